"""Pictures over many walks: gains judged on an ensemble, a Pareto front, a gain schedule."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mjx_climb import plots
from tuning.problem import ensemble
from tuning.searches.pareto import knee
from tuning.searches.robust import JUDGED_SHARE

SCALES = {"m": (1e3, "mm"), "rad": (180 / np.pi, "deg")}
_COLORS = {"config": plots.VERMILLION, "paper": plots.VERMILLION, "pd": "0.6"}


def _scaled(variable: xr.DataArray) -> tuple[float, str]:
    """Return the factor and the unit in which people read a metric."""
    factor, unit = SCALES.get(variable.attrs["units"], (1.0, variable.attrs["units"]))
    return factor, "" if unit == "1" else f" [{unit}]"


def plot_judged(judged: xr.Dataset, metrics: Sequence[str] = ("force_variation", "peak_pull_force")) -> Figure:
    """Draw which share of the unseen walks stays below a value, a curve for each set of gains.

    A dot marks the mean, a diamond the mean of the worst 5 %. A gripper lets go beyond the
    vertical line.
    """
    with plots.style():
        figure = Figure(figsize=(plots.COLUMN, 0.35 + 1.75 * len(metrics)), layout="constrained")
        axes = figure.subplots(len(metrics), 1, squeeze=False)[:, 0]
        share = 100 * (np.arange(judged.sizes["member"]) + 1) / judged.sizes["member"]
        handles = []
        for number, name in enumerate(judged["gains"].values.tolist()):
            color = _COLORS.get(name, (plots.BLUE, plots.GREEN, plots.PURPLE)[number % 3])
            for panel, metric in zip(axes, metrics, strict=True):
                values = judged[metric].sel(gains=name).values.astype(float)
                values = np.sort(values[np.isfinite(values)]) * _scaled(judged[metric])[0]
                panel.step(values, share[: values.size], where="post", color=color, linewidth=1.2)
                panel.plot(
                    values.mean(), np.interp(values.mean(), values, share[: values.size]), "o", color=color, ms=4
                )
                worst = ensemble.worst_mean(values, JUDGED_SHARE)
                panel.plot(worst, np.interp(worst, values, share[: values.size]), "D", color=color, ms=4)
            handles.append(Line2D([], [], color=color, label=name))
        for panel, metric in zip(axes, metrics, strict=True):
            panel.set_xlabel(judged[metric].attrs["long_name"] + _scaled(judged[metric])[1])
            panel.set_ylabel("share of walks [%]")
            panel.set_ylim(0, 103)
            limit = judged.attrs.get("holding_limit", np.inf)
            if metric == "peak_pull_force" and limit < panel.get_xlim()[1]:
                panel.axvline(limit, color=plots.RED, linewidth=0.8)
        handles.append(Line2D([], [], color="0.3", marker="o", ms=4, linestyle="", label="mean"))
        handles.append(Line2D([], [], color="0.3", marker="D", ms=4, linestyle="", label="worst 5 %"))
        plots.legend(figure, handles)
    return figure


def plot_front(front: xr.Dataset) -> Figure:
    """Draw a Pareto front, all that was walked on the way, its knee, the config's gains, pd, and the front of pd."""
    x, y = front.attrs["against"], front.attrs["better"]
    (fx, ux), (fy, uy) = _scaled(front[x]), _scaled(front[y])
    fronts = front[x].values * fx, front[y].values * fy
    walked = front[f"walked_{x}"].values * fx, front[f"walked_{y}"].values * fy
    reference = {
        name: (front[f"reference_{x}"].sel(reference=name).item() * fx,
               front[f"reference_{y}"].sel(reference=name).item() * fy)
        for name in ("config", "pd")
    }  # fmt: skip
    held = front["held"].values.astype(bool)
    with plots.style():
        figure = Figure(figsize=(plots.COLUMN, 2.7), layout="constrained")
        panel = figure.subplots()
        panel.plot(walked[0][held], walked[1][held], ".", color="0.75", ms=2.5, label="walked", zorder=1)
        panel.plot(*fronts, "-o", color=plots.BLUE, ms=2.5, label="front")
        panel.plot(front[f"without_{x}"] * fx, front[f"without_{y}"] * fy, "--.", color=plots.BLACK, ms=3, lw=0.8,
                   label="pd over kp, kd")  # fmt: skip
        chosen = knee(front[x].values, front[y].values)
        panel.plot(fronts[0][chosen], fronts[1][chosen], "*", color=plots.ORANGE, ms=9, mec="black", mew=0.5,
                   linestyle="", label="knee")  # fmt: skip
        for (name, (a, b)), marker in zip(reference.items(), "Ds", strict=True):
            panel.plot(a, b, marker, color=_COLORS[name], mec="black", mew=0.5, ms=5, linestyle="", label=name)
        shown = np.array([*zip(*fronts, strict=True), *(v for v in reference.values() if np.isfinite(v).all())])
        for axis, place in (("x", 0), ("y", 1)):
            low, high = shown[:, place].min(), shown[:, place].max()
            if low > 0 and high / low > 8:
                getattr(panel, f"set_{axis}scale")("log")
                room = (low / high) ** 0.08
                getattr(panel, f"set_{axis}lim")(low * room, high / room)
            else:
                room = 0.1 * (high - low) or 0.1 * abs(high)
                getattr(panel, f"set_{axis}lim")(low - room, high + room)
        panel.set_xlabel(front[x].attrs["long_name"] + ux)
        panel.set_ylabel(front[y].attrs["long_name"] + uy)
        panel.legend(fontsize=6.5)
    return figure


