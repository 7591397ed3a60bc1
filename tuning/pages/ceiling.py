"""The page of `tuning.ceiling`: contestants from the best plan found to pd, one sentence, one table, two pictures."""

import itertools
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_climb.viz import plots
from mjx_climb.viz.plots import key
from tuning.comparisons import verdicts
from tuning.numbers import number, unit
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.page import Findings, Page, Table
from tuning.problem.readings import best_of_both
from tuning.results.ceiling import BLIND, CLAIRVOYANT, LEVEL, PD, RETUNED, Bounded, mean_and_interval

BARS = "The objective of each contestant, pd's mean is 1: bars are means, dots the members' walks."
FRONT = "The front of two metrics, means over the walks: plans that know all in advance, and the laws."
FORCES = "The largest foot force and the base's offset in the walk of the first member."
_METRICS = ("force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque",
            "base_deviation")  # fmt: skip


def noise(found: Bounded) -> float:
    """Return the difference of two means of the objective that is no more than noise of the search."""
    return max(found.left, 0.0) * abs(found.means[BLIND])


def sentence(found: Bounded) -> str:
    """Return the most that a sensor can be worth, and the best law's share of it."""
    worth, walks = found.sensor, found.data.sizes["member"]
    means, best = found.means, found.best_law
    law, reached, share = verdicts.in_words(best), means[best], found.share(best)
    if not np.isfinite(worth.mean):
        return "A walk was lost, so that the plans cannot be compared"
    over = f"{LEVEL:.0%} interval {100 * worth.low:.1f} to {100 * worth.high:.1f} over {walks} walks"
    over = "one walk" if walks < 2 else over
    ends = f"the best plan found without a sensor reaches {means[BLIND]:.3f}, with all known {means[CLAIRVOYANT]:.3f}"
    if worth.mean <= noise(found) or not (walks < 2 or worth.low > 0):
        return f"What a sensor is worth cannot be told from nothing here ({over}): {ends}, {law} {reached:.3f}"
    way = f"{law} reaches {reached:.3f}, {share:.0%} of the way from the one to the other"
    return f"A sensor is worth at most {100 * worth.mean:.1f} % of pd's objective ({over}): {ends}; {way}"


def sensor_of_laws(found: Bounded) -> str:
    """The best law that reads forces beside the best that does not, in words; nothing where there is no such pair."""
    laws = [name for name in found.contestants if name not in (*found.plans, PD)]
    reading = str(found.data.attrs.get("reads_forces", "")).split(", ")
    ours, without = best_of_both(laws, reading, found.means.__getitem__)
    if ours is None or without is None:
        return ""
    worth = mean_and_interval(found.values(without) - found.values(ours))
    ends = f" ({LEVEL:.0%} interval {100 * worth.low:.1f} to {100 * worth.high:.1f})" if np.isfinite(worth.low) else ""
    said = f"a force sensor is worth {100 * worth.mean:.1f} % of pd's objective{ends}"
    best = f"{verdicts.in_words(ours)} {found.means[ours]:.3f}"
    return f"of the laws {said}: {best}, {verdicts.in_words(without)} {found.means[without]:.3f} without one"


def notes(found: Bounded) -> list[str]:
    """Return the basis of the numbers, in lines."""
    lines = ["plans are the best found: the least may be less, and a sensor worth more or less than these numbers"]
    lines.append(f"the second search bettered the blind plan by {found.left:.2%}: smaller differences are search noise")
    if np.isfinite(found.spread):
        lines.append(f"the two best starts of the blind plan ended {found.spread:.2%} apart")
    if tested := found.tested:
        means = ", ".join(f"{name} {values.mean():.3f}" for name, values in tested.items() if name != PD)
        lines.append(f"in {found.data.sizes['fresh']} unseen walks, relative to pd in these: {means}")
    lines += filter(None, [sensor_of_laws(found)])
    if found.data.attrs["hidden"]:
        lines.append(
            "the first disturbance comes at one time in all walks, so the blind plan was searched without "
            "disturbances; laws and pd were searched with them"
        )
    own_gait = str(found.data.attrs["own_gait"])
    if own_gait and RETUNED not in own_gait.split(", "):
        lines.append(
            f"warning: {RETUNED} walks with the config's gait, and the gait is searched for {own_gait}; "
            "--retuned-pd FILE takes kp, kd and a gait"
        )
    for name in found.contestants:
        broken = int((~found.data["feasible"].sel(contestant=name).values.astype(bool)).sum())
        if broken:
            lines.append(f"warning: {name} breaks a limit in {broken} of {found.data.sizes['member']} walks")
    return lines


