"""The full time histories of one robot's walk."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_climb.control.sensor_watch import SILENCE
from mjx_climb.parameter_types import Gains, Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.sample import Quantities


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory(Quantities[np.ndarray]):
    """One walk: all quantities of its time steps, with time as their first axis."""

    scenario: Scenario  # as it walked
    gains: Gains | Mapping[str, np.ndarray]  # by name, where the law has others than the paper's
    parameters: Parameters  # the scenario's, or those given in their place
    limbs: tuple[str, ...]  # their names, in order
    law: str = ""  # name of the control law, where it is not the scenario's

    @property
    def robot(self) -> Robot:
        """The constants of the scenario's robot."""
        return load_robot(self.scenario.robot)

    @property
    def lost_sensors(self) -> dict[str, float]:
        """From when on, s, the law did without the force sensors of some feet, by limb."""
        each = zip(self.limbs, self.sensor_lost.T, strict=True)
        return {limb: max(float(self.time[own.argmax()]) - SILENCE, 0.0) for limb, own in each if own.any()}

    @property
    def falls_at(self) -> float | None:
        """From when on, s, no grip holds until the walk's end; None where some grip holds then."""
        held = np.flatnonzero(self.support.any(1))
        first = held[-1] + 1 if held.size else 0
        return float(self.time[first]) if first < len(self.time) else None

    @property
    def gap(self) -> float:
        """The largest distance off the ground, m, at which a gripper shuts, up to the first that misses it."""
        before = np.cumsum(self.missed.any(1)) - self.missed.any(1) < 1
        return float(np.nanmax(self.grip_gap[before]))

    @property
    def standing(self) -> dict[str, float]:
        """From when on, s, the robot stands at the walk's end, as some feet found no grip, by limb."""
        until_the_end = np.logical_and.accumulate(self.stands[::-1])[::-1]
        each = zip(self.limbs, until_the_end.T, strict=True)
        return {limb: float(self.time[own.argmax()]) for limb, own in each if own.any()}


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Scalar metrics for JSON: None if undefined, and the limb by name."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result
