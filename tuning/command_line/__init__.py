"""The program `mjx-climb`: one file per command, and here how they end.

Exit codes: 0 done; 1 what doctor gives where something is wrong; 2 bad input, with one line on stderr; 130 interrupted,
with a line that says what was kept.
Commands import JAX and all that is heavy when they run, so that `--help` is quick.
"""

import signal
import sys
import threading
from collections.abc import Sequence
from typing import Annotated, NoReturn

import typer

from tuning.command_line import bench, doctor, export, options, pareto, reproduce, run, schedule, schema, sweep, tune
from tuning.command_line.ending import Interrupted, user_error

app = typer.Typer(
    name="mjx-climb",
    help="Simulate a limbed climbing robot, and find the admittance gains that keep it on the wall.",
    epilog="\b\nExamples:\n  mjx-climb doctor\n  mjx-climb run case_1_2\n  mjx-climb tune case_1_2 --space diagonal\n\n"
    "Each command has its own help with examples: mjx-climb run --help",
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
app.command("run", short_help="Walk one robot through a scenario.")(run.run)
app.command("sweep", short_help="Walk a grid of stiffness and damping, and map it.")(sweep.sweep)
app.command("tune", short_help="Search the gains of the controller.")(tune.tune)
app.command("pareto", short_help="Search the front of two metrics.")(pareto.pareto)
app.command("schedule", short_help="Tune gains for pairs of gravity and cargo.")(schedule.schedule)
app.command("reproduce", short_help="Walk the paper's cases and judge its claims.")(reproduce.reproduce)
app.command("export", short_help="Write gains for the robot's own controller.")(export.export)
app.command("schema", short_help="Print the schema of scenarios, for editors.")(schema.schema)
app.command("bench", short_help="Measure speed beside MuJoCo and MJX.")(bench.bench)
app.command("doctor", short_help="Examine this installation.")(doctor.doctor)


def _version(wanted: bool) -> None:
    if not wanted:
        return
    import importlib.metadata

    versions = []
    for name in ("mjx-climb", "mujoco", "mujoco-mjx", "jax"):
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} (not installed as a package)")
    typer.echo(", ".join(versions))
    raise typer.Exit()


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the versions and exit.")
    ] = False,
) -> None:
    pass


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program and exit."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does
    options.ARGUMENTS.set(tuple(arguments))
    try:
        code = app(arguments or ["--help"], prog_name="mjx-climb", standalone_mode=False)
    except (Interrupted, KeyboardInterrupt) as interrupt:
        _say(f"interrupted: {interrupt}" if str(interrupt) else "interrupted")
        sys.exit(130)
    except Exception as error:
        if (message := user_error(error)) is None:
            raise
        _say(f"error: {message}")
        sys.exit(2)
    if code == 130:  # a KeyboardInterrupt that typer caught
        _say("interrupted: nothing was kept; the same command starts again")
    sys.exit(code or 0)


def _say(text: str) -> None:
    print(f"mjx-climb: {text}", file=sys.stderr)
