"""How a virtual mass moves: integrated exactly, or as the paper's first author does it on a robot.

His C++ library `admittance_control` (2026, Apache-2.0) works on three-vectors, of force and of moment: an input whose
norm is below a deadband counts as zero; semi-implicit Euler in substeps of at most 2 ms, of a period cut to 20 ms;
rate and displacement bounded in norm, and at the bound of the displacement no rate outwards.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mjx_climb.control.virtual_model import Impedance, Transition, VirtualState, advance, discretize
from mjx_climb.dynamics.spatial import dot, norm

SUBSTEP = 2e-3  # s, at most
LONGEST_PERIOD = 20e-3  # s
Pair = tuple[float, float]  # of translations, of rotations


class Motion(NamedTuple):
    """What a walk is compiled for."""

    semi_implicit: bool = False
    deadband: Pair = (0.0, 0.0)  # N, N m
    max_offset: Pair = (math.inf, math.inf)  # m, rad
    max_velocity: Pair = (math.inf, math.inf)  # m/s, rad/s


class Mass(NamedTuple):
    """The state of a law with a virtual mass: what it moves by, which stays the same, and where it is."""

    pace: Any  # `Transition`, or the period in s
    state: VirtualState


def begin(motion: Motion, gains: Impedance, period: float | Array, state: VirtualState) -> Mass:
    """Return a virtual mass in a state, for steps of `period` s."""
    return Mass(jnp.asarray(period) if motion.semi_implicit else discretize(gains, period), state)


def move(motion: Motion, gains: Impedance, mass: Mass, force: Array) -> Mass:
    """Return the virtual mass one step later, under `force` (3 or 6, ..., B) N, N m."""
    force = _in_threes(force, motion.deadband, dead)
    if motion.semi_implicit:
        return mass._replace(state=_semi_implicit(motion, gains, mass, force))
    transition: Transition = mass.pace
    return mass._replace(state=_within(motion, advance(transition, mass.state, force)))


def dead(force: Array, deadband: float) -> Array:
    """Return a force (3, ...), zero where its norm is below the deadband."""
    return jnp.where(norm(force) < deadband, 0.0, force)


def bounded(vector: Array, largest: float) -> Array:
    """Return a vector (3, ...), shortened to the largest norm."""
    length = norm(vector)
    return vector * jnp.where(length > largest, largest / jnp.where(length > largest, length, 1.0), 1.0)


def inward(rate: Array, displacement: Array, largest: float) -> Array:
    """Return a rate (3, ...) without its outward part where the displacement is at its largest norm or beyond."""
    length = norm(displacement)
    beyond = length >= largest
    direction = displacement / jnp.where(beyond, length, 1.0)
    return rate - jnp.where(beyond, jnp.maximum(dot(rate, direction), 0.0), 0.0) * direction


def _semi_implicit(motion: Motion, gains: Impedance, mass: Mass, force: Array) -> VirtualState:
    period = jnp.minimum(mass.pace, LONGEST_PERIOD)
    count = jnp.ceil(period / SUBSTEP - 1e-6)
    h = period / count
    state = mass.state
    for number in range(round(LONGEST_PERIOD / SUBSTEP)):
        x, v = state
        v = v + h * (force - gains.damping * v - gains.stiffness * x) / gains.inertia
        v = _in_threes(v, motion.max_velocity, bounded)
        moved = _within(motion, VirtualState(x + h * v, v))
        going = number < count
        state = VirtualState(*(jnp.where(going, new, old) for new, old in zip(moved, state, strict=True)))
    return state


def _within(motion: Motion, state: VirtualState) -> VirtualState:
    """Return the state within the bounds of rate and displacement."""
    x, v = state.displacement, _in_threes(state.rate, motion.max_velocity, bounded)
    parts = [slice(start, start + 3) for start in range(0, x.shape[0], 3)]
    limits = motion.max_offset[: len(parts)]
    if not all(map(math.isinf, limits)):
        v = jnp.concatenate([inward(v[part], x[part], limit) for part, limit in zip(parts, limits, strict=True)])
    return VirtualState(_in_threes(x, motion.max_offset, bounded), v)


def _in_threes(vector: Array, limits: Pair, change: Callable[[Array, float], Array]) -> Array:
    """Return a vector (3 or 6, ...) with its three-vectors changed, the very same where no limit asks for it."""
    used = limits[: vector.shape[0] // 3]
    if all(limit in (0.0, math.inf) for limit in used):
        return vector
    return jnp.concatenate([change(vector[3 * i : 3 * i + 3], limit) for i, limit in enumerate(used)])
