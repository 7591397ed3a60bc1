"""The search from Python: `from tuning.tune import tune`."""

from tuning.searches.tune import Progress, tune

__all__ = ["Progress", "tune"]