def plot_schedule(table: xr.Dataset) -> Figure:
    """Draw the gains over gravity, a line for each cargo, and the force variation that they leave of pd's.

    Solid lines are translations, dashed ones rotations where they differ; gains that differ within either appear as
    their geometric mean. Hollow marks break a limit.
    """
    gravity, kinds = table["gravity"].values, table.attrs["searched"].split()
    units = {"stiffness": "K [N/m, N m/rad]", "damping": "D [N s/m, N m s]", "inertia": "M [kg, kg m$^2$]"}
    loads = table["cargo"].values
    colors = [plots.BLUE, plots.ORANGE, plots.GREEN, plots.PURPLE, plots.SKY, plots.VERMILLION]
    dashes = {"tuned": "-", "config": ":", "retuned_pd": "--"}
    with plots.style():
        figure = Figure(figsize=(plots.COLUMN, 0.5 + 1.3 * (len(kinds) + 1)), layout="constrained")
        axes = figure.subplots(len(kinds) + 1, 1, sharex=True)
        for number, load in enumerate(loads):
            color = colors[number % len(colors)]
            point = table.sel(cargo=load)
            sound = point["feasible"].values.astype(bool)
            for panel, kind in zip(axes, kinds, strict=False):
                for part, dash in zip(_translation_and_rotation(point[kind].values), "-:", strict=False):
                    _line(panel, gravity, part, sound, color, dash)
                panel.set_ylabel(units.get(kind, f"{kind} [{table[kind].attrs['units']}]"))
            variation = point["force_variation"]
            for walk, dash in dashes.items():
                left = 100 * (variation.sel(walk=walk) / variation.sel(walk="pd")).values
                _line(axes[-1], gravity, left, sound if walk == "tuned" else None, color, dash)
        for panel in axes[:-1]:
            _log_scale(panel)
        axes[-1].axhline(100, color="0.6", linewidth=0.8)
        axes[-1].set_ylabel("force variation\n[% of pd]")
        axes[-1].set_xscale("log")
        axes[-1].set_xlabel("gravity [G]")
        axes[-1].legend(
            handles=[Line2D([], [], color="0.3", ls=d, label=w.replace("_", " ")) for w, d in dashes.items()],
            fontsize=6.5,
        )
        plots.legend(
            figure, [Line2D([], [], color=c, label=f"{load:g} kg") for load, c in zip(loads, colors, strict=False)],
            "cargo",
        )  # fmt: skip
    return figure


def _translation_and_rotation(gain: np.ndarray) -> list[np.ndarray]:
    """Return the geometric means of a gain (n, axes) or (n) over translations, and over rotations where they differ."""
    logs = np.log(gain.reshape(len(gain), -1))
    both = [part.mean(1) for part in (logs[:, :3], logs[:, 3:]) if part.size]
    return [np.exp(part) for part in both[: 1 + (not np.allclose(both[0], both[-1]))]]


def _log_scale(panel: Axes) -> None:
    """Make the y axis logarithmic, a decade at least: less would make mountains of what does not matter."""
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    room = max(np.sqrt(10 * low / high), 1.0)
    panel.set_ylim(low / room, high * room)
    if high * room**2 / low < 1e3:
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())


def _line(panel: Axes, x: np.ndarray, y: np.ndarray, sound: np.ndarray | None, color: str, dash: str) -> None:
    panel.plot(x, y, dash, color=color)
    if sound is not None:
        panel.plot(x[sound], y[sound], "o", color=color, ms=3)
        panel.plot(x[~sound], y[~sound], "o", color=color, ms=3, mfc="white")
