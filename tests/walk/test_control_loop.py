"""The robot's own loop, step by step: what is sampled, held, moved along lines, late, and sent to the servos."""

import dataclasses
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import sensor_watch as watching
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


class Listening(mc.Law):
    """A law whose state is the last measurement that it was given."""

    def init(self, start):
        feet, flat = start.reference.foot_position, jnp.zeros(4)
        of_limbs = {name: jnp.zeros_like(feet) for name in ("foot_force", *SERVOS)}
        base = {"base_position": feet[0], "base_orientation": flat, "base_linear_velocity": feet[0]}
        known = {"base_angular_velocity": feet[0], "wrench": jnp.zeros(6), "support": flat > 0, "forces_known": True}
        return mc.Measurement(**base, **known, **of_limbs)

    def step(self, state, measured, reference):
        kept = jax.tree.map(lambda new, old: jnp.asarray(new, jnp.asarray(old).dtype), measured, state)
        # so that all that it keeps counts as read
        read = sum(0.0 * jnp.sum(leaf) for leaf in jax.tree.leaves(measured))
        return kept, shifted(reference, jnp.zeros(6).at[2].set(read))


SERVOS = ("joint_angles", "joint_rates", "joint_torque", "foot_lever")


def test_a_law_hears_what_sensors_and_servos_say_and_when():
    """Forces by the joints' efforts, biased and rounded; RH's sensor dies. While one is lost kp rises.

    A bus of 1.5 ms, base estimates late by 2 ms, a law at every fourth step.
    """
    keys = {
        "control_period": PERIOD * STEP, "command_delay": 1.5e-3, "base_estimate": {"delay": 2e-3},
        "force_sensor": {"bias": 0.25, "resolution": 0.5, "source": "joint_effort"},
    }  # fmt: skip
    scenario = mc.Scenario().with_overrides({"hardware": keys, "control": {"kp": 30.0, "safe_kp": 50.0}})
    dead = np.array([np.inf, np.inf, 2e-3, np.inf])
    own = mc.parameters(scenario).replace({"hardware.force_sensor.dead": dead})
    hardware = hardware_of(own, stages_of(own, scenario.time_step), STEP, ROBOT)
    drive = dataclasses.replace(own.drive, hardware=hardware)
    controller = control_loop.Controller(Listening(), GEOMETRY, hardware, drive)
    turn = np.array([np.cos(0.2), 0.0, 0.0, np.sin(0.2)])
    axes = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1.0]])
    reference = mc.Reference(jnp.asarray(BASE), jnp.asarray(turn), jnp.asarray(FEET))
    rest, random = np.asarray(ROBOT.stance_joints), np.random.default_rng(1)
    begun = State(
        reference.base_position, reference.base_orientation, jnp.zeros(3), jnp.zeros(3), jnp.asarray(rest), 0 * rest
    )
    memory = jax.jit(lambda: control_loop.begin(controller, ROBOT, begun, reference))()
    assert (memory.sensor_watch is None, memory.reports is None) == (False, False)
    support = np.array([True, True, False, True])
    wanted = np.asarray(jax.jit(inverse_kinematics)(GEOMETRY, (FEET - BASE) @ axes).joint_angles)
    history = {name: [value] for name, value in zip(
        SERVOS, (rest, 0 * rest, 0 * rest, (FEET - BASE) @ axes), strict=True)}  # fmt: skip
    rises, torque, targets = [], 0 * rest, [rest]
    # LH has been silent for so long that it is lost after two samples more; then it reads again
    watch = watching.begin(jnp.asarray(FEET))._replace(doubt=jnp.array([-0.1, 0.0935, -0.1, -0.1]))
    memory = memory._replace(sensor_watch=watch)

    watched = jax.jit(watching.watched)

    @jax.jit
    def passed(memory, state, lever, force, moment, felt, n):
        wrench = base_wrench_of_foot_force(lever, force, moment)
        grip: Any = types.SimpleNamespace(foot_force=force, foot_moment=moment, support=support)
        feet = Feet(lever, 0 * lever, lever)
        actual = control_loop.Actual(state, feet, None, None, grip, wrench, felt)
        return control_loop.control(controller, memory, actual, reference, n, None)

    bases = [(BASE, turn, np.zeros(3), np.zeros(3))]
    for n in range(13):
        force, moment, by_effort = (random.normal(0, 3, (4, 3)) for _ in range(3))
        by_effort[1] = -0.25 if n < 8 else by_effort[1]
        angles, rates = rest + random.normal(0, 0.1, (4, 3)), random.normal(0, 0.1, (4, 3))
        base = BASE + random.normal(0, 0.1, 3), turn, random.normal(0, 1, 3), random.normal(0, 1, 3)
        lever = FEET + random.normal(0, 0.1, (4, 3)) - base[0]
        state = State(*base, angles, rates)
        memory, _, _, drive = passed(memory, state, lever, force, moment, by_effort, n)
        bases.append(base)
        for name, value in zip(SERVOS, (angles, rates, torque, lever @ axes), strict=True):
            history[name].append(value)
        read = np.round((by_effort + 0.25) / 0.5) * 0.5
        read[n >= np.round(dead / STEP)] = 0.0
        rises.append(float(watch.kp_rise))  # sent with the law's command, a step later
        if n % PERIOD == 0:
            watch, believed, known = watched(watch, read, support, PERIOD * STEP)
            rises[-1] = float(watch.kp_rise)
            about = np.cross(lever, believed) + moment
            wrench = np.concatenate([np.sum(believed, axis=0), about.sum(0)])
            heard = memory.law
            np.testing.assert_allclose(heard.foot_force, believed)
            np.testing.assert_allclose(heard.wrench, wrench * known, atol=1e-12)
            assert heard.forces_known == known
            np.testing.assert_array_equal(heard.support, support)
            for name, values in history.items():
                np.testing.assert_allclose(getattr(heard, name), late(values, 1), atol=1e-12, err_msg=name)
            for value, there in zip(heard[:4], bases[max(n - 1, 0)], strict=True):
                np.testing.assert_allclose(value, there, atol=1e-12)
        targets.append(wanted)
        kp = 30.0 + late([0.0, *rises], 1) * 20.0
        torque = kp * (late(targets, 1) - angles) - float(own.joint_loop.kd) * rates
        np.testing.assert_allclose(drive.motor_torque, torque, atol=1e-9)
    assert np.sign(np.diff(rises[::PERIOD])).tolist() == [1, -1, 0]
