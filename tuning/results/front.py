"""The result of a search for a Pareto front: the points on it, and its knee."""

import dataclasses
import functools

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.resolve import AnyGains
from tuning.problem.search import Pareto, Search
from tuning.problem.spaces import as_gains
from tuning.results.result import Result


@dataclasses.dataclass(frozen=True)
class Front(Result):
    """A Pareto front of two metrics; `gains` are those at its knee.

    `data` holds along `point` both metrics of all that was walked in the search, nothing torn off. Along `front` the
    gains on the front (those of six axes along `six`, of three along `three`) and all their metrics, in float64 with
    grippers that tear off. Along `reference` the metrics of the law's own gains (`config`) and of `pd`, likewise. Along
    `without` the front of what needs no force sensor (`without_law`): pd on a grid of kp and kd, and load transfer by
    plan on those of pd's front (`without_kp`, `without_kd`, and both metrics).
    """

    FILE = "front.nc"
    KIND = "pareto"

    search: Search = dataclasses.field(default_factory=Search)
    asked: Pareto = dataclasses.field(default_factory=Pareto)

    @functools.cached_property
    def knee(self) -> int:
        """The index of the point where the front bends, the furthest from the line between its ends."""
        return knee(self.data[self.asked.against].values, self.data[self.asked.better].values)

    @functools.cached_property
    def rival(self) -> xr.Dataset | None:
        """The point without a force sensor that costs no more than the knee, None where all cost more."""
        return without_sensor(self.data, self.knee, self.problem.metrics)

    def comment(self, name: str) -> str:
        """Return the two metrics of the trade."""
        return f"mjx-climb tune {name}: {self.asked.better} against {self.asked.against}, the knee of the front"


def knee(x: np.ndarray, y: np.ndarray) -> int:
    """Return the index of the point of a front that lies furthest from the line between its ends."""
    if len(x) < 3:
        return 0
    across, down = (x - x[0]) / (x[-1] - x[0]), (y - y[-1]) / (y[0] - y[-1])
    return int(np.argmin(across + down))


def gains_of(front: xr.Dataset, index: int) -> AnyGains:
    """Return the gains of one point of the front."""
    row = front.isel(front=index)
    return as_gains({name: row[name].values for name in front.attrs["gains"].split()})


def without_sensor(front: xr.Dataset, index: int, about: mc.MetricTable = mc.METRICS) -> xr.Dataset | None:
    """Return the point without a force sensor that costs no more than one of the front, None where all cost more."""
    against, better = front.attrs["against"], front.attrs["better"]
    cost = sign(about[against]) * front[f"without_{against}"].values
    within = np.flatnonzero(cost <= sign(about[against]) * front[against].values[index])
    if not within.size:
        return None
    values = sign(about[better]) * front[f"without_{better}"].values[within]
    return front.isel(without=int(within[values.argmin()]))


def sign(metric: mc.Metric) -> float:
    """Return the factor that makes a smaller value of a metric the better one."""
    return -1.0 if metric.larger_is_better else 1.0
