"""The discrete stability limit of a control law: which gains let a small disturbance grow.

The closed loop (robot, contacts, joint loop, law, and the hardware between them: delays, filter, control period,
armature, viscous friction) is linearised over one control period about stances of the gait, without gravity; small
disturbances grow in a stance where the largest eigenvalue of that period leaves the unit circle. Between two moments at
which some foot is lifted off or set down the same feet hold: the stances are those of the beginning, the middle and the
end of each such time in a cycle, on uneven ground in every cycle of the walk. The worst of them counts, not the product
over the cycle: a disturbance that grows in one stance and dies out in the next is smaller after a cycle, and yet tears
grippers off in between. This is the limit of the loop as it is simulated, not of the law by itself: the virtual model
alone is stable for any positive gains.

What has no linear part is left out: noise, bias, resolution, the limits of torque, offset and rate. So are dry
friction, backlash and a deadband, which hold a robot still that would else begin to shake: the limit is that of larger
motions, which slip.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.compilation import devices
from mjx_climb.compilation.cpu_pieces import in_kernels
from mjx_climb.compilation.first_possible import in_pieces_or_whole
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.compilation.machine import source_digest
from mjx_climb.control import Law, law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.dynamics.kinematics import limb_frames
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate_back
from mjx_climb.hardware.control_period import period_steps
from mjx_climb.hardware.stages import Stages
from mjx_climb.quantities.batches import batch_last, flattened, own_axes, rows_of
from mjx_climb.quantities.parameters import own_numbers
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.identity import identity
from mjx_climb.rollouts.rollout import given_in
from mjx_climb.walk import control_loop, gait
from mjx_climb.walk.contact import Attitude
from mjx_climb.walk.inverse_kinematics import inverse_kinematics
from mjx_climb.walk.step import Carry, Structure, Walk, advance, begin, prepare, structure

ROUNDING = 1e-9  # a radius above 1 by less is 1
# of the matrices of one compiled batch, about: with twice as many XLA refuses the pieces of some laws' steps
_ENTRIES = 32 * 50**2
_LARGEST_BATCH = 32  # matrices
_FINEST = 16  # values along an axis of a map
_FINEST_WITH_MEMORY = 8  # the same where delays make the matrices large
_MANY = 1000  # matrices, from which on a faster program is worth what it takes to compile
_CLEAR = 2  # steps from where a foot is lifted off or set down: it is off the ground there
_UNBOUNDED = {"control.deadband": 0.0, "control.max_offset": None, "control.max_velocity": None}


def spectral_radius(
    scenario: mc.Scenario,
    gains: AnyGains,
    numbers: mc.Parameters | None = None,
    *,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> np.ndarray:
    """Return by how much a small disturbance grows in a time step of the worst stance; the loop is stable below 1.

    It is the largest magnitude of an eigenvalue of one control period, taken to the power of a step, in any stance of
    the scenario's gait; where the scenario has cargo, of the robot without it or with it. What a law remembers in whole
    numbers, or in yes and no, stays as it is: it cannot be off by a little.

    Arguments:
        scenario: what walks where.
        gains: with any leading batch axes.
        numbers: parameters in place of the scenario's, delays, period and filter among them, with batch axes that
            broadcast with the gains'.
        law: whose gains they are, the scenario's where None.
        engine: the dynamics.

    Returns:
        Radii with the batch axes of gains and numbers.
    """
    return np.asarray(by_stance(scenario, gains, numbers, law=law, engine=engine).max(-1))


def by_stance(
    scenario: mc.Scenario,
    gains: AnyGains,
    numbers: mc.Parameters | None = None,
    *,
    only: int | None = None,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> np.ndarray:
    """Return the radii of `spectral_radius` in each stance, the last axis: of robots without cargo, then with it.

    The other arguments are those of `spectral_radius`; `only` is the number of one stance, which is then the only one.
    """
    if law is None:
        law = law_of(scenario.with_overrides(_UNBOUNDED))
    calm = _calm(scenario, numbers)
    law, calm, shape, _ = given_in(scenario, law, gains, calm, np.float64)
    trees, axes, count = (law, calm), (own_axes(law), own_axes(calm)), math.prod(shape)
    flat = flattened(trees, axes, shape)
    walk = structure(scenario, engine, calm, law=law, smooth=True, in_pieces=mc.pieces_pay(engine, "cpu"))
    walk = walk._replace(stages=_linear(walk.stages))
    steps = np.ones(count, int)
    if walk.stages.control_period:
        steps[:] = np.asarray(period_steps(jnp.asarray(flat[1].control_period), scenario.time_step))
    stances = _stances(scenario, steps, uneven=bool(calm.foothold_height.size))
    cargo = 2 if calm.cargo_mass.any() else 1
    which = np.arange(cargo * stances.shape[1]) if only is None else np.array([only])
    size, batch = count * which.size, _batch_of(walk.stages)
    with jax.enable_x64(True), jax.default_device(devices.host()):
        some, there = _rows(flat, axes, np.zeros(1, int), np.ones(1))
        kinds_of = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves((some, there)))
        states = _states(walk, jax.tree.structure((some, there)), kinds_of)
        run, column = _program(batch * states, walk.in_pieces, size > _MANY), np.repeat(np.arange(states), batch)

    def radii_of(start: int) -> np.ndarray:
        places = np.minimum(np.arange(start, start + batch), size - 1)
        rows, (loaded, stance) = places // which.size, np.divmod(which[places % which.size], stances.shape[1])
        first, period = stances[rows, stance], steps[rows]
        given = _rows(flat, axes, np.tile(rows, states), np.tile(loaded, states))
        # held: all further steps are alike; on a line to the next target each is another
        kinds = period.max() if walk.stages.linear else min(period.max(), 2)
        at = [np.tile(first + min(k, kinds - 1), states) for k in range(kinds)]
        with jax.enable_x64(True), jax.default_device(devices.host()):  # holds for one thread
            matrices = [np.asarray(run(walk, *given, step, column)).reshape(states, states, batch) for step in at]
        return _radii(np.stack(matrices).transpose(0, 3, 1, 2), period)[: size - start]

    with ThreadPoolExecutor(devices.usable_cores()) as threads:
        radii = np.concatenate(list(threads.map(radii_of, range(0, size, batch))))
    return np.asarray(radii.reshape(*shape, which.size))


def _stances(scenario: mc.Scenario, periods: np.ndarray, *, uneven: bool) -> np.ndarray:
    """Return at which steps (B, N) of a walk the loop is linearised, at whole multiples of control periods (B,)."""
    times, cycle = scenario.gait, scenario.gait.cycle / scenario.time_step
    moments = [0.0, 1.0, *(share + swing for share in times.lift_off.values() for swing in (0.0, 1 - times.duty))]
    switches = np.unique(np.round(np.multiply(moments, cycle)))
    switches = switches[np.diff(switches, prepend=-np.inf) > _CLEAR]  # shares are rounded
    if uneven:
        cycles = math.ceil(scenario.steps / cycle)
        switches = np.unique([switches + number * np.round(cycle) for number in range(cycles)])
    begin, end, period = switches[:-1], switches[1:], periods[:, None]
    first, last = np.ceil((begin + _CLEAR) / period), np.maximum(np.floor((end - _CLEAR + 1) / period) - 1, 0)
    middle = np.clip(np.round((begin + end) / 2 / period), first, last)
    return np.asarray(np.concatenate([np.minimum(first, last), middle, last], axis=1) * period)


def _rows(trees: Any, axes: Any, rows: np.ndarray, loaded: np.ndarray) -> tuple[Law, mc.Parameters]:
    """Return law and numbers of some rows, `loaded` (B,) with their cargo: all gains batched for one program."""
    law, numbers = rows_of(trees, axes, rows)
    law = jax.tree.map(
        lambda gain, own: np.broadcast_to(gain, (len(rows), *gain.shape[gain.ndim - own :])), law, axes[0]
    )
    kp = np.broadcast_to(numbers.kp, len(rows))
    return law, dataclasses.replace(numbers, kp=kp, cargo_mass=numbers.cargo_mass * loaded)


def _linear(stages: Stages) -> Stages:
    """Return the stages that have a linear part."""
    without = ("force_noise", "force_bias", "force_resolution", "base_noise", "torque_limit", "dry_friction",
               "backlash", "capture")  # fmt: skip
    return stages._replace(**dict.fromkeys(without, False))


def _batch_of(stages: Stages) -> int:
    """Return how many matrices are made at once: the more, the smaller they are."""
    samples = 4 + stages.force_delay + stages.base_delay + stages.command_delay + stages.servo_delay
    return max(1, min(_LARGEST_BATCH, _ENTRIES // (12 * samples) ** 2))


def _radii(steps: np.ndarray, periods: np.ndarray) -> np.ndarray:
    """Return radii (B,) of matrices (k, B, s, s) of the steps of a period, the last of which stands for all others."""
    radius = np.full(len(periods), np.inf)
    finite = np.isfinite(steps).all((0, 2, 3))
    if not finite.any():
        return radius
    matrices = steps[:, finite]
    core = _coupled((matrices != 0).any((0, 1)))
    alone = np.diagonal(matrices, axis1=2, axis2=3)[..., ~core]
    matrices = matrices[:, :, core][..., core]
    values = np.empty(matrices.shape[1])
    for period in np.unique(periods[finite]):
        rows = periods[finite] == period
        kinds = min(int(period), len(matrices))
        whole, single = np.eye(int(core.sum())), np.ones(alone.shape[-1])
        for k in range(kinds):
            times = int(period) - k if k == len(matrices) - 1 else 1
            whole = np.linalg.matrix_power(matrices[k, rows], times) @ whole
            single = single * alone[k, rows] ** times
        sizes = np.abs(np.concatenate([np.linalg.eigvals(whole), single], axis=-1))
        values[rows] = sizes.max(-1) ** (1 / period)
    radius[finite] = values
    return radius


def _coupled(acts: np.ndarray) -> np.ndarray:
    """Return which states (s,) act on others that act back on them, where `acts` (s, s) says who acts on whom.

    The eigenvalues are those of these states together and of each other state by itself.
    """
    reach = acts | np.eye(len(acts), dtype=bool)
    farther = (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
    while (farther != reach).any():
        reach, farther = farther, (farther.astype(np.float32) @ farther.astype(np.float32)) > 0
    return np.asarray((reach & reach.T).sum(1) > 1)


def over_map(
    scenario: mc.Scenario, walks: xr.Dataset, *, law: mc.Law | None = None, engine: str = DEFAULT_ENGINE
) -> xr.DataArray:
    """Return the radius over the two gains (the same on all axes) of a grid of walks, as far as `over_axes` has it."""
    axes = {str(name): walks[name].values for name in walks["diverged"].dims}
    return on_map(over_axes(scenario, axes, law=law, engine=engine), walks)


def over_axes(
    scenario: mc.Scenario,
    axes: Mapping[str, ArrayLike],
    *,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> xr.DataArray:
    """Return the radius over values of two gains, the same on all axes of one.

    Of more than 16 values along an axis (8 with delays in the loop) so many are taken.
    """
    finest = _FINEST if _batch_of(structure(scenario, engine).stages) == _LARGEST_BATCH else _FINEST_WITH_MEMORY
    some = {name: _spread(np.asarray(values, float), finest) for name, values in axes.items()}
    lengths = (law_of(scenario) if law is None else law).AXES
    mesh = zip(some, np.meshgrid(*some.values(), indexing="ij"), strict=True)
    gains = {name: values.reshape(-1, 1) if lengths.get(name) else values.ravel() for name, values in mesh}
    radius = spectral_radius(scenario, gains, law=law, engine=engine).reshape([v.size for v in some.values()])
    return xr.DataArray(radius, some, list(some), attrs={"units": "1", "long_name": "largest eigenvalue of one step"})


def _spread(values: np.ndarray, count: int) -> np.ndarray:
    """Return so many of the values, first and last among them."""
    some: np.ndarray = values[np.unique(np.linspace(0, values.size - 1, min(values.size, count)).round().astype(int))]
    return some


def on_map(radius: xr.DataArray, walks: xr.Dataset) -> xr.DataArray:
    """Return the radius at all gains of a grid of walks, NaN where it was not worked out."""
    names = [str(name) for name in walks["diverged"].dims]
    whole = radius.transpose(*names).reindex({name: walks[name] for name in names})
    return whole.assign_coords({name: walks[name] for name in names})  # with their units


@functools.cache
def _program(batch: int, in_pieces: bool, fast: bool) -> Callable[..., jax.Array]:
    def compiled(in_pieces: bool) -> Callable[..., jax.Array]:
        options = mc.compiler_options(batch, in_pieces=in_pieces, backend="cpu")
        options["xla_backend_optimization_level"] = int(fast)  # higher ones only compile for longer
        return kept(_columns, _identity, options)

    return in_pieces_or_whole(compiled) if in_pieces else compiled(False)


def _identity(shape: Structure, law: Law, *others: Any) -> str | None:
    """Return what a program of this module depends on, its own code too; see `mjx_climb.rollouts.identity`."""
    known = identity(shape, law, *others)
    return None if known is None else known + source_digest(Path(__file__).parent)


def _calm(scenario: mc.Scenario, numbers: mc.Parameters | None) -> mc.Parameters:
    """Return numbers, the scenario's own where None, without gravity and pushes, and with the cargo loaded."""
    numbers = own_numbers(scenario) if numbers is None else jax.tree.map(np.asarray, numbers)
    changed = {name: getattr(numbers, name) * 0 for name in ("gravity", "push_force", "push_moment")}
    changed |= {"cargo_start": np.zeros(()), "cargo_stop": np.full((), np.inf)}
    calm: mc.Parameters = dataclasses.replace(numbers, **changed)
    return calm


