"""All commands, how they were typed, and how they end.

Exit codes: 0 done; 1 of doctor where something is wrong, and of run where its walk failed; 2 bad input, with one
line on stderr; 130 interrupted, with a line on the work that was kept.
Commands import JAX and all that is heavy when they run, so that `--help` is quick.
"""

import contextlib
import errno
import importlib
import inspect
import logging
import os
import re
import shlex
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from mjx_climb.scenario.kinds import named_in
from tuning.command_line import interruption

if TYPE_CHECKING:
    from tuning.pages.page import Origin

ARGUMENTS: ContextVar[tuple[str, ...]] = ContextVar("ARGUMENTS", default=())  # as typed
# module and question of each command, as its decorator has them: to read its options would take too long
_HOMES = {
    name: (module, question)
    for (question, name), module in named_in(
        Path(__file__).parent, r'^@command\(\s*"([^"]+)"[\s\S]*?^def (\w+)\('
    ).items()
}
COMMANDS = {name: _HOMES[name][1] for name in sorted(_HOMES)}
_TRUE = ("1", "true", "t", "yes", "y", "on")  # as JAX reads its settings
_LONGEST = 1000  # characters of a line
_ALIKE = 0.75  # least likeness of two names that may be mistaken for each other
_OF_THE_USER = {"InputError", "ConfigError", "RobotError", "OutputError", "Refused", "LostProcess", "RenderingError",
                "InstallationError"}  # fmt: skip
# file, line and error at the end of a traceback in an error of JAX, which called a function back
_CALLED_BACK = re.compile(
    r'[Cc]allback[\s\S]*Traceback[\s\S]*File "([^"]+)", line (\d+)[^\n]*\n(?:[ \t][^\n]*\n)*(\S[^\n]*)'
)
_OUTPUT = (errno.ENOSPC, errno.EIO, errno.EDQUOT)  # of prints; typer ends quietly where a pipe is closed


class Grouped(TyperCommand):
    """A command whose help lists arguments and options under headings, and whose options have one value each."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse an option with two values, or with its opposite: neither would be without a word."""
        for parameter in self.params:
            names = {*parameter.opts, *parameter.secondary_opts}
            typed = [(name, words) for name, words in _by_option(args) if name in names and name.startswith("--")]
            flag = getattr(parameter, "is_flag", False)
            said = dict.fromkeys(name if flag else " ".join(words) for name, words in typed)
            if len(said) > 1 and not getattr(parameter, "multiple", False):
                raise InputError(f"{parameter.opts[0]}: expected one value, got {' and '.join(said)}")
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a section of help for each panel that parameters name."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            if (record := parameter.get_help_record(ctx)) is not None:
                sections.setdefault(getattr(parameter, "rich_help_panel", None) or "Options", []).append(record)
        for heading, records in sections.items():
            with formatter.section(heading):
                formatter.write_dl(records)


class InputError(ValueError):
    """An argument or option that cannot be used; in one line: option, expected, got."""


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
    for name, question in COMMANDS.items():
        if only not in (None, name):  # its options would be read for nothing
            made.command(name, short_help=question)(_program)
            continue
        function = getattr(importlib.import_module(f"tuning.command_line.{_HOMES[name][0]}"), name)
        whole = f"{question}\n\n{inspect.cleandoc(function.__doc__)}"
        made.command(name, cls=Grouped, help=whole, short_help=question)(function)
    return made


def versions_of(*packages: str) -> dict[str, str | None]:
    """Return the versions of packages, None for one that is not installed as such."""
    from importlib import metadata

    found: dict[str, str | None] = dict.fromkeys(packages)
    for name in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def in_words(versions: Mapping[str, str | None]) -> str:
    """Return versions in one line."""
    return ", ".join(f"{name} {version or '(not installed as a package)'}" for name, version in versions.items())


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(in_words(versions_of("mjx-climb", "mujoco", "mujoco-mjx", "jax")))
        raise typer.Exit()


def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the versions and exit.")
    ] = False,
) -> None:
    pass


