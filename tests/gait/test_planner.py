"""The planner: choice of footholds in a walk, and recovery."""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control.recovering import Recovering
from mjx_climb.gait.chosen_footholds import middle_of, situation_of, towards
from mjx_climb.gait.footholds.climblab import ClimbLab
from mjx_climb.gait.footholds.held import Held, hold_axes, no_holds
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.gait.own_swings import OwnSwings
from mjx_climb.gait.recovery import Recovery
from mjx_climb.ground import Holds
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.gains import own_section
from tuning.problem import spaces
from tuning.problem.search import Search

PUSH = {"force": [0.0, 10.0, 0.0], "start": 0.02, "stop": 0.06}
NO_PUSH = PUSH | {"force": [0.0, 0.0, 0.0]}
SOFT = {"control.kd": 0.1}  # N m s/rad, with which a stretched limb can follow the time step
# a limb swings for 0.2 s; footholds are near, so that nothing tears off
SHORT = {
    "duration": 0.3, "gait.cycle": 0.8, "gait.stride": 0.004, "gait.step_height": 0.005,
    "disturbance.pushes": [NO_PUSH],
}  # fmt: skip
SWING = 200  # steps
THRESHOLD = 0.001  # m
LH = 1  # swings first


def holds(position):
    """Return holds at points (..., n, 3) on level ground."""
    batch, count = position.shape[:-2], position.shape[-2]
    return Holds(
        position=position, normal=np.broadcast_to([0.0, 0.0, 1.0], position.shape),
        limit_matrix=np.zeros((*batch, count, 0, 3)), limit_bound=np.zeros((*batch, count, 0)),
        valid=np.ones((*batch, count)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_2", "pd", SHORT)


@pytest.fixture(scope="module")
def soft(scenario):
    """That of walks on holds."""
    return scenario.with_overrides(SOFT)


@pytest.fixture(scope="module")
def planned(scenario):
    return mc.rollout(scenario)


@pytest.mark.slow
def test_a_planner_that_has_nothing_to_do_changes_no_walk(scenario, planned):
    """The limbs swing at the same steps, the base reference is the same; swings begin where the feet grip."""
    watched = mc.rollout(scenario.with_overrides({"control.recovery.shift": 1.0}))
    assert not planned.detached.any()
    np.testing.assert_array_equal(watched.support, planned.support)
    np.testing.assert_allclose(watched.base_reference, planned.base_reference, rtol=0, atol=1e-12)
    np.testing.assert_allclose(watched.foot_target, planned.foot_target, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_push_interrupts_the_gait(scenario, planned):
    """The base reference moves to the base, and the limb in the air is on the ground sooner than planned."""
    own = {"shift": THRESHOLD, "utilization": 1e3, "landing_time": 0.05, "rest_time": 0.3, "take_over": 1.0}
    law = Recovering(**{f"recovery_{name}": value for name, value in own.items()})
    pushed = mc.rollout(scenario.with_overrides({"disturbance.pushes": [PUSH]}), law=law)
    moved = np.linalg.norm(pushed.base_reference - planned.base_reference, axis=1)
    at = int((moved > 1e-9).argmax())
    assert 20 < at < SWING - 60 and at % 20 == 0
    # at a tick the reference is where the base is
    np.testing.assert_allclose(pushed.base_reference[at], pushed.base_position[at], rtol=0, atol=1e-12)
    assert moved[at] > THRESHOLD
    assert not pushed.support[:at, LH].any() and pushed.support[at + 52 : SWING, LH].all()
    # the gait stands still: LF, which is next, would lift off after the swing
    assert pushed.support[at + 52 :].all() and not planned.support[SWING:].all()


@pytest.fixture(scope="module")
def rock(planned):
    """Grounds (3, 12, 3) m: a hold near each foot, and eight elsewhere."""
    random = np.random.default_rng(0)
    near = planned.foot_position[0] + random.normal(0, 0.004, (3, 4, 3))
    points = np.concatenate([near, random.uniform(-0.3, 0.3, (3, 8, 3))], axis=1)
    points[..., 2] = 0
    return points


@pytest.mark.slow
def test_a_limb_swings_to_the_nearest_hold(soft, planned, rock):
    """The first limb that swings grips the hold that is nearest to its planned foothold."""
    parameters = dataclasses.replace(own_parameters(soft), ground=Ground(holds=holds(rock[0])), footholds=Nearest())
    walk = mc.rollout(soft, parameters=parameters)
    want = planned.foot_position[0, LH] + [soft.gait.stride, 0, 0]
    hold = rock[0][np.linalg.norm(rock[0] - want, axis=1).argmin()]
    np.testing.assert_allclose(walk.grip_point[SWING + 20, LH], hold, rtol=0, atol=5e-4)


@pytest.mark.slow
def test_a_hold_bears_what_its_polyhedron_says(soft, rock):
    """A pull along its normal of more than its limit tears the grip off at once; one of less does not."""
    own, pulled = own_parameters(soft), np.tile([[[0.0, 0.0, -1.0]]], (12, 1, 1))
    normal = np.array([0.48, 0.36, 0.8])

    def walked(limit, some=slice(None)):
        limits = {"limit_matrix": pulled, "limit_bound": np.full((12, 1), 1e3)}
        limits["limit_bound"][some] = limit
        ground = dataclasses.replace(holds(rock[0]), normal=np.tile(normal, (12, 1)), **limits)
        return mc.rollout(soft, parameters=dataclasses.replace(own, ground=Ground(holds=ground), footholds=Nearest()))

    strong = walked(1e3)
    landed = np.arange(len(strong.time)) >= SWING
    np.testing.assert_allclose(strong.ground_normal[SWING + 1, LH], normal)
    # so it stands from the start
    np.testing.assert_allclose(strong.ground_normal[:SWING, 0], np.tile(normal, (SWING, 1)))
    pull = np.where(landed & strong.support[:, LH], -strong.foot_force[:, LH] @ normal, 0.0)
    assert pull.max() > 0 and not strong.torn_off.any()
    # of the hold where it lands alone
    hold, limit = np.linalg.norm(rock[0] - strong.grip_point[-1, LH], axis=1).argmin(), 0.5 * pull.max()
    weak = walked(limit, hold)
    first = int((pull > limit).argmax())
    # until then both walks are one
    np.testing.assert_array_equal(weak.foot_force[: first + 1], strong.foot_force[: first + 1])
    assert weak.torn_off[first, LH] and weak.torn_off.sum() == 1 and not weak.support[first + 1, LH]
    # of the limits of hold and gripper that counts which is nearer
    pulls = pull > 0
    of_gripper = np.linalg.norm(strong.foot_force[pulls, LH], axis=1) / soft.contact.holding_limit
    np.testing.assert_allclose(strong.utilization[pulls, LH], np.maximum(of_gripper, pull[pulls] / 1e3))
    assert weak.utilization[first, LH] == pytest.approx(pull[first] / limit) and of_gripper.max() < pull[first] / limit


def test_the_axes_of_a_hold_are_those_of_the_reference():
    """Uphill in the surface, across, along the normal; where the weight is along the normal x is uphill."""
    random = np.random.default_rng(0)
    for normal, weight in ((random.normal(size=3), random.normal(size=3)), ([0, 0, 2.0], [0, 0, -9.0]), ([1, 0, 0], 0)):
        unit = np.asarray(normal) / np.linalg.norm(normal)
        axes = np.asarray(hold_axes(unit, np.broadcast_to(weight, 3) * 1.0))
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(axes[:, 2], unit, atol=1e-12)
        want = -np.broadcast_to(weight, 3) if np.any(weight) and abs(unit[2]) < 1 else np.eye(3)[int(abs(unit[0]) == 1)]
        along = want - (want @ unit) * unit
        np.testing.assert_allclose(axes[:, 0], along / np.linalg.norm(along), atol=1e-12)


def test_the_plane_of_a_hold_counts_near_it_and_its_limit_where_it_is_held():
    """At both ends of a swing; between them the ground is level. Of grip and hold the weaker one bears the pull."""
    random = np.random.default_rng(0)
    start, goal = random.normal(size=(2, 4, 3))
    normal, left = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in random.normal(size=(2, 4, 3)))
    held = Held(jnp.asarray(normal), jnp.asarray(-normal[:, None]), jnp.full((4, 1), 5.0))
    progress: Any = SimpleNamespace(held=held, left=left, start=start, goal=jnp.asarray(goal), below=start[:, 2])
    plan: Any = SimpleNamespace(settling=0.2)
    gait = OwnSwings(plan, 0.001, False, None, None, None, 1)
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    middle = np.column_stack([goal[:, :2], start[:, 2]])
    each = {-0.1: (start, left), 0.07: (start, left), 0.3: (middle, up), 0.6: (goal, up), 0.73: (goal, normal)}
    for phase, (point, around) in (each | {4.0: (goal, normal)}).items():
        now: Any = SimpleNamespace(swing_phase=jnp.full(4, phase))
        _, surface = gait.ground(progress, now)
        np.testing.assert_array_equal(surface.point, point)
        np.testing.assert_array_equal(surface.normal, around)
        for grip, weaker in ((15.0, 5.0), (3.0, 3.0), (0.0, 5.0)):
            pull = gait.pulls(progress, now, surface, jnp.asarray(grip))
            np.testing.assert_allclose(pull, (weaker if phase >= 1 else grip) * around, rtol=1e-12)
    # a choice counts on the holds where limbs will stand, and before the first one on level ground
    body: Any = SimpleNamespace(support=None, center_of_mass=0, weight=None, holding_force=jnp.asarray(3.0))
    plan = SimpleNamespace(swing_steps=1, cycle_steps=4)
    for hold, around in ((held, normal), (no_holds(holds(start), goal), up), (None, up)):
        progress.held = hold
        pull = situation_of(plan, progress, body, jnp.ones(3)).pull
        np.testing.assert_allclose(pull, 3 * around, rtol=1e-12)


@pytest.mark.slow
def test_different_grounds_are_one_program_and_each_walks_as_alone(soft, rock):
    """Three grounds in a batch walk as each does alone, and neighbours change no bit."""
    own, rule = own_parameters(soft), Nearest()

    def walked(points):
        return mc.rollout_metrics(
            soft,
            parameters=dataclasses.replace(own, ground=Ground(holds=holds(points)), footholds=rule),
            dtype=np.float64,
        )

    together, others = walked(rock), walked(rock[[2, 1, 1]])
    assert len(np.unique(together["base_deviation"])) == 3
    for name, values in together.items():
        np.testing.assert_array_equal(others[name][:2], values[[2, 1]], err_msg=name)
        np.testing.assert_allclose(walked(rock[:1])[name], values[:1], rtol=1e-12, err_msg=name)


@pytest.mark.slow
@pytest.mark.nightly
def test_tangents_pass_with_the_choice_frozen(soft, rock):
    """The derivative by a gain is that of finite differences, between which the choice stays."""
    parameters = dataclasses.replace(own_parameters(soft), ground=Ground(holds=holds(rock[0])), footholds=Nearest())
    how = {"parameters": parameters, "dtype": np.float64}
    _, tangents = mc.rollout_jvp(soft, {"kp": 50.0}, {"kp": np.array([1.0])}, **how)
    ends = [mc.rollout_metrics(soft, {"kp": 50.0 + step}, **how) for step in (-1e-3, 1e-3)]
    for name in ("cost_of_transport", "force_variation"):
        difference = (ends[1][name] - ends[0][name]) / 2e-3
        assert difference != 0
        np.testing.assert_allclose(tangents[name].ravel()[0], difference, rtol=1e-4, err_msg=name)


@pytest.mark.parametrize("limbs", [3, 4, 6])
def test_the_base_stands_where_the_lines_between_opposite_feet_meet(limbs):
    """For four feet the intersection of the diagonals; of more the point of least squares; of three the mean."""
    random = np.random.default_rng(limbs)
    angles = 2 * np.pi * np.arange(limbs) / limbs
    feet = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) + random.normal(0, 0.1, (limbs, 3))
    found = np.asarray(middle_of(feet))
    if limbs == 3:
        np.testing.assert_allclose(found, feet.mean(0), atol=1e-12)
        return
    one, other = feet[: limbs // 2, :2], feet[limbs // 2 :, :2]
    across = (other - one) @ np.array([[0, 1], [-1, 0]])
    across /= np.linalg.norm(across, axis=1)[:, None]
    meet = np.linalg.lstsq(across, (across * one).sum(1), rcond=None)[0]
    np.testing.assert_allclose(found, [*meet, feet[:, 2].mean()], atol=1e-12)


def test_the_base_moves_as_far_as_all_feet_stay_within_reach(scenario):
    """Of the shares of its way the largest, by joint angles found anew, with room left before a limb is straight."""
    robot = load_robot(scenario.robot)
    geometry, random, shares = limb_geometry(robot), np.random.default_rng(0), [0.0, 0.25, 0.5, 0.75, 1.0]
    start, rotation = robot.stance_position, np.eye(3)
    stance = start + limb_frames(robot, None, robot.stance_joints).foot
    feet = stance + random.normal(0, [0.04, 0.04, 0.005], (200, 4, 3))
    goal = start + random.normal(0, [0.06, 0.06, 0.005], (200, 3))
    reach = functools.partial(within_reach, robot, geometry)
    found = jax.vmap(lambda feet, goal: towards(reach, feet, rotation, start, goal))(feet, goal)
    made = []
    for each, end, place in zip(feet, goal, np.asarray(found), strict=True):
        fine = []
        for share in shares:
            lever = each - (start + share * (end - start)) - robot.frame_position[:, 0]
            angles, reachable = inverse_kinematics(geometry, 1.05 * lever + robot.frame_position[:, 0])
            within = (angles >= robot.joint_lower) & (angles <= robot.joint_upper)
            fine.append(bool(reachable.all() and within.all()))
        made.append(max((share for share, may in zip(shares, fine, strict=True) if may), default=0.0))
        np.testing.assert_allclose(place, start + made[-1] * (end - start), atol=1e-6)
    assert {*made} == {*shares}


def test_footholds_are_chosen_where_there_are_holds_alone(scenario):
    with pytest.raises((ConfigError, ValueError), match="expected planned, as the ground has no holds"):
        mc.rollout_metrics(scenario.with_overrides({"gait.footholds": "nearest"}))


def test_no_threshold_is_no_recovery(scenario):
    """By default there is no component: the program is that of the planned walk."""
    assert own_parameters(scenario).recovery is None
    assert own_parameters(scenario).footholds is None
    some = own_parameters(scenario.with_overrides({"control.recovery.margin": 0.5})).recovery
    assert isinstance(some, Recovery) and some.margin == 0.5 and np.isinf(some.shift)


def test_gains_of_a_law_are_values_of_the_recovery(scenario):
    """Searches find them in any sum with the law that has them; the scenario's own values stay beside them."""
    law = own_section.load_law("VirtualModelAdmittance+Recovering")
    names = spaces.space(scenario, Search(), law).names
    assert {"damping", "recovery_shift", "recovery_take_over"} <= {*names} and "recovery_return_time" not in names
    some = scenario.with_overrides({"control.recovery": {"margin": 0.5, "shift": 0.1}})
    found = resolve_in(some, law, {"recovery_shift": np.array([0.01, 0.02])}, None, np.float64).parameters.recovery
    np.testing.assert_array_equal(found.shift, [0.01, 0.02])
    assert found.margin == 0.5 and found.utilization == 0.6
    assert resolve_in(scenario, law, None, None, np.float64).parameters.recovery.shift == 0.015


def test_the_choice_is_part_of_the_parameters():
    assert jax.tree.leaves(ClimbLab()) == [0.1]


def test_a_walk_shorter_than_a_period_of_the_planner_is_one_period(scenario):
    short = scenario.with_overrides({"duration": 0.05, "gait.planning_period": 0.1})
    assert short.planning_steps == short.steps


@pytest.mark.nightly
@pytest.mark.slow
def test_step_by_step_it_is_the_same_walk(scenario):
    """A robot that is stepped from outside decides at the same steps as one that walks."""
    recovery = {"control.recovery.shift": THRESHOLD, "gait.planning_period": 0.01}
    simulation = mc.Simulation(scenario.with_overrides(recovery | {"disturbance.pushes": [PUSH], "duration": 0.1}))
    whole, state = simulation.rollout(), simulation.reset(dtype=np.float64)
    step, references = jax.jit(simulation.step), []
    for _ in range(100):
        state, sample = step(state)
        references.append(sample.base_reference)
    assert float(state.carry.gait.interruptions.number) >= 1
    np.testing.assert_allclose(references, whole.base_reference, rtol=0, atol=1e-9)
