"""How good any control law could be: the best joint targets over time, by their knowledge: `tuning.ceiling`.

Three kinds of plans bound every law on the same walks. The clairvoyant one knows each member's robot, disturbance and
noise in advance. The blind one is the same for all members, as a gait alone. A causal one is blind until a
disturbance begins, and knows all from a delay after that on. A plan that knows more never ends higher, and neither does
a finer spacing of the knots. The best plan found is an upper bound of the least: longer searches may find less.
"""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD as PDLaw
from mjx_climb.control import law_of
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.execution import devices
from mjx_climb.execution.batch_axes import own_axes
from mjx_climb.files import dataset
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.gait_values import gait_of
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.background import Callback, Work, background, ignore
from tuning.gains import gains_file
from tuning.gains.gains_file import Whole, by_name
from tuning.methods.adam import choose
from tuning.methods.many_variables import Evaluated, descend
from tuning.problem import ensemble as ensembles
from tuning.problem import objectives
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.plans import (
    RATE,
    SWING,
    Freedom,
    Knots,
    OverTime,
    Scored,
    Walked,
    Walks,
    commanded,
    over_time,
    row,
    rows,
    walks_of,
)
from tuning.problem.readings import reads_forces
from tuning.problem.search import Search, check_metrics
from tuning.results.ceiling import BLIND, CLAIRVOYANT, FIRST, PD, RETUNED, Bounded
from tuning.searches import retuned_pd
from tuning.searches.tune import tune

TRAVEL = 0.01  # by how much plans may travel less than the contestants, or more, as a share of the way or of a stride
SHAKEN = 0.01  # rad, standard deviation of the offsets of a random start
LIMIT_MARGIN = 0.02  # relative: where the penalty of a limit begins, inside it
INSTANTS = 800  # at most, of the histories that are kept
_WIDENED = ("base_deviation", SWING.name, "peak_joint_torque", RATE.name)  # limits that no contestant breaks
Laws = Mapping[str, AnyGains | Whole | str | os.PathLike[str]]  # gains, by the names of who has them
Progress = Callable[[str, int, int], None]  # called with the name of a search, evaluations done, and in all


class Draws(NamedTuple):
    """The walks of all contestants: those of the search, and fresh ones."""

    members: int
    fresh: int
    parameters: mc.Parameters  # (member and fresh, ...)
    how: Mapping[str, Any]  # metrics, engine and precision

    def members_of(self, each: Any) -> Any:
        """Return the first rows of a tree of arrays."""
        return jax.tree.map(lambda value: value[: self.members], each)

    def fresh_of(self, each: Any) -> Any:
        """Return the other rows of a tree of arrays."""
        return jax.tree.map(lambda value: value[self.members :], each)


class Contestant(NamedTuple):
    """A law with its gains in a scenario, and its walks."""

    scenario: mc.Scenario
    law: mc.Law
    gains: AnyGains
    parameters: mc.Parameters  # (member, ...), see `tuning.problem.plans.rows`
    metrics: Mapping[str, np.ndarray]  # (member,)
    fresh_parameters: mc.Parameters  # (fresh, ...)
    fresh_metrics: Mapping[str, np.ndarray]


class Start(NamedTuple):
    """A plan of each member from which a search begins."""

    name: str
    targets: np.ndarray  # (member, time, limb, joint) rad
    parameters: mc.Parameters  # (member, ...)


class Contest(NamedTuple):
    """The common part of all contestants."""

    scenario: mc.Scenario
    robot: Robot
    asked: Ceiling
    walks: Walks
    draws: Draws
    step: float  # rad, of the first offsets
    progress: Progress


class Ended(NamedTuple):
    """The best plan of each member that was found, and how each descent went."""

    plan: Start
    scored: Scored  # of its walks, with the disturbances
    records: list[dict[str, Any]]


