"""How a command ends when it does not end well: what the user did wrong, or that she stopped it."""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tuning.command_line import interruption


class InputError(ValueError):
    """An argument or option that cannot be used; in one line: option, what was expected, what was got."""


class Interrupted(Exception):
    """Ctrl-C, and what was kept."""


class Kept:
    """How much of a command's work is kept, counted as it goes on."""

    def __init__(self, done: int = 0):
        self.done = done

    def told(self, show: Callable[..., None]) -> Callable[..., None]:
        """Return a function that counts what `show` is told, its first argument."""

        def counted(done: int, *rest: object) -> None:
            self.done = done
            show(done, *rest)

        return counted

    def phases(self, show: Callable[..., None]) -> Callable[[int, int, str], None]:
        """Return the same for what is told its phase as well, as "descent 1 of 3"."""
        counted = self.told(show)
        return lambda done, total, phase: counted(done, total, f"{phase} {done}/{total}")


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
    kinds: list[type[Exception]] = [InputError]
    if "mjx_climb" in sys.modules:
        from mjx_climb import ConfigError, RobotError
        from mjx_climb.files.writing import OutputError

        kinds += [ConfigError, RobotError, OutputError]
    if "mjx_climb.compilation.devices" in sys.modules:
        from mjx_climb.compilation.devices import LostProcess

        kinds.append(LostProcess)
    if "mjx_climb.rendering" in sys.modules:
        from mjx_climb.rendering import RenderingError

        kinds.append(RenderingError)
    return str(error) if isinstance(error, tuple(kinds)) else None


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
