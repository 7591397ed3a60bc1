"""How often intervals hold under other draws of the noise: python -m tests.tuning.identification.redrawn [DRAWS] [LOG].

One of the logs of `coverage` is fitted. Estimates and residuals under other noise are those of the fit's linearisation,
states of windows included, so that a draw costs no simulation.
"""

import sys

import numpy as np

import tuning
from tests.tuning.identification.coverage import KEYS, SCENARIO, STEP, TRUTHS, shares, truth_of
from tests.tuning.identification.stand_in_mujoco import log_of
from tuning.identification.fit import shooting
from tuning.identification.fit.inference import Z, posterior, suspicious, whiteness
from tuning.identification.fit.levenberg_marquardt import prior_of


def linearised(problem, fitted):
    """Return the derivatives of all rows along variables and states (rows, N), and the matrix of the fit (N, N)."""
    normal, count, limbs, windows = fitted.normal, len(fitted.x), problem.model.sizes[0], len(problem.which)
    width = normal.state_gradient.shape[2]
    values, tangents = problem.model.evaluate(fitted.x[None], fitted.start[None], problem.which)
    own, along = ({name: v[0] for name, v in each.items()} for each in (values, tangents))
    size = count + limbs * windows * width
    rows, matrix = np.zeros((len(problem.rows.value), size)), np.zeros((size, size))

    def states(limb, window):
        first = count + (limb * windows + window) * width
        return slice(first, first + width)

    for first, last, w, n, jacobian in shooting._jacobians(problem, shooting._predicted(problem, fitted.x, own, along)):
        rows[first:last, :count], rows[first:last, states(n, w)] = jacobian[:, :count], jacobian[:, count:]
    matrix[:count, :count] = normal.hessian + np.diag(1 / prior_of(problem.model).sd ** 2)
    for n, w in np.ndindex(limbs, windows):
        here, before = states(n, w), states(n, w - 1)
        matrix[here, here] = normal.state_hessian[n, w]
        matrix[:count, here], matrix[here, :count] = normal.mixed[n, w], normal.mixed[n, w].T
        if w:
            matrix[here, before], matrix[before, here] = normal.onward[n, w], normal.onward[n, w].T
    return rows, matrix


def redrawn(found, draws, seed=0):
    """Return whether intervals hold (draws, KEYS), their width over Fisher's, and whether a draw is called wrong."""
    problem, fitted, rng = found.problem, found.fitted, np.random.default_rng(seed)
    noise, used = problem.noise[problem.rows.signal], problem.fitted
    rows, matrix = linearised(problem, fitted)
    scaled = rows / noise[:, None]
    gain = np.linalg.solve(matrix, (scaled * used[:, None]).T)
    along = problem.sensitivity(fitted)
    vars(problem)["sensitivity"] = lambda _: along
    stamps = fitted.normal.stamps._replace(weight=np.where(used, 1 / noise**2, 0.0))
    inside, width, wrong = np.zeros((draws, len(KEYS)), bool), np.zeros((draws, len(KEYS))), np.zeros(draws, bool)
    for n in range(draws):
        drawn = rng.normal(size=len(noise))
        moved = gain @ drawn
        normal = fitted.normal._replace(residuals=noise * (drawn - scaled @ moved), stamps=stamps)
        other = fitted._replace(normal=normal)
        tests = whiteness(problem, other)
        known = posterior(problem, other, tests)
        sd, fisher = (np.sqrt(np.diag(each))[: len(KEYS)] for each in (known.covariance, known.fisher))
        inside[n], width[n], wrong[n] = np.abs(moved[: len(KEYS)]) <= Z * sd, sd / fisher, bool(suspicious(tests))
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
