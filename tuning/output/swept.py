"""A sweep, and what it leaves in a folder: the grid, its maps, the walks that matter beside it, and the report."""

import contextlib
import dataclasses
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb import plots
from mjx_climb.compilation import devices
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.files import dataset, scenario_files
from mjx_climb.rollouts.given import AnyGains
from tuning.gains import gains_file
from tuning.gains.gains_file import replaced
from tuning.gains.own_section import taken
from tuning.judged import stability_limit
from tuning.output.ahead import ahead, to_nobody
from tuning.output.beside import GIVEN, Beside, beside, one_walk
from tuning.output.folder import check_own, complete, made_from, write_config
from tuning.output.found import draw
from tuning.output.stages import Stage, silent
from tuning.report import page
from tuning.report import sweep as pages
from tuning.report.comparison import Compared, differences, gains_of
from tuning.report.explorer import axes_of
from tuning.report.numbers import to_json
from tuning.report.remarks import failed
from tuning.searches import finished_parts, grid, retuned_pd, shards
from tuning.searches.retuned_pd import Worth
from tuning.searches.shards import Shard

FILES = "report.html, sweep.nc, maps.png, comparison.json, config.yaml"
OWN_GAINS = "gains.yaml"
HATCHED = ("detached_limb", "diverged")  # shown on every map
CAPTION = "All metrics over both gains; brighter is better."


@dataclasses.dataclass(frozen=True)
class Swept:
    """A grid of walks over two gains, and what made it."""

    data: xr.Dataset  # see `tuning.searches.grid.sweep`
    scenario: mc.Scenario
    law: mc.Law | None = None  # the scenario's where None
    gains: AnyGains | None = None  # in place of the scenario's or the law's own
    metrics: mc.MetricTable = mc.METRICS
    engine: str = DEFAULT_ENGINE

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of both gains, that of the horizontal axis first."""
        return axes_of(self.data)

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: page.Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
        compared: Beside | None = None,
    ) -> "Judged":
        """Walk the best, the scenario's own gains and pd, and write what `mjx-climb sweep` writes.

        Arguments:
            folder: where to; it is made. What the search kept there with `out=folder` is removed.
            origin: what the report says of where it comes from.
            figures: formats of the pictures, of `mjx_climb.plots.FORMATS`; the report holds them as PNG anyway.
            stage: told what goes on, see `tuning.output.stages`; nothing is printed.
            compared: what `beside` gave, where it was begun before the grid.

        Returns:
            The walks, their metrics side by side, and the grid with the limit of stability.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        check_own(folder, "sweep.nc")
        walked, law = self.walker()
        walked = write_config(walked, folder, law, self.metrics)
        own = scenario_files.copied(self.scenario, folder)
        found = dataclasses.replace(self, scenario=own, data=made_from(self.data, walked))
        judged = judge(found, stage, compared)
        dataset.save(judged.data, folder / "sweep.nc")
        dataset.write_text_atomically(folder / "comparison.json", judged.summary + "\n")
        with ahead() as begin:
            many = judged.data["diverged"].size > grid.HISTORIES
            walking = begin(lambda _: _histories(found, judged) if many else judged.data)
            draw({"maps": lambda: sheet(judged.data, judged.compared)}, folder, {"png", *figures}, stage)
            with stage("histories") if many else contextlib.nullcontext():
                histories = walking(to_nobody)
        with stage("report", compiles=False):
            again = f'tuning.sweep(mjx_climb.load_scenario("config.yaml"), {_listed(self.data)}).write("again")'
            origin = complete(origin, "tuning.sweep(...)", again, folder)
            page.write(_page(found, judged, histories, origin, folder), folder)
        finished_parts.clear(folder)
        return judged

    def walker(self, gains: AnyGains | None = None) -> tuple[mc.Scenario, mc.Law | None]:
        """Return scenario and law of the grid, with further gains in place of theirs."""
        walked = (self.scenario, self.law) if self.gains is None else replaced(self.scenario, self.law, self.gains)
        return walked if gains is None else replaced(*walked, gains)


