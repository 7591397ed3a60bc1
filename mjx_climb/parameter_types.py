"""Gains and parameters: the values that may differ from one robot of a batch to the next."""
# ruff: noqa: RUF009 (fields carry their keys and units)

import dataclasses
import difflib
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import numpy as np
from jax import Array
from jaxtyping import Real

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.component import Component
from mjx_climb.scenario.values import MAX_GRAVITY
from mjx_climb.value_field import POSITIVE, ValueField

# batch axes of one gain need not be those of another: they broadcast
_Values = Array | np.ndarray
_Gain = Real[_Values, ""] | Real[_Values, "... 1"] | Real[_Values, "... 6"] | float
_JointGain = Real[_Values, "..."] | float
_Scalar = Real[_Values, "..."]
ROUNDING = 2.0**-21  # of a number of steps: the error of single precision


def _of(unit: str, long_name: str, default: object = dataclasses.MISSING) -> Any:
    return dataclasses.field(metadata={"unit": unit, "long_name": long_name}, default=default)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains of the admittance law (paper Eqs. 2 and 3): scalar, six axes, or a batch of six axes.

    Axes: three translations, then three rotations, about the axes of the walk (x ahead, z up). The end-effector law
    uses the translations. `kp`, `kd`, `ki` and `safe_kp` replace the scenario's joint gains where given.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({"inertia": 1, "damping": 1, "stiffness": 1})

    inertia: _Gain = _of("kg, kg m^2", "virtual inertia M")
    damping: _Gain = _of("N s/m, N m s/rad", "virtual damping D")
    stiffness: _Gain = _of("N/m, N m/rad", "virtual stiffness K")
    kp: _JointGain | None = _of("N m/rad", "joint gain kp", default=None)
    kd: _JointGain | None = _of("N m s/rad", "joint gain kd", default=None)
    ki: _JointGain | None = _of("N m/(rad s)", "joint gain ki", default=None)
    safe_kp: _JointGain | None = _of("N m/rad", "joint gain kp without a sensor", default=None)


# unit and meaning of the gains of the paper and of the joint loop
GAIN_UNITS = {field.name: (field.metadata["unit"], field.metadata["long_name"]) for field in dataclasses.fields(Gains)}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Parameters:
    """Every number of a walk, SI units: a tree of components, whose values have any leading batch axes.

    Each value has a path, the key of a config: "contact.stiffness", "hardware.servo.armature".
    Arrays of JAX, or of NumPy, which keep double precision under any setting of JAX.
    """

    VALUES: ClassVar[Mapping[str, ValueField]] = MappingProxyType(
        {
            "gravity": ValueField("m/s^2", (3,), (-MAX_GRAVITY, MAX_GRAVITY), long_name="gravity, world axes"),
            "mass_scale": ValueField("1", (), POSITIVE, long_name="scale of the robot's masses and inertias"),
        }
    )
    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({"gravity": 1})

    gravity: Real[_Values, "... 3"]  # (3,) m/s^2
    mass_scale: _Scalar  # the cargo's not
    # components, of any class that has the seam's methods
    contact: Any  # `Contact`
    drive: Any  # `Actuator`
    joint_loop: Any  # `JointLoop`
    force_sensor: Any  # `ForceSensors`
    base_estimate: Any  # `BaseEstimate`
    bus: Any  # `Bus`
    gait: Any  # `PeriodicGait`
    ground: Any  # `Ground`
    disturbances: tuple[Any, ...]  # `Disturbance`s: cargo, pushes, and others
    footholds: Any = None  # `Footholds`, the choice among the holds; None: the planned ones
    recovery: Any = None  # None: nothing interrupts the gait
    waiting: Any = None  # None: the gait does not wait for grips

    @property
    def components(self) -> dict[str, Component]:
        """The components by their sections of a config, those within others after these."""
        found: dict[str, Component] = {}
        for place, each in _named(self).items():
            found[place] = each
            found |= {f"{place}.{name}": part for name, part in vars(each).items() if isinstance(part, Component)}
        return found

    @property
    def paths(self) -> dict[str, ValueField]:
        """The declaration of each value, by its path."""
        own = {
            f"{place}.{name}": field for place, each in self.components.items() for name, field in each.VALUES.items()
        }
        return {**self.VALUES, **own}

    @property
    def values(self) -> dict[str, AnyArray]:
        """The values by their paths."""
        own = {
            f"{place}.{name}": getattr(each, name) for place, each in self.components.items() for name in each.VALUES
        }
        return {**{name: getattr(self, name) for name in self.VALUES}, **own}

    @property
    def units(self) -> dict[str, tuple[str, str]]:
        """Unit and meaning of each value, by its path."""
        return {path: (field.unit, field.long_name or path) for path, field in self.paths.items()}

    def at(self, path: str) -> AnyArray:
        """The value at a path.

        Raises:
            ValueError: no such path.
        """
        values = self.values
        if path not in values:
            raise ValueError(_unknown(path, values))
        return values[path]

    def replace(self, values: Mapping[str, Any]) -> "Parameters":
        """Parameters with other values, with any batch axes, at some paths.

        Gains that registers hold follow the torque at standstill, `hardware.servo.torque_limit`.

        Raises:
            ValueError: no such path.
        """
        limit = f"{SECTIONS['drive']}.torque_limit"
        if limit in values and getattr(self.drive, "in_registers", False):
            by = values[limit] / self.at(limit)
            gains = {f"{SECTIONS['joint_loop']}.{name}": name for name in self.joint_loop.VALUES}
            values = {path: getattr(self.joint_loop, name) * by for path, name in gains.items()} | dict(values)
        return self.replace_alone(values)

    def replace_alone(self, values: Mapping[str, Any]) -> "Parameters":
        """`replace`, without changes that follow from the values.

        Raises:
            ValueError: no such path.
        """
        known = self.paths
        changes: dict[str, dict[str, Any]] = {}
        for path, value in values.items():
            if path not in known:
                raise ValueError(_unknown(path, known))
            place, _, name = path.rpartition(".")
            changes.setdefault(place, {})[name] = value
        own = changes.pop("", {})
        changed = dataclasses.replace(self, **own) if own else self

        def change(place: str, each: Component) -> Component:
            return dataclasses.replace(each, **changes[place]) if place in changes else each  # type: ignore[type-var]

        return changed.with_components(change) if changes else changed

    def with_components(self, change: Callable[[str, Component], Component]) -> "Parameters":
        """Parameters with each component replaced by the result of `change` for its section and itself."""
        changed: dict[str, Component] = {}
        for place, each in _named(self).items():
            new = {n: change(f"{place}.{n}", part) for n, part in vars(each).items() if isinstance(part, Component)}
            changed[place] = change(place, dataclasses.replace(each, **new) if new else each)  # type: ignore[type-var]
        disturbances = tuple(each for place, each in changed.items() if place.startswith(f"{_DISTURBANCE}."))
        single: dict[str, Any] = {name: changed[place] for name, place in SECTIONS.items() if place in changed}
        return dataclasses.replace(self, **single, disturbances=disturbances)


