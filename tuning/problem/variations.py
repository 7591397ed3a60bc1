"""Changes of parameters by path: other values, or factors on those that are there.

An ensemble, worse hardware, margins, operating points and halves of a comparison are rows of {path: values or factor}.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.component import checked_value, given
from mjx_climb.hardware.stages import DELAYED
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.parameter_types import SECTIONS
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import MAX_DELAY

PERIOD = "hardware.control_period"
_SERVO = SECTIONS["drive"]
WORDS: Mapping[str, tuple[tuple[str, ...], str]] = {  # of several paths: their sections, and the end of their names
    "delay": (("hardware.force_sensor", "hardware.base_estimate", "hardware.command_delay"), "delay"),
    "period": ((PERIOD,), "period"),
    "friction": ((_SERVO,), "friction"),
    "backlash": ((_SERVO,), "backlash"),
    "noise": (("hardware",), "noise"),
    "bias": (("hardware",), "bias"),
    "armature": ((_SERVO,), "armature"),
}


class Factor(NamedTuple):
    """A factor, with any batch axes, on the value at a path."""

    by: ArrayLike


Change = ArrayLike | Factor


def scaled(text: str) -> float | None:
    """Return the factor of a text as x2, None of another text.

    Raises:
        ValueError: a factor that is no number above 0.
    """
    if not text.startswith("x"):
        return None
    try:
        factor = float(text[1:])
    except ValueError:
        factor = np.nan
    if not 0 < factor < np.inf:
        raise ValueError(f"expected a factor above 0, as x2, got {text!r}")
    return factor


def changed(parameters: mc.Parameters, changes: Mapping[str, Change], step: float | None = None) -> mc.Parameters:
    """Return parameters with other values at some paths; a control period is whole time steps of `step` s, where given.

    Raises:
        ValueError: a path that they do not have.
    """
    found = {
        path: _times(parameters, path, change) if isinstance(change, Factor) else np.asarray(change, float)
        for path, change in changes.items()
    }
    if step is not None and PERIOD in found:
        found[PERIOD] = whole_periods(found[PERIOD], step)
    return parameters.replace(found)


def is_path(name: str) -> bool:
    """Return whether a name is a path of the parameters, and none of a gain, nor of a value of the gait."""
    return "." in name and name not in GAIT


def as_walked(
    scenario: mc.Scenario, law: mc.Law, values: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], mc.Parameters]:
    """Return gains and parameters of robots with values (N,) of gains, the same on all axes, and at paths."""
    own = own_parameters(scenario).replace({name: each for name, each in values.items() if is_path(name)})
    lengths = law.AXES
    gains = {name: each[:, None] if lengths.get(name) else each for name, each in values.items() if not is_path(name)}
    return gains, own


def checked(scenario: mc.Scenario, parameters: mc.Parameters, changes: Mapping[str, Change], key: str) -> mc.Parameters:
    """Return parameters with changes of numbers that a user gave by path.

    Arguments:
        key: of a path in messages, as "draw.{}".

    Raises:
        ConfigError: in one line, a path that they do not have, or a value that no walk can have there.
    """
    for path in changes:
        if path not in parameters.paths:
            raise refused(path, parameters, key.format(path))
    found, longest = changed(parameters, changes, scenario.time_step), MAX_DELAY * scenario.time_step
    for path in changes:
        field, value = parameters.paths[path], found.at(path)
        try:
            checked_value(key.format(path), value, field.shape, *field.bounds, limits=field.limits)
        except ValueError as error:
            raise ConfigError(reason=str(error)) from None
        if path in DELAYED.values() and np.max(value) > longest:
            most = f"{MAX_DELAY} time steps, {longest:g} s"
            raise ConfigError("", key.format(path), f"at most {most}", f"{np.max(value):g}")
    return found


def _times(parameters: mc.Parameters, path: str, factor: Factor) -> np.ndarray:
    value, axes = np.asarray(parameters.at(path), float), len(parameters.paths[path].shape)
    by = np.asarray(factor.by, float)
    return np.asarray(value * by.reshape((*by.shape, *[1] * axes)))


def scalable(parameters: mc.Parameters, paths: Iterable[str]) -> list[str]:
    """Return those of some paths that parameters have and on which a factor changes anything."""
    values = parameters.values
    return [path for path in paths if path in values and given(values[path])]


def paths_of(parameters: mc.Parameters, name: str) -> list[str]:
    """Return the paths that one of `WORDS` stands for, or the one path that a name is."""
    if name not in WORDS:
        return [name]
    sections, end = WORDS[name]
    return [path for path in parameters.paths if path.startswith(sections) and path.endswith(end)]


def whole_periods(periods: ArrayLike, step: float) -> np.ndarray:
    """Return the nearest control periods of whole time steps, one at least, s; 0 (every step) stays."""
    periods = np.asarray(periods, float)
    return np.where(periods > 0, np.maximum(np.round(periods / step), 1) * step, 0.0)


def refused(path: str, parameters: mc.Parameters, key: str) -> ConfigError:
    """Return the refusal of a change, which a key asks for, of a value that a walk does not have."""
    owner = parameters.components.get(path.rpartition(".")[0])
    got = "none" if owner is None else f"{type(owner).__name__} without {path.rpartition('.')[2]}"
    return ConfigError("", key, f"a value at {path} to change", got)
