"""Searches for admittance gains, and the command line on top of them.

`tuning.sweep`, `tune`, `pareto`, `schedule`, `robust`, `judge`: what they return writes by `.write(folder)` what the
command writes. `sweep_shard`, `judge_shard` and `merge` are for several machines. Names are imported when they are
first used, so that the command line starts at once.
"""

TYPE_CHECKING = False  # `typing` takes longest of all that is imported before the program watches signals

if TYPE_CHECKING:
    from tuning.searching import judge, judge_shard, merge, pareto, robust, schedule, sweep, sweep_shard
    from tuning.tune import tune

__all__ = ["judge", "judge_shard", "merge", "pareto", "robust", "schedule", "sweep", "sweep_shard", "tune"]


def __getattr__(name: str) -> object:
    import importlib

    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "tune":  # the module, which may be called; it has set itself here
        return importlib.import_module("tuning.tune")
    value = getattr(importlib.import_module("tuning.searching"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
