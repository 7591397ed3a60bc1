"""Figures of README and of the studies' pages, from their tables.

    python docs/studies/figures.py

prints the pieces of text that each page must have, and which it lacks; `tests/project/test_figures.py` reads them back.
"""

import csv
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from scipy.stats import binomtest

HERE = Path(__file__).parent
README = HERE.parents[1] / "README.md"
Row = Mapping[str, str]
TABLES = ("paper_gait", "which_law")  # of laws beside both rivals
PD, PLAN, CONFIG = "pd, searched", "load transfer by plan", "pd as configured"
BLIND = "the best without forces"
EQ_3, TRANSFER = "Eq. 3, virtual model", "load transfer"
CASES = ("1_1", "1_2", "2")
GAITS = {"closing": "waits", "at once": "goes on"}  # of the climbs with each grip
RULES = ("nearest", "best_margin", "least_use")


def table(name: str) -> list[Row]:
    """Return the rows of a study's table."""
    with (HERE / f"{name}.csv").open(encoding="utf-8") as rows:
        return list(csv.DictReader(rows))


def changes(law: str, metric: str, rival: str = "pd") -> list[tuple[str, str, float, float, float]]:
    """Return servos, case, and change of a mean from a rival with its interval, per cent, of all comparisons."""
    found = []
    for name in TABLES:
        rows = [row for row in table(name) if row["metric"] == metric and row["of 512 walks"] == "mean"]
        values = {(row["servos"], row["case"], row["law"]): float(row["value"]) for row in rows}
        for row in (row for row in rows if row["law"] == law):
            place, base = (row["servos"], row["case"]), PD if rival == "pd" else row["best without forces"]
            ends = (float(row[f"95 % {end}: difference from {rival} %"]) for end in ("low", "high"))
            found.append((*place, 100 * (values[*place, law] / values[*place, base] - 1), *ends))
    return found


def real(found: Sequence[tuple[str, str, float, float, float]]) -> list[float]:
    """Return the sizes of the reductions whose interval leaves 0 out, per cent."""
    return [-change for _, _, change, _, high in found if high < 0]


def span(values: Sequence[float]) -> str:
    """Return the least and the largest of some values in whole numbers."""
    return f"{min(values):.0f} to {max(values):.0f}"


def cell(change: float, low: float, high: float) -> str:
    """Return a change with its interval as a table has it; ~ where the interval holds 0."""
    middle, first, last = (round(value) for value in (change, low, high))
    return f"{middle} ({first} to {last})" if high < 0 or low > 0 else "~"


def ceiling(row: str, contestant: str, column: str = "objective") -> float:
    """Return a value of the study of the ceiling."""
    rows = (each for each in table("ceiling") if (each["row"], each["contestant"]) == (row, contestant))
    return float(next(rows)[column])


def lead(servos: str, case: str) -> float:
    """Return by how much load transfer is better than searched pd on 512 unseen walks, per cent."""
    place = f"{servos}_{case}_unseen_512"
    return 100 * (1 - ceiling(place, "load_transfer") / ceiling(place, "retuned_pd"))


def part_of_ceiling(servos: str, case: str) -> float:
    """Return the lead of load transfer over that of the plan that knows all, on the searched gaits, per cent."""
    place = f"{servos}_{case}_searched_gait"
    pd, law, plan = (ceiling(place, name) for name in ("retuned_pd", "load_transfer", "clairvoyant"))
    return 100 * (pd - law) / (pd - plan)


def listed(values: Sequence[float]) -> str:
    """Return values as "12, 11 and 14"."""
    *first, last = (f"{value:.0f}" for value in values)
    return f"{', '.join(first)} and {last}"


def arrived(robot: str, law: str, rule: str, density: float, contact: str = "closing") -> list[int]:
    """Return how many climbs arrive, by angle, with grips that close or hold at once."""
    wanted = {"robot": robot, "ground": "rock", "law": law, "rule": rule, "contact": contact, "gait": GAITS[contact]}
    rows = [row for row in table("climb") if wanted.items() <= row.items() and float(row["density"]) == density]
    return [int(row["arrived"]) for row in sorted(rows, key=lambda row: float(row["angle"]))]


