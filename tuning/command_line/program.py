"""All commands, one file each, and how they end.

Exit codes: 0 done; 1 what doctor gives where something is wrong, and run where its walk failed; 2 bad input, with one
line on stderr; 130 interrupted, with a line that says what was kept.
Commands import JAX and all that is heavy when they run, so that `--help` is quick.
"""

import contextlib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from tuning.command_line import interruption
from tuning.command_line.ending import InputError, Interrupted, leave_output, user_error
from tuning.command_line.typed import ARGUMENTS

NOTHING_KEPT = "interrupted: nothing was kept; the same command starts again"
PACKAGES = ("mjx-climb", "mujoco", "mujoco-mjx", "jax")  # whose versions are told
COMMANDS = {  # what each does; the function of its name in the module of its name is it
    "run": "Walk one robot through a scenario.",
    "sweep": "Walk a grid of stiffness and damping, and map it.",
    "merge": "Put shards of sweep or judge together.",
    "tune": "Search the gains of the controller.",
    "judge": "Judge gains on walks that no search saw.",
    "pareto": "Search the front of two metrics.",
    "schedule": "Tune gains for pairs of gravity and cargo.",
    "plot": "Draw the pictures of a result again.",
    "margins": "Find how bad hardware may be before gains fail.",
    "reproduce": "Walk the paper's cases and judge its claims.",
    "export": "Write gains for the robot's own controller.",
    "robot": "Make a robot's own file ready to walk.",
    "schema": "Print the schema of scenarios, for editors.",
    "bench": "Measure speed beside MuJoCo and MJX.",
    "doctor": "Examine this installation.",
}


def program(only: str | None = None) -> typer.Typer:
    """Return the program with all commands, or with the names of all and the options of one."""
    made = typer.Typer(
        name="mjx-climb",
        help="Simulate a limbed climbing robot, and find the admittance gains that keep it on the wall.",
        epilog="\b\nExamples:\n  mjx-climb doctor\n  mjx-climb run case_1_2\n  mjx-climb tune case_1_2 --space diagonal"
        "\n\n"
        "Each command has its own help with examples: mjx-climb run --help",
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        callback=_program,
    )
    for name, short_help in COMMANDS.items():
        loaded = importlib.import_module(f"tuning.command_line.{name}").COMMAND if only in (None, name) else _not_loaded
        made.command(name, short_help=short_help)(loaded)
    return made


def _not_loaded() -> None:
    """Stand for a command that was not asked for: its options would be read for nothing."""


def _asked(arguments: Sequence[str]) -> str:
    """Return the command that is asked for, by arguments or by a shell that completes them, empty without one."""
    completed = [os.environ.get(name, "") for name in ("COMP_WORDS", "_TYPER_COMPLETE_ARGS")]
    return next((word for word in (*arguments, *" ".join(completed).split()) if word in COMMANDS), "")


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        found = {name: next(iter(metadata.distributions(name=name)), None) for name in PACKAGES}
        texts = [f"{name} {each.version if each else '(not installed as a package)'}" for name, each in found.items()]
        typer.echo(", ".join(texts))
        raise typer.Exit()


def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the versions and exit.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str]) -> int:
    """Run the program and return its exit code; what went wrong is said on standard error."""
    ARGUMENTS.set(tuple(arguments))
    try:
        _check_surroundings(arguments)
        code = program(_asked(arguments))(arguments or ["--help"], prog_name="mjx-climb", standalone_mode=False)
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
