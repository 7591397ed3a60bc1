"""The variables of a fit: keys of a scenario and of its robot, each with nominal value, prior, bounds and coordinate.

A fit moves in coordinates: the logarithm of positive values, the value itself of others. An
inertia moves in log-Cholesky coordinates of the body's mass distribution: with mass m, centre c and an upper
triangular A (diagonal exp(d)), `A A^T` is the second moment about the centre over m, so that every point is a body that
can exist (Rucker and Wensing, Smooth Parameterization of Rigid-Body Inertia, 2022).
"""

import dataclasses
import fnmatch
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.own_objects import load
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_to_matrix, turn_about_z
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError, did_you_mean
from mjx_climb.value_field import ValueField

FACTOR = 1.0  # prior sd of a logarithm: a factor of e, 7 at two sd
_SCALES = {  # prior sd by unit, of values that may be zero; the nominal value where that is larger
    "kg m^2": 0.02, "N m": 0.2, "N m s/rad": 0.2, "rad": 0.02, "s": 0.01, "N": 1.0, "1": 0.3, "N s/m": 50.0, "m": 0.01,
    "Ohm": 0.5,
}  # fmt: skip
_LONGEST = 0.02  # s, bound of a delay that is fitted, where the nominal one is not near it
_TILT = 0.1  # rad
_JOINT = {"armature": "kg m^2", "friction": "N m", "damping": "N m s/rad", "zero": "rad"}
_CENTER = ("center.x", "center.y", "center.z")
_INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of these in A and in the inertia
_AS_DELAY = "as a delay: fit hardware.command_delay"
_BY_STEPS = {  # keys without a derivative, and their effect on a log
    "hardware.control_period": _AS_DELAY,
    "hardware.servo.rate": _AS_DELAY,
    "hardware.force_sensor.resolution": "as noise",
}
_OTHERS = (  # keys whose values no log of joint commands tells
    "gait.", "disturbance.", "contact.capture_distance", "hardware.seed", "hardware.base_estimate.",
    "hardware.force_sensor.noise", "hardware.force_sensor.drift", "control.safe_kp",
)  # fmt: skip
Change = Callable[[Any, Parameters, Robot], tuple[Parameters, Robot]]  # pure, of a value in SI units
ON_GROUND = ("contact.", "hardware.force_sensor.", "robot.base.", "log.")  # a robot on a stand does not tell them


