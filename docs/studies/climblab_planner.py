"""How ClimbLab's planner and this one differ: each option of the choice, by choices and by arrivals.

    JAX_ENABLE_X64=1 python -m docs.studies.climblab_planner results/climblab_planner.csv

Choices are those of the 225 states of `tests/reference/climblab_nonperiodic.npz`. Walks go 0.5 m ahead in a free order
by ClimbLab's rule: on 8 grids of holds every 6 cm, which begin anywhere within a pitch, and on 16 grounds with 400
random holds a square metre. A walk arrives if the base is there before a grip is torn off. They have a heading; by
ClimbLab's options others head for a goal 5 m ahead, as ClimbLab's do.
"""

import argparse
import csv
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

import mjx_climb as mc
from mjx_climb.gait.footholds.climblab import ClimbLab
from mjx_climb.ground import Holds, holds_of_seeds
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.from_scenario import own_parameters
from tests.gait.test_climblab_choices import STATES, planned

WAY, PITCH, GRIDS, GROUNDS = 0.5, 0.06, 8, 16  # m, m, walks, walks
GOAL = (5.0, 0.0)  # m
# ClimbLab's values of the options
CLIMBLAB = {"reach_a_stride_on": False, "reach_by_height": True, "base_must_follow": True}
KEYS = {
    "duration": 40.0, "time_step": 1e-3, "gravity": [0.0, 0.0, -1.62], "gait.cycle": 2.0, "gait.stride": 0.1,
    "gait.order": "free", "gait.footholds": "climblab", "gait.planning_period": 0.1, "control.controller": "pd",
    "control.kp": 20.0, "control.kd": 0.1, "contact.holding_limit": None,
    "ground.holds.rock": {"density": 400.0, "corner": [-0.4, -0.4], "size": [1.5, 0.8]}, "ground.holds.limit": None,
    "ground.holds.spread": 0.0, "ground.holds.count": 480,
}  # fmt: skip


def grounds(scenario: mc.Scenario) -> Holds:
    """Return the holds of all walks, (walk, n): the grids first."""
    rock = holds_of_seeds(scenario.ground, range(GROUNDS))
    count = rock.position.shape[1]
    x, y = np.meshgrid(np.arange(-0.4, 1.1, PITCH), np.arange(-0.4, 0.4, PITCH), indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    begin = PITCH * np.random.default_rng(0).random((GRIDS, 1, 3)) * [1, 1, 0]
    found = {name: np.array(getattr(rock, name)) for name in Holds.VALUES}
    grids = {name: np.repeat(value[:1], GRIDS, axis=0) for name, value in found.items()}
    grids["position"] = np.pad(grid + begin, ((0, 0), (0, count - len(grid)), (0, 0)))
    grids["normal"] = np.broadcast_to([0.0, 0, 1], grids["position"].shape)
    grids["valid"] = np.tile(np.arange(count) < len(grid), (GRIDS, 1)).astype(float)
    return Holds(**{name: np.concatenate([grids[name], found[name]]) for name in found})


def arrived(scenario: mc.Scenario, rule: ClimbLab) -> np.ndarray:
    """Return which walks arrive, (walk,) bool."""
    own = own_parameters(scenario)
    parameters = dataclasses.replace(own, ground=Ground(holds=grounds(scenario)), footholds=rule)
    found = mc.Simulation(scenario).metrics(None, parameters, dtype=np.float32, unsteady=True)
    return np.asarray((found["travel"] >= WAY) & np.isnan(found["detached_at"]) & (found["diverged"] == 0))


def main() -> None:
    """Decide and walk by all settings of the options, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    scenario = mc.load_scenario("configs/climb_rock.yaml").with_overrides(KEYS)
    rows = []
    each = [(False, own) for own in itertools.product(*([value, not value] for value in CLIMBLAB.values()))]
    for goal, own in (*each, (True, tuple(CLIMBLAB.values()))):
        options: dict[str, Any] = dict(zip(CLIMBLAB, own, strict=True))
        limb, hold, of_limb, *_ = planned(ClimbLab(**options))
        stays = np.where(STATES["of_limb"] < 0, STATES["feet"], STATES["of_limb"])
        heads = scenario.with_overrides({"gait.way_points": [GOAL]}) if goal else scenario
        there = arrived(heads, ClimbLab(**options))
        row = {name: str(value).lower() for name, value in {"goal": goal, **options}.items()}
        row["limb and hold %"] = f"{100 * ((limb == STATES['limb']) & (hold == STATES['hold'])).mean():.1f}"
        row["hold of each limb %"] = f"{100 * (of_limb == stays).mean():.1f}"
        row |= {"grids": f"{there[:GRIDS].sum()} of {GRIDS}", "random grounds": f"{there[GRIDS:].sum()} of {GROUNDS}"}
        rows.append(row)
        print(row, flush=True)
        with out.open("w", newline="") as target:
            writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
