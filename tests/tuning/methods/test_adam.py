"""Adam for the rows of a batch: which rows go back to their best point, and how far they step from there."""

from types import SimpleNamespace

import jax
import numpy as np

import mjx_climb as mc
from tuning.methods.adam import Adam
from tuning.methods.gradient import SINGLE, Leg, by_adam
from tuning.problem import spaces
from tuning.problem.evaluation import Evaluation
from tuning.problem.search import Search

NOBODY = np.zeros(2, bool)


def begun(patience=3):
    return Adam(np.zeros((2, 1)), 1, (0.9, 0.97), patience, 1e-30)


def test_a_row_that_finds_nothing_better_goes_back_after_each_while_and_steps_half_as_far():
    """The first row has its best point at 1; the second finds better ones all along. Slopes are 1: so is a step."""
    adam, back, lengths = begun(), [], []
    for number in range(10):
        x = np.full((2, 1), number + 1.0)
        merit = np.array([float(number > 0), -float(number)])
        there, steps = adam.step(x, merit, np.ones((2, 1)), NOBODY)
        if there[0] != x[0]:
            back.append(number)
            assert there[0] == 1.0
        lengths.append(steps[:, 0])
        assert there[1] == x[1]
    assert back == [3, 6, 9]
    scales = [1.0] * 3 + [0.5] * 3 + [0.25] * 3 + [0.125]
    np.testing.assert_allclose(lengths, np.column_stack([scales, np.ones(10)]))
    np.testing.assert_array_equal(adam.best[:, 0], [1.0, 10.0])


def test_steps_are_compiled_once():
    """All but the first of each shape."""
    adam, heard = begun(), []
    listener = lambda event, *_, **__: heard.append(event)  # noqa: E731
    for number in range(3):
        if number == 1:
            jax.monitoring.register_event_duration_secs_listener(listener)
        adam.step(np.zeros((2, 1)), np.zeros(2), np.ones((2, 1)), NOBODY)
    jax.monitoring.unregister_event_duration_listener(listener)
    assert not heard


def test_a_row_that_is_lost_goes_back_at_once_with_an_empty_memory():
    """As far as before where there is no point to go back to; a lost point is never the best, whatever its merit."""
    adam, slopes = begun(), np.array([[2.0], [-2.0]])
    adam.step(np.ones((2, 1)), np.array([1.0, 1.0]), slopes, np.array([False, True]))
    there, steps = adam.step(np.full((2, 1), 5.0), np.array([-9.0, -9.0]), -slopes, ~NOBODY)
    np.testing.assert_array_equal(there[:, 0], [1.0, 0.0])
    # the slope at the best point, with a memory of nothing else
    np.testing.assert_allclose(steps[:, 0], [0.5, 0.0], atol=1e-12)
    np.testing.assert_array_equal(adam.least, [1.0, np.inf])
    # the second step of a memory whose first slope was 0, at full length
    _, steps = adam.step(there, np.array([0.5, 0.5]), slopes, NOBODY)
    np.testing.assert_allclose(steps[1], -(0.1 / (1 - 0.9**2)) / np.sqrt(0.03 / (1 - 0.97**2)))


def test_a_step_over_a_cliff_is_taken_back():
    """Where the value is ten times the best one's above it, 10 at least; slopes are 1, so that points go down."""
    space = spaces.space(mc.Scenario(), Search(space="isotropic"))
    middle = np.tile((space.lower + space.upper) / 2, (3, 1))
    leg = Leg(middle, np.eye(space.size), 4, SINGLE, np.ones(3))

    def found(*value):
        value, ones = np.array(value), np.ones((3, space.size))
        return Evaluation(value, value, 0 * value, value < np.inf, ones, ones, {})

    for third, back in (((1090.0, 10.9, 9.0), False), ((1110.0, 11.1, 11.0), True)):
        moves = by_adam(SimpleNamespace(problem=SimpleNamespace(space=space)), leg, np.random.default_rng(0))
        first, second = next(moves), moves.send(found(100.0, 1.0, 0.1))
        assert (second.theta < first.theta).all()
        last = moves.send(found(*third))
        assert ((last.theta > second.theta) == back).all()
