"""Multiple shooting: each limb begins each window in a state of its own, which is fitted beside the variables.

Residuals are the samples over their noise under Huber's loss, what a window's end misses of the next one's beginning
over a small tolerance, and priors. Where time stamps err, the states of all limbs form one chain: what was sampled at a
stamp is late together (`tuning.identification.fit.stamps`).

References:
    H. G. Bock, Recent Advances in Parameter Identification Techniques for O.D.E., 1983.
    P. J. Huber, Robust Statistics, 1981.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.identification.fit.least_squares import DIVERGED, Fitted, LeastSquares, Normal, eliminated
from tuning.identification.fit.stamps import stamped
from tuning.identification.model.predicted import LATE, MEMORY, Model
from tuning.identification.model.windows import KINDS, Windows

_STATE = (0.2, 3.0)  # prior sd of a start from its guess: rad, rad/s
_TIGHT = 0.05  # of the noise, what a window's end may miss


class Problem(LeastSquares):
    """What is minimised where each limb begins each window in a state of its own."""

    model: Model

    @property
    def follows(self) -> np.ndarray:
        """Which windows go on from the one before, (windows,) bool."""
        return np.asarray(self.model.windows.abuts[self.which] & np.isin(self.which - 1, self.which))

    def some(self, count: int) -> np.ndarray:
        """Return windows from all over the log."""
        fitted = np.flatnonzero(~self.model.windows.held_out)
        return np.asarray(fitted[np.unique(np.linspace(0, len(fitted) - 1, count).round().astype(int))])

    def linearized(self, x: np.ndarray, start: np.ndarray) -> list[Normal]:
        """Return the normal equations at points x (points, P) and starts (points, windows, limb, joint, S)."""
        values, tangents = self.model.evaluate(x, start, self.which)
        found = []
        for k in range(len(x)):
            own, along = ({name: v[k] for name, v in each.items()} for each in (values, tangents))
            finite = all((np.abs(v) < DIVERGED).all() for each in (own, along) for v in each.values())
            if not finite:  # the model diverges there: a point to keep away from
                own, along = ({name: np.zeros_like(v) for name, v in each.items()} for each in (own, along))
            normal = _normal(self, x[k], start[k], own, along)
            found.append(normal if finite else normal._replace(cost=np.inf))
        return found

    def sensitivity(self, found: Fitted) -> Float[np.ndarray, "rows P"]:
        """Return the derivatives of all rows along the variables, with the states of windows eliminated, SI units."""
        values, tangents = self.model.evaluate(found.x[None], found.start[None], self.which)
        own, along = ({name: v[0] for name, v in each.items()} for each in (values, tangents))
        count, limbs, windows = len(found.x), self.model.sizes[0], len(self.which)
        _, _, ways = eliminated(found.normal)
        answer = np.stack([way[:, :-1] for way in ways])
        if len(ways) < limbs:  # one chain of the states of all limbs, window by window
            answer = answer.reshape(windows, limbs, -1, count).swapaxes(0, 1)
        answer = answer.reshape(limbs, windows, -1, count)
        found_rows = np.zeros((len(self.rows.value), count))
        for first, last, w, n, jacobian in _jacobians(self, _predicted(self, found.x, own, along)):
            found_rows[first:last] = jacobian[:, :count] - jacobian[:, count:] @ answer[n, w]
        return found_rows

    @property
    def guess(self) -> np.ndarray:
        """First guesses of the starts (windows, limb, joint, S): a bristle is bent by the motion."""
        known = self.model.windows.start[self.which]
        guesses = {"bristle": 0.9 * np.tanh(known[..., 1] / 0.05), "loop.goal": known[..., 0]}
        own = [guesses.get(name, np.zeros(known.shape[:-1])) for name in self.model.memory]
        return np.concatenate([known, *(each[..., None] for each in own)], axis=-1)

    @property
    def state_scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Prior sd of a limb's state from its guess, and what it may miss of the window before, (limb, D) each."""
        limbs, joints, size = self.model.sizes
        windows = self.model.windows
        prior, tight = np.zeros((limbs, joints, size)), np.zeros((limbs, joints, size))
        prior[..., :2] = _STATE
        for n, name in enumerate(self.model.memory, 2):
            prior[..., n], tight[..., n] = MEMORY[name]
        for kind, typical in ((0, 1e-3), (1, 3e-2)):
            noise = np.full((limbs, joints), np.nan)
            of_kind = windows.kind == kind
            noise[windows.limb[of_kind], windows.joint[of_kind]] = self.noise[of_kind]
            tight[..., kind] = _TIGHT * np.where(np.isfinite(noise), noise, typical)
        return prior.reshape(limbs, -1), tight.reshape(limbs, -1)


