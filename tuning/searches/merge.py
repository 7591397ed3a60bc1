"""Shards of a sweep, or of evaluated gains, put together: `tuning.merge`."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import mjx_climb as mc
from tuning.gains.own_section import taken
from tuning.searches import judge, shards, sweep
from tuning.searches.judge import Judged
from tuning.searches.shards import Kept
from tuning.searches.sweep import Swept


def merge(
    folders: Sequence[str | os.PathLike[str]],
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
) -> Swept | Judged:
    """Return what shards in some folders were part of, as `sweep` or `judge` return it: on CPUs bit by bit.

    `merge([folder]).write(folder)` is `mjx-climb merge`.

    Arguments:
        folders: those of the shards, or one that holds them all; nothing in them is changed.
        law: the user's own, where the shards had one whose file they do not name.
        metrics: those of the shards, likewise.

    Raises:
        ConfigError: no shards there, shards of different things, of another law, other metrics or versions, or not all
            of them: in one line which are missing and what would finish them.
    """
    return of(shards.find([Path(folder) for folder in folders]), law, mc.MetricTable(metrics))


def of(found: Sequence[Kept], law: mc.Law | None, metrics: mc.MetricTable) -> Swept | Judged:
    """Return what shards that `shards.find` found were part of; `merge` with its errors."""
    folder = found[0].folder
    scenario, law, metrics = taken(mc.load_scenario(folder / "config.yaml"), law, metrics, f"{folder}/config.yaml")
    if found[0].identity["kind"] == judge.KIND:
        draw = judge.read_asked(found[0], scenario, law, metrics)
        return draw.result(shards.joined(draw, found))
    grid = sweep.read_asked(found[0], scenario, law, metrics)
    return grid.result(shards.joined(grid, found))
