"""The base of control laws: a law is an object whose fields are its gains, with a state at the start and one step.

```python
class Damped(mjx_climb.Law):
    damping: Array = mjx_climb.gain("N s/m", length=3, bounds=(1.0, 1e5), default=5e3)

    def init(self, start): ...
    def step(self, state, measured, reference): ...
```
"""

import abc
import dataclasses
import functools
import inspect
import operator
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, dataclass_transform

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from mjx_climb.component import Component
from mjx_climb.execution import reached
from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_multiply, quaternion_to_matrix
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.value_field import ValueField, value_field

LONG = 1e3  # s, the times of a reference whose limbs are not said to swing


class Measurement(NamedTuple):
    """Readings of the robot's sensors, and the base pose that it estimates from them; world axes."""

    base_position: Array  # (3,) m, of the base's centre of mass
    base_orientation: Array  # (4,) wxyz, base to world
    base_linear_velocity: Array  # (3,) m/s, of the base's centre of mass
    base_angular_velocity: Array  # (3,) rad/s
    foot_force: Array  # (limb, 3) N, of the ground on the foot
    wrench: Array  # (6,) N, N m: `w = J_b^T F_e`, moments about the base's centre of mass
    support: Array  # (limb,) bool: the gripper is shut and holds
    joint_angles: Array | float = 0.0  # (limb, joint) rad, of the servos' encoders
    joint_rates: Array | float = 0.0  # (limb, joint) rad/s
    joint_torque: Array | float = 0.0  # (limb, joint) N m, of the motors in the time step before, from their current
    forces_known: Array | bool = True  # () bool: no force sensor is dead; where one is, all forces and the wrench are 0
    foot_lever: Array | float = 0.0  # (limb, 3) m, base axes: from its centre of mass to the feet, by the encoders


# fields of a measurement by the sensor that they come from
SENSORS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "forces": ("foot_force", "wrench", "forces_known"),
        "base pose": ("base_position", "base_orientation", "base_linear_velocity", "base_angular_velocity"),
        "joint angles": ("joint_angles", "joint_rates", "foot_lever"),
        "joint efforts": ("joint_torque",),
    }
)


class Reference(NamedTuple):
    """The gait's targets; world axes."""

    base_position: Array  # (3,) m, of the base's centre of mass
    base_orientation: Array  # (4,) wxyz, base to world: the axes of the reference
    foot_position: Array  # (limb, 3) m
    until_lift_off: Array | float = LONG  # (limb,) s, until the gripper opens next; 0 in a swing
    since_touchdown: Array | float = LONG  # (limb,) s, since the gripper shut last; 0 in a swing


class JointGains(NamedTuple):
    """By how much a law multiplies the joint loop's gains, limb by limb; None: not at all."""

    kp: Array  # (limb,) 1
    kd: Array | None = None  # (limb,) 1
    ki: Array | None = None  # (limb,) 1

    @property
    def moved(self) -> dict[str, Array]:
        """The factors by name, of the gains that are not left alone."""
        return {name: factor for name, factor in self._asdict().items() if factor is not None}


class Command(NamedTuple):
    """Targets for the inverse kinematics, world axes, and the shift that led to them."""

    base_position: Array  # (3,) m, of the base's centre of mass
    base_orientation: Array  # (4,) wxyz, base to world
    foot_position: Array  # (limb, 3) m
    base_displacement: Array  # (6,) m, rad: the law's shift of the base, reference axes
    joint_gains: JointGains | None = None  # None: the joint loop's own


class Start(NamedTuple):
    """Knowledge of a law before its first step."""

    period: float | Array  # () s, from one step of the law to the next
    reference: Reference  # at the start
    joint_angles: Array | None = None  # (limb, joint) rad; None: not known
    weight: Array | float = 0.0  # (3,) N, world axes, of the robot without cargo, as its file has it
    # (limb, 3, 3) m/N, base axes: of a foot, by the joint loop's stiffness, `J kp^-1 J^T`
    compliance: Array | float = 0.0


def shifted(reference: Reference, displacement: Array, turn: Array | None = None) -> Command:
    """Return the reference with its base shifted by `displacement` (6,) m, rad, along the axes of the reference.

    Its last three values are a rotation vector, unless the quaternion `turn` (4,) says how the base is turned.
    """
    turn = quaternion_from_rotation_vector(displacement[3:]) if turn is None else turn
    return Command(
        base_position=reference.base_position + quaternion_to_matrix(reference.base_orientation) @ displacement[:3],
        base_orientation=quaternion_multiply(reference.base_orientation, turn),
        foot_position=reference.foot_position,
        base_displacement=displacement,
    )