def keep_beside(
    shard: Shard,
    out: Path,
    scenario: mc.Scenario,
    law: mc.Law | None,
    gains: AnyGains | None,
    metrics: Iterable[mc.Metric],
    about: Mapping[str, str],
) -> None:
    """Leave in the folder of a shard what `merged` needs beside its walks, before these begin.

    Arguments:
        shard, out: which shard, and the folder below which it is kept.
        scenario, law, gains, metrics: as of `Swept`.
        about: `again`, see `tuning.searches.shards.tell`; what else the report is to say.

    Raises:
        OutputError: a file cannot be written.
    """
    folder = shard.folder(out)
    write_config(scenario, folder, law, metrics)
    if gains is not None:
        gains_file.save(gains, folder / OWN_GAINS, "of the sweep in this folder", law)
    shards.tell(out, shard, about)


def merged(found: Sequence[shards.Kept], law: mc.Law | None, metrics: mc.MetricTable) -> Swept:
    """Return the sweep whose shards these are.

    Raises:
        ConfigError: shards of another law, other metrics or versions, or not all of them.
    """
    folder = found[0].folder
    scenario, law, metrics = taken(mc.load_scenario(folder / "config.yaml"), law, metrics, f"{folder}/config.yaml")
    gains = gains_file.load(folder / OWN_GAINS, law) if (folder / OWN_GAINS).is_file() else None
    walked, walking = (scenario, law) if gains is None else replaced(scenario, law, gains)
    data = grid.merged(found, walked, walking, metrics)
    return Swept(data, scenario, law, gains, metrics, found[0].identity["engine"])


class Judged(NamedTuple):
    """The best walk of a grid beside the scenario's own gains and pd, walked in double precision."""

    data: xr.Dataset  # the grid, with the limit of stability
    best: xr.Dataset | None  # its cell, None where all failed
    walks: Mapping[str, mc.Trajectory]  # best, pd retuned, gains file, config (or paper), pd: as far as there are such
    compared: Compared  # gains and metrics of these
    failed: int  # walks of the grid
    at_edge: list[str]  # gains whose end of the axis the best cell lies on
    worth: Worth | None  # of a force sensor: the best against pd retuned
    summary: str  # all of it, JSON


def judge(found: Swept, stage: Stage = silent, compared_with: Beside | None = None) -> Judged:
    """Walk what the grid is compared with, and work out its limit of stability."""
    best, engine = grid.best_cell(found.data), found.engine
    axes = {name: found.data[name].values for name in found.axes}
    others = compared_with or beside(found.scenario, found.law, found.gains, axes, engine, lambda work: work)
    # side by side: most of the time goes to the compiler, which has a program of its own for each
    with stage("walks alone and stability limit"), ThreadPoolExecutor(devices.usable_cores()) as pool:
        limits = pool.submit(others.limits, to_nobody)
        asked = dict(others.walks)
        if best is not None:
            walker = found.walker({name: best[name].item() for name in found.axes})
            asked["best"] = one_walk(*walker, engine)
        walking = {name: pool.submit(walk, to_nobody) for name, walk in reversed(asked.items())}
        (rival, limit), level, step = limits.result(), None, None
        if best is not None and (rival is None or (rival.lacks and best["force_variation"] < rival.value)):
            rival = retuned_pd.least(found.scenario, engine=engine)  # a verdict for the law takes all of pd's bounds
        if rival is not None:
            alone = retuned_pd.walker(found.scenario, rival.joint)
            walking[retuned_pd.NAME] = pool.submit(one_walk(alone, None, engine), to_nobody)
            if best is not None and alone.time_step != found.scenario.time_step:  # as short for both that are compared
                step = alone.time_step
                shorter = walker[0].with_overrides({"time_step": step})
                level = pool.submit(one_walk(shorter, walker[1], engine), to_nobody)
        walks = {name: each.result() for name, each in walking.items()}
        radius = stability_limit.on_map(limit, found.data)
    config = next(name for name in others.walks if name not in ("pd", GIVEN))
    order = [name for name in ("best", retuned_pd.NAME, GIVEN, config, "pd") if name in walks]
    walks = {name: walks[name] for name in order}
    compared = {name: (gains_of(walk), mc.metrics(walk, found.metrics)) for name, walk in walks.items()}
    worth = None
    if rival is not None:
        theirs = compared[retuned_pd.NAME][1]
        compared[retuned_pd.NAME] = rival.joint, theirs
        if best is not None:
            ours = compared["best"][1] if level is None else mc.metrics(level.result(), found.metrics)
            worth = _worth(found, ours, theirs, rival, step)
    data = found.data.assign(spectral_radius=radius)
    failed = int(((data["detached_limb"] >= 0) | data["diverged"].astype(bool)).sum())
    edges = [] if best is None else [n for n in found.axes if best[n].item() in data[n].values[[0, -1]]]
    summary = _summary(compared, worth, {"walks": data["diverged"].size, "failed": failed, "best_at_edge_of": edges})
    return Judged(data, best, walks, compared, failed, edges, worth, summary)


