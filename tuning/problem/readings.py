"""Sensors on which a law depends, by its program."""

import jax.numpy as jnp
import numpy as np

from mjx_climb.control import Reference, Start, law_of
from mjx_climb.control.law import beginning
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.robot_import.load import load_robot
from tuning.problem.evaluation import Problem


def readings(problem: Problem) -> frozenset[str]:
    """Return the sensors on which a law depends, by its program: names of `mjx_climb.control.law.SENSORS`."""
    scenario, law = problem.scenario, problem.law or law_of(problem.scenario)
    one = resolve_in(scenario, law, None, own_parameters(scenario), np.float64).law
    robot = load_robot(scenario.robot)
    # of any values: only the program is looked at
    zero, feet, joints, each = map(jnp.zeros, (3, robot.foot_center.shape, robot.stance_joints.shape, len(robot.limbs)))
    reference = Reference(zero, jnp.array([1.0, 0.0, 0.0, 0.0]), feet, each, each)
    return beginning(one, Start(scenario.time_step, reference, joints)).reads


def reads_forces(problem: Problem) -> bool:
    """Tell whether a law depends on the forces that are measured, by its program."""
    return "forces" in readings(problem)
