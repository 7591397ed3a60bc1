"""A gripped robot whose base sways: against MuJoCo's C code with a spring and a damper at each foot."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.inputs.from_scenario import parameters
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.gripped_in_mujoco import TRUTH, swayed, sways
from tuning.identification.model import held_feet as grips
from tuning.identification.model.held_base import targets_of

ROBOT = load_robot("hubrobo_v3_2")
# the torque jumps as the target does
BOUNDS = {"position": 2e-4, "velocity": 5e-3, "effort": 0.2, "force": 0.02, "base_position": 2e-5,
          "base_orientation": 3e-5}  # fmt: skip


@pytest.mark.parametrize("firm", [True, False])
def test_grips_that_transmit_moments_hold_the_attitude_that_they_shut_in(firm):
    scenario = mc.load_scenario("case_1_1", {"contact.rotational_stiffness": 5.0} if firm else {})
    own = parameters(scenario)
    hardware = hardware_of(own, stages_of(own, scenario.time_step, ROBOT), scenario.time_step, ROBOT)
    pose, still = (ROBOT.stance_position, ROBOT.stance_orientation), jnp.zeros(3)
    gripped = grips.gripped(ROBOT, hardware, State(*pose, still, still, ROBOT.stance_joints, jnp.zeros((4, 3))))
    attitude = gripped.contact.attitude
    assert (attitude.held.tolist() == [True] * 4) if firm else attitude is None


@pytest.mark.parametrize(
    ("stiffness", "damping", "duration"),
    [
        pytest.param(1e4, 20.0, 0.9, marks=pytest.mark.slow),
        *(pytest.param(*each, 1.5, marks=pytest.mark.nightly) for each in ((1e4, 20.0), (5e4, 60.0))),
    ],
)
def test_a_step_of_a_millisecond_is_right_to_second_order(stiffness, damping, duration):
    truth = dataclasses.replace(TRUTH, stiffness=stiffness, damping=damping)
    time, targets = sways(duration, 0.001)
    log = swayed(truth, time, targets, step=2.5e-5, lead=0.0)
    scenario = mc.load_scenario("case_1_1", {
        "control.kp": truth.kp, "control.kd": truth.kd, "hardware.servo.armature": truth.armature,
        "contact.stiffness": stiffness, "contact.damping": damping,
    })  # fmt: skip
    with jax.enable_x64(True):
        own = parameters(scenario)
        hardware = hardware_of(own, stages_of(own, scenario.time_step, ROBOT), 0.001, ROBOT)
        robot = jax.tree.map(lambda value: jnp.asarray(value, float), ROBOT)
        still = jnp.zeros(3)
        pose = robot.stance_position, robot.stance_orientation
        state = State(*pose, still, still, robot.stance_joints, jnp.zeros((4, 3)))
        gripped = grips.gripped(robot, hardware, state)
        held = np.stack([targets_of(time, command, time, 0.001)[0] for command in targets.T], axis=1)
        step = functools.partial(grips.advance, gripped)
        _, ours = jax.lax.scan(step, grips.begin(hardware, state), jnp.asarray(held.reshape(-1, 4, 3)))
    after = time > 0.3  # it begins at rest half a step early
    for kind, bound in BOUNDS.items():
        off = np.reshape(getattr(ours, kind), (len(time), -1)) - log[kind].reshape(len(time), -1)
        moved = np.ptp(log[kind].reshape(len(time), -1)[after], axis=0).max()
        assert np.abs(off[after]).max() < bound
        assert moved > 20 * bound
