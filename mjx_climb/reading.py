"""Files that were given or found: readers by suffix, edits, paths, and files that may have a reader wait forever."""

import errno
import functools
import importlib
import os
import pkgutil
import stat
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def read_found(path: str | os.PathLike[str]) -> str:
    """Return the UTF-8 text of a regular file.

    Raises:
        OSError: it is not there, cannot be read, or is a pipe or a device, which could have a reader wait forever.
        UnicodeDecodeError: other text.
    """
    with open(path, encoding="utf-8", opener=_without_waiting) as file:
        check_regular(path, file.fileno())
        return file.read()


def check_regular(path: str | os.PathLike[str], opened: int | None = None) -> None:
    """Check a file before a library reads it; `opened` is its descriptor, where it is open.

    Raises:
        OSError: it is not there, or is a pipe or a device, which could have a reader wait forever.
    """
    if not stat.S_ISREG(os.stat(path if opened is None else opened).st_mode):
        raise OSError(errno.EINVAL, "no regular file", os.fspath(path))


def readers_in(package: str, folders: Iterable[str]) -> dict[str, Any]:
    """Return `read` of the modules of a package, by the suffixes of files in their `SUFFIXES`."""
    each = [importlib.import_module(f"{package}.{found.name}") for found in pkgutil.iter_modules(folders)]
    return {suffix: module.read for module in each for suffix in module.SUFFIXES}


def until_edited(files: Callable[..., Iterable[str | os.PathLike[str] | None]]) -> Callable[[Function], Function]:
    """Decorator of a function of hashable arguments: its results are kept until one of its files is edited.

    Arguments:
        files: the paths, by the function's arguments; None and files that are not there count too.
    """

    def decorate(function: Function) -> Function:
        kept = functools.lru_cache(maxsize=64)(lambda written, *given, **named: function(*given, **named))

        @functools.wraps(function)
        def call(*given: Any, **named: Any) -> Any:
            return kept(tuple(map(_written, files(*given, **named))), *given, **named)

        return cast(Function, call)

    return decorate


def _written(file: str | os.PathLike[str] | None) -> tuple[int, int] | None:
    """Return when a file was written, ns, and its size, bytes."""
    try:
        about = None if file is None else os.stat(file)
    except (OSError, ValueError):  # ValueError: a null byte
        return None
    return None if about is None else (about.st_mtime_ns, about.st_size)


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # a pipe opens, whether or not anybody writes to it


def leaving(folder: str | os.PathLike[str], names: Iterable[str]) -> str | None:
    """Return the first of some names of files in a folder that leads out of it, by dots, a root or a link, or None."""
    home = Path(os.path.realpath(folder))
    for name in names:
        above, last = os.path.split(name)
        try:
            inside = Path(os.path.realpath(home / above)).is_relative_to(home)
        except ValueError:  # a null byte
            return name
        if last in ("", os.curdir, os.pardir) or "\0" in last or not inside:
            return name
    return None
