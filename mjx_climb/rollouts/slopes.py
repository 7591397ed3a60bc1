"""Metrics of a batch with their slopes along directions in the gains: forward-mode derivatives through the walk."""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import DTypeLike

from mjx_climb.checks.time_step import check_time_step
from mjx_climb.compilation.first_possible import first_possible
from mjx_climb.compilation.gpu_kernel import slopes_over_robots
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.compilation.options import kernel_pays, pieces_pay
from mjx_climb.control import Law
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.batches import varying
from mjx_climb.quantities.parameters import Gains, Parameters
from mjx_climb.rollouts.given import AnyGains, Given, values_by_name
from mjx_climb.rollouts.identity import identity
from mjx_climb.rollouts.rollout import Metrics, backend_of, compiled_walk, given_in, metrics_of, walk_batch
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Metric
from mjx_climb.walk.step import Structure, structure

_SLOPE = "slope of "


def rollout_slopes(
    scenario: Scenario,
    gains: AnyGains,
    directions: AnyGains,
    numbers: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    dtype: DTypeLike = np.float32,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Walk a batch of robots and return their metrics and the slopes of these along k directions in the gains.

    A direction costs about as much as the walk itself, and nothing is kept over time. The arguments that are not listed
    are those of `mjx_climb.rollout_metrics`.

    Arguments:
        directions: rates of change of the gains, in their units and by their names: values (k, *batch, n), of length 1
            and for `kp` and `kd` (k, *batch), with batch axes that broadcast to the gains'. A gain of the law without
            rates stays as it is.

    Returns:
        The metrics (*batch), and the slopes (k, *batch) of those that are real numbers.

    Raises:
        ConfigError: no such engine, or a time step too long for the scenario's contacts and joints.
        ValueError: rates of a gain that the law does not have, or `kp` or `kd` in one of two `Gains` alone.
    """
    _check_same_gains(gains, directions)
    check_time_step(scenario)
    walkers = given_in(scenario, law, gains, numbers, dtype)
    rates, axes = _rates(walkers, directions, dtype)
    slopes_of_each = next(iter(rates.values())).shape[len(walkers.shape)]
    backend = backend_of(walkers, engine, dtype, slopes_of_each)
    in_kernel = backend is None and kernel_pays(engine, dtype)
    in_pieces = pieces_pay(engine, backend)
    how: dict[str, Any] = {"metrics": metrics, "smooth": smooth, "in_pieces": in_pieces}
    walk = structure(scenario, engine, walkers.numbers, law=law, **how)

    def compiled(robots: int) -> Callable[..., Metrics]:
        return _compiled_kernel(robots) if in_kernel else _compiled(robots, walk.in_pieces, backend)

    found = walk_batch(compiled, walk, walkers, rates, axes, batch_size, progress, backend)
    slopes = {n.removeprefix(_SLOPE): np.moveaxis(v, -1, 0) for n, v in found.items() if n.startswith(_SLOPE)}
    return {name: value for name, value in found.items() if not name.startswith(_SLOPE)}, slopes


def _check_same_gains(gains: AnyGains, directions: AnyGains) -> None:
    if not (isinstance(gains, Gains) and isinstance(directions, Gains)):
        return
    for name, rates in vars(directions).items():
        value = getattr(gains, name)
        if value is None and rates is not None:
            raise ValueError(f"directions.{name}: expected None, as gains.{name} is, got rates")
        if value is not None and rates is None:
            raise ValueError(f"directions.{name}: expected rates of change, as gains.{name} is given, got None")


def _rates(walkers: Given, directions: AnyGains, dtype: DTypeLike) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return rates (*batch, k, ...) by name, and how many axes each has after the batch's."""
    law, lengths = walkers.law, {n: field.length for n, field in walkers.law.GAINS.items()} | {"kp": 1, "kd": 1}
    given = values_by_name(law, directions)
    along = {
        n: _direction_last(np.asarray(v, dtype), lengths[n], walkers.shape) for n, v in given.items() if n in lengths
    }
    if not along:  # the law has none of these gains: nothing moves
        count = len(next(iter(given.values())))
        along = {"kp": np.zeros((*walkers.shape, count), dtype)}
    return along, {name: 1 + (lengths[name] > 1) for name in along}


def _direction_last(rates: np.ndarray, length: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return rates (k, *batch, length) as (*shape, k, length), without the last axis where the length is 1."""
    own = (length,) if length > 1 else ()
    batch = rates.shape[1 : rates.ndim - len(own)]
    value = np.broadcast_to(rates, (*rates.shape[: rates.ndim - len(own)], *own))
    value = value.reshape(len(value), *[1] * (len(shape) - len(batch)), *batch, *own)
    return np.moveaxis(np.broadcast_to(value, (len(value), *shape, *own)), 0, len(shape))


def _slopes_of(structure: Structure, law: Law, numbers: Parameters, along: dict[str, Array]) -> Metrics:
    def walked(moving: dict[str, Array]) -> tuple[Metrics, Metrics]:
        metrics = metrics_of(structure, *_moved(moving, law, numbers))
        real = {name: value for name, value in metrics.items() if jnp.issubdtype(value.dtype, jnp.floating)}
        return real, {name: value for name, value in metrics.items() if name not in real}

    def slope(direction: dict[str, Array]) -> tuple[Metrics, Metrics, Metrics]:
        return jax.jvp(walked, (_moving(law, numbers, along),), (direction,), has_aux=True)

    real, slopes, others = jax.vmap(slope, in_axes=1, out_axes=(None, -1, None))(along)
    return real | others | {_SLOPE + name: value for name, value in slopes.items()}


def _moving(law: Law, numbers: Parameters, along: dict[str, Array]) -> dict[str, Array]:
    """Return the gains (B, ...) that have rates (B, k, ...), by name."""
    gains = {name: getattr(law if name in law.GAINS else numbers, name) for name in along}
    return {n: jnp.broadcast_to(gains[n], (len(rates), *rates.shape[2:])) for n, rates in along.items()}


def _moved(moving: dict[str, Array], law: Law, numbers: Parameters) -> tuple[Law, Parameters]:
    """Return law and parameters with other gains."""
    gains = {name: value for name, value in moving.items() if name in law.GAINS}
    joint = {name: value for name, value in moving.items() if name not in law.GAINS}
    moved: Law = dataclasses.replace(law, **gains)  # type: ignore[type-var]
    return moved, dataclasses.replace(numbers, **joint)


def _slopes_in_kernel(structure: Structure, law: Law, numbers: Parameters, along: dict[str, Array]) -> Metrics:
    """Return what `_slopes_of` does, by a single GPU kernel."""

    def walked(moving: dict[str, Array], law: Law, numbers: Parameters) -> Metrics:
        return metrics_of(structure, *_moved(moving, law, numbers))

    moving, limbs = _moving(law, numbers, along), len(structure.lift_off)
    batched = [dict.fromkeys(moving, True), varying(law), varying(numbers)]
    metrics, slopes = slopes_over_robots(walked, batched, limbs=limbs)(along, moving, law, numbers)
    return metrics | {_SLOPE + name: value for name, value in slopes.items() if value is not None}


@functools.cache
def _compiled(batch: int, in_pieces: bool, backend: str | None) -> Callable[..., Metrics]:
    return compiled_walk(_slopes_of, batch, in_pieces, backend)


@functools.cache
def _compiled_kernel(batch: int) -> Callable[..., Metrics]:
    kernel = kept(_slopes_in_kernel, identity, {})
    return first_possible(kernel, functools.partial(_compiled, batch, False, None), "the GPU kernel")