def texts() -> dict[Path, list[str]]:
    """Return the sentences that each page must have."""
    closing, at_once = (
        [[each / 2.56 for each in arrived("hubrobo", "base_admittance", rule, 400, contact)] for rule in RULES]
        for contact in GAITS
    )
    leads = {robot: [lead(robot, case) for case in CASES] for robot in ("dynamixel_x", "ideal")}
    parts = [part_of_ceiling("dynamixel_x", case) for case in CASES]
    return {
        README: [
            headline(),
            goal(),
            beside(),
            f"load transfer takes {span(leads['dynamixel_x'])} % off that of pd on Dynamixel X servos. That is "
            f"{span(parts)} % of what joint targets take off that know all in advance.",
            f"arrives in {span([each for row in closing for each in row])} % of 256 climbs at every angle, by "
            "whichever rule it chooses holds.",
            f"With grips that hold at once, wherever they shut, it arrives in {span([row[3] for row in at_once])} % "
            "on an overhang of 135°.",
        ],
        HERE / "ceiling.md": [
            f"takes {listed(leads['dynamixel_x'])} % off the objective of pd that was searched likewise, on ideal "
            f"robots {listed(leads['ideal'])} %.",
            f"On the gaits found on `dynamixel_x` that is {listed(parts)} % of what joint targets take off that know "
            "all in advance",
            *_searched(),
            *_plans(),
            _known_grips(),
        ],
        HERE / "climb.md": [" | ".join(each) for each in _climbs()],
        HERE / "does_the_sensor_pay.md": [
            *_comparisons(),
            headline(),
            goal(),
            beside(),
            *(row.replace("*", "") for row in worth_rows(table("what_a_sensor_is_worth"))),
        ],
        HERE / "which_law.md": [*_laws()],
        HERE / "worse_hardware.md": [*_worse()],
        HERE / "robust_gains.md": [*_robust()],
        HERE / "identification.md": [*_covered()],
        HERE.parent / "explanation" / "statistics.md": [claims()],
        HERE.parent / "guides" / "from_log_to_gains.md": [*_identified()],
    }  # fmt: skip


OF_EACH = (("1.1", "dynamixel_x"), ("1.2", "dynamixel_x"), ("2", "dynamixel_x"), ("1.1", "mx_64"))  # columns
METRICS = ("objective", "V N", "F N", "COT", "peak torque N m")


def _laws() -> Iterator[str]:
    """Yield the rows of the table of laws: changes from a rival, ~ where the interval holds 0; and lost walks."""
    rows = {(row["servos"], row["case"], row["law"], row["metric"]): row
            for row in table("which_law") if row["of 512 walks"] == "mean"}  # fmt: skip
    for law, rival in (*((law, "pd") for law in (PLAN, TRANSFER, *OTHERS, HALVED)), (TRANSFER, BLIND)):
        each = [
            ", ".join(_change(rows[servos, case, law, metric], rival) for metric in METRICS) for case, servos in OF_EACH
        ]
        yield f"{f'{law} beside the plan' if rival == BLIND else law} | {' | '.join(each)} |"
    for law in (PD, PLAN, TRANSFER, *OTHERS):
        lost = (512 * float(rows[servos, case, law, "share lost"]["value"]) for case, servos in OF_EACH)
        yield f"{law} | {' | '.join(f'{number:.1f}' for number in lost)} |"


OTHERS, HALVED = (EQ_3, "Eq. 2, feet", "internal force", "Climb-SDK"), "pd on half the friction"


def _change(own: Row, rival: str) -> str:
    """Return the middle of the interval of a difference in whole per cent, ~ where it holds 0."""
    low, high = (float(own[f"95 % {end}: difference from {rival} %"]) for end in ("low", "high"))
    middle = round((low + high) / 2)
    return "~" if low <= 0 <= high else f"{middle:+d}" if middle else "0"


