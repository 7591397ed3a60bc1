"""The data of the page's script, as plain values: walks over time, and the cells of a grid."""

import base64
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.viz import plots
from mjx_climb.walks import LINES, histories, stretches
from tuning.numbers import failed, gain, plain, plain_unit, presentable
from tuning.results.swept import MOST_CELLS, axes_of, coarser_grid, place_of

BASELINE = "pd"  # the walk that all others are compared with; disturbances and grip changes are its own
SCALES = {"m": (1e3, "mm"), "rad": (180 / np.pi, "deg")}  # how people read a line or a metric
# of the maps from worst to best, six hexadecimal digits each
COLORS = "".join(mpl.colors.to_hex(color)[1:] for color in mpl.colormaps["viridis"](np.linspace(0, 1, 64)))
_FAILED = ("detached_limb", "detached_at", "diverged")


def explorer(
    walks: Mapping[str, mc.Trajectory], metrics: Mapping[str, Mapping[str, Any]], *,
    shown: tuple[str, ...] | None = None, opens_on: str | None = None, points: Mapping[str, Any] | None = None,
    about: mc.MetricTable = mc.METRICS, scenario: mc.Scenario | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return one interactive part of a page: walks, `BASELINE` among them, and points to choose more of them from.

    At first the walks `shown` are drawn (all where None), and beside the points stand the numbers of the walk that it
    `opens_on` (those of the points' own beginning where None). The points are walks of a `scenario`, the baseline's
    where None, whose time step is one or more of the walks'.
    """
    first = walks[BASELINE]
    scenario = scenario or first.scenario
    count, steps = stretches(scenario.steps)
    lines, drawn = [], []
    for name, (unit, text, _) in LINES.items():
        factor, scaled = SCALES.get(unit, (1, unit))
        lines.append({"name": name, "label": text, "unit": scaled, "factor": factor})
    for name, walk in walks.items():
        about_walk = {
            "name": name,
            "shown": shown is None or name in shown,
            "metrics": plain(presentable(metrics[name], None)),
        }
        packed_lines = {line: packed(values) for line, values in histories(walk, scenario.steps).items()}
        drawn.append({**about_walk, "failed": _failure(metrics[name]), "lines": packed_lines})
    return {
        "baseline": BASELINE, "opens_on": opens_on,
        "metrics": {m.name: _about(m.long_name, m.unit, larger=m.larger_is_better) for m in about},
        "lines": lines,
        "time": {"count": count, "stretch": steps * scenario.time_step, "end": scenario.steps * scenario.time_step},
        "windows": [window[:3] for window in plots.disturbances(first)],
        "grips": plots.grip_changes(first).tolist(),
        "holding_limit": scenario.value("contact.holding_limit"),
        "walks": drawn,
        "points": points if points and (points["scales"] or not points["axes"]) else None,  # none without a number
    }  # fmt: skip


def grid_points(
    grid: xr.Dataset, histories: xr.Dataset, baseline: Mapping[str, Any], marks: Mapping[str, tuple[float, float]],
    chosen: xr.Dataset | None,
) -> dict[str, Any]:  # fmt: skip
    """Return the cells of a grid over two gains for `explorer`, which begins at the chosen one, else at the first.

    `histories` is a grid over the same values or some of them; the metrics of the baseline are for the colours.
    """
    axes = x, y = axes_of(grid)
    shown = coarser_grid(grid, chosen, MOST_CELLS)
    flat = shown.transpose(*axes, ...).stack(cell=axes, create_index=False)
    failed_cells = plots.failed_walks(shown, *axes)
    values_of = {name: _values(plots.comparable(flat, name)) for name in map(str, shown.data_vars) if name not in LINES}
    scales, texts = {}, {}
    for name in values_of:
        variable, larger = shown[name], dataset.larger_is_better(shown[name])
        if name not in mc.METRICS.names:
            label = variable.attrs.get("long_name", name.replace("_", " "))
            texts[name] = _about(label, variable.attrs.get("units", "1"), larger=larger)
        values = plots.comparable(shown, name).transpose(y, x).values.astype(float)
        if name not in ("detached_limb", "diverged") and np.isfinite(values).any():
            norm, _ = plots.color_scale(values, failed_cells, baseline.get(name), larger)  # as on the pictures
            logarithmic = isinstance(norm, mpl.colors.LogNorm)
            scales[name] = {"low": float(norm.vmin or 0.0), "high": float(norm.vmax or 0.0), "log": logarithmic}
    failures = zip(*(values_of[name] for name in _FAILED), strict=True)
    with_history = [np.isin(shown[name].values, histories[name].values) for name in axes]
    held = histories.sel({name: shown[name].values[has] for name, has in zip(axes, with_history, strict=True)})
    drawn = []
    for name in axes:
        label, units = grid[name].attrs.get("long_name", name), grid[name].attrs["units"].split(",")
        drawn.append({"name": name, "label": label, "unit": units[0], "values": _values(shown[name])})
    begin = dict.fromkeys(axes, 0) if chosen is None else place_of(shown, chosen)
    return {
        "count": flat.sizes["cell"], "left_out": grid["diverged"].size - flat.sizes["cell"],
        "axes": drawn,
        "gains": {name: _values(flat[name]) for name in axes},
        "values": values_of, "texts": texts, "scales": scales,
        "failed": [_failure(dict(zip(_FAILED, each, strict=True))) for each in failures],
        "marks": [{"name": name, "at": list(at)} for name, at in marks.items()],
        "limit": [line.tolist() for line in plots.stability_lines(grid, *axes)],
        "begin": begin[x] * shown.sizes[y] + begin[y],
        "stored": np.flatnonzero(np.logical_and.outer(*with_history)).tolist(),
        "histories": {name: packed(held[name].transpose(*axes, "extreme", "stretch").values) for name in LINES},
        "colors": COLORS,
    }  # fmt: skip


def listed_points(
    walks: xr.Dataset, histories: Mapping[str, np.ndarray], chosen: int, trade: tuple[str, str],
    about: mc.MetricTable = mc.METRICS,
) -> dict[str, Any]:  # fmt: skip
    """Return walks that form no grid, along the dimension `front`, for `explorer`, which begins at the chosen one.

    The two metrics of `trade` are drawn against each other.
    """
    count, gains = walks.sizes["front"], walks.attrs["searched"].split()
    return {
        "count": count, "left_out": 0, "axes": None, "trade": list(trade),
        "gains": {name: [gain({name: held}, name) for held in walks[name].values] for name in gains},
        # nothing lets go on a front
        "values": {name: _values(walks[name]) for name in about.names} | {"detached_limb": [None] * count},
        "texts": {}, "scales": {}, "failed": [None] * count, "marks": [], "begin": chosen, "stored": list(range(count)),
        "histories": {name: packed(histories[name]) for name in LINES}, "colors": COLORS,
    }  # fmt: skip


def packed(values: np.ndarray) -> str:
    """Return numbers as little-endian float32 in base64, exact as a batch walked them."""
    with np.errstate(over="ignore"):  # a walk that diverges
        return base64.b64encode(np.asarray(values).astype("<f4").tobytes()).decode()


def _about(label: str, unit: str, *, larger: bool) -> dict[str, Any]:
    return {"label": label, "unit": plain_unit(unit), "larger_is_better": larger}


def _values(variable: xr.DataArray) -> list[Any]:
    """Return values as JSON has them, with the digits that their precision holds; limbs by name."""
    values = variable.values
    if "flag_meanings" in variable.attrs:
        names = [None, *variable.attrs["flag_meanings"].split()[1:]]
        return [names[int(value) + 1] for value in values]
    if values.dtype.kind == "b" or variable.name in ("diverged", "feasible"):
        return list(values.astype(bool).tolist())
    digits = 7 if values.dtype == np.float32 else 10
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values.astype(float)]


def _failure(metrics: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the failure of a walk and its time (s), None where there was none."""
    text = failed(metrics, "torn off", "diverged")
    return {"text": text, "at": metrics["detached_at"]} if text else None
