"""A caller's law, gains and parameters, resolved and checked once, before anything is traced."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from mjx_climb.arrays import AnyArray
from mjx_climb.component import AnyComponent, checked_value, in_full, in_precision, real_numbers, with_values
from mjx_climb.control import PD, Law
from mjx_climb.execution.batch_axes import batch_shape, own_axes
from mjx_climb.gait.recovery import recovery_of
from mjx_climb.inputs.from_scenario import check_parameters, compiled_for, own_parameters
from mjx_climb.inputs.gait_values import GAIT, TIMES, with_gait
from mjx_climb.parameter_types import Gains, Parameters, path_of_gain, with_whole_steps
from mjx_climb.scenario.declared import JOINT_GAINS
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.shapes import broadcasts

AnyGains = Gains | Law | Mapping[str, AnyArray]  # values by name

_MAY_BE_ZERO = ("kd", "ki")


class WalkInputs(NamedTuple):
    """A law whose gains have their full length, parameters, and the batch shape of both."""

    law: Law
    parameters: Parameters  # with the joint gains that were given, and with times that are whole time steps
    shape: tuple[int, ...]
    # as given, with the gait's values among the gains; without the joint gains, and before times become whole steps
    own: Parameters
    walked: Parameters  # as `parameters`, in the precision given: values that JAX does not trace are known
    called: Mapping[str, str]  # names in messages of the parameters among the gains, by the parameters' names

    @property
    def axes(self) -> tuple[Law, Parameters]:
        """How many axes the value of one robot has, in place of each value of law and parameters."""
        return own_axes(self.law), own_axes(self.parameters)


class Ready(NamedTuple):
    """Parameters that are checked, and ready for walks under any gains."""

    given: Parameters
    own: Parameters  # each value of its full shape
    walked: Parameters  # with times that are whole time steps, and the options that values ask of a compiled walk
    cast: Parameters  # as `walked`, in the precision of the walk


def ready(
    scenario: Scenario, parameters: Parameters, dtype: DTypeLike, xp: ModuleType = np, *, compiled: bool = False
) -> Ready:
    """Return parameters as `resolve` needs them; arguments and errors are its own."""
    array = functools.partial(xp.asarray, dtype=checked_dtype(dtype))
    check_parameters(parameters, len(scenario.gait.lift_off))
    return _made_ready(scenario, parameters, array, compiled, {})


def _made_ready(
    scenario: Scenario,
    given: Parameters,
    array: Callable[[AnyArray], AnyArray],
    compiled: bool,
    called: Mapping[str, str],
) -> Ready:
    own = given.with_components(lambda _, each: in_full(each))
    walked = with_whole_steps(own, scenario.time_step)
    walked = walked if compiled else compiled_for(scenario, walked)
    cast = {p: in_precision(called.get(p, f"parameters.{p}"), value, array) for p, value in walked.values.items()}
    return Ready(given, own, walked, walked.replace(cast))


def resolve(
    scenario: Scenario,
    law: Law,
    gains: AnyGains | None,
    parameters: Parameters | Ready | None,
    dtype: DTypeLike,
    xp: ModuleType = jnp,
    *,
    compiled: bool = False,
) -> WalkInputs:
    """Return the law with the gains given in place of its own, and parameters with joint gains and gait among them.

    Parameters are the scenario's where there are none; all are arrays of a precision, of JAX or of NumPy (`xp`). Those
    of a walk that is compiled keep the options of their components.

    Raises:
        ValueError: in one line, an unknown name, a wrong shape, a gain that is not positive, a parameter that no
            scenario could have, or a precision other than float32 and float64. Of traced values only shapes are
            known.
    """
    array = functools.partial(xp.asarray, dtype=checked_dtype(dtype))
    if not isinstance(parameters, Ready):
        own = own_parameters(scenario) if parameters is None else parameters
        parameters = ready(scenario, own, dtype, xp, compiled=compiled)
    values, given = _values_by_name(law, gains), parameters.given
    called = {path_of_gain(name): f"gains.{name}" for name in values if name in (*GAIT, *JOINT_GAINS)}
    moved = with_gait(
        scenario, given, {key: checked_value(f"gains.{key}", values.pop(key), (), 0.0) for key in GAIT if key in values}
    )
    joint = {
        path_of_gain(name): checked_value(f"gains.{name}", values.pop(name), (), zero=name in _MAY_BE_ZERO)
        for name in JOINT_GAINS
        if name in values
    }
    law = with_values(law, {name: value for name, value in values.items() if name in law.GAINS}, array)
    if (recovery := recovery_of(law, moved.recovery)) is not moved.recovery:
        moved = dataclasses.replace(moved, recovery=recovery)
    if moved is not given:
        parameters = _made_ready(scenario, moved, array, compiled, called)
    own, walked, cast = parameters[1:]
    if joint:
        walked = walked.replace(joint)
        cast = cast.replace({path: in_precision(called[path], value, array) for path, value in joint.items()})
    # gains of a law without any still say how many robots there are
    others = {name: jnp.shape(value)[:-1] for name, value in values.items() if name not in law.GAINS}
    shape = batch_shape(law, cast, others=others)
    check_robots(shape)
    if others and shape != batch_shape(law, cast):
        cast = dataclasses.replace(cast, mass_scale=xp.broadcast_to(cast.mass_scale, shape))
    return WalkInputs(law, cast, shape, own, walked, called)


def resolve_in(
    scenario: Scenario, law: Law, gains: AnyGains | None, parameters: Parameters | Ready | None, dtype: DTypeLike
) -> WalkInputs:
    """Return the inputs of a walk as `resolve` does, as arrays of NumPy."""
    with jax.enable_x64(True):
        return resolve(scenario, law, gains, parameters, dtype, np)


def check_robots(shape: tuple[int, ...]) -> None:
    """Raise a ValueError for a batch of nobody."""
    if 0 in shape:
        raise ValueError(f"gains and parameters: expected one robot or more, got batch axes {shape}")


def checked_dtype(dtype: DTypeLike) -> np.dtype:
    """Return the precision of a walk; raise a ValueError for other than float32 and float64."""
    if np.dtype(dtype) not in (np.float32, np.float64):
        raise ValueError(f"dtype: expected float32 or float64, got {np.dtype(dtype)}")
    return np.dtype(dtype)


def with_gains(law: Law, gains: AnyGains) -> Law:
    """Return a law with some of its gains replaced, by name; those of the joint loop are no part of it.

    Raises:
        ValueError: a name that it does not have.
    """
    values = {name: value for name, value in _values_by_name(law, gains).items() if name in law.GAINS}
    return dataclasses.replace(law, **values)


def has_gains_of_the_paper(law: Law) -> bool:
    """Tell whether a law's gains are those of `Gains`, as far as it has any."""
    return isinstance(law, PD) or set(law.GAINS) == set(Gains.AXES)