def ceiling(
    scenario: mc.Scenario,
    laws: Laws | None = None,
    settings: Ceiling | None = None,
    *,
    ensemble: Ensemble | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    **changes: Any,
) -> Bounded:
    """Search how good any control law could be in a scenario, and return laws beside it.

    `tuning.write(ceiling(scenario, {"mine": "gains.yaml"}), "results/mine")` writes a page.

    Arguments:
        scenario: robot, gait, ground and hardware.
        laws: the rivals by name: gains of the scenario's law, gains files, or as
            `tuning.gains.gains_file.whole(file, scenario)` gives them. pd is among them; so is pd with kp and kd that
            are searched, unless there is a "retuned_pd".
        settings: of the search; `changes` are keys of `tuning.problem.ceiling.Ceiling` in place of it or to change it.
        ensemble: the walks, all alike for every contestant; the scenario's own walk where None.
        metrics: of the walks; weights and limits may name them.
        engine: the dynamics, one of `mjx_climb.ENGINES`.
        progress: called after each evaluation with the name of a search, how many are done, and in all.

    Raises:
        ConfigError: settings that make no sense for the scenario, or pd diverges.
    """
    asked = (settings or Ceiling()).changed(changes)
    how: dict[str, Any] = {
        "metrics": mc.MetricTable((*metrics, SWING, RATE)),
        "engine": engine,
        "dtype": np.dtype(asked.precision).type,
    }
    draws = draws_of(scenario, ensemble, asked.test_members, how)
    found, wanted = _contestants(scenario, laws or {}, asked, draws)
    goal = _widened(wanted, asked, [each.metrics for each in found.values()], scenario.gait.stride)

    begun = [each.parameters for each in found.values()]
    begun += [found[PD].parameters] * asked.random
    every = jax.tree.map(lambda *each: np.concatenate(each), *begun)
    under = walks_of(scenario, goal, every, **how)
    step = asked.step * float(found[PD].metrics["peak_joint_torque"].mean()) / scenario.control.kp
    contest = Contest(scenario, load_robot(scenario.robot), asked, under, draws, step, progress or (lambda *_: None))
    with background() as begin:  # programs are compiled beside each other, and beside the first search
        for work in _prepared(contest, every):
            begin(work)
        works = {name: begin(functools.partial(_over_time, each, draws)) for name, each in found.items()}
        kept = {name: work(ignore) for name, work in works.items()}
        starts = [_start(name, each, kept[name]) for name, each in found.items()]
        starts += _random(scenario, asked, starts[0])
        ended, hidden = _plans(contest, starts)
    front = None if asked.against is None else _front(contest, goal, found[PD].metrics, ended[-1].plan)
    tested = _tested(contest, found, ended) if draws.fresh else {}
    bounded = _bounded(contest, goal, found, ended, front, hidden, tested, ensemble)
    plans = {each.plan.name: each.plan for each in reversed(ended[1:])}
    return dataclasses.replace(bounded, data=bounded.data.assign(_histories(contest, plans, kept)))


# --- who takes part


def draws_of(scenario: mc.Scenario, ensemble: Ensemble | None, fresh: int, how: Mapping[str, Any]) -> Draws:
    """Return all walks: of the ensemble and of a fresh draw of it, or the scenario's own."""
    drawn = [(1, own_parameters(scenario))]
    if ensemble is not None:
        both = ensemble, ensembles.fresh(ensemble.model_copy(update={"members": fresh}))
        drawn = [(each.members, ensembles.draw(scenario, each)) for each in both if each.members]

    def flat(members: int, value: Any, own: int) -> np.ndarray:
        value = np.asarray(value)
        each = value[:, 0] if value.ndim > own else value
        return np.broadcast_to(each, (members, *value.shape[value.ndim - own :]))

    rows = [jax.tree.map(functools.partial(flat, count), each, own_axes(each)) for count, each in drawn]
    parameters: mc.Parameters = jax.tree.map(lambda *each: np.concatenate(each), *rows)
    return Draws(drawn[0][0], sum(count for count, _ in drawn[1:]), parameters, how)


def _contestants(
    scenario: mc.Scenario, laws: Laws, asked: Ceiling, draws: Draws
) -> tuple[dict[str, Contestant], Objective]:
    """Return who takes part, pd first, and the objective: programs of several laws are compiled side by side."""
    with background() as begin:

        def walk(scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains) -> Work[Contestant]:
            return begin(lambda _: _contestant(scenario, law, gains, draws))

        works = {PD: walk(under_pd(scenario), None, {})}
        works |= {name: walk(*_walker(scenario, name, own)) for name, own in laws.items()}
        goal = _objective(asked, works[PD](ignore).metrics, draws.how["metrics"])
        if RETUNED not in laws:
            own = _retuned(scenario, asked, goal, draws)
            works = {PD: works.pop(PD), RETUNED: walk(*_walker(scenario, RETUNED, own)), **works}
        return {name: work(ignore) for name, work in works.items()}, goal


