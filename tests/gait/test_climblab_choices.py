"""By ClimbLab's options the planner chooses what ClimbLab's own functions choose: limb and hold in 225 states."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.footholds.climblab import ClimbLab
from mjx_climb.gait.footholds.footholds import Prospects, Situation
from mjx_climb.gait.footholds.reach import height_table, outward, ranges, within_ranges
from mjx_climb.gait.free_order import FreeOrder
from mjx_climb.ground import Holds
from mjx_climb.physics.inverse_kinematics import limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.scenario.messages import ConfigError
from tests.gait.test_planner_decisions import LEVEL, PERIOD, PLAN, ROBOT, STEP, body_of

STATES = dict(np.load(Path(__file__).parents[1] / "reference" / "climblab_nonperiodic.npz"))
COUNT, BASE = STATES["count"], np.array([0.0, 0.0, 0.11])
NONE = -1
# ClimbLab has the base upright over the crossing of the diagonals


def padded(values):
    """Return values of each state's holds, (state, most, ...), those that a state lacks 0."""
    found = np.zeros((len(COUNT), COUNT.max(), *values.shape[1:]))
    for row, own in zip(found, np.split(values, np.cumsum(COUNT)[:-1]), strict=True):
        row[: len(own)] = own
    return found


POINTS, VALID = padded(STATES["points_um"] * 1e-6), padded(np.ones(COUNT.sum()))
REACH = padded(np.unpackbits(STATES["reach"], axis=1, count=int(COUNT.sum())).T).astype(bool)
FEET = np.take_along_axis(POINTS, STATES["feet"][..., None], 1)


def planned(rule):
    """Return what a planner decides in each state: limb and hold, each limb's hold, base's place, and the reach."""
    geometry = limb_geometry(ROBOT)
    table = height_table(ROBOT, geometry) if rule.reach_by_height else None
    plan = PLAN._replace(base_start=jnp.asarray(BASE))

    @jax.jit
    @jax.vmap
    def decide(points, valid, feet):
        up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
        holds = Holds(points, up, jnp.zeros((len(points), 0, 3)), jnp.zeros((len(points), 0)), valid)
        gait = FreeOrder(plan, STEP, False, ROBOT, geometry, holds, PERIOD, rule, 4, (), table)
        memory, _ = gait.init()
        memory = memory._replace(goal=feet, base_goal=jnp.asarray(BASE))
        body = body_of(base_position=BASE, base_rotation=LEVEL)._replace(feet=feet, grip_point=feet)
        now = gait.schedule(memory, jnp.asarray(0))
        found = gait.lift_off(memory, now, jnp.asarray(BASE), body)
        ways = jnp.zeros(3), plan.advance
        forward, zero = jnp.array([1.0, 0, 0]), jnp.zeros(3)
        situation = Situation(feet, feet, forward, jnp.ones(4, bool), zero, zero, jnp.asarray(0.0), 0 * feet)
        each, _ = gait.choose(situation, body, ways, memory.held)
        reached = jax.vmap(lambda point: gait.reached(body, ways)(jnp.broadcast_to(point, (4, 3))))(points)
        return found.begun > memory.begun, found.goal, each, found.base_goal, reached

    lifts, goal, each, base, reached = map(np.asarray, decide(POINTS, VALID, FEET))
    limb = np.where(lifts.any(1), lifts.argmax(1), NONE)
    number = [[numbered(n, place) for place in row] for n, row in enumerate(each)]
    hold = [numbered(n, goal[n, k]) if k != NONE else NONE for n, k in enumerate(limb)]
    return limb, np.array(hold), np.array(number), base, reached


def numbered(state, place):
    """Return which hold of a state is at a place, NONE for that of the limb itself."""
    same = (POINTS[state] == place).all(1) & (VALID[state] > 0)
    return int(same.argmax()) if same.any() else NONE


@pytest.mark.slow
def test_with_climblabs_options_all_choices_are_climblabs():
    limb, hold, of_limb, base, reached = planned(ClimbLab())
    np.testing.assert_array_equal(limb, STATES["limb"])
    np.testing.assert_array_equal(hold, STATES["hold"])
    own = np.arange(4) * 0 + STATES["feet"]
    # where ClimbLab ends, a limb stays on its hold
    np.testing.assert_array_equal(of_limb, np.where(STATES["of_limb"] == NONE, own, STATES["of_limb"]))
    np.testing.assert_array_equal(reached[VALID > 0], REACH[VALID > 0])
    moves = limb != NONE
    np.testing.assert_allclose(base[moves, :2], STATES["base_next"][moves, :2], rtol=0, atol=2e-6)