def gain(
    unit: str,
    *,
    length: int = 6,
    shape: tuple[int, ...] | None = None,
    bounds: tuple[float, float],
    rotation_bounds: tuple[float, float] | None = None,
    default: object = dataclasses.MISSING,
    long_name: str = "",
    searched: bool = True,
) -> Any:
    """Return the field of a law that is one of its gains.

    Arguments:
        unit: as in "N s/m", or "N s/m, N m s/rad" where rotations have their own.
        length: 1, or 3 or 6 axes; a value is a scalar, which holds for all axes, or has them last, after a batch's.
        shape: in place of `length`, any: (12, 8) of the weights of a small network. A value has these axes last.
        bounds: where searches look, low and high. A gain must be above 0, unless `low` lets it be 0 or less.
        rotation_bounds: the bounds of the three rotations, where they are others.
        default: the value of a law that is made without one.
        long_name: for axes and tables; the field's own name where empty.
        searched: whether searches move the gain without being asked to.

    Raises:
        ValueError: a length other than 1, 3 and 6, or bounds that are not in order.
    """
    if length not in (1, 3, 6):
        raise ValueError(f"length of a gain: expected 1, 3 or 6, got {length}")
    own = ((length,) if length > 1 else ()) if shape is None else tuple(shape)
    return value_field(ValueField(unit, own, bounds, rotation_bounds, long_name, searched), default)


def scalar(unit: str, long_name: str, *, default: float, **more: Any) -> Any:
    """Return the field of a gain that is one number; the arguments are those of `gain`."""
    return gain(unit, length=1, default=default, long_name=long_name, **more)


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(gain, scalar, dataclasses.field))
class Law(Component, abc.ABC):
    """Base of control laws: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `gain` are its gains: swept, batched, differentiated, tuned. Any other field is part of the program:
    it must be hashable, and another value is compiled anew.

    `init` and `step` are written for one robot: a gain of length 1 is (), of length 3 or 6 (3,) or (6,). Outside a walk
    a gain may also be a scalar that holds for all axes, or have batch axes in front.
    """

    GAINS: ClassVar[Mapping[str, ValueField]] = MappingProxyType({})  # by name, in the order of the fields
    # gains that act on each limb for itself: (limb, length) works in their place, too
    LIMBWISE: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for name in {"kp", "kd", "ki", "safe_kp"} & cls.VALUES.keys():
            raise ValueError(f"{cls.__name__}.{name}: expected another name, this one is the joint loop's")
        cls.GAINS = cls.VALUES

    @abc.abstractmethod
    def init(self, start: Start) -> PyTree:
        """Return the state at the start: a pytree. Values that depend on the gains alone belong into it."""

    @abc.abstractmethod
    def step(self, state: PyTree, measured: Measurement, reference: Reference) -> tuple[PyTree, Command]:
        """Return the state after a step, of the same structure and shapes, and the robot's command."""

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches look, by gain and by `gain.rotation`, for steps of `period` s."""
        bounds = {name: field.bounds for name, field in self.GAINS.items()}
        rotations = {f"{name}.rotation": field.rotation_bounds for name, field in self.GAINS.items()}
        return bounds | {name: found for name, found in rotations.items() if found is not None}


class PD(Law):
    """The baseline: it commands the gait's own reference under any forces. It has no gains and no state."""

    def init(self, start: Start) -> tuple[()]:
        """Return no state."""
        return ()

    def step(self, state: tuple[()], measured: Measurement, reference: Reference) -> tuple[tuple[()], Command]:
        """Return the reference as it is."""
        return state, Command(*reference[:3], jnp.zeros_like(reference.base_position, shape=6))


class Beginning(NamedTuple):
    """Facts about a law before its first step."""

    state: PyTree
    reads: frozenset[str]  # names of `SENSORS` on which its step depends
    joint_gains: JointGains | None  # of its first command: ones; None: the law leaves them alone

    @property
    def reads_forces(self) -> bool:
        """Whether its step depends on foot forces or their wrench."""
        return "forces" in self.reads

    @property
    def reads_servos(self) -> bool:
        """Whether its step depends on reports of the joints' servos."""
        return bool(self.reads & {"joint angles", "joint efforts"})


def begin(law: Law, start: Start) -> PyTree:
    """Return the state of a law at the start of a walk, see `beginning`."""
    return beginning(law, start).state


