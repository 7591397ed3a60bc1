"""The full time histories of one robot's walk."""

# ruff: noqa: RUF009 (fields carry their units and names)

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mjx_climb.control.sensor_watch import SILENCE
from mjx_climb.parameter_types import Gains, Parameters
from mjx_climb.scenario.model import Scenario


def _history(units: str, long_name: str) -> Any:
    return dataclasses.field(metadata={"about": (units, long_name)})


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """One walk, sampled at every time step; SI units, world axes, limbs in the order of the robot.

    A row holds the state at `time`, and the forces and accelerations that act in the step from there.
    """

    scenario: Scenario  # as it walked
    gains: Gains | Mapping[str, np.ndarray]  # by name, where the law has others than the paper's
    parameters: Parameters  # the scenario's, or what was given in their place
    limbs: tuple[str, ...]  # their names, in order
    time: Float[np.ndarray, " time"]  # s
    base_position: Float[np.ndarray, "time 3"] = _history("m", "position of the base's centre of mass")
    base_orientation: Float[np.ndarray, "time 4"] = _history("1", "orientation of the base, unit quaternion")
    base_linear_velocity: Float[np.ndarray, "time 3"] = _history("m/s", "linear velocity of the base")
    base_angular_velocity: Float[np.ndarray, "time 3"] = _history("rad/s", "angular velocity of the base")
    base_linear_acceleration: Float[np.ndarray, "time 3"] = _history("m/s^2", "linear acceleration of the base")
    base_angular_acceleration: Float[np.ndarray, "time 3"] = _history("rad/s^2", "angular acceleration of the base")
    joint_angles: Float[np.ndarray, "time limb joint"] = _history("rad", "joint angle")
    joint_rates: Float[np.ndarray, "time limb joint"] = _history("rad/s", "joint rate")
    joint_accelerations: Float[np.ndarray, "time limb joint"] = _history("rad/s^2", "joint acceleration")
    joint_targets: Float[np.ndarray, "time limb joint"] = _history("rad", "commanded joint angle")
    joint_torque: Float[np.ndarray, "time limb joint"] = _history("N m", "joint torque")
    foot_position: Float[np.ndarray, "time limb 3"] = _history("m", "position of the foot")
    foot_velocity: Float[np.ndarray, "time limb 3"] = _history("m/s", "velocity of the foot")
    foot_target: Float[np.ndarray, "time limb 3"] = _history("m", "commanded position of the foot")
    foot_force: Float[np.ndarray, "time limb 3"] = _history("N", "force of the ground on the foot")
    foot_moment: Float[np.ndarray, "time limb 3"] = _history("N m", "moment of the ground on the foot")
    grip_point: Float[np.ndarray, "time limb 3"] = _history("m", "point where the foot grips or last gripped")
    support: Bool[np.ndarray, "time limb"] = _history("1", "the gripper is shut and holds")
    contact: Bool[np.ndarray, "time limb"] = _history("1", "the ground acts on the foot")
    detached: Bool[np.ndarray, "time limb"] = _history("1", "the gripper was torn off before")
    torn_off: Bool[np.ndarray, "time limb"] = _history("1", "the gripper is torn off in this step")
    missed: Bool[np.ndarray, "time limb"] = _history("1", "the gripper shuts out of reach in this step")
    reachable: Bool[np.ndarray, "time limb"] = _history("1", "the foot target is within reach")
    sensor_lost: Bool[np.ndarray, "time limb"] = _history("1", "the law does without the foot's force sensor")
    base_reference: Float[np.ndarray, "time 3"] = _history("m", "base position that the gait asks for")
    base_displacement: Float[np.ndarray, "time 6"] = _history(
        "m (x, y, z), rad (rx, ry, rz)", "shift of the base by the control law"
    )  # axes of the reference
    base_wrench: Float[np.ndarray, "time 6"] = _history(
        "N (x, y, z), N m (rx, ry, rz)", "wrench of the foot forces on the base"
    )
    push: Float[np.ndarray, "time 6"] = _history("N (x, y, z), N m (rx, ry, rz)", "wrench on the base from outside")
    cargo_mass: Float[np.ndarray, " time"] = _history("kg", "mass of the cargo")
    center_of_mass: Float[np.ndarray, "time 3"] = _history("m", "centre of mass of robot and cargo")
    tsm: Float[np.ndarray, " time"] = _history("m", "tumble stability margin")
    gia_margin: Float[np.ndarray, " time"] = _history("m/s^2", "gravito-inertial acceleration margin")
    law: str = ""  # name of the control law, where it is not the scenario's

    @property
    def lost_sensors(self) -> dict[str, float]:
        """From when on, s, the law did without the force sensors of some feet, by limb."""
        each = zip(self.limbs, self.sensor_lost.T, strict=True)
        return {limb: max(float(self.time[own.argmax()]) - SILENCE, 0.0) for limb, own in each if own.any()}


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Return scalar metrics with None for what is not defined and the limb by name: what goes into JSON."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result
