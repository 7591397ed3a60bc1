"""A gain schedule: tables, picture and page."""

import itertools
from typing import Any

import numpy as np
import xarray as xr
import yaml
from matplotlib.figure import Figure

from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from mjx_climb.walk.metrics import failed
from tuning.comparisons.of_schedule import ScheduleComparison
from tuning.comparisons.of_schedule import compare as compare
from tuning.numbers import change, gain, has_axes, number
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.page import Findings, Page, Table
from tuning.pages.pictures import plain_numbers
from tuning.results.scheduled import Scheduled
from tuning.searches import retuned_pd

SCHEDULE = "Gains by gravity and cargo."
SHOWN = ("force_variation", "peak_foot_force", "peak_pull_force", "base_deviation")  # in tables
_LOADS = (plots.BLUE, plots.ORANGE, plots.GREEN, plots.PURPLE, plots.SKY, plots.VERMILLION)
_UNITS = {"stiffness": "K [N/m, N m/rad]", "damping": "D [N s/m, N m s]", "inertia": "M [kg, kg m$^2$]"}
_DASHES = {"tuned": "-", "config": ":", "retuned_pd": "--"}


def contents(found: Scheduled, compared: ScheduleComparison, name: str) -> Contents:
    """Return the table, all metrics, a picture and the page."""
    data = found.data
    level, load, loss = one_for_all(data)
    one = "every set of gains breaks a limit at some other operating point"
    if loss < np.inf:
        one = f"the gains of {level:g} G, {load:g} kg lose at most {loss:.3f} of pd's objective"
    files: dict[str, Any] = {"schedule.csv": to_csv(data), "schedule.yaml": to_yaml(data)}
    said = Findings(compared.verdict, [compared.worth], [f"one for all: {one}"])
    assert found.search is not None
    tables, facts = [table_of(data)], {"seed": found.search.seed}
    page = Page("Gains for each gravity and cargo: {}", said, found.scenario, tables=tables, facts=facts)
    over = (f"--over {each}={','.join(f'{v:.9g}' for v in data[each].values)}" for each in ("gravity", "cargo"))
    again = f"mjx-climb tune config.yaml --search search.yaml {' '.join(over)} --out again"
    files |= {"schedule": Picture(SCHEDULE, lambda: plot_schedule(data))}
    return contents_of(found, name, page, rows(data), files, again=again, data=data)


def table_of(data: xr.Dataset) -> Table:
    """Return the gains of each operating point, and the force variation beside the config's, retuned pd's and pd's."""
    names = data.attrs["searched"].split()
    words = {"config": "config", retuned_pd.NAME: "retuned", retuned_pd.UNSEARCHED: "planned", "pd": "pd"}
    beside = {name: words[name] for name in words if name in data["walk"]}
    columns = ["gravity\nG", "cargo\nkg", *names, "variation\nN", *(f"vs\n{word} %" for word in beside.values()), ""]
    lines = []
    for row in rows(data):
        tuned, *others = (row["force_variation"][walk] for walk in ("tuned", *beside))
        cells = [f"{row['gravity_g']:.3g}", f"{row['cargo_kg']:.3g}", *(gain(row, name) for name in names)]
        cells += ["failed" if tuned is None else number(tuned), *(change(tuned, other) for other in others)]
        outside = "" if row["feasible"] else "breaks limits"
        lines.append([*cells, f"{outside} {row['on_bound']} on a bound" if row["on_bound"] else outside])
    return Table("Gains by gravity and cargo", columns, [("", lines)], 0)


def one_for_all(table: xr.Dataset) -> tuple[float, float, float]:
    """Return the operating point, gravity G and cargo kg, whose gains serve all others best, and the most they lose.

    The loss is the largest `transfer` less the tuned `value` over all operating points; infinite where every set of
    gains breaks a constraint somewhere.
    """
    loss = table["transfer"].values - table["value"].values[:, :, None, None]
    worst = np.where(np.isfinite(loss), loss, np.inf).max((0, 1))
    g, c = np.unravel_index(np.argmin(worst), worst.shape)
    return float(table["gravity"][g]), float(table["cargo"][c]), float(worst[g, c])


def rows(table: xr.Dataset) -> list[dict[str, Any]]:
    """Return the schedule as plain rows: gravity_g, cargo_kg, the gains, and their metrics beside pd's.

    A metric of a walk that failed is None.
    """
    result = []
    for g, c in np.ndindex(table["value"].shape):
        point = table.isel(gravity=g, cargo=c)
        row: dict[str, Any] = {"gravity_g": float(point["gravity"]), "cargo_kg": float(point["cargo"])}
        for name in table.attrs["gains"].split():
            values = np.unique(np.round(point[name].values.ravel(), 12))
            row[name] = float(values[0]) if values.size == 1 else point[name].values.tolist()
        row["feasible"], row["on_bound"] = bool(point["feasible"]), point["on_bound"].item()
        for name in SHOWN:
            holds = ~failed(point)
            each = zip(point["walk"].values.tolist(), point[name].values.tolist(), holds.values, strict=True)
            row[name] = {walk: value if held else None for walk, value, held in each}
        row[retuned_pd.NAME] = {name: float(point[f"retuned_{name}"]) for name in ("kp", "kd", "value")}
        result.append(row)
    return result


