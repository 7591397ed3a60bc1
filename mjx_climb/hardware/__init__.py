"""The hardware between control law and joints: sensors, control period, bus and servos."""

from mjx_climb.hardware.actuator import Actuator
from mjx_climb.hardware.servo import Servos
from mjx_climb.hardware.velocity_commanded import VelocityCommanded

# by the names that --drive and `hardware.servo.kind` take
KINDS: dict[str, type[Actuator]] = {"servo": Servos, "velocity": VelocityCommanded}
