"""The worth of a force sensor in words: gains that were found against pd with joint gains of its own."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mjx_climb.control import PlannedTransfer
from mjx_climb.gait.recovery import recovery_of
from tuning.comparisons import judge, paired
from tuning.comparisons.side_by_side import VARIATION, AtOneStep, Values, differences
from tuning.comparisons.verdicts import more_or_less
from tuning.numbers import number
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Objective
from tuning.results.front import Front
from tuning.results.tuned import Tuned
from tuning.searches import retuned_pd
from tuning.searches.retuned_pd import NAME, ON_A_GRID, PLANNED, UNSEARCHED, Rival

LEVEL = 0.05  # chance at most, of a claim that searches of equal laws make


class OverWalks(NamedTuple):
    """How far a difference is known that was found over several walks, relative as it is."""

    walks: int
    low: float
    high: float
    needed: float  # walks that would tell it from 0, if it is as found


def over_walks(walks: xr.Dataset, name: str, goal: Objective, rival: str = NAME) -> OverWalks:
    """Return how far the change of the objective from a rival is known, NaN where too few walks tell."""
    table = paired.compared(walks.sel(gains=[name, rival, judge.PD]), [], rival, goal)
    own = table.sel(metric="objective", statistic="mean", gains=name)
    base = abs(float(own["value"] - own["difference"]))
    low, high = (float(own[key]) / base for key in ("low", "high"))
    return OverWalks(table.attrs["members_compared"], low, high, float(own["walks_needed"]))


class Ends(NamedTuple):
    """Objectives at which the searches of gains and of their rival ended, one for each seed."""

    ours: Sequence[float]
    theirs: Sequence[float]

    @property
    def why_unknown(self) -> str:
        """Why the searches do not tell the laws apart, "" where all of one end below all of the other."""
        counts = len(self.ours), len(self.theirs)
        if 2 / math.comb(sum(counts), counts[0]) > LEVEL:
            enough = next(n for n in itertools.count(1) if 2 / math.comb(2 * n, n) <= LEVEL)
            searches = "one search of each tells" if counts[0] == 1 else f"{counts[0]} searches of each tell"
            return f"{searches} no law from another (from {enough} seeds on)"
        apart = max(self.ours) < min(self.theirs) or max(self.theirs) < min(self.ours)
        return "" if apart else f"the {counts[0]} searches of each do not all agree"


class BesidePd(NamedTuple):
    """pd retuned, where another law without a force sensor was searched too."""

    value: float  # of the goal
    rival: Rival


class Worth(NamedTuple):
    """The worth of a force sensor: of gains found against pd retuned."""

    changes: dict[str, float]  # relative, by goal: -0.1 is a tenth less
    in_words: str

    @property
    def summary(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"force_sensor": self.changes | {"in_words": self.in_words}}


def worth_of(
    values: Mapping[str, float],
    without: Mapping[str, float],
    rival: Rival,
    *,
    larger: bool = False,
    place: str = "",
    others: tuple[Sequence[str], Sequence[str]] = ((), ()),
    over: OverWalks | None = None,
    level: AtOneStep | None = None,
    what: str = "the force sensor",
    pd: BesidePd | None = None,
    ends: Ends | None = None,
) -> Worth:
    """Return the worth of a force sensor.

    There is a verdict only where other searches and other walks would not turn it round.

    Arguments:
        values: first of the goal, then of other metrics.
        without: the same of the best law without a force sensor, which is `rival`.
        larger: whether more of the first value is better, not less.
        place: where the gains were searched, if that is not all there is.
        others: metrics that are worse, and those that are better, in words.
        over: how far the change of the first value is known, of several walks.
        level: the change of the first value at one time step, where `without` has a step of its own.
        what: parts that pd retuned lacks, in words.
        pd: pd retuned; None where no other law without a force sensor was searched, so that there is no verdict.
        ends: of the searches; None of grids, which another search does not change.
    """
    than = f"{_named(rival)}, which needs none" + (f" ({rival.beside})" if rival.beside else "")
    than += "" if rival.feasible else " (and breaks a limit)"
    changes = {name: values[name] / without[name] - 1 for name in values}
    if not all(map(math.isfinite, changes.values())):
        return Worth(changes, f"{what}: not to be compared with {than}: a walk failed")
    first = next(iter(changes.values()))
    turned = level is not None and not first * level.change > 0
    if over is not None and not (over.low > 0 or over.high < 0):
        verdict = f"{over.walks} walks cannot tell what {what} is worth{place}"
        if math.isfinite(over.needed):
            verdict += f" ({math.ceil(over.needed):,} would, if the difference is what it seems)"
    elif level is not None and turned:
        verdict = f"no verdict on {what}{place}, since a time step of {level.step:g} s turns it round"
    elif ends is not None and (why := ends.why_unknown):
        verdict = f"it cannot be told what {what} is worth{place}, since {why}"
    elif not (first > 0 if larger else first < 0):
        verdict = f"{what} does not pay{place}"
    elif rival.lacks:
        verdict = f"no verdict on {what}, since pd was searched {rival.lacks}"
    elif pd is None:
        verdict = f"no verdict on {what}, since of the laws without one pd alone was searched"
    else:
        verdict = f"{what} pays"
    said, interval = "", ""
    if over is not None and math.isfinite(over.low):
        interval = f" (95 % interval {100 * over.low:+.1f} to {100 * over.high:+.1f} %)"
    for name, change in changes.items():  # the objective may be less though one of its terms is more
        link = " and " if (change < 0) == (first < 0) else ", though "
        said += f"{link if said else ''}{more_or_less(change)} {name.replace('_', ' ')}{interval}"
        interval = ""
    step = "" if rival.step is None else f", both at a time step of {rival.step:g} s"
    rest = [f"{which}: {', '.join(each)}" for which, each in zip(("worse", "better"), others, strict=True) if each]
    if pd is not None and pd.rival.name != rival.name:
        name = next(iter(values)).replace("_", " ")
        whole, own = (float(next(iter(each.values()))) / pd.value for each in (without, values))
        of_pd = f"{more_or_less(own - 1)} {name} than {_named(pd.rival)}"
        rest = [f"{of_pd}, of which {what} is worth {100 * (whole - own) * (-1 if larger else 1):.1f} %", *rest]
    return Worth(changes, "; ".join([f"{verdict}: {said} than {than}{step}", *rest]))


def better_of(rival: Rival, values: Mapping[str, float]) -> tuple[str, Rival]:
    """Return the better of pd retuned and of `retuned_pd.by_plan` on its joint gains: its name among walks, the rival.

    `values` by these names are of a goal that should be small, NaN where a walk failed.
    """
    if UNSEARCHED not in values:
        return NAME, rival
    pd, plan = values[NAME], values[UNSEARCHED]
    if math.isnan(plan) or plan >= pd:
        found = "the walk failed" if math.isnan(plan) else number(plan)
        return NAME, rival._replace(beside=f"load transfer by plan on these, not searched: {found}")
    found = "the walk failed" if math.isnan(pd) else number(pd)
    return UNSEARCHED, rival._replace(value=plan, name=PlannedTransfer.__name__, beside=f"pd on these: {found}")


class Without(NamedTuple):
    """The best rival without a force sensor of a search."""

    name: str  # of its walk
    rival: Rival
    pd: BesidePd | None  # where a law that plans was searched too
    ends: Ends | None  # of both searches; None where the rival was not searched


def best_without(
    found: Tuned, rivals: tuple[Tuned, Tuned | None], scores: Mapping[str, float], step: float | None = None
) -> Without:
    """Return the best of pd retuned and of load transfer by plan, searched or on pd's joint gains.

    Arguments:
        found: the gains.
        rivals: pd retuned, and load transfer by plan, where it was searched.
        scores: the goal in the walks of both, by name, NaN where one failed.
        step: s, of the comparison, where it is not the scenario's.
    """
    retuned, plan = rivals
    name, best = better_of(retuned_pd.rival_of(retuned, step), scores)
    if plan is None:
        return Without(name, best, None, Ends(found.ends, retuned.ends) if name == NAME else None)
    pd = BesidePd(scores[name], best)
    if scores[PLANNED] < scores[name]:
        return Without(PLANNED, retuned_pd.rival_of(plan, step), pd, Ends(found.ends, plan.ends))
    return Without(name, best, pd, Ends(found.ends, retuned.ends))


def give_joint_gains(rows: dict[str, tuple[Values | None, Values]], joint: Values, rival: str) -> None:
    """Give the joint gains of pd retuned to it and to the plan on them, which goes where it is not the best `rival`."""
    for name in rows.keys() & {NAME, UNSEARCHED}:
        rows[name] = joint, rows[name][1]
    if rival != UNSEARCHED:
        rows.pop(UNSEARCHED, None)


def _named(rival: Rival) -> str:
    own = ", ".join(f"{name.removeprefix('gait.').replace('_', ' ')} {v:.4g}" for name, v in rival.joint.items())
    return f"{rival.name} with {own}"


def between(metrics: Iterable[Values], scored: Iterable[Values], rival: Rival, problem: Problem, **how: Any) -> Worth:
    """Return the worth of a force sensor from the metrics and scores of ours and of the best rival without one.

    `how` are arguments of `worth_of`.
    """
    (ours, theirs), (values, without) = metrics, scored
    others = differences(ours, theirs, problem.metrics, but=(VARIATION,))
    recovers = problem.law is not None and recovery_of(problem.law, None) is not None
    what = "the force sensor with the recovery" if recovers else "the force sensor"
    return worth_of(values, without, rival, others=others, what=what, **how)


def of_front(found: Front) -> str:
    """Return the worth of a force sensor at the knee of a front in a sentence."""
    metrics, without = found.problem.metrics, found.rival
    better, against = (metrics.in_words(name) for name in (found.asked.better, found.asked.against))
    if without is None:
        return f"pd has more {against} than the knee with any kp and kd of its grid"
    name = "pd" if law_without(without) == NAME else PlannedTransfer.__name__
    ours = {better: found.data[found.asked.better].values[found.knee].item()}
    theirs = {better: without[f"without_{found.asked.better}"].item()}
    joint = {name: without[f"without_{name}"].item() for name in ("kp", "kd")}
    rival = Rival(joint, theirs[better], lacks=ON_A_GRID, name=name)
    worth = worth_of(ours, theirs, rival, larger=metrics[found.asked.better].larger_is_better)
    return f"{worth.in_words}, at no more {against}"


def law_without(point: xr.Dataset) -> str:
    """Return the law of a point of a front without a force sensor."""
    return str(point["without_law"].item()) if "without_law" in point else NAME


def of_schedule(table: xr.Dataset, by_plan: np.ndarray | float = math.nan) -> str:
    """Return the worth of a force sensor in a sentence: the gains against the better rival without one at each point.

    `by_plan` are the values of `retuned_pd.by_plan` on the kp and kd of pd, NaN where it breaks a limit.
    """
    best = np.fmin(table["retuned_value"].values, by_plan)
    ratio = table["value"].values / best
    known = ratio[np.isfinite(ratio)]
    if not known.size:
        there = "with pd, which keeps" if np.isnan(best).all() else "with pd: the gains keep"
        return f"the force sensor: not to be compared {there} the limits at no operating point"
    none = f"no verdict on the force sensor, since pd was searched {ON_A_GRID}"
    verdict = none if (known < 1).any() else "the force sensor does not pay"
    span = " to ".join(dict.fromkeys(f"{end:.3f}" for end in (known.min(), known.max())))
    found = f"{verdict}: less objective at {(known < 1).sum()} of {known.size} operating points"
    name = "that of pd with kp and kd for each, which needs none"
    if np.isfinite(by_plan).any():
        name = f"the least of pd with kp and kd for each and of load transfer by plan on these ({UNSEARCHED})"
    return f"{found}, {span} times {name}"
