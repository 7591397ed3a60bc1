"""A file before its columns have a meaning: columns of numbers over time, by topic and field."""

import dataclasses
from collections.abc import Mapping, Set

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Table:
    """Samples that were recorded together: the messages of a topic, or the rows of a file.

    A field is named by its path with dots, as `wrench.force.x`; an entry of a list by its name, where the message names
    it, as `position.joint_0`, or else by its number, as `data.0`.
    """

    topic: str  # "" for a file that is one table
    times: Mapping[str, Float[np.ndarray, " samples"]]  # in the file's unit: by column, or `header` and `log`
    fields: Mapping[str, Float[np.ndarray, " samples"]]  # NaN: not recorded
    frame: str = ""  # of the messages' header
    unnamed: Set[str] = frozenset()  # fields whose path has an entry's number for want of a name
    renamed: Set[str] = frozenset()  # fields that stand there by the names of their entries too
    words: Set[str] = frozenset()  # all that stands in columns of words


@dataclasses.dataclass(frozen=True)
class Recording:
    """All tables of a file."""

    tables: Mapping[str, Table]  # by topic
    source: str  # the file, as the user named it
    warnings: tuple[str, ...] = ()  # on columns that could not be read, a line each
