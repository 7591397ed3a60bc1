"""`mjx-climb margins`: how much worse hardware may be before gains fail."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from tuning.judged.linear_margins import Stable
    from tuning.judged.margins import Margin


def margins(
    config: options.Config,
    gains: options.GainsFile = None,
    retuned_pd: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Gains file whose kp and kd pd has too, in a curve of its own."),
    ] = None,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    law: options.LawFile = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-margins"),
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Find how late, slow and weak a robot's hardware may be before gains fail.

    Makes force delay, command delay, control period and joint gains worse, one at a time, on top of the scenario's own
    hardware, and says up to where no gripper is torn off, up to where the force varies less than under pd on the same
    hardware, and up to where the linearised loop is stable. Warns where walks, or the linearised loop, bear less than
    twice what the hardware has.

    Writes to DIR the margins (margins.json), all walks (margins.nc), and the force variation over each quantity, for
    the gains, pd and the config's own gains (margins, in the formats of --figures).

    \b
    Examples:
      mjx-climb margins case_1_2 --gains gains.yaml
      mjx-climb margins case_1_2 --gains gains.yaml --hardware dynamixel_x --json
    """
    with options.reserved_stdout() as stdout:
        options.start_devices()
        from mjx_climb.control import PD
        from tuning.command_line import progress, report
        from tuning.gains import gains_file
        from tuning.judged import linear_margins
        from tuning.judged import margins as judged
        from tuning.output import margins as output
        from tuning.output.folder import check_own, write_config

        scenario, own, _ = options.asked(config, controller, changes, hardware, law)
        given = {} if gains is None else gains_file.load(gains, own)
        others = {} if gains is None or own is not None else {"config": judged.Walker(None, {})}
        if retuned_pd is not None:
            others["retuned pd"] = judged.Walker(PD(), _joint_gains(retuned_pd))
        engine = options.engine_from(engine)
        formats = options.figures_from(figures)
        out = out or Path("results") / f"{config.stem}-margins"
        check_own(out, "margins.json")
        scenario = write_config(scenario, out, own)

        console = report.console(stderr=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)
        with meter.stage("margins") as told:
            found = judged.find(scenario, given, law=own, others=others, engine=engine, progress=told)
        with meter.stage("linearised loop", unit="quantities") as told:
            stable = linear_margins.find(scenario, given, found.margins, law=own, engine=engine, progress=told)
        with meter.stage("drawing", compiles=False):
            text = output.write(found, stable, out, "config" if gains is None else gains.stem, formats)

        tables = console if json else report.console(file=stdout)
        tables.print(margins_table(found.margins, stable))
        for line in output.warnings(found, stable):
            tables.print(f"warning: {line}", soft_wrap=True)
        console.print(
            f"written to {out}: {output.FILES}, {', '.join(f'margins.{kind}' for kind in formats)}, config.yaml",
            soft_wrap=True,
        )
        if json:
            print(text, file=stdout)


def margins_table(margins: "dict[str, Margin]", stable: "dict[str, Stable]") -> "Table":
    """Return margins beside the scenario's hardware: by walks, and of the linearised loop."""
    from tuning.command_line.report import plain_table
    from tuning.judged.margins import QUANTITIES, in_words, with_unit

    table = plain_table("", "hardware", "holds up to", "better than pd up to", "linearised: stable up to")
    for name, margin in margins.items():
        reached = [in_words(name, margin.worst, value) for value in (margin.holds, margin.better)]
        reached.append(in_words(name, stable[name].tried, stable[name].up_to))
        table.add_row(QUANTITIES[name].title, with_unit(name, margin.own), *reached)
    return table


def _joint_gains(file: Path) -> dict[str, float]:
    from tuning.gains import gains_file

    values = gains_file.by_name(gains_file.load(file))
    if missing := [name for name in ("kp", "kd") if name not in values]:
        raise InputError(
            f"--retuned-pd: expected a gains file with kp and kd, {file} has no {' and no '.join(missing)}"
        )
    return {name: values[name] for name in ("kp", "kd")}
