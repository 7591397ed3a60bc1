"""Processes forked from one in which JAX has begun: its threads are not there, and it would wait for them for ever."""

import os
import sys

_too_late = False


def _after_fork() -> None:
    global _too_late
    bridge = sys.modules.get("jax._src.xla_bridge")  # not public; jax is pinned to one minor version
    _too_late = bridge is not None and bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def check_process() -> None:
    """Refuse to compute in such a process.

    Raises:
        RuntimeError: in one line, what to do.
    """
    if _too_late:
        raise RuntimeError(
            "this process was forked from one in which JAX had begun, and JAX would hang here: start it by "
            "multiprocessing.get_context('spawn') or 'forkserver'"
        )
