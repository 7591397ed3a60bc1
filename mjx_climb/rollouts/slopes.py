"""Metrics of a batch with their slopes along directions in the gains: forward-mode derivatives through the walk."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import DTypeLike

from mjx_climb.compilation.options import compiler_options, pieces_pay
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.parameters import Gains, Parameters, batch_shape
from mjx_climb.rollouts.rollout import Metrics, Tree, given, metrics_of, walk_batch
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Metric
from mjx_climb.walk.step import Structure, structure

_SLOPE = "slope of "


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Directions(Gains):
    """Rates of change of gains along k directions: an axis of k after the batch axes of `Gains`."""

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({"inertia": 2, "damping": 2, "stiffness": 2, "kp": 1, "kd": 1})


def rollout_slopes(
    scenario: Scenario,
    gains: Gains,
    directions: Gains,
    numbers: Parameters | None = None,
    *,
    metrics: Iterable[Metric] = METRICS,
    dtype: DTypeLike = np.float32,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Walk a batch of robots and return their metrics and the slopes of these along k directions in the gains.

    A direction costs about as much as the walk itself, and nothing is kept over time.

    Arguments:
        scenario, gains, numbers, metrics, dtype, batch_size, progress, engine, smooth: as `mjx_climb.rollout_metrics`
            takes them; gains with six axes.
        directions: rates of change of the gains, in their units: values (k, *batch, 6), `kp` and `kd` (k, *batch) where
            the gains have them, with batch axes that broadcast to the gains'.

    Returns:
        The metrics (*batch), and the slopes (k, *batch) of those that are real numbers.

    Raises:
        ValueError: `kp` or `kd` in the gains and not in the directions, or the reverse.
    """
    _check_same_gains(gains, directions)
    gains, numbers = given(scenario, gains, numbers, dtype)
    shape = batch_shape(gains, numbers)
    given_rates = {n: v for n, v in vars(directions).items() if v is not None}
    along = _Directions(**{n: _direction_last(n, v, shape, dtype) for n, v in given_rates.items()})
    walk = structure(scenario, engine, metrics=metrics, smooth=smooth, in_pieces=pieces_pay(engine))
    compiled = functools.partial(_compiled, in_pieces=walk.in_pieces)
    found = walk_batch(compiled, walk, (gains, along, numbers), shape, batch_size, progress)
    slopes = {n.removeprefix(_SLOPE): np.moveaxis(v, -1, 0) for n, v in found.items() if n.startswith(_SLOPE)}
    return {name: value for name, value in found.items() if not name.startswith(_SLOPE)}, slopes


def _check_same_gains(gains: Gains, directions: Gains) -> None:
    for name, rates in vars(directions).items():
        value = getattr(gains, name)
        if value is None and rates is not None:
            raise ValueError(f"directions.{name}: expected None, as gains.{name} is, got rates")
        if value is not None and rates is None:
            raise ValueError(f"directions.{name}: expected rates of change, as gains.{name} is given, got None")


def _direction_last(name: str, rates: ArrayLike, shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Return rates (k, *batch, ...) as (*shape, k, ...)."""
    value = np.asarray(rates, dtype)
    own = value.shape[value.ndim - Gains.AXES.get(name, 0) :]
    batch = value.shape[1 : value.ndim - len(own)]
    value = value.reshape(len(value), *[1] * (len(shape) - len(batch)), *batch, *own)
    return np.moveaxis(np.broadcast_to(value, (len(value), *shape, *own)), 0, len(shape))


def _slopes_of(structure: Structure, gains: Gains, along: _Directions, numbers: Parameters) -> Metrics:
    def walked(gains: Gains) -> tuple[Metrics, Metrics]:
        metrics = metrics_of(structure, gains, numbers)
        real = {name: value for name, value in metrics.items() if jnp.issubdtype(value.dtype, jnp.floating)}
        return real, {name: value for name, value in metrics.items() if name not in real}

    def slope(direction: _Directions) -> tuple[Metrics, Metrics, Metrics]:
        return jax.jvp(walked, (gains,), (Gains(**vars(direction)),), has_aux=True)

    robots = jnp.shape(gains.stiffness)[0]
    gains, along = _batched(gains, robots), _batched(along, robots)
    real, slopes, others = jax.vmap(slope, in_axes=1, out_axes=(None, -1, None))(along)
    return real | others | {_SLOPE + name: value for name, value in slopes.items()}


def _batched(tree: Tree, robots: int) -> Tree:
    """Return a tree whose values all have the batch axis."""
    values = {name: value for name, value in vars(tree).items() if value is not None}
    own = {name: value.shape[value.ndim - tree.AXES.get(name, 0) :] for name, value in values.items()}
    wide: dict[str, Any] = {n: jnp.broadcast_to(v, (robots, *own[n])) for n, v in values.items()}
    return dataclasses.replace(tree, **wide)


@functools.cache
def _compiled(batch: int, in_pieces: bool) -> Callable[..., Metrics]:
    return jax.jit(_slopes_of, static_argnums=0, compiler_options=compiler_options(batch, in_pieces=in_pieces))
