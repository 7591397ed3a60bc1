"""What a fit is worth: what the log does not tell keeps its prior, and an interval of no width is none."""

import dataclasses

import numpy as np
import pytest

from tuning.identification.fit.identify import Estimate, trusted
from tuning.identification.fit.inference import covariance_of, useless
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
