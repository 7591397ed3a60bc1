"""Files of graspable points, a format each: `SUFFIXES` of its files and `read(path, topic)`.

`read` returns the `Table` of a file. A new file in this folder is known.
"""

from collections.abc import Callable
from pathlib import Path

from mjx_climb.ground.table import Table, reading
from mjx_climb.reading import readers_in
from mjx_climb.scenario.messages import ConfigError

Read = Callable[[Path, str | None], Table]


READERS: dict[str, Read] = readers_in(__name__, __path__)


def table_of(file: str, topic: str | None = None) -> Table:
    """The columns of a file of points.

    Raises:
        ConfigError: in one line, no such file, another format, or a damaged one.
    """
    path = Path(file)
    if not path.is_file():
        raise ConfigError(file, "", "a file of points", "none")
    if (reader := READERS.get(path.suffix.lower())) is None:
        raise ConfigError(file, "", f"points as {', '.join(sorted(READERS))}", path.suffix or "no suffix")
    with reading(file, "", "a whole file of points"):
        return reader(path, topic)
