"""How a command ends when it does not end well: what the user did wrong, or that she stopped it."""

import contextlib
import errno
import math
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.command_line import interruption

if TYPE_CHECKING:
    from tuning.searches.rounds import Progress


class InputError(ValueError):
    """An argument or option that cannot be used; in one line: option, what was expected, what was got."""


class Interrupted(Exception):
    """Ctrl-C, and what was kept."""


class Kept:
    """How much of a command's work is kept, counted as it goes on."""

    def __init__(self, done: int = 0):
        self.done = done

    def counting(self, show: Callable[..., None]) -> Callable[..., None]:
        """Return a function that counts what `show` is called with, its first argument."""

        def counted(done: int, *rest: object) -> None:
            self.done = done
            show(done, *rest)

        return counted

    def rounds(self, show: Callable[..., None]) -> "Callable[[Progress], None]":
        """Return the same for the rounds of a search, which are shown with what is best so far."""

        def counted(now: "Progress") -> None:
            self.done = now.rounds
            slope = f", gradient {now.gradient_norm:.2g}" if math.isfinite(now.gradient_norm) else ""
            best = f"{now.best:.4f}" if math.isfinite(now.best) else "none feasible yet"
            text = f"{now.phase} {now.rounds}/{now.rounds_in_all}: best {best}{slope}, {now.alive} of {now.batch} alive"
            show(now.rounds, now.rounds_in_all, f"{text}, {now.env_steps / 1e6:.2f} M env-steps")

        return counted


@contextlib.contextmanager
def kept_in(out: Path, what: str, done: int = 0) -> Iterator[Kept]:
    """Say what is kept where the user stops a command, as "3 rounds"; `done` of them were there before.

    Raises:
        Interrupted: in place of KeyboardInterrupt, and of what goes wrong after the user asked to stop: a process that
            walked beside this one, for example, was stopped as well and may be gone first.
    """
    kept = Kept(done)
    try:
        yield kept
    except Interrupted:  # it says more
        raise
    except (KeyboardInterrupt, Exception) as error:
        if not (isinstance(error, KeyboardInterrupt) or interruption.requested()):
            raise
        raise Interrupted(f"{kept.done} {what} are kept in {out}; the same command goes on from there") from None


_LONGEST = 1000  # characters
_OF_THE_USER = {"InputError", "ConfigError", "RobotError", "OutputError", "LostProcess", "RenderingError"}
_OUTPUT = (errno.ENOSPC, errno.EIO, errno.EDQUOT)  # of what is printed; typer ends quietly where a pipe is closed


def user_error(error: Exception) -> str | None:
    """Return one readable line for an error that is the user's to mend, None for one of ours."""
    message = _message(error)
    if message is None:
        return None
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(message.split()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


def leave_output() -> None:
    """Drop what standard output does not take: Python would try again as it ends, and say so."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _message(error: Exception) -> str | None:
    if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT:  # files raise OutputError
        reason = os.strerror(error.errno).lower()
        return f"standard output: expected a place that takes what is printed, got '{reason}'"
    if isinstance(error, RuntimeError) and "Unable to initialize backend" in str(error):
        return f"JAX_PLATFORMS: expected devices that JAX can use, got '{str(error).partition(' (set ')[0]}'"
    if type(error).__name__ in ("InternalFloatingPointError", "FloatingPointError"):
        return (
            "JAX_DEBUG_NANS, JAX_DEBUG_INFS: expected none of them: what a walk does not have is NaN or infinite here"
        )
    if hasattr(error, "format_message"):  # usage, from typer
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context is not None else ""
        if context is not None and hasattr(error, "option_name") and hasattr(error, "possibilities"):
            return f"No such option: {error.option_name}{_nearest(error.option_name, context.command)}{hint}"
        return f"{error.format_message()}{hint}"
    ours = {kind.__name__ for kind in type(error).__mro__ if kind.__module__.split(".")[0] in ("mjx_climb", "tuning")}
    return str(error) if ours & _OF_THE_USER else None


def _nearest(option: str, command: Any) -> str:
    """Return the option or the key of the scenario that is nearest to one that a command does not have, in words."""
    from difflib import get_close_matches

    from mjx_climb.scenario.messages import keys
    from mjx_climb.scenario.model import Scenario

    options = {name.lstrip("-"): [name] for parameter in command.params for name in parameter.opts}
    changes: dict[str, list[str]] = {}
    for key in keys(Scenario) if "set" in options else ():
        for name in {key, key.rpartition(".")[2]}:
            changes.setdefault(name, []).append(f"--set {key}=")
    known = changes | options
    near = get_close_matches(option.lstrip("-"), known, 1)
    return f" (did you mean {' or '.join(known[near[0]])}?)" if near else ""
