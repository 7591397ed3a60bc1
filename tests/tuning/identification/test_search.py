"""The search: it ends at its optimum, may sit on a bound and leave it, and is told where a model diverges."""

import dataclasses

import numpy as np
import pytest

from tuning.identification.fit.problem import Evaluated, Prior
from tuning.identification.fit.search import Searches
from tuning.methods.parts import Parts


@dataclasses.dataclass
class Curve:
    """Two variables, and a residual each with its derivative; the cost is half the sum of their squares."""

    residual: object
    derivative: object
    lower: float = -np.inf
    upper: float = np.inf
    calls: int = 0
    sd: float = 100.0

    @property
    def whole_prior(self):
        return Prior(np.zeros(2), np.full(2, self.sd), np.full(2, self.lower), np.full(2, self.upper))

    free = fitted = np.full(2, True)

    def evaluate(self, point):
        self.calls += 1
        value = self.residual(point)
        if not np.isfinite(value).all():
            return None
        return Evaluated(value, value, -self.derivative(point), np.zeros(2))

    def ended(self, point, cost, iterations, ended):
        return point, cost, ended


def ended(curve, first, most=60):
    with Parts(None, dict) as parts:
        return Searches(parts).search(curve, np.array(first, float), most, "search", 1e-8)


def test_a_search_ends_at_its_minimum_across_a_narrow_bent_valley():
    curve = Curve(
        lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
    )
    point, cost, how = ended(curve, (-1.2, 1.0))
    assert how == "converged" and point == pytest.approx([1.0, 1.0], abs=0.01) and cost < 0.001
    assert curve.calls < 40


@pytest.mark.parametrize(("target", "end"), [(-1.0, 0.0), (0.5, 0.5)])
def test_a_search_sits_on_a_bound_and_leaves_it_again(target, end):
    """From the bound itself, both towards the inside and against it."""
    curve = Curve(lambda x: 3 * (x - target), lambda x: np.diag([3.0, 3.0]), lower=0.0)
    point, _, how = ended(curve, (0.0, 2.0))
    assert how == "converged" and point == pytest.approx([end, end], abs=1e-3)
    assert end or (point == 0.0).all()


def test_a_search_ends_beside_a_bound_on_which_the_model_diverges():
    """As a fit of twelve recordings did: the point on the bound was taken, and it ended in an AssertionError."""
    curve = Curve(lambda x: np.where(x > 0, 3 * (x + 1.0), np.nan), lambda x: np.diag([3.0, 3.0]), lower=0.0)
    point, _, how = ended(curve, (1.0, 2.0))
    assert how == "converged" and (point > 0).all() and (point < 1e-2).all()


def test_a_search_whose_evaluations_run_out_says_so_and_a_model_that_diverges_gives_none():
    slow = Curve(lambda x: np.exp(3 - x), lambda x: -np.diag(np.exp(3 - x)))
    assert ended(slow, (0.0, 0.0), most=2)[2] == "out of iterations"
    assert ended(Curve(lambda x: x * np.nan, lambda x: np.eye(2)), (0.0, 0.0)) is None


@pytest.mark.parametrize("sd", [0.5, 5.0])
def test_a_prior_pulls_by_its_standard_deviation(sd):
    """Residuals 0.4 (x - 1) beside x / sd: the least squares are at 0.16 / (0.16 + 1 / sd^2), reached in few steps."""
    curve = Curve(lambda x: 0.4 * (x - 1.0), lambda x: np.diag([0.4, 0.4]), sd=sd)
    point, _, how = ended(curve, (0.5, 0.2))
    assert how == "converged" and point == pytest.approx([0.16 / (0.16 + sd**-2)] * 2, rel=1e-3) and curve.calls < 12
