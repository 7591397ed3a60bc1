"""Rollouts: one robot with full histories, or a batch with its metrics alone; jit-compiled once per shape."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding
from numpy.typing import DTypeLike

from mjx_climb.checks.time_step import check_time_step
from mjx_climb.compilation import devices
from mjx_climb.compilation.cache import enable_cache
from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.compilation.first_possible import first_possible
from mjx_climb.compilation.forward_only import forward_only
from mjx_climb.compilation.gpu_kernel import over_robots
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.compilation.options import compiler_options, kernel_pays, pieces_pay, walks_on_host
from mjx_climb.control import Law, law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.batches import batch_last, batch_shape, flattened, own_axes, rows_of, varying
from mjx_climb.quantities.parameters import Parameters, parameters
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.given import AnyGains, Given, checked, given, recorded
from mjx_climb.rollouts.identity import identity
from mjx_climb.rollouts.trajectory import Trajectory, from_samples, to_samples
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Context, Metric, MetricTable, running
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Structure, advance, begin, prepare, structure, weighing

Metrics = dict[str, Array]
Progress = tuple[Carry, running.Running]


def metrics_of(structure: Structure, law: Law, numbers: Parameters) -> Metrics:
    """Walk a batch and return its metrics, with the batch axes that law and parameters broadcast to."""
    return walk_recorded(structure, law, numbers, lambda sample: ())[0]


def walk_recorded(
    structure: Structure, law: Law, numbers: Parameters, record: Callable[[Sample], Any]
) -> tuple[Metrics, Any]:
    """Walk a batch and return its metrics, and what `record` keeps of each sample, stacked over time."""
    shape, dtype = batch_shape(law, numbers), jnp.result_type(numbers.kp)
    batch = math.prod(shape)
    walk = prepare(structure, batch_last(law, shape, dtype), batch_last(numbers, shape, dtype), batch)
    metrics = structure.metrics
    context = Context(walk.robot, walk.numbers.gravity, walk.numbers.heading, walk.time_step)

    def step(carry: Progress, _: None) -> tuple[Progress, Any]:
        walked, values = carry
        walked, sample = advance(walk, walked, values.steps)
        return (walked, running.accumulate(metrics, values, sample, context)), record(sample)

    start = (begin(walk, batch), running.start(metrics, batch, dtype))
    step = in_kernels(step) if structure.in_pieces else step
    (_, values), records = jax.lax.scan(step, start, length=structure.steps)
    result = running.finish(metrics, values, context)
    return {name: value.reshape(shape) for name, value in result.items()}, records


def _samples_of(structure: Structure, law: Law, numbers: Parameters) -> Sample:
    """Walk one robot and return every sample, stacked over time."""
    dtype = jnp.result_type(numbers.kp)
    walk = prepare(structure, batch_last(law, (), dtype), batch_last(numbers, (), dtype), 1)
    step: Callable[[Carry, Array], tuple[Carry, Sample]] = functools.partial(advance, walk)
    step = in_kernels(step) if structure.in_pieces else step
    return jax.lax.scan(step, begin(walk, 1), jnp.arange(structure.steps))[1]


@functools.cache
def _compiled_samples(in_pieces: bool) -> Callable[..., Sample]:
    return kept(_samples_of, identity, compiler_options(1, in_pieces=in_pieces, backend="cpu"))


@functools.cache
def _compiled_metrics(batch: int, in_pieces: bool, backend: str | None) -> Callable[..., Metrics]:
    return kept(metrics_of, identity, compiler_options(batch, in_pieces=in_pieces, backend=backend))


def _metrics_in_kernel(structure: Structure, law: Law, numbers: Parameters) -> Metrics:
    """Walk robots of one batch axis as `metrics_of` does, as a single GPU kernel."""
    walk, limbs = functools.partial(metrics_of, structure), len(structure.lift_off)
    return over_robots(walk, [varying(law), varying(numbers)], limbs=limbs)(law, numbers)


@functools.cache
def _compiled_kernel(batch: int) -> Callable[..., Metrics]:
    kernel = kept(_metrics_in_kernel, identity, {})
    return first_possible(kernel, functools.partial(_compiled_metrics, batch, False, None), "the GPU kernel")


def simulator(
    scenario: Scenario,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
    in_pieces: bool = False,
) -> Callable[..., Metrics]:
    """Return a pure function `f(gains=None, parameters=None) -> metrics` for `jit`, `vmap`, `jvp` and `jacfwd`.

    Equal arguments give the same function, so that `jax.jit` compiles it once.

    Arguments:
        scenario: what walks where; its numbers are the default parameters.
        law: the control law, the scenario's own where None; its gains are the defaults of those not given.
        metrics: what the walk is judged by, as `mjx_climb.METRICS + (mine,)`.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        smooth: for searches: no gripper is torn off, whatever the force (`peak_pull_force` tells), and the metrics have
            smooth companions, see `mjx_climb.walk.metrics.extremes`.
        in_pieces: several times faster on a CPU (see `mjx_climb.pieces_pay`), for values and forward derivatives alone.

    Returns:
        A function of gains (`Gains`, a mapping by name, or a law) and `Parameters` with any leading batch axes, in the
        precision of the gains. It gives a dict of arrays with those batch axes, named and in units as the metrics say.
        A batch axis in the gains is faster than `vmap`: it stays contiguous. NaN stands for what is not defined:
        `detached_at` while all limbs hold (`detached_limb` is then -1, else the index of the limb). Where the state
        stopped being finite, `diverged`, the others are those of the walk until then. Under `grad` and other reverse
        modes a function in pieces raises `NotImplementedError`.

    Raises:
        ConfigError: no such engine.
        ValueError: no control law, or two metrics of one name. The function raises it for gains that the law does not
            have, or cannot have, and for a metric that does not keep its shapes.
    """
    shape = structure(scenario, engine, metrics=metrics, smooth=smooth, in_pieces=in_pieces)
    law = law_of(scenario) if law is None else checked(law)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(law)):
        return _simulate(scenario, law, shape)
    return _simulator(scenario, _ByValue(law), shape)


class _ByValue:
    """A law as the key of a cache: equal to others of its class with the same values."""

    def __init__(self, law: Law) -> None:
        leaves, tree = jax.tree.flatten(law)
        arrays = [np.asarray(leaf) for leaf in leaves]
        self.law = law
        self.key = tree, tuple((array.shape, array.dtype.str, array.tobytes()) for array in arrays)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.key == other.key


@functools.lru_cache(maxsize=64)
def _simulator(scenario: Scenario, law: _ByValue, shape: Structure) -> Callable[..., Metrics]:
    return _simulate(scenario, law.law, shape)


def _simulate(scenario: Scenario, law: Law, shape: Structure) -> Callable[..., Metrics]:
    def simulate(gains: AnyGains | None = None, numbers: Parameters | None = None) -> Metrics:
        dtype = _floating_dtype(law if gains is None else gains)
        array = functools.partial(jnp.asarray, dtype=dtype)
        numbers = jax.tree.map(array, parameters(scenario, dtype) if numbers is None else numbers)
        walking, numbers, *_ = given(scenario, law, gains, numbers, array)
        if shape.in_pieces:
            walking, numbers = forward_only((walking, numbers), "for reverse mode make it without in_pieces")
        return metrics_of(shape, walking, numbers)

    return simulate


def _floating_dtype(tree: Any) -> jnp.dtype:
    """Return the precision of a tree's arrays, or the one in force where it holds plain numbers alone."""
    arrays = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    floats = [leaf for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.result_type(*floats) if floats else jnp.result_type(float)


def rollout(
    scenario: Scenario,
    gains: AnyGains | None = None,
    numbers: Parameters | None = None,
    *,
    law: Law | None = None,
    dtype: DTypeLike = np.float64,
    engine: str = DEFAULT_ENGINE,
) -> Trajectory:
    """Walk one robot through a scenario, on the CPU, and return the full time histories.

    Arguments:
        scenario: what walks where, under which controller and disturbance.
        gains: in place of the law's own, by name: `Gains`, a mapping, or a law.
        numbers: parameters in place of the scenario's, unbatched.
        law: the control law with its gains; the scenario's own where None.
        dtype: precision of the simulation; float64 needs no setting of JAX's.
        engine: the dynamics, one of `mjx_climb.ENGINES`.

    Raises:
        ConfigError: no such engine, or a time step too long for the scenario's contacts and joints.
        ValueError: batched gains or parameters (see `rollout_metrics`), or gains that the law does not have.
    """
    walker = given_in(scenario, law, gains, numbers, dtype)
    if walker.shape != ():
        raise ValueError("rollout walks one robot: for a batch of gains or parameters use rollout_metrics")
    check_time_step(scenario, numbers=walker.numbers)
    enable_cache()
    with devices.on_host():
        shape = structure(scenario, engine, walker.numbers, in_pieces=pieces_pay(engine, "cpu"))
        with jax.enable_x64(np.dtype(dtype) == np.float64):
            samples = _compiled_samples(shape.in_pieces)(shape, walker.law, walker.numbers)
            samples = jax.tree.map(np.asarray, samples)
    own = dataclasses.replace(walker.numbers, **walker.replaced)
    name = "" if law is None else type(law).__name__
    return from_samples(
        samples, scenario, recorded(scenario, gains, walker), own, load_robot(scenario.robot).limbs, name
    )


def given_in(
    scenario: Scenario, law: Law | None, gains: AnyGains | None, numbers: Parameters | None, dtype: DTypeLike
) -> Given:
    """Return law and parameters, the scenario's own where None is given, as arrays of numpy of a precision.

    Raises:
        ValueError: as `mjx_climb.rollouts.given.given`.
    """
    array = functools.partial(np.asarray, dtype=dtype)
    with devices.on_host(), jax.enable_x64(True):
        numbers = parameters(scenario) if numbers is None else numbers
        return given(scenario, law, gains, jax.tree.map(array, numbers), array)


def metrics(trajectory: Trajectory, metrics: Iterable[Metric] = METRICS) -> dict[str, float | str | bool | None]:
    """Return the metrics of one walk, those of `mjx_climb.METRICS` or others, in their units.

    `detached_at` and `detached_limb` (a name) are None while all limbs hold, as is what is not defined. Where the state
    stopped being finite, `diverged`, the others are those of the walk until then.

    Raises:
        ValueError: two metrics of one name, or one that does not keep its shapes.
    """
    robot, numbers = load_robot(trajectory.scenario.robot), trajectory.numbers
    samples = to_samples(trajectory)
    dtype = samples.base_position.dtype
    robot = jax.tree.map(lambda value: np.asarray(value, dtype), robot)  # by NumPy: nothing is compiled
    context = Context(
        weighing(robot, np.asarray(numbers.mass_scale, dtype)[None]),
        np.asarray(numbers.gravity, dtype)[:, None],
        np.asarray(numbers.heading, dtype)[None],
        trajectory.scenario.time_step,
    )
    with devices.on_host(), jax.enable_x64(dtype == np.float64):
        table = MetricTable(metrics)
        found = _accumulated(table, samples, context)
        values = {name: found[name].item() for name in table.names}
    return named(values, trajectory.limbs)


@functools.partial(jax.jit, static_argnums=0)
def _accumulated(metrics: MetricTable, samples: Sample, context: Context) -> Metrics:
    def step(values: running.Running, sample: Sample) -> tuple[running.Running, None]:
        return running.accumulate(metrics, values, sample, context), None

    values = running.start(metrics, 1, samples.base_position.dtype)
    return running.finish(metrics, jax.lax.scan(step, values, samples)[0], context)


def named(values: Mapping[str, Any], limbs: tuple[str, ...]) -> dict[str, float | str | bool | None]:
    """Return scalar metrics with None for what is not defined and the limb by name: what goes into JSON."""
    result = {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
    if "detached_limb" in values:
        result["detached_limb"] = limbs[values["detached_limb"]] if values["detached_limb"] >= 0 else None
    return result


def rollout_metrics(
    scenario: Scenario,
    gains: AnyGains | None = None,
    numbers: Parameters | None = None,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    dtype: DTypeLike = np.float32,
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: str = DEFAULT_ENGINE,
    smooth: bool = False,
) -> dict[str, np.ndarray]:
    """Walk a batch of robots on all devices and return their metrics; memory does not grow with time.

    Arguments:
        scenario: what walks where.
        gains: in place of the law's own, by name: `Gains(damping=(..., 6), ...)`, a mapping, or a law, with leading
            batch axes.
        numbers: parameters with leading batch axes that broadcast with the gains'.
        law: the control law with its gains, which may have leading batch axes too; the scenario's own where None.
        metrics: what the walks are judged by, as `mjx_climb.METRICS + (mine,)`.
        dtype: precision of the simulation.
        batch_size: at most so many robots in one call of the compiled program, one call at a time on a GPU and one on
            each core of a CPU. Few robots walk on the CPU although there is a GPU: they are there sooner.
        progress: called with the number of robots that have walked and the number in all, after each call.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        smooth: for searches, see `simulator`.

    Returns:
        Arrays with the batch axes of gains and parameters, by the names of the metrics; NaN and -1 as `simulator` says.

    Raises:
        ConfigError: no such engine, or a time step too long for the scenario's contacts and joints.
        ValueError: shapes that do not broadcast, or gains that the law does not have, or cannot have.
    """
    check_time_step(scenario)
    walkers = given_in(scenario, law, gains, numbers, dtype)
    backend = backend_of(walkers, engine, dtype)
    in_kernel = backend is None and kernel_pays(engine, dtype)
    in_pieces = pieces_pay(engine, backend)
    walk = structure(scenario, engine, walkers.numbers, metrics=metrics, smooth=smooth, in_pieces=in_pieces)

    def program(robots: int) -> Callable[..., Metrics]:
        return _compiled_kernel(robots) if in_kernel else _compiled_metrics(robots, walk.in_pieces, backend)

    return walk_batch(program, walk, walkers, batch_size=batch_size, progress=progress, backend=backend)


def backend_of(walkers: Given, engine: str, dtype: DTypeLike, slopes: int = 0) -> str | None:
    """Return where a batch walks, each robot with so many slopes: None for JAX's default."""
    return "cpu" if walks_on_host(math.prod(walkers.shape), engine, dtype, slopes) else None


def _batched(tree: Any, axes: Any, count: int) -> Any:
    """Return a flattened tree whose values all have the batch axis, before each one's own `axes`."""
    return jax.tree.map(lambda v, own: v if v.ndim > own else np.broadcast_to(v, (count, *v.shape)), tree, axes)


def walk_batch(
    compiled: Callable[[int], Callable[..., Metrics]],
    structure: Structure,
    walkers: Given,
    others: Mapping[str, np.ndarray] = MappingProxyType({}),
    own_axes_of_others: Mapping[str, int] = MappingProxyType({}),
    batch_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    backend: str | None = None,
) -> dict[str, np.ndarray]:
    """Return what a batched program gives for a batch, walked in parts on all devices; see `rollout_metrics`.

    `compiled` gives the program for so many robots. It takes the structure, law, parameters, and the `others` where
    there are any, with one batch axis in place of theirs, and returns a dict of arrays with the batch as their first
    axis. `backend` is where it walks, where that is not JAX's default.
    """
    law, numbers, shape, _ = walkers
    count = math.prod(shape)
    share = devices.share_size(count, batch_size, backend)
    trees: list[Any] = [law, numbers]
    axes: list[Any] = [own_axes(law), own_axes(numbers)]
    if others:
        trees, axes = [*trees, dict(others)], [*axes, dict(own_axes_of_others)]
    flat = flattened(trees, axes, shape)
    double = any(leaf.dtype == np.float64 for leaf in jax.tree.leaves(trees))
    enable_cache()
    walked = functools.partial(compiled(share), structure)

    def walk(rows: np.ndarray, sharding: Sharding) -> Metrics:
        law, numbers, *others = rows_of(flat, axes, rows)
        # batched, come what may: one robot's would have lost the axis
        numbers = dataclasses.replace(numbers, kp=np.broadcast_to(numbers.kp, share))
        others = [_batched(tree, own, share) for tree, own in zip(others, axes[2:], strict=True)]
        with devices.on_host(), jax.enable_x64(double):  # holds for one thread
            return walked(*jax.device_put((law, numbers, *others), sharding))

    result = devices.spread(walk, count, share, progress, backend)
    return {name: value.reshape((*shape, *value.shape[1:])) for name, value in result.items()}