def _worse() -> Iterator[str]:
    """Yield the cells of the table of worse hardware: V of pd, and of load transfer beside it and beside the plan."""
    settings = {"as drawn": "as drawn",
                "force_sensor.delay=0.002": "all forces 2 ms late", "force_sensor.delay=0.03": "all forces 30 ms late",
                "control_period=0.001": "law and targets at 1 kHz", "control_period=0.02": "law and targets at 50 Hz",
                "friction=x0.5": "half the friction", "friction=x2": "twice the friction",
                "force_sensor.noise=0.5": "0.5 N of noise", "force_sensor.dead.LF=3.0": "sensor of LF dead from 3 s on",
                "force_sensor.bias=1.0": "1 N of bias on all sensors"}  # fmt: skip
    rows = table("worse_hardware")
    found = {(row["case"], row["values"].split(" in ")[0], row["law"]): row for row in rows if row["metric"] == "V N"}
    own = "change from its own walks as drawn, %"
    pairs = ((own, PD), ("difference from pd", TRANSFER), (f"difference from {PLAN}", TRANSFER))
    for column, words in settings.items():
        cells = []
        for case in ("1.1", "1.2"):
            cells.append(", ".join(re.sub("~.*", "~", found[case, *place][column]) for place in pairs))
            cells[-1] = cells[-1].replace(",", " N,", 1) if column == "as drawn" else cells[-1]
        lost = {(row["case"], row["law"]): row[column] for row in rows if row["metric"] == "lost"}
        cells += [", ".join(lost[case, law] for law in (PD, PLAN, TRANSFER)) for case in ("1.1", "1.2")]
        yield f"{words} | {' | '.join(cells)} |"


def _robust() -> Iterator[str]:
    """Yield the rows of the table of robust gains: lost walks, V and P, mean / worst 5 %, of either search."""
    rows = {(row["case"], row["law"], row["gains"], row["metric"]): row for row in table("robust_gains")}
    for case, law in itertools.product(("1.1", "1.2", "2"), (PD, PLAN, TRANSFER, EQ_3)):
        cells = [f"{float(rows[case, law, gains, 'V N']['lost']):.0f}" for gains in ("robust", "nominal")]
        for metric, gains in itertools.product(("V N", "P N"), ("robust", "nominal")):
            own = rows[case, law, gains, metric]
            cells.append(f"{_three(float(own['mean']))} / {_three(float(own['worst 5 %']))}")
        yield f"{case} | {law} | {' | '.join(cells)} |"


def _identified() -> Iterator[str]:
    """Yield what the notebook printed: values with intervals, the held-out error, and forces of walks."""
    cells = json.loads((HERE.parents[1] / "notebooks" / "from_log_to_gains.ipynb").read_text(encoding="utf-8"))["cells"]
    printed = "".join(line for cell in cells for each in cell.get("outputs", []) for line in each.get("text", []))
    _, second = printed.split("tells 4 of 4 parameters")
    for value, low, high in re.findall(r"-> +(\S+) +(\S+) to (\S+)", second):
        yield f"| {value} | {low} to {high} |"
    yield f"within {re.findall(r'within ([0-9.]+) of the noise', second)[-1]} of the noise"
    forces = dict(re.findall(r"(\w+) +force_variation (\S+)", printed))
    yield (
        f"{forces['found']} N of force variation on the robot that was found, {forces['truth']} N on the true one, and "
        f"{forces['profile']} N on the profile's"
    )


def _covered() -> Iterator[str]:
    """Yield shares of intervals that hold the truth, and of these or "the model is wrong", with exact intervals."""
    kinds = ("inside", "inside", "short: inside", *("stribeck", "cogging", "backlash", "flexible joint"),
             "sagging supply", "short: stribeck")  # fmt: skip
    for kind, step in zip(kinds, ("0.00025", *["0.001"] * 8), strict=True):
        rows = [
            row for row in table("identification_benches") if (row["logs"], row["step of the fit, s"]) == (kind, step)
        ]
        cells, logs = [], int(rows[0]["count"])
        for column in ("inside, %", "inside or wrong, %"):
            held = sum(round(logs * float(row[column]) / 100) for row in rows)
            low, high = binomtest(held, logs * len(rows)).proportion_ci()
            cells.append(f"{held / logs / len(rows):.1%} ({low:.1%} to {high:.1%})".replace("%", ""))
        yield f"| {logs} "
        yield f" | {' | '.join(cells)} |"


def _three(value: float) -> str:
    """Return three digits of a value, zeros too."""
    return f"{value:#.3g}".rstrip(".").replace("e+0", "e")


