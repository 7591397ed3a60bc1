"""What a walk tells its gait of the robot: masses, forces, grips and the pulls that they bear."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.gait.recovery import RecoveringGait, Recovery
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.physics.kinematics import center_of_mass, limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.walk import step
from mjx_climb.walk.structure import structure
from tests.gait.test_planner import holds

CARGO = {"disturbance.cargo": {"mass": 0.5, "start": 0.01, "stop": 0.1}}


class Told(RecoveringGait):
    """A gait that remembers by what it decides."""

    def look_ahead(self, memory, now, step, reference, body):
        return step, reference, body


@pytest.mark.parametrize("number, cargo", [(0, 0.0), (20, 0.5)])
def test_a_gait_is_told_of_the_robot_as_it_is(number, cargo):
    """A robot of more mass, with cargo in its window, 1 mm low, which moves; of one foot the grip is lost."""
    gait = {"gait.cycle": 0.8, "gait.base_reference": "actual"}
    scenario = mc.load_scenario("case_2", CARGO | gait | {"gravity": [0.5, 0.0, -2.0], "duration": 0.3})
    own = mc.parameters(scenario)
    parameters = dataclasses.replace(
        own, mass_scale=np.asarray(1.2), recovery=Recovery(), ground=Ground(holds=holds(np.zeros((1, 3))))
    )
    law = law_of(scenario)
    found = resolve_in(scenario, law, None, parameters, np.float64)
    shape = structure(scenario, "limb", found.walked, law=found.law)

    @jax.jit
    def told(law, parameters, number):
        walk = step.prepare(shape, law, parameters)
        walk, carry = walk._replace(gait=Told(**vars(walk.gait))), step.begin(walk)
        moving = dataclasses.replace(
            carry.state, base_position=carry.state.base_position - jnp.array([0, 0, 1e-3]),
            base_linear_velocity=jnp.array([0.1, 0.0, 0.0]),
        )  # fmt: skip
        lost = carry.contact._replace(detached=jnp.arange(4) == 2)
        after = step.look_ahead(walk, carry._replace(state=moving, contact=lost), number)
        alone = center_of_mass(walk.robot, limb_frames(walk.robot, None, moving.joint_angles), moving, jnp.zeros(()))
        return moving, alone, after.gait

    moving, alone, (at, reference, body) = told(found.law, found.parameters, jnp.asarray(number))
    robot = load_robot(scenario.robot)
    mass = 1.2 * robot.total_mass + cargo
    np.testing.assert_allclose(body.mass, mass)
    np.testing.assert_allclose(body.weight, mass * np.array([0.5, 0, -2.0]))
    middle = (1.2 * robot.total_mass * alone + cargo * moving.base_position) / mass
    np.testing.assert_allclose(body.center_of_mass, middle, atol=1e-9)
    np.testing.assert_array_equal(body.velocity, [0.1, 0, 0])
    # RH has let go and lies on the ground, 1 mm deep
    np.testing.assert_array_equal(body.support, np.arange(4) != 2)
    rises = scenario.contact.stiffness * 1e-3
    np.testing.assert_allclose(body.foot_force, np.tile([-0.1 * scenario.contact.damping, 0, rises], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(body.feet, np.asarray(body.grip_point) - [0, 0, 1e-3], atol=1e-9)
    assert body.holding_force == scenario.contact.holding_limit and at == number
    np.testing.assert_allclose(body.pull, scenario.contact.holding_limit * np.asarray(body.normal))
    np.testing.assert_array_equal(body.base_position, moving.base_position)
    assert reference.foot_position.shape == (4, 3)
    if number == 0:
        # a cycle starts where the base is, in decisions as in steps
        np.testing.assert_array_equal(reference.base_position, moving.base_position)