def table(found: Bounded) -> Table:
    """Return the contestants with their objective, share, and mean metrics."""
    about = found.problem.metrics
    tested = {name: f"{values.mean():.4f}" for name, values in found.tested.items()}
    columns = [
        "contestant",
        "objective",
        *(["unseen"] if tested else []),
        "share %",
        *(f"{about.in_words(n)} {unit(n, about)}".strip() for n in _METRICS),
    ]
    rows = []
    for name in found.contestants:
        own, share = found.data.sel(contestant=name), 100 * found.share(name)
        means = [number(float(np.mean(own[metric].values))) for metric in _METRICS]
        unseen = [tested.get(name, "-")] if tested else []
        rows.append([name, f"{found.means[name]:.4f}", *unseen, f"{share:.0f}" if np.isfinite(share) else "-", *means])
    about_unseen = "; unseen: the objective in walks of a fresh draw" if tested else ""
    return Table(
        f"Means over the walks; share: of the way from blind to clairvoyant{about_unseen}", columns, [("", rows)], 1
    )


def searches_table(found: Bounded) -> Table:
    """Return how each descent went."""
    data, rows = found.data, []
    for number_ in range(data.sizes["descent"]):
        own = {name: data[f"descent_{name}"].values[number_] for name in ("contestant", "start", "knots", "before",
                                                                          "merit", "slope")}  # fmt: skip
        rows.append([str(own["contestant"]), str(own["start"]), f"{own['knots']:g}",
                     *(f"{own[name]:.4g}" for name in ("before", "merit", "slope"))])  # fmt: skip
    columns = ["searched", "start", "knots s", "objective before", "after", "slope left"]
    return Table(
        "Descents; objectives with the penalties of limits; slope: of that at the begin", columns, [("", rows)], 2
    )


def front_table(found: Bounded) -> Table:
    """Return the plans along the front."""
    names, about = (found.asked.better, str(found.asked.against)), found.problem.metrics
    columns = ["weight of the second %", *(f"{about.in_words(name)} {unit(name, about)}".strip() for name in names)]
    each = zip(found.data["front_share"].values, found.data["front"].values.mean(-1), strict=True)
    rows = [[f"{100 * share:g}", *map(number, means)] for share, means in each]
    return Table("The front of two metrics: plans that know all in advance", columns, [("", rows)], 1)


def summary(found: Bounded) -> dict[str, Any]:
    """Return the result as plain data, as `summary.json` and `evaluate --ceiling --json` have it.

    `ceiling`: objective (pd: 1), share and mean metrics of plans (clairvoyant, blind, ...), laws and pd by name;
    `unseen`: those of blind plan and laws in unseen walks; `sensor`: the largest worth of a sensor, with its interval.
    """
    worth = found.sensor
    ceiling = {
        name: {"objective": found.means[name], "share": found.share(name),
               **{metric: float(np.mean(found.data[metric].sel(contestant=name))) for metric in _METRICS}}
        for name in found.contestants
    }  # fmt: skip
    sensor = {"at_most": worth.mean, "low": worth.low, "high": worth.high, "in_words": sentence(found)}
    unseen = {
        name: {"objective": values.mean(),
               **{metric: float(np.mean(found.data[f"unseen_{metric}"].sel(tested=name))) for metric in _METRICS}}
        for name, values in found.tested.items()
    }  # fmt: skip
    front = found.data["front"].values.mean(-1).tolist() if "front" in found.data else []
    return {
        "sensor": sensor,
        **({"front": {"metrics": [found.asked.better, found.asked.against], "points": front}} if front else {}),
        "unseen": unseen,
        "ceiling": ceiling,
        "search_noise": noise(found),
        "starts_apart": found.spread,
    }


