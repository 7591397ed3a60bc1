"""The seam between a search method and what runs it."""

from collections.abc import Callable, Generator
from typing import NamedTuple

import numpy as np

from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.search import Search


class Task(NamedTuple):
    """What a method is given."""

    problem: Problem
    search: Search
    start: np.ndarray  # (n,) the scenario's own gains


class Request(NamedTuple):
    """Points that a method wants judged."""

    theta: np.ndarray  # (B, n)
    directions: np.ndarray | None  # (k, n) along which slopes are wanted
    phase: str

    @property
    def tangents(self) -> int:
        """How many slopes are wanted."""
        return 0 if self.directions is None else len(self.directions)


Points = Generator[Request, Evaluation, None]
Descent = Generator[Request, Evaluation, tuple[np.ndarray, np.ndarray]]  # all points visited, and their merits


class Method(NamedTuple):
    """A method: its rounds in all, and the generator of its requests. The same task gives the same requests."""

    rounds: Callable[[Task], int]
    run: Callable[[Task], Points]
