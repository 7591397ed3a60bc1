"""Files of graspable points, a format each: `SUFFIXES` of its files and `read(path, topic)`.

`read` returns the columns of a file by their names, each (N,). A new file in this folder is known.
"""

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mjx_climb.scenario.messages import ConfigError, config_error

Columns = Mapping[str, np.ndarray]
Read = Callable[[Path, str | None], Columns]


def _readers() -> dict[str, Read]:
    """Return the readers of this folder, by the suffix of files."""
    each = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    return {suffix: module.read for module in each for suffix in getattr(module, "SUFFIXES", ())}


READERS = _readers()


def columns_of(file: str, topic: str | None = None) -> Columns:
    """The columns of a file of points, by their names in it, each (N,).

    Raises:
        ConfigError: in one line, no such file, another format, a damaged one, or no column x, y or z.
    """
    path = Path(file)
    if not path.is_file():
        raise config_error(file, "", "a file of points", "none")
    if (reader := READERS.get(path.suffix.lower())) is None:
        raise config_error(file, "", f"points as {', '.join(sorted(READERS))}", path.suffix or "no suffix")
    try:
        columns = reader(path, topic)
    except ConfigError:
        raise
    # libraries raise what their decoders do, on files that are damaged
    except Exception as error:
        reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
        raise config_error(file, "", "a whole file of points", reason) from None
    if missing := [name for name in "xyz" if name not in columns]:
        got = ", ".join(columns) or "none"
        raise config_error(file, missing[0], "columns x, y and z", got)
    return columns
