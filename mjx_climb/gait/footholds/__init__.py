"""Choice of footholds: which of the points that can be held a limb swings to next."""

from mjx_climb.gait.footholds.best_margin import BestMargin
from mjx_climb.gait.footholds.climblab import ClimbLab
from mjx_climb.gait.footholds.farthest import Farthest
from mjx_climb.gait.footholds.footholds import Footholds
from mjx_climb.gait.footholds.least_use import LeastUse
from mjx_climb.gait.footholds.nearest import Nearest

# by the names that `gait.footholds` takes beside `planned`
SHIPPED: dict[str, type[Footholds]] = {
    "nearest": Nearest,
    "farthest": Farthest,
    "climblab": ClimbLab,
    "best_margin": BestMargin,
    "least_use": LeastUse,
}