def _columns(shape: Structure, law: Law, numbers: mc.Parameters, step: jax.Array, column: jax.Array) -> jax.Array:
    """Return by how much the state (s, B) is off after the step of a number (B,), where one value of it was before.

    Which one is `column` (B,): a robot for each column of each matrix, as robots are what a step in pieces is fast at.
    """
    batch = len(numbers.kp)
    walk, carry = _stance(shape, law, numbers, step)
    remembered, whole = jax.tree.flatten((carry.law, carry.hardware))
    smooth = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in remembered]
    robot, tree = jax.tree.flatten(carry.state)
    before = (*robot, *(leaf for leaf, varied in zip(remembered, smooth, strict=True) if varied))

    def stepped(*before: jax.Array) -> list[jax.Array]:
        state = jax.tree.unflatten(tree, before[: len(robot)])
        varied = iter(before[len(robot) :])
        law, hardware = jax.tree.unflatten(
            whole, [next(varied) if kind else leaf for kind, leaf in zip(smooth, remembered, strict=True)]
        )
        after, _ = advance(walk, Carry(state, carry.contact, carry.gait, law, hardware), step)
        moved = jax.tree.leaves((after.law, after.hardware))
        return jax.tree.leaves(after.state) + [leaf for leaf, kind in zip(moved, smooth, strict=True) if kind]

    def moved(*off: jax.Array) -> list[jax.Array]:
        after: list[jax.Array] = jax.jvp(stepped, before, off)[1]
        return after

    sizes = [leaf.size // batch for leaf in before]
    places = jnp.split(jnp.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    off = [
        (place[:, None] == column).astype(leaf.dtype).reshape(leaf.shape)
        for place, leaf in zip(places, before, strict=True)
    ]
    after = (in_kernels(moved) if shape.in_pieces else moved)(*off)
    return jnp.concatenate([leaf.reshape(-1, batch) for leaf in after])


def _stance(shape: Structure, law: Law, numbers: mc.Parameters, step: jax.Array) -> tuple[Walk, Carry]:
    """Return robots that stand as they should at a step (B,), and have never been otherwise."""
    batch, dtype = len(numbers.kp), jnp.result_type(float)
    walk = prepare(shape, batch_last(law, (batch,), dtype), batch_last(numbers, (batch,), dtype), batch)
    carry = begin(walk, batch)
    now = gait.schedule(walk.plan, step)
    _, start = gait.nominal_start(walk.plan, now, carry.gait, carry.gait)
    base = jnp.broadcast_to(gait.base_reference(walk.plan, now, start), (3, batch))
    rotation = quaternion_to_matrix(walk.plan.base_orientation)[:, :, None]
    grip = walk.plan.footholds + now.foothold * walk.plan.advance[:, None]
    grip = jnp.broadcast_to(grip.at[2].add(gait.ground_height(walk.plan, now)), carry.contact.grip_point.shape)
    target = gait.foot_targets(walk.plan, now, grip)
    joints = inverse_kinematics(walk.controller.geometry, rotate_back(rotation, target - base[:, None])).joint_angles
    state = dataclasses.replace(carry.state, base_position=base, joint_angles=joints)
    memory = control_loop.start(state, jnp.broadcast_to(target, grip.shape), walk.controller)
    touching = jnp.broadcast_to(now.closed, carry.contact.touching.shape)
    contact = carry.contact._replace(grip_point=grip, touching=touching)
    if walk.controller.stages.rotational:  # grips hold the attitudes that feet have now
        frames = limb_frames(walk.robot, quaternion_to_matrix(state.base_orientation), joints)
        contact = contact._replace(attitude=Attitude(frames.rotation[-1], touching))
    return walk, carry._replace(state=state, contact=contact, hardware=memory)


@functools.lru_cache(maxsize=8)
def _states(shape: Structure, tree: Any, kinds: tuple[Any, ...]) -> int:
    """Return how many values of a robot can be off by a little, from the kinds of a law's and parameters' arrays."""
    law, numbers = jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*kind) for kind in kinds])
    carry = jax.eval_shape(lambda *given: _stance(shape, *given)[1], law, numbers, jax.ShapeDtypeStruct((1,), float))
    leaves = jax.tree.leaves((carry.state, carry.law, carry.hardware))
    return sum(leaf.size for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))
