"""Joint targets over time as a search problem: their knots, and walks under them with scores and derivatives.

A plan is the joint target of each step, (time, limb, joint) rad, in place of a control law; the bus holds it and hands
it on late as it does a law's. The search moves offsets at knots, on straight lines between them, from a given plan.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array, lax
from jaxtyping import Bool, Float, PyTree, Real

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import PD
from mjx_climb.execution import devices, paths
from mjx_climb.execution.batch_axes import own_axes
from mjx_climb.inputs.resolve import AnyGains, resolve_in
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.physics.spatial import norm
from mjx_climb.walk.metrics import peak
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.structure import Structure, structure
from mjx_climb.walks import Scan, metrics_of, samples_of
from tuning.problem.objectives import Limit, Objective, Term

# robots of a call on one core: four take hardly longer than one, and more than 16 are done no sooner together
_AT_LEAST, _AT_ONCE = 4, 16


# --- metrics that limit a plan: without them it could leave its feet where they are, or jerk


def _swing_deviation(sample: Sample, _: Any) -> Array:
    """Return how far each swinging foot is off the gait's path, (limb,) m; 0 of the others."""
    off = sample.foot_position - sample.foot_target
    return jnp.where(sample.support, 0.0, jnp.sqrt((off * off).sum(-1) + 1e-18))


def _joint_rates(sample: Sample, _: Any) -> Array:
    """Return the sizes of the joint rates, (limb, joint) rad/s."""
    return jnp.abs(sample.joint_rates)


SWING = peak("swing_deviation", "m", "swinging foot off its path", _swing_deviation)
RATE = peak("peak_joint_rate", "rad/s", "peak joint rate", _joint_rates)


# --- knots


@dataclasses.dataclass(frozen=True)
class Knots:
    """Instants between which offsets of the joint targets are straight lines."""

    steps: int  # of the walk
    every: int  # time steps from one knot to the next

    @property
    def count(self) -> int:
        """The number of knots; the last is behind the last step."""
        return (self.steps - 1) // self.every + 2

    @functools.cached_property
    def _shares(self) -> scipy.sparse.csr_array:
        """By how much each knot counts in each step, (time, knot)."""
        steps = np.arange(self.steps)
        left = steps // self.every
        share = steps / self.every - left
        values, columns = np.concatenate([1 - share, share]), np.concatenate([left, left + 1])
        return scipy.sparse.csr_array((values, (np.tile(steps, 2), columns)), (self.steps, self.count))

    def at_steps(
        self, values: Float[np.ndarray, "*batch knot limb joint"]
    ) -> Float[np.ndarray, "*batch time limb joint"]:
        """Return offsets at knots as offsets in each step."""
        return _along_time(self._shares, values)

    def at_knots(
        self, slopes: Float[np.ndarray, "*batch time limb joint"]
    ) -> Float[np.ndarray, "*batch knot limb joint"]:
        """Return derivatives by offsets in each step as derivatives by those at knots."""
        return _along_time(self._shares.T.tocsr(), slopes)


def _along_time(matrix: scipy.sparse.csr_array, values: np.ndarray) -> np.ndarray:
    first = np.moveaxis(values, -3, 0)
    found = (matrix @ first.reshape(len(first), -1)).reshape(matrix.shape[0], *first.shape[1:])
    return np.moveaxis(found, 0, -3)


# --- walks under plans


class Asked(NamedTuple):
    """The static part of walks under plans; hashable."""

    structure: Structure
    terms: tuple[tuple[str, bool], ...]  # metric, and whether larger is better
    limits: tuple[tuple[str, bool], ...]


class Numbers(NamedTuple):
    """The numbers of an objective: another one of the same terms and limits needs no other program."""

    terms: np.ndarray  # (terms, 3) weight, and the baselines of the metric and of its smooth companion
    limits: np.ndarray  # (limits, 3) value, scale, margin
    sharp: np.ndarray  # () 0: derivatives of the smooth companions; 1: of the true metrics


class Steering(NamedTuple):
    """The plan of one walk that offsets at knots are added to."""

    base: np.ndarray  # (time, limb, joint) rad
    begins: np.ndarray  # (set,) int32, the step from which a set of offsets counts
    lower: np.ndarray  # (limb, joint) rad, of joint targets
    upper: np.ndarray


