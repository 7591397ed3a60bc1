"""The discrete stability limit of a control law: which gains let a small disturbance grow.

The closed loop (robot, contacts, joint loop, law, and the hardware between them: delays, filter, control period,
armature, viscous friction, back EMF) is linearised over one control period about stances of the gait, without
gravity; small disturbances grow in a stance where the largest eigenvalue of that period leaves the unit circle. Between
two moments at which some foot is lifted off or set down the same feet hold: the stances are those of the beginning, the
middle and the end of each such time in a cycle, on uneven ground in every cycle of the walk. The worst of them counts,
not the product over the cycle: a disturbance that grows in one stance and dies out in the next is smaller after a
cycle, and yet tears grippers off in between. This is the limit of the loop as it is simulated, not of the law by
itself: the virtual model alone is stable for any positive gains.

Left out are parts that are not linear: noise, bias, resolution, a sensor that dies, the limits of torque, offset and
rate, the profile of the servos' goals. The servos' own loop runs every time step here, at any rate. Left out are also
dry friction, backlash and a deadband, which hold a robot still that would else begin to shake: the limit is that of
larger motions, which slip.

Delays are linear already. So JAX differentiates a loop whose signals are all one time step late, and `_with_delays`
puts the buffers of any delays around it: one compiled program serves all delays, and it is small.

Over a map of two gains of a law the Jacobians of a stance are weighted sums of a few of them, by the same weights in
every stance: six of a law that discretises mass, damping and stiffness exactly. So all of them are computed in the
first stance alone, and a few in the others, with two more that check it.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are imported when they are first used
import xarray as xr
from jax import Array
from jax.extend.core import jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.component import given
from mjx_climb.control import Law, law_of
from mjx_climb.disturbances.on_base import Cargo
from mjx_climb.execution import devices
from mjx_climb.execution.jax_types import PyTree
from mjx_climb.gait import schedule as gait
from mjx_climb.hardware import bus
from mjx_climb.hardware.stages import DELAYED
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains, resolve_in
from mjx_climb.parameter_types import path_of_gain
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.physics.inverse_kinematics import inverse_kinematics
from mjx_climb.physics.kinematics import foot_kinematics, foot_turning, limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.walk import control_loop
from mjx_climb.walk.step import Carry, Walk, advance, begin, constants_of_law, set_up, walk_of
from mjx_climb.walk.structure import Structure, structure
from tuning.problem.variations import as_walked

ROUNDING = 1e-9  # a radius above 1 by less is 1
_ENTRIES = 512 * 50**2  # of the matrices that are made at once, about: 10 MB
_MOST_MATRICES = 512
_ROBOTS_OF_A_CALL = 16
_FEWEST_ROBOTS = 16  # whose Jacobians are looked at for weighted sums
_CHECKED = 2  # of these sums in each stance, of robots so far apart
_APART = 7
_NO_PART = 1e-13  # of the largest Jacobian, what is left of one whose sum is exact but for rounding
_FEWEST_MATRICES = 9  # with fewer, calls hold fewer robots, by another program; see `execution.devices`
# Of the matrices that one call makes, 160 kB: XLA:CPU computes arrays of some 256 kB and more by several threads, and
# makes invalid code of a region that holds one ("Incorrect number of arguments passed to called function", jaxlib 0.10)
_ENTRIES_OF_A_CALL = 20_000
_FINEST = 16  # values along an axis of a map
_FINEST_WITH_MEMORY = 8  # the same where delays make the matrices large
_CLEAR = 2  # steps from where a foot is lifted off or set down: it is off the ground there
_NOT_LINEAR = ("force_noise", "force_bias", "force_resolution", "force_dead", "base_noise", "torque_limit",
               "current_limit", "dry_friction", "stribeck", "load_torque", "profile", "servo_rate",
               "backlash")  # fmt: skip
_LATE = ("base", "command", "force")  # the signals whose delays are put around the compiled program
_REST = "rest"  # of the states, by name behind the signals
_ONE_STEP = 2  # samples of a buffer whose signal is one time step late: the newest, and the one before
_PERIOD, _CARGO = "hardware.control_period", "disturbance.cargo.mass"
HARDWARE = (*(DELAYED[part] for part in _LATE), _PERIOD)  # stages that a loop may have at any of their values
# by robot in every call, so that all share a program
_OWN_OF_EACH = (*map(path_of_gain, ("kp", "kd", "ki")), _CARGO, *HARDWARE)
_REACH = "contact.capture_distance"
_UNBOUNDED = {"control.deadband": 0.0, "control.max_offset": None, "control.max_velocity": None}
_Robots = tuple[Law, mc.Parameters]  # of one batch axis: every gain has it, and parameters of one's own


def spectral_radius(
    scenario: mc.Scenario,
    gains: AnyGains,
    parameters: mc.Parameters | None = None,
    *,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> np.ndarray:
    """Return by how much a small disturbance grows in a time step of the worst stance; the loop is stable below 1.

    It is the largest magnitude of an eigenvalue of one control period, taken to the power of a step, in any stance of
    the scenario's gait; where the scenario has cargo, of the robot without it or with it. A law's whole
    numbers and truth values stay as they are: they cannot be off by a little.

    Arguments:
        gains: with any leading batch axes, which the radii have too.
        parameters: in place of the scenario's, delays, period and filter among them, with axes that broadcast with
            the gains'.
        law: whose gains they are, the scenario's where None.
    """
    return np.asarray(by_stance(scenario, gains, parameters, law=law, engine=engine).max(-1))


def by_stance(
    scenario: mc.Scenario,
    gains: AnyGains,
    parameters: mc.Parameters | None = None,
    *,
    only: int | None = None,
    hardware: Collection[str] = (),
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
) -> np.ndarray:
    """Return the radii of `spectral_radius` in each stance, the last axis: of robots without cargo, then with it.

    The other arguments are those of `spectral_radius`.

    Arguments:
        only: the number of one stance, which is then the only one.
        hardware: those of `HARDWARE` that the loop has at any of their values, so that calls that vary one or the other
            of them share a compiled program.
    """
    if law is None:
        law = law_of(scenario.with_overrides(_UNBOUNDED))
    calm = own_parameters(scenario) if parameters is None else jax.tree.map(np.asarray, parameters)
    cargo = [each for each in calm.disturbances if isinstance(each, Cargo)][:1]
    calm = dataclasses.replace(calm, gravity=calm.gravity * 0, disturbances=tuple(cargo))
    always = {"disturbance.cargo.start": np.zeros(()), "disturbance.cargo.stop": np.full((), np.inf)}
    always |= {_REACH: np.full((), np.inf)} if _REACH in calm.paths else {}
    calm = calm.replace(always)
    found = resolve_in(scenario, law, gains, calm, np.float64)
    walk = structure(scenario, engine, found.parameters, law=law, smooth=True)
    stages = walk.stages._replace(**dict.fromkeys(_NOT_LINEAR, False))
    stages = stages._replace(control_period=stages.control_period or _PERIOD in hardware)
    linear = stages.control_period and scenario.hardware.interpolation == "linear"
    late = [part for part in _LATE if getattr(stages, f"{part}_delay") or DELAYED[part] in hardware]
    buffers: dict[str, Any] = {f"{part}_delay": _ONE_STEP for part in late}
    walk = walk._replace(stages=stages._replace(linear=linear, **buffers))
    periods = np.ones(found.shape, int)
    if walk.stages.control_period:
        periods[...] = np.asarray(
            bus.period_steps(jnp.asarray(found.parameters.bus.control_period), scenario.time_step)
        )
    stances = linearised_at(scenario, periods.ravel(), uneven=bool(calm.ground.foothold_height.size))
    loads = 2 if given(calm.at(_CARGO)) else 1
    which = np.arange(loads * stances.shape[1]) if only is None else np.array([only])
    rows, places = (each.ravel() for each in np.indices((periods.size, which.size)))
    loaded, stance = np.divmod(which[places], stances.shape[1])

    def of_rows(value: np.ndarray, own: int) -> np.ndarray:
        """Return the values of robots by their rows."""
        tail = value.shape[value.ndim - own :]
        return np.broadcast_to(value, (*found.shape, *tail)).reshape(periods.size, *tail)[rows]

    def if_varied(value: np.ndarray, own: int) -> np.ndarray:
        return of_rows(value, own) if value.ndim > own else value

    law = jax.tree.map(of_rows, found.law, found.axes[0])
    parameters = jax.tree.map(if_varied, found.parameters, found.axes[1])  # each that is one a robot costs time to pass
    each = {path: of_rows(found.parameters.at(path), 0) for path in _OWN_OF_EACH}
    delays = {part: each[DELAYED[part]] / scenario.time_step for part in late}
    each |= {DELAYED[part]: np.full(rows.size, scenario.time_step) for part in late}
    each[_CARGO] = each[_CARGO] * loaded
    robots = law, parameters.replace(each)
    each_period, first = periods.ravel()[rows], stances[rows, stance]
    radii = radii_of(walk, robots, found.axes, delays, each_period, first, stances=which.size)
    return np.asarray(radii.reshape(*found.shape, which.size))


def radii_of(
    walk: Structure,
    robots: _Robots,
    axes: PyTree,
    delays: Mapping[str, np.ndarray],
    periods: np.ndarray,
    first: np.ndarray,
    *,
    stances: int = 1,
) -> np.ndarray:
    """Return the radii (N,) of robots, linearised over their control periods (N,), which begin at a `first` step.

    `axes` are those of one robot's values, `delays` those of signals, in time steps, (N,) each. The rows are those of
    each robot in so many `stances`.
    """

    def one(value: np.ndarray, own: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(value.shape[value.ndim - own :], value.dtype)

    off, step = jax.ShapeDtypeStruct((), np.dtype(float)), jax.ShapeDtypeStruct((), np.dtype(np.int32))
    of_one = off, *jax.tree.map(one, robots, axes), step
    sizes = {name: math.prod(shape) for name, shape in execution.shapes_of(_moved, walk, *of_one).items()}
    states = sum(sizes.values())
    # robots that differ in their delays alone are linearised once
    varied = [value for value, own in zip(*map(jax.tree.leaves, (robots, axes)), strict=True) if value.ndim > own]
    known = [np.reshape(value, (len(periods), -1)) for value in (*varied, first)]
    _, own, of = np.unique(np.concatenate(known, axis=1), axis=0, return_index=True, return_inverse=True)
    of = of.ravel()
    late = np.stack([delays[name] for name in sizes if name != _REST], axis=1) if delays else np.zeros((len(of), 0))
    call = min(_ROBOTS_OF_A_CALL, max(1, _ENTRIES_OF_A_CALL // states**2))
    most = max(call, _FEWEST_MATRICES, min(_MOST_MATRICES, _ENTRIES // states**2))

    def jacobians(rows: np.ndarray) -> list[np.ndarray]:
        """Return the transposed Jacobians (R, states, states) of the steps of a period, the last repeated."""
        # held: all steps after the first of a period are alike; on a line to the next target each is another
        longest, found = int(periods[rows].max()), []
        padded = np.resize(rows, max(len(rows), _FEWEST_MATRICES))
        some = jax.tree.map(lambda value, own: value[padded] if value.ndim > own else value, robots, axes)
        still, columns = np.zeros((len(padded), states)), np.broadcast_to(np.eye(states), (len(padded), states, states))
        for kind in range(longest if walk.stages.linear else min(longest, 2)):
            step = (first[padded] + kind).astype(np.int32)
            linearised = execution.Robots((still, *some, step), (1, *axes, 0), (len(padded),), columns)
            _, tangents = execution.run(_moved, walk, linearised, batch_size=call, compile_briefly=True)
            found.append(np.concatenate([tangents[name] for name in sizes], axis=-1)[: len(rows)])
        return found

    def with_delays(
        cores: np.ndarray, steps: list[np.ndarray], weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return which robots have some Jacobians, or weighted sums of these, and their radii."""
        steps = steps if weights is None else [np.tensordot(weights, step, 1) for step in steps]
        place = np.full(len(own), -1)
        place[cores] = np.arange(len(cores))
        mine = np.flatnonzero(place[of] >= 0)
        radii = np.empty(len(mine))
        for each in np.unique(late[mine], axis=0):
            alike = (late[mine] == each).all(1)
            rows = mine[alike]
            buffers = [_weights(steps_late) for steps_late in each]
            whole = [_with_delays(step[place[of[rows]]], list(sizes.values()), buffers) for step in steps]
            radii[alike] = _radii(whole, periods[rows])
        return mine, radii

    radii, left, table = np.empty(len(periods)), np.arange(len(own)), np.unique(of.reshape(-1, stances), axis=0)
    # eigenvalues of these while the next are made; threads of BLAS would only wait for a core
    with ThreadPoolExecutor(devices.usable_cores()) as beside, threadpool_limits(1, "blas"):
        begun = []
        if stances > 1 and _FEWEST_ROBOTS <= len(table) <= most and np.ptp(periods) == 0:
            known = jacobians(own[table[:, 0]])
            begun.append(beside.submit(with_delays, table[:, 0], known))
            left = np.setdiff1d(left, table[:, 0])
            if (found := _few_of(np.concatenate([step.reshape(len(step), -1) for step in known], axis=1))) is not None:
                few, weights = found
                some = _of_few(table, few, weights, lambda cores: jacobians(own[cores]), periods)
                begun += [beside.submit(with_delays, *each, weights) for each in some]
                left = left if not some else left[:0]
        for cores in (left[start : start + most] for start in range(0, len(left), most)):
            begun.append(beside.submit(with_delays, cores, jacobians(own[cores])))
        for part in begun:
            mine, of_mine = part.result()
            radii[mine] = of_mine
    return radii


