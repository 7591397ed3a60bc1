"""pd with joint gains of its own for the same goal: what can be had without a force sensor."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

import mjx_climb as mc
from mjx_climb.checks.time_step import short_enough
from mjx_climb.control import PD
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.rollouts.given import AnyGains
from tuning.gains.gains_file import by_name
from tuning.problem import spaces
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.spaces import JOINT, default_bounds
from tuning.searches import finished_parts, tune
from tuning.searches.result import Result

NAME = "retuned_pd"  # in tables and files
_COARSE = (12, 9)  # values of kp and kd
FINE = (24, 18)
_JUDGED_BY = ("force_variation", "detached_limb", "diverged")


def search(
    problem: Problem,
    settings: Search,
    *,
    out: Path | None = None,
    progress: Callable[[tune.Progress], None] | None = None,
) -> Result | None:
    """Search kp and kd of pd as a law's gains were searched: goal, walks, method and rounds are the same.

    A method of the caller's own is replaced by the default one, in its own number of rounds.

    Arguments:
        problem: what was searched.
        settings: of its search.
        out: a folder that keeps each finished round in a folder of its own, see `tuning.searches.tune.tune`.
        progress: called after each round.

    Returns:
        The search, or None where what was searched is itself pd.

    Raises:
        KeyboardInterrupt: the user stopped it; with `out` it goes on from there.
    """
    if problem.law is None and problem.scenario.control.controller == "pd":
        return None
    settings, scenario = _settings(settings), under_pd(problem.scenario)
    rival = dataclasses.replace(problem, scenario=scenario, space=spaces.space(scenario, settings), law=None)
    again = tune.run(rival, settings, out=None if out is None else _kept_in(out), progress=progress)
    if again.interrupted:
        raise KeyboardInterrupt
    return again


def walked_on_grid(
    scenario: mc.Scenario,
    metrics: mc.MetricTable,
    counts: tuple[int, int] = _COARSE,
    *,
    numbers: mc.Parameters | None = None,
    dtype: DTypeLike = np.float32,
    engine: str = DEFAULT_ENGINE,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Walk pd with kp and kd on a grid within the bounds of a search, and with the scenario's own.

    `numbers` (P) are walked in place of the scenario's, all of them with each.

    Returns:
        kp and kd, (N,) each, and the metrics of their walks, (N) or (N, P).
    """
    pd = under_pd(scenario)
    bounds, own = default_bounds(pd, PD()), {"kp": pd.control.kp, "kd": pd.control.kd}
    axes = [np.append(np.geomspace(*bounds[name], count), own[name]) for name, count in zip(own, counts, strict=True)]
    gains = dict(zip(own, (values.ravel() for values in np.meshgrid(*axes)), strict=True))
    each = gains if numbers is None else {name: values[:, None] for name, values in gains.items()}
    walks = mc.rollout_metrics(pd, each, numbers, metrics=metrics, dtype=dtype, engine=engine)
    return gains, {name: np.asarray(value) for name, value in walks.items()}


def on_grid(scenario: mc.Scenario, *, engine: str = DEFAULT_ENGINE) -> dict[str, float] | None:
    """Return kp and kd with which pd has the least force variation of a grid and holds, None where it never does.

    Those that are too much for the time step, with which no walk alone would be begun, are left out.

    What a sweep, which looks for the same among the gains of a law, is to be compared with.
    """
    table = mc.MetricTable(mc.METRICS[name] for name in _JUDGED_BY)
    gains, walks = walked_on_grid(scenario, table, engine=engine)
    holds = (walks["detached_limb"] < 0) & ~walks["diverged"].astype(bool)
    variation = np.where(holds, walks["force_variation"], np.inf)
    for place in np.argsort(variation)[: np.isfinite(variation).sum()]:
        joint = {name: float(values[place]) for name, values in gains.items()}
        if short_enough(scenario.with_overrides({f"control.{name}": value for name, value in joint.items()})):
            return joint
    return None


def _kept_in(out: Path) -> Path:
    return Path(out) / finished_parts.FOLDER / NAME


def _settings(search: Search) -> Search:
    """Return the settings with the joint loop alone to move."""
    changed: dict[str, Any] = {
        "space": "isotropic", "inertia": False, "also": (), "joint_gains": True, "pins": {},
        "bounds": {name: span for name, span in search.bounds.items() if name in JOINT},
    }  # fmt: skip
    if search.method == OWN_METHOD:
        changed |= {"method": "gradient", "starts": None, "iterations": None}
    return search.model_copy(update=changed)


class Worth(NamedTuple):
    """What a force sensor changes: of gains found against pd retuned."""

    changes: dict[str, float]  # relative, of what the gains were found for: -0.1 is a tenth less
    in_words: str


def worth(
    values: Mapping[str, float],
    without: Mapping[str, float],
    gains: AnyGains,
    *,
    feasible: bool = True,
    larger: bool = False,
) -> Worth:
    """Return what a force sensor is worth.

    Arguments:
        values: first what the gains were found for, then what else is to be said of them.
        without: the same of pd retuned.
        gains: kp and kd of that.
        feasible: whether it keeps all limits.
        larger: whether more of the first value is better, not less.
    """
    joint = by_name(gains)
    rival = f"pd with kp {float(joint['kp']):.4g}, kd {float(joint['kd']):.4g}, which needs none"
    rival += "" if feasible else " (and breaks a limit)"
    changes = {name: values[name] / without[name] - 1 for name in values}
    if not all(map(math.isfinite, changes.values())):
        return Worth(changes, f"the force sensor: not to be compared with {rival}: a walk diverged")
    first = next(iter(changes.values()))
    verdict = "pays" if (first > 0 if larger else first < 0) else "does not pay"
    parts = [
        f"{100 * abs(change):.1f} % {'less' if change < 0 else 'more'} {name.replace('_', ' ')}"
        for name, change in changes.items()
    ]
    return Worth(changes, f"the force sensor {verdict}: {' and '.join(parts)} than {rival}")
