"""Time histories small enough to keep for a batch: the least and the largest value in each stretch of a walk."""

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import DTypeLike

from mjx_climb.checks.time_step import check_time_step
from mjx_climb.compilation.options import pieces_pay
from mjx_climb.control import Law
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.dynamics.spatial import norm
from mjx_climb.quantities.batches import batch_shape
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.rollout import Metrics, backend_of, compiled_walk, given_in, walk_batch, walk_recorded
from mjx_climb.rollouts.trajectory import Trajectory, to_samples
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Metric
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Structure, structure

STRETCHES = 200

# name: unit, long name, and the metric that is its largest value
LINES: dict[str, tuple[str, str, str]] = {
    "foot_force_history": ("N", "largest foot force", "peak_foot_force"),
    "base_deviation_history": ("m", "base off its reference", "base_deviation"),
    "joint_torque_history": ("N m", "largest joint torque", "peak_joint_torque"),
}


class Stretches(NamedTuple):
    """How a walk is cut up."""

    number: int
    steps: int  # of one stretch; the last may be shorter


def stretches(steps: int) -> Stretches:
    """Return the stretches of a walk of so many steps: `STRETCHES` of them, or fewer."""
    length = math.ceil(steps / STRETCHES)
    return Stretches(math.ceil(steps / length), length)


def rollout_histories(
    scenario: Scenario,
    gains: AnyGains | None = None,
    numbers: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    dtype: DTypeLike = np.float32,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: str = DEFAULT_ENGINE,
) -> dict[str, np.ndarray]:
    """Walk a batch of robots and return metrics as `rollout_metrics` does, and `LINES` over time beside them.

    Returns:
        The metrics, and by the names of `LINES` arrays (*batch, 2, stretches) in their units. These are the least and
        the largest value in each of `stretches(scenario.steps)`, not finite from where the state stopped being finite.
    """
    check_time_step(scenario)
    walkers = given_in(scenario, law, gains, numbers, dtype)
    backend = backend_of(walkers, engine, np.float64)  # no kernel writes histories
    in_pieces = pieces_pay(engine, backend)
    walk = structure(scenario, engine, walkers.numbers, law=law, metrics=metrics, in_pieces=in_pieces)
    compiled = functools.partial(_compiled, in_pieces=walk.in_pieces, backend=backend)
    return walk_batch(compiled, walk, walkers, batch_size=batch_size, progress=progress, backend=backend)


def histories(trajectory: Trajectory) -> dict[str, Float[np.ndarray, "extreme stretch"]]:
    """Return `LINES` of one walk, as `rollout_histories` does."""
    lines = _lines(to_samples(trajectory))  # by NumPy: nothing is compiled
    return {name: np.asarray(value)[0] for name, value in _extremes(lines).items()}


def _lines(sample: Sample, length: Callable[..., Any] = np.linalg.norm) -> dict[str, Array]:
    """Return `LINES` of samples stacked over time, (T, B), or as `length` works along an axis."""
    offset = sample.base_position - sample.base_reference
    return {
        "foot_force_history": length(sample.foot_force, axis=-3).max(-2),
        "base_deviation_history": length(offset, axis=-2),
        "joint_torque_history": abs(sample.joint_torque).max((-3, -2)),
    }


def _lines_now(sample: Sample) -> dict[str, Array]:
    """Return `LINES` of a sample of a walk, (B,).

    Lengths are the metrics' own: equal equations are carried out once, so a line's largest value is its metric.
    """
    return _lines(sample, lambda vectors, axis: norm(vectors))


def _extremes(lines: Mapping[str, Array]) -> dict[str, Array]:
    """Return the least and the largest value of lines (T, B) in each stretch, (B, 2, stretches)."""
    steps = len(next(iter(lines.values())))
    count, length = stretches(steps)
    rows = np.arange(count * length).clip(max=steps - 1).reshape(count, length)
    found = {}
    for name, line in lines.items():
        array = line.__array_namespace__()
        found[name] = array.stack([line[rows].min(1), line[rows].max(1)]).transpose(2, 0, 1)
    return found


def _histories_of(structure: Structure, law: Law, numbers: Parameters) -> Metrics:
    metrics, lines = walk_recorded(structure, law, numbers, _lines_now)
    shape = batch_shape(law, numbers)
    return metrics | {name: v.reshape(*shape, *v.shape[1:]) for name, v in _extremes(lines).items()}


@functools.cache
def _compiled(batch: int, in_pieces: bool, backend: str | None) -> Callable[..., Metrics]:
    return compiled_walk(_histories_of, batch, in_pieces, backend)
