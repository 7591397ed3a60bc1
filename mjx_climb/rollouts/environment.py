"""Robots stepped by hand: a reset and one step as pure functions, the batch first."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from mjx_climb.compilation.closed_over import closed_over
from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.compilation.forward_only import forward_only
from mjx_climb.compilation.options import pieces_pay
from mjx_climb.control import Law, law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.dynamics.state import State
from mjx_climb.hardware.stages import stages_of
from mjx_climb.quantities.batches import batch_last, own_axes
from mjx_climb.quantities.parameters import Parameters, own_numbers
from mjx_climb.rollouts.given import AnyGains, check_robots, checked, checked_dtype, given
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk import action as hot
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Structure, Walk, advance, begin, prepare, structure

Tree = TypeVar("Tree")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class JointTargets:
    """An action: where the joint loop should take the joints, in place of the law and the inverse kinematics."""

    angles: ArrayLike  # (*batch, limb, joint) rad


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BaseShift:
    """An action: how far the base should be from its reference, in place of what the law says; the feet as planned."""

    displacement: ArrayLike  # (*batch, 6) m, rad: translation and rotation vector along the axes of the reference


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EnvironmentState:
    """Robots between two steps: every array has the batch axes first, so that `vmap`, `where` and slices take it."""

    step: Array  # (*batch,) how many have been made
    carry: Carry  # what one step hands to the next: values (*batch, ...)
    constants: list[Array]  # what law and parameters make of themselves: values (*batch, ...)
    law: Law  # with its gains as they are now, (*batch, ...)
    parameters: Parameters  # (*batch, ...)

    @property
    def robot(self) -> State:
        """The mechanical state, joints (*batch, limb x joint), as `mjx_climb.forward_dynamics` takes it."""
        state = self.carry.state
        joints = {
            name: jnp.swapaxes(getattr(state, name), -1, -2).reshape(*self.step.shape, -1)
            for name in ("joint_angles", "joint_rates")
        }
        return dataclasses.replace(state, **joints)


class Environment:
    """A scenario's robots, to be stepped by hand under its law or another, or under actions of one's own.

    ```python
    env = mjx_climb.Environment(scenario)
    state = env.reset(parameters)
    state, sample = env.step(state)
    ```

    `reset` and `step` are pure and compiled, for `jit`, `vmap`, `scan` and forward derivatives; made again from equal
    arguments, an environment is not compiled again. The walk is that of `mjx_climb.rollout`, bit for bit, and goes on
    where a rollout would end.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        law: Law | None = None,
        engine: str = DEFAULT_ENGINE,
        dtype: DTypeLike | None = None,
        in_pieces: bool | None = None,
    ) -> None:
        """Prepare an environment.

        Arguments:
            scenario: what walks where; its numbers are the default parameters.
            law: the control law, the scenario's own where None.
            engine: the dynamics, one of `mjx_climb.ENGINES`.
            dtype: precision of the simulation; JAX's own setting where None.
            in_pieces: as `mjx_climb.simulator` takes it; where it pays, if None. False for reverse derivatives.

        Raises:
            ConfigError: no such engine.
            ValueError: no control law.
        """
        pieces = pieces_pay(engine) if in_pieces is None else in_pieces
        self.scenario = scenario
        self.law = law_of(scenario) if law is None else checked(law)
        self.dtype = checked_dtype(jnp.result_type(float) if dtype is None else dtype)
        self._structure = structure(scenario, engine, law=self.law, in_pieces=pieces)
        own = given(scenario, self.law, None, own_numbers(scenario), self._array)
        self._kind = _kind(own.law, own.numbers)

    def reset(
        self, parameters: Parameters | None = None, gains: AnyGains | None = None, *, batch: tuple[int, ...] = ()
    ) -> EnvironmentState:
        """Return robots in the rest stance with all grippers shut.

        Arguments:
            parameters: with any leading batch axes; the scenario's own where None.
            gains: in place of the law's own, by name, with leading batch axes that broadcast with the parameters'.
            batch: further axes, where neither has them: `batch=(64,)` for 64 equal robots.

        Raises:
            ValueError: shapes that do not broadcast, gains that the law does not have, or cannot have, or parameters
                with hardware that the scenario does not have.
        """
        numbers = own_numbers(self.scenario) if parameters is None else parameters
        law, numbers, shape, _ = given(self.scenario, self.law, gains, numbers, self._array)
        self._check_hardware(numbers)
        shape = jnp.broadcast_shapes(shape, tuple(batch))
        check_robots(shape)
        return self._begun(law, numbers, shape)

    def step(
        self,
        state: EnvironmentState,
        action: JointTargets | BaseShift | None = None,
        gains: AnyGains | None = None,
    ) -> tuple[EnvironmentState, Sample]:
        """Return the robots one time step later, and all that is known about this step.

        Arguments:
            state: what `reset` or the last `step` gave.
            action: for this step, with the batch axes of the state; None: what the law says. The law stays as it is
                while actions take its place.
            gains: from this step on, in place of the law's, by name, `kp` and `kd` too; axes as of `reset`, within the
                batch of the state. Those not given stay; so does what the law remembers.

        Returns:
            The state after the step; and the sample, fields as in `mjx_climb.Trajectory` with the batch axes in place
            of time: the state at the start of the step, and the forces and accelerations that act in it.

        Raises:
            ValueError: gains as of `reset`, or for more robots than there are.
        """
        if gains is not None:
            law, numbers, wanted, _ = given(self.scenario, state.law, gains, state.parameters, self._array)
            if wanted != (shape := state.step.shape):
                raise ValueError(f"gains: expected batch axes that broadcast to the state's {shape}, got {wanted}")
            begun = self._begun(law, numbers, shape)
            state = dataclasses.replace(begun, step=state.step, carry=state.carry)
        after: tuple[EnvironmentState, Sample] = _stepped(self._structure, self._kind, state, action)
        return after

    def _begun(self, law: Law, numbers: Parameters, shape: tuple[int, ...]) -> EnvironmentState:
        law, numbers = _spread(law, shape), _spread(numbers, shape)
        laid_out = (batch_last(tree, shape, self.dtype) for tree in (law, numbers))
        carry, constants = _batch_first(_begun(self._structure, self._kind, *laid_out), shape)
        return EnvironmentState(jnp.zeros(shape, jnp.int32), carry, constants, law, numbers)

    def _array(self, value: Any) -> Array:
        return jnp.asarray(value, self.dtype)

    def _check_hardware(self, numbers: Parameters) -> None:
        """Refuse numbers whose stages of hardware are not compiled: known before anything is traced, or not asked."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(numbers)):
            return
        built, asked = self._structure.stages, stages_of(self.scenario, numbers)
        if asked != built:
            raise ValueError(
                f"parameters: expected the stages of hardware and the longest delays of the scenario, {built}, "
                f"got {asked}; make the Environment of a scenario that has them"
            )


class _Kind(NamedTuple):
    """Of what structure and shapes law and parameters are, their batch axes apart. Hashable."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    dtype: jnp.dtype

    def like(self, robots: int) -> tuple[Law, Parameters]:
        """Return law and parameters of so many robots, without values, in the layout of the hot path."""
        leaves = [jax.ShapeDtypeStruct((*shape, robots), self.dtype) for shape in self.shapes]
        both: tuple[Law, Parameters] = jax.tree.unflatten(self.tree, leaves)
        return both


