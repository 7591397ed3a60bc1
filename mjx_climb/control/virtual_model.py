"""A virtual mass, damper and spring, integrated exactly under a force that is held over the step."""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

_DOUBLINGS = 24


class Impedance(Protocol):
    """Gains of a virtual mass, damper and spring, in any shape."""

    @property
    def inertia(self) -> Any: ...  # kg, kg m^2
    @property
    def damping(self) -> Any: ...  # N s/m, N m s/rad
    @property
    def stiffness(self) -> Any: ...  # N/m, N m/rad


class VirtualState(NamedTuple):
    """Displacement and rate of the virtual mass, in any shape: m or rad, and per second."""

    displacement: Array
    rate: Array


class Transition(NamedTuple):
    """One step of the virtual model as increments: `x += xx x + xv v + xf f`, `v += vx x + vv v + vf f`."""

    xx: Array
    xv: Array
    vx: Array
    vv: Array
    xf: Array
    vf: Array


def rest(like: ArrayLike) -> VirtualState:
    """Return the state of a virtual mass at rest, in the shape of `like`."""
    return VirtualState(jnp.zeros_like(like), jnp.zeros_like(like))


def discretize(gains: Impedance, time_step: float | Array) -> Transition:
    """Return the zero-order hold of `M xdd + D xd + K x = f` for one time step, stable for any positive gains.

    The matrix exponential is found by doubling a second-order L-stable step of `time_step / 2**24`. The closed form
    with sqrt(D^2 - 4 K M) is no alternative: it has no derivative at critical damping and cancels in float32. Working
    with the increments (exponential minus identity) keeps the slow motion of a stiff damper to full precision.
    """
    h = time_step / 2**_DOUBLINGS
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


def advance(transition: Transition, state: VirtualState, force: Array) -> VirtualState:
    """Return the virtual mass one step later, under `force` in N or N m."""
    t, x, v = transition, state.displacement, state.rate
    return VirtualState(x + t.xx * x + t.xv * v + t.xf * force, v + t.vx * x + t.vv * v + t.vf * force)
