"""All commands, one file each, and how they end.

Exit codes: 0 done; 1 what doctor gives where something is wrong, and run where its walk failed; 2 bad input, with one
line on stderr; 130 interrupted, with a line that says what was kept.
Commands import JAX and all that is heavy when they run, so that `--help` is quick.
"""

import contextlib
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from tuning.command_line import (
    bench,
    doctor,
    export,
    interruption,
    judge,
    margins,
    merge,
    options,
    pareto,
    plot,
    reproduce,
    robot,
    schedule,
    schema,
    sweep,
    tune,
)
from tuning.command_line import run as walk
from tuning.command_line.ending import InputError, Interrupted, leave_output, user_error

NOTHING_KEPT = "interrupted: nothing was kept; the same command starts again"

app = typer.Typer(
    name="mjx-climb",
    help="Simulate a limbed climbing robot, and find the admittance gains that keep it on the wall.",
    epilog="\b\nExamples:\n  mjx-climb doctor\n  mjx-climb run case_1_2\n  mjx-climb tune case_1_2 --space diagonal\n\n"
    "Each command has its own help with examples: mjx-climb run --help",
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
app.command("run", short_help="Walk one robot through a scenario.")(walk.run)
app.command("sweep", short_help="Walk a grid of stiffness and damping, and map it.")(sweep.sweep)
app.command("merge", short_help="Put shards of sweep or judge together.")(merge.merge)
app.command("tune", short_help="Search the gains of the controller.")(tune.tune)
app.command("judge", short_help="Judge gains on walks that no search saw.")(judge.judge)
app.command("pareto", short_help="Search the front of two metrics.")(pareto.pareto)
app.command("schedule", short_help="Tune gains for pairs of gravity and cargo.")(schedule.schedule)
app.command("plot", short_help="Draw the pictures of a result again.")(plot.plot)
app.command("margins", short_help="Find how bad hardware may be before gains fail.")(margins.margins)
app.command("reproduce", short_help="Walk the paper's cases and judge its claims.")(reproduce.reproduce)
app.command("export", short_help="Write gains for the robot's own controller.")(export.export)
app.command("robot", short_help="Make a robot's own file ready to walk.")(robot.robot)
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


def run(arguments: Sequence[str]) -> int:
    """Run the program and return its exit code; what went wrong is said on standard error."""
    options.ARGUMENTS.set(tuple(arguments))
    try:
        _check_surroundings(arguments)
        code = app(arguments or ["--help"], prog_name="mjx-climb", standalone_mode=False)
        sys.stdout.flush()
    except (Interrupted, KeyboardInterrupt) as interrupt:
        _say(f"interrupted: {interrupt}" if str(interrupt) else NOTHING_KEPT)
        return interruption.CODE
    except Exception as error:
        message = user_error(error)
        if interruption.requested():  # it broke what this went wrong on, a program that it had started for example
            _say(f"interrupted: {message or type(error).__name__}")
            return interruption.CODE
        if message is None:
            raise
        _say(f"error: {message}")
        leave_output()
        return 2
    if code == interruption.CODE:  # a KeyboardInterrupt that typer caught
        _say(NOTHING_KEPT)
    elif interruption.requested():
        _say("interrupted: the command had come to its end, and all that it writes is written")
        return interruption.CODE
    return code or 0


def _check_surroundings(arguments: Sequence[str]) -> None:
    """Refuse what a command would fail on when its work is done.

    Raises:
        InputError: in one line, what.
    """
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")
    if sys.stdout is None:
        raise InputError("standard output: expected an open one, got a closed one (>/dev/null drops what is printed)")
    try:
        texts = {"the working folder": os.getcwd(), **{f"argument {n}": text for n, text in enumerate(arguments, 1)}}
    except OSError as error:
        raise InputError(f"the working folder: expected one that is there, got '{error.strerror}'") from None
    for name, text in texts.items():
        if text != text.encode(errors="replace").decode():
            raise InputError(f"{name}: expected UTF-8, which reports are written in, got {text!r}")


def _say(text: str) -> None:
    with contextlib.suppress(OSError):  # nobody can read it
        print(f"mjx-climb: {text}", file=sys.stderr, flush=True)
