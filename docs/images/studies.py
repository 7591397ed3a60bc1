"""Draw the picture of each study, and of other pages, from the tables beside them.

python docs/images/studies.py [FOLDER]
"""

import csv
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator

HERE = Path(__file__).parent
STUDIES = HERE.parent / "studies"
# of a phone's column: 4.2 inches at 96 px
WIDTH, ROW, MARGIN = 4.2, 0.29, 1.15
# docs/hooks/dark.py has those that stand for them on dark pages; colour-blind readers tell them apart (Okabe and Ito)
INK, FAINT = "#222222", "#d0d0d0"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#aa4499")
MARKERS = "osD^"
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
STYLE = {
    **{f"{part}.color": INK for part in ("text", "xtick", "ytick")},
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.facecolor": "none",
    "figure.constrained_layout.use": True,
    "font.size": 11,
    "grid.color": FAINT,
    "legend.frameon": False,
    "legend.fontsize": 10,
    "svg.fonttype": "none",  # text that a browser draws and a reader can search
    "svg.hashsalt": "mjx_climb",  # the same file from the same table
    "ytick.major.size": 0,
}
Row = Mapping[str, str]
Span = tuple[float, float, float]  # value, lower and upper end of its interval
Series = Mapping[str, Mapping[str, Span]]  # by its name: by row of the picture


def table(name: str, **wanted: str) -> list[Row]:
    """Return the rows of a table that have some values."""
    with (STUDIES / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [row for row in rows if all(row[column.replace("_", " ")] == value for column, value in wanted.items())]


def numbers(text: str) -> list[float]:
    """Return the numbers of a cell."""
    return [float(found) for found in NUMBER.findall(text)]


def span(text: str) -> Span:
    """Return the middle and the ends of a cell: of "3.8e6 to 4.6e6" both, of one number this alone."""
    found = numbers(text)
    return (sum(found) / len(found), min(found), max(found))


def change(row: Row, rivals: Sequence[Row], column: str) -> Span:
    """Return the difference of a row from its rival's in per cent, with the interval that the table has beside it."""
    rival = np.mean([float(row[column]) for row in rivals])
    value = 100 * (float(row[column]) / rival - 1)
    low, high = (next((row[name] for name in row if name.startswith(f"95 % {end}")), "") for end in ("low", "high"))
    return (value, float(low), float(high)) if low and high else (value, value, value)


def gathered(values: Iterable[tuple[str, str, Span]]) -> Series:
    """Return series by name and label; several values of one, from searches of other seeds, become one span."""
    found: dict[str, dict[str, list[Span]]] = {}
    for name, label, value in values:
        found.setdefault(name, {}).setdefault(label, []).append(value)
    return {
        name: {label: (float(np.mean([v for v, _, _ in own])), min(low for _, low, _ in own), max(h for *_, h in own))
               for label, own in rows.items()}
        for name, rows in found.items()
    }  # fmt: skip


def dots(panel: Axes, series: Series, at: float | None = None, spread: float = 0.0) -> None:
    """Draw a row for each label and a mark with its interval for each series; `at` is where nothing differs."""
    labels = list(dict.fromkeys(label for values in series.values() for label in values))
    for place, (name, values) in enumerate(series.items()):
        offset = spread * (place - (len(series) - 1) / 2)
        rows = [labels.index(label) + offset for label in values]
        middle, low, high = np.array(list(values.values())).T
        marker, colour = MARKERS[place % len(MARKERS)], COLOURS[place % len(MARKERS)]
        panel.hlines(rows, low, high, color=colour, linewidth=2)
        panel.plot(middle, rows, marker, color=colour, markersize=7, label=name)
    if at is not None:
        panel.axvline(at, color=INK, linewidth=1)
    if max(abs(np.array(panel.get_xlim()))) > 10:
        panel.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], integer=True))
    panel.set_yticks(range(len(labels)), labels)
    panel.set_ylim(len(labels) - 0.5, -0.5)
    panel.grid(axis="x")
    panel.spines[["top", "right", "left"]].set_visible(False)


