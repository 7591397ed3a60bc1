"""What each kind of result leaves in its folder: one function for a kind, of its name, gives the contents."""

import contextlib
import dataclasses
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.control import PD, law_of
from mjx_climb.execution import devices
from mjx_climb.files import scenario_files
from mjx_climb.inputs.from_scenario import gains as scenario_gains
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.viz import plots
from tuning.background import Callback, Stage, Work, background, ignore
from tuning.comparisons import begun as comparisons
from tuning.comparisons import judge as judging
from tuning.comparisons import maps, margins, paired, stability_limit, verification
from tuning.comparisons.begun import GIVEN, OfGrid, OfSearch, beside_retuned, one_walk
from tuning.comparisons.compare import file_name, reads_forces
from tuning.comparisons.remedies import remedies
from tuning.comparisons.worth import Worth, of_front, of_schedule, worth_of
from tuning.gains import gains_file
from tuning.gains.gains_file import by_name, replaced
from tuning.numbers import failed, number, remarks, to_json
from tuning.pages import page, pictures
from tuning.pages import sections as pages
from tuning.pages.comparison import Compared, differences, gains_of
from tuning.pages.explorer import axes_of
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Goal, Objective
from tuning.problem.spaces import INTEGRAL, JOINT, searches_gait
from tuning.results.config_file import write_config
from tuning.results.front import Front
from tuning.results.judged import Comparison, Judged
from tuning.results.result import Written
from tuning.results.scheduled import Scheduled
from tuning.results.swept import HISTORIES, Swept, best_cell, holding
from tuning.results.tuned import Robust, Tuned
from tuning.searches import retuned_pd
from tuning.searches import schedule as schedules
from tuning.searches.shards import Rows
from tuning.writing.folder import Contents, Folder

MAPS = "All metrics over both gains; brighter is better."
CONVERGENCE = "How the search converged."
WALKS = "The tuned gains beside pd over time: red crosses mark a torn gripper, shading a disturbance."
PATH = "The way of the search over the map; the red line is the limit of stability."
MARGINS = "Force variation on worse hardware: a curve ends where a gripper is torn off, or the walk diverges."
LAWS = "Differences from retuned pd, with 95 % intervals over the walks; grey where the interval holds 0."
SHARES = "Share of the walks below a value."
FRONT = "The front, and all that was walked on the way."
SCHEDULE = "Gains by gravity and cargo."
Metrics = Mapping[str, Any]  # of one walk, as `mjx_climb.metrics` gives them
_HATCHED = ("detached_limb", "diverged")  # shown on every map
_VARIATION = "force_variation"


# ------------------------------------------------------------------------------------------------------------
# Fresh draws, schedules and fronts


def judge(found: Judged, folder: Folder, _: None = None) -> Contents:
    """Every walk, means and worst, the picture, the page."""
    ensemble = found.ensemble
    assert ensemble is not None
    found, metrics = folder.found(found), found.problem.metrics
    summed = judging.summary(found.data)
    sentence = f"{ensemble.members} walks each; {judging.failed_in_words(summed)}"
    outcome = [sentence, *judging.lost_in_words(found.data)]
    summary = to_json(judging.plain(summed, pages.shown(metrics)))
    return Contents(
        Written(data=found.data, summed=summed, outcome=outcome, summary=summary),
        {"summary.json": summary + "\n"},
        {"judged": (SHARES, lambda: pictures.plot_judged(found.data))},
        lambda origin: page.Page(
            title=f"Gains on the walks of {origin.name}", origin=origin, verdict=f"{sentence}.",
            scenario=found.scenario, notes=outcome[1:], tables=[pages.judged_table(summed, metrics)],
            facts={"seed": ensemble.seed},
        ),
    )  # fmt: skip


def schedule(found: Scheduled, folder: Folder, _: None = None) -> Contents:
    """The table, all metrics, and a picture; no report."""
    data = folder.found(found).data
    level, load, loss = schedules.one_for_all(data)
    one = "every set of gains breaks a limit at some other operating point"
    if loss < np.inf:
        one = f"the gains of {level:g} G, {load:g} kg lose at most {loss:.3f} of pd's objective"
    outcome = [of_schedule(data), f"one for all: {one}"]
    return Contents(
        Written(data=data, outcome=outcome, summary=to_json(schedules.rows(data))),
        {"schedule.csv": schedules.to_csv(data), "schedule.yaml": schedules.to_yaml(data)},
        {"schedule": (SCHEDULE, lambda: pictures.plot_schedule(data))},
    )


