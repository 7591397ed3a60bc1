"""The result of a search for gains: every point that was evaluated, and the best."""

import dataclasses
import functools
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.inputs.gait_values import scenario_with_gait
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.inputs.time_step import short_enough
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.gains_file import by_name
from tuning.gains.own_section import check_reference, reference
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Judge, Search
from tuning.problem.spaces import INTEGRAL, JOINT, as_gains, to_gains64
from tuning.results.result import Result

AGREEMENT = "agreement_of_seeds"  # in words
CHECKED = "check"  # the phase in which the best points walk through a draw of their own
ENDS = "ends_of_seeds"  # objective of each search, where it is the best of several


@dataclasses.dataclass(frozen=True)
class Tuned(Result):
    """The gains that a search found.

    `data` holds every point that was evaluated, in order: dimensions `point` and `coordinate` (names of the space);
    variables `theta` (the natural logarithm of a gain, or the gain by its `unit`), `value`, `descent`, `penalty`,
    `feasible`, `gradient_norm`, `round`, `row` (place in its batch), `phase`, `env_steps` (spent so far) and the
    metrics.
    """

    FILE = "search.nc"
    KIND = "tune"

    search: Search = dataclasses.field(default_factory=Search)
    gains: AnyGains = dataclasses.field(default_factory=dict)  # the best found: `mc.Gains`, or by name for other laws

    @functools.cached_property
    def best(self) -> int:
        """The index of the best point."""
        return best_of({name: self.data[name].values for name in ("value", "penalty", "feasible", "phase")})

    @property
    def method(self) -> str:
        """The name of the method, of the user's own that of its class or function."""
        own = getattr(self.problem.own_method, "function", self.problem.own_method)
        return self.search.method if own is None else getattr(own, "__name__", type(own).__name__)

    @property
    def theta(self) -> np.ndarray:
        """The best point (n,)."""
        return np.asarray(self.data["theta"].values[self.best])

    @property
    def value(self) -> float:
        """The objective of the best point."""
        return float(self.data["value"][self.best])

    @property
    def of_pd(self) -> float:
        """The objective of pd: 1 where no function of the user's own is minimised."""
        return float(getattr(self.problem.objective, "reference", 1.0))

    @property
    def feasible(self) -> bool:
        """Whether the best point keeps every limit."""
        return bool(self.data["feasible"][self.best])

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics of the best point, as the search saw it: nothing torn off."""
        return {name: float(self.data[name][self.best]) for name in self.problem.metrics.names if name in self.data}

    @property
    def env_steps(self) -> int:
        """The cost of the search; a forward-mode step with n tangents counts 1 + n."""
        return int(self.data["env_steps"][-1])

    @property
    def best_at(self) -> int:
        """Environment steps spent when the best was found."""
        return int(self.data["env_steps"][self.best])

    @property
    def interrupted(self) -> bool:
        """Whether the user ended the search."""
        return bool(self.data.attrs["interrupted"])

    @property
    def ends(self) -> list[float]:
        """The objective at which the search of each seed ended, infinite where it breaks a limit."""
        return [float(end) for end in np.ravel(self.data.attrs.get(ENDS, self.value))]

    @property
    def seeds(self) -> int:
        """From how many seeds it was searched."""
        return int(self.data.attrs.get("seeds", len(self.ends)))  # an earlier file has their number alone

    @property
    def converged(self) -> bool:
        """Whether a search that was to converge did; true of others."""
        return bool(self.data.attrs.get("converged", True))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the data as netCDF, from which `load` makes the result again, and return its path."""
        return dataset.save(self.data, path)

    def comment(self, name: str) -> str:
        how = f"{self.method}, {self.search.space}"
        return f"mjx-climb tune {name}: {how}, objective {self.value:.4f} (pd: {self.of_pd:.4g})"


@dataclasses.dataclass(frozen=True)
class Robust(Tuned):
    """The gains that a search over an ensemble found."""

    KIND = "robust"

    ensemble: Ensemble = dataclasses.field(default_factory=Ensemble)
    judges: int = Judge().members  # walks of each set of gains in the fresh draw that tests the result

    def comment(self, name: str) -> str:
        how = f"{self.method}, {self.search.space}, {self.ensemble.members} members"
        return f"mjx-climb tune {name} --ensemble: {how}, objective {self.value:.4f} (pd: {self.of_pd:.4g})"


