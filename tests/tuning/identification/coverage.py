"""How often intervals hold: python -m tests.tuning.identification.coverage [REPEATS] [SECONDS] prints what it counts.

Truths are drawn from what servos are; each has its log by MuJoCo's C code, with noise, delay and jitter.
"""

import sys
from collections import defaultdict

import numpy as np

import mjx_climb as mc
import tuning
from tests.tuning.identification.stand_in_mujoco import Truth, log_of

KEYS = (
    "hardware.servo.armature",
    "hardware.servo.coulomb_friction",
    "control.kp",
    "control.kd",
    "hardware.command_delay",
)
SPANS = ((0.006, 0.02), (0.03, 0.1), (25.0, 60.0), (0.2, 0.5), (0.002, 0.008))  # even in the logarithm
TRUTHS = 20
STEP = 2.5e-4  # s, of MuJoCo's Runge-Kutta


def counted(repeats, duration, said=lambda line: None):
    """Return which intervals hold the truth, their widths over Fisher's, and errors held out over the noise."""
    scenario = mc.Scenario().with_overrides({"control.kp": 40.0, "control.kd": 0.3})
    inside, wide, ahead = defaultdict(list), defaultdict(list), []
    for repeat in range(repeats):
        drawn = np.exp(np.random.default_rng(repeat % TRUTHS).uniform(*np.log(SPANS).T))
        drawn[4] = round(drawn[4] / STEP) * STEP
        truth = dict(zip(KEYS, drawn, strict=True))
        robot = Truth(*(drawn[:2]), 0.0, *drawn[2:])
        log = log_of(robot, duration, jitter=0.0005, seed=1000 + repeat, step=STEP)
        found = tuning.identify(scenario, log, KEYS, starts=1)
        ahead.append(found.held_out["error_over_noise"])
        for n, key in enumerate(KEYS):
            estimate = found.estimates[key]
            inside[key].append(estimate.low <= truth[key] <= estimate.high)
            wide[key].append(found.posterior.widening[n])
        said(f"{repeat}: {[(k.rpartition('.')[2], v[-1]) for k, v in inside.items()]} {ahead[-1]:.3f} {found.warnings}")
    return inside, wide, ahead


def main():
    repeats, duration = int(sys.argv[1] if sys.argv[1:] else 100), float(sys.argv[2] if sys.argv[2:] else 5.0)
    inside, wide, ahead = counted(repeats, duration, lambda line: print(line, flush=True))
    for key in KEYS:
        print(f"{key}: inside {np.mean(inside[key]):.1%}, width over Fisher {np.mean(wide[key]):.3f}")
    print(f"all: inside {np.mean(list(inside.values())):.1%}; held out {np.mean(ahead):.3f}, worst {max(ahead):.3f}")


if __name__ == "__main__":
    main()
