"""What a fit is worth: what the log does not tell keeps its prior, and an interval of no width is none."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tuning.identification.fit.conclusions import trusted
from tuning.identification.fit.inference import Whiteness, covariance_of, is_seen, posterior, unmodelled, useless
from tuning.identification.fit.least_squares import Fitted, LeastSquares, Normal
from tuning.identification.fit.report import findings
from tuning.identification.fit.result import Estimate
from tuning.identification.fit.stamps import Stamped
from tuning.identification.model.predicted import DELAY
from tuning.identification.model.variables import Variable

KP = Variable("control.kp", "N m/rad", 50.0, np.log(50.0), 1.0, 0.05, 5e4, log=True)
ARMATURE = Variable("hardware.servo.armature", "kg m^2", 0.012, 0.012, 0.02, 0.0, np.inf)
NARROW = Estimate(50.0, 49.999, 50.001, True, 40.0, "N m/rad")


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


@pytest.mark.parametrize(("estimate", "variable", "refuted", "given"), [
    (NARROW, KP, False, True),  # a log without noise
    (NARROW, KP, True, False),
    (dataclasses.replace(NARROW, low=49.99, high=50.01), KP, True, True),
    (dataclasses.replace(NARROW, low=50.0, high=50.0), KP, False, False),
    (Estimate(1e-75, 0.0, 1e-70, True, 0.012, "kg m^2"), ARMATURE, True, False),
    (Estimate(1e-75, 0.0, 1e-70, True, 0.0, "kg m^2"), ARMATURE, True, False),
    (Estimate(0.0, 0.0, 1e-4, True, 0.0, "kg m^2"), ARMATURE, True, True),
])  # fmt: skip
def test_an_interval_of_no_width_is_none_on_a_model_that_the_residuals_refute(estimate, variable, refuted, given):
    found = trusted(estimate, variable, refuted=refuted, useless=False)
    assert found == estimate if given else (found.low, found.high, found.seen) == (None, None, False)
    assert given == ("no interval" not in found.remark)


def test_a_fit_that_does_not_predict_what_was_held_out_tells_nothing():
    noise, moved = np.array([1e-3, 0.03]), np.array([0.2, 2.0])
    assert useless(noise, moved, 2.9) == useless(noise, moved, None) == ""
    assert useless(noise, moved, 26.0).startswith("what was held out is predicted 26 times worse than the noise")
    assert useless(noise, moved, np.nan)
    assert useless(np.array([0.1004, 3.0]), moved, 1.0).startswith("the fit leaves 50 % or more of what each signal")
    assert useless(noise, np.array([0.2, 0.03]), 1.0) == ""  # of a joint at rest
    wide = Estimate(40.0, 30.0, 50.0, True, 40.0, "N m/rad")
    assert trusted(wide, KP, refuted=False, useless=True).low is None


# ------------------------------------------------------------------------------------------------------ the widening


class Line(LeastSquares):
    """Two signals of white noise, each a line of its own variable; nothing is simulated."""

    def __init__(self, blocks=40, samples=25, seed=0, keys="ab", time_step=1e-3):
        count = 2 * blocks * samples
        signal, place = np.repeat([0, 1], count // 2), np.tile(np.repeat(np.arange(blocks), samples), 2)
        along = np.zeros((count, 2))
        along[np.arange(count), signal] = 1.0
        names = SimpleNamespace(names=("a", "b"), time_step=time_step)
        variables = tuple(Variable(key, "1", 0.0, 0.0, 100.0, -np.inf, np.inf) for key in keys)
        vars(self).update(
            model=SimpleNamespace(variables=variables, windows=names), rows=SimpleNamespace(signal=signal),
            place=place, limb=np.zeros(count, int), clock=0.0, along=along,
            residuals=np.random.default_rng(seed).normal(0, 1, count),
        )  # fmt: skip

    def sensitivity(self, found):
        return self.along

    def known(self, share=0.0, residuals=None, x=(0.0, 0.0)):
        """Return the posterior where a share of the first signal's residuals is not modelled."""
        count, none = len(self.along), np.zeros((0, 1, 0))
        weight = np.ones(count)
        residuals = self.residuals if residuals is None else residuals
        normal = Normal(
            0.0, self.along.T @ residuals, self.along.T @ self.along, none, none[..., None], none[..., None],
            np.zeros((0, 1, 2, 0)), residuals, Stamped(0 * weight, 0 * weight, weight, np.zeros(0), 0.0),
        )  # fmt: skip
        found = Fitted(np.array(x), np.zeros((1, 0)), np.ones(2), 0.0, normal, 0.0, 1, np.zeros(2), "converged")
        each = (("a", share), ("b", 0.0))
        tests = [Whiteness(name, 0.5, np.zeros(3), 0.01, own, count // 2) for name, own in each]
        return posterior(self, found, tests)


def test_what_one_signal_lacks_widens_what_that_signal_tells_alone_and_no_more_than_the_prior():
    problem = Line()
    plain, wrong, hopeless = problem.known(), problem.known(0.3), problem.known(1e9)
    assert plain.widening == pytest.approx(1.0, abs=0.2)
    assert wrong.widening[1] == pytest.approx(plain.widening[1])
    assert wrong.widening[0] == pytest.approx(np.sqrt(1 + 0.3 * 1000), rel=0.05)  # of 1000 samples
    assert 99.0 < np.sqrt(hopeless.covariance[0, 0]) <= 100.0  # the prior's
    assert not hopeless.seen[0] and hopeless.seen[1]


def test_a_false_alarm_costs_little_and_no_correlation_is_a_cliff():
    shares = [unmodelled(0.3, statistic) for statistic in (0.5, 1.0, 1.05, 1.2, 3.0, 100.0)]
    assert shares[:2] == [0.0, 0.0] and (np.diff(shares[1:]) > 0).all() and shares[2] < 0.02
    assert shares[-1] == pytest.approx(0.3, rel=0.15)
    shares = [unmodelled(correlation, 10.0) for correlation in (0.0, 0.05, 0.1, 0.105, 0.2, 0.9)]
    assert shares[:3] == [0.0, 0.0, 0.0] and (np.diff(shares[2:]) > 0).all() and shares[3] < 0.02
    assert shares[-1] == pytest.approx(0.9 * 0.9, rel=0.02)


def test_few_blocks_count_by_students_quantile():
    """Of noise that blocks share, eight blocks leave an interval 2.36 / 1.96 times as wide as many would."""
    found = []
    for blocks in (8, 2000):
        problem = Line(blocks, samples=4)
        shift = np.sin(np.pi * (np.arange(blocks) + 0.5))  # +1, -1: their scatter is known
        residuals = 3 * shift[problem.place] * np.ones(len(problem.place))
        found.append(problem.known(residuals=residuals).widening[0] / np.sqrt(blocks / (blocks - 1)))
    few, many = found
    assert many == pytest.approx(3 * np.sqrt(4), rel=0.01)
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


@pytest.mark.parametrize(("x", "sd", "seen"), [
    (0.012, 0.001, True),
    (0.012, 0.015, False),  # hardly narrower than the prior
    (0.0, 1e-4, False),  # on its bound
    (0.075, 1e-3, False),  # beyond what the prior allows: the interval is outside of it
])  # fmt: skip
def test_a_parameter_is_told_where_its_interval_is_well_inside_the_prior_and_off_its_bounds(x, sd, seen):
    assert is_seen(ARMATURE, x, sd) == seen


def test_no_warning_of_a_fit_is_folded_away_on_its_page():
    told = {
        "sentence": "log.csv tells 1 of 2 parameters",
        "warnings": ("on its bound", "stuck"),
        "combined": ("a + b",),
    }
    said = findings(SimpleNamespace(**told))
    assert (said.verdict, said.beside) == (told["sentence"], ["warning: on its bound", "warning: stuck"])
    assert said.lines == ["a + b", *said.beside, told["sentence"]]
