"""The search from Python, and what a search method of one's own is made of.

`from tuning.tune import tune`; the module itself may be called as well, so that `tuning.tune(...)` is the same.
"""

import sys
import types
from typing import Any

from tuning.methods import Method, Request, Task
from tuning.methods.rounds import Progress
from tuning.results.result import Tuned
from tuning.searches.tune import tune

__all__ = ["Method", "Progress", "Request", "Task", "Tuned", "tune"]


class _Called(types.ModuleType):
    """A module that is called as the function of its name."""

    def __call__(self, *args: Any, **how: Any) -> Tuned:
        return tune(*args, **how)


sys.modules[__name__].__class__ = _Called
