"""The hardware section of a scenario: what real sensors, buses and servos do to the loop. By default nothing."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from mjx_climb.scenario.messages import failure
from mjx_climb.scenario.values import NonNegative, Number, PositiveOrNull, Section, Seed

MAX_DELAY = 500  # time steps: each is a sample of a buffer, which a step reads whole


class ForceSensor(Section):
    """Force sensors of the feet, a sample every time step."""

    delay: NonNegative = Field(default=0.0, description="age of what the law reads, s")
    noise: NonNegative = Field(default=0.0, description="white noise, standard deviation per axis and sample, N")
    bias: Number = Field(default=0.0, description="offset on every axis of every sensor, world axes, N")
    resolution: NonNegative = Field(default=0.0, description="smallest step that the sensor tells, N; 0: any")
    filter: PositiveOrNull = Field(default=None, description="first-order low pass, cut-off, Hz; null: none")
    filtered_by: Literal["sensor", "law"] = Field(
        default="sensor",
        description="forces of each foot every time step, or the law's own samples of them and of the wrench",
    )


class BaseEstimate(Section):
    """Pose and rates of the base as the law knows them: what measured_pose reads."""

    delay: NonNegative = Field(default=0.0, description="age of pose and rates, s")
    position_noise: NonNegative = Field(default=0.0, description="white noise, standard deviation per axis, m")
    velocity_noise: NonNegative = Field(default=0.0, description="white noise, standard deviation per axis, m/s")


class Servo(Section):
    """The joints' motors and gears, all alike."""

    torque_limit: PositiveOrNull = Field(default=None, description="torque at standstill, N m; null: any")
    no_load_speed: PositiveOrNull = Field(
        default=None, description="speed at which no torque is left, rad/s; null: the torque limit holds at any speed"
    )
    armature: NonNegative = Field(default=0.0, description="inertia of motor and gears seen at the joint, kg m^2")
    coulomb_friction: NonNegative = Field(default=0.0, description="dry friction, N m")
    viscous_friction: NonNegative = Field(default=0.0, description="friction that grows with the rate, N m s/rad")
    load_friction: NonNegative = Field(default=0.0, description="dry friction as a share of the motor's torque, 1")
    backlash: NonNegative = Field(default=0.0, description="play of the gears from end to end, rad")
    delay: NonNegative = Field(default=0.0, description="from the joint loop to the motor's torque, s")

    @model_validator(mode="after")
    def _line_has_two_ends(self) -> Servo:
        if self.no_load_speed is not None and self.torque_limit is None:
            raise failure("a number beside no_load_speed", key="torque_limit", got=None)
        return self


class Hardware(Section):
    """What stands between the control law and the joints; all zero or null: nothing."""

    control_period: NonNegative = Field(
        default=0.0, description="period of law and joint targets, s; a whole number of time steps; 0: the time step"
    )
    command_delay: NonNegative = Field(default=0.0, description="from the law to the joints, s")
    interpolation: Literal["hold", "linear"] = Field(
        default="hold", description="joint targets between two periods: held, or on a line to the next"
    )
    force_sensor: ForceSensor = Field(default=ForceSensor(), description="force sensors of the feet")
    base_estimate: BaseEstimate = Field(default=BaseEstimate(), description="what the law knows of the base")
    servo: Servo = Field(default=Servo(), description="motors and gears")
    seed: Seed = Field(default=0, description="of all noise; equal seeds, equal noise")
