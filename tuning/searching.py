"""The searches from Python beside `tuning.tune`: each returns what can be written as the command of its name does."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.rollouts.given import AnyGains
from tuning.gains.gains_file import replaced
from tuning.output.swept import Swept
from tuning.searches import grid


def sweep(
    scenario: mc.Scenario,
    axes: grid.Axes,
    *,
    law: mc.Law | None = None,
    gains: AnyGains | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    batch_size: int | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Swept:
    """Walk a grid of two gains, the same on all axes of one walk, in single precision.

    `sweep(scenario, {"stiffness": k, "damping": d}, out="results/mine").write("results/mine")` is `mjx-climb sweep`.

    Arguments:
        scenario: what walks where.
        axes: a list of values for each of two gains of the law, SI units; that of the horizontal axis first.
        law: the control law, the scenario's where None.
        gains: in place of the scenario's or the law's own, for those that are not swept, and for a further walk to
            compare with.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        batch_size: robots that walk at a time; see `tuning.searches.grid.default_batch_size`.
        out: a folder that keeps each finished part, so that an interrupted sweep goes on from there, bit by bit.
        progress: called with the number of walks done and the number in all.

    Returns:
        The metrics over both gains (`data`, an `xarray.Dataset`), and what `write(folder)` needs.

    Raises:
        ValueError: axes that are no lists of positive numbers, or no gains of the law.
        OutputError: `out` cannot be written, or holds an unfinished sweep of something else.
    """
    table = mc.MetricTable(metrics)
    walked, own = (scenario, law) if gains is None else replaced(scenario, law, gains)
    data = grid.sweep(
        walked, axes=axes, law=own, progress=progress, batch_size=batch_size, engine=engine, metrics=table,
        out=None if out is None else Path(out),
    )  # fmt: skip
    return Swept(data, scenario, law, gains, table, engine)