def from_rounds(problem: Problem, search: Search, arrays: Mapping[str, np.ndarray], *, interrupted: bool) -> Tuned:
    """Return the result of the points evaluated so far.

    The best is the feasible point of the least value, of those in the phase `CHECKED` where there is one; where none is
    feasible, the one of the least value plus penalty.
    Joint gains shake at a long time step, under some gaits sooner than under others. A search may see little of it in
    one walk, but nobody can walk with them: a point that would be the best, were its time step short enough, is
    infeasible and has a penalty without end.

    Raises:
        ValueError: nothing was evaluated.
    """
    if not arrays or not len(arrays["value"]):
        raise ValueError("expected a point that was evaluated, got none")
    metrics, scenario, space = problem.metrics, problem.scenario, problem.space
    arrays = {**arrays, "penalty": np.array(arrays["penalty"], float), "feasible": np.array(arrays["feasible"])}
    while True:
        best = best_of(arrays)
        gains = to_gains64(space, np.asarray(arrays["theta"][best], float))
        joint = {
            f"control.{name}": float(value) for name, value in by_name(gains).items() if name in (*JOINT, INTEGRAL)
        }
        walked = scenario_with_gait(scenario.with_overrides(joint), by_name(gains))
        if walked is scenario or short_enough(walked) or not np.isfinite(arrays["penalty"][best]):
            break
        arrays["penalty"][best], arrays["feasible"][best] = np.inf, False
    data: dict[str, Any] = {}
    for name, values in arrays.items():
        about = {"units": "1", "long_name": name.replace("_", " ")}
        data[name] = ("point", values, dataset.metric_attributes(metrics[name]) if name in metrics.names else about)
    data["theta"] = (("point", "coordinate"), arrays["theta"], {"units": "1", "long_name": "coordinates of gains"})
    data["unit"] = ("coordinate", space.units, {"long_name": "gain at 1; 0: theta is its natural logarithm"})
    attrs: dict[str, Any] = {"title": "search for gains", **dataset.provenance(scenario), "search": search.to_yaml()}
    attrs |= {"interrupted": int(interrupted), "gains": dataset.fields_as_json(by_name(gains))}
    if problem.law is not None:
        attrs["law"] = reference(problem.law)
    coordinates = {"coordinate": list(space.names), "point": np.arange(len(arrays["value"]))}
    made = xr.Dataset(data, coordinates, attrs)
    if problem.ensemble is None:
        return Tuned(made, problem, search, gains=gains)
    return Robust(made, problem, search, problem.ensemble, gains)


def of_seeds(searches: Sequence[Tuned]) -> Tuned:
    """Return the best of searches that differ in their seed, with how far they agree as the attribute `AGREEMENT`.

    Its settings are those of the first, which repeat them all.
    """
    ranked = {name: [own.data[name].values[own.best] for own in searches] for name in ("value", "penalty", "feasible")}
    best, asked = searches[best_of(ranked)], searches[0].search
    values, theta = [own.value for own in searches], np.stack([own.theta for own in searches])
    logarithms = best.data["unit"].values == 0
    said = f"{len(searches)} seeds end at objectives of {min(values):.4f} to {max(values):.4f}"
    said += f", the best is of seed {best.search.seed}"
    if logarithms.any():
        apart = np.exp(np.ptp(theta[:, logarithms], axis=0))
        name = best.data["coordinate"].values[logarithms][apart.argmax()]
        said += f", their gains at most a factor of {apart.max():.3g} apart ({name})"
    if outside := sum(not own.feasible for own in searches):
        said += f"; {outside} of them break a limit"
    attrs = {
        AGREEMENT: said,
        ENDS: [own.value if own.feasible else np.inf for own in searches],
        "search": asked.to_yaml(),
    }
    data = best.data.assign_attrs(attrs, interrupted=int(searches[-1].interrupted))
    return dataclasses.replace(best, data=data, search=asked)


def best_of(arrays: Mapping[str, ArrayLike]) -> int:
    """Return the index of the best point: of those that were checked on walks of their own, where some were."""
    checked = np.asarray(arrays.get("phase", "")) == CHECKED
    if checked.any():
        places = np.flatnonzero(checked)
        return int(
            places[best_of({name: np.asarray(each)[places] for name, each in arrays.items() if name != "phase"})]
        )
    value, penalty, feasible = (np.asarray(arrays[name]) for name in ("value", "penalty", "feasible"))
    ranked = np.where(feasible, value, np.inf) if feasible.any() else value + penalty
    return int(np.argmin(np.where(np.isfinite(ranked), ranked, np.inf)))


def load(path: str | os.PathLike[str], law: mc.Law | None = None, metrics: Iterable[mc.Metric] = mc.METRICS) -> Tuned:
    """Read the result that `Tuned.save` wrote; its scenario, law, metrics and settings repeat the search.

    Arguments:
        path: the file.
        law: the one whose gains were searched, where it was not the scenario's.
        metrics: those of its walks.

    Raises:
        ConfigError: no such file, or another one, or a search of another law.
    """
    data, source = dataset.load(path), os.fspath(path)
    if "search" not in data.attrs or "interrupted" not in data.attrs:
        raise ConfigError(source, "", "the result of a search", "another dataset")
    check_reference(law, data.attrs.get("law"), source)
    gains = as_gains({name: np.asarray(v) for name, v in json.loads(data.attrs["gains"]).items() if v is not None})
    problem = Problem(dataset.scenario_of(data), law=law, metrics=mc.MetricTable(metrics))
    return Tuned(data, problem, Search.parse(data.attrs["search"], source), gains=gains)