class Scored(NamedTuple):
    """The scores of walks under plans, (N,) each."""

    value: np.ndarray
    merit: np.ndarray  # value plus penalty, infinite where the walk diverged
    feasible: np.ndarray
    metrics: dict[str, np.ndarray]


def judged(asked: Asked, targets: Array, numbers: Numbers, law: mc.Law, parameters: mc.Parameters) -> dict[str, Array]:
    """Return the score of one walk under joint targets."""
    return _followed(asked, numbers, law, parameters, targets)[1]


def scored(asked: Asked, targets: Array, numbers: Numbers, law: mc.Law, parameters: mc.Parameters) -> dict[str, Array]:
    """Return the score of one walk under joint targets, and its derivatives by them, in reverse mode."""

    def followed(targets: Array) -> dict[str, Array]:
        along, found = _followed(asked, numbers, law, parameters, targets)
        return {"_along": along} | found

    found, slopes = execution.gradients_over_robots(followed)({"_along": jnp.ones((), targets.dtype)}, targets)
    del found["_along"]
    return found | {"_slopes": slopes}


def steered(
    asked: Asked, moving: dict[str, Array], steering: Steering, numbers: Numbers, law: mc.Law, parameters: mc.Parameters
) -> dict[str, Array]:
    """Return the score of one walk under "offsets" (set, knot, limb, joint) rad, with derivatives of `_along` alone.

    There is a whole number of steps between knots.
    """
    scan = functools.partial(_between_knots, moving["offsets"], steering)
    along, found = _followed(asked, numbers, law, parameters, jnp.asarray(steering.base), scan)
    return {"_along": along} | lax.stop_gradient(found)


def _between_knots(
    offsets: Array, steering: Steering, step: Callable[..., PyTree], begun: PyTree, base: Array, *, length: int
) -> tuple[PyTree, tuple[()]]:
    """Scan steps under offset joint targets, in a loop over the intervals between knots and one over their steps.

    Nothing is read at a place that is known only in the walk, and no joint target is stored.
    """
    knots = jnp.moveaxis(offsets, 1, 0)
    every = length // (len(knots) - 1)

    def walk_step(carried: tuple[PyTree, Array], base: Array, ends: tuple[Array, Array]) -> tuple[Any, tuple[()]]:
        carry, number = carried
        share = lax.rem(number, jnp.int32(every)).astype(base.dtype) / every
        added = jnp.where((number >= steering.begins)[:, None, None], (1 - share) * ends[0] + share * ends[1], 0.0)
        whole = base + added.sum(0)
        # at a limit the offset still counts, as in `Freedom.slopes`
        below, above = whole < steering.lower, whole > steering.upper
        targets = jnp.where(below, steering.lower, jnp.where(above, steering.upper, whole))
        return (step(carry, targets)[0], number + 1), ()

    def walk_interval(carried: tuple[PyTree, Array], given: Any) -> tuple[Any, tuple[()]]:
        base, *ends = given
        return lax.scan(functools.partial(walk_step, ends=ends), carried, base)

    parts = base.reshape(-1, every, *base.shape[1:])
    (last, _), _ = lax.scan(walk_interval, (begun, jnp.int32(0)), (parts, knots[:-1], knots[1:]))
    return last, ()


def _followed(
    asked: Asked, numbers: Numbers, law: mc.Law, parameters: mc.Parameters, targets: Array, scan: Scan = lax.scan
) -> tuple[Array, dict[str, Array]]:
    """Return the derivatives that follow of one walk, and its metrics and score."""
    metrics = metrics_of(asked.structure, law, parameters, scan, targets)
    terms = [
        Term(name, weight, value, smooth, larger)
        for (name, larger), (weight, value, smooth) in zip(asked.terms, numbers.terms, strict=True)
    ]
    limits = [
        Limit(name, value, scale, margin, "", larger)
        for (name, larger), (value, scale, margin) in zip(asked.limits, numbers.limits, strict=True)
    ]
    score = Objective(tuple(terms), tuple(limits)).score(metrics)
    value, descent, penalty, feasible = map(jnp.asarray, score)
    merit = value + penalty
    along = (1 - numbers.sharp) * descent + numbers.sharp * merit
    return along, metrics | {"_value": value, "_merit": merit, "_feasible": feasible}


