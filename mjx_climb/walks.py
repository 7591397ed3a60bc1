"""Whole walks of one robot, from law and parameters to metrics or histories, as functions for `mjx_climb.execution`.

Histories that are kept for a batch are small: the least and the largest value of `LINES` in each stretch of a walk.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int, PyTree

from mjx_climb.arrays import AnyArray
from mjx_climb.control import Law
from mjx_climb.parameter_types import Parameters, path_of_gain
from mjx_climb.physics.spatial import norm
from mjx_climb.robot.constants import Robot
from mjx_climb.trajectory import Trajectory
from mjx_climb.walk.control_loop import JointTargets
from mjx_climb.walk.metrics import Context, Running, accumulate, finish, start
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Walk, advance, begin, look_ahead, prepare
from mjx_climb.walk.structure import Structure

Metrics = dict[str, Array]
Record = TypeVar("Record")  # kept of each sample
Scan = Callable[..., tuple[PyTree, PyTree]]  # as `jax.lax.scan` of a step, its first carry, and `length`

STRETCHES = 200
PART = 2000  # steps of a walk, about, by one call of a program that gives all samples
_LEAST = "least of "  # before a line's name

# name: unit, long name, and the metric that is its largest value
LINES: dict[str, tuple[str, str, str]] = {
    "foot_force_history": ("N", "largest foot force", "peak_foot_force"),
    "base_deviation_history": ("m", "base off its reference", "base_deviation"),
    "joint_torque_history": ("N m", "largest joint torque", "peak_joint_torque"),
}


def metrics_of(
    structure: Structure,
    law: Law,
    parameters: Parameters,
    scan: Scan = jax.lax.scan,
    targets: Float[Array, "time limb joint"] | None = None,
) -> Metrics:
    """Return the metrics of a walk; nothing is stored over time.

    Joint targets, rad, take the law's place where given. Another `scan` may change those that it reads before the step
    gets them.
    """
    return _walked(structure, law, parameters, lambda sample: (), scan, targets)[0]


def metrics_of_moved(
    structure: Structure, gains: Mapping[str, Array], law: Law, parameters: Parameters, scan: Scan = jax.lax.scan
) -> Metrics:
    """Return the metrics of a walk with some gains, by name, in place of those of the law and of the joint loop."""
    moved = dataclasses.replace(law, **{n: v for n, v in gains.items() if n in law.GAINS})
    of_joints = {path_of_gain(name): value for name, value in gains.items() if name not in law.GAINS}
    return metrics_of(structure, moved, parameters.replace(of_joints), scan)


def histories_of(structure: Structure, law: Law, parameters: Parameters) -> Metrics:
    """Return the metrics of a walk, and the extremes of `LINES` in each stretch of time beside them."""
    metrics, over_time = _walked(structure, law, parameters, _lines)
    return metrics | _extremes(over_time)


def samples_of(
    structure: Structure, law: Law, parameters: Parameters, targets: Float[Array, "time limb joint"] | None = None
) -> Sample:
    """Return every sample of a walk, stacked over time; joint targets, rad, take the law's place where given."""
    walk = prepare(structure, law, parameters)
    return _samples(walk, begin(walk), jnp.arange(structure.steps), targets)[1]


def begun(structure: Structure, law: Law, parameters: Parameters, time_step: Float[Array, ""]) -> Carry:
    """Return a robot before its first step."""
    return begin(prepare(structure._replace(time_step=time_step), law, parameters))


def next_samples(
    structure: Structure,
    law: Law,
    parameters: Parameters,
    time_step: Float[Array, ""],
    carry: Carry,
    first: Int[Array, ""],
    targets: Float[Array, "time limb joint"] | None = None,
) -> tuple[Carry, Sample]:
    """Return a robot after its next steps, from the `first` on, and their samples; targets as of `samples_of`.

    The time step and the length of the walk are no part of the program, which serves them all.
    """
    walk = prepare(structure._replace(time_step=time_step), law, parameters)
    return _samples(walk, carry, first + jnp.arange(structure.steps, dtype=first.dtype), targets)


def _samples(walk: Walk, begun: Carry, steps: Int[Array, " time"], targets: Array | None) -> tuple[Carry, Sample]:
    def step(carry: Carry, now: tuple[Array, Array | None]) -> tuple[Carry, Sample]:
        number, angles = now
        return advance(walk, carry, number, None if angles is None else JointTargets(angles))

    found: tuple[Carry, Sample] = _over_steps(walk, step, begun, (steps, targets))
    return found


def _walked(
    structure: Structure,
    law: Law,
    parameters: Parameters,
    record: Callable[[Sample], Record],
    scan: Scan = jax.lax.scan,
    targets: Float[Array, "time limb joint"] | None = None,
) -> tuple[Metrics, Record]:
    """The metrics of a walk, and `record` of each sample, stacked over time.

    Joint targets, rad, take the law's place where there are some.
    """
    walk, table = prepare(structure, law, parameters), structure.metrics
    context = _context(structure, walk.robot, parameters)

    def step(carry: tuple[Carry, Running], angles: Array | None) -> tuple[tuple[Carry, Running], Record]:
        walked, running = carry
        walked, sample = advance(walk, walked, running.steps, None if angles is None else JointTargets(angles))
        return (walked, accumulate(table, running, sample, context)), record(sample)

    begun = (begin(walk), start(table, parameters.gravity.dtype))
    (_, running), records = _over_steps(walk, step, begun, targets, scan)
    return finish(table, running, context), records


