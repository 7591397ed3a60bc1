"""The values of a scenario as a pytree: what may differ from one robot of a batch to the next."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import concrete_or_error
from pydantic import TypeAdapter, ValidationError

from mjx_climb.component import real_numbers, with_values
from mjx_climb.execution import check_process
from mjx_climb.gait.footholds import SHIPPED
from mjx_climb.gait.footholds.footholds import Footholds
from mjx_climb.gait.published_swing import published_path
from mjx_climb.gait.recovery import Recovery
from mjx_climb.gait.swing import swing_path
from mjx_climb.ground import holds_of
from mjx_climb.hardware.stages import DELAYED, Stages, lacking, stages_of
from mjx_climb.inputs.own_objects import components_of
from mjx_climb.parameter_types import KEYS, Gains, Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import section
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.values import Limit, Number, Positive
from mjx_climb.terrain import foothold_heights

_PUSHES = {"push_force": -2, "push_moment": -2, "push_start": -1, "push_stop": -1}  # which axis they are along


def parameters(scenario: Scenario, dtype: jnp.dtype | None = None) -> Parameters:
    """Return the parameters of a scenario, to be replaced one by one or by batches with `dataclasses.replace`."""
    with jax.ensure_compile_time_eval():  # values under `jit` too: they say which hardware a walk is compiled for
        own, kind = own_parameters(scenario), dtype or jnp.result_type(float)
        made: Parameters = jax.tree.map(lambda value: jnp.asarray(value, kind), own)
        return made


def own_parameters(scenario: Scenario, source: str = "scenario") -> Parameters:
    """Return the parameters of a scenario in double precision, as arrays of NumPy; files of its section own are run."""
    check_process()
    values = {name: _value(scenario, *key.split(".")) for name, key in KEYS.items()}
    values |= {"foothold_height": foothold_heights(scenario), "swing_path": _swing_path(scenario), "mass_scale": 1.0}
    control, dead = scenario.control, scenario.hardware.force_sensor.dead
    values["safe_kp"] = control.kp if control.safe_kp is None else control.safe_kp
    instants = dict(dead.items()) if dead is not None else {}
    values["force_dead"] = [instants.get(limb, math.inf) for limb in load_robot(scenario.robot).limbs]
    arrays = {name: np.asarray(value, float) for name, value in values.items()}
    pushes = {name: arrays[name].reshape(-1, 3) for name in ("push_force", "push_moment")}
    numbers = Parameters(**arrays | pushes)
    own: dict[str, Any] = {"footholds": _footholds(scenario), "recovery": _recovery(scenario)}
    own["holds"] = holds_of(scenario.ground)
    own |= {place: each for place, each in components_of(scenario, numbers, source).items() if each is not None}
    return dataclasses.replace(numbers, **own)


def _footholds(scenario: Scenario) -> Footholds | None:
    """Return the rule that `gait.footholds` names, None of planned ones."""
    name = scenario.gait.footholds
    return None if name == "planned" else with_values(SHIPPED[name](), {}, name="footholds")


def _recovery(scenario: Scenario) -> Recovery | None:
    """Return the recovery of a scenario, None without a threshold."""
    given = scenario.control.recovery
    if not given.interrupts:
        return None
    values = {name: _value(given, name) for name in Recovery.VALUES}
    values["margin"] = given.margin or 0.0
    return with_values(Recovery(), {name: np.asarray(value, float) for name, value in values.items()}, name="recovery")


def _swing_path(scenario: Scenario) -> np.ndarray:
    """Return the coefficients (limb, 3, K) of the gait's swing, or of a published one."""
    gait = scenario.gait
    if gait.swing_file is None:
        return swing_path(scenario)
    return published_path(gait.swing_file, gait, len(gait.lift_off))


def _value(section: object, *names: str) -> object:
    """Return the value at a key of a section, of each section in a list of them; null is infinite."""
    if not names:
        return math.inf if section is None else section
    if isinstance(section, tuple):
        return [_value(each, *names) for each in section]
    return _value(getattr(section, names[0]), *names[1:])


def gains(scenario: Scenario) -> Gains:
    """Return the admittance gains that the scenario's own control section gives."""
    control = scenario.control
    return Gains(*(jnp.asarray(value, float) for value in (control.inertia, control.damping, control.stiffness)))


def check_ranges(parameters: Parameters) -> None:
    """Refuse parameters that no scenario could have, as far as their values are known.

    Raises:
        ValueError: in one line, which one, what was expected and the first value that is wrong.
    """
    for name, value in parameters.numbers.items():
        if isinstance(value, jax.core.Tracer):
            continue
        values = np.asarray(real_numbers(f"parameters.{name}", value))
        kind, validator = _type(name)
        for end in map(float, (values.min(), values.max()) if values.size else ()):  # of NaN among them both are
            given: object = end
            if end == math.inf and type(None) in get_args(kind):
                given = None
            elif get_origin(kind) is tuple:
                given = (end,) * len(get_args(kind))
            elif kind is int and end.is_integer():
                given = int(end)
            try:
                validator.validate_python(given)
            except ValidationError as invalid:
                expected = invalid.errors()[0]["ctx"]["expected"].replace("or null", "or infinite")
                raise ValueError(f"parameters.{name}: expected {expected}, got {end:g}") from None
    pushes = {name: np.shape(getattr(parameters, name))[axis:][:1] for name, axis in _PUSHES.items()}
    if len(set(pushes.values())) > 1:
        counts = ", ".join(f"{count[0] if count else 'none'} of {name}" for name, count in pushes.items())
        raise ValueError(f"parameters.push_start: expected as many of each for the pushes, got {counts}")


@functools.cache
def _type(name: str) -> tuple[object, TypeAdapter[object]]:
    """Return the type of the key that a parameter comes from, and what validates its values."""
    if name not in KEYS:
        kind: Any = {"mass_scale": Positive, "force_dead": Limit}.get(name, Number)
        return float | None if kind is Limit else float, TypeAdapter(kind)
    *place, key = KEYS[name].split(".")
    field = section(Scenario, place).model_fields[key]
    kind = Annotated[field.annotation, *field.metadata]
    return field.annotation, TypeAdapter(kind)


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
