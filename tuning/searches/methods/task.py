"""The protocol of a search method: it is given a task, and asks for points by requests."""

from collections.abc import Callable, Generator
from typing import NamedTuple

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.search import Search


class Task(NamedTuple):
    """What a method is given."""

    problem: Problem
    search: Search
    start: np.ndarray  # (n,) the scenario's own gains


class Request(NamedTuple):
    """Points that a method wants evaluated."""

    theta: np.ndarray  # (B, n)
    directions: np.ndarray | None  # (k, n) along which tangents are wanted
    phase: str

    @property
    def tangents(self) -> int:
        """How many tangents are wanted."""
        return 0 if self.directions is None else len(self.directions)


Points = Generator[Request, Evaluation, None]


class Method(NamedTuple):
    """A method: its rounds in all, and the generator of its requests. The same task gives the same requests."""

    rounds: Callable[[Task], int]
    run: Callable[[Task], Points]


def as_method(method: Method | Callable[[Task], Points]) -> Method:
    """Return a method; the rounds of a bare function are the setting `iterations`, 0 where that is not set.

    Raises:
        ConfigError: neither a method nor a function.
    """
    if isinstance(method, Method):
        return method
    if not callable(method):
        raise ConfigError(f"method: expected a name, a Method, or a function of a Task, got {method!r}")
    return Method(_iterations, method)


def _iterations(task: Task) -> int:
    return task.search.iterations or 0


def check_request(request: Request, n: int) -> None:
    """Refuse what asks for no points (B, n).

    Raises:
        ConfigError: in one line, what was expected.
    """
    expected = f"method: expected a Request of finite theta (B, {n}), got"
    if not isinstance(request, Request):
        raise ConfigError(f"{expected} a {type(request).__name__}")
    theta = np.asarray(request.theta)
    if not np.isfinite(theta).all():
        raise ConfigError(f"{expected} {theta.shape} with values that are not finite")
    if theta.ndim != 2 or not len(theta) or theta.shape[1] != n:
        raise ConfigError(f"{expected} {theta.shape}")
    if request.directions is not None and np.shape(request.directions)[1:] != (n,):
        raise ConfigError(f"method: expected directions (k, {n}), got {np.shape(request.directions)}")