def recorded(scenario: Scenario, gains: AnyGains | None, resolved: WalkInputs) -> Gains | dict[str, AnyArray]:
    """Return the gains of a walk to be stored with it, six axes each where the law has those of the paper, or none.

    A law of translations leaves the rotations as they were given, or as the scenario has them.
    """
    law, parameters = resolved.law, resolved.parameters
    joint = {name: getattr(parameters.joint_loop, name) for name in JOINT_GAINS if name in _values_by_name(law, gains)}
    if not has_gains_of_the_paper(law):
        return {name: getattr(law, name) for name in law.GAINS} | joint
    place, six = gains if isinstance(gains, Gains) else scenario.control, {}
    for name in Gains.AXES:
        six[name] = np.array(np.broadcast_to(np.asarray(getattr(place, name), parameters.gravity.dtype), 6))
        own = getattr(law, name, six[name])
        six[name][: own.size] = own
    return Gains(**six, **joint)


def checked(component: AnyComponent, kind: type[Any]) -> AnyComponent:
    """Return a law, contact, actuator or disturbance as it is.

    Raises:
        ValueError: no instance of the kind.
        ConfigError: a field that cannot be hashed: the program is compiled for its value.
    """
    what = kind.__name__.lower()
    if not isinstance(component, kind):
        made = (
            f"; {component.__name__}() makes one" if isinstance(component, type) and issubclass(component, kind) else ""
        )
        expected = f"an instance of a class that inherits from mjx_climb.{kind.__name__}"
        raise ValueError(f"{what}: expected {expected}, got {component!r}{made}")
    for field in dataclasses.fields(component):
        if field.name not in component.VALUES and "tree" not in field.metadata:
            value = getattr(component, field.name)
            try:
                hash(value)
            except TypeError:
                expected = "a value that can be hashed, as a tuple, or one made by mjx_climb.gain or parameter"
                raise ConfigError(type(component).__name__, field.name, expected, repr(value)) from None
    return component


