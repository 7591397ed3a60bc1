"""The searches from Python beside `tuning.tune`: each returns what can be written as the command of its name does."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.rollouts.given import AnyGains
from tuning.gains.gains_file import replaced
from tuning.output import judged, swept
from tuning.output.judged import Judged
from tuning.output.pareto import Front
from tuning.output.robust import JUDGES, Robust
from tuning.output.schedule import Scheduled
from tuning.output.swept import Swept
from tuning.problem.ensemble import Ensemble
from tuning.problem.search import Search
from tuning.searches import draw, grid, shards
from tuning.searches import pareto as fronts
from tuning.searches import robust as robust_search
from tuning.searches import schedule as schedules
from tuning.searches import tune as searches
from tuning.searches.finished_parts import Parts
from tuning.searches.judged_rounds import Told
from tuning.searches.shards import made

Folder = str | os.PathLike[str]


def sweep(
    scenario: mc.Scenario,
    axes: grid.Axes,
    *,
    law: mc.Law | None = None,
    gains: AnyGains | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    batch_size: int | None = None,
    out: Folder | None = None,
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
        out=_path(out),
    )  # fmt: skip
    return Swept(data, scenario, law, gains, table, engine)


def sweep_shard(
    scenario: mc.Scenario,
    axes: grid.Axes,
    shard: tuple[int, int],
    *,
    out: Folder,
    law: mc.Law | None = None,
    gains: AnyGains | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Walk a shard of what `sweep` walks, for `merge`; `mjx-climb sweep --shard 3/16`.

    The arguments that are not listed are those of `sweep`.

    Arguments:
        shard: which one, from 1, and how many there are.
        out: the folder below which all shards are kept, each in a folder of its own. A shard that was interrupted goes
            on from there.
        progress: called with the number of walks of the shard that are done, and the number of its walks.

    Returns:
        The shard's own folder.

    Raises:
        ConfigError: no such shard, or more shards than walks.
        ValueError: axes that are no lists of positive numbers, or no gains of the law.
        OutputError: `out` cannot be written, or holds shards of something else.
    """
    part, folder = made(*shard), Path(out)
    walked, own = (scenario, law) if gains is None else replaced(scenario, law, gains)
    how: dict[str, Any] = {"axes": axes, "law": own, "batch_size": batch_size, "engine": engine, "metrics": metrics}
    grid.claim(walked, out=folder, shard=part, **how)
    again = {"again": "the same call of tuning.sweep_shard for {shard}"}
    swept.keep_beside(part, folder, scenario, law, gains, metrics, again)
    grid.sweep_shard(walked, part, out=folder, progress=progress, **how)
    return part.folder(folder)


def merge(
    folders: Sequence[Folder], *, law: mc.Law | None = None, metrics: Iterable[mc.Metric] = mc.METRICS
) -> Swept | Judged:
    """Return what shards in some folders were part of, as `sweep` or `judge` return it: on CPUs bit by bit.

    `merge([folder]).write(folder)` is `mjx-climb merge`.

    Arguments:
        folders: those of the shards, or one that holds them all; nothing in them is changed.
        law: the user's own, where the shards had one whose file they do not name.
        metrics: those of the shards, likewise.

    Raises:
        ConfigError: no shards there, shards of different things, or not all of them: in one line which are missing
            and what would finish them.
    """
    kept, table = shards.find([Path(folder) for folder in folders]), mc.MetricTable(metrics)
    if kept[0].identity["kind"] == draw.KIND:
        return judged.merged(kept, law, table)
    return swept.merged(kept, law, table)


