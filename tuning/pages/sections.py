"""What stands on the page of each search: of a sweep, of a search for gains, of a front, of gains on an ensemble."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.walks import LINES
from tuning.comparisons.compare import HARDWARE
from tuning.comparisons.judge import PD
from tuning.comparisons.worth import of_front
from tuning.gains.gains_file import by_name
from tuning.gains.gains_tables import labels
from tuning.numbers import axis_values, change, failed, gain, number, remarks, unit
from tuning.pages import comparison
from tuning.pages.explorer import MOST_CELLS, axes_of, coarser_grid, explorer, grid_points, listed_points
from tuning.pages.page import Origin, Page, Table
from tuning.problem.evaluation import Problem
from tuning.results.front import Front, without_sensor
from tuning.results.judged import Comparison
from tuning.results.swept import HISTORIES
from tuning.results.tuned import Tuned
from tuning.searches import sweep as sweeps
from tuning.searches.retuned_pd import NAME

if TYPE_CHECKING:
    from tuning.writing.contents import SweepComparison, TuneComparison

SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "peak_joint_torque", "cost_of_transport",
         "base_deviation", "joint_limit_margin")  # fmt: skip


def sentences(lines: Iterable[str]) -> list[str]:
    """Return lines with a capital in front and a full stop."""
    return [f"{line[0].upper()}{line[1:]}".removesuffix(".") + "." for line in lines]


def with_histories(result: xr.Dataset, scenario: mc.Scenario, best: xr.Dataset | None, **how: Any) -> xr.Dataset:
    """Return a sweep that has time histories: itself, or of a larger one a coarser grid with the best cell in it."""
    if all(name in result for name in LINES):
        return result
    # out of the cells that the page shows
    kept = coarser_grid(coarser_grid(result, best, MOST_CELLS), best, HISTORIES)
    return sweeps.sweep(scenario, {name: kept[name].values for name in axes_of(kept)}, **how).data


def sweep_page(
    problem: Problem, compared: "SweepComparison", histories: xr.Dataset, marks: Mapping[str, tuple[float, float]],
    notes: Sequence[str], origin: Origin,
) -> Page:  # fmt: skip
    """Return the page of a sweep: its maps with gains marked on them, time histories, and notes that stand first."""
    grid, best, rows, about = compared.data, compared.best, compared.rows, problem.metrics
    axes, metrics = axes_of(grid), {walk: numbers for walk, (_, numbers) in rows.items()}
    count, kept, found = grid["diverged"].size, histories["diverged"].size, list(notes)
    if best is None:
        verdict = f"None of the {count} walks held: every one lost a gripper or diverged."
    else:
        name, won = "force_variation", metrics["best"]
        gains = " and ".join(f"{axis} {best[axis].item():.4g}" for axis in axes)
        text, missed = comparison.against(name, "best", metrics, about), won.get("missed_grips")
        grips = f"every grip holds, but {missed} missed the ground" if missed else "every gripper holds"
        verdict = f"Of {count} walks, {gains} are best: force variation {text}; {failed(won) or grips}."
        found.append(f"{compared.failed} of the {count} walks lost a gripper or diverged")
        found += _worse_than_pd(won, metrics["pd"], about)
    found += remarks(metrics)
    if kept < count:
        found.append(f"the page holds the time histories of {kept} of the cells; a click shows the nearest of them")
    begin = best if best is not None else grid.isel(dict.fromkeys(axes, 0))
    points = grid_points(grid, histories, metrics["pd"], marks, begin)
    walks = {name: compared.walks[name] for name in reversed(list(compared.walks))}
    facts = {
        "precision": f"{grid.attrs['dtype']} (grid), float64 (named walks)", "engine": grid.attrs["engine"],
        "robots at a time": grid.attrs["batch_size"], "seed": "none: nothing is drawn at random",
    }  # fmt: skip
    return Page(
        title=f"Sweep of {origin.name}, {' by '.join(str(grid.sizes[name]) for name in axes)} gains", origin=origin,
        verdict=verdict, scenario=problem.scenario, notes=sentences(found), facts=facts,
        explorers={"Maps and walks": explorer(walks, metrics, shown=("pd",), points=points, about=about)},
        tables=[comparison.table(rows, "Walks in double precision", about, problem.law)],
    )  # fmt: skip


def tune_page(
    found: Tuned, compared: "TuneComparison", outcome: Iterable[str], tests: Iterable[str], origin: Origin
) -> Page:
    """Return the page of a search: what matters most in the lines of `outcome`, what else the tests found folded."""
    search, about, checked, rows = found.search, found.problem.metrics, compared.checked, compared.rows
    metrics = {walk: numbers for walk, (_, numbers) in rows.items()}
    scores = []
    for name in [name for name, weight in search.weights.items() if weight]:
        three = {walk: metrics[walk] for walk in ("tuned", "pd", "config")}
        scores.append(f"{about.in_words(name)} {comparison.against(name, 'tuned', three, about)}")
    limits = "every limit is kept" if checked.passed else f"limits are broken: {', '.join(checked.broken_limits)}"
    points = None if compared.over is None else _points_of_map(found, compared.over, metrics["pd"])
    title = "Map: the same gains on all axes, around the result" if points else "Walks"
    walks = {name: compared.walks[name] for name in reversed(list(rows))}
    objective = {"tuned": {"objective": checked.value}, "pd": {"objective": 1.0}}
    values = {walk: {**numbers, **objective.get(walk, {})} for walk, numbers in metrics.items()}
    open_notes, folded = ([line[0].upper() + line[1:] for line in lines] for lines in (outcome, tests))
    side_by_side = comparison.table(rows, "Walks in double precision", about, found.law)
    caption = "Around the result: change of the objective, in per cent of pd's, with one gain 20 % less or more"
    around = []
    for name, shape in checked.shape.items():
        changes = (checked.less[name], checked.more[name])
        cells = ("breaks a limit" if value is None else f"{100 * value:+.2f}" for value in changes)
        around.append([name, *cells, shape, number(checked.slopes.get(name))])
    near = Table(caption, ["gain", "20 % less", "20 % more", "shape", "slope per log"], [("", around)], 1)
    return Page(
        title=f"Tuned gains for {origin.name}: {search.method}, {search.space}", origin=origin,
        verdict=f"Tuned gains score {checked.value:.4f} of pd's 1: {'; '.join(scores)}; {limits}.",
        scenario=found.scenario, more=folded,
        notes=[*open_notes, *sentences(_worse_than_pd(metrics["tuned"], metrics["pd"], about))],
        explorers={
            title: explorer(walks, values, shown=("pd", "tuned"), opens_on="tuned", points=points, about=about)
        },
        tables=[side_by_side, comparison.gains_table(rows, found.law), near],
        facts={"precision": "float32 (search, map), float64 (named walks, verification)", "seed": search.seed,
               "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})"},
    )  # fmt: skip


def _points_of_map(found: Tuned, over: xr.Dataset, baseline: comparison.Values) -> dict[str, Any]:
    """Return the cells of the map around a result, which begins at its best one.

    Gains that differ from axis to axis stand at the geometric means of translations and of rotations.
    """
    x, y = axes_of(over)
    walks = {"tuned": by_name(found.gains)} | ({"config": vars(found.scenario.control)} if found.law is None else {})
    marks: dict[str, tuple[float, float]] = {}
    for walk, gains in walks.items():
        both = np.stack([axis_values(gains[x]), axis_values(gains[y])])
        if np.ptp(both, axis=1).max() == 0:
            marks[walk] = (both[0, 0].item(), both[1, 0].item())
            continue
        for part, place in (("translations", both[:, :3]), ("rotations", both[:, 3:])):
            at = np.exp(np.log(place).mean(1))
            if np.isfinite(at).all():
                marks[f"{walk}, {part}"] = (at[0].item(), at[1].item())
    value = over["objective"].where(over["feasible"])
    best = over.isel(value.argmin(dim=...)) if np.isfinite(value).any() else over.isel({x: 0, y: 0})
    return grid_points(over, over, {**baseline, "objective": 1.0}, marks, best)


def _worse_than_pd(metrics: comparison.Values, baseline: comparison.Values, about: mc.MetricTable) -> list[str]:
    worse, _ = comparison.differences(metrics, baseline, about)
    return [f"worse than pd: {', '.join(worse)}"] if worse else []


def robust_page(found: Tuned, summed: xr.Dataset, outcome: Sequence[str], origin: Origin) -> Page:
    """Return the page of a search over an ensemble.

    `summed` is of walks that the search never saw, see `tuning.comparisons.judge.summary`; `outcome` says in lines how
    it went on them, what a force sensor is worth, which limits bind or break.
    """
    rivals: comparison.Compared = {"robust": (by_name(found.gains), {})}
    if not found.law:
        control = found.scenario.control
        rivals = {**rivals, "config": ({key: getattr(control, key) for key in mc.Gains.AXES}, {})}
    verdict, *notes = sentences(outcome)
    return Page(
        title=f"Robust gains for {origin.name}: {found.search.method}, {found.search.space}", origin=origin,
        verdict=verdict, scenario=found.scenario, notes=notes,
        facts={"seed": found.search.seed, "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})"},
        tables=[judged_table(summed, found.problem.metrics), comparison.gains_table(rivals, found.law)],
    )  # fmt: skip


def shown(metrics: mc.MetricTable) -> list[str]:
    """Return the names of the metrics that the table has: the main ones, and those of the user's own."""
    return [*SHOWN, *(name for name in metrics.names if name not in mc.METRICS.names)]


