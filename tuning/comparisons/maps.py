"""Maps: the scores of walks over a grid of two gains, and where the closed loop is unstable."""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from tuning.comparisons import stability_limit
from tuning.problem import objectives
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.searches.tune import problem_of


def with_objective(walks: xr.Dataset, scenario: mc.Scenario, search: Search | None = None, **how: Any) -> xr.Dataset:
    """Add the score of each cell in a search: `objective`, 1 for pd, and `feasible`, keeps every limit.

    Arguments:
        walks: metrics over two gains, as `tuning.sweep` gives them.
        search: weights and limits; the default ones where None.
        how: law, engine and metrics of the walks, as of `tuning.tune`.
    """
    return judged_by(walks, problem_of(scenario, search or Search(), **how))


def judged_by(walks: xr.Dataset, problem: Problem) -> xr.Dataset:
    """Add the score of each cell by a problem's objective, as `with_objective` does."""
    dimensions = walks["diverged"].dims
    walks = walks.transpose(*dimensions, ...)
    score = score_of(problem.objective, {name: walks[name].values for name in problem.metrics.names})
    value = np.where(np.isfinite(score.value), score.value, np.nan)
    return walks.assign(
        objective=(dimensions, value, {"units": "1", "long_name": "objective, 1 for pd"}),
        feasible=(dimensions, score.feasible, {"units": "1", "long_name": "keeps every limit"}),
    )


def with_stability(
    walks: xr.Dataset, scenario: mc.Scenario, *, law: mc.Law | None = None, engine: str = DEFAULT_ENGINE
) -> xr.Dataset:
    """Add `spectral_radius`, the largest eigenvalue of one step: above 1 a small disturbance grows.

    Pictures of such a map show its limit, see `mjx_climb.viz.plots.plot_map`.
    """
    axes = {str(name): walks[name].values for name in walks["diverged"].dims}
    radius = stability_limit.over_axes(scenario, axes, law=law, engine=engine)
    return walks.assign(spectral_radius=stability_limit.on_map(radius, walks))


def best_cell(judged: xr.Dataset, metric: str = "objective") -> xr.Dataset | None:
    """Return the cell of the least `metric` among the feasible ones, None where there are none."""
    values = judged[metric].where(judged["feasible"])
    return judged.isel(values.argmin(dim=...)) if np.isfinite(values).any() else None


def score_of(objective: objectives.Goal, metrics: Mapping[str, Any]) -> objectives.Score:
    """Judge metrics of a rollout, None or NaN where undefined; a walk that let go is infeasible."""
    arrays: dict[str, Any] = {
        name: np.asarray(np.nan if value is None else value)
        for name, value in metrics.items()
        if not isinstance(value, str) and name != "detached_limb"
    }
    arrays["diverged"] = arrays["diverged"].astype(bool)
    with jax.enable_x64(True), devices.on_host():
        score = _score(objective, arrays)
    held = ~np.isfinite(arrays["detached_at"].astype(float))
    value, descent, penalty, feasible = (np.asarray(part) for part in score)
    return objectives.Score(value, descent, penalty, feasible & held)


@functools.partial(jax.jit, static_argnums=0)
def _score(objective: objectives.Goal, metrics: Mapping[str, jax.Array]) -> objectives.Score:
    return objective.score(metrics)
