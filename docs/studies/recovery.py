"""How large a push a walk survives: case 2 under four laws, each with and without recovery.

    python docs/studies/recovery.py results/recovery.csv [--draws 64] [--seconds 8] [--hardware dynamixel_x]

Pushes are those of `mjx-climb evaluate --pushes`. Thresholds of the recovery are those with which most walks
survive on draws of their own. The table has impulses in N s that half and 95 % survive with intervals, for
all directions and each. `--bound` prints what no law and no step could better: the largest push up that grips bear at
rest, however they share it.
"""

import argparse
import csv
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.linalg import block_diag
from scipy.optimize import linprog

import mjx_climb as mc
from mjx_climb.gait.recovery import Recovery
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.spatial import skew
from mjx_climb.robot_import.load import load_robot
from tuning.comparisons.pushes import DIRECTIONS, METRICS, SHARES, SMALLEST, Walker, borne, find, instants, pushed
from tuning.gains import gains_file
from tuning.problem.objectives import lost

LENGTHS = (0.2, 1.0)  # s, of a push
LARGEST = 160.0  # N
FORCES = 8  # with which thresholds are chosen
GRAVITY = {"1e-6 G": 9.81e-6, "1/6 G": 9.81 / 6}
HARDWARE = ("ideal", "dynamixel_x")
# files of gains; None: those of the config
GAINS = {"pd": None, "retuned_pd": "case_2_pd", "base_admittance": "case_2", "load_transfer": "case_2_best"}
THRESHOLDS = {
    "shift": (0.005, 0.015, 0.04, np.inf),
    "utilization": (0.3, 0.6, 0.9, np.inf),
    "landing_time": (0.1, 0.25),
    "rest_time": (0.3,),
}
PERIOD = 0.02  # s, between decisions of the gait


def walker(hardware: str, law: str, seconds: float, gravity: float) -> tuple[mc.Scenario, Walker]:
    """Return the scenario of a row, and whose walks are pushed there."""
    scenario = mc.load_scenario("configs/case_2.yaml")
    scenario = scenario.with_overrides({"duration": seconds, "gait.planning_period": PERIOD})
    scenario = scenario.with_overrides({"gravity": [0.0, 0.0, -gravity]})
    if hardware != "ideal":
        section = yaml.safe_load(Path(f"configs/hardware/{hardware}.yaml").read_text())["hardware"]
        scenario = scenario.with_overrides({"hardware": section})
    if (file := GAINS[law]) is None:
        scenario = scenario.with_overrides({"control.controller": law})
        return scenario, Walker(None, {}, own_parameters(scenario))
    own = gains_file.whole(f"configs/gains/dynamixel_x_{file}.yaml", scenario)
    return scenario, Walker(own.law, own.gains, own_parameters(scenario))


def recovering(own: Walker, settings: dict[str, float]) -> Walker:
    """Return the same walks with recovery."""
    assert own.parameters is not None
    values: dict[str, Any] = {name: np.asarray(value) for name, value in settings.items()}
    values["take_over"] = np.asarray(1.0)
    return own._replace(parameters=dataclasses.replace(own.parameters, recovery=Recovery(**values)))


def chosen(scenario: mc.Scenario, own: Walker, draws: int) -> dict[float, dict[str, float]]:
    """Return the thresholds with which most walks survive, by the length of a push: pushes of all sizes, in one batch.

    Batch axes are thresholds, force, length, direction, draw.
    """
    each = [dict(zip(THRESHOLDS, values, strict=True)) for values in itertools.product(*THRESHOLDS.values())]
    axes = np.moveaxis(np.array([[*settings.values()] for settings in each]), 1, 0)[..., None, None, None, None]
    walkers = recovering(own, dict(zip(THRESHOLDS, axes, strict=True)))
    force = np.geomspace(SMALLEST, 1.0, FORCES)[:, None, None, None] * LARGEST
    force = np.broadcast_to(force, (len(each), FORCES, len(LENGTHS), len(DIRECTIONS), draws))
    start = instants(scenario, LENGTHS, draws, seed=1)
    parameters = pushed(scenario, walkers, force, np.array(LENGTHS), start, seed=1)
    found = mc.rollout_metrics(scenario, own.gains, parameters, law=own.law, metrics=METRICS, unsteady=True)
    survivors = (np.asarray(lost(found)) == 0).sum(axis=(1, 3, 4))
    return {length: each[int(np.argmax(survivors[:, n]))] for n, length in enumerate(LENGTHS)}


def rows_of(hardware: str, law: str, gravity: str, seconds: float, draws: int) -> list[dict[str, object]]:
    """Return the rows of one law: without recovery, and with the best thresholds for each length of a push."""
    scenario, own = walker(hardware, law, seconds, GRAVITY[gravity])
    best = chosen(scenario, own, max(2, draws // 8))
    walkers = {"none": own} | {f"{length:g} s": recovering(own, settings) for length, settings in best.items()}
    found = find(scenario, walkers, lengths=LENGTHS, largest=LARGEST, draws=draws, seed=2)
    rows: list[dict[str, object]] = []
    for length, name in itertools.product(LENGTHS, ("none", "recovery")):
        data = found.sel(walker=f"{length:g} s" if name == "recovery" else name, length=length)
        for direction in ("all", *DIRECTIONS):
            pushes = data if direction == "all" else data.sel(direction=direction)
            row: dict[str, object] = {"hardware": hardware, "gravity": gravity, "push": f"{length:g} s", "law": law}
            row |= {"recovery": name, "direction": direction}
            for words, share in SHARES.items():
                middle, low, high = (f"{length * value:.3g}" for value in borne(pushes, share))
                row |= {words: middle, f"{words} low".removeprefix("half "): low}
                row |= {f"{words} high".removeprefix("half "): high}
            rows.append(row | (best[length] if name == "recovery" else dict.fromkeys(THRESHOLDS, "")))
    return rows


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
    random = np.random.default_rng(2)
    for name, size in GRAVITY.items():
        scenario, _ = walker("ideal", "pd", seconds, size)
        walk, robot = mc.rollout(scenario), load_robot(scenario.robot)
        steps = (random.uniform(0.5, seconds - 2.0, count) / scenario.time_step).astype(int)
        found = [
            [most_up(walk.foot_position[k][down], walk.base_position[k], walk.center_of_mass[k],
                     robot.total_mass * size, scenario.contact.holding_limit)
             for down in (walk.support[k], np.full(walk.support.shape[1], True))]
            for k in steps
        ]  # fmt: skip
        standing, all_down = np.median(found, axis=0)
        print(f"{name}: {standing:.1f} N on the feet that stand, {all_down:.1f} N on all feet", flush=True)


def main() -> None:
    """Walk all rows and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--draws", type=int, default=64, help="of each direction")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--hardware", choices=HARDWARE, nargs="+", default=list(HARDWARE))
    parser.add_argument("--bound", action="store_true", help="print the bound alone")
    asked = parser.parse_args()
    if asked.bound:
        print_bound(asked.seconds)
        return
    rows: list[dict[str, object]] = []
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    for hardware, law, gravity in itertools.product(asked.hardware, GAINS, GRAVITY):
        print(hardware, law, gravity, flush=True)
        rows += rows_of(hardware, law, gravity, asked.seconds, asked.draws)
        with asked.out.open("w", newline="") as target:
            writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
