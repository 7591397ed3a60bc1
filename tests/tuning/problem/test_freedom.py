"""The freedom of plans as each walk has it, and the bounds that searches have where nobody names any."""

import dataclasses
import types

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, LoadTransfer, VirtualModelAdmittance
from mjx_climb.scenario.model import RobotFile
from tuning.problem import spaces
from tuning.problem.plans import Freedom, Knots
from tuning.problem.search import Search
from tuning.problem.spaces import NO_SPACE, default_bounds, kind_of, space

CASE = mc.load_scenario("case_1_2")
STEPS, EVERY = 20, 5


def freedom(common, since, starts=2, members=3):
    rng = np.random.default_rng(0)
    base = 0.1 * rng.standard_normal((starts, members, STEPS, 4, 3))
    return Freedom(base, Knots(STEPS, EVERY), common, since, np.full((4, 3), -0.15), np.full((4, 3), 0.15))


SINCE = np.array([0.0, 4.2, 30.0])


@pytest.mark.parametrize(("common", "since"), [(True, None), (True, SINCE), (False, SINCE)])
def test_the_steering_of_each_walk_makes_its_targets(common, since):
    """Its sets of offsets, each from its own step on or, where there is none, behind the last; between its limits."""
    free = freedom(common, since)
    x = 0.2 * np.random.default_rng(1).standard_normal(free.none.shape)
    offsets, steering = free.steering(x, np.float64)
    assert offsets.shape == (6, 2, free.knots.count, 4, 3)
    lines = free.knots.at_steps(offsets)
    there = np.arange(STEPS) >= steering.begins[..., None]
    whole = steering.base + (lines * there[..., None, None]).sum(1)
    found = np.clip(whole, steering.lower[:, None], steering.upper[:, None])
    np.testing.assert_allclose(found, free.targets(x).reshape(6, STEPS, 4, 3), atol=1e-12)
    assert steering.begins.dtype == np.int32
    wanted = np.full((2, 3, 2), STEPS)
    wanted[..., 0] = 0 if common else STEPS
    wanted[..., 1] = STEPS if since is None else np.minimum(np.ceil(since), STEPS)
    np.testing.assert_array_equal(steering.begins, wanted.reshape(6, 2))


@pytest.mark.parametrize(("common", "since"), [(True, None), (True, SINCE), (False, SINCE)])
def test_slopes_of_problems_are_those_of_the_mean_over_their_members(common, since):
    """By the walks' own offsets, and by their targets: both against central differences of a weighed sum."""
    free = freedom(common, since)
    free = dataclasses.replace(free, lower=free.lower - 9, upper=free.upper + 9)
    weights = np.random.default_rng(2).standard_normal(free.base.shape)
    x = 0.1 * np.random.default_rng(1).standard_normal(free.none.shape)

    def values(point):
        return free.of_problems((free.targets(point) * weights).sum((2, 3, 4)).ravel())

    by_targets = free.slopes(x, weights)
    _, steering = free.steering(x, np.float64)
    there = (np.arange(STEPS) >= steering.begins[..., None])[..., None, None]
    of_sets = free.knots.at_knots(there * weights.reshape(6, 1, STEPS, 4, 3))
    np.testing.assert_allclose(free.slopes_of_sets(of_sets), by_targets, atol=1e-12)
    for place in range(0, x.shape[1], 7):
        step = np.zeros_like(x)
        step[:, place] = 1e-3
        slope = (values(x + step) - values(x - step)) / 2e-3
        np.testing.assert_allclose(by_targets[:, place], slope, atol=1e-9)


# ------------------------------------------------------------------------------------------------------------- bounds


def test_joint_gains_are_searched_about_the_scenarios_own():
    bounds = default_bounds(CASE, PD())
    for name, (below, above) in spaces.JOINT.items():
        own = getattr(CASE.control, name)
        assert bounds[name] == pytest.approx((own / below, own * above))
    none = CASE.with_overrides({"control.kd": 0.0})
    damped = 4e-3 * CASE.control.kp
    assert default_bounds(none, PD())["kd"] == pytest.approx((damped / spaces.JOINT["kd"][0],
                                                              damped * spaces.JOINT["kd"][1]))  # fmt: skip


def test_bounds_of_a_laws_gains_are_its_own():
    shipped = VirtualModelAdmittance().search_bounds(CASE.time_step)
    assert {name: default_bounds(CASE, VirtualModelAdmittance())[name] for name in shipped} == shipped
    own = LoadTransfer().search_bounds(CASE.time_step)
    assert {name: default_bounds(CASE, LoadTransfer())[name] for name in own} == own


