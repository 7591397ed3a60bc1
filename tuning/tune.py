"""The search from Python: `from tuning.tune import tune`, and what a search method of one's own is made of."""

from tuning.searches.methods import Method, Request, Task
from tuning.searches.tune import Progress, tune

__all__ = ["Method", "Progress", "Request", "Task", "tune"]
