"""A law as a walk runs it: what stays the same from step to step is taken out of what it carries."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start

Leaves = list[Any]


class Running(NamedTuple):
    """A law that has begun: what goes from one step to the next, and one step."""

    initial: Leaves
    command: Callable[[Leaves, Measurement, Reference], tuple[Leaves, Command]]


def begin(law: Law, start: Start) -> Running:
    """Return a law, its gains in the layout of the hot path, at the start of a walk.

    The leaves of its state that `step` hands on unchanged are found by tracing it once. They stay as `init` gave them,
    be it plain numbers, and a loop over steps need not carry them. The others get the shape that they have after a
    step.

    Raises:
        ValueError: `step` returns a state of another structure, shape or type than `init`.
    """
    tree: Any
    leaves, tree = jax.tree.flatten(law.init(start))
    example = _measurement_like(start.reference)

    def step(leaves: Leaves, measurement: Measurement, reference: Reference) -> tuple[Leaves, Command]:
        state, command = law.step(jax.tree.unflatten(tree, leaves), measurement, reference)
        after, after_tree = jax.tree.flatten(state)
        if after_tree != tree:
            raise ValueError(f"{_step(law)}: expected a state like that of init, {tree}, got {after_tree}")
        return after, command

    same = _unchanged(step, leaves, example, start.reference)
    places = [place for place, kept in enumerate(same) if not kept]

    def whole(changing: Leaves) -> Leaves:
        every = list(leaves)
        for place, value in zip(places, changing, strict=True):
            every[place] = value
        return every

    def command(changing: Leaves, measurement: Measurement, reference: Reference) -> tuple[Leaves, Command]:
        after, command = step(whole(changing), measurement, reference)
        return [after[place] for place in places], command

    initial = _grown(law, command, [leaves[place] for place in places], example, start.reference)
    return Running(initial, command)


def _step(law: Law) -> str:
    return f"{type(law).__name__}.step"


def _unchanged(step: Callable[..., Any], leaves: Leaves, measurement: Measurement, reference: Reference) -> list[bool]:
    """Tell which leaves of a state a step hands on as they are."""
    program = jax.make_jaxpr(step)(leaves, measurement, reference).jaxpr
    return [program.outvars[place] is program.invars[place] for place in range(len(leaves))]


def _grown(
    law: Law, command: Callable[..., Any], changing: Leaves, measurement: Measurement, reference: Reference
) -> Leaves:
    """Return what changes from step to step in the shapes that a step gives it."""
    while True:
        after = jax.eval_shape(command, changing, measurement, reference)[0]
        try:
            shapes = [jnp.broadcast_shapes(jnp.shape(old), new.shape) for old, new in zip(changing, after, strict=True)]
        except ValueError:
            found = [(jnp.shape(old), new.shape) for old, new in zip(changing, after, strict=True)]
            raise ValueError(f"{_step(law)}: expected a state of the shapes of init, got {found}") from None
        if shapes == [jnp.shape(old) for old in changing]:
            return [jnp.asarray(old, new.dtype) for old, new in zip(changing, after, strict=True)]
        changing = [
            jnp.broadcast_to(jnp.asarray(old, new.dtype), shape)
            for old, new, shape in zip(changing, after, shapes, strict=True)
        ]


def _measurement_like(reference: Reference) -> Measurement:
    """Return a measurement of the shapes that a walk's have."""
    position, feet = reference.base_position, reference.foot_position

    def zeros(*shape: int) -> Array:
        return jnp.zeros((*shape, position.shape[-1]), position.dtype)

    return Measurement(
        position, reference.base_orientation, zeros(3), zeros(3), jnp.zeros_like(feet), zeros(6), feet[0] == feet[0]
    )
