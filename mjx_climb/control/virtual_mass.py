"""The virtual mass, damper and spring of Eqs. 2 and 3, `M xdd + D xd + K x = f`, one period at a time.

It is integrated exactly under a force that is held over the period, or as the paper's first author does it on a robot.
His C++ library `admittance_control` (2026, Apache-2.0) works on three-vectors, of force and of moment: an input whose
norm is below a deadband counts as zero; semi-implicit Euler in substeps of at most 2 ms, of a period cut to 20 ms;
rate and displacement bounded in norm, and at the bound of the displacement no rate outwards.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.physics.spatial import norm

# of the library `admittance_control`, see above
SUBSTEP = 2e-3  # s, at most
LONGEST_PERIOD = 20e-3  # s
# the error of the second-order step falls by four with each: by 2^-48 = 4e-15, near the rounding of double precision
_DOUBLINGS = 24
Pair = tuple[float, float]  # of translations, of rotations


class Impedance(Protocol):
    """Gains of a virtual mass, damper and spring, of any shape that broadcasts with the displacement."""

    @property
    def inertia(self) -> Array: ...  # kg, kg m^2
    @property
    def damping(self) -> Array: ...  # N s/m, N m s/rad
    @property
    def stiffness(self) -> Array: ...  # N/m, N m/rad


class Motion(NamedTuple):
    """How a virtual mass moves: static, a walk is compiled for it."""

    semi_implicit: bool = False
    deadband: Pair = (0.0, 0.0)  # N, N m
    max_offset: Pair = (math.inf, math.inf)  # m, rad
    max_velocity: Pair = (math.inf, math.inf)  # m/s, rad/s


EXACT = Motion()


class Transition(NamedTuple):
    """One period of the exact motion, as increments: `x += xx x + xv v + xf f`, `v += vx x + vv v + vf f`."""

    xx: Array
    xv: Array
    vx: Array
    vv: Array
    xf: Array
    vf: Array


class EulerSteps(NamedTuple):
    """Constants of a virtual mass for semi-implicit Euler."""

    inertia: Array
    damping: Array
    stiffness: Array
    period: Array  # () s


class VirtualMass(NamedTuple):
    """State of a virtual mass, and its constants."""

    displacement: Array  # (..., 3) or (6,) m, rad
    rate: Array  # the same, per second
    by: Transition | EulerSteps


def at_rest(gains: Impedance, period: float | Array, like: Array, motion: Motion = EXACT) -> VirtualMass:
    """Return a virtual mass at rest, for steps of `period` s; its displacement has the shape of `like`."""
    zero = jnp.zeros_like(like)
    if motion.semi_implicit:
        return VirtualMass(zero, zero, EulerSteps(gains.inertia, gains.damping, gains.stiffness, jnp.asarray(period)))
    return VirtualMass(zero, zero, discretize(gains, period))


def advance(mass: VirtualMass, force: Array, motion: Motion = EXACT) -> VirtualMass:
    """Return the virtual mass one period later, under `force` in N, N m, of the displacement's shape."""
    force = _each_vector(dead, motion.deadband, force)
    if isinstance(mass.by, EulerSteps):
        return _semi_implicit(mass, mass.by, force, motion)
    t, x, v = mass.by, mass.displacement, mass.rate
    return _bounded(x + t.xx * x + t.xv * v + t.xf * force, v + t.vx * x + t.vv * v + t.vf * force, mass, motion)


