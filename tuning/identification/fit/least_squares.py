"""Multiple shooting by Levenberg and Marquardt: variables, and the state that each limb begins each window in.

Residuals are the samples over their noise under Huber's loss, what a window's end misses of the next one's beginning
over a small tolerance, and priors. Windows of a limb form a chain, so that their states are eliminated by a banded
solve, and a small system of the variables is left. Where time stamps err, the states of all limbs form one chain: what
was sampled at a stamp is late together (`tuning.identification.fit.stamps`).

References:
    H. G. Bock, Recent Advances in Parameter Identification Techniques for O.D.E., 1983.
    P. J. Huber, Robust Statistics, 1981.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.linalg import norm
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from tuning.identification.fit.iterates import Iterate, Iterates
from tuning.identification.fit.stamps import Stamped, stamped
from tuning.identification.model.predicted import LATE, MEMORY, Fit, Model
from tuning.identification.model.windows import KINDS, SHORTEST, Windows

_STATE = (0.2, 3.0)  # prior sd of a start from its guess: rad, rad/s
_TIGHT = 0.05  # of the noise, what a window's end may miss
_ENOUGH = 0.02  # decrease of the cost, half a chi^2, at which the search ends
_SOLVED = 1e-6  # relative residual of the states' equations
DIVERGED = 1e20  # SI units: squares of larger values and derivatives tell nothing, or overflow
_DAMPING, _SOFTER, _HARDER, _MOST = 1e-4, 0.1, 10.0, 1e3


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
    by_block: Float[np.ndarray, "limb window P"]  # gradients of a limb's samples in a window
    state_by_block: Float[np.ndarray, "limb window D"]
    residuals: Float[np.ndarray, " rows"]  # in SI units, of all rows, less what their time stamps' errors make
    stamps: Stamped


class Fitted(NamedTuple):
    """Where a search ended."""

    x: Float[np.ndarray, " P"]
    start: Float[np.ndarray, "window limb joint S"]
    noise: Float[np.ndarray, " signals"]
    clock: float  # s, standard deviation of a time stamp's error
    normal: Normal
    cost: float  # with priors
    iterations: int
    converged: bool


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
        return linearized(self, x, start)

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


def linearized(problem: Problem, x: np.ndarray, start: np.ndarray) -> list[Normal]:
    """Return the normal equations at points x (points, P) and starts (points, windows, limb, joint, S)."""
    values, tangents = problem.model.evaluate(x, start, problem.which)
    found = []
    for k in range(len(x)):
        own, along = ({name: v[k] for name, v in each.items()} for each in (values, tangents))
        finite = all((np.abs(v) < DIVERGED).all() for each in (own, along) for v in each.values())
        if not finite:  # the model diverges there: a point to keep away from
            own, along = ({name: np.zeros_like(v) for name, v in each.items()} for each in (own, along))
        normal = _normal(problem, x[k], start[k], own, along)
        found.append(normal if finite else normal._replace(cost=np.inf))
    return found


class _Predicted(NamedTuple):
    value: np.ndarray  # (rows,)
    along: np.ndarray  # (rows, lanes)
    late: np.ndarray  # (rows, 2), per delay of what is recorded, in the order of LATE
    rate: np.ndarray  # (rows,) SI units per s: what a sample changes by, taken a second later
    known: np.ndarray  # (rows,) bool: not of the time before the window


def _predicted(problem: Problem, x: np.ndarray, values: dict[str, Any], tangents: dict[str, Any]) -> _Predicted:
    """Return what was predicted for each row, and its derivatives.

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
    """Return the sums of samples, of priors of the starts, and of what windows' ends miss."""
    limbs, joints, size = problem.model.sizes
    count, windows, width = len(problem.model.variables), len(problem.which), joints * size
    made = _predicted(problem, x, values, tangents)
    fitted, residuals = problem.fitted & made.known, problem.rows.value - made.value
    late = stamped(residuals, made.rate, fitted, problem.rows.stamp, problem.noise[problem.rows.signal], problem.clock)
    sums = Normal(
        cost=0.0, gradient=np.zeros(count), hessian=np.zeros((count, count)),
        state_gradient=np.zeros((limbs, windows, width)), state_hessian=np.zeros((limbs, windows, width, width)),
        onward=np.zeros((limbs, windows, width, width)), mixed=np.zeros((limbs, windows, count, width)),
        by_block=np.zeros((limbs, windows, count)), state_by_block=np.zeros((limbs, windows, width)),
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
    model, limbs, count, lanes = problem.model, len(sums.mixed), len(sums.gradient), len(problem.model.lanes)
    weight, width = sums.stamps.weight, sums.state_gradient.shape[2]
    together = np.zeros((len(sums.stamps.stiffness), count + limbs * width))
    group = problem.place * limbs + problem.limb
    late = [(place, list(LATE).index(v.key)) for place, v in enumerate(model.variables) if v.key in LATE]
    for first, last in _runs(group):
        w, n = divmod(int(group[first]), limbs)
        own, (column, moves) = made.along[first:last], _columns(model, n)
        jacobian = np.concatenate([own[:, column] * moves, own[:, lanes:]], axis=1)
        for place, kind in late:
            jacobian[:, place] = made.late[first:last, kind]
        weighted = jacobian * weight[first:last, None]
        gradient, product = weighted.T @ sums.residuals[first:last], weighted.T @ jacobian
        sums.by_block[n, w] += gradient[:count]
        sums.state_by_block[n, w] += gradient[count:]
        sums.hessian[:] += product[:count, :count]
        sums.state_hessian[n, w] += product[count:, count:]
        sums.mixed[n, w] += product[:count, count:]
        if problem.clock:
            there, own = problem.rows.stamp[first:last], weighted * made.rate[first:last, None]
            np.add.at(together[:, :count], there, own[:, :count])
            np.add.at(together[:, count + n * width : count + (n + 1) * width], there, own[:, count:])
    sums.gradient[:] += sums.by_block.sum((0, 1))
    sums.state_gradient[:] += sums.state_by_block
    return together


def _with_stamps(problem: Problem, sums: Normal, together: np.ndarray) -> Normal:
    """Return the sums with the errors of time stamps eliminated: as of one limb that has the states of all."""
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
        by_block=sums.by_block.sum(0, keepdims=True), state_by_block=of_all(sums.state_by_block),
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
    """Add what windows' ends miss of the next ones' starts to the sums, and return the cost.

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


def condensed_by_block(normal: Normal) -> Float[np.ndarray, "limb window P"]:
    """Return the share of each limb's samples in each window of the condensed gradient."""
    _, _, ways = eliminated(normal)
    found = normal.by_block.copy()
    for n, way in enumerate(ways):
        answer = way[:, :-1].reshape(*normal.state_by_block[n].shape, -1)
        found[n] -= np.einsum("wdp,wd->wp", answer, normal.state_by_block[n])
    return found


# ----------------------------------------------------------------------------------------------------------- search


class Prior(NamedTuple):
    mean: np.ndarray
    sd: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def prior_of(model: Fit) -> Prior:
    """Return priors and bounds of the coordinates, (P,) each."""
    low, high = np.reshape([v.bounds for v in model.variables], (-1, 2)).T
    mean, sd = np.reshape([(v.mean, v.sd) for v in model.variables], (-1, 2)).T
    return Prior(mean, sd, low, high)


def search(
    problem: LeastSquares, x: np.ndarray, start: np.ndarray, most: int, text: str, kept: Iterates
) -> list[Fitted]:
    """Return where the search from each of several points (points, P) ends; all points move together, in one batch."""
    prior, points = prior_of(problem.model), len(x)
    first = Iterate(x, start, np.full(points, _DAMPING), np.zeros(points, bool))
    iteration, (x, start, damping, done) = kept.begin(text, most, first)
    normals = problem.linearized(x, start)
    costs = [n.cost + _prior_cost(prior, each) for n, each in zip(normals, x, strict=True)]
    done = done | ~np.isfinite(costs)
    while iteration < most and not done.all():
        kept.show(iteration, min(costs))
        iteration += 1
        memory = problem.model.memory
        steps = [_step(normals[k], x[k], damping[k], start[k], prior, memory) for k in range(points)]
        trial, trial_start = (np.stack(each) for each in zip(*steps, strict=True))
        found = problem.linearized(trial, trial_start)
        for k, normal in enumerate(found):
            cost = normal.cost + _prior_cost(prior, trial[k])
            if done[k]:
                continue
            if cost <= costs[k]:
                done[k] = costs[k] - cost < _ENOUGH
                x, start = x.copy(), start.copy()
                x[k], start[k], normals[k], costs[k] = trial[k], trial_start[k], normal, cost
                damping[k] = max(damping[k] * _SOFTER, 1e-12)
            else:
                damping[k] *= _HARDER
                done[k] = damping[k] > _MOST or abs(cost - costs[k]) < _ENOUGH / 4
        kept.keep(iteration, Iterate(x, start, damping, done))
    kept.end(iteration)
    return [
        Fitted(x[k], start[k], problem.noise, problem.clock, normals[k], costs[k], iteration, bool(done[k]))
        for k in range(points)
    ]


def _prior_cost(prior: Prior, x: np.ndarray) -> float:
    return float((((x - prior.mean) / prior.sd) ** 2).sum()) / 2


def _step(
    normal: Normal, x: np.ndarray, damping: float, start: np.ndarray, prior: Prior, memory: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the next point and starts: variables at a bound that the step would pass stay there."""
    gradient, matrix, ways = eliminated(normal, damping)
    gradient = gradient + (prior.mean - x) / prior.sd**2
    matrix = matrix + np.diag((1 + damping) / prior.sd**2)
    free, move = np.ones(len(x), bool), np.zeros(len(x))
    while free.any():
        inner = np.ix_(free, free)
        move = np.zeros(len(x))
        move[free] = cho_solve(_factor(matrix[inner]), gradient[free])
        out = free & (((x <= prior.lower) & (move < 0)) | ((x >= prior.upper) & (move > 0)))
        if not out.any():
            break
        free &= ~out
    after = np.clip(x + move, prior.lower, prior.upper)
    later = start.copy()
    if ways:
        of_states = np.stack([way[:, -1] - way[:, :-1] @ (after - x) for way in ways])
        later += of_states.reshape(len(ways), len(start), -1).swapaxes(0, 1).reshape(start.shape)
    if "bristle" in memory:
        place = 2 + memory.index("bristle")
        later[..., place] = np.clip(later[..., place], -1.0, 1.0)
    return after, later


def _factor(matrix: np.ndarray) -> Any:
    """Return a Cholesky factor; what is not positive definite by rounding is raised by as much."""
    diagonal = np.diag(np.maximum(np.diag(matrix), 1e-300))
    return _raised(lambda share: cho_factor(matrix + share * diagonal, lower=True))


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

    return np.asarray(_raised(solution))


def _times(band: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the product of a symmetric matrix in SciPy's lower banded form with columns (n, k)."""
    product: np.ndarray = band[0][:, None] * values
    size = len(values)
    for below, row in enumerate(band[1:], start=1):
        product[below:] += row[: size - below, None] * values[: size - below]
        product[: size - below] += row[: size - below, None] * values[below:]
    return product


def _raised(solve: Callable[[float], Any]) -> Any:
    """Return what `solve` does with the least share of the diagonal that makes its matrix positive definite."""
    for share in (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-3, 1.0):
        try:
            return solve(share)
        except np.linalg.LinAlgError:
            continue
    raise FloatingPointError("the normal equations are not finite")


def scaled_residuals(problem: LeastSquares, normal: Normal) -> Float[np.ndarray, " rows"]:
    """Return residuals over their noise; that of what was not fitted has the errors of its time stamps in it."""
    noise, stamps = problem.noise[problem.rows.signal], normal.stamps
    return np.asarray(normal.residuals / np.hypot(noise, np.where(problem.fitted, 0.0, problem.clock * stamps.rate)))