def run(arguments: Sequence[str]) -> int:
    """Run the program and return its exit code; errors go to standard error."""
    ARGUMENTS.set(tuple(arguments))
    logging.getLogger("jax._src.callback").disabled = True  # it prints a failed callback, which `user_error` names
    # the command may stand in the words that a shell completes
    completed = " ".join(os.environ.get(name, "") for name in ("COMP_WORDS", "_TYPER_COMPLETE_ARGS"))
    asked = next((word for word in (*arguments, *completed.split()) if word in COMMANDS), "")
    try:
        _check_surroundings(arguments)
        code = program(asked)(arguments or ["--help"], prog_name="mjx-climb", standalone_mode=False)
        sys.stdout.flush()
    except (interruption.Interrupted, KeyboardInterrupt) as interrupt:
        _say(f"interrupted: {interrupt}" if str(interrupt) else interruption.NOTHING_KEPT)
        return interruption.CODE
    except SystemExit as ended:
        if {"typer", "click"} & {*_last_file(ended).split("/")}:  # which print completions, and end
            raise
        _say(f"error: expected own files that leave the program to its end, got sys.exit({ended.code!r})")
        return 2
    except Exception as error:
        message = user_error(error)
        if interruption.requested():  # it broke a program that this had started, for example
            _say(f"interrupted: {message or type(error).__name__}")
            return interruption.CODE
        if message is None:
            raise
        _say(f"error: {message}")
        try:
            sys.stdout.flush()
        except OSError:  # drop the rest: Python would try again as it ends, and say so
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except AttributeError:  # closed
            pass
        return 2
    if code == interruption.CODE:  # a KeyboardInterrupt that typer caught
        _say(interruption.NOTHING_KEPT)
    elif interruption.requested():
        _say("interrupted: the command had come to its end, and all that it writes is written")
        return interruption.CODE
    return code or 0


def _check_surroundings(arguments: Sequence[str]) -> None:
    """Refuse surroundings that a command would fail on when its work is done."""
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
    uncompiled = os.environ.get("JAX_DISABLE_JIT", "")
    if uncompiled.lower() in _TRUE and not {"-h", "--help", "--version"} & {*arguments}:
        raise InputError(f"JAX_DISABLE_JIT: expected 0, as no walk ends that is not compiled, got {uncompiled!r}")


def _say(text: str) -> None:
    from mjx_climb.scenario.messages import printable

    with contextlib.suppress(OSError):  # nobody can read it
        print(f"mjx-climb: {printable(text)}", file=sys.stderr, flush=True)


