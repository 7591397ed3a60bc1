"""The seam of the choice of footholds: how much a point is worth to a limb that is about to swing."""

import abc
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.arrays import AnyArray
from mjx_climb.component import Component, option
from mjx_climb.physics.spatial import norm

SAME = 1e-3  # m, points nearer to each other than this are one
AHEAD = 0.2  # m, within which holds ahead of a limb are counted, as in ClimbLab


class Situation(NamedTuple):
    """The situation of a choice; world axes."""

    feet: Array  # (limb, 3) m, where limbs stand, or will stand when their swings are over
    planned: Array  # (limb, 3) m, where the periodic gait has their next footholds
    forward: Array  # (3,) 1, direction of travel
    stands: Array  # (limb,) bool, which limbs hold while the others swing
    center_of_mass: Array  # (3,) m, where the limbs that swing touch down
    weight: Array  # (3,) N, of the robot
    holding_force: Array  # () N, pull that a grip of the scenario bears; 0: it names none
    pull: Array  # (limb, 3) N, that grips bear where the feet are: each the pull times the normal of the hold


class Candidate(NamedTuple):
    """A hold, and where each limb's foot would be on it; world axes."""

    position: Array  # (limb, 3) m
    pull: Array  # () N, along the normal, that a grip on it bears
    normal: Array  # (3,) 1, unit, out of the ground


class Prospects(NamedTuple):
    """The holds before each limb, in numbers."""

    farthest: Array  # (limb,) m, way to the farthest hold that may be chosen; -inf: there is none
    near: Array  # (limb,) number of holds in reach ahead within `AHEAD`
    in_vain: Array  # (limb,) number of those that are worth more than the best one that may be chosen

    @classmethod
    def none(cls, feet: Array) -> "Prospects":
        """Those of feet (limb, 3) without a hold."""
        nothing = jnp.zeros_like(feet[:, 0])
        return cls(nothing - jnp.inf, nothing, nothing)


class Footholds(Component, abc.ABC):
    """Base of the rules: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `parameter` are its values. `score` is written for one robot and one point; the gait calls it for
    each point in turn. Derivatives pass with the choice frozen. Reach is the same for all rules, by options.
    """

    reach_a_stride_on: bool = option(True, "a hold must be in reach from the base a stride further on, too")
    reach_by_height: bool = option(
        False, "reach by ClimbLab's table of reach by height; false: by inverse kinematics with 5 % of a limb to spare"
    )
    base_must_follow: bool = option(
        False,
        "no step that leaves a foot out of reach of the base in its new place; false: the base goes as far as it can",
    )

    @abc.abstractmethod
    def score(self, situation: Situation, candidate: Candidate) -> Array:
        """How much a point is worth to each limb, (limb,); of several the largest is chosen, -inf is never chosen."""

    def apart(self, situation: Situation, position: Array) -> Array:
        """Whether points (limb, 3) m are far enough from where feet stand, (limb,) bool: those of other limbs."""
        others = ~np.eye(len(position), dtype=bool)
        return jnp.asarray((norm(position[:, None] - situation.feet) > SAME) | ~others).all(1)

    def limb_worth(self, prospects: Prospects) -> Array:
        """How much it is worth that each limb is next, (limb,), where the order is free: of equal ones the first is."""
        return prospects.farthest


def pull_of_grip(of_hold: AnyArray, holding_force: Array) -> Array:
    """Return the pull along the normal that a grip on a hold bears, N: that of the weaker; 0 where neither names one.

    Arguments:
        of_hold: N, that holds bear, of any shape; infinite where they name none.
        holding_force: () N, that grips bear; 0: they name none.
    """
    weaker = jnp.minimum(of_hold, jnp.where(holding_force > 0, holding_force, jnp.inf))
    return jnp.where(jnp.isfinite(weaker), weaker, 0.0)


def level(vector: AnyArray) -> Array:
    """Return vectors (..., 3) without their part along z, which is the ground's normal."""
    return jnp.concatenate([vector[..., :2], jnp.zeros_like(vector[..., 2:])], axis=-1)


def frozen(score: Array) -> Array:
    """Return a score that derivatives take as it is."""
    return jax.lax.stop_gradient(score)