def pareto(found: Front, folder: Folder, _: None = None) -> Contents:
    """The front with its gains, a picture, the knee, and the report with the walks along the front."""
    found = folder.found(found)
    problem, data, asked, scenario = found.problem, found.data, found.asked, found.scenario
    how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
    names, metrics, worth = data.attrs["gains"].split(), (asked.against, asked.better), of_front(found)
    with folder.stage("walks along the front"):
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        on_front = {name: data[name].values for name in names}
        histories = mc.rollout_histories(scenario, on_front, metrics=problem.metrics, unsteady=True, **how)

    def rows(columns: tuple[str, ...], along: str, prefix: str = "") -> list[dict[str, Any]]:
        return [{n: data[f"{prefix}{n}"].values[i] for n in columns} for i in range(data.sizes[along])]

    config, pd = ({n: data[f"reference_{n}"].sel(reference=name).item() for n in metrics} for name in ("config", "pd"))
    summary = to_json(
        {
            "front": rows((*metrics, *names), "front"), "knee": found.knee, "config": config, "pd": pd,
            "pd_over_kp_and_kd": rows(("kp", "kd", *metrics), "without", "without_"),
            "force_sensor": {"in_words": worth},
        }
    )  # fmt: skip
    again = "mjx-climb pareto config.yaml --search search.yaml "
    again += f"--better {asked.better} --against {asked.against} --points {asked.points} --out again"
    return Contents(
        Written(walks=walks, data=data, outcome=[worth], summary=summary),
        {"summary.json": summary + "\n"},
        {"front": (FRONT, lambda: pictures.plot_front(data))},
        lambda origin: pages.pareto_page(found, histories, walks, origin),
        again,
    )


def compare(found: Comparison, folder: Folder, _: None = None) -> Contents:
    """Every walk with what differs, a table, the gains of each law, a picture, the page."""
    ensemble, metrics = found.ensemble, found.problem.metrics
    assert ensemble is not None and isinstance(found.problem.objective, Objective)
    reading = [name for name in found.laws if reads_forces(found.tuned[name].problem)]
    with folder.stage("intervals", compiles=False):
        table = paired.compared(found.data, pages.of_laws(metrics), retuned_pd.NAME, found.problem.objective)
    outside = [name for name, own in found.tuned.items() if not own.feasible]
    said = paired.verdict(table, found.laws, reading, found.hardware, outside)
    data = paired.beside(found.data, table).assign_attrs(verdict=said.in_words)
    found = folder.found(dataclasses.replace(found, data=data))
    name = "from Python" if folder.origin is None else folder.origin.name
    gains = {
        f"gains-{file_name(law)}.yaml": gains_file.text(
            gains_file.completed(own.scenario, own.gains),
            f"mjx-climb compare {name}: {law}",
            own.problem.law or law_of(own.scenario),
        )
        for law, own in found.tuned.items()
    }
    rows = pages.rows_of_laws(table)
    searched = {
        law: {"gains": by_name(own.gains), "points": own.data.sizes["point"], "env_steps": own.env_steps,
              "objective": own.value, "feasible": own.feasible, "reads_forces": law in reading}
        for law, own in found.tuned.items()
    }  # fmt: skip
    summary = to_json({"verdict": said.in_words, "best": said.best, "laws": searched, "table": rows})
    notes = [*pages.notes_of_laws(found, table), *judging.lost_in_words(found.data)]
    return Contents(
        Written(data=found.data, summed=table, outcome=[*notes, said.in_words], summary=summary),
        {**gains, "compared.csv": pages.to_csv(rows), "summary.json": summary + "\n"},
        {"compared": (LAWS, lambda: pictures.plot_laws(table))},
        lambda origin: pages.laws_page(found, table, said.in_words, notes, origin),
    )


# ------------------------------------------------------------------------------------------------------------
# A search over an ensemble


