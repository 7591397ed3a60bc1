"""The feet's force sensors: what acts, late, with an offset and noise, in steps of a resolution, filtered."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.hardware import delay
from mjx_climb.hardware.noise import normal
from mjx_climb.hardware.stages import Stages
from mjx_climb.quantities.parameters import Parameters

FIRST_CHANNEL = 0


class ForceSensor(NamedTuple):
    """What the sensors remember."""

    buffer: Any  # of (3, L, B) N, newest first
    filtered: Any  # (3, L, B) N


def start(force: Array, stages: Stages) -> ForceSensor:
    """Return sensors that have always read `force` (3, L, B) N."""
    return ForceSensor(delay.start(force, stages.force_delay), force if stages.force_filter else ())


def measured(
    sensor: ForceSensor,
    force: Array,
    step: Array,
    numbers: Parameters,
    stages: Stages,
    weights: tuple[Array, ...],
    filter_share: Array,
) -> tuple[ForceSensor, Array]:
    """Return the sensors after this step and what they read of `force` (3, L, B) N: a sample a step.

    `weights` of the delay and `filter_share` are those of `delay.weights` and `share`.
    """
    buffer, filtered = sensor
    if stages.force_delay:
        buffer, force = delay.delayed(buffer, force, weights)
    if stages.force_bias:
        force = force + numbers.force_bias
    if stages.force_noise:
        channels = FIRST_CHANNEL + jnp.arange(force.shape[0] * force.shape[1]).reshape(*force.shape[:2], 1)
        noise = normal(jnp.asarray(numbers.seed), step, channels, force.dtype)
        force = force + numbers.force_noise * noise
    if stages.force_resolution:
        force = rounded(force, jnp.asarray(numbers.force_resolution))
    if stages.force_filter:
        force = filtered = low_passed(filtered, force, filter_share)
    return ForceSensor(buffer, filtered), force


def rounded(force: Array, resolution: Array) -> Array:
    """Return the nearest multiples of the resolution, the force itself where that is 0; the derivative is that of none.

    A staircase is flat wherever it has a derivative: searches would take the sensor for a blind one.
    """
    unit = jnp.where(resolution > 0, resolution, 1.0)
    return force + jnp.where(resolution > 0, jax.lax.stop_gradient(unit * jnp.round(force / unit) - force), 0.0)


def share(cutoff: Array, time_step: float | Array) -> Array:
    """Return the share of an input held over a step that a first-order filter takes in it, `1 - exp(-2 pi f h)`."""
    return -jnp.expm1(-2 * jnp.pi * time_step * cutoff)


def low_passed(before: Array, force: Array, share: Array) -> Array:
    """Return a first-order filter's output after a step, `y += share (u - y)`."""
    return before + share * (force - before)