def _kind(law: Law, numbers: Parameters) -> _Kind:
    leaves, tree = jax.tree.flatten((law, numbers))
    axes = jax.tree.leaves((own_axes(law), own_axes(numbers)))
    shapes = tuple(leaf.shape[leaf.ndim - own :] for leaf, own in zip(leaves, axes, strict=True))
    return _Kind(tree, shapes, numbers.kp.dtype)


def _spread(tree: Tree, shape: tuple[int, ...]) -> Tree:
    """Return a tree whose values all have the batch axes."""

    def wide(value: Array, own: int) -> Array:
        return jnp.broadcast_to(value, (*shape, *value.shape[value.ndim - own :]))

    result: Tree = jax.tree.map(wide, tree, own_axes(tree))
    return result


def _prepared(structure: Structure, law: Law, numbers: Parameters, robots: int) -> tuple[Carry, Walk]:
    """Return the start of a walk, every value with a batch axis, and the walk; in the layout of the hot path."""
    walk = prepare(structure, law, numbers, robots)
    return jax.tree.map(lambda leaf: _with_batch(leaf, robots), begin(walk, robots)), walk


def _differing(structure: Structure, kind: _Kind) -> list[bool]:
    """Tell which constants of a step differ from robot to robot: their shapes follow the number of robots."""

    def constants(law: Law, numbers: Parameters) -> list[Array]:
        start, walk = _prepared(structure, law, numbers, numbers.kp.shape[-1])
        return closed_over(
            functools.partial(advance, walk), start, jnp.zeros(start.gait.shape[-1], jnp.int32)
        ).constants

    two, three = (jax.eval_shape(constants, *kind.like(robots)) for robots in (2, 3))
    return [a.shape != b.shape for a, b in zip(two, three, strict=True)]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begun(structure: Structure, kind: _Kind, law: Law, numbers: Parameters) -> tuple[Carry, list[Array]]:
    robots = numbers.kp.shape[-1]
    start, walk = _prepared(structure, law, numbers, robots)
    step = closed_over(functools.partial(advance, walk), start, jnp.zeros(robots, jnp.int32))
    return start, [value for value, own in zip(step.constants, _differing(structure, kind), strict=True) if own]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _stepped(
    structure: Structure, kind: _Kind, state: EnvironmentState, action: JointTargets | BaseShift | None
) -> tuple[EnvironmentState, Sample]:
    shape = state.step.shape
    robots = math.prod(shape)
    carry, constants = jax.tree.map(lambda leaf: _last(leaf, shape), (state.carry, state.constants))
    count = state.step.reshape(robots) if shape else state.step  # of one robot as a rollout has it: the same program
    acting = _hot(action, shape, kind.dtype)
    # the values of law and parameters do not matter here: all that depends on them is in the state
    any_law, any_numbers = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), kind.like(robots))
    walk = _prepared(structure, any_law, any_numbers, robots)[1]
    if structure.in_pieces:
        why = "an Environment with in_pieces=False has reverse ones, and is slower"
        carry, constants, acting = forward_only((carry, constants, acting), why)
    step = closed_over(functools.partial(advance, walk), carry, count, acting)
    own = iter(constants)
    pairs = zip(step.constants, _differing(structure, kind), strict=True)
    call: Callable[..., tuple[Carry, Sample]] = functools.partial(step.call, [next(own) if d else c for c, d in pairs])
    call = in_kernels(call) if structure.in_pieces else call
    after, sample = call(carry, count, acting)
    sample = jax.tree.map(lambda leaf: _public(_with_batch(leaf, robots), shape), sample)
    return dataclasses.replace(state, step=state.step + 1, carry=_batch_first(after, shape)), sample