def _of_few(
    table: np.ndarray, few: np.ndarray, weights: np.ndarray, jacobians: Callable[[np.ndarray], list[np.ndarray]],
    periods: np.ndarray,
) -> list[tuple[np.ndarray, list[np.ndarray]]]:  # fmt: skip
    """Return the robots in each stance but the first, and a few Jacobians (F, s, s) there of each step of a period.

    Their weighted sums are the Jacobians of all these robots: none are returned where some, which are computed alone,
    have other radii.

    Arguments:
        table: the numbers (C, S) of the robots in each stance.
        few: (F,) robots, and the weights (C, F), see `_few_of`.
        jacobians: of robots by number.
        periods: the control period, one or more times.
    """
    stances, others = table.T[1:], np.setdiff1d(np.arange(len(table)), few)
    checked = others[np.arange(len(stances) * _CHECKED).reshape(-1, _CHECKED) * _APART % len(others)]
    asked = np.stack([stance[[*few, *alone]] for stance, alone in zip(stances, checked, strict=True)])
    made = [step.reshape(*asked.shape, *step.shape[1:]) for step in jacobians(asked.ravel())]
    sums = [np.einsum("scf,sfij->scij", weights[checked], step[:, : len(few)]) for step in made]
    alone = [step[:, len(few) :] for step in made]
    periods = np.resize(periods, checked.size)
    found, expected = (_radii([np.concatenate(step) for step in steps], periods) for steps in (sums, alone))
    if not np.allclose(found, expected, rtol=0, atol=ROUNDING):
        return []
    return [(stance, [step[number, : len(few)] for step in made]) for number, stance in enumerate(stances)]


