"""The result of a search, the same for every method: the gains, how they were found, and what made them."""

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.checks.time_step import short_enough
from mjx_climb.files import dataset
from mjx_climb.rollouts.given import AnyGains, has_gains_of_the_paper, with_gains
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import by_name
from tuning.gains.law_file import check_reference, reference
from tuning.problem import search as search_settings
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.problem.spaces import to_gains64


@dataclasses.dataclass(frozen=True)
class Result:
    """What a search found.

    `history` holds every point that was judged, in order: dimensions `point` and `coordinate` (names of the space);
    variables `theta` (natural logarithm), `value`, `descent`, `penalty`, `feasible`, `gradient_norm`, `round`, `row`
    (place in its batch), `phase`, `env_steps` (spent so far) and the metrics.
    """

    scenario: mc.Scenario
    search: Search
    gains: AnyGains  # the best found, in float64: `mc.Gains`, or by name where the law has others than the paper's
    theta: np.ndarray  # (n,)
    value: float  # 1 for pd
    feasible: bool
    metrics: dict[str, float]  # of the best, as the search saw it: nothing torn off
    env_steps: int  # a forward-mode step with n tangents counts 1 + n
    best_at: int  # env-steps spent when the best was found
    interrupted: bool
    history: xr.Dataset
    judged_by: mc.MetricTable = mc.METRICS
    law: mc.Law | None = None  # with the gains found, where another than the scenario's was searched

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the whole result as netCDF and return its path."""
        return dataset.save(self.history, path)


def from_history(problem: Problem, search: Search, arrays: Mapping[str, np.ndarray], *, interrupted: bool) -> Result:
    """Return the result of the points judged so far.

    The best is the feasible point of the least value; where none is feasible, the one of the least value plus penalty.
    A point whose joint gains are too much for the time step is neither, and has a penalty without end.

    Raises:
        ValueError: nothing was judged.
    """
    if not arrays or not len(arrays["value"]):
        raise ValueError("expected a judged point, got none")
    scenario, space, law, metrics = problem.scenario, problem.space, problem.law, problem.metrics
    count = len(arrays["value"])
    arrays = _without_the_unsteady(problem, arrays)
    best = best_of(arrays)
    data: dict[str, Any] = {
        "theta": (("point", "coordinate"), arrays["theta"], {"units": "1", "long_name": "log of the gains"})
    }
    for name, values in arrays.items():
        if name == "theta":
            continue
        about = {"units": "1", "long_name": name.replace("_", " ")}
        data[name] = (
            "point",
            values,
            dataset.metric_attributes(metrics[name]) if name in metrics.names else about,
        )
    attrs: dict[str, Any] = {"title": "search for gains", **dataset.provenance(scenario), "search": search.to_yaml()}
    attrs["interrupted"] = int(interrupted)
    history = xr.Dataset(data, {"coordinate": list(space.names), "point": np.arange(count)}, attrs)
    theta = np.asarray(arrays["theta"][best], float)
    gains = to_gains64(space, theta)
    history.attrs["gains"] = dataset.fields_as_json(by_name(gains))
    if law is not None:
        history.attrs["law"] = reference(law)
    return _of(history, scenario, search, gains, best, law, metrics)


def _without_the_unsteady(problem: Problem, arrays: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
    """Return the arrays with a penalty for each point that would be the best, were its time step short enough.

    Joint gains shake at a long time step. A search may see little of it in one walk, but nobody can walk with them.
    """
    penalty, feasible = np.array(arrays["penalty"], float), np.array(arrays["feasible"])
    judged = {**arrays, "penalty": penalty, "feasible": feasible}
    while np.isfinite(penalty[best := best_of(judged)]):
        gains = by_name(to_gains64(problem.space, np.asarray(arrays["theta"][best], float)))
        joint = {f"control.{name}": float(gains[name]) for name in ("kp", "kd") if gains.get(name) is not None}
        if not joint or short_enough(problem.scenario.with_overrides(joint)):
            break
        penalty[best], feasible[best] = np.inf, False
    return judged


def best_of(arrays: Mapping[str, np.ndarray]) -> int:
    """Return the index of the best point."""
    value, penalty, feasible = (np.asarray(arrays[name]) for name in ("value", "penalty", "feasible"))
    ranked = np.where(feasible, value, np.inf) if feasible.any() else value + penalty
    ranked = np.where(np.isfinite(ranked), ranked, np.inf)
    return int(np.argmin(ranked))


def _of(
    history: xr.Dataset,
    scenario: mc.Scenario,
    search: Search,
    gains: AnyGains,
    best: int,
    law: mc.Law | None,
    metrics: mc.MetricTable,
) -> Result:
    names = [name for name in metrics.names if name in history]
    return Result(
        scenario=scenario,
        search=search,
        gains=gains,
        theta=history["theta"].values[best],
        value=float(history["value"][best]),
        feasible=bool(history["feasible"][best]),
        metrics={name: float(history[name][best]) for name in names},
        env_steps=int(history["env_steps"][-1]),
        best_at=int(history["env_steps"][best]),
        interrupted=bool(history.attrs["interrupted"]),
        history=history,
        judged_by=metrics,
        law=None if law is None else with_gains(law, gains),
    )


def load(path: str | os.PathLike[str], law: mc.Law | None = None, metrics: Iterable[mc.Metric] = mc.METRICS) -> Result:
    """Read the result that `Result.save` wrote; its scenario, law, metrics and settings repeat the search.

    Arguments:
        path: the file.
        law: the one whose gains were searched, where it was not the scenario's.
        metrics: those that its walks were judged by.

    Raises:
        ConfigError: no such file, or another one, or a search of another law.
    """
    history = dataset.load(path)
    if "search" not in history.attrs:
        raise ConfigError(f"{os.fspath(path)}: expected the result of a search, got another dataset")
    gains = {name: np.asarray(v) for name, v in json.loads(history.attrs["gains"]).items() if v is not None}
    check_reference(law, history.attrs.get("law"), os.fspath(path))
    of_the_paper = law is None or has_gains_of_the_paper(law)
    arrays = {name: history[name].values for name in ("value", "penalty", "feasible")}
    settings = search_settings.parse(history.attrs["search"], os.fspath(path))
    return _of(
        history,
        dataset.scenario_of(history),
        settings,
        mc.Gains(**gains) if of_the_paper else gains,
        best_of(arrays),
        law,
        mc.MetricTable(metrics),
    )
