"""A robot on a stand: against MuJoCo's C code with the base welded, and finite differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware.servo import RELAXATION
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.inputs.from_scenario import parameters
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.stand_in_mujoco import TRUTH, recorded, sines, welded
from tuning.identification.model import held_base as stands
from tuning.identification.model.held_dynamics import held_accelerations

ROBOT = load_robot("hubrobo_v3_2")


def state_at(angles, rates):
    still = jnp.zeros(3)
    return State(jnp.asarray(ROBOT.stance_position), jnp.array([1.0, 0, 0, 0]), still, still, angles, rates)


@pytest.mark.slow
def test_accelerations_are_those_of_mujoco_with_the_base_welded():
    rng = np.random.default_rng(0)
    model = welded("hubrobo_v3_2", dataclasses.replace(TRUTH, gravity=(1.0, -2.0, -9.0)))
    model.dof_damping[:], model.dof_frictionloss[:], model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0, 0, 0
    data = mujoco.MjData(model)
    robot = dataclasses.replace(ROBOT, armature=np.full((4, 3), TRUTH.armature))
    for _ in range(5):
        data.qpos[:], data.qvel[:] = ROBOT.stance_joints.ravel() + rng.normal(0, 0.4, 12), rng.normal(0, 3, 12)
        torque = rng.normal(0, 1, 12)
        data.qfrc_applied[:] = torque
        mujoco.mj_forward(model, data)
        state = state_at(*(jnp.asarray(v.reshape(4, 3)) for v in (data.qpos, data.qvel)))
        ours = held_accelerations(robot, state, jnp.asarray(torque.reshape(4, 3)), jnp.array([1.0, -2.0, -9.0]))
        np.testing.assert_allclose(ours.ravel(), data.qacc, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_tangents_are_finite_differences():
    rng = np.random.default_rng(1)
    point = [jnp.asarray(rng.normal(0, s, (4, 3))) for s in (0.5, 2.0, 1.0)] + [jnp.asarray(ROBOT.link_mass)]

    def solved(angles, rates, torque, mass):
        robot = dataclasses.replace(ROBOT, link_mass=mass)
        return held_accelerations(robot, state_at(angles, rates), torque, jnp.array([0.0, 0, -9.81]))

    along = [jnp.asarray(rng.normal(0, 0.1, (4, 3))) for _ in point]
    _, tangent = jax.jvp(solved, tuple(point), tuple(along))
    ends = [solved(*(p + s * 1e-6 * a for p, a in zip(point, along, strict=True))) for s in (1, -1)]
    np.testing.assert_allclose(tangent, (ends[0] - ends[1]) / 2e-6, rtol=2e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, pytest.param(0.05, marks=pytest.mark.nightly)])
def test_a_step_of_a_millisecond_is_right_to_second_order(friction):
    """Against MuJoCo at 0.05 ms; dry friction is a bristle here and a constraint there."""
    truth = dataclasses.replace(TRUTH, friction=friction)
    time, targets = sines(1.0, 0.001)
    log = recorded(truth, time, targets, step=5e-5)
    hardware = {"armature": truth.armature, "viscous_friction": truth.damping, "coulomb_friction": friction}
    scenario = mc.load_scenario("configs/case_1_1.yaml", {
        "control.kp": truth.kp, "control.kd": truth.kd, **{f"hardware.servo.{k}": v for k, v in hardware.items()}
    })  # fmt: skip
    own = parameters(scenario)
    stand = stands.Stand(ROBOT, hardware_of(own, stages_of(own, scenario.time_step, ROBOT), 0.001, ROBOT))
    start = stands.begin(stand, jnp.asarray(targets[0].reshape(4, 3)), jnp.zeros((4, 3)))
    held = np.stack([stands.targets_of(time, command, time, 0.001)[0] for command in targets.T], axis=1)
    _, ours = jax.lax.scan(functools.partial(stands.advance, stand), start, jnp.asarray(held.reshape(-1, 4, 3)))
    moved = np.abs(log["position"] - log["position"][0]).max()
    error = [np.abs(np.reshape(getattr(ours, n), (-1, 12)) - log[n]).max() for n in ("position", "velocity", "effort")]
    assert moved > 0.2
    # it begins at rest half a step early; the torque jumps as the target does; a bristle bends by 0.5 mrad
    bounds = (2e-4, 1e-2, 0.15) if friction == 0 else (1.2e-3, 0.15, 0.15)
    assert all(e < b for e, b in zip(error, bounds, strict=True)), error


def test_targets_are_means_of_held_commands_around_a_step_and_know_their_rates():
    rng = np.random.default_rng(2)
    time, command = np.cumsum(rng.uniform(0.004, 0.02, 50)), rng.normal(0, 1, 50)
    at = rng.uniform(0.0, 0.6, 40)
    share = np.linspace(-1, 1, 20001)
    fine = at[:, None] + share * 0.001
    held = command[np.maximum(np.searchsorted(time, fine, side="right") - 1, 0)]
    value, rate = stands.targets_of(time, command, at, 0.001)
    np.testing.assert_allclose(value, np.average(held, axis=1, weights=1 - np.abs(share)), atol=2e-4)
    ends = [stands.targets_of(time, command, at + s, 0.001)[0] for s in (1e-9, -1e-9)]
    np.testing.assert_allclose(rate, (ends[0] - ends[1]) / 2e-9, atol=1e-4 * np.abs(rate).max())


@pytest.mark.parametrize(
    ("rate", "change", "bristle", "lead", "heavy", "bend"),
    [(0.1, 0.4, 0.1, 0.0, 50.0, 1e-3), (0.1, 0.4, 0.1, 0.004, 50.0, 1e-3), (-0.2, 0.1, 0.3, 0.0, 50.0, 1e-3),
     (0.5, 0.4, 0.6, 0.0, 50.0, 1e-3), (-0.5, 0.4, -0.6, 0.0, 50.0, 1e-3), (0.1, 0.4, 0.1, 0.004, 1.0, 1e-3),
     (0.1, 0.4, 0.1, 0.0, 1.0, 1e-3), (1e-4, 0.0, 0.1, 0.0, 20.0, 2e-6), (-1e-4, 0.0, 0.2, 0.001, 20.0, 2e-6)],
)  # fmt: skip
def test_a_heavy_joint_alone_is_braked_by_its_bristle_as_by_hand(rate, change, bristle, lead, heavy, bend):
    """Beside its armature links weigh nothing, and no spring pulls: friction alone changes its rate."""
    friction, step, near = 5.0, 1e-3, 1e-6 if heavy > 20 else 1e-3
    own = rubbed({"coulomb_friction": friction, "presliding": bend, "armature": heavy}, gravity=[0.0, 0.0, 0.0])
    after, seen = one_step(own, rate, change, bristle, lead=lead)
    bent = np.clip(bristle + rate * step / bend, -1, 1)
    per_rate = 1 / (bend / RELAXATION + abs(change) / 2)
    share, per_change = bent + per_rate * rate, per_rate * (step / 2 + lead)
    reached = share / (1 + friction * per_change / heavy)
    slope = friction * per_change if abs(reached) < 1 else 0.0
    acceleration = -friction * (share if abs(reached) < 1 else np.sign(reached)) / (heavy + slope)
    np.testing.assert_allclose(after.change, step * acceleration, rtol=1e-2)
    np.testing.assert_allclose(after.state.joint_rates, rate + step * acceleration, rtol=near)
    np.testing.assert_allclose(after.servo.bristle, bent)
    np.testing.assert_allclose(seen.velocity, rate + step * acceleration / 2, rtol=near)


@pytest.mark.parametrize(("rate", "bristle"), [(0.5, 0.6), (-0.5, -0.6)])
@pytest.mark.parametrize(("scale", "change", "kd"), [(1.0, 0.0, 0.0), (1.3, 0.0, 0.0), (1.0, 0.4, 3.0)])
def test_gears_rub_by_what_they_carry_of_motor_and_load(rate, bristle, scale, change, kd):
    """The load, gravity and the motion, by MuJoCo; each joint slips, and its armature is far above all inertias.

    The motor brakes by the rate where the angles are, half a change further, and the joint by that half a step before.
    """
    heavy, off = 1e5, np.linspace(-0.03, 0.03, 12).reshape(4, 3)
    servo = {"coulomb_friction": 0.1, "presliding": 0.001, "armature": heavy}
    servo |= {"load_friction": 0.3, "external_load_friction": 0.5}
    own = rubbed(servo, gravity=[1.0, -2.0, -9.0])
    own = own.replace({"mass_scale": np.array(scale), "control.kd": np.array(kd)})
    after, _ = one_step(own, rate, change, bristle, off)
    data = mujoco.MjData(model := welded("hubrobo_v3_2", dataclasses.replace(TRUTH, gravity=(1.0, -2.0, -9.0))))
    data.qpos[:], loads = ROBOT.stance_joints.ravel(), []
    for own_rate in (rate, rate + change / 2):
        data.qvel[:] = own_rate
        mujoco.mj_forward(model, data)
        loads.append(-scale * data.qfrc_bias.reshape(4, 3))
    (load, acting), torque = loads, 50.0 * off
    np.testing.assert_allclose(after.servo.load, load, rtol=1e-9, atol=1e-9)
    most = 0.1 + np.abs(0.5 * load - 0.3 * (torque - kd * (rate + change / 2)))
    moved = torque - kd * rate + acting - np.sign(rate) * most
    np.testing.assert_allclose(after.change, 1e-3 * moved / heavy, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize(("share", "on"), [(0.5, 1.0), (0.0, 0.0), (0.25, 0.5)])
def test_gains_have_their_share_and_torques_are_none_where_they_are_off(share, on):
    own = rubbed({"torque_limit": 4.0}, gravity=[0.0, 0.0, 0.0]).replace(
        {"control.kd": np.array(0.3), "control.ki": np.array(2.0)}
    )
    stand = stands.Stand(ROBOT, hardware_of(own, stages_of(own, 1e-3, ROBOT), 1e-3, ROBOT))
    found = stands.with_gains(stand, stands.Sent(np.zeros((4, 3)), share, on)).hardware.parameters
    each = {name: float(np.max(found.at(f"control.{name}"))) for name in ("kp", "kd", "ki")}
    assert each == pytest.approx({"kp": 50.0 * share, "kd": 0.3 * on, "ki": 2.0 * on})
    assert float(np.max(found.at("hardware.servo.torque_limit"))) == pytest.approx(4.0 * on)
    for sent in (
        stands.Sent(np.zeros((4, 3))),
        stands.Sent(np.zeros((4, 3)), share),
        stands.Sent(np.zeros((4, 3)), None, on),
    ):
        assert stands.with_gains(stand, sent) is stand


def rubbed(servo, gravity):
    """Return parameters of servos whose gears rub by their load, with gains of 50 and 0."""
    servo = {"load_friction": 0.0, "external_load_friction": 1e-12} | servo
    changes = {f"hardware.servo.{name}": value for name, value in servo.items()}
    scenario = mc.Scenario().with_overrides(changes | {"control.kp": 50.0, "control.kd": 0.0, "gravity": gravity})
    return parameters(scenario)


def one_step(own, rate, change, bristle, off=0.0, lead=0.0):
    """Return the robot a step after joints in its stance had a rate, which had changed, and a bent bristle."""
    stages = stages_of(own, 1e-3)
    with jax.enable_x64(True):
        stand = stands.Stand(ROBOT, hardware_of(own, stages, 1e-3, ROBOT), lead)
        angles = jnp.asarray(ROBOT.stance_joints, float)
        moving = stands.begin(stand, angles, jnp.full(angles.shape, rate))
        moving = moving._replace(
            change=jnp.full(angles.shape, change), servo=moving.servo._replace(bristle=jnp.full(angles.shape, bristle))
        )
        return _advanced(stages)(ROBOT, own, lead, moving, angles + off)


@functools.cache
def _advanced(stages):
    @jax.jit
    def advanced(robot, own, lead, moving, targets):
        return stands.advance(stands.Stand(robot, hardware_of(own, stages, 1e-3, robot), lead), moving, targets)

    return advanced


def test_frictions_of_a_limb_are_found_joint_after_joint_within_their_limits():
    """A second implementation by loops; with enough sweeps each torque is its limit or what its bristle asks for."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 3, 3))
    mobility = root @ root.transpose(0, 2, 1) + np.eye(3)
    free, share = rng.normal(size=(2, 4, 3))
    most, per_change = rng.uniform(0.2, 1.0, (2, 4, 3))
    with jax.enable_x64(True):
        found = stands._reached(*map(jnp.asarray, (mobility, free, most, share, per_change)))
    for limb in range(4):
        borne, reached = most[limb] * np.clip(share[limb], -1, 1), share[limb].copy()
        for _ in range(stands._SWEEPS):
            for n in range(3):
                others = free[limb, n] - sum(mobility[limb, n, m] * borne[m] for m in range(3) if m != n)
                stiff = most[limb, n] * per_change[limb, n] * mobility[limb, n, n]
                reached[n] = (share[limb, n] + per_change[limb, n] * others) / (1 + stiff)
                borne[n] = most[limb, n] * min(max(reached[n], -1.0), 1.0)
        np.testing.assert_allclose(found[limb], reached, rtol=1e-9)
