"""The iterates of a fit's searches, shown and kept in a folder: a fit that is interrupted goes on from the last one."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tuning.methods.parts import Parts

Progress = Callable[[int, int, str], None]


class Iterate(NamedTuple):
    """Where a search is, at all of its points."""

    x: np.ndarray  # (points, P)
    start: np.ndarray  # (points, windows, limb, joint, S)
    damping: np.ndarray  # (points,)
    slow: np.ndarray  # (points,) bool: the last step that was taken gained next to nothing
    done: np.ndarray  # (points,) bool


class Iterates:
    """The iterates of all searches of a fit, each search `begin`s in turn; the fit is deterministic."""

    def __init__(self, parts: Parts, progress: Progress | None = None):
        """Take the folder, and what is called with iterations done, at most to do, and a line."""
        self._parts, self._progress = parts, progress
        self._finished, self._number, self._text, self._most = 0, -1, "", 0

    def begin(self, text: str, most: int, first: Iterate) -> tuple[int, Iterate]:
        """Return how many iterations of the next search are kept, and where it is after them: 0 and `first` else."""
        self._number, self._text, self._most = self._number + 1, text, most
        for iteration in range(most, 0, -1):
            if (kept := self._parts.load(self._place(iteration))) is not None:
                return iteration, Iterate(**kept)
        return 0, first

    def show(self, iteration: int, cost: float) -> None:
        """Tell how far the search is; an exception of `progress` ends the fit."""
        if self._progress is not None:
            before = self._finished
            self._progress(before + iteration, before + self._most, f"{self._text}: cost {cost:.6g}")

    def keep(self, iteration: int, now: Iterate) -> None:
        """Keep an iterate; OutputError where it cannot be."""
        arrays: dict[str, Any] = now._asdict()
        self._parts.save(self._place(iteration), arrays)

    def end(self, iteration: int) -> None:
        """End a search after so many iterations."""
        self._finished += iteration

    def _place(self, iteration: int) -> int:
        return 1000 * self._number + iteration
