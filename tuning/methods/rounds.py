"""Rounds of a search: a method asks for batches of points; they are evaluated, kept on disk, recorded and reported.

A method is deterministic, so a search that was killed goes on by running its method again from the start on the rounds
that its folder holds, without walking them: the result is that of an undisturbed search, bit by bit.
"""

import os
from collections.abc import Callable, Generator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.files.writing import OutputError
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import PREFIX
from tuning.methods.method import Request
from tuning.methods.parts import Parts
from tuning.problem.evaluation import Evaluation, Problem


class Progress(NamedTuple):
    """How far a search has come."""

    rounds: int
    rounds_in_all: int  # 0 where the method does not say
    phase: str
    best: float  # value of the best feasible point, NaN while there is none
    gradient_norm: float  # at the best point of the last round, NaN without gradients
    alive: int
    batch: int
    env_steps: int
    walked: bool  # False for a round that was found on disk


Callback = Callable[[Progress], None]


def counted(report: Callable[[int, int], None]) -> Callback:
    """Return a callback that reports how many rounds are done, and in all."""
    return lambda now: report(now.rounds, now.rounds_in_all)


def follow(
    points: Generator[Request, Evaluation, Any],
    evaluate: Callable[[Request], Evaluation],
    enough: Callable[[], bool] = lambda: False,
) -> bool:
    """Run a method, or a part of one, to its end, or until it is told after a round that it is `enough`.

    Returns:
        Whether it was.
    """
    try:
        request = next(points)
        while True:
            found = evaluate(request)
            if enough():
                points.close()
                return True
            request = points.send(found)
    except StopIteration:
        return False


TOLERANCE = 1e-3  # relative improvement below which a search has found nothing better


def settled(merits: np.ndarray, patience: int) -> bool:
    """Return whether the last so many evaluations bettered the best merit by less than `TOLERANCE`, relative.

    Arguments:
        merits: of all points evaluated so far, in order: value plus penalty, not finite where a walk diverged.
        patience: in evaluations, for any number of gains.
    """
    walked = np.where(np.isfinite(merits), merits, np.inf)
    if len(walked) <= patience or not np.isfinite(before := walked[:-patience].min()):
        return False
    return bool(before - walked.min() <= TOLERANCE * abs(before))


class Rounds(Parts):
    """Evaluates batches and keeps them; those that `out` holds from an interrupted run of the same are not walked."""

    def __init__(
        self,
        in_all: int,
        out: str | os.PathLike[str] | None,
        identity: Callable[[], Mapping[str, Any]],
        progress: Callback | None = None,
    ):
        super().__init__(out, identity)
        self.done, self.in_all, self.env_steps, self.best, self._progress = 0, in_all, 0, np.inf, progress
        self._columns: dict[str, list[np.ndarray]] = {}

    @property
    def evaluated(self) -> dict[str, np.ndarray]:
        """Every point evaluated so far, in order: the columns of `tuning.results.tuned.Tuned.data`."""
        return {name: np.concatenate(values) for name, values in self._columns.items()}

    def evaluate(self, problem: Problem, request: Request) -> Evaluation:
        """Return the evaluation of some points.

        Raises:
            ConfigError: a request that holds no points of the problem's space.
            OutputError: the round cannot be kept, or the folder holds another one in its place.
        """
        check_request(request, problem.space.size)
        stored = self.load(self.done)
        if stored is None:
            found = problem.evaluate(request.theta, request.directions)
            fields = found._asdict()
            metrics = {f"metric_{name}": values for name, values in fields.pop("metrics").items()}
            self.save(self.done, {"theta": request.theta, **fields, **metrics})
        elif np.array_equal(stored.pop("theta"), request.theta):
            metrics = {name.removeprefix("metric_"): v for name, v in stored.items() if name.startswith("metric_")}
            found = Evaluation(**{name: stored[name] for name in Evaluation._fields[:-1]}, metrics=metrics)
        else:
            again = f"(remove {self.out}/parts to start again)"
            raise OutputError(f"{self.out}: expected the rounds of this search, got others {again}")
        self.env_steps += problem.env_steps(len(request.theta), request.tangents)
        self._record(request, found)
        self.done += 1
        if self._progress is not None:
            norm = float(self._columns["gradient_norm"][-1][np.argmin(found.merit)])
            best, alive = self.best if np.isfinite(self.best) else np.nan, int(found.alive.sum())
            spent, walked, batch = self.env_steps, stored is None, len(request.theta)
            self._progress(Progress(self.done, self.in_all, request.phase, best, norm, alive, batch, spent, walked))
        return found

    def _record(self, request: Request, found: Evaluation) -> None:
        count = len(request.theta)
        columns: dict[str, Any] = {name: getattr(found, name) for name in ("value", "descent", "penalty", "feasible")}
        columns |= {"theta": np.asarray(request.theta, float), "row": np.arange(count)}
        norm = np.linalg.norm(found.gradient, axis=1) if request.tangents else np.nan
        each = {"gradient_norm": norm, "round": self.done, "phase": request.phase, "env_steps": self.env_steps}
        columns |= {name: np.full(count, value) for name, value in each.items()}
        columns |= {name: values for name, values in found.metrics.items() if not name.startswith(PREFIX)}
        for name, values in columns.items():
            self._columns.setdefault(name, []).append(values)
        self.best = float(np.nanmin([self.best, *found.value[found.feasible]]))


def check_request(request: Request, n: int) -> None:
    """Refuse by a ConfigError in one line a request without points (B, n)."""
    got = f"a {type(request).__name__}"
    if isinstance(request, Request):
        theta = np.asarray(request.theta)
        got = "" if theta.ndim == 2 and len(theta) and theta.shape[1] == n else f"{theta.shape}"
        got = got if np.isfinite(theta).all() else f"{theta.shape} with values that are not finite"
    if got:
        raise ConfigError("", "method", f"a Request of finite theta (B, {n})", got)
    if request.directions is not None and np.shape(request.directions)[1:] != (n,):
        raise ConfigError("", "method", f"directions (k, {n})", np.shape(request.directions))
