"""Compare the grip that snaps shut with the one that closes: force after shutting, and peak pull of pd around one pd.

Run from the repository's root: `python docs/explanation/closing.py`. It writes `closing.csv`, which the picture of
docs/explanation/physics.md shows, and `closing_pd.csv`, both beside itself.
"""

import csv
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

import mjx_climb as mc  # noqa: E402

CONTACTS = {
    "at once": {"contact.closing_time": 0.0, "contact.capture_distance": 0.005},
    "closing": {"contact.closing_time": 0.1, "contact.capture_distance": 0.005},
}
HANGS = {
    "control.controller": "pd", "gravity": [0.0, 0.0, 1.62], "disturbance.cargo.mass": 0.0, "duration": 1.1,
    "contact.holding_limit": None,
}  # fmt: skip
SPAN = 0.02  # s after the first gripper shuts
KP, KD = 17.24, 0.9705  # N m/rad, N m s/rad, of pd retuned for case 1.2: docs/start/first_sweep.md
STEPS, STEP = 8, 1.03  # gains of each kind, and the factor from one to the next


def forces() -> list[list[object]]:
    """Return the pull on LH and its distance off the ceiling over the first 20 ms, by contact."""
    rows: list[list[object]] = []
    for name, contact in CONTACTS.items():
        walk = mc.rollout(mc.load_scenario("case_1_2", HANGS | contact))
        limb = walk.limbs.index("LH")
        shut = int(walk.support[:, limb].argmax())
        gap = walk.grip_gap[shut, limb]
        for step in range(shut, shut + round(SPAN / walk.scenario.time_step) + 1):
            time, pull = walk.time[step] - walk.time[shut], -walk.foot_force[step, limb, 2]
            rows.append([name, f"{1e3 * time:.0f}", f"{pull:.4f}", f"{1e3 * walk.foot_position[step, limb, 2]:.4f}"])
        print(f"{name}: {1e3 * gap:.2f} mm off when it shuts, {-walk.foot_force[shut, limb, 2]:.2f} N in that step")
    return rows


def around_pd() -> list[list[object]]:
    """Return the peak pull of pd of 64 gains in case 1.2, by contact; print the largest change from one to the next."""
    rows: list[list[object]] = []
    # a larger kd is too large for the time step
    factors = STEP ** (np.arange(STEPS) - STEPS + 1)
    gains = {"kp": KP * factors[:, None] * STEP ** (STEPS // 2), "kd": KD * factors}
    for name, contact in CONTACTS.items():
        scenario = mc.load_scenario("case_1_2", contact | {"control.controller": "pd"})
        found = mc.rollout_metrics(scenario, gains, dtype=np.float64, unsteady=True)
        pull = np.where(found["diverged"], np.nan, found["peak_pull_force"])
        change = max(np.nanmax(np.abs(np.diff(np.log(pull), axis=axis))) for axis in (0, 1))
        span = f"{np.nanmin(pull):.3f} to {np.nanmax(pull):.3f} N, {np.isnan(pull).sum()} diverge"
        print(f"{name}: peak pull {span}, factor {np.exp(change):.3f} for {STEP - 1:.0%}")
        for (i, j), value in np.ndenumerate(pull):
            rows.append([name, f"{gains['kp'][i, 0]:.4g}", f"{gains['kd'][j]:.4g}", f"{value:.4f}"])
    return rows


def written(name: str, header: list[str], rows: list[list[object]]) -> None:
    """Write a table beside this file."""
    with (HERE / name).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


if __name__ == "__main__":
    written("closing.csv", ["contact", "time ms", "pull N", "height mm"], forces())
    written("closing_pd.csv", ["contact", "kp N m/rad", "kd N m s/rad", "peak pull N"], around_pd())
