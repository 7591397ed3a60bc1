"""How a function of one robot is carried out for a batch: all that leans on the insides of JAX and XLA.

The rest of the program uses these names; docs/explanation/execution.md explains the whole.
"""

import contextlib
import os
import sys

from mjx_climb.lazy import lazy_names

TYPE_CHECKING = False
if TYPE_CHECKING:
    from mjx_climb.execution.batches import Robots as Robots
    from mjx_climb.execution.batches import run as run
    from mjx_climb.execution.batches import run_one as run_one
    from mjx_climb.execution.batches import shapes_of as shapes_of
    from mjx_climb.execution.batches import walking_with as walking_with
    from mjx_climb.execution.flat import reached as reached
    from mjx_climb.execution.limbs import of_limbs as of_limbs
    from mjx_climb.execution.one_robot import gradients_over_robots as gradients_over_robots
    from mjx_climb.execution.one_robot import over_robots as over_robots
    from mjx_climb.execution.paths import many_at_once as many_at_once
else:  # each is imported, and JAX with it, when it is first asked for
    __getattr__, __dir__, __all__ = lazy_names(__name__)

# Processes forked from one in which JAX has begun: its threads are not there, and it would wait for them for ever.
_too_late = False


def _after_fork() -> None:
    global _too_late
    if "jax" in sys.modules:
        from mjx_climb.execution.jax_internals import devices_have_begun

        _too_late = devices_have_begun()


with contextlib.suppress(AttributeError):  # a system that does not fork
    os.register_at_fork(after_in_child=_after_fork)


def check_process() -> None:
    """Refuse to compute in a process that was forked from one in which JAX had begun.

    Raises:
        RuntimeError: one line with the remedy.
    """
    if _too_late:
        raise RuntimeError(
            "this process was forked from one in which JAX had begun, and JAX would hang here: start it by "
            "multiprocessing.get_context('spawn') or 'forkserver'"
        )
