"""The worth of random fits against dense algebra and sums over rows: posteriors, whiteness, noise and clock."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize_scalar

from tuning.identification.fit import inference
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.fit.stamps import Noise, Samples, noise_of, whitened
from tuning.identification.model.predicted import DELAY
from tuning.identification.model.variables import Variable

Z = 1.959964


class Given(Problem):
    """A problem of random rows; nothing is simulated."""

    def __init__(self, draw, clock=0.0, delayed=False):
        signals, blocks, per = int(draw.integers(1, 4)), int(draw.choice([3, 9, 14])), int(draw.choice([6, 25]))
        window, signal = (each.ravel() for each in np.mgrid[:blocks, :signals])
        window, signal = np.repeat(window, per), np.repeat(signal, per)
        step = np.concatenate(
            [np.sort(draw.choice(np.arange(4 * per), per, replace=False)) for _ in range(blocks * signals)]
        )
        count = len(step)
        keys = [f"control.k{n}" if draw.random() < 0.5 else f"hardware.servo.{n}_friction" for n in range(4)]
        keys = [DELAY, "log.velocity.delay", *keys] if delayed or draw.random() < 0.5 else keys
        sd = draw.uniform(0.1, 3, len(keys))
        variables = tuple(
            Variable(key, "1", 1.0, 0.0, s, 1e-9, 9, log=bool(draw.random() < 0.3), beside=key.startswith("log."))
            for key, s in zip(keys, sd, strict=True)
        )
        rows = SimpleNamespace(
            signal=signal, window=window, step=step, share=draw.random(count), stamp=np.arange(count)
        )
        windows = SimpleNamespace(
            names=tuple(f"s{n}" for n in range(signals)), limb=draw.integers(0, 2, signals), rows=rows, time_step=0.01,
            begin=np.arange(blocks) * 4 * per * 0.01,
        )  # fmt: skip
        held = draw.random(len(keys)) < 0.2
        vars(self).update(
            model=SimpleNamespace(variables=variables, windows=windows), clock=clock, held=None if held.all() else held,
            fitted=draw.random(count) < 0.9, predicted=np.zeros(count, bool),
        )  # fmt: skip
        memory, noise = draw.choice([0.0, 0.3, 0.8]), draw.normal(size=count)
        for n in range(1, count):
            noise[n] = memory * noise[n - 1] + math.sqrt(1 - memory**2) * noise[n]
        noise[draw.random(count) < 0.02] *= 6
        along = draw.normal(size=(count, len(keys))) * draw.choice([0.01, 0.3, 1.0], len(keys))
        if draw.random() < 0.4:
            along[:, -1] = along[:, -2] * draw.choice([1.0, -2.0]) + 1e-3 * along[:, -1]
        self.x, self.noise_of_rows, self.along_rows = draw.normal(size=len(keys)) * 0.3, noise, along

    def found(self):
        weight = np.minimum(1, 2.5 / abs(self.noise_of_rows)) * self.fitted
        information = self.along_rows.T @ (self.along_rows * weight[:, None])
        zero = 0 * self.noise_of_rows
        return Fitted(
            self.x, np.zeros((1, 0)), np.ones(3), 0.0, zero, self.noise_of_rows, self.along_rows, information, zero,
            1.0, 1, "converged",
        )  # fmt: skip


def whiteness_by_hand(problem, found):
    """Name, correlations, period, share and lasting part of each signal that has samples enough."""
    rows, windows = problem.rows, problem.model.windows
    for number, name in enumerate(windows.names):
        own = [n for n in range(len(rows.signal)) if rows.signal[n] == number and problem.fitted[n]]
        when = {n: windows.begin[rows.window[n]] + 0.01 * (rows.step[n] + rows.share[n]) for n in own}
        own.sort(key=when.get)
        count = len(own)
        if count < 5:
            continue
        r = [max(-4.0, min(4.0, found.scaled[n])) for n in own]
        every = [
            sum(a * b for a, b in zip(r, r[lag:], strict=False)) / sum(a * a for a in r)
            for lag in range(1, count // 5 + 1)
        ]
        first = every[:20]
        statistic = count * (count + 2) * sum(c**2 / (count - lag) for lag, c in enumerate(first, 1))
        by_chance = stats.chi2.ppf(1 - 1e-3 / len(windows.names), len(first))
        largest = max(map(abs, first))
        share = 0.0
        if statistic > by_chance and largest > 0.1:
            share = largest * (1 - by_chance / statistic) * (1 - (0.1 / largest) ** 2)
        lasts = []
        for each in every:
            if each < 0.1:
                break
            lasts.append(each * share / largest)
        spacing = np.median([when[b] - when[a] for a, b in itertools.pairwise(own)])
        yield name, first, spacing, share, lasts, own


@pytest.mark.parametrize("seed", range(12))
def test_residuals_are_tested_lag_by_lag(seed):
    problem = Given(np.random.default_rng(seed))
    found = problem.found()
    tests, expected = inference.whiteness(problem, found), list(whiteness_by_hand(problem, found))
    assert [test.signal for test in tests] == [each[0] for each in expected]
    for test, (_, correlation, period, share, lasts, rows) in zip(tests, expected, strict=True):
        assert test.period == pytest.approx(period)
        np.testing.assert_allclose(test.correlation, correlation, atol=1e-12)
        assert test.share == pytest.approx(share, abs=1e-6)
        np.testing.assert_allclose(test.lasting, lasts, atol=1e-6)
        np.testing.assert_array_equal(test.rows, rows)
        lag = int(np.argmax(np.abs(correlation)))
        assert test.in_words == (
            f"the model is wrong: residuals of {test.signal} are correlated, {correlation[lag]:+.2f} "
            f"{(lag + 1) * period:.3g} s apart"
        )
    loud = sorted((each for each in expected if each[3]), key=lambda each: -max(map(abs, each[1])))
    assert [test.signal for test in inference.suspicious(tests)] == [each[0] for each in loud]


def posterior_by_hand(problem, found, tests, ahead):
    """The widened covariance, by rows and blocks one by one."""
    sd = np.array([v.sd for v in problem.model.variables])
    free = [n for n in range(len(sd)) if problem.held is None or not problem.held[n]]
    held = [n for n in range(len(sd)) if n not in free]
    information, rows, windows = found.information, problem.rows, problem.model.windows
    fisher = np.linalg.inv(information[np.ix_(free, free)] + np.diag(1 / sd[free] ** 2))
    moved = found.along[:, free] @ fisher
    weight = np.minimum(1, 2.5 / abs(found.scaled))
    expected = np.diag(fisher @ information[np.ix_(free, free)] @ fisher)
    blocks = {}
    for n in np.flatnonzero(problem.fitted):
        block = rows.window[n] if problem.clock else (rows.window[n], windows.limb[rows.signal[n]])
        blocks[block] = blocks.get(block, 0.0) + moved[n] * weight[n] * found.scaled[n]
    count, scatter = len(blocks), np.ones(len(free))
    if count >= 8:
        student = stats.t.ppf(0.975, count - 1) / Z
        scatter = np.maximum(sum(b**2 for b in blocks.values()) * count / (count - 1) * student**2 / expected, 1)
    alone = together = 0.0
    for test in tests:
        own = moved[test.rows] * weight[test.rows][:, None]
        alone = alone + (own**2).sum(0)
        apart = sum(
            (share * (own[:-lag] * own[lag:]).sum(0) for lag, share in enumerate(test.lasting, 1)), np.zeros(len(free))
        )
        together = together + (own**2).sum(0) + 2 * np.maximum(apart, 0)
    square = max(ahead, 1) ** 2 * np.maximum(scatter, together / alone)
    own_sd = np.sqrt(np.diag(fisher))
    widened = 1 / np.sqrt(1 / sd[free] ** 2 + np.maximum(1 / own_sd**2 - 1 / sd[free] ** 2, 0) / square)
    covariance = np.diag(sd**2)
    follow = -fisher @ information[np.ix_(free, held)] @ np.diag(sd[held] ** 2)
    covariance[np.ix_(free, held)], covariance[np.ix_(held, free)] = follow, follow.T
    covariance[np.ix_(free, free)] = (
        np.diag(widened / own_sd) @ fisher @ np.diag(widened / own_sd) + follow @ np.diag(1 / sd[held] ** 2) @ follow.T
    )
    keys = [v.key for v in problem.model.variables]
    if DELAY in keys:
        late, most = keys.index("log.velocity.delay"), 0.1 * windows.time_step
        shown = abs(found.x[late])
        most = min(shown, most) if shown > 3 * math.sqrt(covariance[late, late]) else 0.0
        covariance[keys.index(DELAY), keys.index(DELAY)] += most**2
    return covariance


@pytest.mark.parametrize("seed", range(12))
def test_a_posterior_is_that_of_dense_algebra(seed):
    draw = np.random.default_rng(seed)
    problem = Given(draw, clock=float(draw.choice([0.0, 1e-3])), delayed=seed % 3 < 2)
    if seed % 3 < 2:
        problem.model.windows.time_step = 30.0
        problem.x[1] = 9.0 if seed % 3 else 1.0  # a delay of velocities that is surely there, or may be
    found, ahead = problem.found(), float(draw.choice([0.7, 1.0, 2.0]))
    tests = inference.whiteness(problem, found)
    known = inference.posterior(problem, found, tests, ahead)
    covariance = posterior_by_hand(problem, found, tests, ahead)
    np.testing.assert_allclose(known.covariance, covariance, rtol=1e-6, atol=1e-9 * np.abs(covariance).max())
    np.testing.assert_allclose(np.diag(known.covariance), np.diag(covariance), rtol=1e-6)
    variables, free = problem.model.variables, problem.free
    # which are not told: those that the samples hardly know were the others known, or else the least known
    sd, asked = problem.prior.sd, free & np.array([not v.beside for v in variables])
    alone = [
        a and 1 / math.sqrt(found.information[n, n] + 1 / s**2) > 0.5 * s
        for n, (a, s) in enumerate(zip(asked, sd, strict=True))
    ]
    if not any(alone):
        deviations = np.zeros(len(sd))
        at = np.flatnonzero(free)
        deviations[at] = np.sqrt(np.diag(np.linalg.inv(found.information[np.ix_(at, at)] + np.diag(1 / sd[at] ** 2))))
        share = np.where(asked, deviations / sd, 0.0)
        alone = (share == share.max()) & (share > 0.5)
    assert inference.untold(problem, found).tolist() == list(alone)


def directions_by_hand(variables, information, sd, x):
    """Lines on parameters that are not told, and on combinations of them that are."""
    helps = {"control.k": "another P gain", "friction": "slow reversals", "delay": "steps of the command"}
    values, vectors = np.linalg.eigh(np.diag(sd) @ information @ np.diag(sd))
    lines, involved, combined = [], set(), []
    for value, v in zip(values, vectors.T, strict=True):
        if max(value, 0) >= 3:  # a posterior of half the prior's deviation
            continue
        loud = [n for n in range(len(sd)) if abs(v[n]) > 0.35 or abs(v[n]) == max(abs(v))]
        if all(variables[n].beside for n in loud):
            continue
        involved |= {*loud}
        keys = [variables[n].key for n in loud]
        words = list(dict.fromkeys(help for key in keys for part, help in helps.items() if part in key))[:2]
        apart = " from " + " and ".join(keys[1:]) if keys[1:] else ""
        lines.append(f"this log does not tell {keys[0]}{apart}" + (f" (add {' or '.join(words)})" if words else ""))
    for value, v in zip(values, vectors.T, strict=True):
        loud = [n for n in range(len(sd)) if abs(v[n]) > 0.35 and n in involved]
        if value < 3 or len(loud) < 2 or sum(v[n] ** 2 for n in involved) < 0.5:
            continue
        most = max(abs(v[n] / sd[n]) for n in loud)
        name = {n: f"log({variables[n].key})" if variables[n].log else variables[n].key for n in loud}
        terms = " ".join(f"{v[n] / sd[n] / most:+.3g} {name[n]}" for n in loud)
        middle = sum(v[n] / sd[n] / most * x[n] for n in loud)
        combined.append(f"{terms} = {middle:.4g} +- {Z / math.sqrt(value) / most:.2g}")
    return tuple(dict.fromkeys(lines)), tuple(combined)


@pytest.mark.parametrize("seed", range(20))
def test_directions_that_are_not_told_are_named(seed):
    draw = np.random.default_rng(seed)
    problem = Given(draw)
    found = problem.found()
    variables, sd = problem.model.variables, problem.prior.sd
    root = draw.normal(size=(len(sd), len(sd))) * draw.choice([0.3, 1.0, 30.0], (len(sd), 1)) / sd
    known = inference.posterior(problem, found._replace(information=root.T @ root), [])
    expected = directions_by_hand(variables, root.T @ root, sd, found.x)

    assert known.unseen == expected[0]
    assert len(known.combined) == len(expected[1])
    for found_line, line in zip(known.combined, expected[1], strict=True):
        terms, _, rest = line.partition(" = ")
        middle, _, width = rest.partition(" +- ")
        # nobody chose the sign of a direction
        turned = terms.translate(str.maketrans("+-", "-+")) + f" = {-float(middle):.4g} +- {width}"
        assert found_line in (line, turned)


# --------------------------------------------------------------------------------------------- noise and time stamps


def noise_by_hand(residuals, signal, fitted, before, moved):
    """Huber's proposal 2 by fixed iterations, from the median."""
    found = list(before)
    for number in range(len(before)):
        own = [r for r, s, f in zip(residuals, signal, fitted, strict=True) if s == number and f]
        if len(own) >= 10:
            sd = 1.4826 * float(np.median(np.abs(own)))
            for _ in range(10):
                sd = math.sqrt(sum(min(r * r, (2.5 * sd) ** 2) for r in own) / len(own) / 0.97756)
            found[number] = max(sd, 1e-5 * moved[number], 1e-12)
    return np.array(found)


