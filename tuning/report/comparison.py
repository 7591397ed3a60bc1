"""Walks side by side: a table, and what it says in words."""

from collections.abc import Container, Mapping
from typing import Any

from mjx_climb import METRICS, Gains, Law, MetricTable, Trajectory
from tuning.gains.gains_file import by_name
from tuning.gains.labels import labels
from tuning.report.numbers import axis_values, change, gain, is_number, number, plain_unit, unit
from tuning.report.page import Table
from tuning.report.remarks import failed

Values = Mapping[str, Any]
Compared = Mapping[str, tuple[Values | None, Values]]  # gains (None for a controller without) and metrics by name


def gains_of(walk: Trajectory) -> dict[str, Any] | None:
    """Return the gains of a walk as they were given, None where its controller has none."""
    if walk.law:
        return by_name(walk.gains)
    control = walk.scenario.control
    return None if control.controller == "pd" else {name: getattr(control, name) for name in Gains.AXES}


def gain_units(compared: Compared, law: Law | None = None) -> dict[str, tuple[str, str]]:
    """Return the units of a translation and of a rotation by gain, those of the joint loop left out.

    They are the gains of the walks, in the order of the paper's, then those of the user's law; the paper's where no
    walk has any.
    """
    held = [gains for gains, _ in compared.values() if gains is not None]
    own = dict.fromkeys(name for gains in held for name in gains if name not in ("kp", "kd"))
    known = labels(law)
    first = [name for name in ("stiffness", "damping", "inertia") if name in own or not own]
    units = {name: known[name][0].split(",") for name in dict.fromkeys([*first, *own])}
    return {name: (plain_unit(each[0]), plain_unit(each[-1])) for name, each in units.items()}


def table(compared: Compared, caption: str, about: MetricTable = METRICS, law: Law | None = None) -> Table:
    """Return gains and metrics of walks; the first is also given as change against the others, in per cent.

    `about` holds the metrics themselves, `law` is the user's own, if any.
    """
    first, *others = compared
    columns = ["", "unit", first, *(f"vs {name} %" for name in others), *others]
    gains = []
    for key, (text, _) in gain_units(compared, law).items():
        values = {name: gain(held, key) for name, (held, _) in compared.items()}
        gains.append([key, text, values[first], *("" for _ in others), *(values[name] for name in others)])
    rows = []
    for key, value in compared[first][1].items():
        theirs = [compared[name][1][key] for name in others]
        changes = [change(value, base) for base in theirs]
        rows.append([about.in_words(key), unit(key, about), number(value), *changes, *map(number, theirs)])
    return Table(caption, columns, [("", gains), ("", rows)])


def gains_table(compared: Compared, law: Law | None = None) -> Table:
    """Return the gains of walks, axis by axis; `law` is the user's own, if any."""
    held = {name: gains for name, (gains, _) in compared.items() if gains is not None}
    sections = []
    for key, units in gain_units(compared, law).items():
        values = {name: axis_values(gains.get(key)) for name, gains in held.items()}
        if law is not None and key in law.GAINS and law.GAINS[key].length == 1:
            rows = [[key, units[0], *(number(_finite(v[0])) for v in values.values())]]
        else:
            axes = enumerate(("x", "y", "z", "rx", "ry", "rz"))
            rows = [[f"{key} {a}", units[i // 3], *(number(_finite(v[i])) for v in values.values())] for i, a in axes]
        sections.append(("", rows))
    return Table("Gains by axis", ["", "unit", *held], sections)


def _finite(value: float) -> float | None:
    return value if value == value else None


def against(metric: str, value: float | None, others: Values, about: MetricTable = METRICS) -> str:
    """Return "47.1 N, 49.7 % below the paper's gains, 52.9 % below pd"."""
    whose = {"paper": "the paper's gains", "config": "the config's gains"}
    text = f"{number(value)} {unit(metric, about)}".strip()
    for name, other in others.items():
        if percent := change(value, other):
            text += f", {percent.lstrip('+-')} % {'above' if percent[0] == '+' else 'below'} {whose.get(name, name)}"
    return text


def held(metrics: Values) -> str:
    """Return in words whether the grippers held."""
    if failures := failed(metrics):
        return failures
    if missed := metrics.get("missed_grips"):
        return f"every grip holds, but {missed} missed the ground"
    return "every gripper holds"


def differences(
    metrics: Values, baseline: Values, about: MetricTable = METRICS, but: Container[str] = (), least: float = 2.0
) -> tuple[list[str], list[str]]:
    """Return which metrics are worse than under the baseline, as "base deviation +414 %", and which are better.

    All but some, where they differ by more than so many per cent.
    """
    worse: list[str] = []
    better: list[str] = []
    for name, value in metrics.items():
        base = baseline[name]
        if name in but or not (is_number(value) and is_number(base)) or not abs(value - base) > least / 100 * abs(base):
            continue
        text = f"{change(value, base)} %" if base > 0 else f"{number(base)} to {number(value)}"
        kind = better if (value > base) == about[name].larger_is_better else worse
        kind.append(f"{about.in_words(name)} {text}")
    return worse, better
