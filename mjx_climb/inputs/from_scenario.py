"""The values of a scenario as a pytree: they may differ from one robot of a batch to the next."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import concrete_or_error
from pydantic import BaseModel

from mjx_climb.component import AnyComponent, Component, checked_value, in_full
from mjx_climb.disturbances.on_base import Cargo, Push
from mjx_climb.execution import check_process
from mjx_climb.gait.footholds.footholds import Footholds
from mjx_climb.gait.periodic import PeriodicGait
from mjx_climb.gait.published_swing import published_path
from mjx_climb.gait.recovery import Recovery
from mjx_climb.gait.swing import COUNT, swing_path
from mjx_climb.gait.waiting import Waiting
from mjx_climb.ground import holds_of
from mjx_climb.ground.ground import Ground
from mjx_climb.hardware.actuator import JointLoop
from mjx_climb.hardware.bus import Bus
from mjx_climb.hardware.sensors import BaseEstimate, ForceSensors
from mjx_climb.hardware.servo import Servos
from mjx_climb.hardware.stages import DELAYED, Stages, lacking, stages_of
from mjx_climb.inputs.own_objects import component_of
from mjx_climb.parameter_types import Gains, Parameters, is_tracer
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import FootholdsKind, Kind, Scenario
from mjx_climb.shapes import check_shape
from mjx_climb.terrain import foothold_heights


def parameters(scenario: Scenario, dtype: jnp.dtype | None = None) -> Parameters:
    """Return the parameters of a scenario, to be replaced one by one or by batches with `Parameters.replace`."""
    with jax.ensure_compile_time_eval():  # values under `jit` too: they say which hardware a walk is compiled for
        own, kind = own_parameters(scenario), dtype or jnp.result_type(float)
        made: Parameters = jax.tree.map(lambda value: jnp.asarray(value, kind), own)
        return made


def paths(scenario: Scenario) -> dict[str, dict[str, Any]]:
    """Return the declaration of each value of a scenario's walk by its path: unit, bounds, shape, meaning and value."""
    own = own_parameters(scenario)
    return {
        path: {"unit": field.unit, "bounds": field.bounds, "shape": np.shape(own.at(path)), "meaning": field.long_name,
               "value": own.at(path)}
        for path, field in own.paths.items()
    }  # fmt: skip


def own_parameters(scenario: Scenario, source: str = "scenario") -> Parameters:
    """Return the parameters of a scenario in double precision, as arrays of NumPy; files of its kinds are run."""
    check_process()
    control, hardware, happens = scenario.control, scenario.hardware, scenario.disturbance
    dead = hardware.force_sensor.dead
    instants = dict(dead.items()) if dead is not None else {}
    robot = load_robot(scenario.robot)
    ground: dict[str, Any] = {"foothold_height": foothold_heights(scenario, robot), "holds": holds_of(scenario.ground)}

    def made(place: str, section: Any, plain: type[Component] = Component, **given: object) -> Any:
        if isinstance(section, Kind):
            return component_of(section, place, source)
        return _of_section(plain, section, **given)

    contact = made("contact", scenario.contact, Gripper).compiled_for()
    in_registers = getattr(hardware.servo, "registers", None) is not None
    return Parameters(
        gravity=np.asarray(scenario.gravity, float),
        mass_scale=np.asarray(1.0),
        contact=contact,
        drive=made("hardware.servo", hardware.servo, Servos, in_registers=in_registers),
        joint_loop=_of_section(JointLoop, control, safe_kp=control.kp if control.safe_kp is None else control.safe_kp),
        force_sensor=_of_section(
            ForceSensors, hardware.force_sensor, dead=[instants.get(limb, math.inf) for limb in robot.limbs]
        ),
        base_estimate=_of_section(BaseEstimate, hardware.base_estimate),
        bus=_of_section(Bus, hardware),
        gait=_of_section(
            PeriodicGait, scenario.gait, swing_path=_swing_path(scenario, robot, contact.transmits_moments)
        ),
        ground=Ground(**ground),
        disturbances=(
            _of_section(Cargo, happens.cargo),
            *(_of_section(Push, push) for push in happens.pushes),
            *(made(f"disturbance.others.{n}", each) for n, each in enumerate(happens.others)),
        ),
        footholds=_footholds(scenario, source),
        recovery=_recovery(scenario),
        waiting=waiting_of(scenario, contact),
    )


def _of_section(kind: type[AnyComponent], section: BaseModel, **given: object) -> AnyComponent:
    """Return a component with the values and options of a section of the scenario; null is infinite."""
    names = [field.name for field in dataclasses.fields(kind) if field.name in type(section).model_fields]  # type: ignore[arg-type]
    values = {name: getattr(section, name) for name in names} | given
    for name in kind.VALUES:
        values[name] = np.asarray(math.inf if values[name] is None else values[name], float)
    return in_full(kind(**values))


def _footholds(scenario: Scenario, source: str) -> Footholds | None:
    """Return the rule that `gait.footholds` names, None of planned ones."""
    rule, place = scenario.gait.footholds, "gait.footholds"
    if rule == "planned":
        return None
    found: Footholds = component_of(FootholdsKind(kind=rule) if isinstance(rule, str) else rule, place, source)
    return found


