"""How a function of one robot is carried out for a batch: all that leans on the insides of JAX and XLA.

What the rest of the program uses is named here; docs/execution.md explains the whole.
"""

from mjx_climb.execution.forked import check_process as check_process
from mjx_climb.lazy import lazy_names

TYPE_CHECKING = False
if TYPE_CHECKING:
    from mjx_climb.execution.batches import run as run
    from mjx_climb.execution.batches import run_one as run_one
    from mjx_climb.execution.batches import walking_with as walking_with
    from mjx_climb.execution.limbs import of_limbs as of_limbs
    from mjx_climb.execution.one_robot import over_robots as over_robots
    from mjx_climb.execution.paths import many_at_once as many_at_once
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
