"""What a control law is: an object whose fields are its gains, with a state at the start and one step.

```python
class Damped(mjx_climb.Law):
    damping: Array = mjx_climb.gain("N s/m", length=3, bounds=(1.0, 1e5), default=5e3)

    def init(self, start): ...
    def step(self, state, measurement, reference): ...
```
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, dataclass_transform

import jax
import jax.numpy as jnp
from jax import Array

_LENGTHS = (1, 3, 6)
_JOINT_LOOP = ("kp", "kd")


class Measurement(NamedTuple):
    """What the robot's sensors tell, and the base pose it works out from them; world axes, the batch last."""

    base_position: Array  # (3, B) m, of the base's centre of mass
    base_orientation: Array  # (4, B) wxyz, base to world
    base_linear_velocity: Array  # (3, B) m/s, of the base's centre of mass
    base_angular_velocity: Array  # (3, B) rad/s
    foot_force: Array  # (3, L, B) N, of the ground on the foot
    wrench: Array  # (6, B) N, N m: `w = J_b^T F_e`, moments about the base's centre of mass
    support: Array  # (L, B) bool: the gripper is shut and holds


class Reference(NamedTuple):
    """What the gait asks for; world axes. What all environments share may have a batch axis of one."""

    base_position: Array  # (3, B) m, of the base's centre of mass
    base_orientation: Array  # (4, B) wxyz, base to world: the axes of the reference
    foot_position: Array  # (3, L, B) m


class Command(NamedTuple):
    """Targets for the inverse kinematics, world axes, and the shift that led to them."""

    base_position: Array  # (3, B) m, of the base's centre of mass
    base_orientation: Array  # (4, B) wxyz, base to world
    foot_position: Array  # (3, L, B) m
    base_displacement: Array  # (6, B) m, rad: the law's shift of the base, reference axes


class Start(NamedTuple):
    """What a law knows before its first step."""

    period: float | Array  # s, from one step of the law to the next; an array (B,) where it differs
    reference: Reference  # at the start, with the whole batch: the shapes of all that follows


def no_shift(start: Start) -> Array:
    """Return the shift of a base that stays where the gait wants it, (6, B)."""
    position = start.reference.base_position
    return jnp.zeros((6, position.shape[-1]), position.dtype)


class GainField(NamedTuple):
    """What is known about a gain beside its value."""

    unit: str
    length: int  # 1; 3 axes; or 6: three translations, then three rotations
    bounds: tuple[float, float]  # of a search
    rotation_bounds: tuple[float, float] | None  # of a search, where rotations have their own
    long_name: str
    searched: bool  # whether searches move it without being asked


def gain(
    unit: str,
    *,
    length: int = 6,
    bounds: tuple[float, float],
    rotation_bounds: tuple[float, float] | None = None,
    default: Any = dataclasses.MISSING,
    long_name: str = "",
    searched: bool = True,
) -> Any:
    """Return the field of a law that is one of its gains.

    Arguments:
        unit: as in "N s/m", or "N s/m, N m s/rad" where rotations have their own.
        length: 1, or 3 or 6 axes; a value is a scalar, which holds for all axes, or has them last, after any batch.
        bounds: where searches look, low and high. A gain must be above 0, unless `low` lets it be 0 or less.
        rotation_bounds: the bounds of the three rotations, where they are others.
        default: the value of a law that is made without one.
        long_name: for axes and tables; the field's own name where empty.
        searched: whether searches move the gain without being asked to.

    Raises:
        ValueError: a length other than 1, 3 and 6, or bounds that are not in order.
    """
    if length not in _LENGTHS:
        raise ValueError(f"length of a gain: expected 1, 3 or 6, got {length}")
    for low, high in (bounds, rotation_bounds or bounds):
        if not low < high:
            raise ValueError(f"bounds of a gain: expected low < high, got {low}, {high}")
    field = GainField(unit, length, bounds, rotation_bounds, long_name, searched)
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={"gain": field})
    return dataclasses.field(default=default, metadata={"gain": field})


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(gain, dataclasses.field))
class Law:
    """Base of control laws: a class that inherits from it becomes a frozen dataclass and a pytree.

    Fields made by `gain` are its numbers: swept, batched, differentiated, tuned. Any other field is part of the
    program: hashable, and another value is compiled anew.

    Outside a walk gains are scalars, (n,) or (*batch, n), of length 1 (*batch). In `init` and `step` everything is in
    the layout of the hot path, batch last: gains (n, B), of length 1 (B,); what does not vary over the batch may have a
    batch axis of one.
    """

    GAINS: ClassVar[Mapping[str, GainField]] = MappingProxyType({})  # by name, in the order of the fields
    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({})  # how many axes the value of one environment has

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]  # a dataclass from here on
        gains = {field.name: field.metadata["gain"] for field in fields if "gain" in field.metadata}
        if taken := [name for name in _JOINT_LOOP if name in gains]:
            raise ValueError(f"{cls.__name__}.{taken[0]}: expected another name, this one is the joint loop's")
        cls.GAINS = MappingProxyType(gains)
        cls.AXES = MappingProxyType({name: int(field.length > 1) for name, field in gains.items()})
        others = [field.name for field in fields if field.name not in gains]
        jax.tree_util.register_dataclass(cls, data_fields=list(gains), meta_fields=others)

    def init(self, start: Start) -> Any:
        """Return the state at the start: a pytree.

        What depends on the gains alone belongs here: what `step` hands on unchanged is no part of the loop.
        """
        raise NotImplementedError(f"{type(self).__name__}.init")

    def step(self, state: Any, measurement: Measurement, reference: Reference) -> tuple[Any, Command]:
        """Return the state after a step, of the same structure, and what the robot is to do."""
        raise NotImplementedError(f"{type(self).__name__}.step")

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches look, by gain and by `gain.rotation`, for steps of `period` s."""
        bounds = {name: field.bounds for name, field in self.GAINS.items()}
        rotations = {name: field.rotation_bounds for name, field in self.GAINS.items()}
        return bounds | {f"{name}.rotation": found for name, found in rotations.items() if found is not None}
