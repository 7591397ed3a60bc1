"""Sensors on which a law depends, by its program."""

from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
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
    shapes = (3, 4, robot.foot_center.shape, len(robot.limbs), len(robot.limbs), robot.stance_joints.shape)
    zeros: list[Any] = [np.zeros(shape) for shape in shapes]
    start = Start(scenario.time_step, Reference(*zeros[:-1]), zeros[-1])
    found: list[frozenset[str]] = []
    jax.eval_shape(lambda law, start: found.append(beginning(law, start).reads), one, start)
    return found[0]


def best_of_both(names: Sequence[str], reading: Collection[str], value: Callable[[str], float]) -> list[str | None]:
    """Return the laws of the least value among those that read forces, and among the others; None of no law."""
    groups = ([name for name in names if (name in reading) is reads] for reads in (True, False))
    return [min(group, key=value, default=None) for group in groups]


def reads_forces(problem: Problem) -> bool:
    """Tell whether a law depends on the forces that are measured, by its program."""
    return "forces" in readings(problem)