def _plans() -> Iterator[str]:
    """Yield the cells of the ceiling's first table: objective, V / F."""
    names = {"ensemble": ("clairvoyant", "causal 2 ms", "blind", "load_transfer", "retuned_pd"),
             "unseen": ("blind", "load_transfer", "retuned_pd")}  # fmt: skip
    for kind, name, case in ((kind, name, case) for kind, each in names.items() for name in each for case in CASES):
        place = f"dynamixel_x_{case}_{kind}"
        cell = f"{ceiling(place, name):.3f}"
        if kind == "ensemble":
            force, peak = (ceiling(place, name, column) for column in ("force_variation_N", "peak_foot_force_N"))
            cell += f", {force:.0f} / {peak:.3g} N"
        yield cell


def _known_grips() -> str:
    """Return the sentence on targets that know where feet grip, and on those that do not."""
    rows = table("known_grips")
    apart = [float(row["feet_apart_mm"]) for row in rows]
    mean, pd = (
        ", ".join(f"{float(row['objective']):.3f}" for row in rows if row["targets"] == name)
        for name in ("mean of other walks", "pd")
    )
    return (
        f"{min(apart):.1f} to {max(apart):.1f} mm apart from walk to walk. pd does know it. Its own targets, averaged "
        f"over 16 walks and played to 512 others, reach {mean}; pd itself {pd}"
    )


class Worth(NamedTuple):
    """The worth of a force sensor in a case, relative to pd's objective, per cent."""

    servos: str
    case: str
    best: tuple[Row, Row, Row]  # pd, the best law without forces, the best with
    size: float
    low: float
    high: float

    @property
    def told(self) -> bool:
        """Whether the interval leaves 0 out."""
        return self.low > 0 or self.high < 0


def worths(rows: Sequence[Row]) -> Iterator[Worth]:
    """Yield the worth of a sensor in each case of a table of `what_a_sensor_is_worth.py`."""
    for servos, case in dict.fromkeys((row["servos"], row["case"]) for row in rows):
        own = [row for row in rows if (row["servos"], row["case"]) == (servos, case)]
        pd = next(row for row in own if row["law"] == "pd")
        groups = ([row for row in own if ("forces" in row["reads"]) == reads] for reads in (False, True))
        without, best = (min(each, key=lambda row: float(row["objective"])) for each in groups)
        ends = (-100 * float(best[name]) / float(pd["objective"]) for name in ("difference", "high", "low"))
        yield Worth(servos, case, (pd, without, best), *ends)


def worth_rows(rows: Sequence[Row]) -> Iterator[str]:
    """Yield the table's rows of the worth of a sensor: objectives; lost walks of 512; the worth with its interval."""
    for each in worths(rows):
        pd, *others = (f"{float(row['objective']):.3f}; {float(row['lost']):.1f}" for row in each.best)
        cells = [f"{row['law']} {cell}" for row, cell in zip(each.best[1:], others, strict=True)]
        size = f"{each.size:.1f} ({each.low:.1f} to {each.high:.1f})"
        size = f"**{size}**" if each.told else f"~ ({each.low:.1f} to {each.high:.1f})"
        yield f"| {each.servos}, {each.case.replace('_', '.')} | {pd} | {' | '.join(cells)} | {size} |"


def headline() -> str:
    """Return in a sentence where a force sensor is worth something beside the best law without one."""
    found = list(worths(table("what_a_sensor_is_worth")))
    told = [each.size for each in found if each.told and each.servos in WEIGHED]
    others = [each for each in found if not each.told or each.servos not in WEIGHED]
    behind = f", in {len(less)} less" if (less := [each for each in others if each.told and each.size < 0]) else ""
    return (
        "Beside the best law without one, which hands loads over by plan, a force sensor is worth, of pd's objective, "
        f"{span(told)} % on {' and '.join(WEIGHED.values())} servos under weight. On ideal robots and in microgravity, "
        f"{len(others)} of {len(found)} comparisons, it is worth nothing that can be told{behind}."
    )


WEIGHED = {"dynamixel_x": "Dynamixel X", "mx_64": "MX-64"}
HELD = (
    "force_variation", "peak_foot_force", "cost_of_transport", "peak_joint_torque", "peak_pull_force", "base_deviation",
)  # fmt: skip


def goal() -> str:
    """Return in a sentence in how many cases a law with a force sensor leads by 5 %, with nothing worse by 2 %."""
    rows, reached = table("what_a_sensor_is_worth"), 0
    cases = list(worths(rows))
    for each in cases:
        blind = each.best[1]
        own = [row for row in rows if (row["servos"], row["case"]) == (each.servos, each.case)]
        reached += any(
            float(row["objective"]) <= 0.95 * float(blind["objective"]) and float(row["lost"]) == 0
            and all(float(row[name]) <= 1.02 * float(blind[name]) for name in HELD)
            for row in own if "forces" in row["reads"]
        )  # fmt: skip
    return (
        f"In {reached or 'none'} of these {len(cases)} is a law with a sensor 5 % ahead of it with no metric worse by "
        "2 % and no walk lost."
    )


