"""How large a push a walk survives: case 2 under pd and load transfer, each with and without recovery.

    python docs/studies/recovery.py results/recovery [--draws 64] [--seconds 8]

A walk survives if no grip is torn off and the walk does not diverge. Each draw is a direction and a time of one push
on the base; every walk of a row meets the same draws, at each impulse. Thresholds of the recovery are chosen
on draws of their own: those with which most walks survive. `survived.csv` has the shares, `half.csv` the impulse at
which half of the walks survive, with an interval over resampled draws.
"""

import argparse
import csv
import dataclasses
import itertools
import time
from pathlib import Path

import numpy as np
import yaml

import mjx_climb as mc
from mjx_climb.gait.recovery import Recovery
from mjx_climb.inputs.from_scenario import own_parameters
from tuning.gains import gains_file

LENGTHS = {"0.2 s": 0.2}  # of a push
GRAVITY = {"1e-6 G": 9.81e-6, "1/6 G": 9.81 / 6}
HARDWARE = ("ideal", "dynamixel_x")
GAINS = {"pd": "pd", "load_transfer": "best"}
IMPULSES = np.geomspace(0.25, 16.0, 19)  # N s
THRESHOLDS = {
    "shift": (0.005, 0.015, 0.04, np.inf),
    "utilization": (0.3, 0.6, 0.9, np.inf),
    "landing_time": (0.1, 0.25),
    "rest_time": (0.3,),
}
KINDS = [*itertools.product(GRAVITY, LENGTHS)]  # of pushes
PERIOD = 0.02  # s, of the planner


def walker(hardware: str, law: str, seconds: float) -> tuple[mc.Simulation, object]:
    """Return the simulation of a row, and its gains."""
    scenario = mc.load_scenario("configs/case_2.yaml")
    scenario = scenario.with_overrides({"duration": seconds, "gait.planning_period": PERIOD})
    file = f"configs/gains/dynamixel_x_case_2_{GAINS[law]}.yaml"
    if hardware != "ideal":
        section = yaml.safe_load(Path(f"configs/hardware/{hardware}.yaml").read_text())["hardware"]
        scenario = scenario.with_overrides({"hardware": section})
    own = gains_file.whole(file, scenario)
    return mc.Simulation(scenario, own.law), own.gains


def drawn(count: int, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (draw, 3) over the sphere and times (draw,) s of pushes."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True), rng.uniform(0.5, seconds - 2.0, count).round(3)


def survived(
    simulation: mc.Simulation,
    gains: object,
    draws: tuple[np.ndarray, np.ndarray],
    impulses: np.ndarray,
    recovery: Recovery | None,
) -> np.ndarray:
    """Return which walks survive, (..., gravity, length, impulse, draw) bool, behind a recovery's axes."""
    (way, start), length = draws, np.array([*LENGTHS.values()])
    force = (impulses[:, None] / length[:, None, None])[..., None, None] * way[:, None]
    own, gravity = own_parameters(simulation.scenario), np.array([*GRAVITY.values()])
    down = np.stack([0 * gravity, 0 * gravity, -gravity], axis=-1)[:, None, None, None]
    parameters = dataclasses.replace(
        own, gravity=down, push_force=force, push_moment=0 * force, push_start=start[:, None],
        push_stop=(start + length[:, None, None])[..., None], recovery=recovery,
    )  # fmt: skip
    found = simulation.metrics(gains, parameters, dtype=np.float32, unsteady=True)
    return np.asarray(np.isnan(found["detached_at"]) & ~found["diverged"].astype(bool))


def half(share: np.ndarray, impulses: np.ndarray) -> float:
    """Return the impulse at which the share of survivors (impulse,) falls to one half, between the impulses tried."""
    share = np.minimum.accumulate(share)
    if share[0] < 0.5 or share[-1] > 0.5:
        return float(impulses[0] if share[0] < 0.5 else impulses[-1])
    return float(np.exp(np.interp(-0.5, -share, np.log(impulses))))


def interval(alive: np.ndarray, impulses: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95% interval of `half` over resampled draws; `alive` (impulse, draw)."""
    count = alive.shape[1]
    found = [half(alive[:, rng.integers(0, count, count)].mean(1), impulses) for _ in range(1000)]
    return tuple(np.quantile(found, [0.025, 0.975]).tolist())


def best_of(simulation: mc.Simulation, gains: object, seconds: float, count: int) -> list[dict[str, float]]:
    """Return for each of `KINDS` the thresholds with which most walks of draws of their own survive."""
    settings = [dict(zip(THRESHOLDS, each, strict=True)) for each in itertools.product(*THRESHOLDS.values())]
    columns = {name: np.array([each[name] for each in settings]).reshape(-1, 1, 1, 1, 1) for name in THRESHOLDS}
    alive = survived(simulation, gains, drawn(count, seconds, 1), IMPULSES[3::3], Recovery(**columns))
    score = alive.mean((3, 4)).reshape(len(settings), -1)
    for number, kind in enumerate(KINDS):
        order = np.argsort(-score[:, number])[:3]
        print(" ", *kind, *(f"{settings[n]} {score[n, number]:.3f}" for n in order), sep="\n    ", flush=True)
    return [settings[int(n)] for n in score.argmax(0)]


def main() -> None:
    """Walk all rows and write both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--draws", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--only", default="", help="rows whose hardware and law have this in them, as ideal-pd")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    shares, halves, rng, begun = [], [], np.random.default_rng(0), time.time()
    draws, sizes = drawn(asked.draws, asked.seconds, 2), (len(GRAVITY), len(LENGTHS), 1, 1)
    for hardware, law in itertools.product(HARDWARE, GAINS):
        if asked.only not in f"{hardware}-{law}":
            continue
        print(f"{hardware}, {law}, {time.time() - begun:.0f} s", flush=True)
        simulation, gains = walker(hardware, law, asked.seconds)
        alive = {"none": survived(simulation, gains, draws, IMPULSES, None)}
        chosen = best_of(simulation, gains, asked.seconds, max(8, asked.draws // 4))
        columns = {name: np.array([each[name] for each in chosen]).reshape(sizes) for name in THRESHOLDS}
        alive["recovery"] = survived(simulation, gains, draws, IMPULSES, Recovery(**columns))
        for recovery, (kind, settings, place) in itertools.product(
            alive, zip(KINDS, chosen, np.ndindex(sizes[:2]), strict=True)
        ):
            own = alive[recovery][place]
            row = {"hardware": hardware, "gravity": kind[0], "push": kind[1], "law": law, "recovery": recovery}
            each = zip(IMPULSES, own.sum(1), strict=True)
            shares += [{**row, "impulse": f"{i:.4g}", "survived": int(n), "of": own.shape[1]} for i, n in each]
            low, high = interval(own, IMPULSES, rng)
            middle, used = half(own.mean(1), IMPULSES), settings if recovery != "none" else dict.fromkeys(settings, "")
            halves.append({**row, "half": f"{middle:.3g}", "low": f"{low:.3g}", "high": f"{high:.3g}", **used})
            print(f"  {', '.join(kind)}, {recovery}: {middle:.3g} N s ({low:.3g} to {high:.3g})", flush=True)
        for file, rows in (("survived.csv", shares), ("half.csv", halves)):
            with (asked.out / file).open("w", newline="") as target:
                writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
