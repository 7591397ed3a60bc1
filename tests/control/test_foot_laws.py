"""Laws that move single feet: walks against NumPy, gradients, and what they do when a sensor or a servo fails."""

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import LoadTransfer, Start, begin
from mjx_climb.control.climb_sdk import ClimbSDK
from mjx_climb.control.internal_force import InternalForce
from tests import oracle, oracle_laws

STEP = 5e-3
FEET = np.array([[0.14, 0.14, 0.0], [-0.14, 0.15, 0.0], [-0.13, -0.14, 0.01], [0.15, -0.14, 0.0]])
WALK = {
    "duration": 0.3, "contact.stiffness": 6e3, "gait.cycle": 0.4, "gait.duty": 0.8, "gait.stride": 0.012,
    "gait.step_height": 0.006, "gait.heading": 0.6, "contact.holding_limit": None,
}  # fmt: skip


class Kind(NamedTuple):
    """A law with gains that make a difference within a short walk, and its twin in NumPy."""

    law: mc.Law
    twin: type[oracle_laws.OfFeet]


KINDS = {
    "LoadTransfer": Kind(
        LoadTransfer(
            normal_damping=60.0, tangential_damping=300.0, leak=2.0, leveling=5.0, unloading=0.05, loading=0.04,
            landing=0.7, pull_limit=0.5,
        ),
        oracle_laws.LoadTransfer,
    ),
    "InternalForce": Kind(InternalForce(damping=30.0, stiffness=500.0), oracle_laws.InternalForce),
    "ClimbSDK": Kind(ClimbSDK(force_gain=4e-4, body_gain=0.15, force_cost=0.02), oracle_laws.ClimbSDK),
}  # fmt: skip
kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
quick = pytest.mark.parametrize(  # the others once a night
    "kind", [pytest.param(k, id=n, marks=[pytest.mark.nightly] * (n != "InternalForce")) for n, k in KINDS.items()]
)


def scene(seed=0):
    """Return a reference and a measurement of a robot that stands on all feet, turned and off its reference."""
    rng = np.random.default_rng(seed)
    attitude, off = Rotation.from_rotvec([0.1, -0.2, 0.7]), Rotation.from_rotvec(rng.uniform(-0.05, 0.05, 3))
    base, still = np.array([0.0, 0.0, 0.11]), np.zeros(3)
    times = np.array([0.03, 0.5, 0.7, 0.6]), np.array([0.5, 0.5, 0.02, 0.5])
    reference = mc.Reference(base, attitude.as_quat(scalar_first=True), FEET, *times)
    turned = (attitude * off).as_quat(scalar_first=True)
    force = rng.normal([0.0, 0.0, 2.0], [0.5, 0.5, 2.0], (4, 3))
    position = base + rng.uniform(-0.01, 0.01, 3)
    wrench = np.concatenate([force.sum(0), np.cross(FEET - position, force).sum(0)])
    measured = mc.Measurement(
        position, turned, still, still, force, wrench, np.ones(4, bool), *np.zeros((3, 4, 3))
    )  # fmt: skip
    # in NumPy up to here: each operation of JAX on its own is compiled
    return jax.tree.map(jnp.asarray, (reference, measured))


def with_arrays(law):
    """Return a law whose gains are arrays: one program for all of its kind."""
    return dataclasses.replace(law, **{name: jnp.asarray(getattr(law, name), float) for name in law.GAINS})


def after(law, state, measured, reference, steps):
    """Return the state after some steps under the same measurement, and how far the feet are then moved, (limb, 3)."""
    return repeated(with_arrays(law), state, measured, reference, steps)


@jax.jit
def repeated(law, state, measured, reference, steps):
    def step(_, now):
        state, command = law.step(now[0], measured, reference)
        return state, command.foot_position - reference.foot_position

    return jax.lax.fori_loop(0, steps, step, (state, jnp.zeros((4, 3))))


def started(law, measured, reference, steps=12):
    """Return what `after` does of a law that begins."""
    return after(law, begin(with_arrays(law), Start(STEP, reference)), measured, reference, steps)


@pytest.mark.slow
@kinds
@pytest.mark.parametrize("control_period", [pytest.param(0.0, marks=pytest.mark.nightly), 0.005])
def test_a_walk_worked_out_again(kind, control_period):
    """Every history to 5e-12, with lift-offs, touchdowns, pulls beyond the limit, and a sensor that dies in a swing."""
    changes = WALK | {"hardware.control_period": control_period, "gait.sequence": ["LH", "LF", "RH", "RF"]}
    changes |= {"hardware.force_sensor.dead": {"LH": 0.02}} if control_period else {}
    scenario = mc.load_scenario("case_1_2", changes)
    walk = mc.rollout(scenario, law=kind.law)
    assert walk.lost_sensors == ({"LH": pytest.approx(0.18, abs=2 * control_period)} if control_period else {})
    offset = np.linalg.norm(walk.foot_target - walk.grip_point, axis=2)[walk.support]
    assert np.ptp(walk.support.sum(1)) and offset.max() > 1e-4
    twin = type("Twin", (kind.twin,), {"gains": {name: float(getattr(kind.law, name)) for name in kind.law.GAINS}})
    oracle.assert_is(walk, twin)


