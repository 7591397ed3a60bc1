"""What parameters may be: what the keys of a scenario may be that they come from."""

import functools
import math
from typing import Annotated, Any, get_args, get_origin

import jax
import numpy as np
from pydantic import TypeAdapter, ValidationError

from mjx_climb.quantities.parameters import KEYS, Parameters
from mjx_climb.scenario.messages import section
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.values import Number, Positive

_OTHERS: dict[str, Any] = {"foothold_height": Number, "swing_path": Number, "mass_scale": Positive}
_PUSHES = {"push_force": -2, "push_moment": -2, "push_start": -1, "push_stop": -1}  # which axis they are along


def check_ranges(parameters: Parameters) -> None:
    """Refuse parameters that no scenario could have, as far as their values are known.

    Raises:
        ValueError: in one line, which one, what was expected and the first value that is wrong.
    """
    for name, value in vars(parameters).items():
        if isinstance(value, jax.core.Tracer):
            continue
        values = np.asarray(value)
        if values.dtype.kind in "cOSU":
            raise ValueError(f"parameters.{name}: expected real numbers, got {values.dtype}")
        for end in (values.min(), values.max()) if values.size else ():  # of NaN among them both are
            _check(name, float(end))
    pushes = {name: np.shape(getattr(parameters, name))[axis] for name, axis in _PUSHES.items()}
    if len(set(pushes.values())) > 1:
        counts = ", ".join(f"{count} of {name}" for name, count in pushes.items())
        raise ValueError(f"parameters.push_start: expected as many of each for the pushes, got {counts}")


def _check(name: str, value: float) -> None:
    kind, validator = _type(name)
    given: Any = value
    if value == math.inf and type(None) in get_args(kind):
        given = None
    elif get_origin(kind) is tuple:
        given = (value,) * len(get_args(kind))
    elif kind is int and value.is_integer():
        given = int(value)
    try:
        validator.validate_python(given)
    except ValidationError as invalid:
        expected = invalid.errors()[0]["ctx"]["expected"].replace("or null", "or infinite")
        raise ValueError(f"parameters.{name}: expected {expected}, got {value:g}") from None


@functools.cache
def _type(name: str) -> tuple[Any, TypeAdapter[Any]]:
    """Return the type of the key that a parameter comes from, and what validates its values."""
    if name in _OTHERS:
        return float, TypeAdapter(_OTHERS[name])
    *place, key = KEYS[name].split(".")
    field = section(Scenario, place).model_fields[key]
    kind: Any = Annotated[field.annotation, *field.metadata]
    return field.annotation, TypeAdapter(kind)
