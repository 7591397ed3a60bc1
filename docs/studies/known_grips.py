"""What plans lose by not knowing where feet grip: searched pd beside its own joint targets, the same for all walks.

    python docs/studies/known_grips.py results/grips.csv [--members 16] [--unseen 512]

pd plans its targets from where its feet did grip. Their mean over some walks knows nothing of that, and is played to
walks that took no part in it; so is each walk's own record, which checks the playing. `ceiling.md` has the figures.
"""

import argparse
import csv
from pathlib import Path

import ceiling as study
import ceiling_laws as searched
import jax
import numpy as np
from what_a_sensor_is_worth import known

from mjx_climb.control import PD
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from tuning.problem import ensemble as ensembles
from tuning.problem import plans
from tuning.problem.evaluation import under_pd
from tuning.searches import ceiling as bounds

HARDWARE = "dynamixel_x"
COLUMNS = ("objective", "force_variation", "peak_foot_force", "lost")


def walked(scenario, draw, how):
    """Return the parameters (N, ...) of a draw's walks under pd, and the targets (N, time, limb, joint) rad sent."""
    drawn = bounds.draws_of(scenario, draw, 0, {}).parameters
    parameters = plans.rows(scenario, PD(), {}, drawn, draw.members)
    reached = plans.over_time(scenario, PD(), {}, parameters, **how).joint_targets
    each = [plans.commanded(one, plans.row(parameters, n), scenario) for n, one in enumerate(reached)]
    return parameters, np.stack(each)


def rows_of(case, members, unseen):
    """Return means over unseen walks of a case: under pd, under its record, and under the mean of other walks'."""
    own = known(HARDWARE, case, "PD")[0]
    plain = study.scenario_of(HARDWARE, case, 8.0)
    scenario = under_pd(searched.begun(plain, own, "pd")[0])
    draw = study.DRAWS[case].model_copy(update={"members": members})
    others = ensembles.fresh(draw).model_copy(update={"members": unseen})
    (goal,) = searched.goals_on(plain, study.WEIGHTS, others)
    how = {"metrics": searched.TABLE, "engine": "limb", "dtype": np.float32}
    _, sent = walked(scenario, draw, how)
    every, back = walked(scenario, others, how)
    walks = plans.walks_of(scenario, goal, every, **how)
    mean = np.broadcast_to(sent.mean(0), back.shape)
    feet = limb_frames(load_robot(scenario.robot), None, sent[:, :: scenario.steps // 200]).foot
    apart = 1e3 * float(np.sqrt(((feet - feet.mean(0)) ** 2).sum(-1).mean()))
    for name, played in (("pd", back), ("mean of other walks", mean)):
        found = walks.judge(played, every)
        metrics = jax.tree.map(np.asarray, found.metrics) | {"objective": found.value}
        metrics["lost"] = searched.lost({n: metrics[n] for n in ("peak_utilization", "diverged")})
        yield [HARDWARE, case, name, apart, *(float(np.mean(metrics[column])) for column in COLUMNS)]


def main():
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--members", type=int, default=16)
    parser.add_argument("--unseen", type=int, default=512)
    asked = parser.parse_args()
    with asked.out.open("w", newline="") as file:
        write = csv.writer(file, lineterminator="\n")
        write.writerow(["servos", "case", "targets", "feet_apart_mm", *COLUMNS])
        for case in study.CASES:
            for row in rows_of(case, asked.members, asked.unseen):
                print(row, flush=True)
                write.writerow([f"{value:.5g}" if isinstance(value, float) else value for value in row])


if __name__ == "__main__":
    main()