class Own(VirtualModelAdmittance):
    """A law that makes bounds of its own."""

    def search_bounds(self, time_step):
        return {"damping": (1.0, 2.0)}


def test_bounds_of_the_papers_gains_are_in_proportion_to_the_mass_of_a_robot_from_a_file(monkeypatch):
    """Both ends; those that a law makes, and the joint loop's, are not."""
    masses = {"hubrobo_v3_2": 2.0}
    monkeypatch.setattr(
        spaces, "load_robot", lambda robot: types.SimpleNamespace(total_mass=masses.get(str(robot), 5.0))
    )
    case = CASE.model_copy(update={"robot": RobotFile.model_construct(file="mine.xml")})
    for law, times in ((VirtualModelAdmittance(), 2.5), (Own(), 1.0)):
        own, found = default_bounds(CASE, law), default_bounds(case, law)
        assert own.keys() == found.keys() and {"damping", "kp", "kd"} <= own.keys()
        for name, (low, high) in own.items():
            scale = 1.0 if name in spaces.JOINT else times
            assert found[name] == pytest.approx((low * scale, high * scale)), name


@pytest.mark.parametrize(
    ("changes", "name", "span"),
    [
        ({}, "gait.duty", (0.75, None)),
        ({}, "gait.step_height", "half to twice"),
        ({}, "gait.cycle", "half to twice"),
    ],
)
def test_a_gait_is_searched_from_half_to_twice_and_keeps_the_order_of_its_swings(changes, name, span):
    case = CASE.with_overrides(changes)
    found = space(case, Search(also=(name,)))
    place = found.names.index(name)
    own = getattr(case.gait, name.removeprefix("gait."))
    low, high = (
        float(np.exp(end)) if found.units[place] == 0 else float(end * found.units[place])
        for end in (found.lower[place], found.upper[place])
    )
    if span == "half to twice":
        assert (low, high) == pytest.approx((own / 2, own * 2))
    else:
        assert low == pytest.approx(span[0]) and high > low


def test_ki_is_searched_about_its_own_or_in_proportion_to_kp():
    for ki in (0.0, 30.0):
        found = space(CASE.with_overrides({"control.ki": ki}), Search(also=("ki",)))
        place = found.names.index("ki")
        low, high = np.exp([found.lower[place], found.upper[place]])
        middle = ki or spaces._PER_KP * CASE.control.kp
        assert np.sqrt(low * high) == pytest.approx(middle) and high / low == pytest.approx(spaces._INTEGRAL**2)


def test_tangents_of_gains_are_differences_along_the_coordinates():
    found = space(CASE, Search(also=("gait.duty",), space="split"))
    rng = np.random.default_rng(0)
    theta = found.draw(rng, 5)
    along = rng.standard_normal((2, found.size))
    made, h = found.to_tangents(theta, along), 1e-6
    for k, direction in enumerate(along):
        ends = [found.to_gains(theta + side * h * direction) for side in (1, -1)]
        for name in ("stiffness", "damping", "gait.duty"):
            slope = (np.asarray(ends[0][name]) - np.asarray(ends[1][name])) / (2 * h)
            np.testing.assert_allclose(np.asarray(made[name])[k], slope, rtol=1e-6)


def test_a_hypercube_has_one_point_in_each_slice_of_each_axis():
    found = space(CASE, Search(space="split"))
    points = found.draw(np.random.default_rng(0), 8)
    for axis in range(found.size):
        share = (points[:, axis] - found.lower[axis]) / (found.upper[axis] - found.lower[axis])
        assert sorted((share * 8).astype(int)) == list(range(8))
    tied = found.draw_tied(np.random.default_rng(0), 8)
    kinds = np.array([kind_of(name) for name in found.names])
    for kind in set(kinds):
        own = np.exp(tied[:, kinds == kind])
        inside = (tied[:, kinds == kind] > found.lower[kinds == kind]) & (
            tied[:, kinds == kind] < found.upper[kinds == kind]
        )
        spread = np.where(inside.all(1), np.ptp(own, axis=1), 0.0)
        np.testing.assert_allclose(spread, 0.0, atol=1e-9 * own.max())


def test_points_on_a_bound_are_named_once_a_thousandth_from_it():
    found = space(CASE, Search(space="isotropic"))
    middle = (found.lower + found.upper) / 2
    assert found.on_bound(middle) == [] and NO_SPACE.size == 0
    for end, sign in ((found.lower, 1), (found.upper, -1)):
        for share, named in ((0.0009, True), (0.0011, False)):
            point = middle.copy()
            point[1] = end[1] + sign * share * (found.upper - found.lower)[1]
            assert (found.on_bound(point) == [found.names[1]]) is named
