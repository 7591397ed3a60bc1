"""pd with joint gains of its own for the same goal: what can be had without a force sensor."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tuning.gains.gains_file import by_name
from tuning.problem import spaces
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.spaces import JOINT
from tuning.searches import finished_parts, tune
from tuning.searches.result import Result

NAME = "retuned_pd"  # in tables and files


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

    objective: float  # relative: -0.1 is a tenth less
    force_variation: float
    in_words: str


def worth(values: Mapping[str, float], without: Mapping[str, float], retuned: Result) -> Worth:
    """Return what a force sensor is worth.

    Arguments:
        values: `objective` and `force_variation` of the gains found.
        without: the same of pd with the joint gains of `retuned`.
        retuned: the search of these.
    """
    joint = by_name(retuned.gains)
    rival = f"pd with kp {float(joint['kp']):.4g}, kd {float(joint['kd']):.4g}, which needs none"
    rival += "" if retuned.feasible else " (and breaks a limit)"
    changes = {name: values[name] / without[name] - 1 for name in ("objective", "force_variation")}
    if not all(map(math.isfinite, changes.values())):
        return Worth(**changes, in_words=f"the force sensor: not to be compared with {rival}: a walk diverged")
    verdict = "pays" if changes["objective"] < 0 else "does not pay"
    parts = [
        f"{100 * abs(change):.1f} % {'less' if change < 0 else 'more'} {name.replace('_', ' ')}"
        for name, change in changes.items()
    ]
    return Worth(**changes, in_words=f"the force sensor {verdict}: {' and '.join(parts)} than {rival}")
