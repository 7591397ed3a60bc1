"""How often intervals hold under other draws of the noise: python -m tests.tuning.identification.redrawn [DRAWS] [LOG].

One of the logs of `coverage` is fitted. Estimates and residuals under other noise are those of the fit's linearisation,
states of windows included, so that a draw costs no simulation.
"""

import sys

import numpy as np

import tuning
from tests.tuning.identification.coverage import KEYS, SCENARIO, STEP, TRUTHS, shares, truth_of, width_of
from tests.tuning.identification.stand_in_mujoco import log_of
from tuning.identification.fit.inference import Z, posterior, suspicious, whiteness


def redrawn(found, draws, seed=0):
    """Return whether intervals hold (draws, KEYS), their width over Fisher's, and whether a draw is called wrong."""
    problem, fitted, rng = found.problem, found.fitted, np.random.default_rng(seed)
    point, used, sd = np.r_[fitted.x, fitted.start.ravel()], problem.fitted, problem.whole_prior.sd
    along = problem.evaluate(point).along
    own = along * used[:, None]
    gain = np.linalg.solve(own.T @ own + np.diag(1 / sd**2), own.T)
    inside, width, wrong = np.zeros((draws, len(KEYS)), bool), np.zeros((draws, len(KEYS))), np.zeros(draws, bool)
    for n in range(draws):
        drawn = rng.normal(size=len(used))
        moved = gain @ drawn
        other = fitted._replace(scaled=drawn - along @ moved)
        tests = whiteness(problem, other)
        known = posterior(problem, other, tests)
        sd_of = np.sqrt(np.diag(known.covariance))[: len(KEYS)]
        inside[n], width[n] = np.abs(moved[: len(KEYS)]) <= Z * sd_of, width_of(other, problem, known)[: len(KEYS)]
        wrong[n] = bool(suspicious(tests))
    return inside, width, wrong


def main():
    draws, number = (*map(int, sys.argv[1:]), *(1500, 0)[len(sys.argv) - 1 :])
    robot, _ = truth_of(number % TRUTHS)
    log = log_of(robot, 5.0, jitter=0.0005, seed=1000 + number, step=STEP)
    inside, width, wrong = redrawn(tuning.identify(SCENARIO, log, KEYS, starts=1), draws, number)
    for key, own, wide in zip(KEYS, inside.T, width.T, strict=True):
        print(f"{key}: {shares(own)}, width over Fisher {wide.mean():.3f}, at most {wide.max():.2f}")
    widest = width[wrong].max(initial=0.0)
    print(f"all: {shares(inside)}; called wrong {wrong.sum()} of {draws}, then at most {widest:.2f} times as wide")


if __name__ == "__main__":
    main()