def test_limbs_may_swing_to_the_holds_that_climblabs_may():
    """By the table of reach, apart from all feet, and where the base can follow: the largest step is chosen."""
    rule, geometry = ClimbLab(), limb_geometry(ROBOT)
    own = PLAN._replace(base_start=jnp.asarray(BASE)), STEP, False, ROBOT, geometry, None, PERIOD, rule, 4, ()
    gait, body = FreeOrder(*own, height_table(ROBOT, geometry)), body_of(base_position=BASE, base_rotation=LEVEL)
    ways, forward = (jnp.zeros(3), PLAN.advance), np.array([1.0, 0, 0])
    some = np.arange(0, len(COUNT), 5)

    @jax.jit
    @jax.vmap
    def asked(points, feet):
        situation = Situation(feet, feet, jnp.asarray(forward), None, None, None, None, None)
        place = jnp.broadcast_to(points[:, None], (len(points), *feet.shape))
        return [jax.vmap(may(body, ways))(place) for may in (gait.reached, functools.partial(gait.allowed, situation))]

    reached, allowed = map(np.asarray, asked(POINTS[some], FEET[some]))
    valid = VALID[some] > 0
    np.testing.assert_array_equal(reached[valid], REACH[some][valid])
    step = POINTS[some][:, :, None] - FEET[some][:, None]
    short = (step[..., :2] ** 2).sum(-1) <= 0.1**2
    worth = np.where(allowed & valid[..., None] & short, step @ forward, -np.inf)
    found = np.where(np.isfinite(worth.max(1)), worth.argmax(1), STATES["feet"][some])
    of_limb = STATES["of_limb"][some]
    np.testing.assert_array_equal(found, np.where(of_limb == NONE, STATES["feet"][some], of_limb))
    assert (allowed & valid[..., None]).sum() < (reached & valid[..., None]).sum() / 1.5


def test_the_limb_with_most_holds_ahead_is_next_but_for_those_in_vain():
    found = ClimbLab().limb_worth(Prospects(jnp.zeros(4), jnp.array([3.0, 5, 5, 0]), jnp.array([0.0, 4, 1, 0])))
    np.testing.assert_array_equal(found, [3, 1, 4, 0])