def beside() -> str:
    """Return in a sentence what laws take off pd's objective where the hardware is drawn."""
    plan, transfer, eq_3 = (changes(law, "objective") for law in (PLAN, TRANSFER, EQ_3))
    both = changes(TRANSFER, "objective", BLIND)
    worse = sum(low > 0 for *_, low, _ in both)
    return (
        f"Where hardware is drawn, the plan takes {span(real(plan))} % off the objective of searched pd in "
        f"{len(real(plan))} of {len(plan)} comparisons, load transfer {span(real(transfer))} % in "
        f"{len(real(transfer))}; "
        f"beside the plan load transfer is ahead in {len(real(both))} and behind in {worse}. Eq. 3 takes "
        f"{max(real(eq_3)):.0f} % off in {len(real(eq_3))} of {len(eq_3)}."
    )


def claims() -> str:
    """Return the sentence of the page of statistics on false claims and power."""
    rows = table("false_claims")
    false = [row for row in rows if row["question"] == "any false claim"]
    power = [row for row in rows if row["question"] != "any false claim" and "128 walks" in row["comparisons_of"]]
    found = [f"{float(row['percent']):.0f} % with {row['comparisons_of'].partition(' seeds')[0]}" for row in power]
    most = max(float(row["percent"]) for row in false)
    return (
        f"Of {min(int(row['of']) for row in rows):,} made-up comparisons of equal laws for each of {len(false)} kinds "
        f"of luck, at most {most} % have a false claim. A law 10 % better, at 3 % of luck and 128 walks, is found in "
        f"{', '.join(found[:-1])} and {found[-1]} seeds"
    )


def _searched() -> Iterator[str]:
    """Yield the cells of the table of searched laws."""
    for robot in ("dynamixel_x", "ideal"):
        for law in ("load_transfer", "retuned_pd"):
            for case in CASES:
                place = f"{robot}_{case}_unseen_512"
                objective, change, force = (
                    ceiling(place, law, column) for column in ("objective", "force_variation_N", "peak_foot_force_N")
                )
                yield f"{objective:.3f}, {change:.0f} / {force:.3g}"


def _climbs() -> Iterator[list[str]]:
    """Yield the climbs that arrive, by angle, of each row of the table: with either grip."""
    for robot, law, rule in (
        *(("hubrobo", "base_admittance", rule) for rule in (*RULES, "best_margin free")),
        ("hubrobo", "pd", "best_margin"), ("hubrobo", "load_transfer", "best_margin"),
        ("hubrobo", "load_transfer", "least_use"), *(("hexapod", "base_admittance", rule) for rule in RULES),
    ):  # fmt: skip
        for density in (200, 400) if rule.endswith("free") else (120, 200, 400):
            both = zip(*(arrived(robot, law, rule, density, contact) for contact in GAITS), strict=True)
            yield [f"{closing} / {at_once}" for closing, at_once in both]


def _comparisons() -> Iterator[str]:
    """Yield the rows of the table of comparisons: objectives beside pd, and of load transfer beside the plan."""
    each = (
        changes(PLAN, "objective"),
        changes(TRANSFER, "objective"),
        changes(TRANSFER, "objective", BLIND),
        changes(EQ_3, "objective"),
    )
    for laws in zip(*each, strict=True):
        yield f"| {laws[0][1]} | {' | '.join(cell(*law[2:]) for law in laws)} |"


def lacking() -> Iterator[tuple[Path, str]]:
    """Yield the pieces that pages lack, whatever their lines and bold type."""
    for page, pieces in texts().items():
        text = " ".join(page.read_text(encoding="utf-8").replace("*", "").split())
        yield from ((page, piece) for piece in pieces if " ".join(piece.split()) not in text)


if __name__ == "__main__":
    for place, pieces in texts().items():
        print(place.name, *pieces, sep="\n  ")
    print("missing:", *(f"{place.name}: {piece}" for place, piece in lacking()), sep="\n  ")
