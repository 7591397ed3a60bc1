"""`mjx-climb export`: gains in the form that a robot's controller takes."""

from pathlib import Path
from typing import Annotated, Literal

import typer


def export(
    gains: Annotated[Path, typer.Argument(metavar="GAINS", help="Gains file, as tune writes it.")],
    form: Annotated[
        Literal["ros2_control", "json", "csv"],
        typer.Option("--format", help="What to write: parameters of ros2_control's admittance_controller, or a table."),
    ] = "ros2_control",
    rate: Annotated[
        int,
        typer.Option("--update-rate", min=1, max=1_000_000, metavar="HZ", help="Update rate of the controller, Hz."),
    ] = 1000,
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the controller in the parameter file.")
    ] = "admittance_controller",
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write.", show_default="standard output")
    ] = None,
) -> None:
    """Write gains for the robot's own controller.

    ros2_control's admittance_controller integrates the law with explicit damping, so gains that are fine here may
    diverge there: those are refused, and you are told which update rate or virtual inertia would do.
    docs/ros2_control.md has the mapping of its parameters and frames to the law used here.

    \b
    Examples:
      mjx-climb export results/case_1_2-tune-gradient-isotropic/gains.yaml --update-rate 500
      mjx-climb export gains.yaml --format csv --out gains.csv
    """
    from mjx_climb.files import dataset
    from tuning.command_line.ending import InputError
    from tuning.gains import gains_file, gains_tables, ros2_control

    loaded = gains_file.load(gains)
    if form == "ros2_control":
        if not name.isidentifier():
            raise InputError(f"--name: expected letters, digits and underscores, got {name!r}")
        ros2_control.check(loaded, rate, str(gains))
        text = ros2_control.write(loaded, rate, name)
    else:
        text = {"json": gains_tables.write_json, "csv": gains_tables.write_csv}[form](loaded)
    if out is None:
        typer.echo(text, nl=False)
    else:
        dataset.write_text_atomically(out, text)
