"""Pushes that walks bear: the table, the picture, the page and the JSON."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons.pushes import SHARES, borne, verdict
from tuning.numbers import to_json
from tuning.pages.contents import Picture
from tuning.pages.page import Findings, Page, Table

CAPTION = "Force on the base that half (dots) and 95 % (bars) of the walks survive, with intervals of 95 %."


def pushes_table(found: xr.Dataset) -> Table:
    """Return force and impulse that half and 95 % of the walks survive, by length, direction and walker."""
    sections = []
    for length in found["length"].values:
        rows = []
        for way in found["direction"].values:
            for name in found["walker"].values:
                own = found.sel(length=length, direction=way, walker=name)
                cells = [text for share in SHARES.values() for text in _cells(found, own, share, float(length))]
                rows.append([str(way) if name == found["walker"].values[0] else "", str(name), *cells])
        sections.append((f"pushes of {length:g} s", rows))
    columns = ["push", "gains", *(f"{name} survive, {unit}" for name in SHARES for unit in ("N", "N s"))]
    return Table("Largest pushes that walks survive, with intervals of 95 %", columns, sections)


def _cells(found: xr.Dataset, own: xr.Dataset, share: float, length: float) -> list[str]:
    """Return force and impulse with their intervals, in N and in N s."""
    each = borne(own, share)
    smallest, largest = found.attrs["smallest"], found.attrs["largest"]
    cells = []
    for factor in (1.0, length):
        if not 0 < each.value < np.inf:
            cells.append(f"> {factor * largest:.3g}" if each.value else f"< {factor * smallest:.3g}")
            continue
        low, high = (f"{factor * force:.3g}" if force < np.inf else "more" for force in each[1:])
        cells.append(f"{factor * each.value:.3g} ({low} to {high})")
    return cells


def summary(found: xr.Dataset) -> str:
    """Return JSON: forces in N and impulses in N s with intervals, null where no push tried bounds them."""

    def plain(value: float, factor: float) -> float | None:
        return factor * value if 0 < value < np.inf else None

    rows = []
    for length in found["length"].values.tolist():
        for way in found["direction"].values.tolist():
            for name in found["walker"].values.tolist():
                for share in SHARES.values():
                    each = borne(found.sel(length=length, direction=way, walker=name), share)
                    bound = {np.inf: "more than the largest", 0.0: "less than the smallest"}.get(each.value, "")
                    rows.append(
                        {"gains": name, "length": length, "direction": way, "survive": share, "outside": bound}
                        | {"force": [plain(value, 1.0) for value in each]}
                        | {"impulse": [plain(value, length) for value in each]}
                    )
    own = {"smallest": found.attrs["smallest"], "largest": found.attrs["largest"], "draws": found.sizes["draw"]}
    return to_json({**own, "pushes": rows, "verdict": verdict(found)}) + "\n"


def files(found: xr.Dataset) -> dict[str, Any]:
    """Return the table as JSON, each draw, and the picture."""
    return {"pushes.json": summary(found), "pushes.nc": found, "pushes": Picture(CAPTION, lambda: plot_pushes(found))}


def page_of(found: xr.Dataset, scenario: mc.Scenario) -> Page:
    """Return the page of pushes."""
    table = pushes_table(found)
    return Page("Pushes, {}", Findings(verdict(found)), scenario, tables=[table], opened=[table])


@plots.style()
def plot_pushes(found: xr.Dataset) -> Figure:
    """Draw the force that half and 95 % of the walks survive by direction, a panel for each length of a push."""
    colors = (plots.VERMILLION, "0.6", plots.BLUE, plots.GREEN, plots.PURPLE, plots.ORANGE)
    names, ways = found["walker"].values.tolist(), found["direction"].values.tolist()
    largest, smallest = found.attrs["largest"], found.attrs["smallest"]
    figure = Figure(figsize=(2 * plots.COLUMN, 2.8), layout="constrained")
    panels = figure.subplots(1, found.sizes["length"], squeeze=False, sharey=True)[0]
    for panel, length in zip(panels, found["length"].values.tolist(), strict=True):
        for number, name in enumerate(names):
            color, aside = colors[number % len(colors)], 0.7 * ((number + 0.5) / len(names) - 0.5)
            for place, way in enumerate(ways):
                own = found.sel(length=length, walker=name, direction=way)
                for share, marker, beside in zip(SHARES.values(), ("o", "_"), (-0.03, 0.03), strict=True):
                    each = np.clip(borne(own, share), smallest, largest)
                    at = place + aside + beside
                    panel.plot([at, at], each[1:], color=color, linewidth=0.8)
                    panel.plot(at, each[0], marker, color=color, ms=4 if marker == "o" else 7)
        panel.axhline(largest, color="0.5", linewidth=0.7, linestyle=":")
        panel.set(title=f"pushes of {length:g} s", yscale="log", xticks=range(len(ways)), xticklabels=ways)
        panel.yaxis.set_major_formatter("{x:g}")
    panels[0].set_ylabel("force [N]")
    handles = [key(name, color=colors[n % len(colors)]) for n, name in enumerate(names)]
    handles.append(key("largest tried", color="0.5", linewidth=0.7, linestyle=":"))
    plots.legend_below(figure, handles, len(handles))
    return figure
