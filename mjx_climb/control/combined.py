"""A control law that is the sum of two: each sees the same measurement, and their commands add up.

```python
law = combined(VirtualModelAdmittance(damping=1e2), EndEffectorAdmittance(damping=1e3))
```
"""

import abc
import copyreg
import dataclasses
import functools
import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from mjx_climb.control.law import Command, JointGains, Law, Measurement, Reference, Start, scalar
from mjx_climb.physics.spatial import quaternion_conjugate, quaternion_multiply

AnyLaw = TypeVar("AnyLaw", bound=Law)
AnySum = TypeVar("AnySum", bound="Sum")


class Part(NamedTuple):
    """A law that is part of another, whose gains are among that one's."""

    kind: type[Law]
    names: tuple[tuple[str, str], ...]  # of its fields: its own, and the one that the whole has for it

    def of(self, whole: Law, **others: object) -> Law:
        """Return the part of a law; `others` are fields of its own that the whole does not have."""
        fields = {own: getattr(whole, name) for own, name in self.names}
        return self.kind(**fields, **others)

    def bounds(self, whole: Law, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches of a law look for the gains of its part."""
        names = dict(self.names)
        found: dict[str, tuple[float, float]] = {}
        for key, bounds in self.of(whole).search_bounds(period).items():
            name, dot, axes = key.partition(".")
            found[f"{names[name]}{dot}{axes}"] = bounds
        return found


class Made(abc.ABCMeta):
    """Type of the classes that are made of others: stored programs find one by the function that made it."""

    MADE_BY: "tuple[Callable[..., Made], tuple[object, ...]] | None" = None  # the function and its arguments


copyreg.pickle(Made, lambda kind: kind.MADE_BY or kind.__qualname__)


class Sum(Law, metaclass=Made):
    """The sum of two laws, made by `combined`: `x = x_ref + dx_1 + dx_2` of base and feet, `q = q_1 q_ref^* q_2`.

    dx is a law's command less the reference; of rotations of the base, the second follows the first.
    """

    PARTS: ClassVar[tuple[Part, ...]] = ()

    def init(self, start: Start) -> tuple[PyTree, ...]:
        """Return the states of both."""
        return tuple(part.of(self).init(start) for part in self.PARTS)

    def step(self, state: PyTree, measured: Measurement, reference: Reference) -> tuple[tuple[PyTree, ...], Command]:
        """Let both take their step, and add up their commands."""
        steps = [part.of(self).step(own, measured, reference) for part, own in zip(self.PARTS, state, strict=True)]
        (one, first), (other, second) = steps
        return (one, other), self._together(first, second, reference)

    def _together(self, first: Command, second: Command, reference: Reference) -> Command:
        back = quaternion_conjugate(reference.base_orientation)
        return Command(
            base_position=first.base_position + (second.base_position - reference.base_position),
            base_orientation=quaternion_multiply(
                first.base_orientation, quaternion_multiply(back, second.base_orientation)
            ),
            foot_position=first.foot_position + (second.foot_position - reference.foot_position),
            base_displacement=first.base_displacement + second.base_displacement,
            joint_gains=product(first.joint_gains, second.joint_gains),
        )

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where the searches of both look."""
        return {key: pair for part in self.PARTS for key, pair in part.bounds(self, period).items()}


class Choice(Sum):
    """One of two laws, made by `either`: both go on side by side, and the robot follows the commands of one."""

    second: Array = scalar("1", "0: the first law commands, 1: the second", bounds=(0.0, 1.0), default=0.0)

    def _together(self, first: Command, second: Command, reference: Reference) -> Command:
        chosen: Command = jax.tree.map(functools.partial(jnp.where, jnp.asarray(self.second) > 0), second, first)
        return chosen


def product(first: JointGains | None, second: JointGains | None) -> JointGains | None:
    """Return the factors of joint gains of two laws together."""
    if first is None or second is None:
        return first or second
    both = dict(first.moved)
    for name, factor in second.moved.items():
        both[name] = both[name] * factor if name in both else factor
    return JointGains(**both)


def combined(first: Law, second: Law) -> Law:
    """Return the law that is the sum of two, an instance of a class `FIRST+SECOND`, the same for the same two classes.

    Its gains are those of both. Where these have a name in common, the name of the law stands in front of all:
    `virtual_model_damping`, `end_effector_damping`; of two laws of one kind, `first_damping`, `second_damping`.
    """
    return _made(Sum, first, second)


def either(first: Law, second: Law, *, take_second: bool) -> Law:
    """Return a law that commands as one of two does, an instance of a class `FIRST|SECOND`; gains as of `combined`.

    Walks under either law have the same compiled program. Both leave the joint loop's gains alone.
    """
    which: Any = {"second": float(take_second)}
    return dataclasses.replace(_made(Choice, first, second), **which)


def _made(base: type[AnySum], *laws: Law) -> AnySum:
    kind = _class_of(base, *map(type, laws))
    values: Any = {
        name: getattr(law, own) for law, part in zip(laws, kind.PARTS, strict=True) for own, name in part.names
    }
    return cast(AnySum, kind(**values))


@functools.cache
def _class_of(base: type[AnySum], first: type[Law], second: type[Law]) -> type[AnySum]:
    owns = [{field.name: field for field in dataclasses.fields(kind)} for kind in (first, second)]
    places = [f"{_prefix(kind)}_" for kind in (first, second)]
    if places[0] == places[1]:
        places = ["first_", "second_"]
    if not owns[0].keys() & owns[1].keys():
        places = ["", ""]
    fields: dict[str, Any] = {}
    parts: list[Part] = []
    for kind, own, place in zip((first, second), owns, places, strict=True):
        names = {name: place + name for name in own}
        fields |= {names[name]: field for name, field in own.items()}
        parts.append(Part(kind, tuple(names.items())))
    limbwise = frozenset(name for part in parts for own, name in part.names if own in part.kind.LIMBWISE)
    sign = "|" if base is Choice else "+"
    name = f"{first.__qualname__}{sign}{f'({second.__qualname__})' if issubclass(second, Sum) else second.__qualname__}"
    made_by = _class_of, (base, first, second)
    return law_class(name, base, fields, PARTS=tuple(parts), LIMBWISE=limbwise, MADE_BY=made_by)


def law_class(name: str, base: type[AnyLaw], fields: Mapping[str, Any], **attributes: object) -> type[AnyLaw]:
    """Return a class of laws with a name, whose fields are copies of those of other laws, by keyword alone."""
    copies = {
        name: dataclasses.field(
            default=field.default, default_factory=field.default_factory, metadata=field.metadata, kw_only=True
        )
        for name, field in fields.items()
    }
    body = {"__module__": base.__module__, "__annotations__": dict.fromkeys(copies, Array), **copies, **attributes}
    return cast(type[AnyLaw], Made(name, (base,), body))


def _prefix(kind: type[Law]) -> str:
    """Return the name of a law in front of its gains."""
    name = kind.__name__.split("@")[0]  # without its gains by phase
    words = name.removesuffix("Admittance") or name
    return re.sub(r"\W+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", words)).lower()
