"""The result of a sweep: the metrics of walks over a grid of two gains."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from mjx_climb.files.dataset import larger_is_better
from mjx_climb.walk.metrics import failed
from tuning.results.result import Result

if TYPE_CHECKING:
    import xarray as xr  # walks do not wait for it

HISTORIES = 256  # walks up to which a grid keeps time histories
MOST_CELLS = 10_000  # on a page; of a larger grid it shows a coarser one


@dataclasses.dataclass(frozen=True)
class Swept(Result):
    """A grid of walks over two gains; `gains` are those in place of the scenario's or the law's own, where given.

    `data` holds the metrics over both gains. A grid of up to `HISTORIES` walks keeps time histories as well: for each
    name in `mjx_climb.walks.LINES` the least and the largest value in each stretch of time, over both
    gains, extreme and stretch.
    """

    FILE = "sweep.nc"
    KIND = "sweep"

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of both gains, that of the horizontal axis first."""
        return tuple(str(name) for name in self.data["diverged"].dims)


def holding(data: "xr.Dataset", metric: str) -> "xr.DataArray":
    """Return a metric of those walks that do not fail, NaN elsewhere."""
    return data[metric].where(~failed(data))


def best_cell(data: "xr.Dataset", metric: str = "force_variation") -> "xr.Dataset | None":
    """Return the cell with the least `metric` among those that neither let go nor diverge, None where all fail.

    Its coordinates are the best gains. Margins and other metrics that should be large are maximised.
    """
    values = holding(data, metric)
    if larger_is_better(data[metric]):
        values = -values
    return data.isel(values.argmin(dim=...)) if np.isfinite(values).any() else None


def axes_of(grid: "xr.Dataset") -> tuple[str, str]:
    """Return the names of the two gains of a grid, the horizontal one first."""
    x, y = map(str, grid["diverged"].dims)
    return x, y


def place_of(grid: "xr.Dataset", cell: "xr.Dataset") -> dict[str, int]:
    """Return the indices of a cell along the axes of a grid."""
    return {name: int(np.argmin(abs(grid[name].values - cell[name].item()))) for name in axes_of(grid)}


def coarser_grid(grid: "xr.Dataset", chosen: "xr.Dataset | None", most: int) -> "xr.Dataset":
    """Return a grid with at most about `most` of its cells, evenly, the chosen one among them."""
    places = {} if chosen is None else place_of(grid, chosen)
    rows = {name: np.arange(grid.sizes[name]) for name in axes_of(grid)}
    while np.prod([len(index) for index in rows.values()]) > most:
        longest = max(rows, key=lambda name: len(rows[name]))
        fewer = max(1, int(0.95 * len(rows[longest])))
        index = np.linspace(0, grid.sizes[longest] - 1, fewer).round().astype(int)
        if longest in places:  # the nearest gives way
            index[np.argmin(abs(index - places[longest]))] = places[longest]
        rows[longest] = np.unique(index)
    return grid.isel(rows)