def discretize(gains: Impedance, period: float | Array) -> Transition:
    """Return the zero-order hold of `M xdd + D xd + K x = f` for one period in s, stable for any positive gains.

    The matrix exponential is found by doubling a second-order L-stable step of `period / 2**24`. The closed form with
    sqrt(D^2 - 4 K M) is no alternative: it has no derivative at critical damping and cancels in float32. Working with
    the increments (exponential minus identity) keeps the slow motion of a stiff damper to full precision.
    """
    h = period / 2**_DOUBLINGS
    mobility = 1 / gains.inertia
    damping, stiffness = gains.damping * mobility, gains.stiffness * mobility
    # A h and A h A h / 2 of A = [[0, 1], [-stiffness, -damping]], then (I - A h + (A h)^2 / 2)^-1 (A h - (A h)^2 / 2)
    bxx, bxv = stiffness * h * h / 2, h + damping * h * h / 2
    bvx, bvv = -stiffness * bxv, -damping * h - (damping**2 - stiffness) * h * h / 2
    determinant = (1 - bxx) * (1 - bvv) - bxv * bvx
    first = Transition(
        xx=((1 - bvv) * bxx + bxv * bvx) / determinant,
        xv=bxv / determinant,
        vx=bvx / determinant,
        vv=((1 - bxx) * bvv + bxv * bvx) / determinant,
        # the force enters like a spring's: xf = -xx / K, vf = -vx / K, written without the quotient
        xf=h * h / 2 * (1 + damping * h) / determinant * mobility,
        vf=bxv / determinant * mobility,
    )

    def double(_: Array, t: Transition) -> Transition:
        return Transition(
            xx=2 * t.xx + t.xx * t.xx + t.xv * t.vx,
            xv=2 * t.xv + (t.xx + t.vv) * t.xv,
            vx=2 * t.vx + (t.xx + t.vv) * t.vx,
            vv=2 * t.vv + t.vv * t.vv + t.xv * t.vx,
            xf=2 * t.xf + t.xx * t.xf + t.xv * t.vf,
            vf=2 * t.vf + t.vx * t.xf + t.vv * t.vf,
        )

    whole: Transition = jax.lax.fori_loop(0, _DOUBLINGS, double, first)
    return whole


def dead(force: Array, deadband: float) -> Array:
    """Return a force (..., 3), zero where its norm is below the deadband."""
    return jnp.where(norm(force)[..., None] < deadband, 0.0, force)


def bounded(vector: Array, largest: float) -> Array:
    """Return a vector (..., 3), shortened to the largest norm."""
    length = norm(vector)[..., None]
    return vector * jnp.where(length > largest, largest / jnp.where(length > largest, length, 1.0), 1.0)


def inward(rate: Array, displacement: Array, largest: float) -> Array:
    """Return a rate (..., 3) without its outward part where the displacement is at its largest norm or beyond."""
    length = norm(displacement)[..., None]
    beyond = length >= largest
    direction = displacement / jnp.where(beyond, length, 1.0)
    outward = jnp.maximum(jnp.vecdot(rate, direction)[..., None], 0.0)
    return rate - jnp.where(beyond, outward, 0.0) * direction


def _semi_implicit(mass: VirtualMass, by: EulerSteps, force: Array, motion: Motion) -> VirtualMass:
    period = jnp.minimum(by.period, LONGEST_PERIOD)
    # a period of whole substeps has no further one by rounding
    count = jnp.ceil(period / SUBSTEP - 1e-6)
    h = period / count
    for substep in range(round(LONGEST_PERIOD / SUBSTEP)):
        x, v = mass.displacement, mass.rate
        v = v + h * (force - by.damping * v - by.stiffness * x) / by.inertia
        v = _each_vector(bounded, motion.max_velocity, v)
        moved = _bounded(x + h * v, v, mass, motion)
        # every robot computes as many substeps as the longest period has, and stops after its own
        going = substep < count
        x, v = jnp.where(going, moved.displacement, mass.displacement), jnp.where(going, moved.rate, mass.rate)
        mass = mass._replace(displacement=x, rate=v)
    return mass


def _bounded(x: Array, v: Array, mass: VirtualMass, motion: Motion) -> VirtualMass:
    """Return the virtual mass at a displacement and a rate, both within their bounds."""
    v = _each_vector(bounded, motion.max_velocity, v)
    v = _each_vector(inward, motion.max_offset, v, x)
    return mass._replace(displacement=_each_vector(bounded, motion.max_offset, x), rate=v)


def _each_vector(change: Callable[..., Array], limits: Pair, *values: Array) -> Array:
    """Return values (..., 3) or (6,) with each three-vector changed by its limit; any shape where there is no limit."""
    if set(limits) <= {0.0, math.inf}:
        return values[0]
    starts = range(0, values[0].shape[-1], 3)
    return jnp.concatenate([change(*(v[..., i : i + 3] for v in values), limits[i // 3]) for i in starts], axis=-1)
