"""How often intervals hold: python -m tests.tuning.identification.coverage [REPEATS] [SECONDS] [MISREAD] [FIRST].

Truths are drawn from what servos are; each has its log by MuJoCo's C code, with noise, delay and jitter, and time
stamps that miss the samples' moments by MISREAD s. Beside what was counted stand the errors over their standard
deviations: their mean is what the model gets wrong, their spread is 1 where the noise is right. It runs four times as
fast without XLA_FLAGS=--xla_backend_optimization_level=0.
"""

import sys
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

import mjx_climb as mc
import tuning
from tests.tuning.identification.stand_in_mujoco import Truth, log_of
from tuning.identification.fit.inference import Z, covariance_of

KEYS = (
    "hardware.servo.armature",
    "hardware.servo.coulomb_friction",
    "control.kp",
    "control.kd",
    "hardware.command_delay",
)
SPANS = ((0.006, 0.02), (0.03, 0.1), (25.0, 60.0), (0.2, 0.5), (0.002, 0.008))  # even in the logarithm
TRUTHS = 20
STEP = 2.5e-4  # s, of MuJoCo's Runge-Kutta
SCENARIO = mc.Scenario().with_overrides({"control.kp": 40.0, "control.kd": 0.3})


class Counted(NamedTuple):
    """What came of repeats, (repeats, KEYS) each but for the last two; an estimate may have no interval."""

    inside: np.ndarray  # bool: there is an interval, and it holds the truth
    error: np.ndarray  # of the estimate's coordinate, over its standard deviation; NaN without an interval
    width: np.ndarray  # of the interval over Fisher's
    ahead: np.ndarray  # (repeats,) error over noise, held out
    warned: list[str]


def truth_of(number):
    """Return one of the truths, as a robot and by key."""
    drawn = np.exp(np.random.default_rng(number).uniform(*np.log(SPANS).T))
    drawn[4] = round(drawn[4] / STEP) * STEP
    return Truth(*(drawn[:2]), 0.0, *drawn[2:]), dict(zip(KEYS, drawn.tolist(), strict=True))


def counted(repeats, duration, misread=0.0, first=0, said=lambda line: None):
    """Return what comes of repeats from the first on; `said` is called with a line of each."""
    rows, warned = [], []
    for repeat in range(first, first + repeats):
        robot, truth = truth_of(repeat % TRUTHS)
        log = log_of(robot, duration, jitter=0.0005, misread=misread, seed=1000 + repeat, step=STEP)
        found = tuning.identify(SCENARIO, log, KEYS, starts=1)
        value, true = np.array([(found.estimates[key].value, truth[key]) for key in KEYS]).T
        # None becomes NaN
        low, high = np.array([(found.estimates[key].low, found.estimates[key].high) for key in KEYS], float).T
        logarithm = np.array([v.log for v in found.model.variables[: len(KEYS)]])
        with np.errstate(divide="ignore"):
            off, span = (np.where(logarithm, np.log(a / b), a - b) for a, b in ((value, true), (high, low)))
        error = 2 * Z * off / span
        known, ahead = found.posterior, found.held_out["error_over_noise"]
        rows.append(
            ((low <= true) & (true <= high), error, width_of(found.fitted, found.problem, known)[: len(KEYS)], ahead)
        )
        warned += found.warnings
        said(f"{repeat}: errors {error.round(2).tolist()}, held out {ahead:.3f} {found.fitted.ended} {found.warnings}")
    return Counted(*map(np.array, zip(*rows, strict=True)), warned)


def width_of(fitted, problem, known):
    """Return the width of the intervals over that if noise were white and the model right, 1 of held variables."""
    free, fisher = np.flatnonzero(problem.free), problem.prior.sd**2
    fisher[free] = np.diag(covariance_of(fitted.information[np.ix_(free, free)], problem.prior.sd[free]))
    return np.sqrt(np.diag(known.covariance) / fisher)


def shares(inside):
    """Return in words how many of some intervals hold, with the exact binomial interval of that share."""
    low, high = binomtest(int(inside.sum()), inside.size).proportion_ci()
    return f"inside {inside.sum()} of {inside.size}, {inside.mean():.1%} ({low:.1%} to {high:.1%})"


def main():
    asked = [kind(word) for kind, word in zip((int, float, float, int), sys.argv[1:], strict=False)]
    repeats, duration, misread, first = (*asked, *(100, 5.0, 0.0, 0)[len(asked) :])
    found = counted(repeats, duration, misread, first, lambda line: print(line, flush=True))
    means = np.nanmean(found.error, 0), np.nanstd(found.error, 0), found.width.mean(0)
    for key, inside, error, spread, width in zip(KEYS, found.inside.T, *means, strict=True):
        print(f"{key}: {shares(inside)}, error {error:+.2f} +- {spread:.2f}, width over Fisher {width:.3f}")
    without = int(np.isnan(found.error).any(1).sum())
    print(f"all: {shares(found.inside)}; logs with an estimate without an interval: {without}")
    print(f"held out {found.ahead.mean():.3f}, worst {found.ahead.max():.3f}")


if __name__ == "__main__":
    main()
