"""Gains as labelled arrays: their units and names, those of a law of one's own too, and their axes."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.files.dataset import COORDINATES, SIX

AXES = {3: "three", 6: "six"}  # the dimension of a gain of so many axes
KNOWN = (*mc.Gains.AXES, "kp", "kd")


class Labelled(NamedTuple):
    """A variable of a dataset, as xarray takes it."""

    dims: tuple[str, ...]
    values: np.ndarray
    attrs: dict[str, str]


def labels(law: mc.Law | None = None) -> dict[str, tuple[str, str]]:
    """Return unit and long name of every gain; where rotations have another unit, it follows after a comma."""
    own = {} if law is None else law.GAINS
    known = {name: COORDINATES[name] for name in KNOWN}
    return known | {n: (field.unit, field.long_name or n.replace("_", " ")) for n, field in own.items()}


def labelled(
    gains: Mapping[str, np.ndarray], leading: tuple[str, ...], law: mc.Law | None = None
) -> dict[str, Labelled]:
    """Return gains (*leading) or (*leading, axes) as variables."""
    known, variables = labels(law), {}
    for name, values in gains.items():
        axes = () if values.ndim == len(leading) else (AXES[values.shape[-1]],)
        unit, text = known[name]
        variables[name] = Labelled((*leading, *axes), values, {"units": unit, "long_name": text})
    return variables


def axes_of(variables: Mapping[str, Labelled]) -> dict[str, list[str]]:
    """Return the coordinates of the axes that some gains have."""
    used = {variable.dims[-1] for variable in variables.values()}
    return {name: list(SIX[:length]) for length, name in AXES.items() if name in used}
