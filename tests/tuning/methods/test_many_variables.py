"""Descents in many variables, and the freedom of plans, against optimal controls that are known exactly."""

import numpy as np
import pytest
from scipy import linalg

from tuning.methods.many_variables import Evaluated, descend
from tuning.problem.plans import Freedom, Knots

STEPS, DT = 40, 0.03  # s
KP, KD, MASS, WEIGHT = 40.0, 2.0, 1.0, 0.2
WIDE = np.full((1, 1), 1e3)


def motion():
    """Return x' = A x + B u of a mass on one joint, x angle and rate, under the joint loop with target u: exact."""
    continuous = np.array([[0.0, 1.0], [-KP / MASS, -KD / MASS]])
    whole = linalg.expm(DT * np.block([[continuous, np.array([[0.0], [KP / MASS]])], [np.zeros((1, 3))]]))
    return whole[:2, :2], whole[:2, 2:]


def responses(pushes=()):
    """Return the angles (steps,) of a mass let go at 1 rad, pushed in some steps, and their slopes by targets."""
    a, b = motion()
    state, slopes = np.array([1.0, 0.0]), np.zeros((2, STEPS))
    angles, along = [], []
    for step in range(STEPS):
        slopes = a @ slopes
        slopes[:, step] += b[:, 0]
        state = a @ state + np.array([0.0, dict(pushes).get(step, 0.0)])
        angles.append(state[0])
        along.append(slopes[0])
    return np.array(angles), np.array(along)


def searched(freedom, members, evaluations=200, step=0.3):
    """Return the cost that a descent finds: sum of squares of angles and of targets, meant over members."""
    each = [responses(pushes) for pushes in members]

    def costs(targets):
        angles = [free + along @ own for (free, along), own in zip(each, targets, strict=True)]
        slopes = [
            2 * (along.T @ one + WEIGHT * own) for (_, along), one, own in zip(each, angles, targets, strict=True)
        ]
        return np.array(
            [(one**2).sum() + WEIGHT * (own**2).sum() for one, own in zip(angles, targets, strict=True)]
        ), np.array(slopes)

    def evaluate(x, _):
        merit, slopes = costs(freedom.targets(x)[0, :, :, 0, 0])
        return Evaluated(freedom.of_problems(merit), freedom.slopes(x, slopes[None, :, :, None, None]))

    return descend(evaluate, freedom.none, evaluations, step=step).merit.mean()


def free(members, common, since, every=1):
    base = np.zeros((1, members, STEPS, 1, 1))
    return Freedom(base, Knots(STEPS, every), common, since, -WIDE, WIDE)


def test_a_mass_on_one_joint_is_moved_as_riccati_says():
    """The least cost of the linear-quadratic problem is x0' P x0 less the cost at the start; to 1 %."""
    a, b = motion()
    cost = np.diag([1.0, 0.0])
    p = cost
    for _ in range(STEPS):
        gain = np.linalg.solve(WEIGHT + b.T @ p @ b, b.T @ p @ a)
        p = cost + a.T @ p @ (a - b @ gain)
    least = p[0, 0] - 1.0  # at 1 rad, at rest; the angle of the start itself is none of the sum
    found = searched(free(1, False, np.zeros(1)), [()])
    assert least <= found * (1 + 1e-9) and found == pytest.approx(least, rel=0.01)


def test_a_descent_ends_at_its_best_point_and_follows_the_true_extremes_at_the_end():
    """Steps of 1 overshoot: the best point is none of the last ones. Of ten evaluations six are smooth, three true."""
    asked, first = [], np.array([[1.0, 2.0], [0.3, -1.0]])

    def evaluate(x, sharp):
        asked.append((x.copy(), sharp))
        return Evaluated((x**2).sum(1), 2 * x)

    found = descend(evaluate, first, 10, step=1.0)
    places, sharp = zip(*asked, strict=True)
    assert sharp == (0.0,) * 6 + (1.0,) * 3 + (0.0,)
    merits = np.array([(x**2).sum(1) for x in places[:-1]])
    np.testing.assert_allclose(found.merit, merits.min(0))
    np.testing.assert_array_equal(found.x, [places[at][row] for row, at in enumerate(merits.argmin(0))])
    np.testing.assert_array_equal(places[-1], found.x)
    assert not np.array_equal(places[-1], places[-2])
    np.testing.assert_allclose(found.slope, np.linalg.norm(found.x, axis=1) / np.linalg.norm(first, axis=1))
    np.testing.assert_array_equal(found.first, merits[0])


