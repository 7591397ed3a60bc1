"""The gait step by step against integers, and steps that are counted alike in both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import PD, law_of
from mjx_climb.execution.batch_axes import over_batch, own_axes
from mjx_climb.gait import schedule as gait
from mjx_climb.gait.base_path import check_base, sway_of, swayed
from mjx_climb.gait.periodic import Periodic
from mjx_climb.gait.swing import COUNT, added_shapes
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import resolve, resolve_in
from mjx_climb.parameter_types import whole_steps
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot
from mjx_climb.walk import step
from mjx_climb.walk.structure import structure

STEP = 1e-3
LIMBS = load_robot("hubrobo_v3_2").limbs
PUSH = {"start": 0.1, "stop": 0.2, "force": [1.0, 0.0, 0.0], "moment": [0.0, 0.0, 0.0]}


def plan_of(scenario, parameters):
    robot = load_robot(scenario.robot)
    return gait.plan(robot, jnp.zeros((4, 3)), parameters, tuple(scenario.gait.lift_off.items()), STEP)


def of_batch(function, parameters, count):
    """A function of one robot's parameters, under vmap."""
    return jax.jit(lambda many: over_batch(function, [many], [own_axes(many)], (count,)))(parameters)


def counted(scenario, changes, dtype, count):
    """Cycle, swing and lift-offs in steps of parameters with changes, as a walk in a precision has them."""
    changed = own_parameters(scenario).replace({f"gait.{name}": value for name, value in changes.items()})
    parameters = resolve_in(scenario, law_of(scenario), None, changed, dtype).parameters
    plan = of_batch(lambda one: plan_of(scenario, one), parameters, count)
    assert plan.cycle_steps.dtype == dtype
    return np.vstack([plan.cycle_steps, plan.swing_steps, plan.swing_offset.T])


