"""The search by Levenberg and Marquardt: where it ends, and what it says of that."""

from types import SimpleNamespace

import numpy as np
import pytest

from tuning.identification.fit.iterates import Iterates
from tuning.identification.fit.least_squares import LeastSquares, Normal
from tuning.identification.fit.levenberg_marquardt import search
from tuning.identification.fit.stamps import Stamped
from tuning.identification.model.variables import Variable
from tuning.methods.parts import Parts


class Curve(LeastSquares):
    """One variable, and a residual r(x) with its derivative; the cost is r^2 / 2."""

    def __init__(self, residual, derivative):
        variable = Variable("x", "1", 0.0, 0.0, 1e6, -np.inf, np.inf)
        model = SimpleNamespace(variables=(variable,), memory=())
        vars(self).update(model=model, noise=np.ones(1), clock=0.0, residual=residual, derivative=derivative)

    def linearized(self, x, start):
        none, nothing = np.zeros((0, 1, 0)), np.zeros(0)
        found = []
        for (point,) in x:
            r, along = self.residual(point), -self.derivative(point)
            found.append(Normal(
                r**2 / 2, np.array([along * r]), np.array([[along**2]]), none, none[..., None], none[..., None],
                np.zeros((0, 1, 1, 0)), np.array([r]), Stamped(nothing, nothing, nothing, nothing, 0.0),
            ))  # fmt: skip
        return found


def ended(residual, derivative, start, most=40):
    with Parts(None, dict) as parts:
        (found,) = search(
            Curve(residual, derivative), np.array([[start]]), np.zeros((1, 1, 0)), most, "search", Iterates(parts)
        )
    return found


def test_a_search_that_comes_to_its_minimum_says_so():
    found = ended(lambda x: 10 * (x - 3.0), lambda x: 10.0, 0.0)
    assert found.ended == "converged" and found.x[0] == pytest.approx(3.0) and found.away[0] < 1e-3


def test_a_search_that_no_step_leads_on_is_stuck_and_says_how_far_it_is():
    """The derivative has the wrong sign: each step makes the cost larger until damping leaves none."""
    found = ended(lambda x: 10 * (x - 3.0), lambda x: -10.0, 0.0)
    assert found.ended == "stuck" and found.away[0] == pytest.approx(30.0, rel=0.01)


def test_a_search_whose_iterations_run_out_says_how_far_it_is():
    found = ended(lambda x: np.exp(3 - x), lambda x: -np.exp(3 - x), 0.0, most=2)
    assert found.ended == "out of iterations" and found.away[0] > 1.0