def exact(members, shared_until):
    """Return the least mean cost of targets that members share up to a step each: by least squares."""
    count, rows, right = len(members), [], []
    place = np.zeros((count, STEPS), int)
    number = STEPS  # the shared ones come first
    for member, until in enumerate(shared_until):
        for step in range(STEPS):
            place[member, step] = step if step < until else number
            number += step >= until
    for member, pushes in enumerate(members):
        angles, along = responses(pushes)
        for matrix, offset in ((along, angles), (np.sqrt(WEIGHT) * np.eye(STEPS), np.zeros(STEPS))):
            whole = np.zeros((STEPS, number))
            whole[:, place[member]] += matrix
            rows.append(whole)
            right.append(-offset)
    matrix, aim = np.concatenate(rows), np.concatenate(right)
    best = np.linalg.lstsq(matrix, aim, rcond=None)[0]
    return ((matrix @ best - aim) ** 2).sum() / count


def test_plans_that_know_later_are_no_better_and_as_good_as_least_squares():
    """Two members are pushed either way at step 20: blind, 5 steps late, and known in advance."""
    members, onset = [((20, 3.0),), ((20, -4.0),)], np.array([20, 20])
    never, at_once = np.full(2, STEPS), np.zeros(2, int)
    kinds = {
        "blind": (free(2, True, None), never),
        "causal": (free(2, True, onset + 5), onset + 5),
        "clairvoyant": (free(2, False, at_once), at_once),
    }
    found = {}
    for name, (freedom, until) in kinds.items():
        found[name] = searched(freedom, members)
        assert found[name] == pytest.approx(exact(members, until), rel=0.01), name
    assert found["clairvoyant"] < found["causal"] < found["blind"]


def test_more_knots_never_end_higher():
    known, base = None, np.zeros((1, 1, STEPS, 1, 1))
    angles, along = responses()
    ends = []
    for every in (20, 10, 5):
        freedom = Freedom(base, Knots(STEPS, every), False, np.zeros(1), -WIDE, WIDE)

        def evaluate(x, _, freedom=freedom):
            own = freedom.targets(x)[0, 0, :, 0, 0]
            slopes = 2 * (along.T @ (angles + along @ own) + WEIGHT * own)
            merit = ((angles + along @ own) ** 2).sum() + WEIGHT * (own**2).sum()
            return Evaluated(np.array([merit]), freedom.slopes(x, slopes[None, None, :, None, None]))

        found = descend(evaluate, freedom.none, 40, step=5.0, known=known)  # far too long a step
        base, known = freedom.targets(found.x), found.merit
        ends.append(found.merit[0])
    assert ends == sorted(ends, reverse=True)


def test_slopes_by_knots_are_those_by_steps_through_the_lines():
    rng, knots = np.random.default_rng(0), Knots(23, 5)
    at_knots, at_steps = rng.normal(size=(2, knots.count, 4, 3)), rng.normal(size=(2, 23, 4, 3))
    np.testing.assert_allclose(
        (knots.at_steps(at_knots) * at_steps).sum(), (at_knots * knots.at_knots(at_steps)).sum(), rtol=1e-12
    )
    line = np.arange(knots.count)[:, None, None] * np.ones((1, 4, 3))
    np.testing.assert_allclose(knots.at_steps(line)[:, 0, 0], np.arange(23) / 5)


def test_a_plan_stays_within_the_joint_limits_and_has_no_slope_beyond():
    freedom = Freedom(np.zeros((1, 1, 9, 1, 1)), Knots(9, 4), True, None, -np.ones((1, 1)), np.ones((1, 1)))
    x = freedom.none + np.array([[0.5, 3.0, 0.5, 0.5]])
    assert freedom.targets(x).max() == 1.0
    slopes = freedom.slopes(x, np.ones((1, 1, 9, 1, 1)))
    assert slopes[0, 1] < freedom.slopes(freedom.none, np.ones((1, 1, 9, 1, 1)))[0, 1]


def test_lost_walks_are_taken_back():
    """Beyond 1 the walk diverges; the least is at 0.9."""

    def evaluate(x, _):
        merit = np.where(x[:, 0] > 1, np.nan, (x[:, 0] - 0.9) ** 2)
        return Evaluated(merit, 2 * (x - 0.9) + np.where(x > 1, np.nan, 0.0))

    found = descend(evaluate, np.array([[0.0], [0.99]]), 120, step=0.5)
    np.testing.assert_allclose(found.x[:, 0], 0.9, atol=0.02)
    assert (found.merit <= found.first).all()
