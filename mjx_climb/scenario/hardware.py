"""The hardware section of a scenario: what real sensors, buses and servos do to the loop. By default nothing."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from mjx_climb.scenario.messages import failure
from mjx_climb.scenario.values import NonNegative, Number, PositiveOrNull, Section, Seed, setting

MAX_DELAY = 500  # time steps: each is a sample of a buffer, which a step reads whole


class ForceSensor(Section):
    """Force sensors of the feet, a sample every time step."""

    delay: NonNegative = setting(0.0, "age of what the law reads, s")
    noise: NonNegative = setting(0.0, "white noise, standard deviation per axis and sample, N")
    bias: Number = setting(0.0, "offset on every axis of every sensor, world axes, N")
    resolution: NonNegative = setting(0.0, "smallest step that the sensor tells, N; 0: any")
    filter: PositiveOrNull = setting(None, "first-order low pass, cut-off, Hz; null: none")
    filtered_by: Literal["sensor", "law"] = setting(
        "sensor", "forces of each foot every time step, or the law's own samples of them and of the wrench"
    )


class BaseEstimate(Section):
    """Pose and rates of the base as the law knows them: what measured_pose reads."""

    delay: NonNegative = setting(0.0, "age of pose and rates, s")
    position_noise: NonNegative = setting(0.0, "white noise, standard deviation per axis, m")
    velocity_noise: NonNegative = setting(0.0, "white noise, standard deviation per axis, m/s")


class Servo(Section):
    """The joints' motors and gears, all alike."""

    torque_limit: PositiveOrNull = setting(None, "torque at standstill, N m; null: any")
    no_load_speed: PositiveOrNull = setting(
        None, "speed at which no torque is left, rad/s; null: the torque limit holds at any speed"
    )
    armature: NonNegative = setting(0.0, "inertia of motor and gears seen at the joint, kg m^2")
    coulomb_friction: NonNegative = setting(0.0, "dry friction, N m")
    viscous_friction: NonNegative = setting(0.0, "friction that grows with the rate, N m s/rad")
    load_friction: NonNegative = setting(0.0, "dry friction as a share of the motor's torque, 1")
    backlash: NonNegative = setting(0.0, "play of the gears from end to end, rad")
    delay: NonNegative = setting(0.0, "from the joint loop to the motor's torque, s")

    @model_validator(mode="after")
    def _line_has_two_ends(self) -> Servo:
        if self.no_load_speed is not None and self.torque_limit is None:
            raise failure("a number beside no_load_speed", key="torque_limit", got=None)
        return self


class Hardware(Section):
    """What stands between the control law and the joints; all zero or null: nothing."""

    control_period: NonNegative = setting(
        0.0, "period of law and joint targets, s; a whole number of time steps; 0: the time step"
    )
    command_delay: NonNegative = setting(0.0, "from the law to the joints, s")
    interpolation: Literal["hold", "linear"] = setting(
        "hold", "joint targets between two periods: held, or on a line to the next"
    )
    force_sensor: ForceSensor = setting(ForceSensor(), "force sensors of the feet")
    base_estimate: BaseEstimate = setting(BaseEstimate(), "what the law knows of the base")
    servo: Servo = setting(Servo(), "motors and gears")
    seed: Seed = setting(0, "of all noise; equal seeds, equal noise")
