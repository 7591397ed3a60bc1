"""Gains by gait phase: other values in a swing, before a lift-off, after a touchdown, and in between.

```python
law = phased(EndEffectorAdmittance(), gains=("damping", "stiffness"))
```
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PyTree

from mjx_climb.control.combined import Made, Part, Sum, law_class, product
from mjx_climb.control.law import Command, JointGains, Law, Measurement, Reference, Start, constants, gain, scalar
from mjx_climb.value_field import ValueField

PHASES = ("in_swing", "before_lift_off", "after_touchdown", "standing")  # as they stand behind a gain's name


class Phased(Law, metaclass=Made):
    """A law some of whose gains have a value for each phase, made by `phased`; see `limb_shares`.

    Values that the law's `init` makes of its gains, as the motion of a virtual mass in one period, are made for each
    phase, and ramped as the gains are.
    """

    phase_time: Array = scalar(
        "s", "time before lift-off, after touchdown", bounds=(1e-2, 1.0), default=0.2, searched=False
    )
    phase_ramp: Array = scalar("s", "time from phase to phase", bounds=(5e-3, 0.5), default=0.05, searched=False)

    PART: ClassVar[Part]  # of the gains that are the same in all phases
    BY_PHASE: ClassVar[tuple[str, ...]] = ()
    OF_JOINTS: ClassVar[tuple[str, ...]] = ()  # of kp, kd and ki

    def init(self, start: Start) -> tuple[PyTree, ...]:
        """Return the law's state by the gains of each phase: the last is the one that moves."""
        return tuple(self._law(self._values(phase)).init(start) for phase in PHASES)

    def step(
        self, states: tuple[PyTree, ...], measured: Measurement, reference: Reference
    ) -> tuple[tuple[PyTree, ...], Command]:
        """Let the law take its step with the gains of the present phase."""
        limbs = limb_shares(reference, self.phase_time, self.phase_ramp)
        of_limbs = bool(self.BY_PHASE) and self.PART.kind.LIMBWISE.issuperset(self.BY_PHASE)
        shares = limbs if of_limbs else robot_shares(limbs)

        def now(*of_phases: Array) -> Array:
            *others, standing = of_phases
            # in this form a value that is the same in all phases keeps its bits
            weights = [share[:, None] if of_limbs else share for share in shares]
            changes = (weight * (other - standing) for weight, other in zip(weights, others, strict=True))
            return sum(changes, standing)

        values = (self._values(phase) for phase in PHASES)
        law = self._law(jax.tree.map(now, *values))
        leaves, tree = jax.tree.flatten(states[-1])
        # values that `init` made of the gains; the states of the other phases are as it returned them
        made = constants(self._law(self._values(PHASES[0])), states[0], measured, reference)
        kept = [stays if _is_real(leaf) else False for stays, leaf in zip(made, leaves, strict=True)]
        by_phase = zip(*map(jax.tree.leaves, states), strict=True)
        mixed = [_choice(keeps, now(*each), each[-1]) for each, keeps in zip(by_phase, kept, strict=True)]
        moved, command = law.step(jax.tree.unflatten(tree, mixed), measured, reference)
        each = zip(kept, leaves, jax.tree.leaves(moved), strict=True)
        after = [_choice(keeps, old, new) for keeps, old, new in each]
        if self.OF_JOINTS:
            names = [name for name in JointGains._fields if name != "ki" or name in self.OF_JOINTS]
            own = {name: self._factors(name, limbs) for name in names}
            command = command._replace(joint_gains=product(JointGains(**own), command.joint_gains))
        return (*states[:-1], jax.tree.unflatten(tree, after)), command

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches of the law look, for each phase alike."""
        own = {f"{name}_{phase}" for name in self.OF_JOINTS for phase in PHASES} | {"phase_time", "phase_ramp"}
        found: dict[str, tuple[float, float]] = {}
        for key, bounds in self._law(self._values("standing")).search_bounds(period).items():
            name, dot, axes = key.partition(".")
            names = [f"{name}_{phase}" for phase in PHASES] if name in self.BY_PHASE else [name]
            found |= {f"{each}{dot}{axes}": bounds for each in names}
        return found | {name: field.bounds for name, field in self.GAINS.items() if name in own}

    def _factors(self, name: str, shares: tuple[Array, Array, Array]) -> Array:
        """Return by how much a joint gain is multiplied, (limb,)."""
        factor = jnp.ones_like(shares[0])
        for phase, share in zip(PHASES, shares, strict=False) if name in self.OF_JOINTS else ():
            factor = factor + share * (getattr(self, f"{name}_{phase}") - 1)
        return factor

    def _values(self, phase: str) -> dict[str, Array]:
        """Return the gains of a phase, by the names that the law has for them."""
        return {name: jnp.asarray(getattr(self, f"{name}_{phase}")) for name in self.BY_PHASE}

    def _law(self, values: dict[str, Array]) -> Law:
        return self.PART.of(self, **values)


def limb_shares(reference: Reference, phase_time: Array, phase_ramp: Array) -> tuple[Array, Array, Array]:
    """Return each limb's shares of the phases swing, before lift-off and after touchdown, (limb,) each.

    The rest to 1 is the share of standing. With `r(t) = clip(t / ramp, 0, 1)`, u the time until lift-off and s that
    since touchdown, the ground has `g = r(u) r(s)`: a swing's values fade in before the lift-off, which is at u = 0,
    and out after the touchdown. Of this `1 - r(u - time)` is before the lift-off, `1 - r(s - time)` of the rest is
    after the touchdown.
    """

    def ramp(time: Array) -> Array:
        return jnp.clip(time / phase_ramp, 0.0, 1.0)

    until, since = (jnp.atleast_1d(jnp.asarray(time)) for time in (reference.until_lift_off, reference.since_touchdown))
    ground, far = ramp(until) * ramp(since), ramp(until - phase_time)
    return 1 - ground, ground * (1 - far), ground * far * (1 - ramp(since - phase_time))


def robot_shares(limbs: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return the robot's shares of the phases swing, before lift-off and after touchdown, () each, from its limbs'.

    Before a lift-off it is the largest of the limbs'. After a touchdown, and then in a swing, it raises the sum of the
    shares so far to the largest such sum of a limb.
    """
    swing, before, after = limbs
    first, second, third = before.max(), (before + after).max(), (before + after + swing).max()
    return third - second, first, second - first


