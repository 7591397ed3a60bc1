"""What a fit is worth: what the log does not tell keeps its prior, and what the model lacks widens intervals."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.tuning.identification.coverage import width_of
from tuning.identification.fit.inference import (
    Whiteness,
    covariance_of,
    posterior,
    unexplained,
    unmodelled,
    untold,
    whiteness,
)
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.fit.report import findings
from tuning.identification.model.predicted import DELAY
from tuning.identification.model.variables import Variable


def test_the_covariance_is_the_inverse_of_what_samples_and_prior_say():
    root, sd = np.random.default_rng(0).normal(0, 1, (20, 4)) * [1.0, 1e3, 1e-3, 1e6], np.array([1.0, 0.1, 50.0, 1e-3])
    expected = np.linalg.inv(root.T @ root + np.diag(1 / sd**2))
    np.testing.assert_allclose(covariance_of(root.T @ root, sd), expected, rtol=1e-6)


@pytest.mark.parametrize("size", [1e17, 1e100])
def test_what_no_sample_says_anything_of_keeps_its_prior_however_large_the_rest_is(size):
    """As the P gain where the log has a column of zeros for it: 50 (46 to 54), with a prior of a factor of e."""
    root, sd = np.random.default_rng(0).normal(0, np.sqrt(size), (20, 3)), np.array([1.0, 0.02, 0.2])
    root[:, 0] = 0.0
    deviations = np.sqrt(np.diag(covariance_of(root.T @ root, sd)))
    assert deviations[0] == pytest.approx(1.0)
    assert (deviations[1:] < 1e-6).all()


def test_what_is_told_together_alone_keeps_the_prior_along_the_rest():
    together, sd = np.array([[1.0, 1.0], [1.0, 1.0]]) * 1e18, np.array([0.3, 0.4])
    found = covariance_of(together, sd)
    expected = np.array([[1, -1], [-1, 1]]) / (1 / 0.3**2 + 1 / 0.4**2)  # of two that are told to add up
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_a_fit_that_leaves_half_of_what_moves_unexplained_is_said_to():
    noise, moved = np.array([1e-3, 0.03]), np.array([0.2, 2.0])
    assert unexplained(noise, moved) == ""
    assert unexplained(np.array([0.1004, 3.0]), moved).startswith("the fit leaves 50 % or more of what each signal")
    assert unexplained(noise, np.array([0.2, 0.03])) == ""  # of a joint at rest


# ------------------------------------------------------------------------------------------------------ the widening


class Line(Problem):
    """Two signals of white noise, each a line of its own variable; nothing is simulated."""

    def __init__(self, blocks=40, samples=25, seed=0, held=(False, False), keys="ab", time_step=1e-3):
        count = 2 * blocks * samples
        signal, block = np.repeat([0, 1], count // 2), np.tile(np.repeat(np.arange(blocks), samples), 2)
        along = np.zeros((count, 2))
        along[np.arange(count), signal] = 1.0
        rows = SimpleNamespace(signal=signal, window=block)
        windows = SimpleNamespace(names=("a", "b"), time_step=time_step, limb=np.zeros(2, int), rows=rows)
        variables = tuple(Variable(key, "1", 0.0, 0.0, 100.0, -np.inf, np.inf) for key in keys)
        model = SimpleNamespace(variables=variables, windows=windows)
        vars(self).update(
            model=model, along=along, block=block, clock=0.0, fitted=np.full(count, True), held=np.array(held),
            residuals=np.random.default_rng(seed).normal(0, 1, count),
        )  # fmt: skip

    def found(self, residuals=None, information=None, x=(0.0, 0.0)):
        residuals = self.residuals if residuals is None else residuals
        told = self.along.T @ self.along if information is None else information
        return Fitted(
            np.array(x), np.zeros((1, 0)), np.ones(2), 0.0, residuals, residuals, self.along, told, 0 * residuals, 0.0,
            1, "converged",
        )  # fmt: skip

    def known(self, lasting=(), residuals=None, ahead=1.0, **how):
        """Return the posterior where the first signal's residuals have some correlation."""
        rows = np.arange(len(self.fitted)).reshape(2, -1)
        each = zip("ab", (np.array(lasting, float), np.zeros(0)), rows, strict=True)
        tests = [Whiteness(name, np.zeros(3), 0.01, 0.0, lasts, own) for name, lasts, own in each]
        return posterior(self, self.found(residuals, **how), tests, ahead)

    def width(self, lasting=(), residuals=None, ahead=1.0):
        """Return the posterior's standard deviations over those if noise were white and the model right."""
        return width_of(self.found(residuals), self, self.known(lasting, residuals, ahead))


def test_what_one_signal_lacks_widens_what_that_signal_tells_alone_and_no_more_than_the_prior():
    problem = Line()
    plain, wrong, hopeless = problem.width(), problem.width(np.full(15, 0.9)), problem.known(np.full(15, 1e12))
    assert plain == pytest.approx(1.0, abs=0.2)
    assert wrong[1] == pytest.approx(plain[1])
    assert wrong[0] == pytest.approx(np.sqrt(1 + 2 * 15 * 0.9), rel=0.01)
    assert 99.0 < np.sqrt(hopeless.covariance[0, 0]) <= 100.0  # the prior's