@pytest.mark.parametrize("seed", range(8))
def test_noise_without_shared_stamps_is_hubers(seed):
    draw = np.random.default_rng(seed)
    count, signals = int(draw.choice([30, 200])), 4
    signal = draw.choice(signals, count, p=[0.5, 0.3, 0.17, 0.03])
    residuals = draw.normal(size=count) * np.array([1.0, 0.1, 0.0, 3.0])[signal]
    residuals[draw.random(count) < 0.1] *= 20
    fitted, moved = draw.random(count) < 0.8, draw.uniform(1, 9, signals)
    samples = Samples(signal, np.arange(count), fitted, 0.01, moved)
    before = Noise(draw.uniform(0.1, 1, signals), 0.0)
    found = noise_of(residuals, draw.normal(size=count), samples, before)
    np.testing.assert_allclose(
        found.signals, noise_by_hand(residuals, signal, fitted, before.signals, moved), rtol=1e-9
    )
    assert found.clock == 0.0 and not samples.shared


@pytest.mark.parametrize("seed", range(2))
def test_noise_and_clock_are_those_of_the_largest_likelihood_of_normal_samples(seed):
    """Of samples without outliers, by the dense covariance of each stamp; held-out rows count for nothing."""
    draw = np.random.default_rng(seed)
    stamps, signals, clock = 500, 5, float(draw.choice([2e-4, 5e-4]))
    stamp, signal = (each.ravel() for each in np.mgrid[:stamps, :signals])
    noise = draw.uniform(0.5, 2, signals) * 1e-3
    rate = draw.normal(size=len(stamp)) * 5
    residuals = rate * draw.normal(0, clock, stamps)[stamp] + noise[signal] * draw.normal(size=len(stamp))
    fitted = stamp < 450
    residuals[~fitted] = 9.0
    found = noise_of(residuals, rate, Samples(signal, stamp, fitted, 0.01, np.ones(signals)), Noise(2 * noise, 0.0))

    def loss(logarithm, own):
        total = 0.0
        for n in range(450):
            rows = stamp == n
            covariance = np.diag(own[signal[rows]] ** 2) + math.exp(2 * logarithm) * np.outer(rate[rows], rate[rows])
            total += np.linalg.slogdet(covariance)[1] + residuals[rows] @ np.linalg.solve(covariance, residuals[rows])
        return total / 2

    best = minimize_scalar(lambda t: loss(t, found.signals), bounds=np.log([1e-5, 5e-3]), method="bounded")
    assert found.clock == pytest.approx(math.exp(best.x), rel=0.03)  # Huber's loss cuts a hundredth of them
    np.testing.assert_allclose(found.signals, noise, rtol=0.12)
    late = found.clock * rate / noise[signal]
    white = whitened(np.column_stack([residuals / noise[signal], rate]), late, stamp)
    rows = stamp == 7
    values, vectors = np.linalg.eigh(np.eye(signals) + np.outer(late[rows], late[rows]))
    root = vectors @ np.diag(values**-0.5) @ vectors.T
    np.testing.assert_allclose(white[rows], root @ np.column_stack([residuals / noise[signal], rate])[rows], rtol=1e-9)