def robust(found: Robust, folder: Folder, _: None = None) -> Contents:
    """Gains, all points, a fresh draw that tests them, pictures and report."""
    found = folder.found(found)
    walks, summed, worth, outcome = _compare_robust(found, folder)
    plain: dict[str, Any] = judging.plain(summed, pages.shown(found.problem.metrics))
    for name, own in plain.items():
        own["objective"] = float(summed["objective"].sel(gains=name))
        own["broken_limits"] = summed["broken"].sel(gains=name).to_series().to_dict()
    plain["search"] = {
        "objective": found.value, "feasible": found.feasible, "env_steps": found.env_steps,
        "gains": by_name(found.gains),
    }  # fmt: skip
    summary = to_json(plain if worth is None else plain | worth.summary)
    return Contents(
        Written(data=walks, summed=summed, outcome=outcome, summary=summary),
        {"judged.nc": walks, "summary.json": summary + "\n"},
        {
            "convergence": (CONVERGENCE, lambda: pictures.plot_convergence(found)),
            "judged": (SHARES, lambda: pictures.plot_judged(walks)),
        },
        lambda origin: pages.robust_page(found, summed, outcome, origin),
        "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again",
    )


def _compare_robust(found: Robust, folder: Folder) -> tuple[xr.Dataset, xr.Dataset, Worth | None, list[str]]:
    """Simulate a result, the scenario's own gains, pd and pd retuned on walks that the search never saw.

    Returns: the walks, their mean and worst (see `tuning.comparisons.judge`), what a force sensor is worth, and all in
    lines. The folder keeps the rounds in which pd is retuned.
    """
    problem, ensemble, goal = found.problem, found.ensemble, found.problem.objective
    assert isinstance(goal, Objective)
    with folder.stage("retuned pd", unit="rounds") as told:
        retuned = comparisons.retuned(problem, found.search, folder.kept)(told)
    walked, pd, step = problem, {}, None
    if retuned is not None:  # as short a time step as it needs, for all that are compared
        pd = {retuned_pd.NAME: retuned.gains}
        shortest = retuned_pd.time_step_for(found.scenario, retuned_pd.joint_of(retuned))
        step = None if shortest == found.scenario.time_step else shortest
        walked = dataclasses.replace(problem, scenario=found.scenario.with_overrides({"time_step": shortest}))
    rivals = {"robust": found.gains, "config": problem.law or scenario_gains(found.scenario)}
    fresh = judging.fresh(ensemble.model_copy(update={"members": found.judges}))
    draws = {
        "fresh draw": judging.through(walked, rivals, fresh, pd),
        "its own draw": judging.through(problem, {"robust": found.gains}, ensemble),
    }
    drawn = {}
    for name, draw in draws.items():
        with folder.stage(name, unit="members") as told:
            drawn[name] = draw.dataset(Rows(draw).walk(told))
    walks, seen = drawn.values()
    broken, scores = judging.broken(walks, goal), judging.scores(walks, goal)
    summed = judging.summary(walks).assign(objective=scores, broken=broken)
    broke = {limit: share for limit, share in broken.sel(gains="robust").to_series().items() if share}
    outcome = [] if found.feasible else ["warning: no gains kept every limit in every member of the search"]
    outcome += [f"warning: {share:.1%} of the fresh walks break {limit}" for limit, share in broke.items()]
    outcome.append(f"{found.judges} walks each that the search never saw; {judging.failed_in_words(summed)}")
    outcome += judging.lost_in_words(walks)
    worth = None
    if retuned is not None:
        means = judging.plain(summed, pages.shown(problem.metrics))
        both = {name: means[name]["mean"] for name in ("robust", retuned_pd.NAME)}
        values = [{"objective": float(scores.sel(gains=n)), _VARIATION: mean[_VARIATION]} for n, mean in both.items()]
        worth = _worth(both.values(), values, retuned_pd.rival_of(found, retuned, step), problem)
        outcome.append(worth.in_words)
    if binding := judging.binding(seen, goal, "robust"):
        outcome.append(f"held by its limits: {'; '.join(binding)}")
    return walks, summed, worth, outcome


# ------------------------------------------------------------------------------------------------------------
# A sweep


