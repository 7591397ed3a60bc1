"""The base of search methods: a class whose generator asks for points and receives their scores."""

import abc
import contextlib
import dataclasses
import importlib
from collections.abc import Callable, Generator
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np

from mjx_climb.inputs.own_objects import in_one_line, load
from mjx_climb.scenario.messages import ConfigError
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.search import METHODS, Search
from tuning.problem.spaces import Space


class Task(NamedTuple):
    """The task of a method."""

    problem: Problem
    search: Search
    start: np.ndarray  # (n,) the scenario's own gains
    others: np.ndarray = np.zeros((0, 0))  # (S, n) further gains that are known, see `tuning.problem.known`

    @property
    def known(self) -> np.ndarray:
        """The points (1 + S, n) that every method evaluates among its first, the scenario's own gains before all."""
        return np.concatenate([self.start[None], self.others.reshape(-1, self.start.size)])


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


class Method(abc.ABC):
    """A search method: a subclass has the generator `run`, and may say how many rounds that takes.

    A method is deterministic: given the same task and the same answers it makes the same requests, so that a search
    that was killed goes on where it stopped.
    """

    gradients: ClassVar[bool] = False  # whether it asks for tangents, which times of the gait do not have
    most: ClassVar[int | None] = None  # numbers that it can search, None: any

    def check(self, space: Space, search: Search) -> None:
        """Refuse by a ConfigError, before anything walks, a space that the method cannot search, or wrong settings."""
        if self.most is not None and space.size > self.most:
            cure = "pin or freeze some, or choose gradient"
            expected = f"at most {self.most} numbers to search by {search.method}"
            raise ConfigError("", "method", expected, f"{space.size}: {cure}")

    def rounds(self, task: Task) -> int:
        """Return how many rounds a run takes at most, 0 where that is not known."""
        return task.search.iterations or 0

    @abc.abstractmethod
    def run(self, task: Task) -> Points:
        """Yield a `Request` of points (B, n) each round and receive its `Evaluation`, until the search is done.

        The first requests hold the points `task.known`: then no result is worse than the scenario's own gains.
        """


@dataclasses.dataclass(frozen=True)
class Function(Method):
    """A method that is a bare generator function of a task."""

    function: Callable[[Task], Points]

    def run(self, task: Task) -> Points:
        return self.function(task)


def own_points(method: Method, task: Task) -> Points:
    """Yield the requests of a method of the user's own.

    Raises:
        ConfigError: in one line, the method fails, is no generator, or asks for no points.
    """
    named = getattr(method, "function", type(method))
    name, answer = f"method {getattr(named, '__name__', type(named).__name__)}", cast(Any, None)
    with in_one_line(name):
        points = method.run(task)
    if not isinstance(points, Generator):
        raise ConfigError("", name, "a generator of Requests", type(points).__name__)
    with contextlib.closing(points):
        while True:
            with in_one_line(name):
                try:
                    request = points.send(answer)
                except StopIteration:
                    break
            answer = yield request
    if answer is None:
        raise ConfigError("", name, "at least one Request of points", "none")


def method_of(named: str | Method | type[Method] | Callable[[Task], Points]) -> Method:
    """Return a method: by the name of a shipped one, as `optuna:SAMPLER`, as FILE.py:NAME, or of a caller's own.

    Raises:
        ConfigError: in one line, no such method.
    """
    found: Any = named
    if isinstance(named, str):
        name, _, sampler = named.partition(":")
        if named in METHODS or name == "optuna":
            found = importlib.import_module(f"tuning.methods.{name}").METHOD
            found = dataclasses.replace(found, sampler=sampler) if sampler else found
        else:
            found, *_ = load(named, "method")
    if isinstance(found, type) and issubclass(found, Method):
        try:
            found = found()
        except TypeError as error:
            raise ConfigError("", "method", f"{found.__name__} to need no arguments: {error}") from None
    if isinstance(found, Method):
        return found
    if not callable(found) or isinstance(found, type):
        raise ConfigError("", "method", "a name, a Method, or a function of a Task", f"{named!r}")
    return Function(found)
