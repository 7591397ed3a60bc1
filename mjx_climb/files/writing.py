"""Files that are either whole or not there."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mjx_climb.scenario.messages import printable


class OutputError(ValueError):
    """A place that cannot be written to; in one line: path, expected, got."""


@contextlib.contextmanager
def whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path that becomes the file where the block ends well, and is removed where it does not.

    Missing folders are made. A link is written through. A pipe or a device is never replaced:
    it is given as it is.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        try:
            target = Path(os.path.realpath(path))
            special = not stat.S_ISREG(os.stat(path).st_mode)
        except (FileNotFoundError, NotADirectoryError):
            special = False
        except ValueError as error:  # a null byte
            raise _refused(path, "a file that can be written", error) from None
        if special:
            yield Path(path)
            return
        partial = target.with_name(f".{target.name}.{os.getpid()}.part")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(partial, target)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink()
    except OSError as error:
        raise _refused(path, "a file that can be written", error) from None


def write_text_atomically(path: str | os.PathLike[str], text: str) -> Path:
    """Write UTF-8 text as `write_bytes_atomically` does."""
    return write_bytes_atomically(path, text.encode())


def write_bytes_atomically(path: str | os.PathLike[str], content: bytes | memoryview) -> Path:
    """Write a file by way of a temporary one beside it, see `whole`, and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole(path) as place, place.open("wb") as file:
        file.write(content)
    return Path(path)


def write_in_place(path: Path, content: bytes) -> None:
    """Write a file as `write_bytes_atomically` does, but in place of a link there, which may lead out of its folder.

    Raises:
        OutputError: the file cannot be written.
    """
    if path.is_symlink():
        path.unlink(missing_ok=True)
    write_bytes_atomically(path, content)


def check_folder(path: str | os.PathLike[str]) -> None:
    """Check, before a long computation, that a folder is there or can be made and takes files; leave nothing in it.

    Raises:
        OutputError: it does not, or cannot.
    """
    folder = Path(path).absolute()
    for place in (folder, *folder.parents):
        try:
            tempfile.TemporaryFile(dir=place).close()
            return
        except FileNotFoundError:
            continue  # to be made in the folder above
        except (OSError, ValueError) as error:
            raise _refused(path, "a folder that can be written to", error) from None


def _refused(path: str | os.PathLike[str], expected: str, error: OSError | ValueError) -> OutputError:
    reason = (getattr(error, "strerror", None) or str(error)).lower()
    return OutputError(f"{printable(os.fspath(path))}: expected {expected}, got {reason}")
