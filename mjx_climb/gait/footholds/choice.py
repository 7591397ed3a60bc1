"""The choice among points: the one of the largest score that a limb may swing to."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.lax import stop_gradient
from jaxtyping import PyTree

from mjx_climb.gait.footholds.footholds import Candidate, pull_of_grip
from mjx_climb.gait.footholds.held import Held, hold_axes, of_some
from mjx_climb.ground import Holds, pull_within
from mjx_climb.physics.kinematics import UP


class Candidates(NamedTuple):
    """Points to choose among, by their number."""

    vector: Array  # (n, 3), the holds, or offsets from the feet
    valid: Array  # (n,) 1: one, 0: padding
    holds: tuple[Array, Array, Array] | None = None  # (n, 3) normals, (n, m, 3) and (n, m) N, limits in their axes

    @classmethod
    def of(cls, holds: Holds) -> "Candidates":
        """The holds of a ground."""
        return cls(holds.position, holds.valid, (holds.normal, holds.limit_matrix, holds.limit_bound))

    def with_feet(self, position: Array, holding_force: Array) -> Candidate:
        """One of them as rules see it, with the limbs' feet at (limb, 3) m, for grips that bear () N; 0: any."""
        if self.holds is None:
            return Candidate(position, holding_force, jnp.array(UP, position.dtype))
        normal, matrix, bound = self.holds
        return Candidate(position, pull_of_grip(pull_within(-matrix[..., 2], bound), holding_force), normal)


def best(
    score: Callable[[Array, Candidates], Array],
    allowed: Callable[[Array], Array],
    candidates: Candidates,
    otherwise: tuple[Array, Held | None],
    weight: Array,
) -> tuple[Array, Held | None]:
    """Return the points of the largest score, (limb, 3) m, of several the first, and the holds there.

    Arguments:
        score: of points (limb, 3) m of a candidate, (limb,).
        allowed: whether points may be chosen, (limb,) bool.
        candidates: holds at points (3,) m, the same for all limbs, or ways (3,) m from the points in `otherwise`.
        otherwise: points and holds where none is allowed.
        weight: (3,) N, for the axes of holds.
    """

    def look(found_so_far: tuple[Array, Array, PyTree], one: Candidates) -> tuple[PyTree, None]:
        worth, place, found_hold = found_so_far
        position = otherwise[0] + one.vector if one.holds is None else jnp.broadcast_to(one.vector, place.shape)
        frozen = stop_gradient(position)
        found = stop_gradient(jnp.where(allowed(frozen) & (one.valid > 0), score(frozen, one), -jnp.inf))
        better = found > worth
        place, found_hold = of_some(better, (position, one.holds), (place, found_hold))
        return (jnp.where(better, found, worth), place, found_hold), None

    place, held = otherwise
    worst, before = jnp.full_like(place[:, 0], -jnp.inf), None
    if candidates.holds is not None:
        before = tuple(jnp.zeros_like(each, shape=(len(place), *each.shape[1:])) for each in candidates.holds)
    (worth, place, hold), _ = jax.lax.scan(look, (worst, place, before), candidates)
    if held is None or hold is None:
        return place, held
    normal, matrix, bound = hold
    axes = jnp.stack([hold_axes(each, weight) for each in normal])
    return place, of_some(worth > -jnp.inf, Held(normal, matrix @ axes.mT, bound), held)