def _walker(
    scenario: mc.Scenario, name: str, own: AnyGains | Whole | str | os.PathLike[str]
) -> tuple[mc.Scenario, mc.Law | None, AnyGains]:
    """Return scenario, law (None: the scenario's) and gains of a contestant."""
    if isinstance(own, str | os.PathLike):
        own = gains_file.whole(own, scenario)
    if isinstance(own, Whole):
        return scenario, own.law, own.gains
    return (under_pd(scenario) if name == RETUNED else scenario), None, own


def _contestant(scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains, draws: Draws) -> Contestant:
    """Return a contestant with its walks; nothing is torn off."""
    own = law or law_of(scenario)
    simulation = mc.Simulation(scenario, own, draws.how["metrics"], draws.how["engine"], smooth=True)
    found = simulation.metrics(gains, draws.parameters, dtype=draws.how["dtype"], unsteady=True)
    every = rows(scenario, own, gains, draws.parameters, draws.members + draws.fresh)
    members = draws.members_of(every), draws.members_of(found)
    return Contestant(scenario, own, gains, *members, draws.fresh_of(every), draws.fresh_of(found))


def _retuned(scenario: mc.Scenario, asked: Ceiling, goal: Objective, draws: Draws) -> dict[str, float]:
    """Return kp and kd of pd, searched for the same objective on the same walks."""
    each = jax.tree.map(lambda value: value[:, None], draws.members_of(draws.parameters))
    walks: dict[str, Any] = {"parameters": each, "metrics": draws.how["metrics"], "engine": draws.how["engine"]}
    how: dict[str, Any] = {"space": "isotropic", "joint_gains": True, "precision": asked.precision}
    return retuned_pd.joint_of(tune(under_pd(scenario), objective=goal, **walks, **how))


def _over_time(of: Contestant, draws: Draws, _: Callback) -> OverTime:
    """Return the histories of a contestant's walks."""
    return over_time(of.scenario, of.law, of.gains, draws.members_of(draws.parameters), **draws.how)


def _start(name: str, of: Contestant, kept: OverTime) -> Start:
    """Return the plans under which members walk as a contestant does, unless it changes the joint loop's gains."""
    walked = enumerate(kept.joint_targets)
    targets = [commanded(each, row(of.parameters, member), of.scenario) for member, each in walked]
    return Start(name, np.stack(targets), of.parameters)


def _random(scenario: mc.Scenario, asked: Ceiling, about: Start) -> list[Start]:
    """Return random starts about one."""
    rng, knots = np.random.default_rng(asked.seed), _knots(scenario, asked.knots[0])
    shape = (asked.random, 1, knots.count, *about.targets.shape[2:])
    shaken = about.targets + knots.at_steps(SHAKEN * rng.standard_normal(shape))
    return [Start(f"random {number + 1}", each, about.parameters) for number, each in enumerate(shaken)]


# --- the goal


def _objective(asked: Ceiling, pd: Mapping[str, np.ndarray], metrics: mc.MetricTable) -> Objective:
    """Return the objective, relative to pd's means over the members, without limits of travel."""
    search = Search.make({"weights": asked.weights, "limits": asked.limits, "no_worse_than_pd": False,
                          "deviation_factor": asked.deviation_factor})  # fmt: skip
    check_metrics(search, metrics, "ceiling")
    if asked.against is not None:
        check_metrics(Search(weights=dict.fromkeys((asked.better, asked.against), 1.0)), metrics, "ceiling")
    baseline = {name: np.asarray(value, float).mean() for name, value in pd.items()}
    goal = objectives.objective(search, baseline | {"base_deviation": pd["base_deviation"].max()}, metrics=metrics)
    reason, limits = f"{asked.deviation_factor:g} times pd's", []
    for name in _WIDENED[1:]:
        if name not in asked.limits:
            value = asked.deviation_factor * float(pd[name].max())
            limits.append(Limit(name, value, max(abs(value), 1e-12), LIMIT_MARGIN, reason))
    return dataclasses.replace(goal, limits=(*goal.limits, *limits))