@dataclasses.dataclass(frozen=True)
class Variable:
    """One number that is fitted; SI units but for `mean` and `sd`, which are of the coordinate."""

    key: str
    unit: str
    nominal: float
    mean: float  # of the prior
    sd: float
    lower: float
    upper: float
    log: bool = False  # the coordinate is the logarithm
    frozen: bool = False  # held at the nominal value
    limb: int | None = None  # the one limb that it moves, where there is one
    beside: bool = False  # not asked for: no line says that it is not told
    change: Change | None = None  # of a variable of the user's own; the nominal value changes nothing

    @property
    def place(self) -> "Place":
        """The static part of it in a compiled fit."""
        return Place(self.key, self.log, self.change)

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the coordinate."""
        with np.errstate(divide="ignore"):
            low, high = np.log([self.lower, self.upper]) if self.log else (self.lower, self.upper)
        return float(low), float(high)

    @property
    def has_value(self) -> bool:
        """Whether there is a value to begin at: a finite one, a positive one where the coordinate is its logarithm."""
        return math.isfinite(self.nominal) and not (self.log and self.nominal <= 0)

    def bound_at(self, x: float) -> str:
        """Return which bound a coordinate is on, lower or upper, "" for none."""
        on = [np.isfinite(bound) and abs(x - bound) < 1e-6 * self.sd for bound in self.bounds]
        return "lower" if on[0] else "upper" if on[1] else ""


class Place(NamedTuple):
    """The static part of a variable in a compiled fit."""

    key: str
    log: bool
    change: Change | None = None


class _Body(NamedTuple):
    """The base or a link."""

    mass: Any  # () kg
    center: Any  # (3,) m, in the frame of the link, or in that of the base as its file has it
    inertia: Any  # (3, 3) kg m^2 about the centre


def variables(
    scenario: mc.Scenario,
    asked: Sequence[str | Variable],
    *,
    held: bool,
    changes: Mapping[str, Mapping[str, Any]] | None = None,
) -> tuple[Variable, ...]:
    """Return the variables of the keys that are asked for, in their order, each once.

    Arguments:
        scenario: its values are nominal; its robot's file is the prior of the robot's.
        asked: keys, or patterns of keys as `robot.*.armature`; `robot.LF.femur` stands for all of this link. A pattern
            is of keys that have a value, and that such a log tells. FILE.py:NAME is a variable of the user's own.
        held: whether the base was held.
        changes: fields of a `Variable` that replace its own, by key.

    Raises:
        ConfigError: no such key, with the nearest ones; or one that such a log cannot tell.
    """
    known = {each.key: each for each in _all(scenario)}
    found: dict[str, Variable] = {}
    for key in asked:
        if isinstance(key, Variable) or ".py:" in key:
            own = key if isinstance(key, Variable) else _loaded(key)
            if own.key in known or own.key in found:
                named = key if isinstance(key, str) else own.key
                raise ConfigError("", f"--fit {named}", "a key of its own", own.key)
            found[own.key] = own
            continue
        if key in _BY_STEPS:
            got = f"one that works by steps (on a log it acts {_BY_STEPS[key]})"
            raise ConfigError("", f"--fit {key}", "a key with a derivative", got)
        keys = [k for k in known if fnmatch.fnmatchcase(k, key) or k.startswith(f"{key}.")]
        grounded = [k for k in keys if held and k.startswith(ON_GROUND)]
        if key not in known:  # a pattern is of keys that such a log tells, with a value to begin at
            keys = [k for k in keys if k not in grounded and known[k].has_value] or keys
        if not keys:
            meant = did_you_mean(key, [*known, *(k.rpartition(".")[0] for k in known)], 3, 0.5)
            raise ConfigError("", f"--fit {key}", "a key that can be fitted", f"an unknown one{meant}")
        if grounded and grounded[0] in keys:
            got = f"{grounded[0]}; a log with base or foot forces of a gripped robot tells it (--base free)"
            raise ConfigError("", f"--fit {key}", "a key that a robot on a stand can tell", got)
        found |= {k: known[k] for k in keys}
    for key, how in (changes or {}).items():
        if key not in found:
            raise ConfigError("", key, f"one of the keys that are fitted, {', '.join(found)}")
        found[key] = dataclasses.replace(found[key], **how)
    for each in found.values():
        if not each.has_value:
            null = math.isinf(each.nominal)
            got = f"null (--set {each.key}=NUMBER)" if null else f"{each.nominal:g}"
            where = "config" if null else "robot"
            raise ConfigError("", f"--fit {each.key}", f"a value in the {where} to begin at", got)
    return tuple(each for each in found.values() if not each.frozen)


def _loaded(text: str) -> Variable:
    made, file, name = load(text, "variable")
    if not isinstance(made, Variable) or made.change is None:
        raise ConfigError(file, "", f"{name} to be a Variable with a change", f"{made!r}")
    return made


def _all(scenario: mc.Scenario) -> Iterator[Variable]:
    own, robot = own_parameters(scenario), load_robot(scenario.robot)
    for path, field in own.paths.items():
        if "." in path and field.shape == () and not path.startswith((*_BY_STEPS, *_OTHERS)):
            yield _of_scenario(path, field, float(np.asarray(own.at(path))), scenario.time_step)
    for axis in "xy":
        yield Variable(f"gravity.tilt_{axis}", "rad", 0.0, 0.0, _TILT, -1.0, 1.0)
    for each in _of_body(_body(robot, ("base",))):
        yield dataclasses.replace(each, key=f"robot.base.{each.key}")
    for n, limb in enumerate(robot.limbs):
        yield from _of_sensor(f"log.{limb}.force", n)
        for j, joint in enumerate(robot.joint_names):
            for each in (*_of_joint(robot, n, j), *_of_body(_body(robot, (limb, joint)))):
                yield dataclasses.replace(each, key=f"robot.{limb}.{joint}.{each.key}", limb=n)


def _of_sensor(place: str, limb: int) -> Iterator[Variable]:
    """Yield the errors of a logged force on a foot: share of it, offset, and share of another axis."""
    yield Variable(f"{place}.gain", "1", 1.0, 1.0, 0.2, 0.1, 10.0, limb=limb)
    for axis in "xyz":
        yield Variable(f"{place}.zero.{axis}", "N", 0.0, 0.0, 2.0, -math.inf, math.inf, limb=limb)
        for other in "xyz".replace(axis, ""):
            yield Variable(f"{place}.{other}_in_{axis}", "1", 0.0, 0.0, 0.05, -1.0, 1.0, limb=limb)


def _positive(key: str, unit: str, nominal: float, sd: float = FACTOR) -> Variable:
    # without a value there is no unit to count in: `variables` refuses it
    mean = math.log(nominal) if 0 < nominal < math.inf else math.nan
    return Variable(key, unit, nominal, mean, sd, nominal * 1e-3, nominal * 1e3, log=True)


def _linear(key: str, unit: str, nominal: float, lower: float, upper: float = math.inf) -> Variable:
    return Variable(key, unit, nominal, nominal, max(abs(nominal), _SCALES.get(unit, 1.0)), lower, upper)


def _of_scenario(key: str, field: ValueField, nominal: float, time_step: float) -> Variable:
    lower, upper = (math.inf * np.sign(end) if abs(end) == sys.float_info.max else end for end in field.bounds)
    if lower > 0:
        found = _positive(key, field.unit, nominal)
        return dataclasses.replace(found, lower=max(found.lower, lower), upper=min(found.upper, upper))
    if field.unit == "s":
        upper = max(2 * nominal, _LONGEST, 2 * time_step)
    return _linear(key, field.unit, nominal, lower, upper)


def _of_joint(robot: Robot, limb: int, joint: int) -> Iterator[Variable]:
    for name, unit in _JOINT.items():
        if name == "zero":
            yield Variable(name, unit, 0.0, 0.0, 0.05, -0.5, 0.5)
        else:
            values = getattr(robot, name)
            yield _linear(name, unit, 0.0 if values is None else float(values[limb, joint]), 0.0)


def _of_body(body: _Body) -> Iterator[Variable]:
    yield _positive("mass", "kg", float(body.mass), 0.3)
    for axis, value in zip(_CENTER, body.center, strict=True):
        yield Variable(axis, "m", float(value), float(value), 0.02, -math.inf, math.inf)
    spread = _cholesky(body)
    for name, (row, column) in zip(_INERTIA, _PLACES, strict=True):
        log, key = row == column, f"inertia.{name}"
        mean = float(np.log(spread[row, row])) if log else float(spread[row, column])
        sd = 0.3 if log else 0.3 * float(spread[row, row])
        # bounds of the coordinate, which is none of the value's
        yield Variable(key, "kg m^2", float(body.inertia[row, column]), mean, sd, -math.inf, math.inf)


def _body(robot: Robot, place: tuple[str, ...]) -> _Body:
    """Return the base, by ("base",), or a link, by the names of its limb and joint."""
    if place == ("base",):
        return _Body(robot.base_mass, np.zeros(3), robot.base_inertia)
    at = _at(robot, place)
    return _Body(robot.link_mass[at], robot.link_center[at], robot.link_inertia[at])


def _at(robot: Robot, place: tuple[str, ...]) -> tuple[int, int]:
    return robot.limbs.index(place[0]), robot.joint_names.index(place[1])


def _cholesky(body: _Body) -> np.ndarray:
    """Return the upper triangular A of a body, (3, 3) m: `A A^T` is the second moment over the mass."""
    moment = (0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia) / body.mass
    least = 1e-9 * np.trace(moment)  # a flat or thin body: as thick as rounding
    lower = np.asarray(np.linalg.cholesky(moment[::-1, ::-1] + least * np.eye(3)))
    return np.ascontiguousarray(lower[::-1, ::-1])


# --------------------------------------------------------------------------------------------- coordinates to a model


def begin(chosen: Sequence[Variable]) -> np.ndarray:
    """Return the coordinates (n,) of the nominal values, inside the bounds."""
    point = [v.mean if ".inertia." in v.key else math.log(v.nominal) if v.log else v.nominal for v in chosen]
    return np.asarray(np.clip(point, *np.reshape([v.bounds for v in chosen], (-1, 2)).T))


def applied(places: Sequence[Place], point: Array, parameters: Parameters, robot: Robot) -> tuple[Parameters, Robot]:
    """Return parameters and robot at a point (n,) of coordinates; the robot's own are constants of NumPy."""
    values, known = _values(places, point), parameters.paths
    changes: dict[str, Any] = {key: value for key, value in values.items() if key in known}
    tilt = [values.get(f"gravity.tilt_{axis}") for axis in "xy"]
    if any(angle is not None for angle in tilt):
        zero = jnp.zeros_like(point[0])
        turn = quaternion_from_rotation_vector(jnp.stack([zero if t is None else t for t in tilt] + [zero]))
        changes["gravity"] = quaternion_to_matrix(turn) @ jnp.asarray(parameters.gravity)
    parameters, robot = parameters.replace(changes), _robot_at(values, robot)
    for place in places:
        if place.change is not None:
            parameters, robot = place.change(values[place.key], parameters, robot)
    return parameters, robot


