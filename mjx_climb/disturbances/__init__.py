"""Disturbances: wrenches and masses from outside."""

from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.disturbances.link_wrench import LinkWrench as LinkWrench
from mjx_climb.disturbances.on_base import Cargo as Cargo
from mjx_climb.disturbances.on_base import Push as Push

# by the names that --disturbance and the kinds of `disturbance.others` take
KINDS: dict[str, type[Disturbance]] = {"link_wrench": LinkWrench}