def _few_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a few rows of values (C, n), and the weights (C, few) by which their sums make up all rows.

    None where it takes more than a quarter of them. The rows are those by which least is left of the others, one after
    the other: so weights stay small, and rounding too.
    """
    if not np.isfinite(values).all():
        return None
    left, few, parts = values.copy(), list[int](), list[np.ndarray]()
    sizes = np.linalg.norm(left, axis=1)
    least = _NO_PART * sizes.max()
    while sizes.max() > least:
        if len(few) == len(values) // 4:
            return None
        few.append(int(sizes.argmax()))
        along = left[few[-1]] / sizes.max()
        parts.append(left @ along)
        left -= np.outer(parts[-1], along)
        sizes = np.linalg.norm(left, axis=1)
    part = np.stack(parts, axis=1)
    return np.array(few), np.linalg.solve(part[few].T, part.T).T


def _weights(steps: float) -> np.ndarray:
    """Return how much of the samples (L,) of a signal, the newest first, makes it up as it was some steps ago.

    It is linear between samples, as `mjx_climb.hardware.bus.weights` has it.
    """
    return np.asarray(np.maximum(1 - np.abs(np.arange(math.ceil(steps) + 1) - steps), 0))


def _with_delays(core: np.ndarray, sizes: Sequence[int], weights: Sequence[np.ndarray]) -> np.ndarray:
    """Return transposed Jacobians (R, n, n) of a loop with the buffers of delayed signals behind its other states.

    Arguments:
        core: transposed Jacobians (R, s, s) of a loop whose signals are one step late each: of the signals as they
            were measured or sent in the step before, and of all other states, to the same after the step.
        sizes: of the signals in their order, and of the rest.
        weights: of each signal, see `_weights`.
    """
    *signals, rest = sizes
    if not signals:
        return core
    late, newest = sum(signals), np.repeat([weight[0] for weight in weights], signals)
    each = [(weight, len(weight) - 1, np.eye(size)) for weight, size in zip(weights, signals, strict=True)]
    read = scipy.linalg.block_diag(*(np.kron(weight[1:, None], one) for weight, _, one in each))
    entered = scipy.linalg.block_diag(*(np.kron(np.eye(1, kept), one) for _, kept, one in each))
    shifted = scipy.linalg.block_diag(*(np.kron(np.eye(kept, k=1), one) for _, kept, one in each))
    with np.errstate(invalid="ignore"):  # a robot that has no finite Jacobian has no finite radius
        # the late signals by the states: by the rest within the step where a delay is below a step, and by the buffers
        signal = np.concatenate([core[:, late:, :late] * newest, np.broadcast_to(read, (len(core), *read.shape))], 1)
        if newest.any():  # a signal may act on another one within the step
            signal = signal @ np.linalg.inv(np.eye(late) - core[:, :late, :late] * newest)
        after = signal @ core[:, :late]
        after[:, :rest] += core[:, late:]
        whole = np.concatenate([after[:, :, late:], after[:, :, :late] @ entered], 2)
        whole[:, rest:, rest:] += shifted
    return whole


def linearised_at(scenario: mc.Scenario, periods: np.ndarray, *, uneven: bool) -> np.ndarray:
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


def _radii(steps: Sequence[np.ndarray], periods: np.ndarray) -> np.ndarray:
    """Return radii (B,) of transposed matrices (B or more, s, s) of each step of a period, the last for all others."""
    steps = [step[: len(periods)] for step in steps]
    radius = np.full(len(periods), np.inf)
    finite = np.all([np.isfinite(step).all((1, 2)) for step in steps], axis=0)
    if not finite.any():
        return radius
    core = _coupled(np.any([(step[finite] != 0).any(0) for step in steps], axis=0))
    alone = np.stack([np.diagonal(step[finite], axis1=1, axis2=2)[:, ~core] for step in steps])
    matrices = np.stack([step[np.ix_(finite, core, core)] for step in steps])
    values = np.empty(matrices.shape[1])
    for period in np.unique(periods[finite]):
        rows = periods[finite] == period
        kinds = min(int(period), len(matrices))
        times = [int(period) - k if k == len(matrices) - 1 else 1 for k in range(kinds)]
        powers = [np.linalg.matrix_power(matrices[k, rows], count) for k, count in enumerate(times)]
        whole = functools.reduce(np.matmul, powers)
        single = np.prod([alone[k, rows] ** count for k, count in enumerate(times)], axis=0)
        sizes = np.abs(np.concatenate([np.linalg.eigvals(whole), single], axis=-1))
        values[rows] = sizes.max(-1) ** (1 / period)
    radius[finite] = values
    return radius


def _coupled(acts: np.ndarray) -> np.ndarray:
    """Return which states (s,) act on others that act back on them, where `acts` (s, s) says who acts on whom.

    The eigenvalues are those of these states together and of each other state by itself.
    """
    reach = acts | np.eye(len(acts), dtype=bool)
    for _ in range(len(acts).bit_length()):  # twice as far each time
        reach = reach @ reach
    return np.asarray((reach & reach.T).sum(0) > 1)


def over_axes(
    scenario: mc.Scenario, axes: Mapping[str, ArrayLike], *, law: mc.Law | None = None, engine: str = DEFAULT_ENGINE
) -> xr.DataArray:
    """Return the radius over values of two gains, the same on all axes of one, or at paths.

    Of more than 16 values along an axis (8 with delays in the loop) so many are taken.
    """
    stages = structure(scenario, engine, own_parameters(scenario)).stages
    delays = stages.force_delay + stages.base_delay + stages.command_delay + stages.servo_delay
    finest = _FINEST_WITH_MEMORY if delays else _FINEST
    some = {}
    for name, values in axes.items():  # the first and the last among them
        places = np.linspace(0, np.size(values) - 1, min(np.size(values), finest)).round().astype(int)
        some[name] = np.asarray(values, float)[np.unique(places)]
    mesh = zip(some, (values.ravel() for values in np.meshgrid(*some.values(), indexing="ij")), strict=True)
    robots = as_walked(scenario, law_of(scenario) if law is None else law, dict(mesh))
    radius = spectral_radius(scenario, *robots, law=law, engine=engine).reshape([v.size for v in some.values()])
    return xr.DataArray(radius, some, list(some), attrs={"units": "1", "long_name": "largest eigenvalue of one step"})


def on_map(radius: xr.DataArray, walks: xr.Dataset) -> xr.DataArray:
    """Return the radius at all gains of a grid of walks, NaN where it was not computed."""
    names = [str(name) for name in walks["diverged"].dims]
    whole = radius.transpose(*names).reindex({name: walks[name] for name in names})
    return whole.assign_coords({name: walks[name] for name in names})  # with their units


def _moved(shape: Structure, off: Array, law: Law, parameters: mc.Parameters, step: Array) -> dict[str, Array]:
    """Return the values of a robot after a step before which they were `off` (s,) from those of its stance.

    They are the newest samples of the delayed signals, by name, and the `_REST`, in the order of `off`. Whole numbers
    and truth values cannot be off by a little; values that a step hands on unchanged, as a law's discretised gains, are
    no states: they stay 0.
    """
    setup = set_up(shape, law, parameters)
    walk = walk_of(shape, setup)
    carry = _stance(walk, setup.plan, step)
    samples, memory = _taken(carry.memory, walk.structure)
    leaves, tree = jax.tree.flatten((carry.state, memory))
    of_law = jax.tree.unflatten(jax.tree.structure(memory.law), constants_of_law(walk, carry))
    none = jax.tree.map(lambda _: False, (carry.state, memory))
    constant = jax.tree.leaves((none[0], none[1]._replace(law=of_law)))

    def advanced(samples: dict[str, Any], leaves: list[Array]) -> tuple[dict[str, Any], list[Array]]:
        state, memory = jax.tree.unflatten(tree, leaves)
        state = execution.of_limbs(state)  # a row of single numbers until now
        after, _ = advance(walk, carry._replace(state=state, memory=_put(memory, samples)), step)
        samples, memory = _taken(after.memory, walk.structure)
        return samples, jax.tree.leaves((after.state, memory))

    program = jax.make_jaxpr(advanced)(samples, leaves)
    count = len(jax.tree.leaves(samples))
    befores, afters = program.jaxpr.invars[count:], program.jaxpr.outvars[count:]
    varied = [
        jnp.issubdtype(leaf.dtype, jnp.floating) and after is not before
        for leaf, before, after in zip(leaves, befores, afters, strict=True)
    ]

    def of_states(leaves: list[Array]) -> list[Array]:
        each = itertools.compress(zip(constant, leaves, strict=True), varied)
        return [leaf if stays is False else jnp.where(stays, 0.0, leaf) for stays, leaf in each]

    values, unravel = ravel_pytree(samples | {_REST: list(itertools.compress(leaves, varied))})
    moved = unravel(values + jnp.broadcast_to(off, values.shape))
    changed = iter(moved.pop(_REST))
    given = [next(changed) if varies else leaf for leaf, varies in zip(leaves, varied, strict=True)]
    found = jaxpr_as_fun(program)(*jax.tree.leaves(moved), *given)
    after = jax.tree.unflatten(jax.tree.structure(samples), found[:count])
    after[_REST] = of_states(found[count:])
    return {name: ravel_pytree(value)[0] for name, value in after.items()}


def _taken(memory: control_loop.Memory, walk: Structure) -> tuple[dict[str, Any], control_loop.Memory]:
    """Return the newest samples of the delayed signals by name, and the memory without them."""
    found: dict[str, Any] = {}
    if walk.stages.force_delay:
        found["force"] = memory.force_sensor.buffer[0]
        memory = memory._replace(force_sensor=memory.force_sensor._replace(buffer=()))
    if walk.stages.base_delay:
        found["base"] = tuple(buffer[0] for buffer in memory.base_estimate)
        memory = memory._replace(base_estimate=())
    if walk.stages.command_delay:
        reports = memory.reports.buffers if memory.reports else ()
        gains = tuple(buffer[0] for buffer in memory.joint_gains)
        found["command"] = memory.targets[0], gains, tuple(buffer[0] for buffer in reports)
        memory = memory._replace(targets=(), joint_gains=())
        memory = memory._replace(reports=memory.reports._replace(buffers=()) if memory.reports else None)
    return found, memory


def _put(memory: control_loop.Memory, samples: Mapping[str, Any]) -> control_loop.Memory:
    """Return a memory with buffers of `_ONE_STEP` that hold samples: the older ones are never read."""
    buffers = jax.tree.map(lambda sample: (sample,) * _ONE_STEP, dict(samples))
    if "force" in buffers:
        memory = memory._replace(force_sensor=memory.force_sensor._replace(buffer=buffers["force"]))
    if "base" in buffers:
        memory = memory._replace(base_estimate=buffers["base"])
    if "command" in buffers:
        targets, gains, reported = buffers["command"]
        memory = memory._replace(targets=targets, joint_gains=gains)
        memory = memory._replace(reports=memory.reports._replace(buffers=reported) if memory.reports else None)
    return memory


def _stance(walk: Walk, plan: gait.Plan, step: Array) -> Carry:
    """Return a robot that stands as it should at a step, and has never been otherwise."""
    carry = begin(walk)
    now = gait.schedule(plan, step)
    grip = plan.footholds + now.foothold[:, None] * plan.advance
    grip = grip.at[:, 2].add(gait.foothold_height(plan, now.foothold))
    start = gait.planned_start(plan, now.cycle)
    reference = gait.reference(plan, now, start, grip, walk.structure.time_step)
    rotation = quaternion_to_matrix(plan.base_orientation)
    target = (reference.foot_position - reference.base_position) @ rotation
    joints = inverse_kinematics(walk.controller.geometry, target).joint_angles
    state = dataclasses.replace(carry.state, base_position=reference.base_position, joint_angles=joints)
    frames, ground = limb_frames(walk.robot, None, joints), gait.foothold_height(plan, now.foothold)
    begun = walk.contact.init(grip, rotation @ frames.rotation[:, -1])
    feet = foot_kinematics(walk.robot, frames, state)
    turning = foot_turning(walk.robot, frames, state) if walk.contact.transmits_moments else None
    contact, _ = walk.contact.step(begun, feet, turning, now.closed, ground)  # feet that swing let go
    memory = control_loop.begin(walk.controller, walk.robot, state, reference)
    return carry._replace(state=state, contact=contact, memory=memory)