def sweep(found: Swept, folder: Folder, begun: OfGrid | None = None) -> Contents:
    """Simulate the best, the scenario's own gains and pd, with the contents that `mjx-climb sweep` writes."""
    problem, (scenario, law) = found.problem, found.walker()
    walked = write_config(scenario, folder.path, law, problem.metrics)
    problem = dataclasses.replace(problem, scenario=scenario_files.copied(problem.scenario, folder.path))
    data = found.data.assign_attrs(scenario=walked.to_yaml())
    found = dataclasses.replace(found, problem=problem, data=data)
    compared = compare_sweep(found, folder.stage, begun)
    data, best, (scenario, law) = compared.data, compared.best, found.walker()
    folder.add("sweep.nc", data)
    count, edges = data["diverged"].size, compared.at_edge
    with background() as begin:
        how = {**problem.walks, "law": law}
        walking = begin(lambda _: pages.with_histories(data, scenario, best, **how) if count > HISTORIES else data)
        folder.draw({"maps": (MAPS, lambda: sheet(data, compared.rows))})
        with folder.stage("histories") if count > HISTORIES else contextlib.nullcontext():
            histories = walking(ignore)
    walks = {
        "config" if name == "paper" else name: {"gains": gains, "metrics": metrics}
        for name, (gains, metrics) in compared.rows.items()
    }
    sensor = {} if compared.worth is None else compared.worth.summary
    counts = {"walks": count, "failed": compared.failed, "best_at_edge_of": edges}
    summary = to_json({"best": None} | walks | sensor | {"grid": counts})
    widen = [f"the best lies on the edge of the grid: widen {name}" for name in edges]
    worth, own_step = [] if compared.worth is None else [compared.worth.in_words], scenario.time_step
    cell = "" if best is None else f", where the best cell has {number(best[_VARIATION].item())} N"
    worth += _at_one_step(compared.step, f"the maps at {own_step:g} s{cell}")
    if best is None:
        outcome = [f"no walk of the grid held: all {count} detached or diverged"]
    else:
        at = ", ".join(f"{name} {best[name].item():.4g}" for name in found.axes)
        outcome = [f"best: {at} ({compared.failed} of {count} walks detached or diverged)", *widen]
    outcome += worth + remarks({name: metrics for name, (_, metrics) in compared.rows.items()})
    if best is None:
        with folder.stage("what would help", compiles=False):
            outcome += _help(compared.walks, law)
    listed = {name: [float(f"{value:.6g}") for value in data[name].values] for name in found.axes}
    return Contents(
        Written(walks=compared.walks, compared=compared.rows, data=data, outcome=outcome, summary=summary),
        {"comparison.json": summary + "\n"},
        page=lambda origin: pages.sweep_page(
            dataclasses.replace(problem, scenario=scenario), compared, histories, marks(data, compared.rows),
            [*worth, *widen], origin,
        ),
        again=f'tuning.sweep(mjx_climb.load_scenario("config.yaml"), {listed}).write("again")',
    )  # fmt: skip


def _help(walks: Mapping[str, mc.Trajectory], law: mc.Law | None) -> list[str]:
    """Return what would keep the grippers of the config's walk shut, nothing where they hold."""
    name = next(name for name in walks if name not in (retuned_pd.NAME, GIVEN, "pd"))
    torn = plots.detachments(walks[name])
    return [f"{name}: {remedies(walks[name].scenario, torn[0][0], law)}"] if torn else []


class SweepComparison(NamedTuple):
    """The best walk of a grid beside the scenario's own gains and pd, walked in double precision."""

    data: xr.Dataset  # the grid, with the limit of stability
    best: xr.Dataset | None  # its cell, None where all failed
    walks: Mapping[str, mc.Trajectory]  # best, pd retuned, gains file, config (or paper), pd: as far as there are such
    rows: Compared  # gains and metrics of these, all at one time step
    failed: int  # walks of the grid
    at_edge: list[str]  # gains whose end of the axis the best cell lies on
    worth: Worth | None  # of a force sensor: the best against pd retuned
    step: float | None = None  # s, the time step of the rows, where it is not the scenario's