def test_cycles_have_the_same_steps_in_both_precisions():
    """Of whole milliseconds against integers, half a step being one; of others against each other.

    Swings are cut to whole steps: a limb that lifts off next does not before.
    """
    scenario, number = mc.load_scenario("case_1_2"), np.arange(1000, 6000)
    quarters = [round(scenario.gait.lift_off[limb] * 4) for limb in LIMBS]
    whole = np.array([number, number // 4, *((k * number + 2) // 4 for k in quarters)])
    lift_offs = np.sort([*whole[2:], number], axis=0)
    assert (lift_offs[:-1] + whole[1] <= lift_offs[1:]).all()
    any_duty = {"cycle": np.random.default_rng(0).uniform(1, 6, 5000), "duty": np.float64(0.7003)}
    for dtype in (np.float32, np.float64):
        np.testing.assert_array_equal(counted(scenario, {"cycle": number * STEP}, dtype, 5000), whole)
        single = np.float32(number * STEP)  # what a caller without double precision has
        np.testing.assert_array_equal(counted(scenario, {"cycle": single}, dtype, 5000), whole)
    np.testing.assert_array_equal(*(counted(scenario, any_duty, dtype, 5000) for dtype in (np.float32, np.float64)))


@pytest.mark.parametrize("traced", [False, True])
def test_windows_and_periods_have_the_same_steps_in_both_precisions(traced):
    """From JAX's transformations too, where nothing is known in double precision; and the gait's."""
    scenario = mc.load_scenario("case_1_2", {"disturbance.pushes": [PUSH]})
    half_steps = np.arange(1, 10001, 7)
    times = half_steps * STEP / 2
    windows = [f"disturbance.{name}.{end}" for name in ("cargo", "pushes.0") for end in ("start", "stop")]
    spans = ("gait.cycle", "hardware.control_period", *windows)
    parameters = own_parameters(scenario).replace(dict.fromkeys(spans, times))
    stages = stages_of(own_parameters(scenario), scenario.time_step)._replace(control_period=True)

    def resolved(parameters):
        return resolve(scenario, law_of(scenario), None, parameters, parameters.gravity.dtype, compiled=True).parameters

    def steps_of_one(one):
        period = hardware_of(one, stages, STEP).pace.period
        starts = [whole_steps(one.at(path), STEP) for path in windows]
        return [*starts, period, plan_of(scenario, one).cycle_steps]

    @jax.jit
    def steps(parameters):
        return of_batch(steps_of_one, resolved(parameters) if traced else parameters, times.size)

    for dtype in (np.float32, np.float64):
        own = jax.tree.map(lambda value: np.asarray(value, dtype), parameters)  # noqa: B023
        for found in steps(own if traced else resolved(own)):
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, (half_steps + 1) // 2)


def test_delays_of_whole_steps_read_the_same_samples_in_both_precisions():
    """Towards longer delays: their derivative moves weight from the sample to the next older one."""
    scenario, number = mc.Scenario(), np.arange(1, 200)
    for dtype in (np.float32, np.float64):
        own = own_parameters(scenario).replace({"hardware.command_delay": dtype(number * STEP)})
        stages = stages_of(own, scenario.time_step)

        def weights(delay, own=own, stages=stages):
            return jnp.stack(hardware_of(own.replace({"hardware.command_delay": delay}), stages, STEP).pace.command)

        found, rate = jax.jvp(weights, (own.bus.command_delay,), (jnp.ones(len(number), dtype),))
        np.testing.assert_allclose(found, np.arange(len(found))[:, None] == number, atol=5e-5)
        np.testing.assert_array_equal(np.argmin(rate, axis=0), number)
        np.testing.assert_array_equal(np.argmax(rate, axis=0), number + 1)


@pytest.mark.parametrize("duty", [0.75, 0.8])
def test_a_limb_knows_when_it_lifts_off_and_when_it_touched_down(duty):
    """Over two cycles, counted in when its gripper opens and shuts; a swinging limb has neither time.

    In the cycle before the walk nothing swings: a limb that has not swung yet has stood for a cycle longer.
    """
    scenario = mc.load_scenario("case_1_2", {"gait.cycle": 0.5, "gait.duty": duty})
    plan, cycle, limbs = plan_of(scenario, own_parameters(scenario)), 500, len(LIMBS)
    opens = np.array([round(scenario.gait.lift_off[limb] * cycle) for limb in LIMBS])
    shuts = opens + cycle - round(duty * cycle)
    step = np.arange(2 * cycle)
    expected = np.zeros((2, len(step), limbs))
    for limb, (first, last) in enumerate(zip(opens, shuts, strict=True)):
        shut = np.ones(5 * cycle, bool)  # beginning two cycles before the walk
        for begin in np.array([0, 2, 3, 4]) * cycle:
            shut[begin + first : begin + last] = False
        for n in step:
            after, before = shut[n + 2 * cycle :], shut[: n + 2 * cycle + 1][::-1]
            expected[:, n, limb] = np.argmin(after), max(np.argmin(before) - 1, 0)

    def reference_of(n):
        start, feet = plan.base_start, gait.first_footholds(plan)
        return gait.reference(plan, gait.schedule(plan, n), start, feet, STEP)

    found = jax.jit(jax.vmap(reference_of, axis_size=len(step)))(jnp.asarray(step))
    for own, times in zip((found.until_lift_off, found.since_touchdown), expected * STEP, strict=True):
        np.testing.assert_allclose(own, times, atol=1e-9)
    assert expected.max(1).min() > 0.5 * cycle


@pytest.mark.parametrize("settling", [0.0, 0.25])
def test_the_base_sways_towards_the_feet_that_stand_and_feet_land_with_a_speed(settling):
    """By differences of the reference: at rest in the middle of a swing, where it is over 0.4 of the way to the others.

    The way is taken at the first cycle; a cycle later the sway is the same.
    """
    changes = {"gait.cycle": 1.0, "gait.duty": 0.8, "gait.sway": 0.4, "gait.landing_speed": 0.1, "gait.heading": 0.5}
    changes |= {"gait.step_height": 0.002, "gait.settling": settling}
    scenario, lands = mc.load_scenario("case_1_2", changes), round(200 * (1 - settling))
    own, robot = own_parameters(scenario), load_robot(scenario.robot)
    feet = np.array([[0.2, 0.1, 0.0], [-0.1, 0.2, 0.0], [-0.2, -0.1, 0.0], [0.1, -0.1, 0.0]])
    with jax.enable_x64(True):
        made = gait.plan(
            robot,
            jnp.asarray(feet),
            own,
            tuple(scenario.gait.lift_off.items()),
            STEP,
            stages_of(own, scenario.time_step),
        )

        def at(n):
            now = gait.schedule(made, n)
            start, standing = gait.planned_start(made, now.cycle), gait.first_footholds(made)
            plain = gait.base_reference(made._replace(sway=None), now, start)
            return gait.base_reference(made, now, start) - plain, gait.foot_targets(made, now, standing), now.closed

        sway, targets, closed = jax.jit(jax.vmap(at))(jnp.arange(2000))
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    for limb, name in enumerate(LIMBS):
        begin = round(scenario.gait.lift_off[name] * 1000)
        others = np.delete(feet, limb, 0).mean(0)[:2]
        np.testing.assert_allclose(sway[begin + 100, :2], 0.4 * (others - robot.stance_position[:2]) @ turn, atol=1e-12)
        np.testing.assert_allclose(sway[begin + 101], sway[begin + 99], atol=1e-5)
        assert not closed[begin + 199, limb] and closed[begin + 200, limb]
        height = targets[begin + lands - 3 : begin + lands, limb, 2]
        np.testing.assert_allclose(height[2] / STEP, 0.1, rtol=0.05)  # the step that would end at the ground
        np.testing.assert_allclose((3 * height[2] - 4 * height[1] + height[0]) / (2 * STEP), -0.1, rtol=0.05)
    np.testing.assert_allclose(sway[1000:], sway[:1000], atol=1e-12)
    assert not sway[:, 2].any() and np.abs(np.diff(sway, axis=0)).max() < 2e-3


def test_a_cycle_that_begins_where_a_swaying_base_is_goes_on_from_there():
    """Its sway is no part of the way: else the base would move on by it with every cycle."""
    feet = np.array([[0.2, 0.1, 0.0], [-0.1, 0.2, 0.0], [-0.2, -0.1, 0.0], [0.1, -0.1, 0.0]])
    case, lift_off = mc.load_scenario("case_1_2"), [0.25, 0.0, 0.5, 0.75]
    with jax.enable_x64(True):
        made = plan_of(case, own_parameters(case))._replace(sway=sway_of(jnp.asarray(feet), lift_off, 0.75, 0.3))
        whole = Periodic(made, STEP, from_actual=True)
        now, way = whole.schedule(None, made.cycle_steps), np.array([0.3, 0.01, 0.1])
        start = whole.cycle_start(0 * way, now, way + swayed(made.sway, 0.0))
    np.testing.assert_allclose(start, [way, way], atol=1e-9)


@pytest.mark.parametrize(
    "duty, lift_off", [(0.5, [0.25, 0.0, 0.5, 0.75]), (0.4, [0.1, 0.0, 0.5, 0.6]), (0.7, [0.0, 0.5, 0.0, 0.5])]
)
def test_the_base_sways_towards_the_feet_that_stand_in_the_middle_of_a_swing(duty, lift_off):
    """Swings that overlap: limbs count that are on the ground then, one that lifts off at that moment does not."""
    feet, swing = np.random.default_rng(0).normal(0, 0.2, (4, 3)), 1 - duty
    sway = sway_of(feet, lift_off, duty, 0.3)
    for time, point in zip(np.unique(lift_off), sway.points, strict=True):
        since = (time + swing / 2 - np.array(lift_off)) % 1
        stands = (since >= swing - 1e-9) & (since < 1 - 1e-9)
        assert 0 < stands.sum() < 4
        np.testing.assert_allclose(point, 0.3 * feet[stands].mean(0) * [1, 1, 0], atol=1e-12)
        np.testing.assert_allclose(swayed(sway, time + swing / 2), point, atol=1e-12)


# the base is ahead at the start, on its way from where the one hind limb has swung to where the other one will
SWAYED = {"duty": 0.8, "sway": 0.4, "phases": {"LH": 0.1, "LF": 0.3, "RF": 0.5, "RH": 0.7}}


@pytest.mark.parametrize("change", [{"gait": SWAYED}, {"gait.height": 0.9}], ids=["swayed", "low"])
def test_a_walk_begins_with_its_feet_on_their_footholds(change):
    """Also where the base is not where it is in the rest stance, so that the joints are others."""
    scenario = mc.Scenario().with_overrides(change)
    own = own_parameters(scenario)
    with jax.enable_x64(True):
        start = jax.jit(lambda: step.begin(step.prepare(structure(scenario, "limb", own, law=PD()), PD(), own)))()
        state, robot = start.state, load_robot(scenario.robot)
        frames = limb_frames(robot, quaternion_to_matrix(state.base_orientation), state.joint_angles)
        feet = np.asarray(state.base_position + frames.foot)
    assert np.abs(state.joint_angles - robot.stance_joints).max() > 0.01
    np.testing.assert_allclose(feet, start.contact.grip_point, atol=1e-6)


@pytest.mark.nightly
def test_a_batch_walks_the_gait_of_one_robot():
    """And no two limbs swing in one step: a swing of 256 steps of 1022 would begin before the last one ends."""
    scenario = mc.load_scenario("case_1_2", {"gait.cycle": 1.022, "duration": 0.8})
    alone, batch = mc.rollout(scenario), mc.rollout_metrics(scenario)
    assert (~alone.support[:, LIMBS.index("LH")]).sum() == 255
    assert alone.support.sum(1).min() == 3
    np.testing.assert_allclose(batch["min_gia_margin"], mc.metrics(alone)["min_gia_margin"], rtol=1e-3, atol=1e-3)


def test_references_over_uneven_ground_are_those_of_loops():
    """Of a turned walk with settling, landings with a speed and shapes added to swings, over three cycles."""
    random, limbs, cycle, swing = np.random.default_rng(0), 4, 40, 10
    offset, heights = np.array([10, 0, 20, 30]), random.normal(0, 0.01, (limbs, 3))
    footholds, advance, start = random.normal(0, 0.2, (limbs, 3)), np.array([0.03, 0.01, 0.0]), np.array([0, 0, 0.1])
    path, rise, settling, landing = random.normal(0, 0.01, (limbs, 3, COUNT)), 0.02, 0.25, 0.006
    plan = gait.Plan(
        *map(jnp.asarray, (start, [1.0, 0, 0, 0], footholds, advance, heights, rise, path, settling)),
        jnp.asarray(float(cycle)), jnp.asarray(float(swing)), jnp.asarray(offset, float), None, jnp.asarray(landing),
    )  # fmt: skip
    grip = random.normal(0, 0.2, (limbs, 3))

    def height(limb, number):
        return heights[limb, min(number, 2)]

    def smooth(share):
        return share * share * (3 - 2 * share)

    @jax.jit
    def found(number):
        now = gait.schedule(plan, number)
        begun = gait.planned_start(plan, now.cycle)
        return now, gait.first_footholds(plan), gait.reference(plan, now, begun, jnp.asarray(grip), 0.5), begun

    for number in (0, 4, 5, 7, 9, 12, 15, 23, 39, 40, 46, 61, 75, 117):
        now, first, made, begun = found(jnp.asarray(number))
        count, into = divmod(number, cycle)
        np.testing.assert_allclose(first, [[x, y, z + height(n, 0)] for n, (x, y, z) in enumerate(footholds)])
        levels = [np.mean([height(limb, each) for limb in range(limbs)]) for each in (count, count + 1)]
        np.testing.assert_allclose(begun, start + count * advance + [0, 0, levels[0]], atol=1e-12)
        base = begun + smooth(into / cycle) * (advance + np.array([0, 0, levels[1] - levels[0]]))
        np.testing.assert_allclose(made.base_position, base, atol=1e-12)
        for limb in range(limbs):
            since = (into - offset[limb]) % cycle
            assert now.foothold[limb] == count + (into - offset[limb] >= swing / 2)
            assert now.closed[limb] == (since >= swing)
            if since >= swing:
                np.testing.assert_array_equal(made.foot_position[limb], grip[limb])
                assert made.until_lift_off[limb] == 0.5 * (cycle - since)
                stood = since - swing + (cycle if number < offset[limb] else 0)
                assert made.since_touchdown[limb] == 0.5 * stood
                continue
            phase = min(since / swing / (1 - settling), 1.0)
            old, new = height(limb, count), height(limb, count + 1)
            end, late = (old if phase < 0.5 else new), max(2 * phase - 1, 0.0)
            level, upright = added_shapes(np.array(phase))
            place = footholds[limb] + (count + smooth(phase)) * advance + path[limb] @ level * [1, 1, 0]
            place = place + path[limb] @ upright * [0, 0, 1]
            place[2] += end + (max(old, new) + rise - end) * smooth(1 - abs(2 * phase - 1))
            place[2] += landing * late**2 * (1 - late) / 2
            np.testing.assert_allclose(made.foot_position[limb], place, atol=1e-12, err_msg=f"{number} {limb}")
            assert made.until_lift_off[limb] == made.since_touchdown[limb] == 0


def test_a_plan_is_its_settings_turned_to_the_heading():
    """Feet, way, shapes of swings and sway; a base of another height than its rest stance; a landing with a speed."""
    own = {
        "cycle": 0.8, "duty": 0.8, "stride": 0.05, "heading": 0.4, "height": 1.25, "sway": 0.3, "landing_speed": 0.06,
        "settling": 0.2, "step_height": 0.03,
    }  # fmt: skip
    lift_off = {"LF": 0.5, "LH": 0.0, "RH": 0.25, "RF": 0.1}
    scenario = mc.Scenario().with_overrides({"gait": own})
    robot, random = load_robot(scenario.robot), np.random.default_rng(3)
    path, feet = random.normal(size=(3, COUNT)), np.asarray(robot.stance_position) + random.normal(size=(4, 3))
    parameters = own_parameters(scenario).replace({"gait.swing_path": path})
    stages = stages_of(parameters, STEP)
    lifts = [lift_off[limb] for limb in robot.limbs]
    away = feet - np.asarray(robot.stance_position)

    @jax.jit
    def planned(parameters, along):
        given = robot, jnp.asarray(feet), parameters, tuple(lift_off.items()), STEP
        turn = quaternion_to_matrix(jnp.asarray(robot.stance_orientation))
        return gait.plan(*given, stages), gait.plan(*given), sway_of(along, lifts, 0.8, 0.3), turn

    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1.0]])
    found, plain, sway, rest = planned(parameters, away @ turn.T)
    expected = {
        "base_start": turn @ (np.asarray(robot.stance_position) * [1, 1, 1.25]), "footholds": feet @ turn.T,
        "advance": 0.05 * turn[:, 0], "step_height": 0.03, "swing_path": 0.03 * turn @ path, "settling": 0.2,
        "cycle_steps": 800, "swing_steps": 160, "swing_offset": np.array(lifts) * 800,
        "landing": 0.06 * 0.8 * 0.160,
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(found, name), value, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(Rotation.from_quat(found.base_orientation, scalar_first=True).as_matrix(), turn @ rest)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), found.sway, sway)
    np.testing.assert_allclose(plain.base_start, turn @ np.asarray(robot.stance_position), atol=1e-12)
    assert plain.sway is plain.landing is None


def test_a_base_that_no_foot_could_follow_is_refused_with_how_far_it_could_go():
    def checked(height):
        check_base(mc.Scenario().with_overrides({"gait.height": height}))

    checked(1.02)
    with pytest.raises(mc.ConfigError, match=r"gait\.height: expected at most .*, got 3$") as refused:
        checked(3.0)
    limit = float(str(refused.value).split("at most ")[1].split(",")[0])
    checked(0.99 * limit)
    with pytest.raises(mc.ConfigError):
        checked(1.01 * limit)