def test_a_false_alarm_costs_little_and_no_correlation_is_a_cliff():
    shares = [unmodelled(0.3, statistic) for statistic in (0.5, 1.0, 1.05, 1.2, 3.0, 100.0)]
    assert shares[:2] == [0.0, 0.0] and (np.diff(shares[1:]) > 0).all() and shares[2] < 0.02
    assert shares[-1] == pytest.approx(0.3, rel=0.15)
    shares = [unmodelled(correlation, 10.0) for correlation in (0.0, 0.05, 0.1, 0.105, 0.2, 0.9)]
    assert shares[:3] == [0.0, 0.0, 0.0] and (np.diff(shares[2:]) > 0).all() and shares[3] < 0.02
    assert shares[-1] == pytest.approx(0.9 * 0.9, rel=0.02)


@pytest.mark.parametrize("per_sample", [0.0, 0.9])
def test_of_correlated_residuals_one_counts_of_so_many_as_the_correlation_lasts(per_sample):
    """Of first order: the variance of a mean is (1 + r) / (1 - r) times that of as many independent samples."""
    problem, rng = Line(blocks=400), np.random.default_rng(1)
    noise, residuals = rng.normal(0, 1, len(problem.fitted)), np.zeros(len(problem.fitted))
    for n in range(1, len(noise)):
        residuals[n] = per_sample * residuals[n - 1] + np.sqrt(1 - per_sample**2) * noise[n]
    windows = problem.model.windows
    windows.begin, count = np.zeros(len(problem.fitted) // 25), len(noise) // 2
    problem.rows.step, problem.rows.share = np.tile(10 * np.arange(count), 2), np.zeros(len(noise))
    first, _ = whiteness(problem, problem.found(residuals))
    assert 1 + 2 * first.lasting.sum() == pytest.approx((1 + per_sample) / (1 - per_sample), rel=0.25)
    assert first.period == pytest.approx(0.01)
    # what a parameter moves back and forth faster than the residuals change, they hardly tell
    quick = problem.along * np.where(np.arange(len(noise)) % 2, 1.0, -1.0)[:, None]
    turned = problem.found(residuals)._replace(along=quick)
    both = (problem.found(residuals), turned)
    slow, fast = (width_of(each, problem, posterior(problem, each, [first]))[0] for each in both)
    assert fast == pytest.approx(1.0, abs=0.3) if per_sample else slow == pytest.approx(1.0, abs=0.2)
    assert slow > 2.5 or not per_sample


def test_few_blocks_count_by_students_quantile():
    """Of noise that blocks share, eight blocks leave an interval 2.36 / 1.96 times as wide as many would."""
    found = []
    for blocks in (8, 2000):
        problem = Line(blocks, samples=4)
        shift = np.sin(np.pi * (np.arange(blocks) + 0.5))  # +1, -1: their scatter is known
        residuals = 2 * shift[problem.block] * np.ones(len(problem.block))
        found.append(problem.width(residuals=residuals)[0] / np.sqrt(blocks / (blocks - 1)))
    few, many = found
    assert many == pytest.approx(2 * np.sqrt(4), rel=0.01)
    assert few / many == pytest.approx(2.364624 / 1.961, rel=0.05)


@pytest.mark.parametrize(("other", "shown", "added"), [
    ("b", 0.5, 1.0),  # a tenth of a time step: nothing shows how well times are meant
    ("log.velocity.delay", 0.05, 0.0),  # within three of its sd, 0.03
    ("log.velocity.delay", -0.5, 0.5),
    ("log.velocity.delay", 7.0, 1.0),
])  # fmt: skip
def test_a_delay_of_commands_is_no_better_known_than_the_clock(other, shown, added):
    plain = Line().known().covariance
    found = Line(keys=(DELAY, other), time_step=10.0).known(x=(0.0, shown)).covariance
    np.testing.assert_allclose(found - plain, np.diag([added**2, 0.0]), atol=1e-9)


def test_what_was_held_out_and_is_predicted_worse_widens_by_as_much():
    plain, worse = (Line().width(ahead=ahead) for ahead in (0.9, 3.0))
    np.testing.assert_allclose(worse, 3 * plain, rtol=1e-3)


TRADED = 400.0 * np.array([[1.0, 1.0], [1.0, 1.0]]) + np.diag([1e-4, 0.0])  # their sum is told


def test_of_two_that_trade_the_less_told_is_held_and_the_other_has_its_doubt():
    held = untold(Line(), Line().found(information=TRADED))
    assert held.tolist() == [False, True]
    problem = Line(held=held)
    assert not untold(problem, problem.found(information=TRADED)).any()
    known = problem.known(information=TRADED)
    assert known.covariance[1, 1] == pytest.approx(100.0**2)  # the prior is the posterior
    assert known.covariance[0, 0] == pytest.approx(100.0**2, rel=0.01)
    together = np.ones(2) @ known.covariance @ np.ones(2)
    alone = known.covariance[0, 0] - known.covariance[0, 1] ** 2 / known.covariance[1, 1]
    assert together == pytest.approx(alone, rel=0.2)  # draws keep to what is told


def test_what_is_not_told_at_all_is_held_at_once():
    assert untold(Line(), Line().found(information=np.diag([1e-6, 1e-6]))).all()
    assert not untold(Line(), Line().found(information=np.diag([1.0, 1.0]))).any()


def test_no_warning_of_a_fit_is_folded_away_on_its_page():
    told = {
        "sentence": "log.csv tells 1 of 2 parameters",
        "warnings": ("on its bound", "stuck"),
        "combined": ("a + b",),
    }
    said = findings(SimpleNamespace(**told))
    assert (said.verdict, said.beside) == (told["sentence"], ["warning: on its bound", "warning: stuck"])
    assert said.lines == ["a + b", *said.beside, told["sentence"]]