class OverTime(NamedTuple):
    """Histories of walks, (N, time, ...)."""

    joint_targets: np.ndarray  # (N, time, limb, joint) rad
    foot_force: np.ndarray  # (N, time) N, of the foot with the largest
    base_offset: np.ndarray  # (N, time, 3) m, from its reference


def over_time(
    scenario: mc.Scenario,
    law: mc.Law,
    gains: AnyGains | None,
    parameters: mc.Parameters,
    targets: Float[np.ndarray, "N time limb joint"] | None = None,
    *,
    metrics: mc.MetricTable,
    engine: str,
    dtype: type,
) -> OverTime:
    """Walk robots with parameters (N, ...) under a law, or under joint targets in its place; nothing is torn off.

    Raises:
        ConfigError: a time step too long for a robot.
    """
    resolved = resolve_in(scenario, law, gains, parameters, dtype)
    check_time_step(scenario, parameters=resolved.walked)
    shape = structure(scenario, engine, resolved.walked, law=resolved.law, metrics=metrics, smooth=True)
    under: tuple[np.ndarray, ...] = () if targets is None else (np.asarray(targets, dtype),)
    given, axes = (resolved.law, resolved.parameters, *under), (*resolved.axes, *(3 for _ in under))
    found = execution.run(_over_time, shape, execution.Robots(given, axes, resolved.shape), over_time=True)
    return OverTime(**found)


def _over_time(
    structure: Structure, law: mc.Law, parameters: mc.Parameters, targets: Array | None = None
) -> dict[str, Array]:
    samples = samples_of(structure, law, parameters, targets)
    forces, offset = norm(samples.foot_force).max(-1), samples.base_position - samples.base_reference
    return {"joint_targets": samples.joint_targets, "foot_force": forces, "base_offset": offset}


class Walked(NamedTuple):
    """The command of a walk: a law with its gains, or a plan in its place."""

    scenario: mc.Scenario
    law: mc.Law
    gains: AnyGains
    parameters: mc.Parameters
    targets: np.ndarray | None  # (time, limb, joint) rad
    engine: str

    def trajectory(self) -> mc.Trajectory:
        """Return the walk, in double precision; nothing is torn off."""
        simulation = mc.Simulation(self.scenario, self.law, engine=self.engine, smooth=True)
        return simulation.rollout(self.gains, self.parameters, targets=self.targets)


