"""`mjx-climb tune --ensemble`: a search over an ensemble of walks, judged on a fresh draw."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from tuning.command_line import options
from tuning.command_line.ending import Interrupted

if TYPE_CHECKING:
    import xarray as xr
    from rich.table import Table

    import mjx_climb as mc
    from tuning.command_line.progress import Meter
    from tuning.problem.ensemble import Ensemble
    from tuning.problem.search import Search
    from tuning.searches.result import Result
    from tuning.searches.retuned_pd import Worth
    from tuning.searches.tune import Progress

SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "peak_joint_torque", "cost_of_transport",
         "base_deviation", "joint_limit_margin")  # fmt: skip


def tune_robustly(
    scenario: "mc.Scenario", wanted: "Search", ensemble: "Ensemble", judges: int, out: Path, engine: str,
    name: str, line: "Callable[[Progress], str]", meter: "Meter", stdout: TextIO, *, json: bool,
    law: "mc.Law | None" = None,
) -> None:  # fmt: skip
    """Search, judge the result beside the config's gains and pd, and write both."""
    from mjx_climb import plots
    from mjx_climb.files import dataset
    from mjx_climb.quantities.parameters import gains as gains_of
    from tuning.command_line import progress, report
    from tuning.gains import gains_file
    from tuning.output import folder
    from tuning.report import ensemble_pictures, page, search_pictures
    from tuning.report import tune as pages
    from tuning.searches import finished_parts, retuned_pd, robust

    begin, kept = time.perf_counter(), 0
    dataset.write_text_atomically(out / "ensemble.yaml", ensemble.to_yaml())

    def round_done(now: "Progress") -> None:
        nonlocal kept
        kept = now.rounds
        show(now.rounds, now.rounds_in_all, line(now))

    try:
        with meter.stage("search", unit="rounds") as show:
            found = robust.search(scenario, ensemble, wanted, law=law, engine=engine, out=out, progress=round_done)
        comment = f"{wanted.method}, {wanted.space}, {ensemble.members} members, objective {found.value:.4f} (pd: 1)"
        gains_file.save(found.gains, out / "gains.yaml", f"mjx-climb tune --ensemble: {comment}", law)
        found.save(out / "search.nc")
        if found.interrupted:
            raise Interrupted(
                f"the best of {kept} rounds is in {out}: objective {found.value:.4f}, gains.yaml; "
                "the same command goes on from there"
            )
        with meter.stage("retuned pd", unit="rounds") as show:
            retuned = robust.retuned(found, ensemble, engine=engine, out=out, progress=round_done)
        pd = {} if retuned is None else {retuned_pd.NAME: retuned.gains}
        goal = robust.goal(scenario, ensemble, found.search, engine)
        with meter.stage("fresh draw") as told:
            rivals = {"robust": found.gains, "config": gains_of(scenario) if law is None else law}
            how: dict[str, Any] = {"pd": pd, "law": law, "engine": engine}
            judged = robust.judge(scenario, rivals, ensemble, members=judges, progress=told, **how)
        with meter.stage("its own draw") as told:
            seen = robust.walked(scenario, {"robust": found.gains}, ensemble, law=law, engine=engine, progress=told)
        summed = robust.summary(judged).assign(
            objective=robust.scores(judged, goal), broken=robust.broken(judged, goal)
        )
        lines = limits_in_words(summed, robust.binding(seen, goal, "robust"))
        worth = None
        if retuned is not None:
            without = _compared_by(summed, retuned_pd.NAME)
            worth = retuned_pd.worth(_compared_by(summed, "robust"), without, retuned)
            lines.insert(0, worth.in_words)
        dataset.save(judged, out / "judged.nc")
        text = report.to_json(_plain(summed, found, worth))
        dataset.write_text_atomically(out / "summary.json", text + "\n")
        with meter.stage("drawing", compiles=False):
            plots.save_figure(search_pictures.plot_convergence(found), out / "convergence")
            plots.save_figure(ensemble_pictures.plot_judged(judged), out / "judged")
        names = summed["gains"].values.tolist()
        failed = ", ".join(f"{n} {share:.0%}" for n, share in zip(names, summed["failed"].values, strict=True))
        verdict = f"{judges} walks each that the search never saw; would lose a gripper, or diverge: {failed}"
        with meter.stage("report", compiles=False):
            again = "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again"
            origin = options.origin(name, again + options.engine_option(engine))
            written = pages.robust_page(
                found, page.Table("On the walks of a fresh draw", *robust_rows(summed), 3), f"{verdict}.",
                notes=[f"{line[0].upper()}{line[1:]}." for line in lines],
                origin=folder.complete(origin, "", "", scenario, out),
                pictures={"How the search converged.": out / "convergence.svg",
                          "Share of the fresh walks below a value.": out / "judged.svg"},
            )  # fmt: skip
            page.write(written, out)
        retuned_pd.forget(out)
        finished_parts.clear(out)
    except KeyboardInterrupt:
        raise Interrupted(f"{kept} rounds are kept in {out}; the same command goes on from there") from None

    console = meter.console
    tables = console if json else report.console(file=stdout)
    tables.print(robust_table(summed))
    tables.print(verdict, soft_wrap=True)
    for words in lines:
        tables.print(words, soft_wrap=True)
    if not found.feasible:
        tables.print("warning: no gains kept every limit in every member of the search")
    console.print(
        f"written to {out} in {progress.duration(time.perf_counter() - begin)}: report.html, gains.yaml, search.nc, "
        "judged.nc, summary.json, convergence and judged (.png, .svg, .pdf), config.yaml, search.yaml, ensemble.yaml",
        soft_wrap=True,
    )
    if json:
        print(text, file=stdout)


