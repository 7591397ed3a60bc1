"""The quantities of a walk, each declared once, and its value in a step computed once.

Trajectories, files, their units and the API reference follow from `Quantities`. A new quantity is a field there and its
value in `sample_of`.
"""
# ruff: noqa: RUF009 (fields carry their units and names)

import dataclasses
from collections.abc import Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import DTypeLike

from mjx_climb.control import Command, Reference
from mjx_climb.disturbances.disturbance import External
from mjx_climb.hardware.actuator import Drive
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.inverse_kinematics import JointSolution
from mjx_climb.physics.kinematics import UP, LimbFrames, center_of_mass, ground_normal
from mjx_climb.physics.margins import gia_margin, net_external_wrench, support_axes, tumble_stability_margin
from mjx_climb.physics.spatial import norm
from mjx_climb.physics.state import Acceleration
from mjx_climb.robot.constants import Robot
from mjx_climb.shapes import dims_of
from mjx_climb.walk.control_loop import Actual

_Array = TypeVar("_Array")


def quantity(unit: str, long_name: str, *, unknown: tuple[float, ...] | float = np.nan) -> Any:
    """Return the field of a quantity, whose annotation has its shape behind any batch axes.

    `unknown` is its value where nobody knows it, as in files that are older than the quantity.
    """
    return dataclasses.field(metadata={"unit": unit, "long_name": long_name, "unknown": unknown})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quantities(Generic[_Array]):
    """All that is known of a step; SI units, world axes, limbs in the order of the robot.

    The state is that at `time`; forces and accelerations are those that act in the step from there. Sliding joints have
    m and N in place of rad and N m.
    """

    time: Float[_Array, "*batch"] = quantity("s", "time")
    base_position: Float[_Array, "*batch 3"] = quantity("m", "position of the base's centre of mass")
    base_orientation: Float[_Array, "*batch 4"] = quantity("1", "orientation of the base, unit quaternion")
    base_linear_velocity: Float[_Array, "*batch 3"] = quantity("m/s", "linear velocity of the base")
    base_angular_velocity: Float[_Array, "*batch 3"] = quantity("rad/s", "angular velocity of the base")
    base_linear_acceleration: Float[_Array, "*batch 3"] = quantity("m/s^2", "linear acceleration of the base")
    base_angular_acceleration: Float[_Array, "*batch 3"] = quantity("rad/s^2", "angular acceleration of the base")
    joint_angles: Float[_Array, "*batch limb joint"] = quantity("rad", "joint angle")
    joint_rates: Float[_Array, "*batch limb joint"] = quantity("rad/s", "joint rate")
    joint_accelerations: Float[_Array, "*batch limb joint"] = quantity("rad/s^2", "joint acceleration")
    joint_targets: Float[_Array, "*batch limb joint"] = quantity("rad", "commanded joint angle")
    joint_torque: Float[_Array, "*batch limb joint"] = quantity("N m", "joint torque")
    foot_position: Float[_Array, "*batch limb 3"] = quantity("m", "position of the foot")
    foot_velocity: Float[_Array, "*batch limb 3"] = quantity("m/s", "velocity of the foot")
    foot_target: Float[_Array, "*batch limb 3"] = quantity("m", "commanded position of the foot")
    foot_force: Float[_Array, "*batch limb 3"] = quantity("N", "force of the ground on the foot")
    foot_moment: Float[_Array, "*batch limb 3"] = quantity("N m", "moment of the ground on the foot")
    grip_point: Float[_Array, "*batch limb 3"] = quantity("m", "point where the foot grips or last gripped")
    ground_normal: Float[_Array, "*batch limb 3"] = quantity("1", "normal of the ground at the foot", unknown=UP)
    support: Bool[_Array, "*batch limb"] = quantity("1", "the gripper is shut and holds")
    contact: Bool[_Array, "*batch limb"] = quantity("1", "the ground acts on the foot")
    detached: Bool[_Array, "*batch limb"] = quantity("1", "the gripper was torn off before")
    torn_off: Bool[_Array, "*batch limb"] = quantity("1", "the gripper is torn off in this step")
    missed: Bool[_Array, "*batch limb"] = quantity("1", "the gripper shuts out of reach in this step")
    grip_gap: Float[_Array, "*batch limb"] = quantity("m", "distance off the ground at which the gripper shuts, else 0")
    utilization: Float[_Array, "*batch limb"] = quantity("1", "share of its limit that a grip uses")
    reachable: Bool[_Array, "*batch limb"] = quantity("1", "the foot target is within reach")
    sensor_lost: Bool[_Array, "*batch limb"] = quantity("1", "the law does without the foot's force sensor")
    stands: Bool[_Array, "*batch limb"] = quantity("1", "the foot found no grip, and the robot stands")
    base_reference: Float[_Array, "*batch 3"] = quantity("m", "base position that the gait asks for")
    base_displacement: Float[_Array, "*batch 6"] = quantity(
        "m (x, y, z), rad (rx, ry, rz)", "shift of the base by the control law, along the axes of the reference"
    )
    base_wrench: Float[_Array, "*batch 6"] = quantity(
        "N (x, y, z), N m (rx, ry, rz)", "wrench of the foot forces on the base"
    )
    push: Float[_Array, "*batch 6"] = quantity("N (x, y, z), N m (rx, ry, rz)", "wrench on the base from outside")
    cargo_mass: Float[_Array, "*batch"] = quantity("kg", "mass of the cargo")
    center_of_mass: Float[_Array, "*batch 3"] = quantity("m", "centre of mass of robot and cargo")
    tsm: Float[_Array, "*batch"] = quantity("m", "tumble stability margin")
    gia_margin: Float[_Array, "*batch"] = quantity("m/s^2", "gravito-inertial acceleration margin")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Sample(Quantities[Array]):
    """All that is known of one step of one robot; of a batch, with its axes in front."""