def by_name(gains: AnyGains) -> dict[str, AnyArray]:
    """Return gains as a mapping, without those that are not given."""
    if isinstance(gains, Law):
        return {name: getattr(gains, name) for name in gains.GAINS}
    values = gains if isinstance(gains, Mapping) else vars(gains)
    return {name: value for name, value in values.items() if value is not None}


def _values_by_name(law: Law, gains: AnyGains | None, what: str = "gains") -> dict[str, AnyArray]:
    """The values given, by name; values of six axes are cut to the translations for a law of three."""
    values = dict(gains or {}) if isinstance(gains, Mapping | None) else by_name(gains)
    values = {name: real_numbers(f"{what}.{name}", value) for name, value in values.items()}
    known = [*law.GAINS, *JOINT_GAINS]
    if values.keys() >= Gains.AXES.keys():  # those of the paper, others beside them or not
        for name, field in law.GAINS.items():
            if field.shape == (3,) and jnp.ndim(values.get(name, 0.0)) and jnp.shape(values[name])[-1] == 6:
                values[name] = values[name][..., :3]
        known += Gains.AXES if isinstance(law, PD) else ()
    if unknown := [name for name in values if name not in known and name not in GAIT]:
        names = f"{', '.join(known)}, the gains of {type(law).__name__}"
        raise ValueError(f"{what}.{unknown[0]}: expected one of {names}")
    return values


def resolved_directions(resolved: WalkInputs, gains: AnyGains | None, directions: AnyGains) -> dict[str, np.ndarray]:
    """Return rates of gains (k, *batch, n) by name as (*batch, k, n), without the last axis where a gain is one number.

    Raises:
        ValueError: in one line, `kp`, `kd` or `ki` in one of two `Gains` alone, a time of the gait that changes, or
            another shape.
    """
    if isinstance(gains, Gains) and isinstance(directions, Gains):
        for name, rates in vars(directions).items():
            if (getattr(gains, name) is None) != (rates is None):
                so = f"rates of change, as gains.{name} is given" if rates is None else f"None, as gains.{name} is"
                raise ValueError(f"directions.{name}: expected {so}, got {'None' if rates is None else 'rates'}")
    law, shape, dtype, found = resolved.law, resolved.shape, resolved.parameters.gravity.dtype, {}
    given = {name: rates for name, rates in _values_by_name(law, directions, "directions").items()}
    for key in TIMES:
        if np.any(given.pop(key, 0.0)):
            raise ValueError(f"directions.{key}: expected none, as it is counted in whole time steps")
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys([*JOINT_GAINS, *GAIT], ())
    shapes |= {name: field.lengths for name, field in law.GAINS.items()}
    count = max([np.shape(rates)[0] for rates in given.values() if np.ndim(rates)], default=1)
    values = resolved.parameters.values
    held = {n: values[p] for n in shapes if (p := path_of_gain(n)) in resolved.called}
    held |= {name: getattr(law, name) for name in law.GAINS}
    batched = max([np.ndim(value) - len(shapes[name]) for name, value in held.items()], default=0)
    for name in (name for name in given if name in shapes):
        value, own = np.asarray(given[name], dtype), shapes[name]
        axes, whole = 1 + batched + len(own), (*shape, *own)
        if value.ndim < axes or value.shape[0] != count or not broadcasts(value.shape[1:], whole):
            expected = f"shape {(count, *whole)}{', or axes of 1 behind the first' if whole else ''}"
            raise ValueError(f"directions.{name}: expected {expected}, got {value.shape}")
        (number, *batch) = value.shape[: value.ndim - len(own)]
        value = np.broadcast_to(value, (number, *batch, *own))
        value = value.reshape(number, *[1] * (len(shape) - len(batch)), *batch, *own)
        found[name] = np.moveaxis(np.broadcast_to(value, (number, *shape, *own)), 0, len(shape))
    # where the law has none of these gains nothing moves
    return found or {"kp": np.zeros((*shape, len(next(iter(given.values())))), dtype)}
