"""A table as text, the same on a page and in a terminal."""

from collections.abc import Sequence
from typing import NamedTuple


class Table(NamedTuple):
    """A table as text; sections are runs of rows with a heading. The first `words` columns are not numbers."""

    caption: str
    columns: Sequence[str]
    sections: Sequence[tuple[str, Sequence[Sequence[str]]]]
    words: int = 2
