"""Whole walks of one robot, from law and parameters to metrics or histories: what `mjx_climb.execution` carries out."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mjx_climb.control import Law
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.robot.constants import Robot, load_robot
from mjx_climb.rollouts.histories import extremes, lines
from mjx_climb.walk.metrics import Context
from mjx_climb.walk.metrics.metric import Running, accumulate, finish, start
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, advance, begin, prepare
from mjx_climb.walk.structure import Structure

Metrics = dict[str, Array]


def metrics_of(structure: Structure, law: Law, parameters: Parameters) -> Metrics:
    """Return the metrics of a walk; nothing is stored over time."""
    return _walked(structure, law, parameters, lambda sample: ())[0]


def metrics_of_moved(structure: Structure, gains: Mapping[str, Array], law: Law, parameters: Parameters) -> Metrics:
    """Return the metrics of a walk with some gains, by name, in place of those of the law and of the joint loop."""
    of_law = {name: value for name, value in gains.items() if name in law.GAINS}
    of_joints = {name: value for name, value in gains.items() if name not in law.GAINS}
    law = dataclasses.replace(law, **of_law)  # type: ignore[type-var]
    return metrics_of(structure, law, dataclasses.replace(parameters, **of_joints))


def histories_of(structure: Structure, law: Law, parameters: Parameters) -> Metrics:
    """Return the metrics of a walk, and the extremes of `LINES` in each stretch of time beside them."""
    metrics, over_time = _walked(structure, law, parameters, lines)
    return metrics | extremes(over_time)


def samples_of(structure: Structure, law: Law, parameters: Parameters) -> Sample:
    """Return every sample of a walk, stacked over time."""
    walk = prepare(structure, law, parameters)
    samples: Sample = jax.lax.scan(functools.partial(advance, walk), begin(walk), jnp.arange(structure.steps))[1]
    return samples


def _walked(
    structure: Structure, law: Law, parameters: Parameters, record: Callable[[Sample], Any]
) -> tuple[Metrics, Any]:
    """Return the metrics of a walk, and what `record` keeps of each sample, stacked over time."""
    walk, table = prepare(structure, law, parameters), structure.metrics
    context = _context(structure, walk.robot, parameters)

    def step(carry: tuple[Carry, Running], _: None) -> tuple[tuple[Carry, Running], Any]:
        walked, running = carry
        walked, sample = advance(walk, walked, running.steps)
        return (walked, accumulate(table, running, sample, context)), record(sample)

    begun = (begin(walk), start(table, parameters.kp.dtype))
    (_, running), records = jax.lax.scan(step, begun, length=structure.steps)
    return finish(table, running, context), records


def metrics_of_samples(structure: Structure, samples: Sample, parameters: Parameters) -> Metrics:
    """Return the metrics of samples stacked over time, of a walk that is over."""
    dtype, table = samples.base_position.dtype, structure.metrics
    robot = jax.tree.map(lambda value: jnp.asarray(value, dtype), load_robot(structure.robot))
    context = _context(structure, robot, parameters)

    def step(running: Running, sample: Sample) -> tuple[Running, None]:
        return accumulate(table, running, sample, context), None

    running = jax.lax.scan(step, start(table, dtype), samples)[0]
    return finish(table, running, context)


def _context(structure: Structure, robot: Robot, parameters: Parameters) -> Context:
    """Return what metrics may know of a walk: the robot as heavy as it is in this walk."""
    names = ("base_mass", "base_inertia", "link_mass", "link_inertia")
    scaled = {name: getattr(robot, name) * parameters.mass_scale for name in names}
    robot = dataclasses.replace(robot, **scaled)
    return Context(robot, parameters.gravity, parameters.heading, structure.time_step)
