"""Polyhedra of forces that a grip holds, against linear programs and against the scalar rule."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import mjx_climb as mc
from mjx_climb.physics.contact.polyhedron import PolyhedralGripper, in_grip, magnet, microspines, scalar
from mjx_climb.physics.kinematics import Feet, Surface

KINDS = {"magnet": magnet(20.0, 0.4), "microspines": microspines(0.8, 15.0), "scalar": scalar(15.0, 6, 12)}


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_grip_holds_is_the_answer_of_a_linear_program(kind):
    """The largest multiple of each of 10,000 loads that `A f <= b` admits; a program at each hundredth of them."""
    grip, draw = PolyhedralGripper(**KINDS[kind]), np.random.default_rng(0)
    loads = draw.normal(size=(10_000, 3)) * draw.uniform(0.1, 30.0, (10_000, 1))
    used = np.asarray(grip.utilization(jnp.asarray(loads)))
    held = (loads @ grip.normals.T <= grip.limits).all(1)
    np.testing.assert_array_equal(used <= 1, held)
    for load, share in zip(loads[::100], used[::100], strict=True):
        found = linprog([-1.0], (grip.normals @ load)[:, None], grip.limits, bounds=[(0, 1e9)])
        most = 1 / share if share > 0 else 1e9
        np.testing.assert_allclose(found.x[0], most, rtol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_the_pull_that_margins_count_on_is_the_answer_of_a_linear_program(kind):
    grip = PolyhedralGripper(**KINDS[kind])
    found = linprog([-1.0], -grip.normals[:, 2:], grip.limits, bounds=[(0, 1e9)])
    np.testing.assert_allclose(grip.holding_force(), found.x[0], rtol=1e-6)


def test_shipped_grips_hold_what_their_words_say():
    """On each edge and a little beyond it: shear up to friction times the force on the ground, spines by their load."""
    grip, (pull, friction) = PolyhedralGripper(**magnet(20.0, 0.4, 4)), (20.0, 0.4)
    corner, side = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4)]), np.cos(np.pi / 4)  # a pyramid within the cone
    edges = [(grip, [*(friction * (pull + up) * corner), up]) for up in (-19.0, -5.0, 0.0, 30.0)]
    edges += [(grip, [friction * (pull + up) * side, 0.0, up]) for up in (-19.0, 0.0, 30.0)] + [(grip, [0, 0, -20.0])]
    spines = PolyhedralGripper(**microspines(0.8, 15.0))
    edges += [(spines, each) for each in (
        [0, 0, -0.5], [10.0, 0, -8.5], [15.0, 0, -12.5], [15.0, 0, 0], [0, 15.0, 0], [0, -15.0, 5.0], [-0.5, 0, 0],
        [-5.5, 0, 10.0],
    )]  # fmt: skip
    for grip, force in edges:
        assert float(grip.utilization(jnp.asarray(force, float))) == pytest.approx(1.0, abs=1e-9), force
    assert float(spines.utilization(jnp.array([-1.0, 0.0, -1.0]))) > 1 > float(spines.utilization(jnp.zeros(3)))
    own = PolyhedralGripper(**microspines(1.0, 9.0, friction=0.2, unloaded=3.0))
    for force in ([4.0, 0, -7.0], [-5.0, 0, 10.0], [9.0, 0, 0]):
        assert float(own.utilization(jnp.asarray(force))) == pytest.approx(1.0, abs=1e-9)


def test_a_ball_of_facets_holds_little_more_than_the_ball():
    """Forces that pull, of any direction: by as much as the middle of a facet is off its corners."""
    rings, sides = 12, 24
    grip, draw = PolyhedralGripper(**scalar(15.0, rings, sides)), np.random.default_rng(0)
    force = draw.normal(size=(2000, 3))
    force *= [1, 1, -1] * np.sign(force[:, 2:]) / np.linalg.norm(force, axis=1, keepdims=True)
    least = np.cos(np.pi / 4 / (rings - 1)) * np.cos(np.pi / sides)
    used = np.asarray(grip.utilization(jnp.asarray(15.0 * force)))
    assert (force[:, 2] < 0).all() and used.max() <= 1 + 1e-12 and used.min() >= least
    assert float(grip.holding_force()) == pytest.approx(15.0)
    assert PolyhedralGripper(**scalar(15.0)).normals.shape == (12 * 24, 3)


def test_a_force_in_the_axes_of_a_grip():
    """Its x is outwards: a foot on the left is pulled to the left."""
    outward = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    force = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(in_grip(force, outward), [[2.0, -1.0, 3.0], [-1.0, -2.0, 3.0]])


@pytest.mark.parametrize("way", [*np.eye(3), *-np.eye(3), np.array([0.6, 0.8, 0.0])], ids=str)
def test_outwards_lies_in_the_surface_also_straight_above_the_ground_or_before_a_wall(way):
    """The lever less its part along the normal; where it has no other, any direction in the surface."""
    grip, normal, aside = (
        PolyhedralGripper(**microspines(1.0, 50.0)),
        np.tile(way, (4, 1)),
        np.cross(way, [0.3, 0.5, 0.7]),
    )
    lever = np.array([0.2 * way, -0.1 * way, 0.2 * way + 0.1 * aside, -0.1 * aside])
    start, shut = jnp.zeros((4, 3)), jnp.ones(4, bool)
    memory, surface = grip.init(start, jnp.broadcast_to(jnp.eye(3), (4, 3, 3))), Surface(start, jnp.asarray(normal))
    for closed, off in ((~shut, 0.1), (shut, 0.0)):
        feet = Feet(start + off * normal, 0 * start, jnp.asarray(lever), surface)
        memory, _ = grip.step(memory, feet, None, closed, jnp.zeros(4))
    outward = np.asarray(memory.outward)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(outward @ way, 0.0, atol=1e-9)
    np.testing.assert_allclose(outward[2:], np.outer([1, -1], aside / np.linalg.norm(aside)), atol=1e-9)


def test_the_axes_of_a_grip_are_those_of_the_step_in_which_it_shut():
    """Spines hold a pull of a foot that was shut ahead of the base, wherever the base goes, until it grips anew."""
    grip = PolyhedralGripper(**microspines(1.0, 50.0))
    ahead, beside = np.tile([0.1, 0.0, 0.0], (4, 1)), np.tile([0.0, 0.1, 0.0], (4, 1))
    start = jnp.zeros((4, 3))
    # 3 N of pull and 4 N of the ground outwards, by a spring of 10,000 N/m
    off = start + jnp.array([-4e-4, 0.0, 3e-4])
    shut, memory = jnp.ones(4, bool), grip.init(start, jnp.broadcast_to(jnp.eye(3), (4, 3, 3)))

    def step(memory, position, lever, closed=shut):
        return grip.step(memory, Feet(position, 0 * position, jnp.asarray(lever)), None, closed, jnp.zeros(4))

    memory, _ = step(memory, start + 0.1, ahead, ~shut)
    memory, _ = step(memory, start, ahead)
    memory, held = step(memory, off, ahead)
    assert not held.torn_off.any() and held.support.all()
    memory, held = step(memory, off, beside)
    assert not held.torn_off.any()
    np.testing.assert_allclose(memory.outward, ahead * 10)
    # a foot that opened without leaving the ground has the axes of before
    memory, _ = step(memory, start, beside, ~shut)
    memory, held = step(memory, off, beside)
    assert not held.torn_off.any()
    memory, _ = step(memory, start + 0.1, beside, ~shut)
    memory, _ = step(memory, start, beside)
    np.testing.assert_allclose(memory.outward, beside * 10)
    torn, held = step(memory, off, beside)
    assert held.torn_off.all() and torn.gripper.detached.all()
    # of a foot that is pushed the same shear is too much, but for ClimbLab's rule
    pushed = start + jnp.array([-6e-3, 0.0, -3e-4])
    for only_pulled in (False, True):
        ruled = dataclasses.replace(grip, only_pulled=only_pulled)
        feet = Feet(pushed, 0 * pushed, jnp.asarray(beside))
        assert ruled.step(memory, feet, None, shut, jnp.zeros(4))[1].torn_off.all() != only_pulled


@pytest.mark.slow
def test_the_scalar_limit_is_one_of_them(case):
    """Fine facets around the ball hold up to 0.2 % more: grips are lost in the same step or the next."""
    scenario = case("case_1_2", "pd", {"duration": 0.3, "contact.holding_limit": 1.0, "gravity": [0.1, 0.0, 2.0]})
    ruled = mc.rollout(scenario)
    faceted = mc.Simulation(scenario, contact=PolyhedralGripper(**scalar(1.0, 40, 90), only_pulled=True)).rollout()
    by_rule, by_facets = (walk.torn_off.argmax(0) for walk in (ruled, faceted))
    assert ruled.torn_off.any(0).sum() > 1
    np.testing.assert_array_equal(ruled.torn_off.any(0), faceted.torn_off.any(0))
    assert np.isin(by_facets - by_rule, (0, 1)).all()
    alike = slice(0, by_rule[by_facets > by_rule].min(initial=len(ruled.time)) + 1)  # until one holds on
    np.testing.assert_allclose(ruled.foot_force[alike], faceted.foot_force[alike], atol=1e-9)


@pytest.mark.nightly
def test_a_batch_of_limits_is_torn_off_as_one_robot_is(case):
    """On the fast path, without a fall back: warnings are errors."""
    scenario = case("case_1_2", "pd", {"duration": 0.3})
    weak, limits = magnet(0.5, 0.3, 4), np.array([0.5, 1.0, 100.0])
    own = PolyhedralGripper(normals=weak["normals"], limits=weak["limits"] * limits[:, None])
    batch = mc.Simulation(scenario, contact=own).metrics()
    alone = mc.metrics(mc.Simulation(scenario, contact=PolyhedralGripper(**magnet(0.25, 0.3, 4))).rollout())
    assert alone["detached_at"] is not None
    np.testing.assert_allclose(batch["detached_at"][0], alone["detached_at"], atol=1e-6)
    assert np.isnan(batch["detached_at"][2])