def _over_steps(
    walk: Walk, step: Callable[..., PyTree], begun: PyTree, inputs: PyTree, scan: Scan = jax.lax.scan
) -> tuple[PyTree, PyTree]:
    """Return the last carry and the records of a walk's steps, by periods of a gait that looks ahead.

    The carry is a `Carry`, or a pair of one and running metrics; inputs are none, or begin with steps.
    """
    steps, period = walk.structure.steps, walk.structure.planning
    if not period:
        return scan(step, begun, inputs, length=steps)

    def walk_period(carried: PyTree, given: PyTree) -> tuple[PyTree, PyTree]:
        if isinstance(carried, Carry):
            carried = look_ahead(walk, carried, jax.tree.leaves(given)[0][0])
        else:
            carried = look_ahead(walk, carried[0], carried[1].steps), carried[1]
        return jax.lax.scan(step, carried, given, length=period)

    if steps == period:
        # XLA takes a loop of one round apart, and JAX 0.10's compiler for CPUs then ends the process
        return walk_period(begun, inputs)
    parts = jax.tree.map(lambda value: value.reshape(steps // period, period, *value.shape[1:]), inputs)
    last, records = scan(walk_period, begun, parts, length=steps // period)
    return last, jax.tree.map(lambda value: value.reshape(steps, *value.shape[2:]), records)


def metrics_of_samples(
    structure: Structure,
    samples: Sample,
    parameters: Parameters,
    time_step: Float[Array, ""],
    steps: Int[Array, ""],
    before: Running,
) -> tuple[Running, Metrics]:
    """Return the metrics of a walk of `steps` so far, of the samples that follow `before`, stacked over time.

    Before the first samples all values of `before` are zeros; those behind the last step are left out.
    """
    dtype, table = samples.base_position.dtype, structure.metrics
    robot = jax.tree.map(lambda value: jnp.asarray(value, dtype), structure.robot)
    context = _context(structure._replace(time_step=time_step), robot, parameters)
    begun = jax.tree.map(functools.partial(jnp.where, before.steps > 0), before, start(table, dtype))

    def step(running: Running, sample: Sample) -> tuple[Running, None]:
        after = accumulate(table, running, sample, context)
        return jax.tree.map(functools.partial(jnp.where, running.steps < steps), after, running), None

    running = jax.lax.scan(step, begun, samples)[0]
    return running, finish(table, running, context)


def real_metrics(structure: Structure, parameters: Parameters) -> list[str]:
    """Return the names of the metrics that are real numbers, which have derivatives."""
    table, context = structure.metrics, _context(structure, structure.robot, parameters)
    found = jax.eval_shape(lambda: finish(table, start(table, jnp.zeros(()).dtype), context))
    return [name for name, value in found.items() if jnp.issubdtype(value.dtype, jnp.floating)]


def _context(structure: Structure, robot: Robot, parameters: Parameters) -> Context:
    """Return the context of a walk's metrics, with the robot's masses scaled as in this walk."""
    names = ("base_mass", "base_inertia", "link_mass", "link_inertia")
    scaled = {name: getattr(robot, name) * parameters.mass_scale for name in names}
    heavy = dataclasses.replace(robot, **scaled)
    return Context(heavy, parameters.gravity, parameters.gait.heading, structure.time_step)


# --- histories


def stretches(steps: int) -> tuple[int, int]:
    """Return the number of stretches of a walk, `STRETCHES` or fewer, and the steps of one; the last may be shorter."""
    length = math.ceil(steps / STRETCHES)
    return math.ceil(steps / length), length


def histories(trajectory: Trajectory, steps: int | None = None) -> dict[str, Float[np.ndarray, "extreme stretch"]]:
    """Return `LINES` of one walk, (2, stretches): the least and the largest value in each stretch.

    The stretches of time are those of a walk of so many `steps`, each one or more of this walk's.
    """
    return together({name: np.asarray(value) for name, value in _extremes(_lines(trajectory), steps).items()})


def _lines(sample: Sample | Trajectory) -> dict[str, AnyArray]:
    """Return `LINES` of a `Sample`, (), or of a `Trajectory`, (time,); by JAX or by NumPy, as its arrays are."""
    torque: AnyArray = sample.joint_torque
    return {
        "foot_force_history": norm(sample.foot_force).max(-1),
        "base_deviation_history": norm(sample.base_position - sample.base_reference),
        "joint_torque_history": abs(torque).max((-2, -1)),
    }


def _extremes(over_time: Mapping[str, AnyArray], of: int | None = None) -> dict[str, AnyArray]:
    """Return the least and the largest value of lines (time,) in each stretch, (stretches,), for `together`.

    They are results of their own: put together within a compiled program each stretch would be an operation.
    """
    found: dict[str, AnyArray] = {}
    for name, line in over_time.items():
        xp, (steps,) = line.__array_namespace__(), line.shape
        number, length = stretches(of or steps)
        length *= steps // (of or steps)
        # the last stretch is filled up with its last value
        rows = xp.concatenate([line, xp.repeat(line[-1:], number * length - steps)]).reshape(number, length)
        found |= {f"{_LEAST}{name}": rows.min(1), name: rows.max(1)}
    return found


def together(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return results of walks with both extremes (..., stretches) of a line in one array, (..., 2, stretches)."""
    return {
        name: np.stack([found[f"{_LEAST}{name}"], value], axis=-2) if name in LINES else value
        for name, value in found.items()
        if not name.startswith(_LEAST)
    }