def _with_batch(leaf: ArrayLike, robots: int) -> Array:
    """Return a value (..., B), of one that all robots share."""
    leaf = jnp.asarray(leaf)
    lead = leaf.shape[:-1] if leaf.ndim and leaf.shape[-1] in (1, robots) else leaf.shape
    leaf = leaf if leaf.ndim > len(lead) else leaf[..., None]
    return jnp.broadcast_to(leaf, (*lead, robots))


def _last(leaf: Array, shape: tuple[int, ...]) -> Array:
    """Return a value (*batch, ...) as (..., B)."""
    return jnp.moveaxis(leaf.reshape(math.prod(shape), *leaf.shape[len(shape) :]), 0, -1)


def _batch_first(tree: Tree, shape: tuple[int, ...]) -> Tree:
    """Return values (..., B) as (*batch, ...)."""

    def first(leaf: Array) -> Array:
        return jnp.moveaxis(leaf, -1, 0).reshape(*shape, *leaf.shape[:-1])

    result: Tree = jax.tree.map(first, tree)
    return result


def _public(leaf: Array, shape: tuple[int, ...]) -> Array:
    """Return a value (..., B) of a sample in the layout of `Trajectory`: (*batch, limb, component)."""
    leaf = jnp.swapaxes(leaf, 0, 1) if leaf.ndim == 3 else leaf
    return _batch_first(leaf, shape)


def _hot(action: JointTargets | BaseShift | None, shape: tuple[int, ...], dtype: jnp.dtype) -> hot.Action:
    """Return an action in the layout of the hot path."""
    if action is None:
        return None
    [value] = jax.tree.leaves(action)
    own = 2 if isinstance(action, JointTargets) else 1
    value = jnp.asarray(value, dtype)
    value = jnp.broadcast_to(value, (*shape, *value.shape[value.ndim - own :]))
    value = _last(value, shape)
    return hot.JointTargets(jnp.swapaxes(value, 0, 1)) if own == 2 else hot.BaseShift(value)