def _recovery(scenario: Scenario) -> Recovery | None:
    """Return the recovery of a scenario, None without a threshold."""
    given = scenario.control.recovery
    if not given.interrupts:
        return None
    return _of_section(Recovery, given, margin=given.margin or 0.0)


def waiting_of(scenario: Scenario, contact: Contact) -> Waiting | None:
    """How a gait waits for the grips of a contact, None where it does not."""
    given = scenario.gait.waiting
    usual = scenario.ground.holds is not None or contact.may_fail
    return _of_section(Waiting, given) if (usual if given.waits is None else given.waits) else None


def _swing_path(scenario: Scenario, robot: Robot, turned: bool) -> np.ndarray:
    """Return the coefficients (limb, 3, K) of the gait's swing, or of a published one."""
    gait = scenario.gait
    if gait.swing_file is None:
        return swing_path(scenario, robot, turned)
    return published_path(gait.swing_file, gait, len(gait.lift_off))


def gains(scenario: Scenario) -> Gains:
    """Return the admittance gains that the scenario's own control section gives."""
    control = scenario.control
    return Gains(*(jnp.asarray(value, float) for value in (control.inertia, control.damping, control.stiffness)))


def check_parameters(parameters: Parameters, limbs: int) -> None:
    """Refuse parameters that no walk could have, as far as their values are known.

    Raises:
        ValueError: in one line, the path of the first wrong value, expected and got.
    """
    values = parameters.values
    for path, field in parameters.paths.items():
        value = checked_value(f"parameters.{path}", values[path], field.shape, limits=field.bounds)
        if field.whole and not is_tracer(value) and (part := np.mod(np.asarray(value), 1)).any():
            raise ValueError(f"parameters.{path}: expected whole numbers, got {np.extract(part, value)[0]:g}")
    sizes: Mapping[str, int | range] = {"limbs": limbs, "K": range(COUNT + 1)}
    for path, dims in _OF_LIMBS.items():
        check_shape(f"parameters.{path}", np.shape(values[path]), dims, sizes)


_OF_LIMBS = {
    "ground.foothold_height": "... limbs N",
    "gait.swing_path": "... limbs 3 K",
    "hardware.force_sensor.dead": "... limbs",
}


def known_parameters(scenario: Scenario, parameters: Parameters) -> tuple[Parameters, dict[str, bool]]:
    """Return parameters with values in place of those that JAX traces, and by their paths whether these are known.

    Under jvp and grad the value is known; under jit and vmap the scenario's decides.
    """
    found: dict[str, Any] = {}
    traced: dict[str, bool] = {}
    for path, value in parameters.values.items():
        if is_tracer(value):
            try:
                found[path], traced[path] = np.asarray(concrete_or_error(None, value)), True
            except jax.errors.ConcretizationTypeError:
                own = own_parameters(scenario).values
                found[path], traced[path] = own.get(path, np.zeros(())), False
    return parameters.replace_alone(found), traced


def compiled_for(scenario: Scenario, parameters: Parameters) -> Parameters:
    """Return parameters whose components have the options that their values ask of a compiled walk.

    Raises:
        ValueError: a value that is traced and decides about an option that is not there.
    """
    known, traced = known_parameters(scenario, parameters)
    components = known.components

    def change(place: str, each: Component) -> Component:
        found = components[place].compiled_for()
        for path in traced:
            section, _, name = path.rpartition(".")
            if section == place and _options(components[place].compiled_for((name,))) != _options(found):
                raise ValueError(_undecided(f"parameters.{path}", ", or a scenario that has such a stage"))
        return _with_options(each, found)

    return parameters.with_components(change)


def with_options_of(parameters: Parameters, like: Parameters) -> Parameters:
    """Return parameters whose components have the options that the values of others ask of a compiled walk."""
    others = like.components
    return parameters.with_components(lambda place, each: _with_options(each, others[place].compiled_for()))


def _with_options(component: Component, like: Component) -> Component:
    return component if like is component else dataclasses.replace(component, **_options(like))  # type: ignore[type-var]


def _options(component: Component) -> dict[str, object]:
    """Return the fields of a component that a walk is compiled for."""
    fields = dataclasses.fields(component)  # type: ignore[arg-type]
    names = [field.name for field in fields if field.name not in component.VALUES and "tree" not in field.metadata]
    return {name: getattr(component, name) for name in names}


def stages_under_trace(
    scenario: Scenario,
    parameters: Parameters,
    robot: Robot | None = None,
    called: Callable[[str], str] = "parameters.{}".format,
) -> Stages:
    """The stages that parameters need; JAX may trace some of these.

    Arguments:
        called: how a value, by its path, is called where it is refused.

    Raises:
        ValueError: a value that is traced and decides about a stage which is not there, or a delay that is traced,
            whose buffer has a length.
    """
    known, traced = known_parameters(scenario, parameters)
    stages = stages_of(known, scenario.time_step, robot)
    for path, is_known in traced.items():
        late = path in DELAYED.values() and not is_known
        if late or lacking(stages, stages_of(known, scenario.time_step, robot, (path,))):
            raise ValueError(_undecided(called(path), "" if late else ", or a scenario that has such a stage"))
    return stages


def _undecided(name: str, otherwise: str) -> str:
    """The refusal of a traced value that decides about a walk's structure."""
    known = f"a value that is known where the walk is compiled{otherwise}"
    return f"{name}: expected {known}, got one that JAX traces: trace only what varies"