def compare_sweep(found: Swept, stage: Stage, begun: OfGrid | None = None) -> SweepComparison:
    """Simulate what the grid is compared with, and work out its limit of stability."""
    problem, best = found.problem, best_cell(found.data)
    axes = {name: found.data[name].values for name in found.axes}
    others = begun or comparisons.of_grid(problem, found.gains, axes, lambda work: work)
    # side by side: most of the time goes to the compiler, which has a program of its own for each
    with stage("walks alone and stability limit"), ThreadPoolExecutor(devices.usable_cores()) as pool:

        def begin(work: Work[Any]) -> Work[Any]:
            future = pool.submit(work, ignore)
            return lambda _: future.result()

        limits, asked, walkers = begin(others.limits), dict(others.walks), dict(others.walkers)
        if best is not None:
            walkers["best"] = found.walker({name: best[name].item() for name in found.axes})
            asked["best"] = one_walk(*walkers["best"], problem.engine)
        walking = {name: begin(walk) for name, walk in reversed(asked.items())}
        rival, limit = limits(ignore)
        if best is not None and (rival is None or (rival.lacks and best[_VARIATION] < rival.value)):
            rival = retuned_pd.least(problem.scenario, engine=problem.engine)  # a verdict takes all of pd's bounds
        step, level = None, dict[str, Work[mc.Trajectory]]()
        if rival is not None:
            own, step, level = beside_retuned(problem.scenario, rival.joint, walkers, problem.engine, begin)
            walking[retuned_pd.NAME] = own
        walked = {name: each(ignore) for name, each in walking.items()}
        compared = walked | {name: each(ignore) for name, each in level.items()}
        radius = stability_limit.on_map(limit, found.data)
    config = next(name for name in others.walks if name not in ("pd", GIVEN))
    names = [name for name in ("best", retuned_pd.NAME, GIVEN, config, "pd") if name in walked]
    rows = {name: (gains_of(compared[name]), mc.metrics(compared[name], problem.metrics)) for name in names}
    worth = None
    if rival is not None:
        rows[retuned_pd.NAME] = dict(rival.joint), (theirs := rows[retuned_pd.NAME][1])
        if best is not None:
            both = rows["best"][1], theirs
            scored = [{_VARIATION: np.nan if failed(each) else each[_VARIATION]} for each in both]
            spread = max(retuned_pd.spread(holding(found.data, _VARIATION).values), rival.spread)
            worth = _worth(both, scored, rival._replace(spread=spread, step=step), problem, " on this grid")
    data = found.data.assign(spectral_radius=radius)
    failures = int(((data["detached_limb"] >= 0) | data["diverged"].astype(bool)).sum())
    edges = [] if best is None else [n for n in found.axes if best[n].item() in data[n].values[[0, -1]]]
    walks = {name: walked[name] for name in names}
    return SweepComparison(data, best, walks, rows, failures, edges, worth, step)


def sheet(data: xr.Dataset, compared: Compared) -> Figure:
    """Draw the maps of all metrics that have values, with the gains and with pd's values to compare with."""
    metrics = [str(n) for n, v in data.items() if "larger_is_better" in v.attrs and n not in _HATCHED]
    known = [name for name in metrics if np.isfinite(data[name]).any()]
    baselines = {name: value for name, value in compared["pd"][1].items() if value is not None}
    return plots.plot_maps(data, known, marks(data, compared), baselines=baselines, columns=3)


def marks(data: xr.Dataset, compared: Compared) -> dict[str, tuple[float, float]]:
    """Return the two gains of the walks that have one of each."""
    found = {}
    for name, (gains, _) in compared.items():
        if gains is not None and all(key in gains and np.unique(gains[key]).size == 1 for key in axes_of(data)):
            x, y = (float(np.ravel(gains[key])[0]) for key in axes_of(data))
            found[name] = x, y
    return found


def _worth(
    metrics: Iterable[Metrics], scored: Iterable[Metrics], rival: retuned_pd.Rival, problem: Problem, place: str = ""
) -> Worth:
    """Return what a force sensor is worth, from the metrics of ours and of pd retuned, and what both are scored by."""
    (ours, theirs), (values, without) = metrics, scored
    others = differences(ours, theirs, problem.metrics, but=(_VARIATION,))
    return worth_of(values, without, rival, place=place, others=others)


# ------------------------------------------------------------------------------------------------------------
# A search for gains


