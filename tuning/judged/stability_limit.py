"""The discrete stability limit of a control law: which gains let a small disturbance grow.

The closed loop (robot, contacts, joint loop, law) is linearised over one time step about the stance in the middle of
the first swing, without gravity; small disturbances grow where the largest eigenvalue of that step leaves the unit
circle. This is the limit of the loop as it is simulated, not of the law by itself: the virtual model alone is stable
for any positive gains.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.compilation import devices
from mjx_climb.control import Law, law_of
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.dynamics.spatial import quaternion_to_matrix, rotate_back
from mjx_climb.dynamics.state import State
from mjx_climb.hardware.stages import IDEAL
from mjx_climb.quantities.batches import batch_last, flattened, own_axes, rows_of
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.rollout import given_in
from mjx_climb.walk import gait
from mjx_climb.walk.inverse_kinematics import inverse_kinematics
from mjx_climb.walk.step import Structure, advance, begin, prepare, structure

_CHUNK = 64  # gain sets per compiled batch
_FINEST = 48  # values along an axis of a map
_Varied = tuple[State, Any]  # of the robot and of the law


def spectral_radius(
    scenario: mc.Scenario, gains: AnyGains, *, law: mc.Law | None = None, engine: str = DEFAULT_ENGINE
) -> np.ndarray:
    """Return the largest magnitude (B,) of an eigenvalue of one step, for gains (B, 6); the loop is stable below 1.

    What a law remembers in whole numbers, or in yes and no, stays as it is: it cannot be off by a little.
    """
    law, numbers, shape, _ = given_in(scenario, law, gains, _calm(scenario), np.float64)
    count = math.prod(shape)
    trees, axes = (law, numbers), (own_axes(law), own_axes(numbers))
    flat = flattened(trees, axes, shape)
    walk = structure(scenario, engine, smooth=True, in_pieces=False)._replace(stages=IDEAL)
    radii = []
    with jax.enable_x64(True), jax.default_device(devices.host()):
        run = _program(walk, scenario.gait.cycle * (1 - scenario.gait.duty))
        for start in range(0, count, _CHUNK):
            rows = np.minimum(np.arange(start, start + _CHUNK), count - 1)
            some, there = rows_of(flat, axes, rows)
            there = dataclasses.replace(there, kp=np.broadcast_to(there.kp, len(rows)))  # batched, come what may
            matrices = np.asarray(run(some, there))
            finite = np.isfinite(matrices).all((1, 2))
            radius = np.full(len(rows), np.inf)
            radius[finite] = np.abs(np.linalg.eigvals(matrices[finite])).max(1)
            radii.append(radius[: count - start])
    return np.concatenate(radii)


def over_map(
    scenario: mc.Scenario, walks: xr.Dataset, *, law: mc.Law | None = None, engine: str = DEFAULT_ENGINE
) -> xr.DataArray:
    """Return the radius over the two gains (the same on all axes) of a grid of walks.

    A grid of more than 48 values along an axis has it at 48 of them, and NaN between.
    """
    axes, names = {}, [str(name) for name in walks["diverged"].dims]
    for name in names:
        values = walks[name].values
        axes[name] = values[np.unique(np.linspace(0, values.size - 1, min(values.size, _FINEST)).round().astype(int))]
    lengths = (law_of(scenario) if law is None else law).AXES
    mesh = zip(names, np.meshgrid(*axes.values(), indexing="ij"), strict=True)
    gains = {name: values.reshape(-1, 1) if lengths.get(name) else values.ravel() for name, values in mesh}
    radius = spectral_radius(scenario, gains, law=law, engine=engine).reshape([v.size for v in axes.values()])
    about = {"units": "1", "long_name": "largest eigenvalue of one step"}
    made = xr.DataArray(radius, axes, names, attrs=about)
    whole = made.reindex({name: walks[name] for name in names})
    return whole.assign_coords({name: walks[name] for name in names})  # with their units


@functools.lru_cache(maxsize=8)
def _program(shape: Structure, swing_time: float) -> Callable[[Law, mc.Parameters], jax.Array]:
    # whole: XLA refuses some pieces of the derivative of a step
    options = mc.compiler_options(_CHUNK, backend="cpu")
    if options:
        options["xla_backend_optimization_level"] = 0  # one step is walked so fast that only the compiler's time counts
    return jax.jit(functools.partial(_jacobian, shape, swing_time), compiler_options=options)


def _calm(scenario: mc.Scenario) -> mc.Parameters:
    """Return the scenario's numbers without gravity, cargo and pushes."""
    with jax.enable_x64(True):
        numbers = jax.tree.map(np.asarray, mc.parameters(scenario))
    zero = {name: np.zeros_like(getattr(numbers, name)) for name in ("gravity", "cargo_mass")}
    zero |= {name: getattr(numbers, name) * 0 for name in ("push_force", "push_moment")}
    calm: mc.Parameters = dataclasses.replace(numbers, **zero)
    return calm


def _jacobian(shape: Structure, swing_time: float, law: Law, numbers: mc.Parameters) -> jax.Array:
    """Return the matrices (B, s, s) that map a small change of state over one step."""
    batch, dtype = len(numbers.kp), jnp.result_type(float)
    walk = prepare(shape, batch_last(law, (batch,), dtype), batch_last(numbers, (batch,), dtype), batch)
    carry = begin(walk, batch)
    step = jnp.asarray(round(swing_time / 2 / shape.time_step))
    now = gait.schedule(walk.plan, step)
    base = jnp.broadcast_to(gait.base_reference(walk.plan, now, walk.plan.base_start), (3, batch))
    rotation = quaternion_to_matrix(walk.plan.base_orientation)[:, :, None]
    target = gait.foot_targets(walk.plan, now, carry.contact.grip_point)
    joints = inverse_kinematics(walk.controller.geometry, rotate_back(rotation, target - base[:, None])).joint_angles
    closed = jnp.broadcast_to(now.closed, carry.contact.touching.shape)
    carry = carry._replace(
        state=dataclasses.replace(carry.state, base_position=base, joint_angles=joints),
        contact=carry.contact._replace(touching=closed),
    )
    smooth = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in carry.law]
    before = (carry.state, [leaf for leaf, varied in zip(carry.law, smooth, strict=True) if varied])
    leaves, tree = jax.tree.flatten(before)
    sizes = [leaf.size // batch for leaf in leaves]
    rows = jnp.split(jnp.eye(sum(sizes)), np.cumsum(sizes)[:-1], axis=1)
    each = [
        jnp.broadcast_to(row.reshape(-1, *leaf.shape[:-1], 1), (len(row), *leaf.shape))
        for row, leaf in zip(rows, leaves, strict=True)
    ]

    def stepped(before: _Varied) -> _Varied:
        after, _ = advance(walk, carry._replace(state=before[0], law=before[1]), step)
        return after.state, after.law

    def columns(before: _Varied, directions: _Varied) -> _Varied:
        along: _Varied = jax.vmap(lambda direction: jax.jvp(stepped, (before,), (direction,))[1])(directions)
        return along

    moved = jax.tree.leaves(columns(before, jax.tree.unflatten(tree, each)))
    matrix = jnp.concatenate([leaf.reshape(sum(sizes), -1, batch) for leaf in moved], axis=1)  # (column, row, B)
    return jnp.transpose(matrix, (2, 1, 0))
