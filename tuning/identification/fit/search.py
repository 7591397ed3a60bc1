"""The search: SciPy's trust region within bounds, from each of several points, by the model's exact derivatives."""

import functools
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from tuning.identification.fit.problem import Fitted, Prior, Problem
from tuning.identification.fit.stamps import HUBER
from tuning.methods.parts import Parts

Progress = Callable[[int, int, str], None]
TOLERANCE = 1e-5  # relative gain in the cost, relative step
_ON_BOUND = 1e-3  # of the prior's sd, nearer to a bound than which a point is set on it


class Searches:
    """The searches of a fit, one by one: shown, and those that ended kept in a folder. The fit is deterministic."""

    def __init__(self, parts: Parts, progress: Progress | None = None):
        """Take the folder, and a function of evaluations done, at most to do, and a line."""
        self._parts, self._progress, self._number, self._done = parts, progress, 0, 0

    def search(
        self, problem: Problem, point: np.ndarray, most: int, text: str, tolerance: float = TOLERANCE
    ) -> Fitted | None:
        """Where the search from a point (N,) ends after at most so many evaluations; None where the model diverges.

        Raises:
            OutputError: the end cannot be kept.
        """
        self._number += 1
        if (kept := self._parts.load(self._number)) is not None:
            end, (cost, count, converged) = kept["point"], kept["end"].tolist()
        else:
            end, cost, count, converged = self._ended(problem, point, most, text, tolerance)
            self._parts.save(self._number, {"point": end, "end": np.array([cost, count, converged])})
        self._done += int(count)
        if not np.isfinite(cost):
            return None
        return problem.ended(end, cost, int(count), "converged" if converged else "out of iterations")

    def _ended(
        self, problem: Problem, point: np.ndarray, most: int, text: str, tolerance: float
    ) -> tuple[np.ndarray, float, int, bool]:
        costs: list[float] = []

        def tell(cost: float) -> None:
            costs.append(cost)
            if self._progress is not None:
                done = self._done + len(costs)
                self._progress(done, max(done, self._done + most), f"{text}: cost {min(costs):.6g}")

        whole, objective = problem.whole_prior, _Objective(problem, point, tell)
        prior, first = Prior(*(each[objective.moves] for each in whole)), objective.point[objective.moves]
        if not np.isfinite(objective.residuals(first)).all():
            return objective.point, np.inf, 1, False
        found = least_squares(
            objective.residuals, first, objective.derivatives, (prior.lower, prior.upper), "trf", ftol=tolerance,
            xtol=tolerance, gtol=1e-8, x_scale=prior.sd, max_nfev=most,
        )  # fmt: skip
        end = found.x
        for bound, outwards in ((prior.lower, found.grad > 0), (prior.upper, found.grad < 0)):
            end = np.where((np.abs(end - bound) < _ON_BOUND * prior.sd) & outwards, bound, end)
        if (end != found.x).any() and problem.evaluate(objective.whole(end)) is None:  # no derivative on the bound
            end = found.x
        return objective.whole(end), float(found.cost), len(costs), found.status > 0


class _Objective:
    """Residuals of the samples and the priors as SciPy takes them: half the sum of their squares is the cost."""

    def __init__(self, problem: Problem, point: np.ndarray, tell: Callable[[float], None]):
        """Take a point (N,), whose held variables stay, and a function of the cost of each point."""
        self._problem, self._prior, self._tell = problem, problem.whole_prior, tell
        self.point = np.clip(point, self._prior.lower, self._prior.upper)
        self.moves = np.concatenate([problem.free, np.full(len(point) - len(problem.free), True)])
        self._of = functools.lru_cache(1)(self._evaluated)  # SciPy asks for both of a point, one after the other

    def whole(self, moving: np.ndarray) -> np.ndarray:
        """The point with other values of the moving variables."""
        point: np.ndarray = self.point.copy()
        point[self.moves] = moving
        return point

    def residuals(self, moving: np.ndarray) -> np.ndarray:
        """Residuals at a point; not finite where the model diverges."""
        return self._of(moving.tobytes())[0]

    def derivatives(self, moving: np.ndarray) -> np.ndarray:
        """Derivatives of the residuals."""
        return self._of(moving.tobytes())[1]

    def _evaluated(self, moving: bytes) -> tuple[np.ndarray, np.ndarray]:
        point, fitted = self.whole(np.frombuffer(moving)), self._problem.fitted
        found, off = self._problem.evaluate(point), ((point - self._prior.mean) / self._prior.sd)[self.moves]
        if found is None:
            self._tell(np.inf)
            return np.full(int(fitted.sum()) + len(off), np.nan), np.zeros(0)
        size = np.abs(found.scaled[fitted])
        # Huber's loss as a square; a sample in its tail keeps half of its curvature
        root = np.where(size < HUBER, size, np.sqrt(np.maximum(2 * HUBER * size - HUBER**2, 0.0)))
        slope = np.where(size < HUBER, 1.0, HUBER / np.maximum(root, HUBER))
        residuals: np.ndarray = np.concatenate([np.sign(found.scaled[fitted]) * root, off])
        along = -found.along[np.ix_(fitted, self.moves)] * slope[:, None]
        derivatives = np.concatenate([along, np.diag(1 / self._prior.sd[self.moves])])
        self._tell(float(residuals @ residuals) / 2)
        return residuals, derivatives
