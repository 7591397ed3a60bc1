"""Gains on worse hardware: the loss of each, and their remaining lead over the best rival."""

import xarray as xr
from matplotlib.figure import Figure

from mjx_climb.viz import plots
from tuning.comparisons import judge as judging
from tuning.comparisons import paired, verdicts
from tuning.comparisons.degraded import AS_DRAWN, METRICS, Degradation, summary
from tuning.comparisons.side_by_side import VARIATION
from tuning.numbers import number
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.page import Findings, Page, Table
from tuning.pages.pictures import scaled
from tuning.results.judged import Degraded

LEAST = 0.1  # N of pull, and of every other metric, that can be compared in per cent
CHANGES = "Mean force variation on worse hardware, of each gains."


def compare(found: Degraded, *_: object) -> Degradation:
    """Return the differences with their intervals; nothing walks."""
    return summary(found.data)


def contents(found: Degraded, compared: Degradation, name: str) -> Contents:
    """Return every walk, both tables, the picture and the page."""
    assert found.ensemble is not None
    said = Findings(in_words(found, compared), judging.lost_in_words(found.data))
    tables, facts = [losses_table(found, compared), lead_table(found, compared)], {"seed": found.ensemble.seed}
    page = Page("Gains on worse hardware, {}", said, found.scenario, tables=tables, facts=facts)
    each = [{"setting": key} | row for key, table in compared.lead.items() for row in paired.differences(table)]
    summary = {"gains": _plain(compared), "differences": each, "verdict": said.verdict}
    picture = Picture(CHANGES, lambda: plot_degraded(found.data))
    return contents_of(found, name, page, summary, {"degraded": picture}, shown=2, data=found.data)


def change(table: xr.Dataset, metric: str, place: str, statistic: str = "mean") -> str:
    """Return by how many per cent a mean differs from the baseline's, ~ where its 95 % interval holds 0.

    It is the value itself where the baseline has next to nothing.
    """
    own = table.sel(metric=metric, statistic=statistic)
    base = float(own["value"].sel(gains=table.attrs["baseline"]))
    if not abs(base) >= LEAST:
        return number(float(own["value"].sel(gains=place)))
    text = f"{100 * float(own['difference'].sel(gains=place)) / base:+.0f}"
    if text in ("+0", "-0"):
        return "0"
    return text if bool(own["real"].sel(gains=place)) else f"~{text}"


def losses_table(found: Degraded, compared: Degradation) -> Table:
    """Return each gains' change, in per cent, against their own walks as drawn, and how many walks are lost."""
    about, settings, members = found.problem.metrics, [*compared.lead], found.data.sizes["member"]
    sections = []
    for metric in (name for name in METRICS if name in about.names):
        rows = []
        for name, table in compared.losses.items():
            base = number(float(table["value"].sel(metric=metric, statistic="mean", gains=AS_DRAWN)))
            rows.append([about.in_words(metric), name, base, *(change(table, metric, each) for each in settings[1:])])
        sections.append(("", rows))
    lost = []
    for name, table in compared.losses.items():
        share = table["value"].sel(metric="failed", statistic="mean")
        lost.append(
            [f"lost of {members}", name, *(f"{float(share.sel(gains=each)) * members:.0f}" for each in settings)]
        )
    caption = "Against their own walks as drawn, %; ~: the interval holds 0"
    return Table(caption, ["metric", "gains", *settings], [*sections, ("", lost)])


def lead_table(found: Degraded, compared: Degradation) -> Table:
    """Return each gains' difference from the best rival in the same setting, in per cent."""
    about, sections = found.problem.metrics, []
    others = [name for name in compared.losses if name != compared.baseline]
    for metric in (name for name in METRICS if name in about.names):
        cells = [[change(table, metric, name) for table in compared.lead.values()] for name in others]
        sections.append(("", [[about.in_words(metric), name, *own] for name, own in zip(others, cells, strict=True)]))
    caption = f"Against {compared.baseline} on the same hardware, %; ~: the interval holds 0"
    return Table(caption, ["metric", "gains", *compared.lead], sections)


def in_words(found: Degraded, compared: Degradation) -> str:
    """Return in a sentence how the first gains do beside their best rival, as drawn and in each setting."""
    means = compared.lead[AS_DRAWN]["value"].sel(statistic="mean")
    walked = verdicts.by_lost_walks(means.sel(metric=VARIATION), means.sel(metric="failed"))
    name, what = next(iter(walked)), f"mean {found.problem.metrics.in_words(VARIATION)} as drawn"
    said = verdicts.against_best(name, walked, what, "N", breaks="loses more walks")
    standing = {setting: paired.standing(table, name, VARIATION) for setting, table in compared.lead.items()}
    for words, place in {f"{name} is ahead": 1, f"{name} is behind": -1, "cannot be told apart": 0}.items():
        there = [setting for setting, own in standing.items() if own == place]
        said += f"; {words}: {', '.join(there)}" if there else ""
    return f"{said}; {_loss_in_words(name, compared.losses[name], found.data.sizes['member'])}"


def _loss_in_words(name: str, table: xr.Dataset, members: int) -> str:
    """Return which setting takes most from gains, and in which they lose most walks."""
    own, lost = (table.sel(metric=metric, statistic="mean") for metric in (VARIATION, "failed"))
    risen = own["difference"].where(own["real"], 0.0)
    worst, most = str(risen["gains"].values[risen.values.argmax()]), int(lost["value"].values.argmax())
    taken = f"no rise of the force variation of {name} can be told"
    if float(risen.max()) > 0:
        before, after = (number(float(own["value"].sel(gains=each))) for each in (AS_DRAWN, worst))
        taken = f"the force variation of {name} rises most with {worst}, from {before} to {after} N"
    count = round(float(lost["value"][most]) * members)
    if not count:
        return f"{taken}; {name} loses no walk in any setting, of {members} in each"
    return f"{taken}; {name} loses most walks: {lost['gains'].values[most]}, {count} of {members}"


def _plain(compared: Degradation) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Return the means and shares of lost walks by gains, setting and metric."""
    found: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for name, table in compared.losses.items():
        own = table["value"].sel(statistic="mean")
        metrics = [str(metric) for metric in own["metric"].values if metric != "objective"]
        found[name] = {
            "mean": {each: {m: float(own.sel(metric=m, gains=each)) for m in metrics} for each in compared.lead}
        }
    return found


@plots.style()
def plot_degraded(walks: xr.Dataset) -> Figure:
    """Draw the mean force variation of each gains in each setting."""
    settings, names = walks["setting"].values.tolist(), walks["gains"].values.tolist()
    figure = Figure(figsize=(plots.COLUMN, 0.9 + 0.28 * len(settings)), layout="constrained")
    axes, (factor, label) = figure.subplots(), scaled(walks["force_variation"])
    means = factor * walks["force_variation"].mean("member")
    handles = []
    for number_, name in enumerate(names):
        color, marker = f"C{number_}", "oDs^vP"[number_ % 6]
        axes.plot(means.sel(gains=name).values, range(len(settings)), marker, color=color, ms=4)
        handles.append(plots.key(name, color=color, marker=marker, ms=4, ls=""))
    axes.set_yticks(range(len(settings)), settings)
    axes.invert_yaxis()
    axes.set_xlabel(f"mean {label}")
    plots.legend(figure, handles)
    return figure
