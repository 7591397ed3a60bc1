"""Write the gains that ship with the program: those of `ceiling_gains.csv`, the best that are known.

Their gait has no stride: a walk keeps the case's speed of travel.

    python docs/studies/shipped_gains.py configs/gains
"""

import csv
import sys
from collections.abc import Mapping
from pathlib import Path

import yaml

FOUND, LAW = Path(__file__).with_name("ceiling_gains.csv"), "LoadTransfer"
# of load transfer on `dynamixel_x`; on unseen walks of ensemble_dynamixel_x.yaml those of case 1.2 lose 23 of 128, and
# those of case 2 have larger forces than earlier ones, which stay
SHIPPED = {("dynamixel_x", "1_1")}
WALKS = {"1_1": 64}
JUDGED = {
    "1_1": "512 unseen walks of configs/ensemble_dynamixel_x.yaml: V 86.9 N, F 16.6 N, peak torque 0.792 N m, none "
           "lost;\n# the earlier gains 100 N, 16.2 N, 0.823 N m; pd 116 N, 16.5 N, 0.834 N m",
}  # fmt: skip


def files() -> dict[str, str]:
    """Return the texts of the files by their names."""
    gains: dict[tuple[str, str], dict[str, float]] = {}
    with FOUND.open(encoding="utf-8") as rows:
        for row in csv.DictReader(rows):
            place = row["servos"], row["case"]
            if place in SHIPPED and row["law"] == LAW:
                gains.setdefault(place, {})[row["gain"]] = float(row["value"])
    return {f"{servos}_case_{case}_best.yaml": _text(servos, case, own) for (servos, case), own in gains.items()}


def _text(servos: str, case: str, values: Mapping[str, float]) -> str:
    gait = {name.removeprefix("gait."): value for name, value in values.items() if name.startswith("gait.")}
    own = {name: value for name, value in values.items() if "." not in name}
    return (
        f"# load transfer, joint gains and gait, sway and height too, searched for case_{case} on {servos}\n"
        f"# CMA-ES, 128 points of {WALKS[case]} walks of 8 s, 100 rounds or fewer; docs/studies/ceiling.md\n"
        f"# judged on {JUDGED[case]}\n"
        + yaml.safe_dump({"law": LAW} | own, sort_keys=False)
        + yaml.safe_dump({"gait": gait}, default_flow_style=None, width=1000, sort_keys=False)
    )


if __name__ == "__main__":
    for name, text in files().items():
        Path(sys.argv[1], name).write_text(text)
