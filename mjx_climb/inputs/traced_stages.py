"""Which stages of hardware a walk has whose parameters JAX may trace."""

from collections.abc import Callable

import jax
import numpy as np
from jax.extend.core import concrete_or_error

from mjx_climb.hardware.stages import DELAYED, Stages, lacking, stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.parameter_types import Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.model import Scenario


def stages_under_trace(
    scenario: Scenario,
    parameters: Parameters,
    robot: Robot | None = None,
    called: Callable[[str], str] = "parameters.{}".format,
) -> Stages:
    """Return the stages that parameters need, of which JAX may trace some.

    What a derivative alone traces is known; what `jit` or `vmap` traces counts as the scenario's own.

    Arguments:
        called: how a parameter, by its name, is called where it is refused.

    Raises:
        ValueError: a parameter that is traced and decides about a stage which is not there, or a delay that is traced,
            whose buffer has a length.
    """
    values, traced = dict(vars(parameters)), {}
    for name, value in parameters.numbers.items():
        if isinstance(value, jax.core.Tracer):
            try:
                values[name], traced[name] = np.asarray(concrete_or_error(None, value)), True
            except jax.errors.ConcretizationTypeError:
                values[name], traced[name] = getattr(own_parameters(scenario), name), False
    known = Parameters(**values)
    stages = stages_of(scenario, known, robot)
    for name, is_known in traced.items():
        late = name.removesuffix("_delay") in DELAYED and not is_known
        if late or lacking(stages, stages_of(scenario, known, robot, (name,))):
            known_one = "a value that is known where the walk is compiled"
            expected = known_one if late else f"{known_one}, or a scenario that has such a stage"
            raise ValueError(f"{called(name)}: expected {expected}, got one that JAX traces: trace only what varies")
    return stages
