"""From a log to the parameters of a scenario: `identify`."""

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import mjx_climb as mc
from mjx_climb.execution.contents import identity
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.fit import inference
from tuning.identification.fit.conclusions import SETTLED, identified
from tuning.identification.fit.problem import Fitted, Prior, Problem
from tuning.identification.fit.profile_changes import in_words, tried
from tuning.identification.fit.result import Identified
from tuning.identification.fit.search import Progress, Searches
from tuning.identification.fit.stamps import Noise, change, noise_of
from tuning.identification.model.gripped import check_parts, cut_gripped, gripped_model
from tuning.identification.model.predicted import DELAY, SERVO_DELAY, Fit, model_of, with_nuisances
from tuning.identification.model.replay import Base, base_of
from tuning.identification.model.variables import Variable, begin, variables
from tuning.identification.model.windows import KINDS, cut
from tuning.identification.readers import read_log
from tuning.identification.readers.log import Log
from tuning.methods.parts import Parts, identity_of
from tuning.problem.evaluation import Problem as Walks

HELD_OUT = 0.2
STARTS = 4
_COARSE = 1e-4  # relative tolerance, with which the starts are compared
_MOST, _PASSES = 100, 4  # evaluations of a search, and passes with the noise estimated anew
_UNHEARD = 30.0  # times their noise, where starts are compared
_LOUD = 0.1  # of a signal's standard deviation, its noise there
_GUESSED = "the log has base or foot forces: base free, all grippers shut (--base held: on a stand)"
_DIVERGES = "the model diverges at the values that it begins with (--set others)"
_OTHERS = 4  # starts, where all those that were asked for diverge
_SPREAD = 0.7  # sd of the starts, of the prior's
_HOP = 3.0  # times a friction, where the search begins once more
_REFUTED = 0.1  # of the residuals' variance of a signal, unmodelled: beyond it other profiles are tried


def identify(
    scenario: mc.Scenario,
    log: Log | str | os.PathLike[str],
    fit: Sequence[str | Variable],
    *,
    base: Base | None = None,
    signals: Any = None,
    changes: Mapping[str, Mapping[str, Any]] | None = None,
    mass: float = 0.0,
    held_out: float = HELD_OUT,
    starts: int = STARTS,
    progress: Progress | None = None,
    out: str | os.PathLike[str] | None = None,
) -> Identified:
    """Fit parameters of a scenario to a robot's log, its base held, or free on all shut grippers.

    Arguments:
        scenario: nominal values, robot and time step.
        log: as `tuning.identification.readers.read_log` gives it, or its file.
        fit: keys, or patterns of keys, as `hardware.servo.*`; or a `tuning.identification.model.variables.Variable` of
            your own, whose `change` is a function of its value, the parameters and the robot, or FILE.py:NAME of one.
        base: held or free; None: held where the log has neither base nor foot forces.
        signals: of a file, where each signal stands in it.
        changes: by key, fields of `tuning.identification.model.variables.Variable` in place of its own, as
            `{"control.kp": {"frozen": True}}`.
        mass: that hung on each foot while the log was made, kg; it is no part of the robot.
        held_out: share of the log, at its end, that is predicted and not fitted.
        starts: points from which the search begins, the nominal one among them.
        progress: called with evaluations done, at most to do, and a line.
        out: a folder in which every search that ended is kept: an interrupted fit goes on there, with the same
            arguments.

    Raises:
        ConfigError: no such key, a log that holds nothing to fit, or parts of your own that its model does not have.
        OutputError: `out` cannot be written to, or holds an unfinished computation of other arguments.
    """
    robot = load_robot(scenario.robot)
    log = log if isinstance(log, Log) else read_log(log, robot, signals)
    chosen_base = base_of(log, base, mass)
    check_parts(own_parameters(scenario), held=chosen_base == "held")
    chosen = variables(scenario, fit, held=chosen_base == "held", changes=changes)
    model: Fit
    if chosen_base == "held":
        windows = cut(log, robot, scenario.time_step, held_out, late=_latest(scenario, chosen))
        model = model_of(scenario, windows, with_nuisances(scenario, chosen, windows.kinds), mass)
    else:
        model = gripped_model(scenario, log, cut_gripped(log, robot, scenario.time_step, held_out), chosen)
    with Parts(out, lambda: identity_of_fit(scenario, log, model, held_out, starts) | {"base": chosen_base}) as parts:
        searches = Searches(parts, progress)
        found, problem = searched(Problem(model, rough_noise(model)), starts, searches)
        tests = inference.whiteness(problem, found)
        refuted = max((test.share for test in tests), default=0.0) > _REFUTED
        hint = ""
        if refuted and chosen_base == "held":
            hint = in_words(tried(problem, found, scenario, chosen, searches))
    guessed = [_GUESSED] if base is None and chosen_base == "free" else []
    return identified(scenario, log, chosen, (found, problem, tests), [*log.warnings, *guessed], hint)