def user_error(error: Exception) -> str | None:
    """Return one readable line for an error that is the user's to mend, None for one of ours."""
    ours = {kind.__name__ for kind in type(error).__mro__ if kind.__module__.split(".")[0] in ("mjx_climb", "tuning")}
    if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT:  # files raise OutputError
        reason = os.strerror(error.errno).lower()
        message = f"standard output: expected a place that takes what is printed, got '{reason}'"
    elif _raised_in(error) == "jax/_src/config.py":
        named = [name for name, value in os.environ.items() if name.startswith("JAX_") and repr(value) in str(error)]
        message = f"{', '.join(named) or 'JAX_...'}: expected a value that JAX knows, got '{error}'"
    elif _raised_in(error) == "jax/_src/xla_bridge.py" and isinstance(error, AssertionError):
        asked = os.environ.get("JAX_PLATFORMS", "")
        message = f"JAX_PLATFORMS: expected devices that JAX can use, got {asked!r}, of which there are none"
    elif isinstance(error, RuntimeError) and "Unable to initialize backend" in str(error):
        message = f"JAX_PLATFORMS: expected devices that JAX can use, got '{str(error).partition(' (set ')[0]}'"
    elif isinstance(error, RuntimeError) and str(error).startswith("Unknown backend cpu"):
        asked = os.environ.get("JAX_PLATFORMS", "")
        message = f"JAX_PLATFORMS: expected cpu among them, where what is exact is computed, got {asked!r}"
    elif type(error).__name__ in ("InternalFloatingPointError", "FloatingPointError"):
        expected = "expected none of them: what a walk does not have is NaN or infinite here"
        message = f"JAX_DEBUG_NANS, JAX_DEBUG_INFS: {expected}"
    elif hasattr(error, "format_message"):  # usage, from typer
        message, context = error.format_message(), getattr(error, "ctx", None)
        if context is not None and hasattr(error, "option_name") and hasattr(error, "possibilities"):
            message = f"No such option: {error.option_name}{_nearest(error.option_name, context.command)}"
        message += f" (see {context.command_path} --help)" if context is not None else ""
    elif ours & _OF_THE_USER:
        message = str(error)
    elif place := _own_place(error):
        message = f"{place}: {type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
    elif called := _CALLED_BACK.search(str(error)):
        message = "{}:{}: {}".format(*called.groups())
    else:
        return None
    from mjx_climb.scenario.messages import printable

    line = printable(" ".join(message.split()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


def _own_place(error: BaseException) -> str:
    """Return file:line of a user's own file that an error was raised in, or came through last; "" for none."""
    objects = sys.modules.get("mjx_climb.inputs.own_objects")
    own = {os.path.abspath(module.__file__ or "") for module, _ in objects.RUN} if objects else set()
    lines = [
        f"{frame.f_code.co_filename}:{line}"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if os.path.abspath(frame.f_code.co_filename) in own
    ]
    return lines[-1] if lines else ""


def _raised_in(error: Exception) -> str:
    """Return the file of JAX that an error was raised in, by its folder in the package; "" for any other file."""
    _, folder, name = _last_file(error).rpartition("/jax/_src/")
    return f"jax/_src/{name}" if folder else ""


def _last_file(error: BaseException) -> str:
    """Return the file that an error was raised in."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace.tb_frame.f_code.co_filename.replace(os.sep, "/") if trace else ""


def _nearest(option: str, command: Any) -> str:
    """Return a suggestion, in words, for an option that a command does not have.

    A key of the scenario of this very name, else the commands that have the option, else names spelt alike.
    """
    from mjx_climb.scenario.messages import did_you_mean, keys
    from mjx_climb.scenario.model import Scenario

    options = {name.lstrip("-"): [name] for parameter in command.params for name in parameter.opts}
    changes: dict[str, list[str]] = {}
    for key in keys(Scenario) if "set" in options else ():
        for name in {key, key.rpartition(".")[2]}:
            changes.setdefault(name, []).append(f"--set {key}=")
    known, asked = changes | options, option.lstrip("-")
    if asked not in changes and (others := _commands_with(option)):
        return f" (an option of {', '.join(others)})"
    return did_you_mean(asked, known, alike=_ALIKE, meant=known)


def _commands_with(option: str) -> list[str]:
    """Return the names of the commands that have an option."""
    commands = getattr(typer.main.get_command(program()), "commands", {})
    return [name for name, each in commands.items() if any(option in parameter.opts for parameter in each.params)]


def origin(name: str, again: str) -> "Origin":
    """Return where a report comes from, but for the scenario: see `tuning.pages.page.Origin`."""
    from tuning.pages.page import Origin

    words = ["mjx-climb"]
    for argument in ARGUMENTS.get():  # absolute paths as bare names: their folders belong to one machine
        option, equals, value = argument.rpartition("=")
        if re.match(r"[/~]|[A-Za-z]:[/\\]", value):
            value = re.split(r"[/\\]", value.rstrip("/\\"))[-1]
        words.append(f"{option}{equals}{value}")
    return Origin(name, shlex.join(words), again)


def typed_but(option: str, value: str) -> str:
    """Return the command as it was typed, to be run again from the same folder, with this value of an option."""
    kept = [word for name, words in _by_option(ARGUMENTS.get()) if name != option for word in words]
    return f"{shlex.join(['mjx-climb', *kept])} {option} {value}"


def repeated(command: Sequence[str], *options: str) -> str:
    """Return the command that repeats one in the folder of its result, with those of these options that were typed."""
    kept = [word for name, words in _by_option(ARGUMENTS.get()) if name in options for word in words]
    name, *files = command
    return shlex.join(["mjx-climb", name, "config.yaml", *files, *kept, "--out", "again"])


def _by_option(arguments: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each option that was typed with its words; the word behind one is taken for its value."""
    words = list(arguments)
    while words:
        first = words.pop(0)
        name, equals, _ = first.partition("=")
        value = [words.pop(0)] if first.startswith("--") and not equals and words and words[0][:2] != "--" else []
        yield name, [first, *value]