def _worth(
    found: Swept, ours: Mapping[str, Any], theirs: Mapping[str, Any], rival: retuned_pd.Rival, step: float | None
) -> Worth:
    name = "force_variation"  # what the best cell has least of
    held = found.data[name].where((found.data["detached_limb"] < 0) & ~found.data["diverged"].astype(bool))
    values, without = ({name: np.nan if failed(metrics) else metrics[name]} for metrics in (ours, theirs))
    return retuned_pd.worth(
        values, without, rival.joint,
        spread=max(retuned_pd.spread(held.values), rival.spread),
        lacks=rival.lacks,
        place=" on this grid",
        step=step,
        others=differences(ours, theirs, found.metrics, but=(name,)),
    )  # fmt: skip


def _summary(compared: Compared, worth: Worth | None, counts: Mapping[str, Any]) -> str:
    walks = {
        "config" if name == "paper" else name: {"gains": gains, "metrics": metrics}
        for name, (gains, metrics) in compared.items()
    }
    sensor = {} if worth is None else {"force_sensor": worth.changes | {"in_words": worth.in_words}}
    return to_json({"best": None} | walks | sensor | {"grid": counts})


def sheet(data: xr.Dataset, compared: Compared) -> Figure:
    """Draw the maps of all metrics that have values, with the gains and with pd's values to compare with."""
    x, y = axes_of(data)
    metrics = [str(n) for n, v in data.items() if "larger_is_better" in v.attrs and n not in HATCHED]
    known = [name for name in metrics if np.isfinite(data[name]).any()]
    baselines = {name: value for name, value in compared["pd"][1].items() if value is not None}
    return plots.plot_maps(data, known, marks(data, compared), baselines=baselines, columns=3, x=x, y=y)


def marks(data: xr.Dataset, compared: Compared) -> dict[str, tuple[float, float]]:
    """Return the two gains of the walks that have one of each."""
    found = {}
    for name, (gains, _) in compared.items():
        if gains is not None and all(key in gains and np.unique(gains[key]).size == 1 for key in axes_of(data)):
            x, y = (float(np.ravel(gains[key])[0]) for key in axes_of(data))
            found[name] = x, y
    return found


def _histories(found: Swept, judged: Judged) -> xr.Dataset:
    scenario, law = found.walker()
    how: dict[str, Any] = {"law": law, "engine": found.engine, "metrics": found.metrics}
    return pages.with_histories(judged.data, scenario, judged.best, **how)


def _page(found: Swept, judged: Judged, histories: xr.Dataset, origin: page.Origin, folder: Path) -> page.Page:
    return pages.page(
        judged.data, histories, judged.walks, judged.compared, marks(judged.data, judged.compared), found.walker()[0],
        warnings=[
            *([] if judged.worth is None else [f"{judged.worth.in_words[0].upper()}{judged.worth.in_words[1:]}."]),
            *(f"The best lies on the edge of the grid: widen {name}." for name in judged.at_edge),
        ],
        origin=origin,
        pictures={CAPTION: folder / "maps.png"},
        about=found.metrics,
        law=found.law,
    )  # fmt: skip


def _listed(data: xr.Dataset) -> dict[str, list[float]]:
    return {name: [float(f"{value:.6g}") for value in data[name].values] for name in axes_of(data)}
