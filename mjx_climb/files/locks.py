"""Folders that one process at a time has for itself; of a process that is killed the system lets go."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from mjx_climb.files.writing import OutputError


@contextlib.contextmanager
def alone(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold a folder as the only one.

    Raises:
        BlockingIOError: another holds it, where this does not `wait` for it.
    """
    try:
        import fcntl
    except ModuleNotFoundError:  # Windows has none
        if not wait:
            raise BlockingIOError from None
        yield
        return
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(held)


def is_held(folder: Path) -> bool:
    """Return whether another holds a folder; one that is gone, or that this user may not open, is not."""
    try:
        with alone(folder, wait=False):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


@contextlib.contextmanager
def refused(folder: Path) -> Iterator[None]:
    """Raise OutputError in one line where the system refuses the operations on a folder."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(f"{folder}: expected a folder that can be written to, got {reason}") from None
