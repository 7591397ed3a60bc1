"""Numbered columns that other columns name: `position0` is of the joint whose name stands in `name0`, row by row."""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|[^\W\d_A-Za-z]+")
_LAST = re.compile(r"(.*?)([\W_]*)(\d+)([^\d]*)$", re.DOTALL)  # of a column's name: the last number in it
_NAMING = frozenset("name names joint joints id ids interface motor motors servo servos actuator actuators".split())
_MOST = 1000  # names of one place: more are no names

Words = Mapping[str, Sequence[str]]  # by column, a word for each row, "" for none
Columns = dict[str, Float[np.ndarray, " samples"]]


def words_of(text: str) -> tuple[str, ...]:
    """Return the words and numbers in a name, in small letters."""
    return tuple(word.lower() for word in _WORD.findall(text))


def by_names(fields: Columns, words: Words) -> tuple[Columns, frozenset[str]]:
    """Return columns by the names that stand beside them, and the columns that these are made of.

    Names are words whose columns are numbered as others of one parent are (`field.name0`, `field.position0`), or one
    column of names whose rows differ (`joint`, `position`). A name has the numbers of the rows in which it stands.
    """
    made: Columns = {}
    used: set[str] = set()
    groups = _groups(fields)
    named = sorted(_names(words), key=lambda each: -len(each[0]))  # the nearest parent first
    for parent, tail, places in named:
        if None in places and _own_names(fields, words[places[None]]):
            continue
        for (head, last), numbered in groups.items():
            beside = head[: len(parent)] == parent if not tail else head == parent and last
            alike = len(numbered) == len(places) and (None in numbered) == (None in places)
            if not beside or not alike or used & {*numbered.values()}:
                continue
            used |= {*numbered.values()}
            # some count from 0, and some from 1
            for field, name in zip(_in_order(numbered), _in_order(places), strict=True):
                said = np.array(words[name], dtype=object)
                for word in dict.fromkeys(said):
                    if word:
                        column = made.setdefault(_renamed(field, word), np.full(len(said), np.nan))
                        column[said == word] = fields[field][said == word]
    return made, frozenset(used)


def _in_order(numbered: Mapping[int | None, str]) -> list[str]:
    return [numbered[number] for number in sorted(numbered, key=lambda number: -1 if number is None else number)]


def _renamed(field: str, word: str) -> str:
    """Return a column's name with a word in place of its last number, or behind it."""
    if (found := _LAST.fullmatch(field)) is None:
        return f"{field}.{word}"
    return ".".join(filter(None, (found[1], word, *words_of(found[4]))))


def _split(field: str) -> tuple[tuple[str, ...], int | None, tuple[str, ...]]:
    """Return the words before the last number in a name, the number, None for none, and the words behind."""
    found = _LAST.fullmatch(field)
    if found is None:
        return words_of(field), None, ()
    return words_of(found[1]), int(found[3]), words_of(found[4])


def _groups(fields: Mapping[str, object]) -> dict[tuple[tuple[str, ...], tuple[str, ...]], dict[int | None, str]]:
    """Return columns by the words around their last number, then by this number; all without one by their words."""
    groups: dict[tuple[tuple[str, ...], tuple[str, ...]], dict[int | None, str]] = {}
    for field in fields:
        head, number, tail = _split(field)
        groups.setdefault((head, tail), {})[number] = field
    return groups


def _names(words: Words) -> list[tuple[tuple[str, ...], tuple[str, ...], dict[int | None, str]]]:
    """Return the columns of names: the words of their parent, those behind their number, and the columns by number."""
    found = []
    for (head, tail), places in _groups(words).items():
        if tail and not {*tail} <= _NAMING:
            continue
        if None in places and not {*head[-1:]} & _NAMING:
            continue
        end = len(head) - (not tail)
        while not tail and end and head[end - 1] in _NAMING:
            end -= 1
        rows = [
            [word for word in row if word] for row in zip(*(words[field] for field in places.values()), strict=True)
        ]
        distinct = {word for row in rows for word in row}
        alike = any(len({*row}) < len(row) for row in rows)
        if not alike and len(distinct) <= _MOST and (None not in places or len(distinct) > 1):
            found.append((head[:end], tail, places))
    return found


def _own_names(fields: Mapping[str, object], said: Sequence[str]) -> bool:
    """Whether columns have the names that stand in a column: then this does not say whose numbers they are."""
    names = [words_of(word) for word in {*said} if word]
    return any(
        name and name == other[at : at + len(name)]
        for other in map(words_of, fields) for at in range(len(other))
        for name in names
    )  # fmt: skip