def phased(law: Law, gains: Sequence[str], *, phase_time: ArrayLike = 0.2, phase_ramp: ArrayLike = 0.05) -> Law:
    """Return a law some of whose gains have a value for each phase, an instance of a class `LAW@GAIN,GAIN`.

    The gain `damping` becomes `damping_in_swing`, `damping_before_lift_off`, `damping_after_touchdown` and
    `damping_standing`, all of the law's own value at first. Gains that act on each limb (`Law.LIMBWISE`) follow the
    phase of the limb, others that of the robot. `kp`, `kd` and `ki` of the joint loop become factors of them in three
    phases, `kp_in_swing` and so on, by the phase of the limb; standing, they are the joint loop's own.

    Arguments:
        law: any law.
        gains: their names.
        phase_time: s, how long it is "before lift-off" and "after touchdown".
        phase_ramp: s, from the values of one phase to those of the next.

    Raises:
        ValueError: a name that the law does not have, or gains that act partly on limbs, partly on the base.
    """
    of: Any = type(law), tuple(gains)
    kind = _phased(*of)
    values = {f"{name}_{phase}": getattr(law, name) for name in kind.BY_PHASE for phase in PHASES}
    values |= {name: getattr(law, own) for own, name in kind.PART.names}
    return kind(**{"phase_time": phase_time, "phase_ramp": phase_ramp} | values)


@functools.cache
def _phased(kind: type[Law], gains: tuple[str, ...]) -> type[Phased]:
    known, of_joints = [*kind.GAINS, *JointGains._fields], tuple(name for name in gains if name in JointGains._fields)
    if not gains or not {*gains} <= {*known}:
        names, got = ", ".join(known), next((name for name in gains if name not in known), "none")
        raise ValueError(f"gains by phase: expected some of {names}, the gains of {kind.__qualname__}, got {got}")
    of_law = tuple(name for name in gains if name not in of_joints)
    if {*of_law} & kind.LIMBWISE and not {*of_law} <= kind.LIMBWISE:
        raise ValueError(f"gains by phase: expected such as act on limbs, or such as do not, got {', '.join(gains)}")
    own, fields = {field.name: field for field in dataclasses.fields(kind)}, {}
    for name, field in own.items():
        for phase in PHASES if name in gains else ():
            declared: ValueField = field.metadata["value"]
            words = f"{declared.long_name or name}, {phase.replace('_', ' ')}"
            metadata = {"value": declared._replace(long_name=words)}
            fields[f"{name}_{phase}"] = dataclasses.field(default=field.default, metadata=metadata)
        if name not in gains:
            fields[name] = field
    for name, phase in itertools.product(of_joints, PHASES[:-1]):
        words = f"factor of {name}, {phase.replace('_', ' ')}"
        fields[f"{name}_{phase}"] = gain("1", length=1, bounds=(0.1, 10.0), default=1.0, long_name=words)
    part = Part(kind, tuple((name, name) for name in own if name not in gains))
    of = f"({kind.__qualname__})" if issubclass(kind, Sum) else kind.__qualname__
    name = f"{of}@{','.join(gains)}"
    of_limbs, made_by = kind.LIMBWISE - {*gains}, (_phased, (kind, gains))
    says = {"PART": part, "BY_PHASE": of_law, "OF_JOINTS": of_joints, "LIMBWISE": of_limbs, "MADE_BY": made_by}
    return law_class(name, Phased, fields, **says)


def _is_real(value: ArrayLike) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(value), jnp.floating))


def _choice(which: bool | Array, one: Array, other: Array) -> Array:
    """Return one of two values, without an operation where it is known which."""
    if isinstance(which, bool):
        return one if which else other
    return jnp.where(which, one, other)