def judge(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    *,
    members: int = JUDGES,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: Folder | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Judged:
    """Judge gains on walks that no search over the ensemble has seen, beside the scenario's own and pd.

    `judge(scenario, gains, ensemble).write(folder)` is `mjx-climb judge`. `metrics` and `engine` are those of `sweep`.

    Arguments:
        scenario: what walks where, under an admittance law.
        gains: by name.
        ensemble: what the walks may meet; drawn again with another seed.
        members: walks of each set of gains.
        law: whose gains they are, where it is not the scenario's.
        out: a folder that keeps each finished part, so that what was interrupted goes on from there, bit by bit.
        progress: called with the number of members that have walked and the number in all.

    Raises:
        ConfigError: an ensemble that the scenario does not allow.
        OutputError: `out` cannot be written, or holds unfinished walks of something else.
    """
    drawn, table = ensemble.model_copy(update={"members": members}), mc.MetricTable(metrics)
    walks = judged.draw_of(scenario, judged.rivals(scenario, gains, law), drawn, law, table, engine)
    kept = None if out is None else Parts(Path(out), walks.identity())
    return Judged(walks.dataset(shards.walk(walks, kept, progress)), scenario, drawn, table, law)


def judge_shard(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    shard: tuple[int, int],
    *,
    out: Folder,
    members: int = JUDGES,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Walk a shard of what `judge` walks, with the same arguments, for `merge`; `mjx-climb judge --shard 3/16`.

    What `sweep_shard` says of `shard`, `out`, `progress` and its result holds here.

    Raises:
        ConfigError: no such shard, more shards than members, or an ensemble that the scenario does not allow.
        OutputError: `out` cannot be written, or holds shards of something else.
    """
    part, folder = made(*shard), Path(out)
    drawn, table = ensemble.model_copy(update={"members": members}), mc.MetricTable(metrics)
    walks = judged.draw_of(scenario, judged.rivals(scenario, gains, law), drawn, law, table, engine)
    kept = shards.claim(walks, folder, part)
    judged.keep_beside(part, folder, walks, drawn, {"again": "the same call of tuning.judge_shard for {shard}"})
    shards.walk(walks, kept, progress, part)
    return part.folder(folder)


def pareto(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    better: str = fronts.BETTER,
    against: str = fronts.AGAINST,
    points: int = fronts.POINTS,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: Folder | None = None,
    progress: Told | None = None,
    **settings: Any,
) -> Front:
    """Search the Pareto front of two metrics as `tuning.searches.pareto.front` does, whose arguments these are.

    `pareto(scenario, out="results/mine").write("results/mine")` is `mjx-climb pareto`.
    """
    how: dict[str, Any] = {"law": law, "metrics": metrics, "engine": engine}
    asked = fronts.trade(scenario, searches.changed(search, settings), better=better, against=against, **how)
    return Front(fronts.run(asked, points, out=_path(out), progress=progress), asked)


def schedule(
    scenario: mc.Scenario,
    search: Search | None = None,
    *,
    gravity: Sequence[float] = schedules.GRAVITIES,
    cargo: Sequence[float] = schedules.CARGO,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: Folder | None = None,
    progress: Told | None = None,
    **settings: Any,
) -> Scheduled:
    """Tune gains for pairs of gravity and cargo as `tuning.searches.schedule.schedule` does, whose arguments these are.

    `schedule(scenario, out="results/mine").write("results/mine")` is `mjx-climb schedule`.
    """
    how: dict[str, Any] = {"law": law, "metrics": metrics, "engine": engine}
    asked = schedules.operating_points(scenario, searches.changed(search, settings), gravity, cargo, **how)
    return Scheduled(schedules.run(asked, out=_path(out), progress=progress), asked)


def robust(
    scenario: mc.Scenario,
    ensemble: Ensemble,
    search: Search | None = None,
    *,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    judges: int = JUDGES,
    out: Folder | None = None,
    progress: Callable[[searches.Progress], None] | None = None,
    **settings: Any,
) -> Robust:
    """Search the gains that do best over an ensemble; `tuning.tune` with its walks and the robust objective.

    Where no weights are given, those of a plain search and the peak pulling force count alike.
    `robust(scenario, ensemble, out="results/mine").write("results/mine")` is `mjx-climb tune --ensemble`.
    """
    wanted = robust_search.settled(search, settings, ensemble)
    wanted = searches.for_this_machine(scenario, wanted, (search, settings.get("method")), engine, law)
    problem = robust_search.problem_of(scenario, ensemble, wanted, law=law, metrics=metrics, engine=engine)
    found = searches.run(problem, wanted, out=_path(out), progress=progress)
    return Robust(**vars(found), problem=problem, ensemble=ensemble, judges=judges)


def _path(out: Folder | None) -> Path | None:
    return None if out is None else Path(out)