def identity_of_fit(scenario: mc.Scenario, log: Log, model: Fit, held_out: float, starts: int) -> dict[str, Any]:
    """Return all that determines a fit, as plain JSON values."""
    fitted = [{name: str(value) for name, value in dataclasses.asdict(each).items()} for each in model.variables]
    for each, own in zip(fitted, (v.change for v in model.variables), strict=True):
        each["change"] = "" if own is None else identity(own, f"variable {each['key']}")
    more = {"log": log.digest, "fit": fitted, "mass": model.structure.mass, "held_out": held_out, "starts": starts}
    return {**identity_of(Walks(scenario)), **more}


def _latest(scenario: mc.Scenario, chosen: Sequence[Variable]) -> float:
    """Return the longest time that commands may take to the motors, s."""
    fitted, own = {v.key: v.upper for v in chosen}, scenario.hardware
    nominal: dict[str, float] = {DELAY: own.command_delay, SERVO_DELAY: scenario.value(SERVO_DELAY, 0.0)}
    return sum(fitted.get(key, delay) for key, delay in nominal.items())


def searched(problem: Problem, starts: int, searches: Searches) -> tuple[Fitted, Problem]:
    """Return the end of the search from the best of the starts, and the problem with the noise that is left.

    Raises:
        ConfigError: the model diverges, in one line.
    """
    model, prior, pieces = problem.model, problem.prior, problem.model.in_pieces
    samples = problem.samples
    # far from the optimum residuals are none of the noise's size: its own would have most of them count by size alone
    louder = np.maximum(problem.noise, _LOUD * samples.moved)
    # torques jump as commands do: no slope leads from one side of a jump to the other
    louder = np.where(model.windows.kind == KINDS.index("effort"), _UNHEARD * louder, louder)
    trial = Problem(pieces, louder)
    ends: list[Fitted] = []
    for point in begins(model, prior, starts + _OTHERS):
        if len(ends) == starts:  # where some diverge, as a limb without armature that falls, others begin
            break
        text = f"start {len(ends) + 1} of {starts}"
        if (end := searches.search(trial, np.r_[point, pieces.guess.ravel()], _MOST, text, _COARSE)) is not None:
            ends.append(end)
    if not ends:
        raise ConfigError(reason=_DIVERGES)
    _, *better = hops(trial, min(ends, key=lambda end: end.cost), searches)
    best, costs = min((*ends, *better), key=lambda end: end.cost), tuple(end.cost for end in (*ends, *better))
    if pieces is not model:
        whole, point = dataclasses.replace(problem, noise=louder), np.r_[best.x, model.guess.ravel()]
        if (end := searches.search(whole, point, _MOST, "the whole log", _COARSE)) is None:
            raise ConfigError(reason=_DIVERGES)
        best = end
    noise = noise_of(best.residuals, best.rate, samples, Noise(problem.noise, 0.0))
    problem = dataclasses.replace(problem, noise=noise.signals, clock=noise.clock, rate=best.rate)
    if (settled := _settled(problem, best, searches, _PASSES)) is None:
        raise ConfigError(reason=_DIVERGES)
    while settled is not None:
        found, problem = settled
        if not (untold := inference.untold(problem, found)).any():
            break
        held = untold | ~problem.free
        at = found._replace(x=np.where(held, begin(model.variables), found.x))
        settled = _settled(dataclasses.replace(problem, held=held), at, searches, 1)  # None: it diverges there
    return found._replace(costs=costs), problem


