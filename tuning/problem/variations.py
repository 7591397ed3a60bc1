"""Changes of parameters by path: other values, or factors on those that are there.

An ensemble, worse hardware, margins, operating points and halves of a comparison are rows of {path: values or factor}.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.component import given
from mjx_climb.scenario.messages import ConfigError


class Factor(NamedTuple):
    """A factor, with any batch axes, on the value at a path."""

    by: ArrayLike


Change = ArrayLike | Factor


def changed(parameters: mc.Parameters, changes: Mapping[str, Change]) -> mc.Parameters:
    """Return parameters with other values at some paths.

    Raises:
        ValueError: a path that they do not have.
    """
    return parameters.replace(
        {
            path: _times(parameters, path, change) if isinstance(change, Factor) else np.asarray(change, float)
            for path, change in changes.items()
        }
    )


def _times(parameters: mc.Parameters, path: str, factor: Factor) -> np.ndarray:
    value, axes = np.asarray(parameters.at(path), float), len(parameters.paths[path].shape)
    by = np.asarray(factor.by, float)
    return np.asarray(value * by.reshape((*by.shape, *[1] * axes)))


def scalable(parameters: mc.Parameters, paths: Iterable[str]) -> list[str]:
    """Return those of some paths that parameters have and on which a factor changes anything."""
    values = parameters.values
    return [path for path in paths if path in values and given(values[path])]


def ending(parameters: mc.Parameters, section: str, *names: str) -> list[str]:
    """Return the paths of a section whose last word ends in one of some names, as "_friction"."""
    return [path for path in parameters.paths if path.startswith(f"{section}.") and path.endswith(names)]


def refused(path: str, parameters: mc.Parameters, key: str) -> ConfigError:
    """Return the refusal of a change, which a key asks for, of a value that a walk does not have."""
    place = path.rpartition(".")[0]
    owner = parameters.components.get(place)
    got = "none" if owner is None else f"{type(owner).__name__} without {path.rpartition('.')[2]}"
    return ConfigError(f"{key}: expected a value at {path} to change, got {got}")