def robust_table(summed: "xr.Dataset") -> "Table":
    """Return mean and worst of the main metrics, each with its change against the config's gains."""
    from tuning.command_line.report import plain_table

    columns, sections = robust_rows(summed)
    table = plain_table(*columns[:2], "", *columns[3:])
    table.columns[2].header = columns[2]
    for _, rows in sections:
        for row in rows:
            table.add_row(*row, end_section=row is rows[-1])
    return table


def robust_rows(summed: "xr.Dataset") -> tuple[list[str], list[tuple[str, list[list[str]]]]]:
    """Return the same as columns and sections of text."""
    from tuning.report.numbers import change, number, unit

    names = summed["gains"].values.tolist()
    columns = ["metric", "unit", "of the members", names[0], "vs config %", *names[1:]]
    values = {name: float(summed["objective"].sel(gains=name)) for name in names}
    scores = [number(value) for value in values.values()]
    scores.insert(1, change(values[names[0]], values["config"]))
    sections = [("", [["objective", "", "mean and worst", *scores]])]
    for metric in SHOWN:
        rows = []
        for statistic, label in (("mean", "mean"), ("worst", f"worst {summed.attrs['worst_share']:.0%}")):
            values = {n: float(summed[metric].sel(gains=n, statistic=statistic)) for n in names}
            cells = [number(v) for v in values.values()]
            cells.insert(1, change(values[names[0]], values["config"]))
            rows.append([metric, unit(metric), label, *cells])
        sections.append(("", rows))
    return columns, sections


def limits_in_words(summed: "xr.Dataset", binding: list[str]) -> list[str]:
    """Return which limits hold the result where it is, and a warning for each that it breaks in the fresh draw."""
    lines = [f"held by its limits: {'; '.join(binding)}"] if binding else []
    shares = summed["broken"].sel(gains="robust")
    for limit, share in zip(shares["limit"].values.tolist(), shares.values.tolist(), strict=True):
        if share:
            lines.append(f"warning: {share:.1%} of the fresh walks break {limit}")
    return lines


def _compared_by(summed: "xr.Dataset", name: str) -> dict[str, float]:
    own = summed.sel(gains=name)
    return {
        "objective": float(own["objective"]),
        "force_variation": float(own["force_variation"].sel(statistic="mean")),
    }


def _plain(summed: "xr.Dataset", found: "Result", worth: "Worth | None") -> dict[str, Any]:
    names = summed["gains"].values.tolist()
    result = {
        name: {
            "failed": float(summed["failed"].sel(gains=name)),
            "objective": float(summed["objective"].sel(gains=name)),
            "broken_limits": dict(
                zip(summed["limit"].values.tolist(), summed["broken"].sel(gains=name).values.tolist(), strict=True)
            ),
            **{s: {m: float(summed[m].sel(gains=name, statistic=s)) for m in SHOWN} for s in ("mean", "worst")},
        }
        for name in names
    }
    from tuning.gains.gains_file import by_name

    gains = by_name(found.gains)
    search = {"objective": found.value, "feasible": found.feasible, "env_steps": found.env_steps, "gains": gains}
    return {**result, "search": search} | ({} if worth is None else {"force_sensor": worth._asdict()})
