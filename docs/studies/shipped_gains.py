"""Write the gains that ship with the program: those of `ceiling_gains.csv`, the best that are known.

Their gait has no stride: a walk keeps the case's speed of travel.

    python docs/studies/shipped_gains.py configs/gains
"""

import csv
import sys
from collections.abc import Mapping
from pathlib import Path

import yaml

FOUND = Path(__file__).with_name("ceiling_gains.csv")
SHIPPED = {("dynamixel_x", law): end for law, end in (("LoadTransfer", "best"), ("PD", "pd"))}
WORDS = {"LoadTransfer": "load transfer", "PD": "pd"}


def files() -> dict[str, str]:
    """Return the texts of the files by their names."""
    gains: dict[tuple[str, str, str], dict[str, float]] = {}
    with FOUND.open() as rows:
        for row in csv.DictReader(rows):
            if (row["servos"], row["law"]) in SHIPPED:
                gains.setdefault((row["servos"], row["case"], row["law"]), {})[row["gain"]] = float(row["value"])
    return {
        f"{servos}_case_{case}_{SHIPPED[servos, law]}.yaml": _text(servos, case, law, values)
        for (servos, case, law), values in gains.items()
    }


def _text(servos: str, case: str, law: str, values: Mapping[str, float]) -> str:
    gait = {name.removeprefix("gait."): value for name, value in values.items() if name.startswith("gait.")}
    own = {name: value for name, value in values.items() if "." not in name}
    text = yaml.safe_dump({"law": law} | own, sort_keys=False)
    gait_text = yaml.safe_dump({"gait": gait}, default_flow_style=None, width=1000, sort_keys=False)
    return (
        f"# {WORDS[law]}, joint gains and gait, sway and height too, searched for case_{case} on {servos}\n"
        f"# CMA-ES, 128 points of 64 walks of 8 s (case 2: 192 walks) in 100 rounds; docs/studies/ceiling.md\n"
        f"{text}{gait_text}"
    )


if __name__ == "__main__":
    for name, text in files().items():
        Path(sys.argv[1], name).write_text(text)
