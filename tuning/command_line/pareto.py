"""`mjx-climb pareto`: what one metric costs in terms of another."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tuning.command_line import completion, options
from tuning.command_line.ending import InputError, Interrupted
from tuning.command_line.tune import SpaceName

if TYPE_CHECKING:
    import xarray as xr
    from rich.table import Table

ROWS = 20


def pareto(
    config: options.Config,
    better: Annotated[
        str, typer.Option(metavar="METRIC", help="Metric to better.", autocompletion=completion.metric)
    ] = "force_variation",
    against: Annotated[
        str, typer.Option(metavar="METRIC", help="Metric that it is traded against.", autocompletion=completion.metric)
    ] = ("base_deviation"),
    points: Annotated[int, typer.Option(min=2, max=200, metavar="N", help="Limits along the front.")] = 12,
    space: Annotated[
        SpaceName | None, typer.Option(help="Which axes share their gains.", show_default="isotropic")
    ] = None,
    search: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the search, YAML: bounds, pins, limits, seed.")
    ] = None,
    controller: options.Controller = None,
    changes: options.Set = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-pareto")
    ] = None,
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Search the Pareto front of two metrics, by gradients under a row of limits, all in one batch.

    Prints the front and its knee, the point furthest from the line between the front's ends, and writes to DIR the
    front with its gains and everything that was walked (front.nc), a picture (front.png, .svg, .pdf) and the gains
    at the knee (gains.yaml). Finished rounds are kept: after Ctrl-C the same command goes on.

    METRIC is any number that run prints, detached_at apart.

    \b
    Examples:
      mjx-climb pareto case_1_2
      mjx-climb pareto case_2 --against cost_of_transport --space split
    """
    with options.reserved_stdout() as stdout:
        import mjx_climb as mc
        from mjx_climb import plots
        from mjx_climb.files import dataset, scenario_files
        from tuning.command_line import progress, report
        from tuning.gains import gains_file
        from tuning.output import folder
        from tuning.problem import search as settings
        from tuning.report import ensemble_pictures, page
        from tuning.report import pareto as pages
        from tuning.searches import finished_parts, tune
        from tuning.searches import pareto as fronts

        begin, kept = time.perf_counter(), 0
        scenario = options.scenario_from(config, controller, changes)
        engine = options.engine_from(engine)
        wanted = options.search_from(search, space, scenario, config)
        for option, metric in (("--better", better), ("--against", against)):
            settings.check_metrics(settings.make({"weights": {metric: 1.0}}), mc.METRICS, option)
        if better == against:
            raise InputError(f"--against: expected another metric than {better}")
        out = out or Path("results") / f"{config.stem}-pareto"
        dataset.check_folder(out)
        console = report.console(stderr=True)
        meter = progress.Meter(console)
        with meter.stage("baseline"), options.weighing("--better"):
            tune.problem_of(scenario, fronts.bettering(better, wanted), engine=engine)
        scenario = scenario_files.copied(scenario, out)
        dataset.write_text_atomically(out / "config.yaml", scenario_files.portable_yaml(scenario, out))

        def told(done: int, total: int, phase: str) -> None:
            nonlocal kept
            kept = done
            show(done, total, f"{phase} {done}/{total}")

        try:
            with meter.stage("front", unit="rounds") as show:
                front = fronts.front(
                    scenario, wanted, better=better, against=against, points=points, engine=engine, out=out,
                    progress=told,
                )  # fmt: skip
            chosen = fronts.knee(front[against].values, front[better].values)
            dataset.save(front, out / "front.nc")
            comment = f"mjx-climb pareto {config.name}: {better} against {against}, the knee of the front"
            gains_file.save(fronts.gains_of(front, chosen), out / "gains.yaml", comment)
            plots.save_figure(ensemble_pictures.plot_front(front), out / "front")
            dataset.write_text_atomically(out / "search.yaml", wanted.to_yaml())
            pd = scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})
            again = f"mjx-climb pareto config.yaml --search search.yaml --better {better} --against {against} "
            again += f"--points {points}{options.engine_option(engine)} --out again"
            with meter.stage("report"):
                on_front = mc.Gains(**{n: front[n].values for n in (*mc.Gains.AXES, "kp", "kd") if n in front})
                written = pages.page(
                    front, chosen, mc.rollout_histories(scenario, on_front, engine=engine),
                    {name: mc.rollout(s, engine=engine) for name, s in (("pd", pd), ("config", scenario))},
                    page.Table("The front", *front_rows(front, chosen), 1), scenario,
                    origin=folder.complete(options.origin(config.stem, again), "", "", scenario, out),
                    seed=wanted.seed,
                    pictures={"The front, and all that was walked on the way.": out / "front.svg"},
                )  # fmt: skip
                page.write(written, out)
            finished_parts.clear(out)
        except KeyboardInterrupt:
            raise Interrupted(f"{kept} rounds are kept in {out}; the same command goes on from there") from None

        tables = console if json else report.console(file=stdout)
        tables.print(front_table(front, chosen))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(
            f"written to {out} in {seconds}: report.html, front.nc, front.png, .svg, .pdf, gains.yaml, config.yaml, "
            "search.yaml",
            soft_wrap=True,
        )
        if json:
            names = (against, better, "stiffness", "damping", "inertia")
            rows = [{n: front[n].values[i] for n in names} for i in range(front.sizes["front"])]
            reference = {
                name: {n: front[f"reference_{n}"].sel(reference=name).item() for n in (against, better)}
                for name in ("config", "pd")
            }
            print(report.to_json({"front": rows, "knee": chosen, **reference}), file=stdout)


def front_table(front: "xr.Dataset", chosen: int) -> "Table":
    """Return the table of a front, some twenty points of it, with the config's gains and pd below."""
    from tuning.command_line.report import plain_table

    columns, sections = front_rows(front, chosen)
    table = plain_table(*columns)
    for _, rows in sections:
        for row in rows:
            table.add_row(*row, end_section=row is rows[-1])
    return table


def front_rows(front: "xr.Dataset", chosen: int) -> tuple[list[str], list[tuple[str, list[list[str]]]]]:
    """Return the same as columns and sections of text."""
    import numpy as np

    from tuning.report.numbers import gain, number, unit

    better, against = front.attrs["better"], front.attrs["against"]
    columns = ["", *(f"{name} {unit(name)}".strip() for name in (against, better)), "stiffness", "damping"]
    on = []
    count = front.sizes["front"]
    shown = sorted({*np.linspace(0, count - 1, min(count, ROWS)).round().astype(int).tolist(), chosen})
    for i in shown:
        gains = {name: front[name].values[i] for name in ("stiffness", "damping")}
        values = (number(front[n].values[i]) for n in (against, better))
        on.append(["knee" if i == chosen else "", *values, *(gain(gains, name) for name in gains)])
    references = []
    for name in ("config", "pd"):
        row = [number(front[f"reference_{n}"].sel(reference=name).item()) for n in (against, better)]
        references.append([name, *row, "", ""])
    return columns, [("", on), ("", references)]
