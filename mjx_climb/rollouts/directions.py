"""Directions in the gains, along which tangents are asked for: checked, and laid out for the batch."""

import numpy as np
from numpy.typing import DTypeLike

from mjx_climb.quantities.parameters import Gains
from mjx_climb.rollouts.resolve import AnyGains, Resolved, values_by_name


def check_same_gains(gains: AnyGains, directions: AnyGains) -> None:
    """Refuse `kp` or `kd` in one of two `Gains` alone.

    Raises:
        ValueError: in one line, which one.
    """
    if not (isinstance(gains, Gains) and isinstance(directions, Gains)):
        return
    for name, rates in vars(directions).items():
        value = getattr(gains, name)
        if value is None and rates is not None:
            raise ValueError(f"directions.{name}: expected None, as gains.{name} is, got rates")
        if value is not None and rates is None:
            raise ValueError(f"directions.{name}: expected rates of change, as gains.{name} is given, got None")


def moving_gains(resolved: Resolved, directions: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the gains (*batch, ...) that have directions, by name, and how many axes the value of one robot has."""
    law, parameters = resolved.law, resolved.parameters
    gains = {name: np.asarray(getattr(law if name in law.GAINS else parameters, name)) for name in directions}
    return gains, {name: law.AXES.get(name, 0) for name in gains}


def resolved_directions(resolved: Resolved, directions: AnyGains, dtype: DTypeLike) -> dict[str, np.ndarray]:
    """Return directions (k, *batch, n) by name as (*batch, k, n), without the last axis where a gain is one number."""
    law, shape = resolved.law, resolved.shape
    lengths = {name: field.length for name, field in law.GAINS.items()} | {"kp": 1, "kd": 1}
    given = values_by_name(law, directions)
    found = {
        name: _direction_last(np.asarray(value, dtype), lengths[name], shape)
        for name, value in given.items()
        if name in lengths
    }
    if not found:  # the law has none of these gains: nothing moves
        found = {"kp": np.zeros((*shape, len(next(iter(given.values())))), dtype)}
    return found


def _direction_last(value: np.ndarray, length: int, shape: tuple[int, ...]) -> np.ndarray:
    own = (length,) if length > 1 else ()
    batch = value.shape[1 : value.ndim - len(own)]
    value = np.broadcast_to(value, (*value.shape[: value.ndim - len(own)], *own))
    value = value.reshape(len(value), *[1] * (len(shape) - len(batch)), *batch, *own)
    return np.moveaxis(np.broadcast_to(value, (len(value), *shape, *own)), 0, len(shape))
