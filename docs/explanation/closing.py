"""Compare the grip that holds at once with the one that closes, in case 1.2, by three tables beside this file.

Run from the repository's root: `python docs/explanation/closing.py`. `closing.csv` has the force after shutting, which
the picture of docs/explanation/physics.md shows; `closing_pd.csv` the peak pull of pd of 64 gains; and
`closing_searches.csv` the least peak pull that gradients and CMA-ES find.
"""

import csv
import itertools
import sys
from pathlib import Path

import numpy as np
import yaml

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

import mjx_climb as mc  # noqa: E402
import tuning  # noqa: E402

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
_SERVOS = HERE.parents[1] / "configs" / "hardware" / "dynamixel_x.yaml"
# ideal joints of a kd near 1 N m s/rad need a shorter time step
SERVOS = {"ideal": {"time_step": 2.5e-4}, "dynamixel_x": yaml.safe_load(_SERVOS.read_text(encoding="utf-8"))}
SEEDS, LIMIT = 3, 0.005  # searches of each kind; m, of the base's deviation


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
    """Return the peak pull of pd of 64 gains, by servos and contact; print the largest change from one to the next."""
    rows: list[list[object]] = []
    factors = STEP ** (np.arange(STEPS) - STEPS // 2)
    gains = {"kp": KP * factors[:, None], "kd": KD * factors}
    for (servos, hardware), (name, contact) in itertools.product(SERVOS.items(), CONTACTS.items()):
        scenario = mc.load_scenario("case_1_2", contact | {"control.controller": "pd"}).with_overrides(hardware)
        pull = mc.rollout_metrics(scenario, gains, dtype=np.float64, unsteady=True)["peak_pull_force"]
        change = max(np.abs(np.diff(np.log(pull), axis=axis)).max() for axis in (0, 1))
        span = f"{pull.min():.3f} to {pull.max():.3f} N"
        print(f"{servos}, {name}: peak pull {span}, factor {np.exp(change):.3f} for {STEP - 1:.0%}", flush=True)
        for (i, j), value in np.ndenumerate(pull):
            rows.append([servos, name, f"{gains['kp'][i, 0]:.4g}", f"{gains['kd'][j]:.4g}", f"{value:.4f}"])
    return rows


def searches() -> list[list[object]]:
    """Return the least peak pull that searches of the shipped law's gains find, by contact, method and seed."""
    rows: list[list[object]] = []
    for (name, contact), method, seed in itertools.product(CONTACTS.items(), ("gradient", "cmaes"), range(SEEDS)):
        scenario = mc.load_scenario("case_1_2", contact)
        how = {"space": "split", "weights": {"peak_pull_force": 1.0}, "limits": {"base_deviation": LIMIT}}
        found = tuning.tune(scenario, method=method, seed=seed, **how)
        rows.append([name, method, seed, f"{found.metrics['peak_pull_force']:.4f}", found.env_steps])
        print(*rows[-1], flush=True)
    return rows


def written(name: str, header: list[str], rows: list[list[object]]) -> None:
    """Write a table beside this file."""
    with (HERE / name).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


if __name__ == "__main__":
    written("closing.csv", ["contact", "time ms", "pull N", "height mm"], forces())
    header = ["servos", "contact", "kp N m/rad", "kd N m s/rad", "peak pull N"]
    written("closing_pd.csv", header, around_pd())
    written("closing_searches.csv", ["contact", "method", "seed", "peak pull N", "env-steps"], searches())