@pytest.mark.parametrize("name", KINDS)
def test_steps_are_those_worked_out_in_numpy(name):
    """Of other forces, feet that open and stand, and bases in each step; in some no force is known.

    Servos of load transfer are at their limit in some steps, in which the offset of such a foot does not grow.
    """
    kind, random, feet = KINDS[name], np.random.default_rng(0), jnp.asarray(FEET)
    own = {each: jnp.asarray(getattr(kind.law, each), float) for each in kind.law.GAINS}
    of_servos = {"torque_limit": 1.0} if name == "LoadTransfer" else {}
    law, limit = dataclasses.replace(kind.law, **own, **of_servos), of_servos.get("torque_limit", np.inf)
    scenario: Any = SimpleNamespace(hardware=SimpleNamespace(control_period=STEP), time_step=STEP)
    twin = kind.twin(scenario, Rotation.from_quat(scene()[0].base_orientation, scalar_first=True), 4)
    twin.gains = {each: float(getattr(kind.law, each)) for each in kind.law.GAINS}
    state, step, held, grown = law.init(Start(STEP, scene()[0])), jax.jit(law.step), 0, 0
    for number in range(24):
        reference, measured = scene(number)
        times = random.uniform(0.0, 0.1, (2, 4))
        known, support = number % 5 != 4, np.arange(4) != (number // 6 if number % 6 < 4 else 4)
        # what is measured where no force is known is none; internal forces get none then
        force = (known or name != "InternalForce") * np.asarray(measured.foot_force) * 6
        torque = random.uniform(-1.1, 1.1, (4, 3))
        measured = measured._replace(
            foot_force=jnp.asarray(force), support=jnp.asarray(support), forces_known=jnp.asarray(known),
            joint_torque=jnp.asarray(torque),
        )  # fmt: skip
        reference = reference._replace(until_lift_off=jnp.asarray(times[0]), since_touchdown=jnp.asarray(times[1]))
        state, command = step(state, measured, reference)
        before, base = twin.offset, (np.asarray(measured.base_position), np.asarray(measured.base_orientation))
        twin.say(np.asarray(reference.base_position), base, force, None, support, known, FEET, times)
        outward = ((twin.offset - before) * before).sum(1) > 0
        stuck = (abs(torque) >= limit).any(1) & support
        twin.offset = np.where((stuck & outward)[:, None], before, twin.offset)
        held, grown = held + (stuck & outward).sum(), grown + (stuck & ~outward).sum()
        moved = np.asarray(command.foot_position - feet)
        np.testing.assert_allclose(moved, twin.reference.apply(twin.offset), rtol=0, atol=1e-9, err_msg=f"{number}")
    assert name != "LoadTransfer" or (held > 5 and grown > 5)


def twice(law, measured, reference):
    """Return how far the feet are moved after two steps, one operation after the other: nothing is compiled."""
    state, _ = law.step(law.init(Start(STEP, reference)), measured, reference)
    return law.step(state, measured, reference)[1].foot_position - reference.foot_position


@pytest.mark.slow
@quick
def test_derivatives_by_every_gain_agree_with_central_differences(kind):
    """The third foot has just lost its grip; the force on the first pulls."""
    reference, measured = scene()
    force, support = measured.foot_force.at[0, 2].set(-6.0), measured.support.at[2].set(False)
    measured = measured._replace(foot_force=force, support=support)
    reference = reference._replace(since_touchdown=reference.since_touchdown.at[1].set(0.02))
    for name, field in kind.law.GAINS.items():

        def shift(value, name=name, field=field):
            gain = value * jnp.ones(3) if field.shape == (3,) else value
            return twice(dataclasses.replace(kind.law, **{name: gain}), measured, reference)

        value = jnp.asarray(float(getattr(kind.law, name)))
        found, h = jax.jvp(shift, (value,), (jnp.ones(()),))[1], 1e-5 * value
        difference = (shift(value + h) - shift(value - h)) / (2 * h)
        np.testing.assert_allclose(found, difference, rtol=1e-5, atol=1e-9, err_msg=name)
        assert np.abs(found).max() > 1e-9, name
        back = jax.grad(lambda value, shift=shift: shift(value).sum())(value)
        np.testing.assert_allclose(back, found.sum(), rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.nightly
@kinds
def test_a_batch_moves_as_each_of_its_robots(kind):
    scenes = [scene(seed) for seed in range(3)]
    reference, measured = jax.tree.map(lambda *each: jnp.stack(each), *scenes)
    together = jax.vmap(lambda r, m: started(kind.law, m, r)[1])(reference, measured)
    for own, one in zip(together, scenes, strict=True):
        np.testing.assert_allclose(own, started(kind.law, one[1], one[0])[1], rtol=0, atol=1e-12)


@quick
def test_without_forces_feet_go_back_to_where_the_gait_wants_them(kind):
    """(Landing would still act.)"""
    reference, measured = scene()
    state, before = started(kind.law, measured, reference, 100)
    assert np.linalg.norm(before, axis=1).min() > 1e-4
    without = measured._replace(foot_force=jnp.zeros((4, 3)), wrench=jnp.zeros(6), forces_known=jnp.asarray(False))
    _, shift = after(kind.law, state, without, reference, 8000)
    assert np.isfinite(shift).all()
    if not isinstance(kind.law, ClimbSDK):  # which has no leak, and goes on to integrate the base's error
        np.testing.assert_allclose(shift, 0, atol=1e-6)


# --- Load transfer alone


def test_loads_leave_a_foot_before_it_lifts_off():
    """Of equal loads; the forces on the feet push each as far as it gives way."""
    reference, measured = scene()
    equal = jnp.tile(jnp.array([0.0, 0.0, 2.0]), (4, 1))
    measured = measured._replace(foot_force=equal, base_position=reference.base_position)
    law = dataclasses.replace(KINDS["LoadTransfer"].law, unloading=1.0, loading=0.02)
    shift = np.array(started(law, measured, reference)[1]) @ np.array([0, 0, 1])
    assert shift[0] > 0 > shift[1]


@pytest.mark.slow
def test_a_limb_at_its_torque_limit_is_not_wound_up():
    """The offset of its foot grows no longer, that of others does; it still may shrink."""
    reference, measured = scene()
    law = dataclasses.replace(KINDS["LoadTransfer"].law, torque_limit=1.0)
    state, start = started(law, measured, reference)
    saturated = measured._replace(joint_torque=jnp.zeros((4, 3)).at[0, 2].set(-1.0))
    _, free = after(law, state, measured, reference, 20)
    _, held = after(law, state, saturated, reference, 20)
    sizes = [np.linalg.norm(shift, axis=1) for shift in (start, held, free)]
    assert sizes[1][0] <= sizes[0][0] + 1e-12 < sizes[2][0] / 2
    assert (sizes[1][1:] > sizes[0][1:]).all()
    _, back = after(law, state, saturated._replace(foot_force=-measured.foot_force), reference, 3)
    assert np.linalg.norm(back[0]) < sizes[0][0]


# --- The others


def test_internal_forces_have_no_net_wrench():
    """At rest `K x = F_int`, which has no net wrench, and is all of forces that have none."""
    reference, measured = scene()
    law = KINDS["InternalForce"].law
    rotation = Rotation.from_quat(np.array(reference.base_orientation), scalar_first=True)
    levers = rotation.inv().apply(FEET - np.array(measured.base_position))
    null = np.eye(12) - oracle_laws.pseudoinverse(levers, np.ones(4)) @ oracle_laws.grasp(levers)
    force = 0.2 * np.random.default_rng(1).normal(size=12)
    for own in (force, null @ force):
        felt = measured._replace(foot_force=jnp.asarray(rotation.apply(own.reshape(4, 3))))
        shift = rotation.inv().apply(np.array(started(law, felt, reference, 4000)[1]))
        np.testing.assert_allclose(law.stiffness * shift.ravel(), null @ own, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_climb_sdk_counts_twenty_times_a_second():
    """In 0.1 s it moves twice; a base that is too low makes it push the feet down, all of them alike."""
    reference, measured = scene()
    level = reference._replace(base_orientation=jnp.array([1.0, 0.0, 0.0, 0.0]))
    low = measured._replace(
        base_orientation=level.base_orientation, base_position=reference.base_position - jnp.array([0.0, 0.0, 1e-3]),
        foot_force=jnp.zeros((4, 3)),
    )  # fmt: skip
    law = KINDS["ClimbSDK"].law
    for steps, updates in ((1, 1), (10, 1), (11, 2), (20, 2), (21, 3)):
        shift = started(law, low, level, steps)[1]
        np.testing.assert_allclose(shift, [[0, 0, -updates * 0.15e-3]] * 4, atol=1e-12)


ROBOTS = {
    "hexapod_ceiling": {"gait.duty": 0.7, "gait.cycle": 1.0, "gait.stride": 0.01},
    "station_arms_handrail": {"gravity": [0.5, 0.0, -1.5]},
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["hexapod_ceiling", pytest.param("station_arms_handrail", marks=pytest.mark.nightly)])
def test_other_robots_walk_under_load_transfer(name):
    """Six limbs on a ceiling, limbs of seven joints on a slope, for a second: no grip is lost, feet are moved."""
    scenario = mc.load_scenario(name, {"duration": 1.0, **ROBOTS[name]})
    walk = mc.rollout(scenario, law=LoadTransfer())
    offset = np.linalg.norm(walk.foot_target - walk.grip_point, axis=2)[walk.support]
    assert np.isfinite(walk.foot_force).all() and not walk.torn_off.any() and not walk.missed.any()
    assert 1e-4 < offset.max() <= 0.02 + 1e-9
