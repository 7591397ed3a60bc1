"""Shards of a sweep or of judge, put together: `tuning.merge`."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import mjx_climb as mc
from tuning.comparisons import judge
from tuning.gains.own_section import taken
from tuning.results.judged import Judged
from tuning.results.swept import Swept
from tuning.searches import sweep
from tuning.searches.shards import Kept, find, joined

Read = Callable[[Kept, mc.Scenario, mc.Law | None, mc.MetricTable], sweep.Grid | judge.Draw]
KINDS: Mapping[str, Read] = {Swept.KIND: sweep.read_asked, Judged.KIND: judge.read_asked}  # kinds that may be cut


def merge(
    folders: Sequence[str | os.PathLike[str]], *, law: mc.Law | None = None, metrics: Iterable[mc.Metric] = mc.METRICS
) -> Swept | Judged:
    """Return the result that shards in some folders were part of, as of `sweep` or `judge`: on CPUs bit by bit.

    `tuning.write(tuning.merge([folder]), folder)` is `mjx-climb sweep --merge`.

    Arguments:
        folders: those of the shards, or one that holds them all; nothing in them is changed.
        law: the user's own, where the shards had one whose file they do not name.
        metrics: those of the shards, likewise.

    Raises:
        ConfigError: no shards there, shards of different things, of another law, other metrics or versions, or not all
            of them: in one line which are missing and the command that finishes them.
    """
    return merged(find([Path(folder) for folder in folders]), law, mc.MetricTable(metrics))


def merged(found: Sequence[Kept], law: mc.Law | None, metrics: mc.MetricTable) -> Swept | Judged:
    """Return the result of the shards that `find` found; `merge` with its errors."""
    config = found[0].folder / "config.yaml"
    own = taken(mc.load_scenario(config), law, metrics, str(config))
    work = KINDS[found[0].identity["kind"]](found[0], *own)
    return work.result(joined(work, found))