def hops(problem: Problem, best: Fitted, searches: Searches) -> list[Fitted]:
    """An end of a search, and the better ones that begin from it with another dry friction, each from the one before.

    A joint swings a whole number of times before it sticks, and the cost has a minimum for each number.
    """
    ends = [best]
    while True:
        points = _other_frictions(problem, np.r_[ends[-1].x, ends[-1].start.ravel()])
        tried = [searches.search(problem, point, 1, "another friction") for point in points]
        lowest = min((end for end in tried if end is not None), key=lambda end: end.cost, default=best)
        if lowest.cost > (1 - _COARSE) * ends[-1].cost:
            return ends
        point = np.r_[lowest.x, lowest.start.ravel()]
        ends += filter(None, [searches.search(problem, point, _MOST, "from another friction", _COARSE)])


def _other_frictions(problem: Problem, point: np.ndarray) -> Iterator[np.ndarray]:
    """Points with a third and three times the value of a dry friction, or with the nominal one."""
    for n, (v, first) in enumerate(zip(problem.model.variables, begin(problem.model.variables), strict=True)):
        if "friction" in v.key and "viscous" not in v.key and not v.beside:
            own = point[n] + np.log(_HOP) * np.array([-1, 1]) if v.log else point[n] * np.array([1 / _HOP, _HOP])
            for other in sorted({float(first), *np.clip(own, *v.bounds).tolist()} - {float(point[n])}):
                yield np.r_[point[:n], other, point[n + 1 :]]


def begins(model: Fit, prior: Prior, count: int) -> np.ndarray:
    """Return points (count, P) from which searches begin, the first one the nominal values."""
    rng = np.random.default_rng(0)
    # a friction far above its nominal value holds all joints still, and no slope leads away from there
    sizes = [abs(v.nominal) if v.nominal and not v.log else v.sd for v in model.variables]
    points = prior.mean + _SPREAD * np.minimum(prior.sd, sizes) * rng.standard_normal((count, len(prior.mean)))
    points = np.clip(np.where(points < prior.lower, 2 * prior.lower - points, points), prior.lower, prior.upper)
    # where a command comes as a sample is taken, a later one changes nothing of it: no place to begin
    off = [2 * model.windows.time_step if v.key == DELAY else -np.inf for v in model.variables]
    points[0] = np.maximum(begin(model.variables), off)
    return np.asarray(points)


def _settled(problem: Problem, found: Fitted, searches: Searches, passes: int) -> tuple[Fitted, Problem] | None:
    """The end of searches from a point, the noise estimated anew after each until it settles, and the last problem.

    None where the model diverges at the point.
    """
    samples = problem.samples
    for n in range(passes):
        end = searches.search(problem, np.r_[found.x, found.start.ravel()], _MOST, f"pass {n + 1}")
        if end is None:
            return None
        before = Noise(problem.noise, problem.clock)
        now = noise_of(end.residuals, end.rate, samples, before)
        found = end._replace(unsettled=change(before, now))
        if found.unsettled < SETTLED or n == passes - 1:
            break
        problem = dataclasses.replace(problem, noise=now.signals, clock=now.clock, rate=end.rate)
    return found, problem


def rough_noise(model: Fit) -> np.ndarray:
    """Return noise (signals,) from second differences, which hold some motion too."""
    rows, noise = model.windows.rows, np.ones(len(model.windows.names))
    for signal in range(len(noise)):
        value = rows.value[rows.signal == signal]
        bend = np.abs(np.diff(value, 2)) if len(value) > 10 else np.array([np.ptp(value)])
        noise[signal] = max(1.4826 * float(np.median(bend)) / np.sqrt(6), 1e-3 * float(np.ptp(value)), 1e-9)
    return noise
