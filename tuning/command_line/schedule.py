"""`mjx-climb schedule`: which gains to load when."""

import itertools
import math
import time
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError, kept_in
from tuning.command_line.tune import SpaceName

if TYPE_CHECKING:
    from rich.table import Table


def schedule(
    config: options.Config,
    gravity: Annotated[
        str | None,
        typer.Option(
            metavar="G,G,..", help="Gravities, ascending, 1 G = 9.81 m/s^2.", show_default="1e-6,1e-2,1/6,0.38,1"
        ),
    ] = None,
    cargo: Annotated[
        str | None, typer.Option(metavar="KG,KG,..", help="Masses of the cargo, ascending, kg.", show_default="0,0.5,1")
    ] = None,
    space: Annotated[
        SpaceName | None, typer.Option(help="Which axes share their gains.", show_default="isotropic")
    ] = None,
    search: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the search, YAML: weights, limits, bounds, seed.")
    ] = None,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-schedule"),
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Tune gains for every pair of gravity and cargo, all side by side in one batch.

    The config's gravity gives the direction, its cargo the time of loading. Prints the gains and what they change
    against pd, and against pd with kp and kd of its own for each pair, and writes to DIR the table (schedule.csv,
    schedule.yaml), all metrics and what the gains of one operating point are worth at another (schedule.nc), and a
    picture (schedule.png). Finished rounds are kept: after Ctrl-C the same command goes on.

    \b
    Examples:
      mjx-climb schedule case_1_2
      mjx-climb schedule case_2 --gravity 1e-6,1e-3,1 --cargo 0,1.5 --space split
    """
    with options.reserved_stdout() as stdout:
        options.start_devices()
        from tuning.command_line import progress, report
        from tuning.output import schedule as output
        from tuning.output.folder import check_own
        from tuning.searches import schedule as schedules

        begin = time.perf_counter()
        scenario, user_law, table = options.asked(config, controller, changes, hardware, law, metric)
        engine, formats = options.engine_from(engine), options.figures_from(figures)
        wanted = options.search_from(search, space, scenario, config, user_law, table)
        levels = schedules.GRAVITIES if gravity is None else _numbers("--gravity", gravity, above=0.0)
        loads = schedules.CARGO if cargo is None else _numbers("--cargo", cargo, least=0.0)
        out = out or Path("results") / f"{config.stem}-schedule"
        check_own(out, "schedule.nc")
        console = report.console(stderr=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)
        with meter.stage("baseline"), options.weighing(search or config):
            asked = schedules.operating_points(
                scenario, wanted, levels, loads, law=user_law, metrics=table, engine=engine
            )
        with kept_in(out, "rounds") as kept:
            with meter.stage("schedule", unit="rounds") as show:
                found = output.Scheduled(schedules.run(asked, out=out, progress=kept.phases(show)), asked)
            found.write(out, figures=formats, stage=meter.stage)

        rows = schedules.rows(found.data)
        tables = console if json else report.console(file=stdout)
        tables.print(schedule_table(rows, found.data.attrs["searched"].split()))
        tables.print(schedules.worth(found.data), soft_wrap=True)
        tables.print(_one_for_all(*schedules.one_for_all(found.data)))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {output.FILES}", soft_wrap=True)
        if json:
            print(report.to_json(rows), file=stdout)


def _one_for_all(level: float, load: float, loss: float) -> str:
    if loss < math.inf:
        return f"one for all: the gains of {level:g} G, {load:g} kg lose at most {loss:.3f} of pd's objective"
    return "one for all: every set of gains breaks a limit at some other operating point"


def schedule_table(rows: list[dict[str, Any]], gains: Sequence[str]) -> "Table":
    """Return the table of a schedule: the gains that were searched, and force variation against pd."""
    from tuning.command_line.report import change, gain, number, plain_table
    from tuning.searches.retuned_pd import NAME

    beside = ("variation\nN", "vs\nconfig %", "vs\nretuned %", "vs\npd %")
    table = plain_table("gravity\nG", "cargo\nkg", *gains, *beside, "")
    table.columns[-1].no_wrap = False  # words give way to numbers
    for row in rows:
        tuned, *others = (row["force_variation"][walk] for walk in ("tuned", "config", NAME, "pd"))
        cells = [f"{row['gravity_g']:.3g}", f"{row['cargo_kg']:.3g}", *(gain(row, name) for name in gains)]
        verdict = "" if row["feasible"] else "breaks limits"
        verdict += f" {row['on_bound']} on a bound" if row["on_bound"] else ""
        table.add_row(*cells, number(tuned), *(change(tuned, other) for other in others), verdict.strip())
    return table


def _numbers(option: str, text: str, *, above: float = -math.inf, least: float = -math.inf) -> list[float]:
    try:
        values = [float(Fraction(part.strip())) for part in text.split(",")]
    except (ValueError, ZeroDivisionError, OverflowError):
        raise InputError(f"{option}: expected numbers with commas between them, got {text!r}") from None
    if any(not low < high for low, high in itertools.pairwise(values)):
        raise InputError(f"{option}: expected ascending numbers, got {text!r}")
    if not (values[0] > above and values[0] >= least):
        bound = f"{least:g} or above" if least >= above else f"above {above:g}"
        raise InputError(f"{option}: expected numbers {bound}, got {text!r}")
    return values
