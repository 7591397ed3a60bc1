"""`mjx-climb pareto`: what one metric costs in terms of another."""

import time
from pathlib import Path
from typing import Annotated

import typer

from tuning.command_line import completion, options
from tuning.command_line.ending import InputError, kept_in
from tuning.command_line.tune import SpaceName


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
    hardware: options.Hardware = None,
    changes: options.Set = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-pareto")
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Search the Pareto front of two metrics, by gradients under a row of limits, all in one batch.

    Prints the front and its knee, the point furthest from the line between the front's ends, and writes to DIR the
    front with its gains and everything that was walked (front.nc), a picture (front.png), the gains at
    the knee (gains.yaml), the front as JSON (summary.json), and all of it as a page for a browser (report.html).
    Finished rounds are kept: after Ctrl-C the same command goes on.

    METRIC is any number that run prints, detached_at apart, or one of --metric.

    \b
    Examples:
      mjx-climb pareto case_1_2
      mjx-climb pareto case_2 --against cost_of_transport --space split
    """
    with options.reserved_stdout() as stdout:
        options.start_devices()
        from tuning.command_line import progress, report
        from tuning.output import pareto as output
        from tuning.output.folder import check_own
        from tuning.problem import search as settings
        from tuning.report.pareto import front_table
        from tuning.searches import pareto as fronts

        begin = time.perf_counter()
        scenario, user_law, table = options.asked(config, controller, changes, hardware, law, metric)
        engine, formats = options.engine_from(engine), options.figures_from(figures)
        wanted = options.search_from(search, space, scenario, config, user_law, table)
        for option, name in (("--better", better), ("--against", against)):
            settings.check_metrics(settings.make({"weights": {name: 1.0}}), table, option)
        if better == against:
            raise InputError(f"--against: expected another metric than {better}")
        out = out or Path("results") / f"{config.stem}-pareto"
        check_own(out, "front.nc")
        console = report.console(stderr=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)
        with meter.stage("baseline"), options.weighing("--better"):
            asked = fronts.trade(
                scenario, wanted, better=better, against=against, law=user_law, metrics=table, engine=engine
            )
        with kept_in(out, "rounds") as kept:
            with meter.stage("front", unit="rounds") as show:
                front = output.Front(fronts.run(asked, points, out=out, progress=kept.phases(show)), asked)
            again = f"mjx-climb pareto config.yaml --search search.yaml --better {better} --against {against} "
            again += f"--points {points}{options.engine_option(engine)} --out again"
            front.write(out, origin=options.origin(config.stem, again), figures=formats, stage=meter.stage)

        tables = console if json else report.console(file=stdout)
        tables.print(report.from_page(front_table(front.data, front.knee, table)))
        tables.print(front.worth, soft_wrap=True)
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {output.FILES}", soft_wrap=True)
        if json:
            print(front.summary, file=stdout)
