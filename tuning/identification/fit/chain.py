"""The fit of a log whose windows go on from each other: normal equations without states of windows.

What windows miss of each other is nothing: each begins where the one before ends, for every variable exactly so.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.identification.fit.least_squares import DIVERGED, Fitted, LeastSquares, Normal
from tuning.identification.fit.stamps import stamped
from tuning.identification.model.gripped import FORCE_DELAY, LATE, GrippedModel
from tuning.identification.model.windows import KINDS

_UNSETTLED = 0.5  # s, at the beginning of a stretch, not fitted: the motion may go on there from before the log


class _Made(NamedTuple):
    """What was predicted at a point."""

    value: Float[np.ndarray, " rows"]
    along: Float[np.ndarray, "rows P"]  # along the variables


@dataclasses.dataclass(frozen=True)
class Chain(LeastSquares):
    """What is minimised of a gripped robot's log; its windows are those from the first on."""

    model: GrippedModel

    def __post_init__(self) -> None:
        super().__post_init__()
        rows, windows = self.rows, self.model.windows
        early = ~windows.abuts[rows.window] & ((rows.step + rows.share) * windows.time_step < _UNSETTLED)
        vars(self).update(fitted=self.fitted & ~early, predicted=self.predicted & ~early)

    def some(self, count: int) -> np.ndarray:
        """Return the first windows of those that are fitted."""
        return np.flatnonzero(~self.model.windows.held_out)[:count]

    def linearized(self, x: np.ndarray, start: np.ndarray) -> list[Normal]:
        """Return the normal equations at points x (points, P)."""
        return [self._normal(*each) for each in self._made(x)]

    def sensitivity(self, found: Fitted) -> Float[np.ndarray, "rows P"]:
        """Return the derivatives of all rows along the variables, SI units."""
        return self._made(found.x[None])[0].along

    def _made(self, x: np.ndarray) -> list[_Made]:
        count = len(self.rows.value)
        made = [_Made(np.full(count, np.nan), np.zeros((count, x.shape[1]))) for _ in x]
        for which, values, tangents in self.model.evaluate(x, len(self.which)):
            here = np.flatnonzero(np.isin(self.rows.window, which))
            of_window = np.searchsorted(which, self.rows.window[here])
            for k, point in enumerate(x):
                own, along = ({name: v[k] for name, v in each.items()} for each in (values, tangents))
                self._predict(made[k], point, (here, of_window), own, along)
        return made

    def _predict(
        self, made: _Made, x: np.ndarray, place: tuple[np.ndarray, np.ndarray], values: dict[str, Any],
        tangents: dict[str, Any],
    ) -> None:  # fmt: skip
        """Enter what was predicted of some rows, between the steps on a line; with the rows the places of windows."""
        here, of_window = place
        rows, windows, model = self.rows, self.model.windows, self.model
        keys = [v.key for v in model.variables]
        for number, kind in enumerate(KINDS):
            own = windows.kind[rows.signal[here]] == number
            chosen, w = here[own], of_window[own]
            if not len(chosen):
                continue
            limb, joint = windows.limb[rows.signal[chosen]], windows.joint[rows.signal[chosen]]
            late = [n for n, key in enumerate(keys) if kind in LATE.get(key, ())]
            delay = float(x[late].sum())
            if kind == "force" and FORCE_DELAY not in keys:
                delay += float(model.parameters.force_sensor.delay)
            at = rows.step[chosen] + rows.share[chosen] - delay / windows.time_step + windows.steps
            step = np.clip(np.floor(at), 0, 2 * windows.steps - 1).astype(int)
            share = at - step
            before, after = (values[kind][w, step + n, limb, joint] for n in (0, 1))
            first, last = (tangents[kind][w, :, step + n, limb, joint] for n in (0, 1))
            made.value[chosen] = before + share * (after - before)
            made.along[chosen] = first + share[:, None] * (last - first)
            made.along[np.ix_(chosen, late)] = ((before - after) / windows.time_step)[:, None]

    def _normal(self, value: np.ndarray, along: np.ndarray) -> Normal:
        """Return the sums of samples."""
        rows, count, windows = self.rows, along.shape[1], len(self.which)
        fitted = self.fitted
        finite = bool((np.abs(value) < DIVERGED).all() and (np.abs(along) < DIVERGED).all())
        value, along = (v if finite else np.zeros_like(v) for v in (value, along))
        residuals = rows.value - value
        # time stamps are taken as they are
        late = stamped(residuals, np.zeros_like(residuals), fitted, rows.stamp, self.noise[rows.signal], 0.0)
        none, weighted = np.zeros((0, windows, 0)), along * late.weight[:, None]
        return Normal(
            cost=late.cost if finite else np.inf, gradient=weighted.T @ residuals, hessian=weighted.T @ along,
            state_gradient=none, state_hessian=none[..., None], onward=none[..., None],
            mixed=np.zeros((0, windows, count, 0)), residuals=residuals, stamps=late,
        )  # fmt: skip
