"""Disturbances: wrenches and masses from outside."""

from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.disturbances.link_wrench import LinkWrench as LinkWrench
from mjx_climb.disturbances.on_base import Cargo as Cargo
from mjx_climb.disturbances.on_base import Push as Push

# by the names that --disturbance and `own.disturbances.0.name` take
SHIPPED: dict[str, type[Disturbance]] = {"LinkWrench": LinkWrench}