DIMS = {field.name: tuple(dims_of(field.type).split()[1:]) for field in dataclasses.fields(Sample)}  # of one step


def unknown(steps: int, sizes: Mapping[str, int], dtype: DTypeLike = float) -> dict[str, np.ndarray]:
    """Return all quantities over time without a value: NaN, of flags False, and the ground's normal up.

    Arguments:
        sizes: how many there are of "limb" and "joint".
    """
    fields = dataclasses.fields(Sample)
    flags = {field.name for field in fields if field.type.dtype is Bool}  # type: ignore[union-attr]
    values = {field.name: field.metadata["unknown"] for field in fields}
    shapes = {name: [sizes.get(dim) or int(dim) for dim in dims] for name, dims in DIMS.items()}
    return {
        name: np.full((steps, *shape), name not in flags and values[name], bool if name in flags else dtype)
        for name, shape in shapes.items()
    }


class Step(NamedTuple):
    """All states, forces and commands of a step."""

    time: Array  # () s
    robot: Robot
    parameters: Parameters
    frames: LimbFrames  # of the links, in the base's axes
    actual: Actual
    reference: Reference
    command: Command
    joints: JointSolution  # targets as the actuators get them
    drive: Drive
    external: External
    acceleration: Acceleration
    sensor_lost: Array  # (limb,) bool
    grip_gap: Array  # (limb,) m
    stands: Array  # (limb,) bool
    holding_force: Array  # () N, the pull that margins may count on; on holds (limb, 3), times their normals


def sample_of(step: Step) -> Sample:
    """Return the value of each quantity in a step."""
    actual, acceleration = step.actual, step.acceleration
    push, cargo = step.external.base_wrench, step.external.cargo_mass
    com = center_of_mass(step.robot, step.frames, actual.state, cargo / step.parameters.mass_scale)
    tsm, gia = _stability_margins(step, com)
    feet = actual.feet
    return Sample(
        time=step.time, **vars(actual.state), **actual.grip._asdict(),
        base_linear_acceleration=acceleration.base_linear, base_angular_acceleration=acceleration.base_angular,
        joint_accelerations=acceleration.joints, joint_torque=step.drive.motor_torque,
        joint_targets=step.joints.joint_angles, reachable=step.joints.reachable,
        foot_position=feet.position, foot_velocity=feet.velocity, foot_target=step.command.foot_position,
        ground_normal=ground_normal(feet),
        sensor_lost=step.sensor_lost, stands=step.stands, grip_gap=step.grip_gap,
        base_reference=step.reference.base_position, base_displacement=step.command.base_displacement,
        base_wrench=actual.wrench, push=push, cargo_mass=cargo, center_of_mass=com, tsm=tsm, gia_margin=gia,
    )  # fmt: skip


def _stability_margins(step: Step, com: Array) -> tuple[Array, Array]:
    """Return TSM, m, and GIA margin, m/s^2."""
    actual, parameters, cargo = step.actual, step.parameters, step.external.cargo_mass
    net_wrench = net_external_wrench(actual.wrench + step.external.base_wrench, actual.state.base_position)
    axes = support_axes(actual.feet.position, actual.grip.support)
    mass, gravity = cargo + parameters.mass_scale * step.robot.total_mass, norm(jnp.asarray(parameters.gravity))
    tsm = tumble_stability_margin(axes, net_wrench, mass, gravity, step.holding_force)
    return tsm, gia_margin(axes, com, net_wrench[0], mass, step.holding_force)
