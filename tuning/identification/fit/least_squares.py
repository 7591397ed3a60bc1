"""What a fit minimises, its normal equations, and their solution.

Windows of a limb form a chain, so that the states that they begin with are eliminated by a banded solve, and a small
system of the variables is left.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.linalg import norm
from scipy.linalg import solveh_banded

from tuning.identification.fit.stamps import Stamped
from tuning.identification.model.predicted import Fit
from tuning.identification.model.windows import SHORTEST

DIVERGED = 1e20  # SI units: squares of larger values and derivatives tell nothing, or overflow
_SOLVED = 1e-6  # relative residual of the states' equations


class Normal(NamedTuple):
    """The normal equations at a point, without priors of the variables; P variables, D numbers of a limb's state.

    Where time stamps err, there is one limb that has the states of all.
    """

    cost: float
    gradient: Float[np.ndarray, " P"]
    hessian: Float[np.ndarray, "P P"]
    state_gradient: Float[np.ndarray, "limb window D"]
    state_hessian: Float[np.ndarray, "limb window D D"]
    onward: Float[np.ndarray, "limb window D D"]  # of a window's state and that of the window before
    mixed: Float[np.ndarray, "limb window P D"]
    residuals: Float[np.ndarray, " rows"]  # in SI units, of all rows, less what their time stamps' errors make
    stamps: Stamped


Ending = Literal["converged", "stuck", "out of iterations"]


class Fitted(NamedTuple):
    """Where a search ended."""

    x: Float[np.ndarray, " P"]
    start: Float[np.ndarray, "window limb joint S"]
    noise: Float[np.ndarray, " signals"]
    clock: float  # s, standard deviation of a time stamp's error
    normal: Normal
    cost: float  # with priors
    iterations: int
    away: Float[np.ndarray, " P"]  # standard deviations that one more step without damping would move a variable by
    ended: Ending
    unsettled: float = 0.0  # relative change of the noise, were it estimated once more


@dataclasses.dataclass(frozen=True)
class LeastSquares:
    """What is minimised: a model, some windows of its log, the noise of each signal, and that of the time stamps."""

    model: Fit
    which: np.ndarray  # windows, in order
    noise: Float[np.ndarray, " signals"]
    clock: float = 0.0  # s, standard deviation of a time stamp's error

    def __post_init__(self) -> None:
        windows = self.model.windows
        place = np.full(len(windows.begin), -1)
        place[self.which] = np.arange(len(self.which))
        inside = place[windows.rows.window] >= 0
        rows = type(windows.rows)(*(column[inside] for column in windows.rows))
        order = np.lexsort((windows.limb[rows.signal], rows.window))
        rows = type(rows)(*(column[order] for column in rows))
        ahead = windows.held_out[rows.window]
        # behind a hole nothing says where the robot is but the first of what is held out
        first = ~windows.abuts[rows.window] & ((rows.step + rows.share) * windows.time_step < SHORTEST)
        vars(self).update(
            rows=rows,
            place=place[rows.window],
            limb=windows.limb[rows.signal],
            fitted=~ahead | first,
            predicted=ahead & ~first,
            inside=np.flatnonzero(inside)[order],
        )

    rows: Any = dataclasses.field(init=False, default=None)
    place: Any = dataclasses.field(init=False, default=None)  # of the window of each row in `which`
    limb: Any = dataclasses.field(init=False, default=None)
    fitted: Any = dataclasses.field(init=False, default=None)  # (rows,) bool
    predicted: Any = dataclasses.field(init=False, default=None)  # (rows,) bool, held out
    inside: Any = dataclasses.field(init=False, default=None)  # of the model's rows

    @property
    def guess(self) -> np.ndarray:
        """First guesses of the windows' states (windows, ...), as far as they are fitted."""
        return np.zeros((len(self.which), 0))

    def some(self, count: int) -> np.ndarray:
        """Return a few windows of those that are fitted, on which points can be compared."""
        raise NotImplementedError

    def linearized(self, x: np.ndarray, start: np.ndarray) -> list[Normal]:
        """Return the normal equations at points x (points, P) and states (points, windows, ...)."""
        raise NotImplementedError

    def sensitivity(self, found: Fitted) -> Float[np.ndarray, "rows P"]:
        """Return the derivatives of all rows along the variables, with the states of windows eliminated, SI units."""
        raise NotImplementedError


def scaled_residuals(problem: LeastSquares, normal: Normal) -> Float[np.ndarray, " rows"]:
    """Return residuals over their noise; that of what was not fitted has the errors of its time stamps in it."""
    noise, stamps = problem.noise[problem.rows.signal], normal.stamps
    return np.asarray(normal.residuals / np.hypot(noise, np.where(problem.fitted, 0.0, problem.clock * stamps.rate)))


# ----------------------------------------------------------------------------------------------------- linear algebra


def _banded(normal: Normal, limb: int, damping: float) -> np.ndarray:
    """Return the states' matrix of one limb in SciPy's lower banded form, its diagonal raised by a share."""
    diagonal, onward = normal.state_hessian[limb], normal.onward[limb]
    windows, width = diagonal.shape[:2]
    band = np.zeros((2 * width, windows * width))
    for a in range(width):
        for b in range(width):
            if b <= a:
                band[a - b, b::width] = diagonal[:, a, b] * (1 + damping * (a == b))
            band[width + a - b, b : (windows - 1) * width : width] = onward[1:, a, b]
    return band


def eliminated(normal: Normal, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return gradient and matrix of the variables with the states eliminated, and by limb what eliminates them.

    The latter are (windows D, P + 1): the states' answer to the variables, and their own step.
    """
    gradient, matrix, ways = normal.gradient.copy(), normal.hessian.copy(), []
    matrix[np.diag_indices_from(matrix)] *= 1 + damping
    for n in range(len(normal.mixed)):
        mixed = normal.mixed[n].swapaxes(1, 2).reshape(-1, len(gradient))
        right = np.concatenate([mixed, normal.state_gradient[n].reshape(-1, 1)], axis=1)
        way = _solved(_banded(normal, n, damping), right)
        matrix -= mixed.T @ way[:, :-1]
        gradient -= mixed.T @ way[:, -1]
        ways.append(way)
    return gradient, matrix, ways


def _solved(band: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution for a banded matrix, raised as that of `_factor`: states may hardly move what is measured."""
    diagonal = np.zeros_like(band)
    diagonal[0] = np.maximum(band[0], 1e-300)

    def solution(share: float) -> np.ndarray:
        raised = band + share * diagonal
        found = solveh_banded(raised, right, lower=True)
        # a matrix that is singular to rounding may have a factor all the same
        if (norm(_times(raised, found) - right, axis=0) > _SOLVED * norm(right, axis=0)).any():
            raise np.linalg.LinAlgError
        return np.asarray(found)

    return np.asarray(raised(solution))


def _times(band: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the product of a symmetric matrix in SciPy's lower banded form with columns (n, k)."""
    product: np.ndarray = band[0][:, None] * values
    size = len(values)
    for below, row in enumerate(band[1:], start=1):
        product[below:] += row[: size - below, None] * values[: size - below]
        product[: size - below] += row[: size - below, None] * values[below:]
    return product


def raised(solve: Callable[[float], Any]) -> Any:
    """Return `solve` with the least share of the diagonal that makes its matrix positive definite."""
    for share in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-3, 1.0):
        try:
            return solve(share)
        except np.linalg.LinAlgError:
            continue
    raise FloatingPointError("the normal equations are not finite")
