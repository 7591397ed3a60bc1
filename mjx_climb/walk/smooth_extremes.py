"""Smooth companions of the metrics that are extremes over a walk.

A plain maximum has a derivative almost everywhere, but one that sees a single instant and jumps where another instant
takes over. The power mean of order 32 over all instants (and feet, or joints) tends to the maximum, to within some
ten per cent, and sees every instant close to it. Minima are log-sum-exp means in units of a hundredth of the first
value. They serve searches that follow gradients; results are reported with the true extremes.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient

from mjx_climb.dynamics.spatial import norm
from mjx_climb.robot.constants import Robot
from mjx_climb.walk.sample import Sample

PREFIX = "smooth_"
MAXIMA = ("peak_foot_force", "peak_pull_force", "peak_joint_torque", "base_deviation")
MINIMA = ("min_tsm", "min_gia_margin", "joint_limit_margin")

_SQUARINGS = 5
ORDER = 2**_SQUARINGS
_SHARPNESS = 100.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mean:
    """A running mean of scaled powers or exponentials, each (B,); no derivative goes through `extreme` and `unit`."""

    extreme: Array  # so far; keeps the powers and exponentials between 0 and 1
    unit: Array  # of the exponentials
    total: Array
    count: Array


def _power(value: Array) -> Array:
    for _ in range(_SQUARINGS):
        value = value * value
    return value


def start(batch: int, dtype: jnp.dtype) -> dict[str, Mean]:
    """Return the means of a walk that has not begun."""
    zero, one = jnp.zeros(batch, dtype), jnp.ones(batch, dtype)
    means = {name: Mean(zero, one, zero, zero) for name in MAXIMA}
    return means | {name: Mean(jnp.full(batch, jnp.inf, dtype), zero, zero, zero) for name in MINIMA}


def accumulate(means: dict[str, Mean], sample: Sample, robot: Robot) -> dict[str, Mean]:
    """Return the means with one more sample of the walk."""
    force = norm(sample.foot_force)
    pulling = sample.support & (sample.foot_force[2] < 0)
    joints = (-1, force.shape[-1])
    margin = jnp.minimum(sample.joint_angles - robot.joint_lower, robot.joint_upper - sample.joint_angles)
    values = {
        "peak_foot_force": force,
        "peak_pull_force": jnp.where(pulling, force, 0.0),
        "peak_joint_torque": jnp.abs(sample.joint_torque).reshape(joints),
        "base_deviation": norm(sample.base_position - sample.base_reference)[None],
        "min_tsm": sample.tsm[None],
        "min_gia_margin": sample.gia_margin[None],
        "joint_limit_margin": margin.reshape(joints),
    }
    return {name: (_with_large if name in MAXIMA else _with_small)(mean, values[name]) for name, mean in means.items()}


def _with_large(mean: Mean, values: Array) -> Mean:
    extreme = stop_gradient(jnp.maximum(mean.extreme, values.max(0)))
    scale = jnp.where(extreme > 0, extreme, 1.0)
    total = mean.total * _power(mean.extreme / scale) + _power(values / scale).sum(0)
    return Mean(extreme, mean.unit, total, mean.count + values.shape[0])


def _with_small(mean: Mean, values: Array) -> Mean:
    first = mean.count == 0
    least = stop_gradient(values.min(0))
    unit = jnp.where(first, jnp.maximum(jnp.abs(least), 1e-6) / _SHARPNESS, mean.unit)
    extreme = stop_gradient(jnp.minimum(mean.extreme, least))
    before = jnp.where(first, 0.0, mean.total * jnp.exp((extreme - jnp.where(first, extreme, mean.extreme)) / unit))
    return Mean(extreme, unit, before + jnp.exp((extreme - values) / unit).sum(0), mean.count + values.shape[0])


def finish(means: dict[str, Mean]) -> dict[str, Array]:
    """Return the smooth extremes (B,), in the units of the true ones, named with `PREFIX`."""
    result = {}
    for name, mean in means.items():
        share = mean.total / mean.count
        some = share > 0
        share = jnp.where(some, share, 1.0)
        if name in MAXIMA:
            value = jnp.where(some, mean.extreme * share ** (1 / ORDER), 0.0)
        else:
            value = mean.extreme - mean.unit * jnp.log(share)
        result[PREFIX + name] = value
    return result