@dataclasses.dataclass(frozen=True)
class Walks:
    """Walks of a scenario under plans, in the order of `Objective`'s terms and limits."""

    asked: Asked
    numbers: Numbers
    dtype: type

    def evaluate(
        self, freedom: "Freedom", x: Float[np.ndarray, "problem variable"], parameters: mc.Parameters, *, sharp: float
    ) -> tuple[Scored, Float[np.ndarray, "problem variable"]]:
        """Walk robots with parameters (N, ...), of `rows`, and return their scores and the derivatives of problems.

        By the kernel of a GPU where it can.

        Arguments:
            sharp: 0 for derivatives of the objective with smooth companions of the extremes, 1 for those of the true
                metrics, or a share between.
        """
        return self._derived(freedom)(freedom, x, parameters, sharp)

    def prepare(self, freedom: "Freedom", parameters: mc.Parameters) -> None:
        """Compile the program of gradients for so many plans, by walks of no account, in one call of it."""
        if (derived := self._derived(freedom)) != self._reverse:
            derived(freedom, freedom.none, parameters, 0.0)
            return
        targets = freedom.base.reshape(-1, *freedom.base.shape[2:])
        at_once = _at_once(len(targets), kernel=False)
        first = np.arange(min(2 * at_once, len(targets)))  # more than one call has shares as all of them do
        self._walked(scored, targets[first], row(parameters, first), 0.0, kernel=False, at_once=at_once)

    def judge(self, targets: Float[np.ndarray, "N time limb joint"], parameters: mc.Parameters) -> Scored:
        """Return the scores of walks under joint targets."""
        return _scored(self._walked(judged, targets, parameters, 1.0, kernel=self.dtype == np.float32))

    def _derived(self, freedom: "Freedom") -> Callable[..., tuple[Scored, np.ndarray]]:
        """Return which of the next two methods takes the least time."""
        if self.dtype != np.float32 or self.asked.structure.planning or freedom.knots.steps % freedom.knots.every:
            return self._reverse
        on = paths.device_for(math.prod(freedom.base.shape[:2]), paths.AN_ADJOINT, kernel=True)
        return self._by_knots if on is None and paths.path_for(on, kernel=True) == "kernel" else self._reverse

    def _reverse(
        self, freedom: "Freedom", x: np.ndarray, parameters: mc.Parameters, sharp: float
    ) -> tuple[Scored, np.ndarray]:
        targets = freedom.targets(x)
        found = self._walked(scored, targets.reshape(-1, *targets.shape[2:]), parameters, sharp, kernel=False)
        slopes = found.pop("_slopes").reshape(targets.shape)
        return _scored(found), freedom.slopes(x, slopes)

    def _by_knots(
        self, freedom: "Freedom", x: np.ndarray, parameters: mc.Parameters, sharp: float
    ) -> tuple[Scored, np.ndarray]:
        robots, offsets = self._steered(freedom, x, parameters, sharp)
        weights: dict[str, np.ndarray] = {"_along": np.ones((len(offsets), 1), self.dtype)}
        found, gradients = execution.run(steered, self.asked, robots._replace(weights=weights))
        del found["_along"]
        return _scored(found), freedom.slopes_of_sets(gradients["offsets"][:, 0])

    def _steered(
        self, freedom: "Freedom", x: np.ndarray, parameters: mc.Parameters, sharp: float
    ) -> tuple[execution.Robots, np.ndarray]:
        """Return the arguments of `steered`, and their offsets at knots."""
        offsets, steering = freedom.steering(x, self.dtype)
        given, axes = self._given(parameters, sharp)
        of_steering = jax.tree.map(lambda value: value.ndim - 1, steering)
        own = {"offsets": offsets.ndim - 1}, of_steering, *axes
        return execution.Robots(({"offsets": offsets}, steering, *given), own, (len(offsets),)), offsets

    def _walked(
        self,
        function: Callable[..., dict[str, Array]],
        targets: np.ndarray,
        parameters: mc.Parameters,
        sharp: float,
        *,
        kernel: bool,
        at_once: int | None = None,
    ) -> dict[str, np.ndarray]:
        count, at_once = len(targets), at_once or _at_once(len(targets), kernel=kernel)
        rows = np.arange(-(-count // at_once) * at_once) % count
        parameters = jax.tree.map(lambda value: value[rows], parameters)
        given, axes = self._given(parameters, sharp)
        batch = execution.Robots((targets[rows].astype(self.dtype), *given), (3, *axes), (len(rows),))
        found = execution.run(function, self.asked, batch, batch_size=at_once, over_time=not kernel)
        return {name: value[:count] for name, value in found.items()}

    def _given(self, parameters: mc.Parameters, sharp: float) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Return the last arguments of a walk, in its precision, and how many axes each of their values has."""
        cast = functools.partial(np.asarray, dtype=self.dtype)
        numbers, law = self.numbers._replace(sharp=np.asarray(sharp)), PD()
        axes = jax.tree.map(np.ndim, numbers), own_axes(law), own_axes(parameters)
        return jax.tree.map(cast, (numbers, law, parameters)), axes


def _scored(found: dict[str, np.ndarray]) -> Scored:
    """Return the scores of walks from the results of their function."""
    value, merit, feasible = (found.pop(f"_{name}") for name in ("value", "merit", "feasible"))
    return Scored(value, np.where(np.isfinite(merit), merit, np.inf), feasible, found)


def walks_of(
    scenario: mc.Scenario,
    objective: Objective,
    parameters: mc.Parameters,
    *,
    metrics: mc.MetricTable,
    dtype: type = np.float32,
    engine: str = DEFAULT_ENGINE,
) -> Walks:
    """Return walks of a scenario under plans.

    Arguments:
        parameters: all rows that will walk, (N, ...), of `rows`: they decide about the stages of hardware.
    """
    shape = structure(scenario, engine, parameters, law=PD(), metrics=metrics, smooth=True)
    terms, limits = objective.terms, objective.limits
    asked = Asked(
        shape,
        tuple((term.metric, term.larger_is_better) for term in terms),
        tuple((limit.metric, limit.larger_is_better) for limit in limits),
    )
    numbers = Numbers(
        np.array([[term.weight, term.baseline, term.smooth_baseline] for term in terms], float),
        np.array([[limit.value, limit.scale, limit.margin] for limit in limits], float).reshape(-1, 3),
        np.zeros(()),
    )
    return Walks(asked, numbers, dtype)


def _at_once(count: int, *, kernel: bool) -> int:
    """Return how many robots walk in a call: on a CPU a share for each core, a power of 2 for few programs."""
    if jax.default_backend() != "cpu" and paths.device_for(count, 0, kernel=kernel) is None:
        return count
    share = max(-(-count // devices.usable_cores()), _AT_LEAST)
    return min(1 << (share - 1).bit_length(), _AT_ONCE if count > 8 else 2)


def rows(
    scenario: mc.Scenario, law: mc.Law, gains: AnyGains | None, parameters: mc.Parameters, members: int
) -> mc.Parameters:
    """Return the inputs of walks beside the law, (members, ...): parameters with joint gains and gait among gains."""
    walked = resolve_in(scenario, law, gains, parameters, np.float64).walked

    def broadcast(value: Any, own: int) -> np.ndarray:
        value = np.asarray(value, float)
        return np.broadcast_to(value, (members, *value.shape[value.ndim - own :]))

    found: mc.Parameters = jax.tree.map(broadcast, walked, own_axes(walked))
    return found


def row(parameters: mc.Parameters, index: int | np.ndarray) -> mc.Parameters:
    """Return those of one robot, or of some."""
    found: mc.Parameters = jax.tree.map(lambda value: value[index], parameters)
    return found


def commanded(
    joint_targets: Float[np.ndarray, "time limb joint"], parameters: mc.Parameters, scenario: mc.Scenario
) -> Float[np.ndarray, "time limb joint"]:
    """Return the plan under which the joints get the targets that they got in a walk, whose bus held and delayed them.

    With a delay of a whole number of time steps, or targets that are held for several, the walk is the same to
    rounding; a line between targets is, but for the last one, whose end is behind the record.
    """
    steps, dt = len(joint_targets), scenario.time_step
    period = max(1, round(float(parameters.bus.control_period) / dt))
    late = float(parameters.bus.command_delay) / dt
    whole = int(late * (1 + 1e-6))
    between = late - whole > 1e-6 * max(late, 1.0)
    # held targets of a part of a step more are there one step later; a line reaches its end in the period's last step
    within = period - 1 if scenario.hardware.interpolation == "linear" else int(between and period > 1)
    sent = np.arange(steps) // period * period
    return joint_targets[np.minimum(sent + within + whole, steps - 1)]


# --- the freedom of plans


@dataclasses.dataclass(frozen=True)
class Freedom:
    """Offsets of the joint targets of some members, from several starts: which may differ between members, and when.

    With `common` all members of a start share offsets, and a start is one problem. With `since` each member has offsets
    of its own from a step on; without `common` each member of each start is a problem by itself.
    """

    base: Float[np.ndarray, "start member time limb joint"]  # rad
    knots: Knots
    common: bool
    since: Real[np.ndarray, " member"] | None  # steps
    lower: Float[np.ndarray, "limb joint"]  # rad, of joint targets
    upper: Float[np.ndarray, "limb joint"]

    @property
    def _parts(self) -> tuple[int, ...]:
        """Starts, sets of offsets of each, and the shape of a set."""
        starts, members, _, *joints = self.base.shape
        return starts, self.common + (0 if self.since is None else members), self.knots.count, *joints

    @property
    def _own(self) -> Bool[np.ndarray, "member time 1 1"]:
        """Where members have offsets of their own."""
        assert self.since is not None
        return (np.arange(self.base.shape[2]) >= np.asarray(self.since)[:, None])[..., None, None]

    @property
    def none(self) -> Float[np.ndarray, "problem variable"]:
        """No offsets."""
        starts, sets, *shape = self._parts
        problems = starts if self.common else starts * sets
        return np.zeros((problems, starts * sets * int(np.prod(shape)) // problems))

    def targets(self, x: Float[np.ndarray, "problem variable"]) -> Float[np.ndarray, "start member time limb joint"]:
        """Return joint targets, within the joint limits."""
        found: np.ndarray = np.clip(self._unclipped(x), *self._bounds)
        return found

    @functools.cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint limits, further where the plans given go further."""
        lowest, highest = self.base.min(2, keepdims=True), self.base.max(2, keepdims=True)
        return np.minimum(self.lower, lowest), np.maximum(self.upper, highest)

    def _unclipped(self, x: np.ndarray) -> np.ndarray:
        offsets = self.knots.at_steps(x.reshape(self._parts))
        found: np.ndarray = self.base + offsets[:, : self.common].sum(1, keepdims=True)
        return found if self.since is None else found + self._own * offsets[:, self.common :]

    def slopes(
        self, x: Float[np.ndarray, "problem variable"], of_targets: Float[np.ndarray, "start member time limb joint"]
    ) -> Float[np.ndarray, "problem variable"]:
        """Return derivatives of each problem's mean over its members, from those of each walk by its targets."""
        whole, (low, high) = self._unclipped(x), self._bounds
        moving = np.where((whole < low) | (whole > high), 0.0, of_targets)
        sets = [moving] * self.common + ([] if self.since is None else [self._own * moving])
        return self.knots.at_knots(self._of_sets(sets)).reshape(self.none.shape)

    def steering(self, x: Float[np.ndarray, "problem variable"], dtype: type) -> tuple[np.ndarray, Steering]:
        """Return the offsets of each walk, (walk, 2, knot, limb, joint) rad, and its steering, (walk, ...).

        Common ones come first, then a member's own; a set that there is not begins behind the last step, so that plans
        of all kinds have one program.
        """
        starts, members, steps = self.base.shape[:3]
        offsets, begins = x.reshape(self._parts), np.full((2, members), steps)
        sets = np.zeros((2, starts, members, *offsets.shape[2:]))
        if self.common:
            sets[0], begins[0] = offsets[:, :1], 0
        if self.since is not None:
            sets[1], begins[1] = offsets[:, self.common :], np.minimum(np.ceil(self.since), steps)

        def of_walks(value: np.ndarray, dtype: type = dtype) -> np.ndarray:
            each = np.broadcast_to(value, (starts, members, *value.shape[2:]))
            return each.reshape(-1, *value.shape[2:]).astype(dtype)

        lower, upper = (of_walks(bound[:, :, 0]) for bound in self._bounds)
        steering = Steering(of_walks(self.base), of_walks(begins.T[None], np.int32), lower, upper)
        return of_walks(np.moveaxis(sets, 0, 2)), steering

    def slopes_of_sets(
        self, of_offsets: Float[np.ndarray, "walk 2 knot limb joint"]
    ) -> Float[np.ndarray, "problem variable"]:
        """Return derivatives of each problem's mean over its members, from those of each walk by its offsets."""
        each = of_offsets.reshape(*self.base.shape[:2], *of_offsets.shape[1:]).astype(float)
        sets = [each[:, :, 0]] * self.common + ([] if self.since is None else [each[:, :, 1]])
        return self._of_sets(sets).reshape(self.none.shape)

    def _of_sets(self, sets: list[np.ndarray]) -> np.ndarray:
        """Return derivatives by sets of offsets, (start, set, ...), from those of each walk, (start, member, ...)."""
        common = [each.mean(1, keepdims=True) for each in sets[: self.common]]
        own = [each / (each.shape[1] if self.common else 1) for each in sets[self.common :]]
        return np.concatenate([*common, *own], 1)

    def of_problems(self, of_walks: Float[np.ndarray, " walk"]) -> Float[np.ndarray, " problem"]:
        """Return the value of each problem, from those of its walks, start by start."""
        return of_walks.reshape(self.base.shape[0], -1).mean(1) if self.common else of_walks
