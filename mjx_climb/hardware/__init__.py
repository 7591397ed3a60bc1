"""What stands between a control law and the joints of a real robot: sensors, control period, bus and servos."""

from mjx_climb.hardware.actuator import Actuator
from mjx_climb.hardware.velocity_commanded import VelocityCommanded

# by the names that --drive and `own.drive.name` take
SHIPPED: dict[str, type[Actuator]] = {"VelocityCommanded": VelocityCommanded}
