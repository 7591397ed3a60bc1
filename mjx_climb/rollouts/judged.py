"""The metrics of one walk that is over."""

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.compilation import devices
from mjx_climb.compilation.cache import enable_cache
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.identity import all_shipped, of_robot
from mjx_climb.rollouts.trajectory import Trajectory, to_samples
from mjx_climb.scenario.model import RobotFile
from mjx_climb.walk.metrics import METRICS, Context, Metric, MetricTable, running
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import weighing


class Judged(NamedTuple):
    """What a compiled judgement depends on beside the walk's samples."""

    robot: str | RobotFile
    metrics: MetricTable
    time_step: float


def metrics(trajectory: Trajectory, metrics: Iterable[Metric] = METRICS) -> dict[str, float | str | bool | None]:
    """Return the metrics of one walk, those of `mjx_climb.METRICS` or others, in their units.

    `detached_at` and `detached_limb` (a name) are None while all limbs hold, as is what is not defined. Where the state
    stopped being finite, `diverged`, the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or one that does not keep its shapes.
    """
    scenario, numbers, samples = trajectory.scenario, trajectory.numbers, to_samples(trajectory)
    dtype = samples.base_position.dtype
    scale, heading = (np.asarray(value, dtype)[None] for value in (numbers.mass_scale, numbers.heading))
    gravity = np.asarray(numbers.gravity, dtype)[:, None]
    enable_cache()
    with devices.on_host(), jax.enable_x64(dtype == np.float64):
        judged = Judged(scenario.robot, MetricTable(metrics), scenario.time_step)
        found = _compiled()(judged, samples, scale, gravity, heading)
        values = {name: found[name].item() for name in judged.metrics.names}
    return named(values, trajectory.limbs)


@functools.cache
def _compiled() -> Callable[..., dict[str, Array]]:
    return kept(_accumulated, _identity, {})


def _accumulated(judged: Judged, samples: Sample, scale: Array, gravity: Array, heading: Array) -> dict[str, Array]:
    dtype = samples.base_position.dtype
    robot = jax.tree.map(lambda value: jnp.asarray(value, dtype), load_robot(judged.robot))
    context = Context(weighing(robot, scale), gravity, heading, judged.time_step)

    def step(values: running.Running, sample: Sample) -> tuple[running.Running, None]:
        return running.accumulate(judged.metrics, values, sample, context), None

    values = running.start(judged.metrics, 1, dtype)
    return running.finish(judged.metrics, jax.lax.scan(step, values, samples)[0], context)


def _identity(judged: Judged, *_: Any) -> str | None:
    if not all_shipped(judged.metrics):
        return None
    return repr((of_robot(judged.robot), judged.metrics.names, judged.time_step))


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Return scalar metrics with None for what is not defined and the limb by name: what goes into JSON."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result