def tune(found: Tuned, folder: Folder, begun: OfSearch | None = None) -> Contents:
    """Simulate, test and draw the result, with the contents that `mjx-climb tune` writes."""
    found = folder.found(found)
    compared = compare_tuned(found, folder, begun)
    over, rows, checked, goal = compared.over, compared.rows, compared.checked, found.problem.objective
    broken = {name: verification.broken_limits(goal, metrics) for name, (_, metrics) in rows.items()}
    broken["tuned"] = checked.broken_limits
    outcome = [f"warning: the tuned gains break limits: {'; '.join(broken['tuned'])}"] if broken["tuned"] else []
    outcome += [] if compared.worth is None else [compared.worth.in_words]
    outcome += _at_one_step(compared.step, f"search, map and limits are at {found.scenario.time_step:g} s")
    outcome += [f"warning: {line}" for line in checked.warnings]
    if broken["config"]:
        outcome.append(f"the config's own gains break limits: {'; '.join(broken['config'])}")
    outcome += remarks({name: metrics for name, (_, metrics) in rows.items()})
    tests = _outcome_of(checked, found) + _turns(found, compared.walks["tuned"])
    plain: dict[str, Any] = {
        name: {"gains": gains, "metrics": metrics, "broken_limits": broken[name]}
        for name, (gains, metrics) in rows.items()
    }
    plain["search"] = {
        **found.search.model_dump(mode="json"), "objective": found.value, "feasible": found.feasible,
        "env_steps": found.env_steps, "env_steps_at_best": found.best_at,
    }  # fmt: skip
    plain |= {} if compared.worth is None else compared.worth.summary
    summary = to_json(plain | {"verification": {**dataclasses.asdict(checked), "passed": checked.passed}})
    files: dict[str, Any] = {"summary.json": summary + "\n"}
    drawn: dict[str, Any] = {"margins": (MARGINS, lambda: pictures.plot_margins(compared.hardware, "tuned"))}
    if over is not None:
        files["map.nc"] = over
        drawn["path"] = PATH, lambda: pictures.plot_path(found, over)
    return Contents(
        Written(walks=compared.walks, compared=rows, data=over, outcome=outcome + tests, summary=summary),
        files,
        drawn,
        lambda origin: pages.tune_page(found, compared, outcome, tests, origin),
        "mjx-climb tune config.yaml --search search.yaml --out again",
    )


class TuneComparison(NamedTuple):
    """A result beside the scenario's own gains and pd, walked in double precision, and what its tests found."""

    walks: Mapping[str, mc.Trajectory]  # pd, config, tuned, retuned_pd
    rows: Compared  # tuned, retuned_pd, config, pd, all at one time step
    over: xr.Dataset | None  # the map around it
    hardware: margins.Found  # on worse hardware
    checked: verification.Verification
    worth: Worth | None  # of a force sensor: the result against pd retuned
    step: float | None = None  # s, the time step of the rows, where it is not the scenario's


def compare_tuned(found: Tuned, folder: Folder, begun: OfSearch | None = None) -> TuneComparison:
    """Simulate a result, what it is compared with and the map around it, and test it; draw the walks meanwhile."""
    scenario, problem, stage = found.scenario, found.problem, folder.stage
    ours, engine = (replaced(found.scenario, found.law, found.gains)[0], found.law), problem.engine
    with background() as begin:
        tested = begin(lambda _: verification.tests(found, problem))  # the longest to compile
        others = begun or comparisons.of_search(problem, found.search, begin, out=folder.kept)
        mapped = others.over or begin(lambda told: verification.map_of(found, problem, progress=told))
        walking = {**others.walks, "tuned": begin(one_walk(*ours, engine))}
        with stage("retuned pd", unit="rounds") as told:
            retuned = others.retuned(told)
        rivals = {"config": margins.Walker(problem.law, {})}
        step, level = None, dict[str, Work[mc.Trajectory]]()
        if retuned is not None:
            joint = retuned_pd.joint_of(retuned)
            walkers = {"tuned": ours, "config": (scenario, found.law), "pd": (under_pd(scenario), None)}
            walking[retuned_pd.NAME], step, level = beside_retuned(scenario, joint, walkers, engine, begin)
            if step is None:
                rivals["retuned pd"] = margins.Walker(PD(), joint)

        def find_margins(told: Callback) -> margins.Found:
            walked = {name: asked(ignore) for name, asked in others.on_hardware.items()}  # begun before this
            how: dict[str, Any] = {"law": found.law, "engine": engine}
            return margins.find(scenario, found.gains, others=rivals, walked=walked, progress=told, **how)

        margin, walks = begin(find_margins), {}
        for name, walk in walking.items():
            with stage(name) as told:
                walks[name] = walk(told)
        own = mc.metrics(walks["tuned"], problem.metrics)
        folder.draw(
            {
                "convergence": (CONVERGENCE, lambda: pictures.plot_convergence(found)),
                "walks": (WALKS, lambda: plots.plot_comparison({name: walks[name] for name in ("pd", "tuned")})),
            }
        )
        with stage("map") as told:
            over = mapped(told)
        with stage("margins") as told:
            hardware = margin(told)
        with stage("verification"):
            checked = verification.verify(
                found, problem, metrics=own, walks=over, hardware=hardware, tested=tested(ignore)
            )
        compared = walks | {name: walk(ignore) for name, walk in level.items()}
    metrics = {name: mc.metrics(trajectory, problem.metrics) for name, trajectory in compared.items()}
    gains, worth = {name: _with_joint_gains(walk, problem) for name, walk in walks.items()}, None
    if retuned is not None:
        both = metrics["tuned"], metrics[retuned_pd.NAME]
        scored = [_scored(problem.objective, each) for each in both]
        worth = _worth(both, scored, retuned_pd.rival_of(found, retuned, step), problem)
        gains[retuned_pd.NAME] = joint | (gains[retuned_pd.NAME] or {})
    order = [name for name in ("tuned", retuned_pd.NAME, "config", "pd") if name in walks]
    rows = {name: (gains[name], metrics[name]) for name in order}
    return TuneComparison(walks, rows, over, hardware, checked, worth, step)