@plots.style()
def plot_bounds(found: Bounded) -> Figure:
    """Draw the objective of each contestant as a bar, with a dot for each member."""
    names = found.contestants
    figure = Figure(figsize=(plots.COLUMN, 0.5 + 0.22 * len(names)), layout="constrained")
    panel = figure.subplots()
    for place, name in enumerate(names):
        values = found.values(name)
        color = "0.6" if name == PD else plots.BLUE if name in found.plans else plots.ORANGE
        panel.barh(place, found.means[name], color=color, height=0.7)
        if len(values) > 1:
            panel.plot(values, np.full(len(values), place), ".", color="0.2", markersize=2)
    for name in (CLAIRVOYANT, BLIND):
        panel.axvline(found.means[name], color=plots.BLUE, linewidth=0.7, linestyle="--")
    panel.set_yticks(range(len(names)), names)
    panel.set(ylim=(len(names) - 0.5, -0.5), xlabel="objective (pd: 1)")
    panel.set_xlim(left=0)
    return figure


@plots.style()
def plot_histories(found: Bounded) -> Figure:
    """Draw the largest foot force and the size of the base's offset over time: clairvoyant, blind, best law, pd."""
    names = list(dict.fromkeys([PD, found.best_law, BLIND, CLAIRVOYANT]))
    colors = dict(
        zip(names, itertools.chain(["0.6"], (plots.ORANGE, plots.GREEN, plots.BLUE)[4 - len(names) :]), strict=True)
    )
    figure = Figure(figsize=(plots.COLUMN, 3.2), layout="constrained")
    forces, offsets = figure.subplots(2, 1, sharex=True)
    time = found.data["instant"].values
    for name, color in colors.items():
        own = found.data.sel(contestant=name)
        forces.plot(time, own["foot_force_history"].values, color=color, linewidth=0.8)
        offsets.plot(time, 1e3 * np.linalg.norm(own["base_offset_history"].values, axis=-1), color=color, linewidth=0.8)
    forces.set(ylabel="largest foot force [N]")
    offsets.set(xlabel="time [s]", ylabel="base offset [mm]")
    plots.legend(figure, [key(name, color=color) for name, color in colors.items()])
    return figure


@plots.style()
def plot_front(found: Bounded) -> Figure:
    """Draw the front of two metrics, with the laws and the other plans as points."""
    names, about = (found.asked.better, str(found.asked.against)), found.problem.metrics
    figure = Figure(figsize=(plots.COLUMN, 2.8), layout="constrained")
    panel = figure.subplots()
    look: dict[str, Any] = {"markersize": 4, "linewidth": 0.8}
    lines = panel.plot(*found.data["front"].values.mean(-1).T, "o-", color=plots.BLUE, label="known in advance", **look)
    for name, marker in zip(found.contestants, itertools.cycle("sDv^<>Pp"), strict=False):
        place = [[float(found.data[metric].sel(contestant=name).mean())] for metric in names]
        color = "0.6" if name == PD else plots.BLUE if name in found.plans else plots.ORANGE
        lines += panel.plot(*place, marker, color=color, label=name, **look)
    labels = (f"{about.in_words(name)} [{unit(name, about)}]".removesuffix(" []") for name in names)
    panel.set(**{f"{axis}label": label for axis, label in zip("xy", labels, strict=True)})
    plots.legend(figure, lines)
    return figure


def contents(found: Bounded, _: None, name: str) -> Contents:
    """Return every contestant's walks with the plans found, two pictures, the page."""
    pictures = {
        "bounds": Picture(BARS, lambda: plot_bounds(found)),
        "first_walk": Picture(FORCES, lambda: plot_histories(found)),
    } | ({"front": Picture(FRONT, lambda: plot_front(found))} if "front" in found.data else {})
    files = {"ceiling.yaml": found.asked.to_yaml()} | pictures
    return contents_of(found, name, page_of(found), summary(found), files, data=found.data)


def page_of(found: Bounded) -> Page:
    """Return the page."""
    asked, (first, *more) = found.asked, notes(found)
    front = [front_table(found)] if "front" in found.data else []
    return Page(
        "How good could any law be: {}", Findings.of(sentence(found), more, first), found.scenario,
        tables=[table(found), *front, searches_table(found)],
        main=list(dict.fromkeys((CLAIRVOYANT, BLIND, found.best_law, RETUNED, PD))),
        facts={"precision": asked.precision, "seed": asked.seed, "limits": found.data.attrs["limits"],
               "gradients for each spacing of knots": asked.iterations},
    )  # fmt: skip