def to_csv(table: xr.Dataset) -> str:
    """Return the schedule as CSV: one line per operating point, a column per number of each gain."""
    lines = []
    for g, c in np.ndindex(table["value"].shape):
        point = table.isel(gravity=g, cargo=c)
        cells = {"gravity_G": point["gravity"], "cargo_kg": point["cargo"]}
        for name in table.attrs["gains"].split():
            labels = [point[dim].values for dim in point[name].dims]
            for place in np.ndindex(point[name].shape):
                axes = (str(label[number]) for label, number in zip(labels, place, strict=True))
                cells["_".join([name, *axes])] = point[name][place]
        cells["feasible"] = point["feasible"]
        cells |= {f"{name}_{walk}": point[name].sel(walk=walk) for name in SHOWN for walk in table["walk"].values}
        lines.append(",".join(f"{float(value):.6g}" for value in cells.values()))
    return "\n".join([",".join(cells), *lines]) + "\n"


def to_yaml(table: xr.Dataset) -> str:
    """Return the schedule as YAML: a list of operating points with their gains."""
    return yaml.safe_dump({"operating_points": rows(table)}, sort_keys=False, default_flow_style=None, width=110)


@plots.style()
def plot_schedule(table: xr.Dataset) -> Figure:
    """Draw the gains over gravity, a line for each cargo, and the force variation that they leave of pd's.

    Solid lines of gains are translations, dotted ones rotations where they differ; gains that differ within either
    appear as their geometric mean, arrays and gains of 0 or less not at all. Below, solid lines are the tuned gains,
    dotted ones the config's, dashed ones pd retuned. Hollow marks break a limit.
    """
    gravity, searched = table["gravity"].values, table.attrs["searched"].split()
    kinds = [kind for kind in searched if has_axes(table[kind][0, 0]) and (table[kind].values > 0).all()]
    colors = dict(zip(table["cargo"].values, itertools.cycle(_LOADS), strict=False))
    figure = Figure(figsize=(plots.COLUMN, 0.5 + 1.3 * (len(kinds) + 1)), layout="constrained")
    *panels, below = figure.subplots(len(kinds) + 1, 1, sharex=True, squeeze=False).ravel()

    for load, color in colors.items():
        point, curves = table.sel(cargo=load), []  # panel, values, dash, and whether a curve's points are marked
        feasible = point["feasible"].values.astype(bool)
        for panel, kind in zip(panels, kinds, strict=True):
            logs = np.log(point[kind].values.reshape(gravity.size, -1))
            parts = [part.mean(1) for part in (logs[:, :3], logs[:, 3:]) if part.size]
            curves.append((panel, np.exp(parts[0]), "-", True))
            if not np.allclose(parts[0], parts[-1]):
                curves.append((panel, np.exp(parts[-1]), ":", True))
            panel.set_ylabel(_UNITS.get(kind, f"{kind} [{table[kind].attrs['units']}]"))
        held = ~failed(point)
        variation = point["force_variation"].where(held)
        left = 100 * variation / variation.sel(walk="pd")
        curves += [(below, left.sel(walk=walk).values, dash, walk == "tuned") for walk, dash in _DASHES.items()]
        for panel, values, dash, marked in curves:
            panel.plot(gravity, values, dash, color=color)
            for some, fill in ((feasible, color), (~feasible, "white")) if marked else ():
                panel.plot(gravity[some], values[some], "o", color=color, ms=3, mfc=fill)
    for panel in panels:  # a decade at least: less would make mountains of small differences
        low, high = panel.dataLim.intervaly
        room = max(np.sqrt(10 * low / high), (high / low) ** 0.05)
        panel.set_ylim(low / room, high * room)
        panel.set_yscale("log")
        plain_numbers(panel.yaxis, few=high * room**2 / low < 1e3)
    below.axhline(100, color="0.6", linewidth=0.8)
    below.set(ylabel="force variation\n[% of pd]", xscale="log", xlabel="gravity [G]")
    if gravity.max() < 100 * gravity.min():  # so few decades would have a number at each of their tenths
        below.set_xlim(gravity.min() / 1.5, gravity.max() * 1.5)
        plain_numbers(below.xaxis, few=True)
    walks = [key(walk.replace("_", " "), color="0.3", ls=dash) for walk, dash in _DASHES.items()]
    plots.legend_below(figure, walks, 3)
    plots.legend(figure, [key(f"{load:g} kg", color=color) for load, color in colors.items()], "cargo")
    return figure
