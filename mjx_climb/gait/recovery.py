"""Recovery: a limb in the air comes down early, and the base gives way.

The gait looks at the robot every planning period. Where the base is too far from its reference, a grip is near its
limit, or the margin is small, the gait's own time stands still for a while, limbs in the air come down on the point
that lets the feet bear best the force which stops the robot, and the base reference moves to where the base is, or so
far towards it. From there it returns to the planned path as the gait goes on.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import Component
from mjx_climb.control import Law, Reference
from mjx_climb.gait.around import AroundGait
from mjx_climb.gait.footholds.choice import Candidates, best
from mjx_climb.gait.footholds.held import upright
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.gait.gait import Body
from mjx_climb.gait.own_swings import Swings, at_tick, clock_at, with_swings
from mjx_climb.gait.schedule import Schedule
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.physics.margins import gia_margin, support_axes, tumbling_moment
from mjx_climb.physics.spatial import norm
from mjx_climb.scenario import declared


class Recovery(declared.Recovery, Component):
    """Thresholds, any of which interrupts the gait, and how it is interrupted."""


def recovery_of(law: Law, own: Recovery | None) -> Recovery | None:
    """Return a recovery in which values are those of a law's gains that are called `recovery_NAME`."""
    values = {name: getattr(law, gain) for name in Recovery.VALUES if (gain := f"recovery_{name}") in law.GAINS}
    return dataclasses.replace(own or Recovery(), **values) if values else own


class Danger(NamedTuple):
    """The quantities of the thresholds."""

    shift: Array  # () m, of the base from its reference
    utilization: Array  # () 1, largest predicted share of a grip's limit
    margin: Array  # () m/s^2, GIA margin


def danger(recovery: Recovery, body: Body, force_rate: Array, shift: Array) -> Danger:
    """Return how near the robot is to losing its grips.

    Arguments:
        force_rate: (limb, 3) N/s, of the forces of the ground on the feet.
        shift: (3,) m, of the base from its reference.
    """
    force = body.foot_force + recovery.lead_time * force_rate
    pulled, limited = body.support & ((force * body.normal).sum(1) < 0), body.holding_force > 0
    used = norm(force) / jnp.where(limited, body.holding_force, 1.0)
    axes = support_axes(body.feet, body.support)
    margin = gia_margin(axes, body.center_of_mass, body.foot_force.sum(0), body.mass, body.pull)
    return Danger(norm(shift), jnp.where(pulled & limited, used, 0.0).max(), margin)


def interrupts(recovery: Recovery, danger: Danger) -> Array:
    """Return whether a threshold is passed, () bool."""
    far, near = danger.shift > recovery.shift, danger.utilization > recovery.utilization
    return far | near | (danger.margin < recovery.margin)


def ways_beside(dtype: jnp.dtype) -> Array:
    """Return ways (17, 3) from a place to itself and to level ones around it, of length 1 at most."""
    angles = np.pi / 4 * np.arange(8)
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return jnp.asarray(np.concatenate([np.zeros((1, 3)), 0.5 * ring, ring]), dtype)


def stopping_margin(recovery: Recovery, body: Body, landing: Array, position: Array) -> Array:
    """Return the smallest moment that tumbles a robot whose feet stop it, with some limbs landed at points, () N m.

    The force that stops the base in the landing time acts at the centre of mass.

    Arguments:
        landing: (limb,) bool, which limbs land.
        position: (limb, 3) m, where.
    """
    feet, support = jnp.where(landing[:, None], position, body.feet), body.support | landing
    time = jnp.maximum(recovery.landing_time, 1e-3)
    force = -body.weight - body.mass * body.velocity / time
    middle = body.center_of_mass + body.velocity * time / 2
    return tumbling_moment(support_axes(feet, support), (force, jnp.cross(middle, force)), body.pull)


class Interruptions(NamedTuple):
    """What a gait that is interrupted remembers; times in steps."""

    resumes: Array  # () step at which the gait's own time goes on
    offset: Array  # (3,) m, of the base reference from its path
    offset_since: Array  # () the gait's time since which it shrinks
    force: Array  # (limb, 3) N, on the feet at the last tick
    number: Array  # () of interruptions


