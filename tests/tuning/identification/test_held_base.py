"""A robot on a stand: against MuJoCo's C code with the base welded, and finite differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
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
