"""Ground that can be held here and not there: graspable points."""

from mjx_climb.ground.from_scenario import holds_of
from mjx_climb.ground.holds import Holds, of

__all__ = ["Holds", "holds_of", "of"]
