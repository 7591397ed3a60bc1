"""A Pareto front: table, picture, page with the walks along it."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.viz import plots
from tuning.comparisons.of_front import FrontComparison
from tuning.comparisons.of_front import compare as compare
from tuning.comparisons.worth import law_without
from tuning.numbers import gain, number, unit
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.explorer import explorer, listed_points
from tuning.pages.page import Findings, Page, Table
from tuning.pages.pictures import COLORS, scaled
from tuning.results.front import Front, knee

FRONT = "The front, and all that was walked on the way."


def contents(found: Front, compared: FrontComparison, name: str) -> Contents:
    """Return the front with its gains, a picture, the knee, and the page with the walks along the front."""
    data, asked = found.data, found.asked
    names, metrics = data.attrs["gains"].split(), (asked.against, asked.better)

    def rows(columns: tuple[str, ...], along: str, prefix: str = "") -> list[dict[str, Any]]:
        return [{n: data[f"{prefix}{n}"].values[i] for n in columns} for i in range(data.sizes[along])]

    config, pd = ({n: data[f"reference_{n}"].sel(reference=name).item() for n in metrics} for name in ("config", "pd"))
    law = ("law",) if "without_law" in data else ()  # older files have none
    summary = {
        "front": rows((*metrics, *names), "front"), "knee": found.knee, "config": config, "pd": pd,
        "without_force_sensor": rows((*law, "kp", "kd", *metrics), "without", "without_"),
        "force_sensor": {"in_words": compared.worth},
    }  # fmt: skip
    page, picture = page_of(found, compared), Picture(FRONT, lambda: plot_front(data))
    again = "mjx-climb tune config.yaml --search search.yaml "
    again += f"--better {asked.better} --against {asked.against} --points {asked.points} --out again"
    return contents_of(found, name, page, summary, {"front": picture}, again=again, walks=compared.walks, data=data)


def page_of(found: Front, compared: FrontComparison) -> Page:
    """Return the page of a front, with the time histories on it, and config and pd walked in double precision."""
    about, better, against = found.problem.metrics, found.asked.better, found.asked.against
    points = listed_points(found.data, compared.histories, found.knee, trade=(against, better), about=about)
    front = explorer(compared.walks, compared.metrics, shown=("pd",), points=points, about=about)
    return Page(
        f"What {about.in_words(better)} costs in {about.in_words(against)}: {{}}",
        Findings(compared.verdict, [compared.worth]), found.scenario,
        tables=[front_table(found.data, found.knee, found.asked.points, found.rival, about)],
        explorers={"The front": front},
        facts={"precision": "float32 (search), float64 (front)", "seed": found.search.seed},
    )  # fmt: skip


def front_table(
    front: xr.Dataset, knee: int, points: int, rival: xr.Dataset | None, about: mc.MetricTable = mc.METRICS
) -> Table:
    """Return so many points of a front, the knee among them, with config, pd and a rival without a sensor below."""
    traded, names = (front.attrs["against"], front.attrs["better"]), front.attrs["searched"].split()
    columns = ["", *(f"{about.in_words(name)} {unit(name, about)}".strip() for name in traded), *names]
    count = front.sizes["front"]

    def row(words: str, values: xr.Dataset, kind: str = "") -> list[str]:
        limb, diverged = (values.get(f"{kind}{name}") for name in ("detached_limb", "diverged"))
        lost = limb is not None and diverged is not None and (limb.item() >= 0 or bool(diverged.item()))
        return [words, *("failed" if lost else number(values[f"{kind}{name}"].item()) for name in traded)]

    on, places = [], np.linspace(0, count - 1, min(count, points)).round().astype(int)
    if knee not in places:
        places[abs(places - knee).argmin()] = knee
    for i in places.tolist():
        point = front.isel(front=i)
        gains = (gain({name: point[name].values}, name) for name in names)
        on.append([*row("knee" if i == knee else "", point), *gains])
    below = [row(name, front.sel(reference=name), "reference_") for name in ("config", "pd")]
    if rival is not None:
        joint = ", ".join(f"{name} {number(rival[f'without_{name}'].item())}" for name in ("kp", "kd"))
        below.append(row(f"{law_without(rival)}, {joint}", rival, "without_"))
    caption = f"The front: {len(on)} of its {count} points, all of them in front.nc"
    return Table(caption, columns, [("", on), ("", [[*cells, *("" for _ in names)] for cells in below])], 1)


@plots.style()
def plot_front(front: xr.Dataset) -> Figure:
    """Draw a Pareto front, all that was walked, its knee, the config's gains, pd, and the front without a sensor."""
    metrics = front.attrs["against"], front.attrs["better"]
    (x_factor, x_label), (y_factor, y_label) = (scaled(front[name]) for name in metrics)

    def places(kind: str = "") -> np.ndarray:
        """Return the points (N, 2) of a kind as they are drawn."""
        return np.transpose([front[f"{kind}{name}"].values for name in metrics]) * [x_factor, y_factor]

    on, references = places(), places("reference_")
    figure = Figure(figsize=(plots.COLUMN, 2.7), layout="constrained")
    panel = figure.subplots()
    walked = places("walked_")[front["held"].values.astype(bool)]
    panel.plot(*walked.T, ".", color="0.75", ms=2.5, label="walked", zorder=1)
    panel.plot(*on.T, "-o", color=plots.BLUE, ms=2.5, label="front")
    panel.plot(*places("without_").T, "--.", color=plots.BLACK, ms=3, lw=0.8, label="no force sensor")
    bend = on[knee(*(front[name].values for name in metrics))]
    panel.plot(*bend, "*", color=plots.ORANGE, ms=9, mec="black", mew=0.5, ls="", label="knee")
    named = dict(zip(front["reference"].values.tolist(), references, strict=True))
    for name, marker in (("config", "D"), ("pd", "s")):
        panel.plot(*named[name], marker, color=COLORS[name], mec="black", mew=0.5, ms=5, ls="", label=name)
    shown = np.concatenate([on, references, places("without_")])
    shown = shown[np.isfinite(shown).all(1)]
    panel.set(xlabel=x_label, ylabel=y_label)
    for axis, low, high in zip("xy", shown.min(0), shown.max(0), strict=True):
        if low > 0 and high / low > 8:
            room = (low / high) ** 0.08
            panel.set(**{f"{axis}scale": "log", f"{axis}lim": (low * room, high / room)})
        else:
            room = 0.1 * (high - low) or 0.1 * abs(high)
            panel.set(**{f"{axis}lim": (low - room, high + room)})
    panel.legend(fontsize=6.5)
    return figure