class _Predicted(NamedTuple):
    value: np.ndarray  # (rows,)
    along: np.ndarray  # (rows, lanes)
    late: np.ndarray  # (rows, 2), per delay of what is recorded, in the order of LATE
    rate: np.ndarray  # (rows,) SI units per s: what a sample changes by, taken a second later
    known: np.ndarray  # (rows,) bool: not of the time before the window


def _predicted(problem: Problem, x: np.ndarray, values: dict[str, Any], tangents: dict[str, Any]) -> _Predicted:
    """Return the prediction of each row, and its derivatives.

    Between the steps angles and rates are on a parabola, efforts on a line. A rate bends where the command jumps, and
    the step there has its mean: it is on a parabola of the steps on its own side of the jump.
    """
    rows, windows, delay = problem.rows, problem.model.windows, problem.model.torque_delay(x)
    delays = {v.key: float(each) for v, each in zip(problem.model.variables, x, strict=True) if v.key in LATE}
    count, lanes = len(rows.value), next(iter(tangents.values())).shape[1]
    made = _Predicted(
        np.zeros(count), np.zeros((count, lanes)), np.zeros((count, 2)), np.zeros(count), np.ones(count, bool)
    )
    for number, kind in enumerate(KINDS):
        chosen = np.flatnonzero(windows.kind[rows.signal] == number)
        if not len(chosen):
            continue
        w, limb, joint = problem.place[chosen], problem.limb[chosen], windows.joint[rows.signal[chosen]]
        key = next((key for key, late in LATE.items() if late == kind), "")
        at = rows.step[chosen] + rows.share[chosen] - delays.get(key, 0.0) / windows.time_step
        step, across = np.clip(np.floor(at), 0, windows.steps - 1).astype(int), np.ones(len(at), int)
        if kind == "velocity":
            step, across = _beside_jumps(windows, rows.signal[chosen], (rows.window[chosen], at, step), delay)
        share = at - step
        before, after = (values[kind][w, step + n, limb, joint] for n in (0, 1))
        made.value[chosen] = before + share * (after - before)
        before, later = (tangents[kind][w, :, step + n, limb, joint] for n in (0, 1))
        made.along[chosen] = before + share[:, None] * (later - before)
        slope = values[kind][w, step + 1, limb, joint] - values[kind][w, step, limb, joint]
        if kind != "effort":
            # a step's rate is the mean over the step: at its middle less a 24th of the second difference
            far = share * (share - 1) / 4 - (1 / 48 if kind == "velocity" else 0.0)
            for n, k in itertools.product((0, 1), (-1, 0, 1)):
                at_k, factor = np.clip(step + n * across, 1, windows.steps - 1) + k, 1 - 3 * (k == 0)
                there = values[kind][w, at_k, limb, joint]
                made.value[chosen] += factor * far * there
                made.along[chosen] += factor * far[:, None] * tangents[kind][w, :, at_k, limb, joint]
                slope += factor * (share / 2 - 0.25) * there
        made.rate[chosen] = slope / windows.time_step
        if key in delays:
            made.late[chosen, list(LATE).index(key)] = -made.rate[chosen]
            made.known[chosen] = at >= -1e-6
    return made


