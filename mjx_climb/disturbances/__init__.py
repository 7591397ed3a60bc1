"""Disturbances: wrenches and masses from outside."""

from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.disturbances.link_wrench import LinkWrench

# by the names that --disturbance and `own.disturbances.0.name` take
SHIPPED: dict[str, type[Disturbance]] = {"LinkWrench": LinkWrench}
