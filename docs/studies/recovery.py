"""How large a push a walk survives: case 2 under four laws, each with and without recovery.

    python docs/studies/recovery.py results/recovery [--only ideal-pd] [--draws 16] [--seconds 8]

A walk survives if no grip is torn off and the walk does not diverge. Each draw is a time of one push on the base, up
off the ground, down, sideways or ahead; every walk of a row meets the same draws, at each impulse. Thresholds of the
recovery are chosen on draws of their own: those with which most walks survive. A file `NAME.json` of each row has
which walks survived. `--tables` alone gathers them: `survived.csv` has the shares, `half.csv` the impulse at which
half of the walks survive, with an interval over resampled draws, for all directions and each. `--bound` prints what
no law and no step could better: the largest push up that grips bear at rest, however they share it.
"""

import argparse
import csv
import dataclasses
import itertools
import json
import time
from pathlib import Path

import numpy as np
import yaml
from scipy.linalg import block_diag
from scipy.optimize import linprog

import mjx_climb as mc
from mjx_climb.disturbances import Push
from mjx_climb.gait.recovery import Recovery
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.spatial import skew
from mjx_climb.robot_import.load import load_robot
from tuning.gains import gains_file

LENGTHS = {"0.2 s": 0.2, "1 s": 1.0}  # of a push
GRAVITY = {"1e-6 G": 9.81e-6, "1/6 G": 9.81 / 6}
HARDWARE = ("ideal", "dynamixel_x")
# files of gains; None: those of the config
GAINS = {"pd": None, "retuned_pd": "case_2_pd", "base_admittance": "case_2", "load_transfer": "case_2_best"}
DIRECTIONS = {"up": (0, 0, 1.0), "down": (0, 0, -1.0), "sideways": (0, 1.0, 0), "ahead": (1.0, 0, 0)}
IMPULSES = np.geomspace(1.5, 32.0, 8)  # N s
THRESHOLDS = {
    "shift": (0.005, 0.015, 0.04, np.inf),
    "utilization": (0.3, 0.6, 0.9, np.inf),
    "landing_time": (0.1, 0.25),
    "rest_time": (0.3,),
}
KINDS = [*itertools.product(GRAVITY, LENGTHS)]  # of pushes
PERIOD = 0.02  # s, between decisions of the gait


def walker(hardware: str, law: str, seconds: float) -> tuple[mc.Simulation, object]:
    """Return the simulation of a row, and its gains."""
    scenario = mc.load_scenario("configs/case_2.yaml")
    scenario = scenario.with_overrides({"duration": seconds, "gait.planning_period": PERIOD})
    if hardware != "ideal":
        section = yaml.safe_load(Path(f"configs/hardware/{hardware}.yaml").read_text())["hardware"]
        scenario = scenario.with_overrides({"hardware": section})
    if (file := GAINS[law]) is None:
        return mc.Simulation(scenario.with_overrides({"control.controller": law})), None
    own = gains_file.whole(f"configs/gains/dynamixel_x_{file}.yaml", scenario)
    return mc.Simulation(scenario, own.law), own.gains


