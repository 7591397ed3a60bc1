"""The robot's own loop, step by step: what is sampled, held, moved along lines, late, and sent to the servos."""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control.law import JointGains, shifted
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import Feet, base_wrench_of_foot_force, limb_frames
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from mjx_climb.walk import control_loop

STEP, PERIOD = 1e-3, 4
ROBOT = load_robot("hubrobo_v3_2")
BASE = ROBOT.stance_position
FEET = BASE + np.asarray(limb_frames(ROBOT, None, ROBOT.stance_joints).foot)
GEOMETRY = limb_geometry(ROBOT)


class Counting(mc.Law):
    """A law that lowers the base with each step and with what its feet bear, and softens the first limb."""

    def init(self, start):
        return jnp.zeros(())

    def step(self, count, measured, reference):
        down = 1e-3 * count + 1e-3 * measured.foot_force[:, 2].sum() + 1e-2 * measured.wrench[3]
        command = shifted(reference, jnp.zeros(6).at[2].set(-down))
        factors = jnp.where(jnp.arange(4) == 0, 1 / (1 + count), 1.0)
        return count + 1, command._replace(joint_gains=JointGains(kp=factors, kd=jnp.ones(4)))


def late(values, steps):
    """Return the last of some values as it was some whole steps and a half ago, the first before they began."""
    padded = [values[0]] * 8 + values
    return (padded[-1 - steps] + padded[-2 - steps]) / 2


@pytest.mark.parametrize("who", ["held", "linear", "shift", "targets"])
def test_a_pass_of_the_loop_is_that_of_numpy(who):
    """A law of 250 Hz that filters forces, over a bus of 1.5 ms; or an action in its place, while the law rests."""
    keys = {
        "control_period": PERIOD * STEP, "command_delay": 1.5e-3, "interpolation": who if who == "linear" else "hold",
        "force_sensor": {"filter": 60.0, "filtered_by": "law"},
    }  # fmt: skip
    scenario = mc.Scenario().with_overrides({"hardware": keys})
    own = mc.parameters(scenario)
    hardware = hardware_of(own, stages_of(own, scenario.time_step), STEP, ROBOT)
    controller = control_loop.Controller(
        Counting(), GEOMETRY, hardware, dataclasses.replace(own.drive, hardware=hardware)
    )
    reference = mc.Reference(jnp.asarray(BASE), jnp.asarray(ROBOT.stance_orientation), jnp.asarray(FEET))
    rest = jnp.asarray(ROBOT.stance_joints)
    state = State(reference.base_position, reference.base_orientation, jnp.zeros(3), jnp.zeros(3), rest, 0 * rest)
    memory, random = control_loop.begin(controller, ROBOT, state, reference), np.random.default_rng(0)
    lever, share = jnp.asarray(FEET - BASE), 1 - np.exp(-2 * np.pi * 60.0 * PERIOD * STEP)
    targets: list[Any] = [np.asarray(rest)]
    factors: list[Any] = [1.0]
    filtered = filtered_wrench = 0.0
    before = end = np.asarray(rest)
    count = 0

    @jax.jit
    def passed(memory, force, rates, n, action):
        moving = State(*list(vars(state).values())[:5], rates)
        feet, wrench = Feet(lever, 0 * lever, lever), base_wrench_of_foot_force(lever, force, 0 * force)
        grip: Any = types.SimpleNamespace(foot_force=force, foot_moment=0 * force, support=jnp.ones(4, bool))
        actual = control_loop.Actual(moving, feet, None, None, grip, wrench)
        return control_loop.control(controller, memory, actual, reference, n, None, action), wrench

    for n in range(11):
        force, rates = random.normal(2, 1, (4, 3)), random.normal(0, 0.1, (4, 3))
        action = {
            "shift": control_loop.BaseShift(jnp.array([0, 0, -1e-3 * n, 0, 0, 0.02])),
            "targets": control_loop.JointTargets(rest + 0.01 * n),
        }.get(who)
        (memory, command, joints, drive), wrench = passed(memory, force, rates, n, action)
        if n % PERIOD == 0:
            filtered = filtered + share * (force - filtered)
            filtered_wrench = filtered_wrench + share * (np.asarray(wrench) - filtered_wrench)
            down = 1e-3 * count + 1e-3 * filtered[:, 2].sum() + 1e-2 * filtered_wrench[3]
            turn, before = np.eye(3), end
            if who == "shift":
                down, cosine, sine = 1e-3 * n, np.cos(0.02), np.sin(0.02)
                turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
            base = BASE - np.array([0, 0, down])
            end = np.asarray(inverse_kinematics(GEOMETRY, (FEET - base) @ turn).joint_angles)
            end = np.asarray(rest + 0.01 * n) if who == "targets" else end
            factor = 1.0 if action is not None else 1 / (1 + count)
            count += action is None
        np.testing.assert_allclose(memory.law, count)
        moved = before + (end - before) * (n % PERIOD + 1) / PERIOD if who == "linear" else end
        targets, factors = [*targets, moved], [*factors, factor]
        wanted = late(targets, 1)
        np.testing.assert_allclose(joints.joint_angles, wanted, atol=1e-9, err_msg=f"{n}")
        if who != "targets":
            np.testing.assert_allclose(command.base_position, base, atol=1e-12)
        kp = 50.0 * np.where(np.arange(4) == 0, late(factors, 1), 1.0)[:, None]
        torque = kp * (wanted - np.asarray(rest)) - float(own.joint_loop.kd) * rates
        np.testing.assert_allclose(drive.motor_torque, torque, atol=1e-6)
