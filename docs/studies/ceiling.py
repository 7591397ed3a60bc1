"""How good could any law be: three cases, ideal and on Dynamixel X servos, one walk and an ensemble of 16.

    python docs/studies/ceiling.py results/ceiling [--only dynamixel_x_1_2] [--iterations 80] [--knots 0.2,0.1,0.05]

Every row has a folder with its page; a row whose page is there is not searched again, so that a stopped study goes on,
and rows may be searched side by side by several processes. `rows.csv` has the contestants of all rows. Derivatives
are in forward mode on a GPU and in reverse mode on a CPU.
"""

import argparse
import csv
import json
import time
from pathlib import Path

import yaml
from even_transfer import EvenTransfer

import mjx_climb as mc
import tuning
from tuning.gains import gains_file
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Cargo, Ensemble, Pushes

CASES = ("1_1", "1_2", "2")
WEIGHTS = {name: 1.0 for name in ("force_variation", "peak_foot_force", "cost_of_transport", "peak_joint_torque")}
ROBOTS = {"grip_stiffness": (0.5, 2.0), "robot_mass": (0.9, 1.1), "gravity": None}
# names of laws, and of their steps in ceiling_laws.py
SEARCHED = {
    "load_transfer": "transfer", "even_transfer": "even", "base_admittance": "base",
    "end_effector_admittance": "end_effector", "internal_force": "internal", "retuned_pd": "pd",
}  # fmt: skip
# disturbances of the kind of each case, at a time that no plan can know
DRAWS = {
    "1_1": Ensemble(pushes=None, cargo=Cargo(mass=(0.5, 1.5), start=(1.0, 3.0)), **ROBOTS),
    "1_2": Ensemble(pushes=None, cargo=Cargo(mass=(0.5, 1.5), start=(1.0, 3.0)), **ROBOTS),
    "2": Ensemble(pushes=Pushes(count=2, force=(2.0, 10.0), start=(0.5, 6.0), length=(0.3, 0.6)), cargo=None, **ROBOTS),
}


def scenario_of(hardware: str, case: str, seconds: float) -> mc.Scenario:
    """Return a case with some hardware, its force sensors without noise, which no plan measures."""
    scenario = mc.load_scenario(f"case_{case}").with_overrides({"duration": seconds})
    if hardware == "ideal":
        return scenario
    section = yaml.safe_load(Path(f"configs/hardware/{hardware}.yaml").read_text())["hardware"]
    section["force_sensor"]["noise"] = 0.0
    return scenario.with_overrides({"hardware": section})


def laws_of(scenario: mc.Scenario, hardware: str, case: str, draw: Ensemble | None, folder: Path | None) -> dict:
    """Return the laws that are compared: the gains of a folder, shipped ones, or with ideal hardware searched ones."""
    if folder is not None:
        files = {name: folder / f"{hardware}_{case}_{kind}.yaml" for name, kind in SEARCHED.items()}
        # a law of one's own is not known by its file alone
        own = {"even_transfer": EvenTransfer()}
        return {name: gains_file.whole(file, scenario, own.get(name)) for name, file in files.items() if file.exists()}
    if hardware != "ideal":
        files = {"load_transfer": "best", "retuned_pd": "pd"}
        return {name: f"configs/gains/{hardware}_case_{case}_{kind}.yaml" for name, kind in files.items()}
    how = {"weights": WEIGHTS, "space": "isotropic", "joint_gains": True}
    found = tuning.tune(scenario, **how) if draw is None else tuning.robust(scenario, draw, **how)
    return {scenario.control.controller: found.gains}


def row(
    place: Path, hardware: str, case: str, draw: Ensemble | None, settings: Ceiling, seconds: float, gains: Path | None
) -> None:
    """Search one row of the study and write its folder."""
    scenario, begun = scenario_of(hardware, case, seconds), time.time()

    def told(name: str, done: int, of: int) -> None:
        if done % 20 == 0 or done == of:
            print(f"  {name}: {done} of {of} gradients, {time.time() - begun:.0f} s", flush=True)

    laws = laws_of(scenario, hardware, case, draw, gains)
    found = tuning.ceiling(scenario, laws, settings, ensemble=draw, progress=told)
    print(
        "\n".join(f"  {line}" for line in tuning.write(found, place).outcome),
        f"  {time.time() - begun:.0f} s",
        flush=True,
    )


def main() -> None:
    """Search all rows, or some, and write them as one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default="", help="rows whose name has this in it")
    parser.add_argument("--members", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=Ceiling().iterations)
    parser.add_argument("--knots", default=",".join(map(str, Ceiling().knots)), help="s, coarse to fine")
    parser.add_argument("--delays", default=",".join(map(str, Ceiling().delays)), help="s, of the causal plans")
    parser.add_argument("--random", type=int, default=Ceiling().random, help="random starts")
    parser.add_argument("--test-members", type=int, default=Ceiling().test_members, help="unseen walks")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--gains", type=Path, help="folder of ceiling_laws.py, whose laws are compared")
    parser.add_argument("--better", default=Ceiling().better, help="metric of a front")
    parser.add_argument("--against", help="metric that it is traded against")
    asked = parser.parse_args()
    names = ("iterations", "knots", "delays", "random", "test_members", "better", "against")
    how = {name: getattr(asked, name) for name in names}
    settings = Ceiling(weights=WEIGHTS, **how)
    for hardware in ("dynamixel_x", "ideal"):
        for case in CASES:
            drawn = DRAWS[case].model_copy(update={"members": asked.members})
            for name, draw in (("nominal", None), ("ensemble", drawn)):
                place = asked.out / f"{hardware}_{case}_{name}"
                if asked.only in place.name and not (place / "report.html").exists():
                    print(place.name, flush=True)
                    row(place, hardware, case, draw, settings, asked.seconds, asked.gains)
    rows = []
    for file in sorted(asked.out.glob("*/summary.json")):
        contestants = json.loads(file.read_text())["ceiling"]
        rows += [{"row": file.parent.name, "contestant": name, **own} for name, own in contestants.items()]
    with (asked.out / "rows.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
