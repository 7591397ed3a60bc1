"""A gripped robot whose base's centre of mass is fitted: its feet and records stay where the file has the base."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware.stages import hardware_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.kinematics import foot_kinematics, limb_frames
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from tests import approved, left
from tuning.identification.model import held_feet as grips
from tuning.identification.model.gripped import Given, simulate
from tuning.identification.model.held_base import Sent
from tuning.identification.model.predicted import Point, Structure, stages_for
from tuning.identification.model.variables import Place

CENTER = np.array([0.02, -0.03, 0.04])
KINDS = ("force", "base_position", "base_orientation", "base_linear_velocity", "base_angular_velocity")
SCENARIO = mc.load_scenario("case_1_1")
ROBOT = load_robot(SCENARIO.robot)


@pytest.mark.slow
def test_a_fitted_centre_moves_neither_the_feet_nor_where_the_base_is_seen():
    """In the first step grips are springs at the feet of the robot as its file has it."""
    rng = np.random.default_rng(5)
    orientation = np.array([0.9, 0.2, -0.3, 0.1]) / np.linalg.norm([0.9, 0.2, -0.3, 0.1])
    joints = np.asarray(ROBOT.stance_joints), 0.1 * rng.normal(size=(4, 3))
    state = State(rng.normal(size=3), orientation, 0.1 * rng.normal(size=3), rng.normal(size=3), *joints)
    feet = foot_kinematics(ROBOT, limb_frames(ROBOT, None, joints[0]), state)
    off = 1e-3 * rng.normal(size=(4, 3))
    parameters = own_parameters(SCENARIO).replace({"contact.damping": np.zeros(())})
    places = tuple(Place(f"robot.base.center.{axis}", log=False) for axis in "xyz")
    structure = Structure(ROBOT, places, stages_for(SCENARIO, ()), SCENARIO.time_step, 0, KINDS)
    hardware = hardware_of(parameters, structure.stages, structure.time_step, ROBOT)
    sent = Sent(np.broadcast_to(joints[0], (1, 4, 3)))
    given = Given(sent, jax.tree.map(np.zeros_like, sent), (np.asarray(feet.position) + off, state))
    seen = simulate(structure, Point(jnp.asarray(CENTER), grips.begin(hardware, state), 0.0), given, parameters)
    np.testing.assert_allclose(seen["force"][0], SCENARIO.contact.stiffness * off, rtol=1e-9)
    for n, kind in enumerate(KINDS[1:]):
        np.testing.assert_allclose(seen[kind][0, 0], jax.tree.leaves(state)[n], atol=1e-12, err_msg=kind)
        np.testing.assert_allclose(seen[f"end {n}"], jax.tree.leaves(state)[n], atol=1e-12, err_msg=kind)


@pytest.mark.slow
def test_the_records_of_a_robot_that_sways_are_those_that_were_read():
    """Feet that resist turning, an armature, filtered forces, late commands, and a centre that is fitted."""
    changes = {"contact.rotational_stiffness": 3.0, "contact.rotational_damping": 0.02}
    changes |= {"hardware.servo.armature": 2e-3, "hardware.force_sensor.filter": 30.0}
    scenario, steps = mc.load_scenario("case_1_1", changes), 60
    joints = np.asarray(ROBOT.stance_joints)
    spin = np.array([0.3, -0.2, 0.4])
    state = State(np.asarray(ROBOT.stance_position), np.asarray(ROBOT.stance_orientation), 0.05 * spin, spin, joints,
                  0.1 * np.ones((4, 3)))  # fmt: skip
    kinds = ("position", "velocity", "effort", *KINDS)
    parameters = own_parameters(scenario)
    places = tuple(Place(f"robot.base.center.{axis}", log=False) for axis in "xyz")
    structure = Structure(ROBOT, places, stages_for(scenario, ()), scenario.time_step, steps, kinds)
    hardware = hardware_of(parameters, structure.stages, structure.time_step, ROBOT)
    phase = 40 * scenario.time_step * np.arange(steps + 1)[:, None, None] + np.arange(3)
    sent, rates = Sent(joints + 0.05 * np.sin(phase)), Sent(0.05 * 40 * np.cos(phase) + 0 * joints)
    feet = foot_kinematics(ROBOT, limb_frames(ROBOT, None, joints), state).position
    given = Given(sent, rates, (np.asarray(feet), state))
    point = Point(jnp.asarray(CENTER), grips.begin(hardware, state), 2e-3)
    seen = jax.jit(simulate, static_argnums=0)(structure, point, given, parameters)
    lines = [f"{kind} {np.shape(values)}: {left.of_values(values)}\n" for kind, values in seen.items()]
    approved.check_numbers(Path(__file__).parent / "approved" / "swaying.txt", "".join(lines))
