"""The command as it was typed, which reports and shards repeat."""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tuning.report.page import Origin

ARGUMENTS: ContextVar[tuple[str, ...]] = ContextVar("ARGUMENTS", default=())  # as typed


def origin(name: str, again: str) -> "Origin":
    """Return where a report comes from, but for the scenario: see `tuning.report.page.Origin`."""
    from tuning.report.page import Origin

    return Origin(name, shlex.join(["mjx-climb", *map(_without_folder, ARGUMENTS.get())]), again)


def _without_folder(argument: str) -> str:
    """Return an argument, or what stands behind its "=", as a bare name where it is an absolute path."""
    option, equals, value = argument.rpartition("=")
    if re.match(r"[/~]|[A-Za-z]:[/\\]", value):
        value = re.split(r"[/\\]", value.rstrip("/\\"))[-1]
    return f"{option}{equals}{value}"


def typed_but(option: str, value: str) -> str:
    """Return the command as it was typed, to be run again from the same folder, with this value of an option."""
    kept = [word for name, words in _by_option() if name != option for word in words]
    return f"{shlex.join(['mjx-climb', *kept])} {option} {value}"


def repeated(command: Sequence[str], *options: str) -> str:
    """Return the command that repeats one in the folder of its result, with those of these options that were typed."""
    kept = [word for name, words in _by_option() if name in options for word in words]
    name, *files = command
    return shlex.join(["mjx-climb", name, "config.yaml", *files, *kept, "--out", "again"])


def _by_option() -> Iterator[tuple[str, list[str]]]:
    """Yield each option that was typed with its words; what follows one is taken for its value."""
    words = list(ARGUMENTS.get())
    while words:
        first = words.pop(0)
        name, equals, _ = first.partition("=")
        value = [words.pop(0)] if first.startswith("--") and not equals and words and words[0][:2] != "--" else []
        yield name, [first, *value]