SECTIONS: Mapping[str, str] = MappingProxyType(  # of a config, by the field of `Parameters` that has its values
    {
        "contact": "contact",
        "drive": "hardware.servo",
        "joint_loop": "control",
        "force_sensor": "hardware.force_sensor",
        "base_estimate": "hardware.base_estimate",
        "bus": "hardware",
        "gait": "gait",
        "ground": "ground",
        "footholds": "gait.footholds",
        "recovery": "control.recovery",
        "waiting": "gait.waiting",
    }
)
_DISTURBANCE = "disturbance"


def _named(parameters: Parameters) -> dict[str, Component]:
    """Return the components by their sections."""
    single = ((place, getattr(parameters, name)) for name, place in SECTIONS.items())
    found: dict[str, Component] = {place: each for place, each in single if each is not None}
    counts: dict[str, int] = {}
    for each in parameters.disturbances:
        group = getattr(each, "GROUP", "others")
        number = counts[group] = counts.get(group, -1) + 1
        alone = number == 0 and not getattr(each, "LISTED", True)
        found[f"{_DISTURBANCE}.{group}" if alone else f"{_DISTURBANCE}.{group}.{number}"] = each
    return found


def _unknown(path: str, known: Collection[str]) -> str:
    """Return the refusal of a path that is not there."""
    near = difflib.get_close_matches(path, known, 3, 0.5) or list(known)[:5]
    return f"{path}: expected a path of the parameters, as {', '.join(near)}"


def path_of_gain(name: str) -> str:
    """Return the path of a gain that no law has: one of the joint loop by its name, or one of the gait by its key."""
    return name if "." in name else f"{SECTIONS['joint_loop']}.{name}"


def whole_steps(seconds: AnyArray, time_step: float) -> AnyArray:
    """Return the whole number of time steps nearest to each time in s, of two the larger; arrays of JAX or of NumPy.

    A time below half a step by no more than the rounding of single precision counts as half a step.
    """
    steps = seconds / time_step + 0.5
    return namespace(steps).floor(steps + _slack(steps))


def stance_steps(duty: AnyArray, cycle_steps: AnyArray) -> AnyArray:
    """Return for how many steps of a cycle a limb stands: rounded up, so that limbs in turn never swing together."""
    steps = duty * cycle_steps
    return namespace(steps).ceil(steps - _slack(steps))


def _slack(steps: AnyArray) -> AnyArray:
    # rounding grows with the number of steps, and is never as much as an eighth of one
    return namespace(steps).minimum(steps * ROUNDING, 0.125)


def with_whole_steps(parameters: Parameters, time_step: float) -> Parameters:
    """Return parameters whose gait, windows and control period are whole time steps, counted in double precision.

    A walk in any precision finds the same numbers of steps in them. Values that JAX traces stay as they are, but for
    the windows of disturbances, along which nothing has a derivative.
    """
    values = parameters.values
    names = [path for path, field in parameters.paths.items() if field.in_steps]
    known: dict[str, Any] = {p: np.asarray(values[p], np.float64) for p in names if not is_tracer(values[p])}
    known |= {path: values[path] for path in names if path.startswith(_DISTURBANCE) and path not in known}
    steps = {path: whole_steps(value, time_step) for path, value in known.items()}
    changed = {path: count * time_step for path, count in steps.items()}
    if "gait.cycle" in steps and not is_tracer(duty := values["gait.duty"]):
        cycle = steps["gait.cycle"]
        changed["gait.duty"] = stance_steps(np.asarray(duty, np.float64), cycle) / np.maximum(cycle, 1)
    return parameters.replace(changed)


def is_tracer(value: object) -> bool:
    """Tell whether JAX traces a value."""
    return isinstance(value, jax.core.Tracer)
