"""Ground that can be held here and not there: graspable points."""

from mjx_climb.ground.from_scenario import holds_of, holds_of_seeds
from mjx_climb.ground.holds import Holds, of, pull_within

__all__ = ["Holds", "holds_of", "holds_of_seeds", "of", "pull_within"]