def with_all(
    chosen: Sequence[Variable], value: Callable[[Variable], float], parameters: Parameters, robot: Robot
) -> tuple[Parameters, Robot]:
    """Return parameters and robot with values that are far from zero, so that all stages of hardware are there."""
    known = parameters.paths
    changes = {v.key: np.asarray(value(v)) for v in chosen if v.key in known}
    of_joints = {v.key.rpartition(".")[2] for v in chosen if v.key.startswith("robot.")} & {"friction", "damping"}
    full: Any = dict.fromkeys(of_joints, np.ones_like(robot.link_mass))
    found = parameters.replace(changes), dataclasses.replace(robot, **full)
    for each in chosen:
        found = found if each.change is None else each.change(value(each), *found)
    both: tuple[Parameters, Robot] = jax.tree.map(np.asarray, found)
    return both


def _values(places: Sequence[Place], point: Array) -> dict[str, Array]:
    return {place.key: jnp.exp(x) if place.log else x for place, x in zip(places, point, strict=True)}


def _robot_at(values: Mapping[str, Array], robot: Robot) -> Robot:
    own: dict[tuple[str, ...], dict[str, Array]] = {}  # by body
    for key, value in values.items():
        if key.startswith("robot."):
            place, name = _parted(key)
            own.setdefault(place, {})[name] = value
    changes: Any = {}
    for name in _JOINT:
        if there := {_at(robot, place): each[name] for place, each in own.items() if name in each}:
            field = "frame_rotation" if name == "zero" else name
            before = jnp.asarray(robot.link_mass * 0.0 if getattr(robot, field) is None else getattr(robot, field))
            if name == "zero":
                there = {at: turn_about_z(before[at], angle) for at, angle in there.items()}
            changes[field] = _with(before, there)
    bodies = {place: _body_at(each, _body(robot, place)) for place, each in own.items() if set(each) - set(_JOINT)}
    if (base := bodies.pop(("base",), None)) is not None:
        frames = jnp.asarray(robot.frame_position)  # the base's sits at its centre of mass, so that the hips move
        changes["frame_position"] = jnp.concatenate([frames[:, :1] - base.center, frames[:, 1:]], axis=1)
        changes |= {"base_mass": base.mass, "base_inertia": base.inertia}
    for name in _Body._fields if bodies else ():
        there = {_at(robot, place): getattr(body, name) for place, body in bodies.items()}
        changes[f"link_{name}"] = _with(jnp.asarray(getattr(robot, f"link_{name}")), there)
    return dataclasses.replace(robot, **changes)