def _at_one_step(step: float | None, but: str) -> list[str]:
    """Return at which time step the walks of a table are where it is not the scenario's, and what is not."""
    return [] if step is None else [f"all walks of the table are at a time step of {step:g} s, {but}"]


def _turns(found: Tuned, walk: mc.Trajectory) -> list[str]:
    """Return what isotropic gains mean for rotations: nothing much, where the law shifts the base."""
    if found.search.space != "isotropic" or not np.any(walk.base_displacement):
        return []
    moved = np.linalg.norm(walk.base_displacement.reshape(-1, 2, 3), axis=-1)
    shift, turn = 1e3 * np.nanmax(moved, axis=0)
    return [
        "one number for N/m and N m/rad alike makes rotations far stiffer at the feet than translations: the law "
        f"shifts the base by up to {shift:.2g} mm and turns it by {turn:.2g} mrad; --space split tunes both"
    ]


def _with_joint_gains(walk: mc.Trajectory, problem: Problem) -> dict[str, Any] | None:
    """Return the gains of a walk, joint loop and searched gait last; None where its controller has none."""
    gains, control = gains_of(walk), walk.scenario.control
    gait = (
        {key: getattr(walk.scenario.gait, name) for key, name in GAIT.items()} if searches_gait(problem.space) else {}
    )
    if gains is None and gait:
        gains = {}
    joint = {name: getattr(control, name) for name in (*JOINT, *((INTEGRAL,) if control.ki else ()))}
    return None if gains is None else gains | joint | gait


def _scored(target: Goal, metrics: Metrics) -> dict[str, float]:
    """Return what gains are compared by."""
    variation = metrics[_VARIATION]
    if variation is None or failed(metrics):
        return {"objective": np.nan, _VARIATION: np.nan}
    return {"objective": float(maps.score_of(target, metrics).value), _VARIATION: float(variation)}


def _outcome_of(checked: verification.Verification, found: Tuned) -> list[str]:
    """Return the outcome of the tests in a few lines, without their warnings."""
    limits = "keeps every limit" if checked.passed else "breaks limits: " + "; ".join(checked.broken_limits)
    lines = [f"verification: alone in float64 objective {checked.value:.4f} (pd: 1); {limits}"]
    if checked.binding_limits:
        lines.append(f"held by its limits: {'; '.join(checked.binding_limits)}")
    kinds = {kind: [n for n, k in checked.shape.items() if k == kind] for kind in ("plateau", "slope", "cliff")}
    lines.append("within 20 %: " + "; ".join(f"{kind} in {', '.join(n)}" for kind, n in kinds.items() if n))
    if checked.slopes:
        steepest = max(checked.slopes, key=lambda name: abs(checked.slopes[name]))
        lines.append(f"steepest slope: {checked.slopes[steepest]:+.3g} per unit of log {steepest}")
    if checked.grid_value is not None:
        lines.append(f"best cell of an isotropic grid: {checked.grid_value:.4f}, the search: {found.value:.4f}")
    for name, margin in checked.margins.items():
        holds, better = (margins.in_words(name, margin.worst, reached) for reached in (margin.holds, margin.better))
        lines.append(f"margin, {margins.QUANTITIES[name].title}: holds up to {holds}, better than pd up to {better}")
    lines.append(f"closed loop in its worst stance: largest eigenvalue {checked.spectral_radius:.6f} (below 1: stable)")
    return lines