def _widened(goal: Objective, asked: Ceiling, walked: Sequence[Mapping[str, np.ndarray]], stride: float) -> Objective:
    """Return the objective with limits so wide that no contestant breaks one that is relative to pd; travel is held."""
    whole = {
        name: np.concatenate([each[name][~each["diverged"].astype(bool)] for each in walked])
        for name in (*_WIDENED, "travel")
    }
    limits = []
    for limit in goal.limits:
        if limit.metric in _WIDENED and limit.metric not in asked.limits:
            value = max(float(np.max(limit.value)), float(whole[limit.metric].max()))
            limit = limit._replace(value=value, scale=max(abs(value), 1e-12))
        limits.append(limit)
    if "travel" not in asked.limits:
        way = max(np.abs(whole["travel"]).max(), stride)
        for value, larger in (
            (whole["travel"].min() - TRAVEL * way, True),
            (whole["travel"].max() + TRAVEL * way, False),
        ):
            limits.append(Limit("travel", float(value), float(way), 0.1 * TRAVEL, "the contestants'", larger))
    return dataclasses.replace(goal, limits=tuple(limits))


# --- the search


def _prepared(contest: Contest, every: mc.Parameters) -> list[Work[None]]:
    """Return works that compile the programs of the first search, from all starts, and of later ones, from one."""
    scenario, members = contest.scenario, contest.draws.members
    robot, knots = contest.robot, _knots(scenario, contest.asked.knots[0])

    def prepared(starts: int, since: np.ndarray | None) -> Work[None]:
        still = np.zeros((starts, members, scenario.steps, *robot.joint_lower.shape))
        freedom = Freedom(still, knots, True, since, robot.joint_lower, robot.joint_upper)
        walked = row(every, np.arange(starts * members))
        return lambda _: contest.walks.prepare(freedom, walked)

    later = np.zeros(members) if contest.asked.delays else None
    return [prepared(len(every.gravity) // members, None), prepared(1, later)]


def _plans(contest: Contest, starts: Sequence[Start]) -> tuple[list[Ended], bool]:
    """Search all plans, from the blind one to the clairvoyant, and return whether the blind one was kept from knowing.

    A first search of the blind plan, from all starts, is where the second search of every plan begins, the blind one's
    too: all have as many evaluations, so that none is better for having been searched longer. One that knows more
    takes the plan of one that knows less where that is better.

    Where the first disturbance comes at the same time in all members, a plan for all of them could know of it: the
    blind one is then searched without disturbances, and the others begin where its second search has ended.
    """
    asked, step = contest.asked, contest.scenario.time_step
    onset = _onset(contest.draws.members_of(contest.draws.parameters), contest.scenario.duration) / step
    felt = np.isfinite(onset)
    hidden = bool(felt.all() and np.ptp(onset) == 0)
    shared = [
        start._replace(targets=np.broadcast_to(start.targets.mean(0, keepdims=True), start.targets.shape))
        for start in starts
    ]
    first = _search(contest, FIRST, shared, undisturbed=hidden)
    begun = first.plan._replace(name=BLIND)
    ended = [first, _search(contest, BLIND, [begun], undisturbed=hidden)]
    # the others keep it until they feel the disturbance
    begun = ended[-1].plan if hidden else begun
    for delay in sorted(asked.delays, reverse=True) if felt.any() else ():
        since = onset + math.ceil(delay / step - 1e-6)
        own = _search(contest, f"causal {1e3 * delay:g} ms", [begun], common=not hidden, since=since)
        ended.append(_no_worse(own, ended[-1], alone=hidden))
    own = _search(contest, CLAIRVOYANT, [begun, *starts], common=False, since=np.zeros(contest.draws.members))
    return [*ended, _no_worse(own, ended[-1], alone=True)], hidden


def _no_worse(own: Ended, less: Ended, *, alone: bool) -> Ended:
    """Return a plan, or the one that knows less where that is better: for each member `alone`, or for all of them."""
    worse = less.scored.merit < own.scored.merit if alone else np.full(len(own.scored.merit), False)
    if not alone and less.scored.merit.mean() < own.scored.merit.mean():
        worse = ~worse
    targets, parameters = choose(worse, less.plan[1:], own.plan[1:])
    plan = Start(own.plan.name, targets, parameters)
    return own._replace(plan=plan, scored=choose(worse, less.scored, own.scored))


def _search(
    contest: Contest,
    name: str,
    starts: Sequence[Start],
    *,
    common: bool = True,
    since: np.ndarray | None = None,
    undisturbed: bool = False,
) -> Ended:
    """Search one kind of plan from several starts, and with ever finer knots from the best of them.

    Arguments:
        common, since: as of `tuning.problem.plans.Freedom`.
        undisturbed: the walks of the search have no disturbances.
    """
    asked, walks, members, records = contest.asked, contest.walks, contest.draws.members, []
    robot = contest.robot
    targets = np.stack([start.targets for start in starts])
    parameters = jax.tree.map(lambda *each: np.concatenate(each), *(start.parameters for start in starts))
    names = np.repeat([[start.name] for start in starts], members, axis=1)
    known, evaluations, in_all = None, 0, asked.iterations * len(asked.knots)
    for spacing in asked.knots:
        free = _knots(contest.scenario, spacing), common, since, robot.joint_lower, robot.joint_upper
        freedom = Freedom(targets, *free)
        walked = dataclasses.replace(parameters, disturbances=()) if undisturbed else parameters

        def evaluate(x: np.ndarray, sharp: float, of: Freedom = freedom, walked: mc.Parameters = walked) -> Evaluated:
            nonlocal evaluations
            found, slopes = walks.evaluate(of, x, walked, sharp=sharp)
            contest.progress(name, evaluations := evaluations + 1, in_all)
            return Evaluated(of.of_problems(found.merit), slopes)

        step = contest.step * math.sqrt(spacing / asked.knots[0])
        found = descend(evaluate, freedom.none, asked.iterations, step=step, known=known)
        for place in range(len(targets)):
            own = slice(place, place + 1) if common else slice(place * members, (place + 1) * members)
            records.append(
                {"contestant": name, "start": ", ".join(dict.fromkeys(names[place])), "knots": spacing,
                 "before": found.first[own].mean(), "merit": found.merit[own].mean(),
                 "slope": np.mean(found.slope[own])}
            )  # fmt: skip
        # the best start of each problem goes on, from its best point
        best, every = found.merit.reshape(len(targets), -1).argmin(0), np.arange(members)
        best = np.broadcast_to(best, members)
        targets, names = freedom.targets(found.x)[best, every][None], names[best, every][None]
        parameters = jax.tree.map(lambda value, pick=best * members + every: value[pick], parameters)
        known = found.merit.reshape(-1, 1 if common else members).min(0)
    ended = Freedom(targets, *free)
    scored, _ = walks.evaluate(ended, ended.none, parameters, sharp=0.0)
    return Ended(Start(name, targets[0], parameters), scored, records)


def _knots(scenario: mc.Scenario, spacing: float) -> Knots:
    """Return knots so many s apart.

    Raises:
        ConfigError: no whole time steps.
    """
    every = round(spacing / scenario.time_step)
    if abs(every * scenario.time_step / spacing - 1) > 1e-6:
        raise ConfigError("", "knots", f"whole time steps of {scenario.time_step:g} s", f"{spacing:g}")
    return Knots(scenario.steps, every)


def _onset(parameters: mc.Parameters, duration: float) -> np.ndarray:
    """Return when the first disturbance acts in each member, (member,) s; infinite: not in the walk.

    Raises:
        ConfigError: a disturbance that does not tell.
    """
    first = np.full(len(parameters.gravity), np.inf)
    for place, each in parameters.components.items():
        if isinstance(each, Disturbance):
            with jax.enable_x64(True):
                begins = jax.vmap(lambda one: one.begins())(each)
            if begins is None:
                got = f"got {type(each).__name__}, which does not tell"
                raise ConfigError("", place, f"a disturbance that tells by begins() when it begins, {got}")
            first = np.minimum(first, begins)
    return np.where(first < duration, first, np.inf)


# --- a front of two metrics


class Front(NamedTuple):
    """The clairvoyant plans between the best of one metric and the best of another."""

    shares: np.ndarray  # (point,) the weight of the second metric, 0 to 1
    metrics: np.ndarray  # (point, 2, member)
    ended: list[Ended]


def _front(contest: Contest, goal: Objective, pd: Mapping[str, np.ndarray], start: Start) -> Front:
    """Search clairvoyant plans for two metrics by turns of their weights, each from the one before it."""
    asked, scenario, how = contest.asked, contest.scenario, contest.draws.how
    assert asked.against is not None
    names = asked.better, asked.against
    terms = _objective(asked.changed({"weights": dict.fromkeys(names, 1.0)}), pd, how["metrics"]).terms
    under = walks_of(scenario, dataclasses.replace(goal, terms=terms), start.parameters, **how)
    shares, ended = np.linspace(0.0, 1.0, asked.points), list[Ended]()
    for share in shares:
        weighted = np.array(under.numbers.terms)
        weighted[:, 0] = 1 - share, share
        own = dataclasses.replace(under, numbers=under.numbers._replace(terms=weighted))
        starts = [start, *(each.plan for each in ended[-1:])]
        name = f"front, {share:.0%} {asked.against}"
        ended.append(
            _search(contest._replace(walks=own), name, starts, common=False, since=np.zeros(contest.draws.members))
        )
    metrics = np.array([[each.scored.metrics[name] for name in names] for each in ended])
    penalty = np.array([each.scored.merit - each.scored.value for each in ended])
    return Front(shares, _along(goal, terms, shares, metrics, penalty), ended)


def _along(
    goal: Objective, terms: Sequence[Term], shares: np.ndarray, metrics: np.ndarray, penalty: np.ndarray
) -> np.ndarray:
    """Return both metrics (point, 2, member) along a front: a plan may be better for its neighbours' weights than own.

    `metrics` (point, 2, member) and `penalty` (point, member) are those of the plans for each share of the second term.
    """
    ratios = [np.asarray(goal.ratios(jnp.asarray(metrics[:, place]), term)[0]) for place, term in enumerate(terms)]
    merits = (1 - shares)[:, None, None] * ratios[0] + shares[:, None, None] * ratios[1] + penalty
    best = np.where(np.isfinite(merits), merits, np.inf).argmin(1)
    return np.take_along_axis(metrics, best[:, None], 0)


# --- unseen walks


def _tested(
    contest: Contest, found: Mapping[str, Contestant], ended: Sequence[Ended]
) -> dict[str, Mapping[str, np.ndarray]]:
    """Return the metrics of the blind plan and of the contestants in walks of a fresh draw, (fresh,) each, by name."""
    plan, pd, count = next(each.plan for each in ended if each.plan.name == BLIND), found[PD], contest.draws.fresh

    def of_plan(pds: np.ndarray, own: np.ndarray, unseen: np.ndarray) -> np.ndarray:
        # joint gains and gait of the plan's start differ from pd's, alike in all members; all else is the member's
        return np.where(own[:1] == pds[:1], unseen, own[:1])

    parameters = jax.tree.map(of_plan, pd.parameters, plan.parameters, pd.fresh_parameters)
    targets = np.broadcast_to(plan.targets[:1], (count, *plan.targets.shape[1:]))
    blind = contest.walks.judge(targets, parameters)
    return {BLIND: blind.metrics, **{name: found[name].fresh_metrics for name in reversed([*found])}}


# --- the result


def _bounded(
    contest: Contest,
    goal: Objective,
    found: Mapping[str, Contestant],
    ended: Sequence[Ended],
    front: Front | None,
    hidden: bool,
    tested: Mapping[str, Mapping[str, np.ndarray]],
    ensemble: Ensemble | None,
) -> Bounded:
    """Return the contestants beside each other, the clairvoyant plan first and pd last."""
    scenario, asked, members = contest.scenario, contest.asked, contest.draws.members
    table, engine = contest.draws.how["metrics"], contest.draws.how["engine"]
    plans = {each.plan.name: each.plan for each in reversed(ended[1:])}
    walked = {each.plan.name: each.scored.metrics for each in reversed(ended[1:])}
    walked |= {name: each.metrics for name, each in reversed([*found.items()])}
    data = _scores(goal, walked, table, ("contestant", "member"))
    if tested:
        wanted = dataclasses.replace(goal, terms=_objective(asked, tested[PD], table).terms)
        unseen = _scores(wanted, tested, table, ("tested", "fresh"))
        data |= {f"unseen_{name}": values for name, values in unseen.items()}
    targets = np.stack([plan.targets for plan in plans.values()]).astype(np.float32)
    joint = {"units": "rad", "long_name": "joint target"}
    data["joint_targets"] = (("plan", "member", "time", "limb", "joint"), targets, joint)
    records = [record for each in (*ended, *(front.ended if front else ())) for record in each.records]
    for name in records[0]:
        data[f"descent_{name}"] = ("descent", np.array([record[name] for record in records]))
    if front is not None:
        data["front"] = (("point", "axis_of_front", "member"), front.metrics)
        data["front_share"] = ("point", front.shares, {"units": "1", "long_name": f"weight of {asked.against}"})
    robot = contest.robot
    attrs: dict[str, Any] = {"title": "bounds of control laws", **dataset.provenance(scenario)}
    attrs |= {"ceiling": asked.to_yaml(), "hidden": int(hidden)}
    attrs["own_gait"] = ", ".join(name for name, each in found.items() if gait_of(by_name(each.gains)))
    reading = (name for name, each in found.items() if reads_forces(Problem(each.scenario, law=each.law)))
    attrs["reads_forces"] = ", ".join(reading)
    attrs["limits"] = "; ".join(objectives.in_words(limit) for limit in goal.limits)
    coordinates = {
        "contestant": list(walked), "member": np.arange(members), "plan": list(plans),
        "limb": list(robot.limbs), "joint": list(robot.joint_names), **({"tested": list(tested)} if tested else {}),
    }  # fmt: skip
    own = mc.MetricTable(metric for metric in table if metric not in (SWING, RATE))
    problem = Problem(scenario, objective=goal, members=members, engine=engine, metrics=own, ensemble=ensemble)
    first = {
        name: Walked(under_pd(scenario), PDLaw(), {}, row(plan.parameters, 0), plan.targets[0], engine)
        for name, plan in plans.items()
    }
    of_first = row(contest.draws.parameters, 0)
    first |= {name: Walked(each.scenario, each.law, each.gains, of_first, None, engine) for name, each in found.items()}
    return Bounded(xr.Dataset(data, coordinates, attrs), problem, ensemble=ensemble, asked=asked, first=first)


def _scores(
    goal: Objective, walked: Mapping[str, Mapping[str, np.ndarray]], table: mc.MetricTable, over: tuple[str, str]
) -> dict[str, Any]:
    """Return objective, whether limits are kept, and metrics of contestants, along them and their walks."""
    metrics = {
        name: np.stack([np.asarray(each[name]) for each in walked.values()]) for name in next(iter(walked.values()))
    }
    with devices.on_host():
        score = goal.score({name: jnp.asarray(value) for name, value in metrics.items()})
    about, kept = ({"units": "1", "long_name": text} for text in ("objective", "every limit is kept"))
    data: dict[str, Any] = {
        "value": (over, np.asarray(score.value), about),
        "feasible": (over, np.asarray(score.feasible), kept),
    }
    for metric in table:
        data[metric.name] = (over, metrics[metric.name], dataset.metric_attributes(metric))
    return data


def _histories(contest: Contest, plans: Mapping[str, Start], kept: Mapping[str, OverTime]) -> dict[str, Any]:
    """Return histories of the first member's walk: (contestant, instant), of plans first."""
    scenario = contest.scenario
    firsts = [(plan.parameters, plan.targets) for plan in plans.values()]
    parameters, targets = jax.tree.map(lambda *each: np.stack([value[0] for value in each]), *firsts)
    planned = over_time(under_pd(scenario), PDLaw(), None, parameters, targets, **contest.draws.how)
    laws = [*reversed([*kept.values()])]
    forces = [*planned.foot_force, *(each.foot_force[0] for each in laws)]
    offsets = [*planned.base_offset, *(each.base_offset[0] for each in laws)]
    first, peaks, kept_offsets = _thinned(np.stack(forces), np.stack(offsets))
    force, offset = ({"units": unit, "long_name": text} for unit, text in
                     (("N", "largest foot force"), ("m", "base off its reference")))  # fmt: skip
    return {
        "foot_force_history": (("contestant", "instant"), peaks, force),
        "base_offset_history": (("contestant", "instant", "axis"), kept_offsets, offset),
        "instant": ("instant", first * scenario.time_step, {"units": "s", "long_name": "time"}),
    }


def _thinned(forces: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first steps of at most `INSTANTS` stretches, the largest force in each, and the offset at its first.

    `forces` are (contestant, step) and `offsets` (contestant, step, axis).
    """
    steps = forces.shape[1]
    first = np.arange(0, steps, -(-steps // INSTANTS))
    return first, np.maximum.reduceat(forces, first, axis=1), offsets[:, first]
