"""Formats of logs, one file each: `SUFFIXES` of its files, "" for a folder, and `read(path)`. A new file is known."""

import os
from collections.abc import Callable
from pathlib import Path

from mjx_climb.reading import check_regular, readers_in
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.readers.table import Recording

READERS: dict[str, Callable[[Path], Recording]] = readers_in(__name__, __path__)


def record(path: str | os.PathLike[str]) -> Recording:
    """Return all numbers of a file by topic and field, or column.

    Raises:
        ConfigError: no such file, or another format.
    """
    path = Path(path)
    if path.suffix.lower() in (".zstd", ".zst", ".gz", ".bz2", ".xz", ".zip", ".lz4"):
        how = "zstd -d" if path.suffix.lower() in (".zstd", ".zst") else "its program"
        raise ConfigError(str(path), "", f"a log that is not packed (unpack it before: {how} {path.name})", path.suffix)
    if not path.exists():
        raise ConfigError(str(path), "", "a log", "no such file or folder")
    reader = READERS.get("" if path.is_dir() else path.suffix.lower() or "none")
    if reader is None:
        expected = f"a log: {', '.join(filter(None, READERS))} or the folder of a bag"
        raise ConfigError(str(path), "", expected, path.suffix or "a name without suffix")
    if not path.is_dir():
        try:
            check_regular(path)
        except OSError as error:
            raise ConfigError(str(path), "", "a log", error.strerror or str(error)) from None
    return reader(path)