def _beside_jumps(
    windows: Windows, signal: np.ndarray, place: tuple[np.ndarray, np.ndarray, np.ndarray], delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps from which rates are predicted, and 1, or 0 where that is by one parabola about the step.

    Arguments:
        windows: of the log.
        signal: of each row.
        place: the rows' windows, where in them rates are sought, in steps, and the step before.
        delay: of torques behind commands, s.
    """
    window, at, step = place
    before, after = windows.jumps(signal, windows.begin[window] + (at - 0.5) * windows.time_step - delay)
    before, after = (at + jump / windows.time_step for jump in (before, after))
    # the step within half a step of a jump has a part of it; a parabola takes three
    first = np.maximum(np.ceil(before + 1.5 - 1e-6), 1)
    last = np.minimum(np.floor(after - 1.5 + 1e-6), windows.steps - 1)
    one_sided = ((before > step - 1.5) | (after < step + 2.5)) & (first <= last)
    center = np.where(one_sided, np.clip(np.rint(at), first, last), step)
    return center.astype(int), np.where(one_sided, 0, 1)


def _normal(
    problem: Problem, x: np.ndarray, start: np.ndarray, values: dict[str, Any], tangents: dict[str, Any]
) -> Normal:
    """Return the sums of samples, of priors of the starts, and of the continuity residuals."""
    limbs, joints, size = problem.model.sizes
    count, windows, width = len(problem.model.variables), len(problem.which), joints * size
    made = _predicted(problem, x, values, tangents)
    fitted, residuals = problem.fitted & made.known, problem.rows.value - made.value
    late = stamped(residuals, made.rate, fitted, problem.rows.stamp, problem.noise[problem.rows.signal], problem.clock)
    sums = Normal(
        cost=0.0, gradient=np.zeros(count), hessian=np.zeros((count, count)),
        state_gradient=np.zeros((limbs, windows, width)), state_hessian=np.zeros((limbs, windows, width, width)),
        onward=np.zeros((limbs, windows, width, width)), mixed=np.zeros((limbs, windows, count, width)),
        residuals=residuals - made.rate * late.error, stamps=late,
    )  # fmt: skip
    together = _add_samples(problem, sums, made)
    cost = late.cost + _add_guesses(problem, sums, start)
    cost += _add_gaps(problem, sums, start, values["end"], tangents["end"])
    return (_with_stamps(problem, sums, together) if problem.clock else sums)._replace(cost=cost)


def _add_samples(problem: Problem, sums: Normal, made: _Predicted) -> np.ndarray:
    """Add what the samples say to the sums, and return how stamps' errors go with variables and states of limbs.

    The latter is (stamps, P + limbs D) of the same matrix, empty without such errors.
    """
    limbs, count = len(sums.mixed), len(sums.gradient)
    weight, width = sums.stamps.weight, sums.state_gradient.shape[2]
    together = np.zeros((len(sums.stamps.stiffness), count + limbs * width))
    for first, last, w, n, jacobian in _jacobians(problem, made):
        weighted = jacobian * weight[first:last, None]
        gradient, product = weighted.T @ sums.residuals[first:last], weighted.T @ jacobian
        sums.gradient[:] += gradient[:count]
        sums.state_gradient[n, w] += gradient[count:]
        sums.hessian[:] += product[:count, :count]
        sums.state_hessian[n, w] += product[count:, count:]
        sums.mixed[n, w] += product[:count, count:]
        if problem.clock:
            there, own = problem.rows.stamp[first:last], weighted * made.rate[first:last, None]
            np.add.at(together[:, :count], there, own[:, :count])
            np.add.at(together[:, count + n * width : count + (n + 1) * width], there, own[:, count:])
    return together


def _jacobians(problem: Problem, made: _Predicted) -> Iterator[tuple[int, int, int, int, np.ndarray]]:
    """Yield runs of rows (first, last) of a window and a limb, and their derivatives (rows, P + D)."""
    model, limbs = problem.model, problem.model.sizes[0]
    group = problem.place * limbs + problem.limb
    late = [(place, list(LATE).index(v.key)) for place, v in enumerate(model.variables) if v.key in LATE]
    for first, last in _runs(group):
        w, n = divmod(int(group[first]), limbs)
        own, (column, moves) = made.along[first:last], _columns(model, n)
        jacobian = np.concatenate([own[:, column] * moves, own[:, len(model.lanes) :]], axis=1)
        for place, kind in late:
            jacobian[:, place] = made.late[first:last, kind]
        yield first, last, w, n, jacobian


def _with_stamps(problem: Problem, sums: Normal, together: np.ndarray) -> Normal:
    """Return the sums with the errors of time stamps eliminated, all limbs' states as one block."""
    limbs, windows, width = sums.state_gradient.shape
    count = len(sums.gradient)
    window = np.zeros(len(together), int)
    window[problem.rows.stamp] = problem.place
    borne = together / np.sqrt(sums.stamps.stiffness)[:, None]
    hessian, onward = np.zeros((2, 1, windows, limbs * width, limbs * width))
    mixed = sums.mixed.transpose(1, 2, 0, 3).reshape(1, windows, count, limbs * width)
    for n in range(limbs):
        own = slice(n * width, (n + 1) * width)
        hessian[0, :, own, own], onward[0, :, own, own] = sums.state_hessian[n], sums.onward[n]
    for w in range(windows):
        of_x, of_states = np.split(borne[window == w], [count], axis=1)
        sums.hessian[:] -= of_x.T @ of_x
        hessian[0, w] -= of_states.T @ of_states
        mixed[0, w] -= of_x.T @ of_states

    def of_all(each: np.ndarray) -> np.ndarray:
        return each.swapaxes(0, 1).reshape(1, windows, limbs * width)

    return sums._replace(
        state_gradient=of_all(sums.state_gradient), state_hessian=hessian, onward=onward, mixed=mixed,
    )  # fmt: skip


def _add_guesses(problem: Problem, sums: Normal, start: np.ndarray) -> float:
    """Add the priors of the starts to the sums, and return their cost."""
    prior, _ = problem.state_scales
    limbs, windows, width = sums.state_gradient.shape
    off = (problem.guess - start).reshape(windows, limbs, width).swapaxes(0, 1) / prior[:, None]
    sums.state_gradient[:] += off / prior[:, None]
    sums.state_hessian[:] += np.apply_along_axis(np.diag, 1, 1 / prior**2)[:, None]
    return float((off**2).sum()) / 2


def _add_gaps(problem: Problem, sums: Normal, start: np.ndarray, ends: np.ndarray, along: np.ndarray) -> float:
    """Add the continuity residuals between windows to the sums, and return their cost.

    `ends` are (windows, limb, joint, S), their tangents `along` (windows, lanes, limb, joint, S).
    """
    _, tight = problem.state_scales
    cost, lanes, width = 0.0, len(problem.model.lanes), tight.shape[1]
    for w in np.flatnonzero(problem.follows).tolist():
        for n in range(len(tight)):
            column, share = _columns(problem.model, n)
            end = along[w - 1][:, n].reshape(-1, width).T / tight[n][:, None]  # (D, lanes)
            to_x, to_state = end[:, column] * share, end[:, lanes:]
            gap = (start[w, n].ravel() - ends[w - 1, n].ravel()) / tight[n]
            back = np.diag(-1 / tight[n])
            cost += float((gap**2).sum()) / 2
            sums.gradient[:] += to_x.T @ gap
            sums.state_gradient[n, w - 1] += to_state.T @ gap
            sums.state_gradient[n, w] += back.T @ gap
            sums.hessian[:] += to_x.T @ to_x
            sums.state_hessian[n, w - 1] += to_state.T @ to_state
            sums.state_hessian[n, w] += back.T @ back
            sums.mixed[n, w - 1] += to_x.T @ to_state
            sums.mixed[n, w] += to_x.T @ back
            sums.onward[n, w] = back.T @ to_state
    return cost


def _runs(group: np.ndarray) -> list[tuple[int, int]]:
    ends = np.flatnonzero(np.diff(group)) + 1
    return list(zip(np.r_[0, ends], np.r_[ends, len(group)], strict=True)) if len(group) else []


def _columns(model: Model, limb: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which lane holds each variable's tangent, and whether the variable moves this limb."""
    lane = np.zeros(len(model.variables), int)
    for n, together in enumerate(model.lanes):
        lane[together] = n
    return lane, np.array([v.limb in (None, limb) and v.key not in LATE for v in model.variables], float)