def _parted(key: str) -> tuple[tuple[str, ...], str]:
    """The body of a robot's key, as `_body` takes it, and the name of its value."""
    _, *place, name = key.split(".", 2 if key.startswith("robot.base.") else 3)
    return tuple(place), name


def _with(before: Array, there: Mapping[tuple[int, int], Any]) -> Array:
    """Return an array (N, M, ...) with other values in some places, by stacking: a kernel's regions cannot scatter."""
    rows = [[there.get((n, m), each) for m, each in enumerate(row)] for n, row in enumerate(before)]
    return jnp.stack([jnp.stack(row) for row in rows])


def _body_at(own: Mapping[str, Array], body: _Body) -> _Body:
    """Return a body with other values; a mass alone scales the inertia with it."""
    mass = own.get("mass", jnp.asarray(body.mass))
    center = jnp.stack([own.get(name, jnp.asarray(body.center)[n]) for n, name in enumerate(_CENTER)])
    found = {at: own[key] for name, at in zip(_INERTIA, _PLACES, strict=True) if (key := f"inertia.{name}") in own}
    found = {at: jnp.exp(value) if at[0] == at[1] else value for at, value in found.items()}
    factor = _with(jnp.asarray(_cholesky(body), mass.dtype), found)
    moment = factor @ factor.T
    return _Body(mass, center, mass * (jnp.trace(moment) * jnp.eye(3, dtype=moment.dtype) - moment))


def in_units(chosen: Sequence[Variable], point: Array, robot: Robot) -> Array:
    """Return the values (n,) in SI units of a point of coordinates; those of an inertia about the link's centre."""
    found, at_point = [], _robot_at(_values([v.place for v in chosen], point), robot)
    for variable, x in zip(chosen, point, strict=True):
        if ".inertia." in variable.key:
            place, name = _parted(variable.key)
            found.append(_body(at_point, place).inertia[_PLACES[_INERTIA.index(name[-2:])]])
        else:
            found.append(jnp.exp(x) if variable.log else x)
    return jnp.stack(found)