def summed_table(summed: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return the table of the walks of a fresh draw: of laws that are compared, or of gains of one law."""
    return laws_table(summed, metrics) if "difference" in summed else judged_table(summed, metrics)


def judged_table(summed: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return mean and worst of the main metrics, the first gains' with their change against the config's."""
    names = summed["gains"].values.tolist()
    columns = ["metric", "unit", "of the members", names[0], "vs config %", *names[1:]]
    statistics = {"mean": "mean", "worst": f"worst {summed.attrs['worst_share']:.0%}"}

    def row(values: xr.DataArray, *words: str) -> list[str]:
        numbers = {name: float(values.sel(gains=name)) for name in names}
        first, *others = map(number, numbers.values())
        return [*words, first, change(numbers[names[0]], numbers["config"]), *others]

    sections = []
    if "objective" in summed:
        sections.append(("", [row(summed["objective"], "objective", "", "mean and worst")]))
    for name in shown(metrics):
        about = metrics.in_words(name), unit(name, metrics)
        rows = [row(summed[name].sel(statistic=key), *about, label) for key, label in statistics.items()]
        sections.append(("", rows))
    return Table("On the walks of a fresh draw", columns, sections, 3)


LAWS_SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque")


def of_laws(metrics: mc.MetricTable) -> list[str]:
    """Return the names of the metrics by which laws are compared: the main ones, and those of the user's own."""
    return [*LAWS_SHOWN, *(name for name in metrics.names if name not in mc.METRICS.names)]


def rows_of_laws(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return a comparison of laws as plain rows: a metric, a statistic, a law, and its numbers."""
    rows: list[dict[str, Any]] = []
    dims = ("metric", "statistic", "gains")
    for place in np.ndindex(*(table.sizes[name] for name in dims)):
        if np.isfinite(table["value"].values[place]):
            words = {name: str(table[name].values[index]) for name, index in zip(dims, place, strict=True)}
            numbers = {
                name: table[name].values[place].item() for name in ("value", "difference", "low", "high", "real")
            }
            rows.append(words | numbers)
    return rows


def to_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return plain rows as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def laws_table(table: xr.Dataset, metrics: mc.MetricTable = mc.METRICS) -> Table:
    """Return mean and worst of each metric by law, each with its difference from retuned pd and the interval, in %.

    Better hardware and the scenario's own pd have a row of the objective and of the lost walks alone.
    """
    base, sections = table.attrs["baseline"], []
    versus = f"vs {base} %"
    columns = ["metric", "law", "mean", versus, f"worst {table.attrs['worst_share']:.0%}", versus]
    for name in table["metric"].values.tolist():
        own = table.sel(metric=name)
        words = [metrics.in_words(name), unit(name, metrics)] if name in metrics.names else [_NOT_METRICS[name], ""]
        rows: list[list[str]] = []
        for law in table["gains"].values.tolist():
            if name in metrics.names and law in (*HARDWARE, PD):
                continue
            cells = [
                cell
                for key in ("mean", "worst")
                for cell in _versus(own.sel(statistic=key, gains=law), own.sel(statistic=key, gains=base))
            ]
            rows.append([words[len(rows)] if len(rows) < len(words) else "", law, *cells])
        sections.append(("", rows))
    caption = f"On {table.attrs['members_compared']} walks that no search saw; ~: no real difference"
    return Table(caption, columns, sections, 2)


_NOT_METRICS = {"objective": "objective", "failed": "share lost"}


def _versus(own: xr.Dataset, base: xr.Dataset) -> tuple[str, str]:
    """Return a value, and its difference with the interval in per cent, "~" behind it where it is not real."""
    value, of = float(own["value"]), abs(float(base["value"]))
    if not np.isfinite(value):
        return "", ""
    if str(own["gains"].values) == str(base["gains"].values):
        return number(value), ""
    if not of:  # a share of no walks has no per cent of its own
        of = 1.0
    change, low, high = (100 * float(own[name]) / of for name in ("difference", "low", "high"))
    return number(value), f"{change:+.1f} [{low:.1f}, {high:.1f}]{' ' if bool(own['real']) else '~'}"


def notes_of_laws(found: Comparison, table: xr.Dataset) -> list[str]:
    """Return what a comparison of laws rests on, in lines."""
    points = {name: own.data.sizes["point"] for name, own in found.tuned.items()}
    same = len({*points.values()}) == 1
    spent = str(min(points.values())) if same else ", ".join(f"{name} {count}" for name, count in points.items())
    notes = [
        f"{spent} points of {found.problem.members} walks searched for each law; {table.attrs['members']} unseen "
        f"walks each; {table.attrs['level']:.0%} intervals hold for all rows of a column at once (max-t over "
        f"{table.attrs['resamples']} resamples of the walks; lost walks: McNemar's exact test)"
    ]
    pd, values = found.tuned[NAME], by_name(found.tuned[NAME].gains)
    notes.append("each law was searched once: another search may end elsewhere, which no interval here counts")
    notes.append(f"retuned pd: {', '.join(f'{name} {gain(values, name)}' for name in pd.problem.space.gains)}")
    if not same:
        notes.append("warning: searches that had converged ended early")
    broken = [name for name, own in found.tuned.items() if not own.feasible]
    if broken:
        notes.append(f"warning: no gains kept every limit in the search of {', '.join(broken)}")
    if left := table.attrs["members"] - table.attrs["members_compared"]:
        notes.append(f"warning: {left} walks in which something diverged count among those lost alone")
    if found.hardware:
        notes.append("better hardware walks with what was tuned for the present one, so it may be worth more")
    return notes


def laws_page(found: Comparison, table: xr.Dataset, verdict: str, notes: Sequence[str], origin: Origin) -> Page:
    """Return the page of a comparison of laws: what it says, the table, and the gains of each."""
    sections = []
    for name, own in found.tuned.items():
        known = labels(own.problem.law)
        rows = [
            ["", gain_name, known[gain_name][0] if gain_name in known else "", gain(by_name(own.gains), gain_name)]
            for gain_name in own.problem.space.gains
        ]
        rows[0][0] = name
        sections.append(("", rows))
    steps = ", ".join(f"{name} {own.env_steps:,}" for name, own in found.tuned.items())
    assert found.search is not None
    return Page(
        title=f"Laws compared on {origin.name}: {', '.join(found.laws)} beside retuned pd", origin=origin,
        verdict=sentences([verdict])[0], scenario=found.scenario, notes=sentences(notes),
        tables=[laws_table(table, found.problem.metrics),
                Table("Gains found", ["law", "gain", "unit", "value"], sections, 3)],
        facts={"precision": "float32", "seed": found.search.seed, "env-steps": steps},
    )  # fmt: skip


def pareto_page(
    found: Front, histories: Mapping[str, np.ndarray], walks: Mapping[str, mc.Trajectory], origin: Origin
) -> Page:
    """Return the page of a front, with the time histories on it, and config and pd walked in double precision."""
    about, front, knee = found.problem.metrics, found.data, found.knee
    better, against = found.asked.better, found.asked.against
    metrics = {walk: mc.metrics(trajectory, about) for walk, trajectory in walks.items()}
    texts = []
    for name in (better, against):
        walked = {"knee": {name: front[name].values[knee].item()}, **metrics}  # nothing fails on a front
        texts.append(f"{about.in_words(name)} {comparison.against(name, 'knee', walked, about)}")
    points = listed_points(front, histories, knee, trade=(against, better), about=about)
    return Page(
        title=f"What {about.in_words(better)} costs in {about.in_words(against)}: {origin.name}", origin=origin,
        verdict=f"The front of {front.sizes['front']} points bends at {'; '.join(texts)}.",
        scenario=found.scenario, notes=sentences([of_front(found)]),
        tables=[front_table(front, knee, found.asked.points, about)],
        explorers={"The front": explorer(walks, metrics, shown=("pd",), points=points, about=about)},
        facts={"precision": "float32 (search), float64 (front)", "seed": found.search.seed},
    )  # fmt: skip


def front_table(front: xr.Dataset, knee: int, points: int, about: mc.MetricTable = mc.METRICS) -> Table:
    """Return so many points of a front, the knee among them, with the config's gains, pd and pd retuned below."""
    traded, names = (front.attrs["against"], front.attrs["better"]), front.attrs["searched"].split()
    columns = ["", *(f"{about.in_words(name)} {unit(name, about)}".strip() for name in traded), *names]
    count = front.sizes["front"]

    def row(words: str, values: xr.Dataset, kind: str = "") -> list[str]:
        limb, diverged = (values.get(f"{kind}{name}") for name in ("detached_limb", "diverged"))
        lost = limb is not None and diverged is not None and (limb.item() >= 0 or bool(diverged.item()))
        return [words, *("failed" if lost else number(values[f"{kind}{name}"].item()) for name in traded)]

    on, places = [], np.linspace(0, count - 1, min(count, points)).round().astype(int)
    if knee not in places:
        places[abs(places - knee).argmin()] = knee
    for i in places.tolist():
        point = front.isel(front=i)
        gains = (gain({name: point[name].values}, name) for name in names)
        on.append([*row("knee" if i == knee else "", point), *gains])
    below = [row(name, front.sel(reference=name), "reference_") for name in ("config", "pd")]
    rival = without_sensor(front, knee, about)
    if rival is not None:
        joint = ", ".join(f"{name} {number(rival[f'without_{name}'].item())}" for name in ("kp", "kd"))
        below.append(row(f"pd, {joint}", rival, "without_"))
    caption = f"The front: {len(on)} of its {count} points, all of them in front.nc"
    return Table(caption, columns, [("", on), ("", [[*cells, *("" for _ in names)] for cells in below])], 1)
