"""The hardware between control law and joints: sensors, control period, bus and servos."""

from mjx_climb.hardware.actuator import Actuator
from mjx_climb.hardware.velocity_commanded import VelocityCommanded

# by the names that --drive and `own.drive.name` take
SHIPPED: dict[str, type[Actuator]] = {"VelocityCommanded": VelocityCommanded}
