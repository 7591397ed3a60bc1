"""Batches of points judged one after the other outside of `tuning.tune`: kept on disk, counted, reported."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tuning.problem.evaluation import Evaluation, Problem
from tuning.searches import tune
from tuning.searches.finished_parts import Parts
from tuning.searches.methods.task import Descent

Told = Callable[[int, int, str], None]  # rounds done, rounds in all, phase


class Round(NamedTuple):
    """What was judged in one batch."""

    theta: np.ndarray  # (B, n)
    found: Evaluation


class Rounds:
    """Judges batches; with a folder, those that it holds from an interrupted run of the same thing are not walked."""

    def __init__(
        self, in_all: int, progress: Told | None = None, out: Path | None = None, identity: dict[str, Any] | None = None
    ):
        self.done, self.in_all, self.env_steps = 0, in_all, 0
        self._progress, self._out = progress, out
        self._kept = None if out is None else Parts(out, identity or {})

    def evaluate(
        self, problem: Problem, theta: np.ndarray, phase: str, directions: np.ndarray | None = None
    ) -> Evaluation:
        """Return what some points are worth."""
        stored = None if self._kept is None else self._kept.load(self.done)
        found = None if stored is None else tune.restored(stored, theta, self._out)
        if found is None:
            found = problem.evaluate(theta, directions)
            if self._kept is not None:
                self._kept.save(self.done, tune.stored_arrays(found, theta))
        self.done += 1
        self.env_steps += problem.env_steps(len(theta), 0 if directions is None else len(directions))
        if self._progress is not None:
            self._progress(self.done, self.in_all, phase)
        return found

    def descend(self, problem: Problem, points: Descent) -> list[Round]:
        """Follow a descent (see `searches.methods.gradient.descend`) to its end and return all that it visited."""
        visited = []
        try:
            request = next(points)
            while True:
                found = self.evaluate(problem, request.theta, request.phase, request.directions)
                visited.append(Round(request.theta, found))
                request = points.send(found)
        except StopIteration:
            return visited
