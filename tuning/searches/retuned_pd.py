"""pd with joint gains of its own for the same goal: what can be had without a force sensor."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.dynamics import DEFAULT_ENGINE
from tuning.gains.gains_file import by_name
from tuning.problem.objectives import Judge
from tuning.problem.search import OWN_METHOD, Search
from tuning.problem.spaces import JOINT
from tuning.searches import tune
from tuning.searches.result import Result

NAME = "retuned_pd"  # in tables and files


def under_pd(scenario: mc.Scenario) -> mc.Scenario:
    """Return the scenario with pd in place of its law."""
    return scenario.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})


def search(
    found: Result,
    *,
    objective: Judge | None = None,
    numbers: mc.Parameters | None = None,
    engine: str = DEFAULT_ENGINE,
    out: Path | None = None,
    progress: Callable[[tune.Progress], None] | None = None,
) -> Result | None:
    """Search kp and kd of pd as a result was searched: goal, walks, method and rounds are the same.

    A method of the caller's own is replaced by the default one, in its own number of rounds.

    Arguments:
        found: the result that pd is to be compared with.
        objective, numbers: of its search, where they were not those of its settings and scenario.
        engine: the dynamics.
        out: a folder that keeps each finished round in a folder of its own, see `tuning.searches.tune.tune`.
        progress: called after each round.

    Returns:
        The search, or None where the result itself is one of pd.
    """
    if found.law is None and found.scenario.control.controller == "pd":
        return None
    how: dict[str, Any] = {"objective": objective, "numbers": numbers, "metrics": found.judged_by, "engine": engine}
    folder = None if out is None else kept_in(out)
    return tune.tune(under_pd(found.scenario), _settings(found.search), out=folder, progress=progress, **how)


def kept_in(out: Path) -> Path:
    """Return where the rounds of a search in `out` keep those of pd beside their own."""
    return Path(out) / "parts" / NAME


def _settings(search: Search) -> Search:
    """Return the settings with the joint loop alone to move."""
    changed: dict[str, Any] = {
        "space": "isotropic", "inertia": False, "also": (), "joint_gains": True, "pins": {},
        "bounds": {name: span for name, span in search.bounds.items() if name in JOINT},
    }  # fmt: skip
    if search.method == OWN_METHOD:
        changed |= {"method": "gradient", "starts": None, "iterations": None}
    return search.model_copy(update=changed)


def worth(values: Mapping[str, float], without: Mapping[str, float], joint: Any) -> str:
    """Return in a sentence what a force sensor is worth.

    Arguments:
        values: `objective` and `force_variation` of the gains found.
        without: the same of pd with the joint gains `joint`.
    """
    gained = {name: 100 * (1 - values[name] / without[name]) for name in ("objective", "force_variation")}
    of = by_name(joint)
    rival = f"pd with kp {float(of['kp']):.4g}, kd {float(of['kd']):.4g}, which needs none"
    parts = [f"{_by(gained[name])} {name.replace('_', ' ')}" for name in gained]
    verdict = "pays" if gained["objective"] > 0 else "does not pay"
    return f"the force sensor {verdict}: {' and '.join(parts)} than {rival}"


def _by(percent: float) -> str:
    return f"{abs(percent):.1f} % {'less' if percent > 0 else 'more'}"
