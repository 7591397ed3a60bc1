"""Searches for admittance gains, and the command line on top of them.

`tuning.sweep`, `tune`, `pareto`, `schedule`, `robust`, `evaluate`, `degrade`, `compare`, `ceiling`, `identify`,
`excite`: `tuning.write(result, folder)` writes their results as the commands do. `sweep_shard`,
`evaluate_shard` and `merge` are for several machines.
"""

from mjx_climb.lazy import lazy_names

# all code here is known by its name, as that of a library: see `mjx_climb.execution.contents`
__part_of__ = "mjx_climb"

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tuning.comparisons.compare import compare as compare
    from tuning.comparisons.degraded import degrade as degrade
    from tuning.comparisons.judge import evaluate as evaluate
    from tuning.comparisons.judge import evaluate_shard as evaluate_shard
    from tuning.comparisons.merge import merge as merge
    from tuning.identification.fit.identify import identify as identify
    from tuning.identification.plan.excitation import excite as excite
    from tuning.kinds import write as write
    from tuning.searches.ceiling import ceiling as ceiling
    from tuning.searches.pareto import pareto as pareto
    from tuning.searches.schedule import schedule as schedule
    from tuning.searches.sweep import sweep as sweep
    from tuning.searches.sweep import sweep_shard as sweep_shard
    from tuning.searches.tune import robust as robust
    from tuning.searches.tune import tune as tune
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
