"""The samples of a log as a model predicts them, between the steps of its simulation, with derivatives."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.identification.model.gripped import FORCE_DELAY
from tuning.identification.model.predicted import Fit
from tuning.identification.model.windows import KINDS, Windows

DIVERGED = 1e20  # SI units: squares of larger values and derivatives tell nothing, or overflow


class Predicted(NamedTuple):
    """The prediction at a point of N variables and states."""

    value: Float[np.ndarray, " rows"]
    along: Float[np.ndarray, "rows N"]
    rate: Float[np.ndarray, " rows"]  # SI units per s: change of a sample by the time that it is taken at

    @property
    def finite(self) -> bool:
        """Whether the model did not diverge."""
        return all(bool((np.abs(each) < DIVERGED).all()) for each in self)


def predicted(model: Fit, x: np.ndarray, start: np.ndarray) -> Predicted:
    """Predict each row of a model's windows, at coordinates x (P,) and states (stretch, limb, joint, S)."""
    rows, count = model.windows.rows, len(x)
    made = Predicted(
        np.full(len(rows.value), np.nan), np.zeros((len(rows.value), count + start.size)), np.zeros(len(rows.value))
    )
    with np.errstate(invalid="ignore", over="ignore"):
        for which, values, tangents in model.evaluate(x, start):
            here = np.flatnonzero(np.isin(rows.window, which))
            kinds = model.windows.kind[rows.signal[here]]
            for kind in np.unique(kinds).tolist():
                chosen = here[kinds == kind]
                at = np.searchsorted(which, rows.window[chosen])
                _enter(made, model, x, (chosen, at, start.shape), KINDS[kind], (values, tangents))
    return made


def _enter(made: Predicted, model: Fit, x: np.ndarray, place: tuple, kind: str, found: tuple) -> None:  # type: ignore[type-arg]
    """Enter rows of one kind: angles and rates between steps on a parabola, all else on a line.

    A rate bends where the command jumps, and the step there has its mean: it is on a parabola of the steps on its own
    side of the jump.
    """
    (chosen, w, shape), windows, rows = place, model.windows, model.windows.rows
    values, tangents = (each[kind] for each in found)
    limb, joint = windows.limb[rows.signal[chosen]], windows.joint[rows.signal[chosen]]
    keys = [v.key for v in model.variables]
    late = [n for n, key in enumerate(keys) if kind in model.LATE.get(key, ())]
    delay = float(x[late].sum())
    if kind == "force" and FORCE_DELAY not in keys:
        delay += float(model.parameters.force_sensor.delay)
    steps, first = windows.steps, ~windows.abuts[rows.window[chosen]] & (not model.LEADS)
    low, most = np.where(first, windows.steps, 0), 2 * steps - 1
    at = rows.step[chosen] + rows.share[chosen] - delay / windows.time_step + steps
    step, across = np.clip(np.floor(at), low, most).astype(int), np.ones(len(at), int)
    if kind == "velocity":
        step, across = _beside_jumps(windows, chosen, (at, step), model.torque_delay(x), low)
    share = at - step

    def of(step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return values[w, step, limb, joint], tangents[w, :, step, limb, joint]

    (value, along), (later, along_later) = of(step), of(step + 1)
    slope = later - value
    moved, turned = value + share * slope, along + share[:, None] * (along_later - along)
    if kind in ("position", "velocity"):
        # a step's rate is the mean over the step: at its middle less a 24th of the second difference
        far = share * (share - 1) / 4 - (1 / 48 if kind == "velocity" else 0.0)
        for n, k in itertools.product((0, 1), (-1, 0, 1)):
            there, along_there = of(np.clip(step + n * across, low + 1, most) + k)
            factor = 1 - 3 * (k == 0)
            moved, turned = moved + factor * far * there, turned + factor * far[:, None] * along_there
            slope = slope + factor * (share / 2 - 0.25) * there
    made.value[chosen], made.rate[chosen] = moved, slope / windows.time_step
    _enter_along(made, model, (chosen, limb, shape), turned)
    made.along[np.ix_(chosen, late)] = -made.rate[chosen][:, None]


def _enter_along(made: Predicted, model: Fit, place: tuple, turned: np.ndarray) -> None:  # type: ignore[type-arg]
    """Enter derivatives (rows, k) along lanes and a joint's state at the variables and states that they are of."""
    (chosen, limb, shape), lanes, count = place, model.lanes, len(model.variables)
    for n, lane in enumerate(lanes):
        for variable in lane:
            moves = np.array([model.moves(model.variables[variable], each) for each in range(1 + int(limb.max()))])
            made.along[chosen, variable] = turned[:, n] * moves[limb]
    width = int(np.prod(shape[2:]))
    stretch = model.windows.stretch[model.windows.rows.window[chosen]]
    column = count + (stretch * shape[1] + limb) * width
    made.along[chosen[:, None], column[:, None] + np.arange(width)] = turned[:, len(lanes) :]


def _beside_jumps(
    windows: Windows, chosen: np.ndarray, place: tuple[np.ndarray, np.ndarray], delay: float, low: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Steps from which rates are predicted, and 1, or 0 where that is by one parabola about the step.

    Arguments:
        windows: of the log.
        chosen: rows of rates.
        place: where they are sought, in steps from the beginning of the window before theirs, and the step before.
        delay: of torques behind commands, s.
        low: the first step that is known.
    """
    (at, step), rows = place, windows.rows
    moments = windows.begin[rows.window[chosen]] + (at - windows.steps - 0.5) * windows.time_step - delay
    before, after = windows.jumps(rows.signal[chosen], moments)
    before, after = (at + jump / windows.time_step for jump in (before, after))
    # the step within half a step of a jump has a part of it; a parabola takes three
    first = np.maximum(np.ceil(before + 1.5 - 1e-6), low + 1)
    last = np.minimum(np.floor(after - 1.5 + 1e-6), 2 * windows.steps - 1)
    one_sided = ((before > step - 1.5) | (after < step + 2.5)) & (first <= last)
    center = np.where(one_sided, np.clip(np.rint(at), first, last), step)
    return center.astype(int), np.where(one_sided, 0, 1)