def figure(rows: int, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a picture with so many rows, and its panels side by side."""
    made = Figure(figsize=(WIDTH, MARGIN + ROW * rows))
    return made, list(made.subplots(1, columns, sharey=True, squeeze=False)[0])


def legend(made: Figure, panel: Axes, columns: int) -> None:
    """Name the marks above the picture."""
    made.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=columns, handletextpad=0.2)


def plain(series: Series, label: str, at: float | None, **how: Any) -> Figure:
    """Return a picture of one panel."""
    columns = how.pop("columns", len(series))
    made, (panel,) = figure(len({name for values in series.values() for name in values}))
    dots(panel, series, at, **how)
    made.supxlabel(label, fontsize=11)
    if len(series) > 1:
        legend(made, panel, columns)
    return made


def logarithmic(panel: Axes, ticks: Sequence[float]) -> None:
    """Scale the axis by powers, with ticks in plain numbers."""
    panel.set_xscale("log")
    panel.set_xticks(ticks, map(str, ticks))
    panel.minorticks_off()


def by_case(rows: Iterable[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return rows by servos and case."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.get("servos", "dynamixel_x"), row["case"]), []).append(row)
    return found


def place(servos: str, case: str) -> str:
    return f"case {case}" if servos == "dynamixel_x" else f"case {case}, {servos.replace('_', '-').upper()}"


# --- the studies


def does_the_sensor_pay() -> Figure:
    """Force variation of three laws relative to pd with its own gains searched, under weight, by robot and gait."""
    low, high = (f"95 % {end}: difference from pd %" for end in ("low", "high"))
    laws = {"load transfer by plan": "plan", "load transfer": "load transfer", "Eq. 3, virtual model": "Eq. 3"}
    rows = [
        (laws[row["law"]], f"{row['case']}, {row['servos'].replace('_', '-')}, {gait}", row)
        for name, gait in (("paper_gait", "paper's gait"), ("which_law", "own gait"))
        for row in table(name, metric="V N", of_512_walks="mean")
        if row["law"] in laws and row["case"] != "2"
    ]
    ends = [(float(row[low]), float(row[high])) for _, _, row in rows]
    series = gathered((law, label, (sum(pair) / 2, *pair)) for (law, label, _), pair in zip(rows, ends, strict=True))
    return plain(series, "change of force variation from searched pd, %", 0, spread=0.2)


def which_law() -> Figure:
    """Force variation of each law relative to pd, by case under weight."""
    low, high = (f"95 % {end}: difference from pd %" for end in ("low", "high"))
    rows = [row for row in table("which_law", metric="V N", of_512_walks="mean") if row[low]]
    rows = [row for row in rows if row["law"] != "pd as configured" and row["case"] != "2"]
    ends = [(float(row[low]), float(row[high])) for row in rows]
    series = gathered(
        (place(row["servos"], row["case"]), row["law"], (sum(pair) / 2, *pair))
        for row, pair in zip(rows, ends, strict=True)
    )
    return plain(series, "change of force variation from pd, %", 0, columns=2, spread=0.17)


def worse_hardware() -> Figure:
    """Force variation of pd by setting, and of load transfer beside pd in the same setting, under weight."""
    short = {
        "force_sensor.delay=0.002": "2 ms late", "force_sensor.delay=0.03": "30 ms late",
        "control_period=0.001": "1 kHz", "control_period=0.02": "50 Hz", "friction=x0.5": "half friction",
        "friction=x2": "twice friction", "force_sensor.noise=0.5": "0.5 N noise",
        "force_sensor.dead.LF=3.0": "LF dead", "force_sensor.bias=1.0": "1 N bias",
    }  # fmt: skip
    rows = [row for row in table("worse_hardware", metric="V N") if row["case"] != "2"]

    def of(kind: str, law: str) -> Series:
        chosen = [row for row in rows if row["values"].startswith(kind) and row["law"] == law]
        cells = [(row, setting) for row in chosen for setting in short if numbers(row[setting])]
        return gathered((f"case {row['case']}", short[setting], span(row[setting])) for row, setting in cells)

    made, panels = figure(len(short), 2)
    for panel, series, title, label in (
        (panels[0], of("change", "pd, searched"), "pd", "from as drawn, %"),
        (panels[1], of("difference from pd", "load transfer"), "load transfer", "from pd, %"),
    ):
        dots(panel, series, 0, spread=0.2)
        panel.set_title(title, fontsize=11)
        panel.set_xlabel(label, fontsize=10)
    legend(made, panels[0], 3)
    return made


def robust_gains() -> Figure:
    """Lost walks of gains that were searched over drawn walks and over the case's own, by case and law."""
    short = {"pd, searched": "pd", "load transfer by plan": "plan", "Eq. 3, virtual model": "Eq. 3"}
    rows = [row for row in table("robust_gains", metric="V N") if row["gains"] != "as configured"]
    series = gathered(
        (short.get(row["law"], row["law"]), f"{row['case']}, {row['gains']}", span(row["lost"])) for row in rows
    )
    return plain(series, "lost walks of 512", None, spread=0.2)


def ceiling() -> Figure:
    """Objective from pd to plans that know all, by case: on the shipped gait and on the searched one, on 16 walks."""
    words = {
        "retuned_pd": "pd",
        "load_transfer": "load transfer",
        "blind": "blind plan",
        "causal 15 ms": "known after 15 ms",
        "clairvoyant": "all known",
    }
    found = {(row["row"], row["contestant"]): row["objective"] for row in table("ceiling")}

    def of(rows: str) -> Series:
        return gathered(
            (f"case {case.replace('_', '.')}", label, span(found[f"dynamixel_x_{case}_{rows}", contestant]))
            for contestant, label in words.items()
            for case in ("1_1", "1_2", "2")
        )

    made, panels = figure(2 * len(words), 2)
    for panel, rows, gait in zip(panels, ("ensemble", "searched_gait"), ("shipped", "searched"), strict=True):
        dots(panel, of(rows), spread=0.25)
        panel.set_title(f"{gait} gait", fontsize=11)
    ends = [end for panel in panels for end in panel.get_xlim()]
    for panel in panels:
        panel.set_xlim(min(ends) - 0.01, max(ends) + 0.01)
        panel.xaxis.set_major_locator(MultipleLocator(0.1))
    made.supxlabel("objective: the less the better, 1 for the config's pd", fontsize=10)
    legend(made, panels[0], 3)
    return made


def paper() -> Figure:
    """Force variation and cost of transport in both readings with the paper's gains, relative to pd."""
    text = (STUDIES / "paper_run.md").read_text("utf-8")
    cases = re.findall(r"^\*\*Case ([\d.]+):(.*?)(?=^\*\*)", text, re.MULTILINE | re.DOTALL)

    def values(metric: str) -> Iterator[tuple[str, str, Span]]:
        for case, part in cases:
            lines = [line.split("|") for line in part.splitlines() if line.startswith((f"| {metric} ", "| metric "))]
            cells = {name.strip(): cell.strip() for name, cell in zip(*lines, strict=True)}
            for reading in ("virtual model", "measured pose"):
                share = 100 * float(cells[reading]) / float(cells["pd"])
                yield reading, f"case {case}", (share, share, share)

    made, panels = figure(4, 2)
    for panel, metric, ticks in (
        (panels[0], "force variation", [25, 50, 100]),
        (panels[1], "cost of transport", [100, 200, 400]),
    ):
        dots(panel, gathered(values(metric)), 100)
        logarithmic(panel, ticks)
        panel.set_title(metric, fontsize=11)
        panel.set_xlabel("% of pd", fontsize=10)
    legend(made, panels[0], 2)
    return made


def identification() -> Figure:
    """How many of the 95 % intervals hold the truth."""
    column = "inside the 95 % interval, %"
    series = gathered((row["logs"], row["parameter"], span(row[column])) for row in table("identification"))
    return plain(series, column, 95, columns=1, spread=0.2)


def gradient_against_grid() -> Figure:
    """Env-steps until the gradient reaches the best cell of the grid."""
    columns = {"seed 0": "Adam reaches it at, seed 0", "seed 1": "seed 1"}
    series = gathered(
        (name, f"{row['reading'].replace('_', ' ')}, {row['case']}", (numbers(row[column])[0],) * 3)
        for name, column in columns.items()
        for row in table("gradient_against_grid")
        if numbers(row[column])
    )
    made = plain(series, "env-steps, millions; line: the grid", 18.43)
    logarithmic(made.axes[0], [0.2, 1, 5, 20])
    return made


def other_robots() -> Figure:
    """Objective of each robot's gains."""
    series = gathered(
        (row["config"].replace("_like", "").replace("_", " "), row["gains"].partition(":")[0], span(row["objective"]))
        for row in table("other_robots_tuned")
    )
    return plain(series, "objective, 1 for the config's pd", 1)


def low_reaction_swings() -> Figure:
    """Change of the force variation under pd by swings of low reaction."""

    def values() -> Iterator[tuple[str, str, Span]]:
        for row in table("low_reaction_swings", law="pd"):
            name = row["config"].replace(", capture_distance: 0.01", ", reach 1 cm")
            name = name.replace("_like", "").replace("_", " ")
            cubic, low = (float(row[f"force variation {swing} N"]) for swing in ("cubic", "low reaction"))
            yield "pd", name if name[0].isalpha() else f"case {name}", (100 * (low / cubic - 1),) * 3

    return plain(gathered(values()), "change of force variation, %", 0)


def recovery() -> Figure:
    """Impulse at which half of the walks survive on Dynamixel X servos, by law, gravity and length of the push."""

    def values() -> Iterator[tuple[str, str, Span]]:
        for row in table("recovery", hardware="dynamixel_x", direction="all"):
            label = f"{row['law']}, {row['gravity']}, {row['push']}".replace("_", " ")
            name = {"none": "without", "recovery": "with recovery"}[row["recovery"]]
            yield name, label, (float(row["half"]), float(row["low"]), float(row["high"]))

    return plain(gathered(values()), "impulse that half survive, N s", None)


def climb() -> Figure:
    """Share of climbs that come 2 m far on an overhang with 400 holds a m², by rule and law, with either grip."""
    grips = {("closing", "waits"): "grips that close", ("at once", "goes on"): "grips that hold at once"}

    def values() -> Iterator[tuple[str, str, Span]]:
        for row in table("climb", ground="rock", angle="135", density="400.0"):
            name, law, rule = grips.get((row["contact"], row["gait"])), row["law"], row["rule"]
            if name and not rule.startswith("climblab"):
                words = "" if law == "base_admittance" else f", {law}"
                label = f"{row['robot'].replace('hubrobo', 'HubRobo')}, {rule}{words}".replace("_", " ")
                yield name, label, share(int(row["arrived"]), int(row["of"]))

    return plain(gathered(values()), "climbs that come 2 m far, %", None, spread=0.2)


def share(count: float, of: float, z: float = 1.96) -> Span:
    """Return a share in per cent with its interval of 95 % (Wilson)."""
    middle, more = count / of, z * z / of
    half = z * np.sqrt(middle * (1 - middle) / of + more / (4 * of))
    low, high = ((middle + more / 2 + sign * half) / (1 + more) for sign in (-1, 1))
    return (100 * middle, 100 * low, 100 * high)


def speed() -> Figure:
    """Steps of a robot in a second by machine and program: of each the fastest batch."""
    rows = table("speed")
    (ours,) = (span(row["value"])[0] for row in rows if (row["machine"], row["what"]) == ("two cores", "closed loop"))
    fastest: dict[tuple[str, str], float] = {}
    for row in rows:
        if row["quantity"] == "ratio of ours to it":
            name, rate = row["what"].partition(",")[0], ours / span(row["value"])[0]
        elif row["quantity"] == "rate" and row["devices"] == "1" and "a thread for" not in row["what"]:
            name, rate = row["what"].partition(" bare")[0].replace("closed", "this, closed"), span(row["value"])[0]
        else:
            continue
        fastest[row["machine"], name] = max(rate, fastest.get((row["machine"], name), 0.0))
    made = plain(gathered((*key, (rate,) * 3) for key, rate in fastest.items()), "env-steps a second", None)
    made.axes[0].set_xscale("log")
    return made


# --- other pages


def margins() -> Figure:
    """Force variation over force delay and control period: where a gripper is torn off the line ends in a cross."""
    made = Figure(figsize=(WIDTH, 4.4))
    rows = table("../explanation/margins")
    for panel, quantity in zip(made.subplots(2, 1), ("force delay", "control period"), strict=True):
        for gains, colour in (("K 3e3, D 150", COLOURS[0]), ("pd", INK)):
            own = [row for row in rows if (row["quantity"], row["gains"]) == (quantity, gains)]
            held = [row for row in own if row["force variation N"] and not row["gripper torn off at s"]]
            time, force = np.array([[float(row[name]) for name in ("value s", "force variation N")] for row in held]).T
            panel.plot(1e3 * time, force, color=colour, linewidth=2, label=gains)
            if len(held) < len(own):
                panel.plot(1e3 * time[-1], force[-1], "X", color=COLOURS[1], markersize=9, label="gripper torn off")
        panel.set_yscale("log")
        panel.set_yticks(ticks := [50, 100, 500, 2000], map(str, ticks))
        panel.minorticks_off()
        panel.set_xlabel(f"{quantity}, ms")
        panel.grid()
        panel.spines[["top", "right"]].set_visible(False)
    made.supylabel("force variation, N", fontsize=11)
    legend(made, made.axes[0], 3)
    return made


def closing() -> Figure:
    """Pull on a foot over the first 20 ms after its gripper shuts off the ground, at once and closing."""
    made = Figure(figsize=(WIDTH, 2.6))
    panel = made.subplots()
    for name, colour in (("at once", COLOURS[1]), ("closing", COLOURS[0])):
        rows = table("../explanation/closing", contact=name)
        time, pull = np.array([[float(row[column]) for column in ("time ms", "pull N")] for row in rows]).T
        panel.plot(time, pull, color=colour, linewidth=2, label=name)
    panel.set_xlabel("time since the gripper shuts, ms")
    panel.set_ylabel("pull, N")
    panel.grid()
    panel.spines[["top", "right"]].set_visible(False)
    legend(made, panel, 2)
    return made


PICTURES: dict[str, Callable[[], Figure]] = {
    draw.__name__: draw
    for draw in (
        ceiling,
        climb,
        closing,
        does_the_sensor_pay,
        gradient_against_grid,
        identification,
        low_reaction_swings,
        margins,
        other_robots,
        paper,
        recovery,
        robust_gains,
        speed,
        which_law,
        worse_hardware,
    )
}


def save(pictures: Mapping[str, Callable[[], Figure]], folder: Path = HERE) -> None:
    """Draw pictures into a folder, by their names."""
    with mpl.rc_context(STYLE):
        for name, draw in pictures.items():
            draw().savefig(folder / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    save(PICTURES, *map(Path, sys.argv[1:]))
