"""The problem of a fit: samples over their noise under Huber's loss, and priors, by single shooting.

A stretch of a log without gaps is simulated from its beginning to its end: the states that stretches begin with are
fitted beside the variables. Samples of one time stamp are whitened together where time stamps err, see
`tuning.identification.fit.stamps`.
"""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import lstsq

from tuning.identification.fit.prediction import predicted
from tuning.identification.fit.stamps import HUBER, Samples, whitened
from tuning.identification.model.predicted import LATENESS, Fit
from tuning.identification.model.windows import SHORTEST, Rows

Ending = Literal["converged", "out of iterations"]


class Prior(NamedTuple):
    mean: np.ndarray
    sd: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Evaluated(NamedTuple):
    """A model at a point."""

    residuals: Float[np.ndarray, " rows"]  # log less model, SI units
    scaled: Float[np.ndarray, " rows"]  # over their noise, whitened
    along: Float[np.ndarray, "rows N"]  # derivatives of the prediction, whitened alike
    rate: Float[np.ndarray, " rows"]  # SI units per s


class Fitted(NamedTuple):
    """Where a search ended."""

    x: Float[np.ndarray, " P"]
    start: Float[np.ndarray, "stretch limb joint S"]
    noise: Float[np.ndarray, " signals"]
    clock: float  # s, standard deviation of a time stamp's error
    residuals: Float[np.ndarray, " rows"]  # log less model, SI units
    scaled: Float[np.ndarray, " rows"]  # over their noise, whitened
    along: Float[np.ndarray, "rows P"]  # derivatives of the prediction, whitened, states eliminated
    information: Float[np.ndarray, "P P"]  # of the samples, states eliminated
    rate: Float[np.ndarray, " rows"]  # SI units per s
    cost: float  # with priors
    iterations: int
    ended: Ending
    costs: tuple[float, ...] = ()  # where the searches from all starts ended
    unsettled: float = 0.0  # relative change of the noise, were it estimated once more

    @property
    def weight(self) -> Float[np.ndarray, " rows"]:
        """Huber's, of each row."""
        return np.asarray(np.minimum(1.0, HUBER / np.maximum(np.abs(self.scaled), 1e-12)))


@dataclasses.dataclass(frozen=True)
class Problem:
    """A model of a log, the noise of each signal, and that of the time stamps."""

    model: Fit
    noise: Float[np.ndarray, " signals"]
    clock: float = 0.0  # s, standard deviation of a time stamp's error
    rate: Float[np.ndarray, " rows"] | None = None  # SI units per s, by which errors of time stamps count
    held: np.ndarray | None = None  # (P,) bool, variables that stay at their nominal values
    fitted: np.ndarray = dataclasses.field(init=False)  # (rows,) bool
    predicted: np.ndarray = dataclasses.field(init=False)  # (rows,) bool, held out

    def __post_init__(self) -> None:
        windows, rows = self.model.windows, self.model.windows.rows
        since = (rows.step + rows.share) * windows.time_step
        new, ahead = ~windows.abuts[rows.window], windows.held_out[rows.window]
        # behind a hole the first held-out samples alone say where the robot is
        first = new & (since < SHORTEST) & bool(self.model.guess.size)
        # samples that were recorded late begin before the stretch
        kinds = [number for number, kind in enumerate(windows.kind) if kind]
        early = new & (since < (self.model.LEADS or np.where(np.isin(rows.signal, kinds), -LATENESS[2], 0.0)))
        vars(self).update(fitted=(~ahead | first) & ~early, predicted=ahead & ~first & ~early)

    @property
    def rows(self) -> Rows:
        """The samples of the log."""
        return self.model.windows.rows

    @property
    def samples(self) -> Samples:
        """The samples as far as their noise asks for."""
        windows, rows = self.model.windows, self.rows
        moved = np.array([np.std(rows.value[rows.signal == n]) for n in range(len(windows.names))])
        return Samples(rows.signal, rows.stamp, self.fitted, windows.stamp_spacing, moved)

    @property
    def free(self) -> np.ndarray:
        """Which variables move, (P,) bool."""
        return np.full(len(self.model.variables), True) if self.held is None else ~self.held

    @property
    def prior(self) -> Prior:
        """Priors and bounds of the coordinates, (P,) each."""
        low, high = np.reshape([v.bounds for v in self.model.variables], (-1, 2)).T
        mean, sd = np.reshape([(v.mean, v.sd) for v in self.model.variables], (-1, 2)).T
        return Prior(mean, sd, low, high)

    @property
    def whole_prior(self) -> Prior:
        """Priors and bounds of the coordinates and the states that stretches begin with, (N,) each."""
        guess = self.model.guess
        sd = np.broadcast_to(self.model.guess_sd, guess.shape).ravel()
        end = np.full(guess.shape, np.inf)
        if guess.size and "bristle" in (names := self.model.memory):
            end[..., 2 + names.index("bristle")] = 1.0
        states = (guess.ravel(), sd, -end.ravel(), end.ravel())
        return Prior(*(np.concatenate(each) for each in zip(self.prior, states, strict=True)))

    def evaluate(self, point: Float[np.ndarray, " N"]) -> Evaluated | None:
        """The model at a point; None where it diverges."""
        count, rows = len(self.model.variables), self.rows
        made = predicted(self.model, point[:count], point[count:].reshape(self.model.guess.shape))
        if not made.finite:
            return None
        residuals, noise = rows.value - made.value, self.noise[rows.signal]
        both = np.column_stack([residuals, made.along]) / noise[:, None]
        if self.clock and self.rate is not None:
            late = np.where(self.fitted | self.predicted, self.rate, 0.0) * self.clock / noise
            both = whitened(both, late, rows.stamp)
        return Evaluated(residuals, both[:, 0], both[:, 1:], made.rate)

    def ended(self, point: Float[np.ndarray, " N"], cost: float, iterations: int, ended: Ending) -> Fitted:
        """Where a search ended, with the states of stretches eliminated."""
        found = self.evaluate(point)
        assert found is not None
        count, guess = len(self.model.variables), self.model.guess
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(found.scaled), 1e-12)) * self.fitted)
        along, of_states = np.split(found.along, [count], axis=1)
        if of_states.size:
            inverse = np.diag(1 / self.whole_prior.sd[count:])
            stacked = np.concatenate([weight[:, None] * of_states, inverse])
            sought = np.concatenate([weight[:, None] * along, np.zeros((len(inverse), count))])
            along = along - of_states @ lstsq(stacked, sought, lapack_driver="gelsy")[0]
        information = (weight[:, None] * along).T @ (weight[:, None] * found.along[:, :count])
        return Fitted(
            point[:count], point[count:].reshape(guess.shape), self.noise, self.clock, found.residuals, found.scaled,
            along, (information + information.T) / 2, found.rate, cost, iterations, ended,
        )  # fmt: skip
