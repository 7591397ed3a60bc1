"""Answers of contacts, actuators and disturbances in a step, checked as a walk is traced: a user may write them."""

from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.component import Component
from mjx_climb.control.law import called, in_words
from mjx_climb.disturbances.disturbance import Body, Disturbance, External
from mjx_climb.hardware.actuator import Actuator, ActuatorGains, Drive, Joints
from mjx_climb.physics.contact.contact import Contact, Grip
from mjx_climb.physics.kinematics import Feet, Turning
from mjx_climb.scenario.messages import ConfigError

_Answer = TypeVar("_Answer")
_OF_FEET = ("foot_force", "foot_moment", "grip_point")  # (limb, 3), the others (limb,)
_REAL = (*_OF_FEET, "utilization", "motor_torque", "joint_torque", "base_wrench", "cargo_mass")  # the others are bool


def gripped(
    contact: Contact, memory: PyTree, feet: Feet, turning: Turning | None, closed: Array, ground: Array
) -> tuple[PyTree, Grip]:
    """A contact's memory after a step, and its grips in it.

    Raises:
        ConfigError: in one line, `step` takes other arguments, or returns something else.
    """
    shapes = {name: (len(closed), 3) if name in _OF_FEET else (len(closed),) for name in Grip._fields}
    return _stepped(contact, Grip, shapes, memory, feet, turning, closed, ground)


def driven(
    actuator: Actuator, memory: PyTree, targets: Array, gains: ActuatorGains, joints: Joints, period: float
) -> tuple[PyTree, Drive]:
    """An actuator's memory after a step, and its torques in it; errors as of `gripped`."""
    shapes = {"motor_torque": targets.shape, "joint_torque": targets.shape}
    return _stepped(actuator, Drive, shapes, memory, targets, gains, joints, period)


def disturbed(disturbance: Disturbance, time: Array, body: Body) -> External:
    """The loads of a disturbance in a step; errors as of `gripped`."""
    found = called(disturbance, "act", time, body)
    shapes = {"base_wrench": (6,), "joint_torque": body.state.joint_angles.shape, "cargo_mass": ()}
    return _of_kind(f"{type(disturbance).__name__}.act", found, External, shapes)


def _stepped(
    component: Component, kind: type[_Answer], shapes: Mapping[str, tuple[int, ...]], memory: PyTree, *inputs: Any
) -> tuple[PyTree, _Answer]:
    found, place = called(component, "step", memory, *inputs), f"{type(component).__name__}.step"
    if not (isinstance(found, tuple) and len(found) == 2):
        raise ConfigError(place, "", f"a pair of memory and {kind.__name__}", in_words(found))
    after, answer = found
    kept: object = jax.tree.structure(memory)
    if kept != jax.tree.structure(after) or not all(map(_alike, *map(jax.tree.leaves, (memory, after)))):
        raise ConfigError(place, "", f"a memory like that before, {in_words(memory)}", in_words(after))
    return after, _of_kind(place, answer, kind, shapes)


def _alike(before: Any, after: Any) -> bool:
    """Return whether two leaves have one shape and type; a number of Python has that of its walk."""
    old, new = jnp.asarray(before), jnp.asarray(after)
    return old.shape == new.shape and (old.weak_type or old.dtype == new.dtype)


def _of_kind(place: str, answer: Any, kind: type[_Answer], shapes: Mapping[str, tuple[int, ...]]) -> _Answer:
    if not isinstance(answer, kind):
        raise ConfigError(place, "", f"an object {kind.__name__}", in_words(answer))
    for name, shape in shapes.items():
        if (value := getattr(answer, name)) is None:
            continue
        array, kind_of = jnp.asarray(value), jnp.floating if name in _REAL else jnp.bool_
        if array.shape != shape or not (array.weak_type or jnp.issubdtype(array.dtype, kind_of)):
            got = f"{array.dtype}{list(array.shape)}"
            raise ConfigError(place, name, f"{'real' if name in _REAL else 'bool'}{list(shape)}", got)
    return answer
