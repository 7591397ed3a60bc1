"""The full time histories of one robot's walk."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mjx_climb.quantities.parameters import Gains, Parameters
from mjx_climb.scenario.model import Scenario


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
    base_position: Float[np.ndarray, "time 3"]  # m, of the base's centre of mass
    base_orientation: Float[np.ndarray, "time 4"]  # wxyz
    base_linear_velocity: Float[np.ndarray, "time 3"]  # m/s
    base_angular_velocity: Float[np.ndarray, "time 3"]  # rad/s
    base_linear_acceleration: Float[np.ndarray, "time 3"]  # m/s^2
    base_angular_acceleration: Float[np.ndarray, "time 3"]  # rad/s^2
    joint_angles: Float[np.ndarray, "time limb joint"]  # rad
    joint_rates: Float[np.ndarray, "time limb joint"]  # rad/s
    joint_accelerations: Float[np.ndarray, "time limb joint"]  # rad/s^2
    joint_targets: Float[np.ndarray, "time limb joint"]  # rad
    joint_torque: Float[np.ndarray, "time limb joint"]  # N m
    foot_position: Float[np.ndarray, "time limb 3"]  # m
    foot_velocity: Float[np.ndarray, "time limb 3"]  # m/s
    foot_target: Float[np.ndarray, "time limb 3"]  # m
    foot_force: Float[np.ndarray, "time limb 3"]  # N, of the ground on the foot
    foot_moment: Float[np.ndarray, "time limb 3"]  # N m, of the ground on the foot
    grip_point: Float[np.ndarray, "time limb 3"]  # m
    support: Bool[np.ndarray, "time limb"]  # the gripper is shut and holds
    contact: Bool[np.ndarray, "time limb"]  # the ground acts on the foot
    detached: Bool[np.ndarray, "time limb"]  # the gripper was torn off before
    torn_off: Bool[np.ndarray, "time limb"]  # it is torn off in this step
    missed: Bool[np.ndarray, "time limb"]  # it shuts out of reach in this step
    reachable: Bool[np.ndarray, "time limb"]  # the foot target was within reach
    base_reference: Float[np.ndarray, "time 3"]  # m, where the gait wants the base
    base_displacement: Float[np.ndarray, "time 6"]  # m, rad: shift by the control law, axes of the reference
    base_wrench: Float[np.ndarray, "time 6"]  # N, N m: `J_b^T F_e`
    push: Float[np.ndarray, "time 6"]  # N, N m, on the base from outside
    cargo_mass: Float[np.ndarray, " time"]  # kg
    center_of_mass: Float[np.ndarray, "time 3"]  # m, robot and cargo
    tsm: Float[np.ndarray, " time"]  # m
    gia_margin: Float[np.ndarray, " time"]  # m/s^2
    law: str = ""  # name of the control law, where it is not the scenario's


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Return scalar metrics with None for what is not defined and the limb by name: what goes into JSON."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result
