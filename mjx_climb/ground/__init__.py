"""Ground that can be held here and not there: graspable points."""

from mjx_climb.ground.holds import Holds

__all__ = ["Holds"]