def drawn(count: int, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (direction * draw, 3) and times (direction * draw,) s of pushes; half of those sideways right.

    All directions have the same times.
    """
    rng = np.random.default_rng(seed)
    start = rng.uniform(0.5, seconds - 2.0, count).round(3)
    way = np.repeat([*DIRECTIONS.values()], count, axis=0)
    way[:, 1] *= np.tile(np.where(np.arange(count) % 2, -1.0, 1.0), len(DIRECTIONS))
    return way, np.tile(start, len(DIRECTIONS))


def survived(
    simulation: mc.Simulation,
    gains: object,
    draws: tuple[np.ndarray, np.ndarray],
    impulses: np.ndarray,
    recovery: Recovery | None,
) -> np.ndarray:
    """Return which walks survive, (..., gravity, length, impulse, draw) bool, behind a recovery's axes."""
    (way, start), length = draws, np.array([*LENGTHS.values()])
    force = (impulses[:, None] / length[:, None, None])[..., None] * way
    own, gravity = own_parameters(simulation.scenario), np.array([*GRAVITY.values()])
    down = np.stack([0 * gravity, 0 * gravity, -gravity], axis=-1)[:, None, None, None]
    push = Push(force=force, moment=0 * force, start=start, stop=start + length[:, None, None])
    others = (each for each in own.disturbances if not isinstance(each, Push))
    parameters = dataclasses.replace(own, gravity=down, disturbances=(*others, push), recovery=recovery)
    found = simulation.metrics(gains, parameters, dtype=np.float32, unsteady=True)
    return np.asarray(np.isnan(found["detached_at"]) & ~found["diverged"].astype(bool))


def half(share: np.ndarray, impulses: np.ndarray) -> float:
    """Return the impulse at which the share of survivors (impulse,) falls to one half, between the impulses tried."""
    share = np.minimum.accumulate(share)
    if share[0] < 0.5 or share[-1] > 0.5:
        return float(impulses[0] if share[0] < 0.5 else impulses[-1])
    return float(np.exp(np.interp(-0.5, -share, np.log(impulses))))


def interval(alive: np.ndarray, impulses: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Return the 95% interval of `half` over resampled times of pushes; `alive` (impulse, direction, draw)."""
    count = alive.shape[2]
    found = [half(alive[..., rng.integers(0, count, count)].mean((1, 2)), impulses) for _ in range(1000)]
    return tuple(np.quantile(found, [0.025, 0.975]).tolist())


def best_of(simulation: mc.Simulation, gains: object, seconds: float, count: int) -> list[dict[str, float]]:
    """Return for each of `KINDS` the thresholds with which most walks of draws of their own survive."""
    settings = [dict(zip(THRESHOLDS, each, strict=True)) for each in itertools.product(*THRESHOLDS.values())]
    columns = {name: np.array([each[name] for each in settings]).reshape(-1, 1, 1, 1, 1) for name in THRESHOLDS}
    alive = survived(simulation, gains, drawn(count, seconds, 1), IMPULSES[1:6], Recovery(**columns, take_over=1.0))
    score = alive.mean((3, 4)).reshape(len(settings), -1)
    for number, kind in enumerate(KINDS):
        order = np.argsort(-score[:, number], kind="stable")[:3]
        print(" ", *kind, *(f"{settings[n]} {score[n, number]:.3f}" for n in order), sep="\n    ", flush=True)
    return [settings[int(n)] for n in score.argmax(0)]


def walk_row(out: Path, hardware: str, law: str, draws: int, seconds: float) -> None:
    """Walk a row without and with recovery, and write which walks survived."""
    simulation, gains = walker(hardware, law, seconds)
    pushes, sizes = drawn(draws, seconds, 2), (len(GRAVITY), len(LENGTHS), 1, 1)
    chosen = best_of(simulation, gains, seconds, max(2, draws // 2))
    columns = {name: np.array([each[name] for each in chosen]).reshape(sizes) for name in THRESHOLDS}
    alive = {
        name: survived(simulation, gains, pushes, IMPULSES, recovery).astype(int).tolist()
        for name, recovery in (("none", None), ("recovery", Recovery(**columns, take_over=1.0)))
    }
    row = {"hardware": hardware, "law": law, "chosen": chosen, "alive": alive}
    (out / f"{hardware}-{law}.json").write_text(json.dumps(row) + "\n")


def write_tables(out: Path) -> None:
    """Write the tables of all rows that have been walked."""
    shares, halves, rng = [], [], np.random.default_rng(0)
    for hardware, law in itertools.product(HARDWARE, GAINS):
        if not (file := out / f"{hardware}-{law}.json").exists():
            continue
        found = json.loads(file.read_text())
        for (number, kind), recovery in itertools.product(enumerate(KINDS), found["alive"]):
            place = np.unravel_index(number, (len(GRAVITY), len(LENGTHS)))
            alive = np.array(found["alive"][recovery])[place].reshape(len(IMPULSES), len(DIRECTIONS), -1)
            row = {"hardware": hardware, "gravity": kind[0], "push": kind[1], "law": law, "recovery": recovery}
            settings = found["chosen"][number]
            used = settings if recovery != "none" else dict.fromkeys(settings, "")
            for n, direction in [(slice(None), "all"), *((slice(n, n + 1), way) for n, way in enumerate(DIRECTIONS))]:
                own = alive[:, n]
                low, high = interval(own, IMPULSES, rng)
                middle, each = half(own.mean((1, 2)), IMPULSES), {**row, "direction": direction}
                halves.append({**each, "half": f"{middle:.3g}", "low": f"{low:.3g}", "high": f"{high:.3g}", **used})
                counts = zip(IMPULSES, own.sum((1, 2)), strict=True)
                of = own[0].size
                shares += [{**each, "impulse": f"{i:.4g}", "survived": int(k), "of": of} for i, k in counts]
    for name, rows in (("survived.csv", shares), ("half.csv", halves)):
        with (out / name).open("w", newline="") as target:
            writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def most_up(feet: np.ndarray, base: np.ndarray, com: np.ndarray, weight: float, limit: float) -> float:
    """Return the largest push up on the base, N, that grips at feet (n, 3) m bear at rest, whatever the law.

    Feet that are pulled bear `limit` N, as a law could share it; friction of the others is without limit. A linear
    program for each choice of the feet that are pulled, with a cone of 24 sides.
    """
    turn = 2 * np.pi * np.arange(24) / 24
    cone = np.stack([np.cos(turn), np.sin(turn), -np.ones(24)], axis=1) / np.sqrt(2)
    rows, best = np.vstack([cone, cone * [1, 1, 0] * np.sqrt(2), [0, 0, -1]]), 0.0
    # forces on the feet and the push add up to nothing, and so do their moments about the centre of mass
    forces = np.hstack([np.eye(3)] * len(feet) + [np.eye(3)[:, 2:]])
    levers = [skew(lever) for lever in feet - com]
    moments = np.hstack([*levers, skew(base - com)[:, 2:]])
    for pulled in itertools.product((False, True), repeat=len(feet)):
        limits = block_diag(*(rows for each in pulled if each)) if any(pulled) else np.zeros((0, 0))
        columns = [3 * foot + axis for foot, each in enumerate(pulled) if each for axis in range(3)]
        above = np.zeros((len(limits), 3 * len(feet) + 1))
        above[:, columns] = limits
        ranges = [(None, None), (None, None), (0, None)], [(None, None), (None, None), (None, 0)]
        found = linprog(
            [0.0] * 3 * len(feet) + [-1.0], above, np.full(len(limits), limit), np.vstack([forces, moments]),
            [0, 0, weight, 0, 0, 0], [each for foot in pulled for each in ranges[foot]] + [(0, None)],
        )  # fmt: skip
        best = max(best, -found.fun) if found.status == 0 else best
    return best


def print_bound(seconds: float, count: int = 40) -> None:
    """Print the largest push up that the feet bear at rest, as the walk has them and with all of them down."""
    simulation, gains = walker("ideal", "pd", seconds)
    robot, times = load_robot(simulation.scenario.robot), drawn(count, seconds, 2)[1][:count]
    for name, size in GRAVITY.items():
        own = dataclasses.replace(own_parameters(simulation.scenario), gravity=np.array([0.0, 0.0, -size]))
        walk = simulation.rollout(gains, own)
        steps = (times / simulation.scenario.time_step).astype(int)
        found = [
            [most_up(walk.foot_position[k][down], walk.base_position[k], walk.center_of_mass[k],
                     robot.total_mass * size, simulation.scenario.contact.holding_limit)
             for down in (walk.support[k], np.full(walk.support.shape[1], True))]
            for k in steps
        ]  # fmt: skip
        standing, all_down = np.median(found, axis=0)
        print(f"{name}: {standing:.1f} N on the feet that stand, {all_down:.1f} N on all feet", flush=True)


def print_searched(file: Path, seconds: float, draws: int) -> None:
    """Print how many walks survive without recovery and with the thresholds of a gains file, under pd."""
    simulation, gains = walker("dynamixel_x", "pd", seconds)
    found = gains_file.whole(file, simulation.scenario).gains
    recovery = Recovery(**{name: found[f"recovery_{name}"] for name in (*THRESHOLDS, "take_over")})
    for name, each in (("none", None), ("searched", recovery)):
        alive = survived(simulation, gains, drawn(draws, seconds, 7), IMPULSES, each)
        for gravity, length in np.ndindex(alive.shape[:2]):
            print(name, [*GRAVITY][gravity], [*LENGTHS][length], *alive[gravity, length].sum(1), "of", alive.shape[-1])


def main() -> None:
    """Walk the rows and write both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--draws", type=int, default=16, help="of each direction")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--only", help="the row of this hardware and law, as ideal-pd, and no table")
    parser.add_argument("--tables", action="store_true", help="walk nothing")
    parser.add_argument("--bound", action="store_true", help="print the bound alone")
    parser.add_argument("--searched", type=Path, help="gains of Recovering: print its survivors alone")
    asked = parser.parse_args()
    if asked.searched:
        print_searched(asked.searched, asked.seconds, asked.draws)
        return
    if asked.bound:
        print_bound(asked.seconds)
        return
    asked.out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    for hardware, law in itertools.product(HARDWARE, GAINS):
        if asked.only in (None, f"{hardware}-{law}") and not asked.tables:
            print(f"{hardware}, {law}, {time.time() - begun:.0f} s", flush=True)
            walk_row(asked.out, hardware, law, asked.draws, asked.seconds)
    if asked.only is None:
        write_tables(asked.out)


if __name__ == "__main__":
    main()
