"""Columns of numbers from a file, and the one way to refuse files of points and grids."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from mjx_climb.reading import check_regular
from mjx_climb.scenario.messages import ConfigError

Column = tuple[str, np.ndarray]


class Table(NamedTuple):
    """The columns of a file, each (N,), and where its sensor was, (3,) m in the file's axes, if it says so."""

    file: str
    columns: Sequence[Column]
    viewpoint: np.ndarray | None = None

    @property
    def names(self) -> list[str]:
        """The names of the columns, in their order."""
        return [name for name, _ in self.columns]

    def values(self, *names: str) -> np.ndarray:
        """Columns side by side, (N, names).

        Raises:
            ConfigError: a name that no column has, or several; a column of anything but real numbers.
        """
        for name in names:
            if not (times := self.names.count(name)):
                expected = f"columns {', '.join(names[:-1])} and {names[-1]}" if names[1:] else f"a column {name}"
                raise ConfigError(self.file, name, expected, ", ".join(self.names) or "none")
            if times > 1:
                raise ConfigError(self.file, name, "one column of this name", str(times))
        held = dict(self.columns)
        return np.stack([real(held[name], self.file, name) for name in names], axis=-1)


def real(values: object, file: str, key: str) -> np.ndarray:
    """Values in double precision.

    Raises:
        ConfigError: complex numbers, texts, objects or dates.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ConfigError(file, key, "real numbers", f"values of type {array.dtype}")
    return array.astype(float)


def packed(content: bytes, layout: DTypeLike, count: int, at: int = 0) -> np.ndarray:
    """Records (count,) of binary content from a byte on.

    Raises:
        ValueError: content for fewer records, or for more; zeros that fill a page may follow.
    """
    size = np.dtype(layout).itemsize
    if len(content) < at + size * count or len(content[at + size * count :].strip(b"\0")) >= max(size, 1):
        raise ValueError(f"{len(content) - at} bytes for {count} points of {size} bytes")
    return np.frombuffer(content, layout, count, at)


@contextlib.contextmanager
def reading(file: str, key: str, expected: str) -> Iterator[None]:
    """Refuse a file in one line for any error of its reader, its decoders included."""
    try:
        check_regular(file)
        yield
    except ConfigError:
        raise
    except Exception as error:
        reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
        raise ConfigError(file, key, expected, reason) from None