def beginning(law: Law, start: Start) -> Beginning:
    """Return the state of a law at the start of a walk, as arrays, real ones in the precision of the reference.

    Raises:
        ConfigError: `step`, traced once, returns another structure, shape or type than `init`, or no `Command`.
    """
    position, _, feet = start.reference[:3]

    def as_array(leaf: ArrayLike) -> Array:
        try:
            array = jnp.asarray(leaf)
        except TypeError:
            expected = "a state of arrays and numbers"
            raise ConfigError(f"{type(law).__name__}.init", "", expected, f"{leaf!r}") from None
        # the type is given even where it is the same: an array of a Python number would be weakly typed
        return jnp.asarray(array, position.dtype if jnp.issubdtype(array.dtype, jnp.floating) else array.dtype)

    state = jax.tree.map(as_array, called(law, "init", start))
    joints = jnp.zeros_like(feet) if start.joint_angles is None else start.joint_angles
    measured = measurement_at(start.reference, joints)
    step = functools.partial(called, law, "step")
    program, found = jax.make_jaxpr(step, return_shape=True)(state, measured, start.reference)
    one, place = jnp.ones_like(feet[:, 0]), f"{type(law).__name__}.step"
    if not (isinstance(found, tuple) and len(found) == 2):
        raise ConfigError(place, "", "a pair of state and command", in_words(found))
    own = getattr(found[1], "joint_gains", None)
    gains = JointGains(**dict.fromkeys(own.moved, one)) if isinstance(own, JointGains) else None
    wanted = {"a state like that of init": state, "the command": Command(*start.reference[:3], measured.wrench, gains)}
    for (what, expected), got in zip(wanted.items(), found, strict=True):
        if jax.tree.flatten(own := in_words(expected)) != jax.tree.flatten(other := in_words(got)):
            raise ConfigError(place, "", f"{what}, {own}", other)

    def reads(names: Sequence[str]) -> bool:
        of_measured = [name in names for name in Measurement._fields]
        none = jax.tree.map(lambda _: False, (state, start.reference))
        return any(reached(program.jaxpr, jax.tree.leaves((none[0], of_measured, none[1]))))

    return Beginning(state, frozenset(name for name, fields in SENSORS.items() if reads(fields)), gains)


def called(component: Component, method: str, *arguments: Any) -> Any:
    """Call a method of a component.

    Raises:
        ConfigError: in one line, it takes other arguments.
    """
    function = getattr(component, method)
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        expected = f"{len(arguments)} arguments beside self"
        raise ConfigError(f"{type(component).__name__}.{method}", "", expected, str(error)) from None
    return function(*arguments)


def in_words(tree: PyTree) -> PyTree:
    """Return a tree with the type and shape of each array in its place, so that a message has the names of fields."""

    def shaped(leaf: Any) -> str:
        return f"{leaf.dtype}{list(leaf.shape)}" if hasattr(leaf, "dtype") else repr(leaf)

    return jax.tree.map(shaped, tree)


def constants(law: Law, begun: PyTree, measured: Measurement, reference: Reference) -> list[bool | Array]:
    """Return which leaves of a state stay as `init` made them under any measurement: they follow from the gains alone.

    By dependence of values, not by how a step is written: a leaf that follows from no measurement, no reference and no
    leaf that changes, and that a step leaves at its value, never changes.

    Arguments:
        law: of one robot.
        begun: its state at the start.
        measured, reference: any, in the shapes and the precision of the walk.

    Returns:
        For each leaf a truth value: that of Python where it is known while tracing, else ().
    """
    given, leaves = (measured, reference), jax.tree.leaves(begun)
    count, inputs = len(leaves), len(jax.tree.leaves(given))
    program = jax.make_jaxpr(lambda state, given: law.step(state, *given)[0])(begun, given).jaxpr
    steered = reached(program, [False] * count + [True] * inputs)
    for _ in leaves:
        through = reached(program, steered + [True] * inputs)
        steered = [one or other for one, other in zip(steered, through, strict=True)]
    # of a leaf that is handed on as it is, no value needs a comparison
    stays: list[Any] = [into is out for into, out in zip(program.invars, program.outvars, strict=False)]
    changing = [place for place in range(count) if not (stays[place] or steered[place])]
    if not changing:
        return stays
    after = jax.tree.leaves(law.step(begun, *given)[0])
    sources: dict[int, list[int]] = {place: [] for place in changing}
    for source in changing:
        through = reached(program, [place == source for place in range(count)] + [False] * inputs)
        for place in changing:
            sources[place] += [source] if through[place] else []
    for place in changing:
        new, old = after[place], leaves[place]
        stays[place] = ((new == old) | (old != old)).all()
    for _ in changing:  # a value that follows from a leaf that changes may change later
        stays = [
            functools.reduce(operator.and_, (stays[source] for source in sources.get(place, ())), own)
            for place, own in enumerate(stays)
        ]
    return stays


def measurement_at(reference: Reference, joints: Array) -> Measurement:
    """Return a measurement of the shapes and types that a walk has, at the pose of the reference."""
    position, orientation, feet = reference[:3]
    six, support, known = jnp.zeros_like(position, shape=6), jnp.ones(len(feet), bool), jnp.asarray(True)
    return Measurement(
        position, orientation, position, position, feet, six, support, joints, joints, joints, known, feet
    )
