"""Walks side by side: tables."""

from collections.abc import Sequence

import numpy as np

from mjx_climb import METRICS, Law, MetricTable
from mjx_climb.files.dataset import SIX
from tuning.comparisons import verdicts
from tuning.comparisons.side_by_side import Compared
from tuning.gains.gains_tables import JOINT_UNITS, labels
from tuning.numbers import axis_values, change_of, gain, has_axes, number, plain_unit, presentable, unit
from tuning.pages.page import Table

Column = tuple[str, str | None]  # a walk, and the walk that it is given as change against; None: its own values


def _gain_units(compared: Compared, law: Law | None) -> dict[str, tuple[str, str]]:
    """Return the units of a translation and of a rotation by gain, those of the joint loop left out.

    They are the gains of the walks, in the order of the paper's, then those of the user's law; the paper's where no
    walk has any.
    """
    own = dict.fromkeys(name for gains, _ in compared.values() for name in gains or () if name not in JOINT_UNITS)
    known = labels(law)
    first = [name for name in ("stiffness", "damping", "inertia") if name in own or not own]
    # of a value at a path the label is its unit's alone where no law knows it
    units = {name: known.get(name, ("", ""))[0].split(",") for name in dict.fromkeys([*first, *own])}
    return {name: (plain_unit(each[0]), plain_unit(each[-1])) for name, each in units.items()}


def table(
    compared: Compared, caption: str, about: MetricTable = METRICS, law: Law | None = None,
    columns: Sequence[Column] | None = None,
) -> Table:  # fmt: skip
    """Return gains and metrics of walks side by side, and changes in per cent.

    Where no columns are asked for: the first walk, its change against each of the others, and these. Of walks that
    failed there is no change.
    """
    if columns is None:
        first, *others = compared
        columns = [(first, None), *((first, name) for name in others), *((name, None) for name in others)]
    heads = [name if base is None else f"vs {base} %" for name, base in columns]
    gains = [
        [key, text, *(gain(compared[name][0], key) if base is None else "" for name, base in columns)]
        for key, (text, _) in _gain_units(compared, law).items()
    ]
    rows, metrics = [], {name: own for name, (_, own) in compared.items()}
    told = {name: presentable(own) for name, own in metrics.items()}
    for key in told[columns[0][0]]:
        cells = (
            number(told[name][key]) if base is None else change_of(metrics[name], metrics[base], key)
            for name, base in columns
        )
        rows.append([about.in_words(key), unit(key, about), *cells])
    return Table(f"{caption}{verdicts.explained(compared)}", ["metric", "unit", *heads], [("", gains), ("", rows)])


def gains_table(compared: Compared, law: Law | None = None) -> Table:
    """Return the gains of walks, axis by axis where the axes differ; `law` is the user's own, if any."""
    held = {name: gains for name, (gains, _) in compared.items() if gains is not None}
    sections = []
    for key, units in _gain_units(compared, law).items():
        if not all(has_axes(gains.get(key)) for gains in held.values()):
            sections.append(("", [[key, units[0], *(gain(gains, key) for gains in held.values())]]))
            continue
        values = [axis_values(gains.get(key)) for gains in held.values()]
        cells = [[number(None if np.isnan(value) else value) for value in six] for six in values]
        if all(len({*each}) == 1 for each in cells):
            rows = [[key, units[0], *(each[0] for each in cells)]]
        else:
            rows = [[f"{key} {axis}", units[i // 3], *(each[i] for each in cells)] for i, axis in enumerate(SIX)]
        sections.append(("", rows))
    # where some have an integral term those without one have none
    told = {"kp": all, "kd": all, "ki": any}
    joint = [name for name in JOINT_UNITS if held and told[name](name in gains for gains in held.values())]
    if joint:
        both = [[name, JOINT_UNITS[name], *(number(gains.get(name)) for gains in held.values())] for name in joint]
        sections.append(("", both))
    return Table("Gains by axis", ["gain", "unit", *held], sections)