def crossed(way_points):
    """Return how far the base comes in 40 decisions on 8 grids of 6 cm, each of which is carried out as planned, m."""
    x, y = np.meshgrid(np.arange(-0.4, 1.1, 0.06), np.arange(-0.4, 0.4, 0.06), indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    geometry, plan = limb_geometry(ROBOT), PLAN._replace(base_start=jnp.asarray(BASE))
    table, up = height_table(ROBOT, geometry), np.broadcast_to([0.0, 0.0, 1.0], grid.shape)
    none = np.zeros((len(grid), 0, 3)), np.zeros((len(grid), 0))

    @jax.jit
    @jax.vmap
    def walk(begin):
        holds = Holds(*map(jnp.asarray, (grid + begin, up, *none, np.ones(len(grid)))))
        gait = FreeOrder(plan, STEP, False, ROBOT, geometry, holds, PERIOD, ClimbLab(), 4, way_points, table)
        memory, _ = gait.init()

        def decision(carry, _):
            feet, base = carry
            before = memory._replace(goal=feet, base_goal=base)
            body = body_of(base_position=base, base_rotation=LEVEL)._replace(feet=feet, grip_point=feet)
            found = gait.lift_off(before, gait.schedule(before, jnp.asarray(0)), base, body)
            return (found.goal, found.base_goal), None

        (_, base), _ = jax.lax.scan(decision, (memory.goal, jnp.asarray(BASE)), None, length=40)
        return base[0]

    return np.asarray(walk(0.06 * np.random.default_rng(0).random((8, 3)) * [1, 1, 0]))


@pytest.mark.nightly
def test_towards_a_goal_it_crosses_grids():
    """ClimbLab's planner heads for a goal; with a heading a limb may go to and fro between holds beside each other."""
    assert (crossed(((5.0, 0.0),)) > 0.5).all() and (crossed(()) < 0.5).any()


OPTIONS = {"reach_a_stride_on": False, "reach_by_height": True, "base_must_follow": True}


@pytest.mark.slow
@pytest.mark.parametrize("name", OPTIONS)
def test_each_option_decides_some_choices(name):
    """Without one of ClimbLab's options some choices are others."""
    limb, hold, _, _, reached = planned(dataclasses.replace(ClimbLab(), **{name: not OPTIONS[name]}))
    assert 0.5 < ((limb == STATES["limb"]) & (hold == STATES["hold"])).mean() < 1
    same = (reached[VALID > 0] == REACH[VALID > 0]).mean()
    assert (same == 1) == (name == "base_must_follow") and same > 0.9


@pytest.mark.parametrize("femur_lower", [None, -2.2])
def test_the_table_of_reach_has_climblabs_rows(femur_lower):
    """At a height the row counts that is nearest, of rows every half degree with the other joint at an end.

    Also where one limb's femur goes so far that its lowest row is of another joint than the others' lowest.
    """
    robot, lower = ROBOT, np.array(ROBOT.joint_lower)
    if femur_lower is not None:
        lower[1, 1] = femur_lower
        robot = dataclasses.replace(ROBOT, joint_lower=lower)
    table, height = height_table(robot, limb_geometry(robot)), np.linspace(-0.25, 0.3, 500)
    each = jax.jit(jax.vmap(lambda z: [outward(arcs, jnp.full(4, z)) for arcs in (table.near, table.far)]))(height)
    for limb in (0, 1):
        low, high = np.degrees(robot.joint_lower[limb]), np.degrees(robot.joint_upper[limb])
        femur, tibia = (np.arange(low[n], high[n] + 0.25, 0.5) for n in (1, 2))

        def rows(femur, tibia, limb=limb):
            """Distance from the first joint in the limb's plane, and height, by forward kinematics."""
            joints = np.zeros((max(np.size(femur), np.size(tibia)), 4, 3))
            joints[..., 1], joints[..., 2] = np.radians(femur)[..., None], np.radians(tibia)[..., None]
            foot = np.asarray(limb_frames(robot, None, joints).foot)[:, limb] - robot.frame_position[limb, 0]
            return np.column_stack([foot[:, :2] @ (np.sqrt([0.5, 0.5]) * [(1, 1), (-1, 1)][limb]), foot[:, 2]])

        far = np.vstack([rows(low[1:2], tibia), rows(femur, high[2:])])
        lowest = far[:, 1].argmin()
        near = np.vstack([far[: lowest + 1], rows(femur, low[2:]), rows(high[1:2], tibia)])
        for found, (out, up) in zip(each, (near.T, far[lowest:].T), strict=True):
            np.testing.assert_allclose(found[:, limb], out[abs(up - height[:, None]).argmin(1)], rtol=0, atol=1e-9)


def test_a_limb_reaches_no_nearer_and_no_farther_than_its_rows_and_turns_within_its_yaw_limits():
    """Places around the first joint, at a height where the nearest row is farther out than the axis."""
    table = height_table(ROBOT, limb_geometry(ROBOT))
    hip, axes = np.asarray(table.hip_position), np.asarray(table.hip_rotation)

    def at(out, turn, height=0.1):
        way = np.stack([out * np.cos(turn), out * np.sin(turn), np.full(4, height)], -1)
        return jnp.asarray(hip + np.einsum("lij,lj->li", axes, way))

    middle = (table.lower + table.upper) / 2
    limits = jax.jit(lambda point: ranges(table, point))(at(0.1 * np.ones(4), middle))
    near, far = map(np.asarray, limits)
    assert (near > 0.02).all() and (far > near + 0.02).all()
    inside, (lower, upper) = (near + far) / 2, (np.asarray(table.lower), np.asarray(table.upper))
    for out, turn, may in (
        (near - 1e-4, middle, False), (near + 1e-4, middle, True), (far - 1e-4, middle, True),
        (far + 1e-4, middle, False), (inside, lower + 1e-4, True), (inside, lower - 1e-4, False),
        (inside, upper - 1e-4, True), (inside, upper + 1e-4, False),
    ):  # fmt: skip
        np.testing.assert_array_equal(within_ranges(table, limits, at(out, turn)), may, err_msg=f"{out} {turn}")


def test_limbs_without_a_table_are_refused():
    arms = mc.load_scenario("configs/station_arms_handrail.yaml")
    keys = {"robot": arms.robot, "gait.sequence": arms.gait.sequence, "gait.footholds": "climblab"}
    scenario = mc.load_scenario("configs/climb_rock.yaml").with_overrides(keys)
    with pytest.raises(ConfigError, match=r"footholds.reach_by_height: expected false for limbs other than"):
        mc.Simulation(scenario).metrics()
