"""Progress through the stages of a longer work, told to whoever asks; nothing is printed here."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol

Told = Callable[..., None]  # walks done, walks in all, and perhaps a text


class Stage(Protocol):
    """Opens a stage of a work; while it is open, the function that it gives is told how far it has come."""

    def __call__(
        self, name: str, *, compiles: bool = True, unit: str = "walks"
    ) -> contextlib.AbstractContextManager[Told]:
        """Open the stage `name`; `compiles` says whether programs may have to be compiled in it."""


@contextlib.contextmanager
def silent(name: str, *, compiles: bool = True, unit: str = "walks") -> Iterator[Told]:
    """Tell nobody."""
    yield lambda *_: None
