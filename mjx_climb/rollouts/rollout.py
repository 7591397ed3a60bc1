"""Rollouts: one robot with full histories, or a batch with its metrics alone; jit-compiled once per shape."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding
from numpy.typing import DTypeLike

from mjx_climb.checks.time_step import check_time_step
from mjx_climb.compilation import devices
from mjx_climb.compilation.cache import enable_cache
from mjx_climb.compilation.cpu_pieces import in_kernels, scan_in_kernels
from mjx_climb.compilation.first_possible import first_possible, in_pieces_or_whole
from mjx_climb.compilation.forward_only import forward_only
from mjx_climb.compilation.gpu_kernel import over_robots
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.compilation.options import compiler_options, kernel_pays, pieces_pay, walks_on_host
from mjx_climb.control import Law, law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.batches import batch_last, batch_shape, flattened, own_axes, varying
from mjx_climb.quantities.parameters import Parameters, own_numbers
from mjx_climb.robot.constants import load_robot
from mjx_climb.rollouts.given import AnyGains, Given, checked, checked_dtype, given, recorded
from mjx_climb.rollouts.identity import identity
from mjx_climb.rollouts.trajectory import Trajectory, from_samples
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import METRICS, Context, Metric, running
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Structure, advance, begin, prepare, structure

_Result = TypeVar("_Result")
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
    scan = scan_in_kernels if structure.in_pieces else jax.lax.scan
    (_, values), records = scan(step, start, length=structure.steps)
    result = running.finish(metrics, values, context)
    return {name: value.reshape(shape) for name, value in result.items()}, records


def _samples_of(structure: Structure, law: Law, numbers: Parameters) -> Sample:
    """Walk one robot and return every sample, stacked over time."""
    dtype = jnp.result_type(numbers.kp)
    walk = prepare(structure, batch_last(law, (), dtype), batch_last(numbers, (), dtype), 1)
    step: Callable[[Carry, Array], tuple[Carry, Sample]] = functools.partial(advance, walk)
    step = in_kernels(step) if structure.in_pieces else step
    return jax.lax.scan(step, begin(walk, 1), jnp.arange(structure.steps))[1]


def compiled_walk(
    function: Callable[..., _Result], batch: int, in_pieces: bool, backend: str | None
) -> Callable[..., _Result]:
    """Return the program of a function of a structure, law, numbers and more, kept on disk, for so many robots."""

    def compiled(in_pieces: bool) -> Callable[..., _Result]:
        return kept(function, identity, compiler_options(batch, in_pieces=in_pieces, backend=backend))

    return in_pieces_or_whole(compiled) if in_pieces else compiled(False)


@functools.cache
def _compiled_samples(in_pieces: bool) -> Callable[..., Sample]:
    return compiled_walk(_samples_of, 1, in_pieces, "cpu")


@functools.cache
def _compiled_metrics(batch: int, in_pieces: bool, backend: str | None) -> Callable[..., Metrics]:
    return compiled_walk(metrics_of, batch, in_pieces, backend)


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
    law = law_of(scenario) if law is None else checked(law)
    shape = structure(scenario, engine, law=law, metrics=metrics, smooth=smooth, in_pieces=in_pieces)
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
        dtype = checked_dtype(_floating_dtype(law if gains is None else gains))
        array = functools.partial(jnp.asarray, dtype=dtype)
        numbers = own_numbers(scenario) if numbers is None else numbers
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
        shape = structure(scenario, engine, walker.numbers, law=law, in_pieces=pieces_pay(engine, "cpu"))
        with jax.enable_x64(np.dtype(dtype) == np.float64):
            samples = _compiled_samples(shape.in_pieces)(shape, walker.law, walker.numbers)
            samples = jax.tree.map(np.asarray, samples)
    own = jax.tree.map(functools.partial(np.asarray, dtype=dtype), walker.own)
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
    array = functools.partial(np.asarray, dtype=checked_dtype(dtype))
    with devices.on_host(), jax.enable_x64(True):
        return given(scenario, law, gains, own_numbers(scenario) if numbers is None else numbers, array)


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
        ValueError: shapes that do not broadcast, gains that the law does not have, or cannot have, parameters that no
            scenario could have, no robots, or another precision than float32 and float64.
    """
    check_time_step(scenario)
    walkers = given_in(scenario, law, gains, numbers, dtype)
    backend = backend_of(walkers, engine, dtype)
    in_kernel = backend is None and kernel_pays(engine, dtype)
    in_pieces = pieces_pay(engine, backend)
    how: dict[str, Any] = {"metrics": metrics, "smooth": smooth, "in_pieces": in_pieces}
    walk = structure(scenario, engine, walkers.numbers, law=law, **how)

    def program(robots: int) -> Callable[..., Metrics]:
        return _compiled_kernel(robots) if in_kernel else _compiled_metrics(robots, walk.in_pieces, backend)

    return walk_batch(program, walk, walkers, batch_size=batch_size, progress=progress, backend=backend)


def walks_in_pieces(scenario: Scenario, numbers: Parameters | None = None, engine: str = DEFAULT_ENGINE) -> bool:
    """Return whether the steps of a batch that walks on JAX's default device are compiled in pieces."""
    return structure(scenario, engine, numbers, in_pieces=pieces_pay(engine)).in_pieces


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
    # slopes have the arrays of several walks
    small = structure.in_pieces and not others
    share = devices.share_size(count, batch_size, backend, in_pieces=small)
    trees: list[Any] = [law, numbers]
    axes: list[Any] = [own_axes(law), own_axes(numbers)]
    if others:
        trees, axes = [*trees, dict(others)], [*axes, dict(own_axes_of_others)]
    law, numbers, *rest = flattened(trees, axes, shape)
    # batched, come what may: one robot's would have lost the axis
    numbers = dataclasses.replace(numbers, kp=np.broadcast_to(numbers.kp, count))
    rest = [_batched(tree, own, count) for tree, own in zip(rest, axes[2:], strict=True)]
    leaves, tree = jax.tree.flatten((law, numbers, *rest))
    varies = [leaf.ndim > own for leaf, own in zip(leaves, jax.tree.leaves(axes), strict=True)]
    double = any(leaf.dtype == np.float64 for leaf in leaves)
    enable_cache()
    walked = functools.partial(compiled(share), structure)

    @functools.cache
    def same_for_all(sharding: Sharding) -> list[Array]:
        """Return what does not vary on a device, put there once."""
        same: list[Array] = jax.device_put([v for v, own in zip(leaves, varies, strict=True) if not own], sharding)
        return same

    def walk(rows: np.ndarray, sharding: Sharding) -> Metrics:
        with devices.on_host(), jax.enable_x64(double):  # holds for one thread
            each = jax.device_put([leaf[rows] for leaf, own in zip(leaves, varies, strict=True) if own], sharding)
            by_kind = {True: iter(each), False: iter(same_for_all(sharding))}
            return walked(*jax.tree.unflatten(tree, [next(by_kind[own]) for own in varies]))

    result = devices.spread(walk, count, share, progress, backend)
    return {name: value.reshape((*shape, *value.shape[1:])) for name, value in result.items()}
