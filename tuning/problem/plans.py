"""Joint targets over time as what is searched: their knots, and walks under them with scores and derivatives.

A plan is the joint target of each step, (time, limb, joint) rad, in place of a control law; the bus holds it and hands
it on late as it does a law's. What is searched are offsets at knots, on straight lines between them, from a given plan.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax import Array
from jaxtyping import Bool, Float, Real

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import PD
from mjx_climb.execution import devices, paths
from mjx_climb.execution.batch_axes import own_axes
from mjx_climb.inputs.resolve import AnyGains, resolve_in
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.walk.metrics import peak
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.structure import Structure, structure
from mjx_climb.walks import metrics_under
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
    """What walks under plans are compiled for; hashable."""

    structure: Structure
    terms: tuple[tuple[str, bool], ...]  # metric, and whether larger is better
    limits: tuple[tuple[str, bool], ...]


class Numbers(NamedTuple):
    """The numbers of an objective: another one of the same terms and limits needs no other program."""

    terms: np.ndarray  # (terms, 3) weight, and what is 1 of the metric and of its smooth companion
    limits: np.ndarray  # (limits, 3) value, scale, margin
    sharp: np.ndarray  # () 0: derivatives of the smooth companions; 1: of the true metrics


class Scored(NamedTuple):
    """What is known about walks under plans, (N,) each."""

    value: np.ndarray
    merit: np.ndarray  # value plus penalty, infinite where the walk diverged
    feasible: np.ndarray
    slopes: np.ndarray | None  # (N, time, limb, joint) derivatives by the joint targets, where asked for
    metrics: dict[str, np.ndarray]


def judged(asked: Asked, targets: Array, numbers: Numbers, law: mc.Law, parameters: mc.Parameters) -> dict[str, Array]:
    """Return the score of one walk under joint targets."""
    return _followed(asked, numbers, law, parameters, targets)[1]


def scored(asked: Asked, targets: Array, numbers: Numbers, law: mc.Law, parameters: mc.Parameters) -> dict[str, Array]:
    """Return the score of one walk under joint targets, and its derivatives by them."""
    followed = functools.partial(_followed, asked, numbers, law, parameters)
    along, pull_back, found = jax.vjp(followed, targets, has_aux=True)
    return found | {"_slopes": pull_back(jnp.ones_like(along))[0]}


def _followed(
    asked: Asked, numbers: Numbers, law: mc.Law, parameters: mc.Parameters, targets: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the derivatives that follow of one walk, and its metrics and score."""
    metrics = metrics_under(asked.structure, law, parameters, targets)
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


@dataclasses.dataclass(frozen=True)
class Walks:
    """Walks of a scenario under plans, in the order of `Objective`'s terms and limits."""

    asked: Asked
    numbers: Numbers
    dtype: type

    def evaluate(
        self, targets: Float[np.ndarray, "N time limb joint"], parameters: mc.Parameters, *, sharp: float = 0.0
    ) -> Scored:
        """Walk robots with parameters (N, ...), of `rows`, under joint targets, and return their scores.

        Arguments:
            sharp: 0 for derivatives of the objective with smooth companions of the extremes, 1 for those of the true
                metrics, or a share between.
        """
        return self._walked(scored, targets, parameters, sharp)

    def judge(self, targets: Float[np.ndarray, "N time limb joint"], parameters: mc.Parameters) -> Scored:
        """Return the scores that `evaluate` returns, without derivatives."""
        return self._walked(judged, targets, parameters, 1.0)

    def _walked(
        self, function: Callable[..., dict[str, Array]], targets: np.ndarray, parameters: mc.Parameters, sharp: float
    ) -> Scored:
        count, at_once = len(targets), _at_once(len(targets))
        rows = np.arange(-(-count // at_once) * at_once) % count
        cast = functools.partial(np.asarray, dtype=self.dtype)
        numbers = jax.tree.map(cast, self.numbers._replace(sharp=np.asarray(sharp)))
        robots, law = jax.tree.map(lambda value: cast(value)[rows], parameters), PD()
        axes = (3, jax.tree.map(np.ndim, numbers), own_axes(law), own_axes(robots))
        batch = execution.Robots((cast(targets)[rows], numbers, law, robots), axes, (len(rows),))
        found = execution.run(function, self.asked, batch, batch_size=at_once, over_time=True)
        found = {name: value[:count] for name, value in found.items()}
        value, merit, feasible = (found.pop(f"_{name}") for name in ("value", "merit", "feasible"))
        slopes = found.pop("_slopes", None)
        return Scored(value, np.where(np.isfinite(merit), merit, np.inf), feasible, slopes, found)


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


def _at_once(count: int) -> int:
    """Return how many robots walk in a call: on a CPU a share for each core, a power of 2 for few programs."""
    if jax.default_backend() != "cpu" and paths.device_for(count, 0, kernel=False) is None:
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


def row(parameters: mc.Parameters, index: int) -> mc.Parameters:
    """Return those of one robot."""
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
    period = max(1, round(float(parameters.control_period) / dt))
    late = float(parameters.command_delay) / dt
    whole = int(late * (1 + 1e-6))
    between = late - whole > 1e-6 * max(late, 1.0)
    # held targets of a part of a step more are there one step later; a line reaches its end in the period's last step
    within = period - 1 if scenario.hardware.interpolation == "linear" else int(between and period > 1)
    sent = np.arange(steps) // period * period
    return joint_targets[np.minimum(sent + within + whole, steps - 1)]


# --- what of plans may change


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

    @property
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
        sets = [moving.mean(1, keepdims=True)] if self.common else []
        if self.since is not None:
            sets.append(self._own * moving / (moving.shape[1] if self.common else 1))
        return self.knots.at_knots(np.concatenate(sets, 1)).reshape(self.none.shape)

    def of_problems(self, of_walks: Float[np.ndarray, " walk"]) -> Float[np.ndarray, " problem"]:
        """Return the value of each problem, from those of its walks, start by start."""
        return of_walks.reshape(self.base.shape[0], -1).mean(1) if self.common else of_walks
