"""A metric: one number of a walk, accumulated from its samples so that a batch needs no memory over time."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, SupportsIndex

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.robot.constants import Robot
from mjx_climb.walk.sample import Sample

Value = Callable[[Sample, "Context"], Array]  # of one sample


class Context(NamedTuple):
    """What a metric may know beside a sample: what stays the same all through a walk, and how far this has come."""

    robot: Robot  # as heavy as it is in this walk
    gravity: Array | np.ndarray  # (3, B) m/s^2
    heading: Array | np.ndarray  # (B,) rad
    time_step: float | Array  # s
    first: Array | bool = True  # () whether this is the first sample
    diverged: Array | bool = False  # (B,) whether an earlier sample was not finite


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number of a walk, with its name, unit and meaning, and how it comes from the samples.

    A walk's batch of B robots is the last axis of every array. A running value is an array (..., B) or a tree of them,
    and keeps its shapes and types. Samples from the one on that is not finite never get here.
    """

    name: str  # in mappings, options and files
    unit: str  # "1" where there is none
    long_name: str  # for people: on pictures, in tables
    larger_is_better: bool  # of two walks the one with more is the better one
    init: Callable[[Array], Any]  # of zeros (B,): the running value before the first sample
    update: Callable[[Any, Sample, Context], Any]  # the running value with one more sample
    finish: Callable[[Any, Context], Array]  # the metric (B,) of the last running value; NaN where it is not defined
    smooth: "Metric | None" = None  # its companion for searches that follow gradients; in place of an extreme
    scale: float | None = None  # how much counts as much, in its unit, where values pass through zero

    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        """A shipped one is pickled by its name, as its functions have none; one's own by its fields."""
        from mjx_climb.walk.metrics.shipped import METRICS, shipped

        own = all(metric is not self for metric in METRICS.with_companions)
        return super().__reduce_ex__(protocol) if own else (shipped, (self.name,))


def total(name: str, unit: str, long_name: str, value: Value, *, larger_is_better: bool = False) -> Metric:
    """Return the metric that integrates a value (B,) of each sample over time: `unit` is the value's times s."""
    return Metric(
        name,
        unit,
        long_name,
        larger_is_better,
        init=lambda zero: zero,
        update=lambda running, sample, context: running + value(sample, context) * context.time_step,
        finish=lambda running, _: jnp.asarray(running),
    )