class RecoveringGait(AroundGait):
    """A gait that is interrupted where the robot is in danger."""

    recovery: Recovery = dataclasses.field(metadata={"tree": True})

    def init(self) -> tuple[Swings, Reference]:
        """The memory of a robot that has not been interrupted."""
        swings, reference = super().init()
        zero, nowhere = jnp.zeros_like(swings.clock), jnp.zeros_like(reference.base_position)
        none = Interruptions(zero, nowhere, zero, jnp.zeros_like(swings.goal), zero)
        return swings._replace(interruptions=none), reference

    def reference(
        self, memory: Swings, now: Schedule, step: Array, base_position: Array, grip_point: Array
    ) -> tuple[Swings, Reference]:
        """The memory after a step, and the reference at it, off its path after an interruption."""
        memory, found = super().reference(memory, now, step, base_position, grip_point)
        return memory, found._replace(base_position=found.base_position + self._offset(memory, step))

    def _offset(self, memory: Swings, step: Array) -> Array:
        """How far the base reference is from its path, (3,) m."""
        steps, own = jnp.maximum(self.recovery.return_time / self.time_step, 1.0), memory.interruptions
        phase = jnp.clip((clock_at(memory, step) - own.offset_since) / steps, 0.0, 1.0)
        offset: Array = own.offset * (1 - rest_to_rest(phase))
        return offset

    def look_ahead(self, memory: Swings, now: Schedule, step: Array, reference: Reference, body: Body) -> Swings:
        """The memory with an interruption, where a threshold is passed, and with the swings of a gait that goes on."""
        recovery, time_step = self.recovery, self.time_step
        offset, own = self._offset(memory, step), memory.interruptions
        swings = at_tick(memory, step)
        at, rate = swings.step, (body.foot_force - own.force) / (self.period * time_step)
        shift = body.base_position - reference.base_position
        near = danger(recovery, body, rate, shift)
        share = self.share_of_limits(swings, now, body.foot_force + recovery.lead_time * rate)
        if share is not None:
            used = jnp.where(body.support, share, 0.0).max()
            near = near._replace(utilization=jnp.maximum(near.utilization, used))
        stops, stood_still = interrupts(recovery, near) & (at > 0), own.resumes > at
        landing_steps = jnp.ceil(recovery.landing_time / time_step) + 1
        lands = ~now.closed & stops & (swings.span - (at - swings.begun) > landing_steps)
        swings = self._landing(swings, lands, landing_steps, now, reference, body)
        resumes = jnp.where(stops, at + landing_steps + jnp.ceil(recovery.rest_time / time_step), own.resumes)
        swings = swings._replace(running=jnp.where(resumes > at, 0.0, 1.0).astype(swings.clock.dtype))
        interrupted = Interruptions(
            resumes=resumes,
            offset=jnp.where(stops, offset + recovery.take_over * shift, own.offset),
            # an offset begins to shrink when the gait goes on
            offset_since=jnp.where(stops, swings.clock, own.offset_since),
            force=body.foot_force,
            number=own.number + jnp.where(stops & ~stood_still, 1.0, 0.0),
        )
        swings = self.lift_off(swings, now, reference.base_position - offset, body)
        return swings._replace(interruptions=interrupted)

    def _landing(
        self, swings: Swings, lands: Array, steps: Array, now: Schedule, reference: Reference, body: Body
    ) -> Swings:
        """The swings after some limbs (limb,) are sent down in `steps` () to where they stop the robot best."""
        recovery, holds, (ground, _) = self.recovery, self.holds, self.ground(swings, now)
        below = jnp.concatenate([reference.foot_position[:, :2], ground[:, None]], axis=1)

        def score(position: Array, one: Candidates) -> Array:
            grip = one.with_feet(position, body.holding_force)
            pull = grip.pull if one.holds is None else jnp.where(lands[:, None], grip.pull * grip.normal, body.pull)
            worth = stopping_margin(recovery, body._replace(pull=pull), lands, position)
            # of equal ones the nearest
            return worth - 1e-6 * jnp.sum((position - reference.foot_position) ** 2, axis=1)

        def allowed(position: Array) -> Array:
            ahead = body.base_position + recovery.landing_time * body.velocity
            target = (position - ahead) @ body.base_rotation
            return jnp.asarray(within_reach(self.robot, self.geometry, target))

        if holds is None:
            ways = ways_beside(below.dtype) * recovery.reach
            each, otherwise = Candidates(ways, jnp.ones_like(ways[:, 0])), (below, swings.held)
        else:
            each, otherwise = Candidates.of(holds), (swings.goal, swings.held)
        goal, held = jax.lax.cond(
            lands.any(), lambda: best(score, allowed, each, otherwise, body.weight), lambda: otherwise
        )
        left = None if holds is None else upright(below)
        return with_swings(
            swings, lands, start=reference.foot_position, goal=goal, below=ground, begun=swings.step, span=steps,
            rise=0.0, held=held, left=left,
        )  # fmt: skip
