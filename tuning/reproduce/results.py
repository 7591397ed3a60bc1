"""The results of a reproduction of the paper: walks, tables, sentences, and the page that shows them."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.scenario import shipped
from mjx_climb.viz import plots
from tuning.background import Stage
from tuning.numbers import number, unit
from tuning.pages.explorer import explorer
from tuning.pages.page import Findings, Origin, Page, Table
from tuning.reproduce import claims
from tuning.reproduce.claims import BASELINE, CASES, CLAIMS, METHODS, READINGS, Case, Verdict, Walk

FIGURE = ("pd", "virtual_model", "measured_pose")  # the baseline and the proposed controller
TITLES = {reading: METHODS[reading].title for reading in READINGS}


class Reproduction(NamedTuple):
    """The walks of one case and their verdicts."""

    published: Case
    walks: dict[str, Walk]  # by method
    metrics: dict[str, dict[str, Any]]  # by method; of the walk with the holding limit
    verdicts: dict[str, dict[str, Verdict]]  # by reading and claim


Found = Mapping[str, Reproduction]  # by case


def scenarios() -> dict[str, mc.Scenario]:
    """Return the paper's cases by name."""
    return {name: mc.load_scenario(shipped.config_path(case.config)) for name, case in CASES.items()}


def stem(case: str) -> str:
    """Return the prefix of a case's files."""
    return f"case_{case.replace('.', '_')}"


def reproduced(folder: Path, stage: Stage) -> Iterator[tuple[str, Reproduction]]:
    """Walk case after case and write its scenario, walks and picture into a folder."""
    for name, scenario in scenarios().items():
        case, walks = CASES[name], {}
        dataset.write_text_atomically(folder / f"{stem(name)}.yaml", scenario.to_yaml())
        for method, what in METHODS.items():
            walks[method] = walk = walked(scenario.with_overrides(what.changes), stage, f"case {name}, {what.title}")
            for key, trajectory in {method: walk.trajectory, f"{method}-unlimited": walk.unlimited}.items():
                if trajectory is not None:
                    dataset.save(dataset.to_dataset(trajectory), folder / f"{stem(name)}-{key}.nc")
        compared = {METHODS[method].title: walks[method].trajectory for method in FIGURE}
        plots.save_figure(plots.plot_comparison(compared, f"Case {name}: {case.title}"), folder / stem(name))
        metrics = {method: mc.metrics(walk.trajectory) for method, walk in walks.items()}
        yield name, Reproduction(case, walks, metrics, claims.judge_all(walks, case))


def walked(scenario: mc.Scenario, stage: Stage, label: str) -> Walk:
    """Walk a scenario and, if a gripper lets go, once more with grippers that never do."""
    with stage(label):
        trajectory = mc.rollout(scenario)
    if not trajectory.torn_off.any():
        return Walk(trajectory)
    with stage(f"{label}, grippers that never let go"):
        return Walk(trajectory, mc.rollout(scenario.with_overrides({"contact.holding_limit": None})))


def as_json(found: Found) -> dict[str, Any]:
    """Return all cases as plain values."""
    cases: dict[str, Any] = {}
    for name, what in found.items():
        case, runs = what.published, {}
        for method, walk in what.walks.items():
            scenario = walk.trajectory.scenario
            control, law = scenario.control, scenario.control.controller
            runs[method] = {
                "controller": law,
                "reading": control.reading if law == "base_admittance" else None,
                "base_reference": scenario.gait.base_reference,
                "gains": None if law == "pd" else {name: getattr(control, name) for name in mc.Gains.AXES},
                "metrics": what.metrics[method],
                "metrics_without_detachment": None if walk.unlimited is None else mc.metrics(walk.unlimited),
            }
        paper = {
            "cost_of_transport": claims.Pair(case.baseline_cost, case.proposed_cost)._asdict(),
            "baseline_detaches": case.baseline_fails,
            "claims": {claim: CLAIMS[claim].text for claim in CLAIMS},
        }
        judged = [
            {"claim": claim, "text": claim_text(claim), "reading": reading, **verdict._asdict()}
            for reading, verdicts in what.verdicts.items()
            for claim, verdict in verdicts.items()
        ]
        cases[name] = {"title": case.title, "paper": paper, "runs": runs, "claims": judged}
    return {"cases": cases}


def claim_text(name: str) -> str:
    """Return a claim in words."""
    if name == "detachment_actual":
        return f"{CLAIMS['detachment'].text} (base reference from the actual base)"
    return CLAIMS[name].text


def tables(found: Found) -> tuple[Table, Table]:
    """Return all metrics of all walks beside the paper's numbers; and for each claim whether it holds in each case and
    reading, with the change of its main quantity."""
    columns = ["metric", "unit", "paper, baseline", "paper, proposed", *(m.title for m in METHODS.values())]
    sections = []
    for name, what in found.items():
        case, rows = what.published, []
        stated = {
            "cost_of_transport": ["" if c is None else _short(c) for c in (case.baseline_cost, case.proposed_cost)],
            "detached_at": ["fails", "holds"] if case.baseline_fails else ["", ""],
        }
        for metric in what.metrics[BASELINE]:
            cells = [_short(metrics[metric]) for metrics in what.metrics.values()]
            if metric == "detached_at":
                cells = ["holds" if cell == "-" and not metrics["diverged"] else cell
                         for cell, metrics in zip(cells, what.metrics.values(), strict=True)]  # fmt: skip
            rows.append([mc.METRICS.in_words(metric), unit(metric, mc.METRICS), *stated.get(metric, ["", ""]), *cells])
        sections.append((f"case {name}: {case.title}", rows))
    verdicts = {f"{name} {TITLES[r]}": case.verdicts[r] for name, case in found.items() for r in READINGS}
    names = dict.fromkeys(name for held in verdicts.values() for name in held)
    judged = [[claim_text(name), *(_word(held.get(name)) for held in verdicts.values())] for name in names]
    caption = "The paper's claims, and the change of what each is about"
    return (
        Table("Metrics beside the paper's numbers", columns, sections),
        Table(caption, ["claim", *verdicts], [("", judged)], 1),
    )


def _short(value: float | str | None) -> str:
    return number(value).replace("e+0", "e")


def _word(verdict: Verdict | None) -> str:
    if verdict is None or verdict.holds is None:
        return "-"
    word, change = "yes" if verdict.holds else "no", verdict.measured.get("change")
    if change is None:
        return word
    # the base moves 20 times as far: a factor says more than per cent
    return f"{word}, x{change + 1:.3g}" if change > 2 else f"{word}, {100 * change:+.1f} %"


def where(found: Found, reading: str, name: str) -> tuple[list[str], int]:
    """Return the cases where a claim holds, and the number of cases where it can be judged."""
    judged = {case: what.verdicts[reading][name].holds for case, what in found.items()}
    return [case for case, holds in judged.items() if holds], sum(holds is not None for holds in judged.values())


def overall(found: Found) -> list[str]:
    """Return one line for each reading: which claims hold, and where."""
    lines = []
    for reading, title in TITLES.items():
        parts: dict[str, list[str]] = {"yes": [], "in part": [], "no": []}
        for name, claim in CLAIMS.items():
            held, judged = where(found, reading, name)
            if held:
                only = "" if len(held) == judged else f" (only in case{'s' * (len(held) > 1)} {' and '.join(held)})"
                parts["in part" if only else "yes"].append(claim.text + only)
            elif judged:
                parts["no"].append(claim.text)
        lines.append(f"{title.capitalize()}: " + "; ".join(f"{k}: {', '.join(v)}" for k, v in parts.items() if v) + ".")
    return lines


def verdict(found: Found) -> str:
    """Return in one sentence how many claims hold in every case where they can be judged, by reading of Eq. 3."""
    parts = []
    for reading, title in TITLES.items():
        counts = [where(found, reading, name) for name in CLAIMS]
        everywhere = sum(bool(held) and len(held) == judged for held, judged in counts)
        somewhere = sum(0 < len(held) < judged for held, judged in counts)
        parts.append(
            f"read as a {title} {everywhere} hold wherever they can be judged and {somewhere} in some cases only"
        )
    return f"Of the paper's {len(CLAIMS)} claims about Eq. 3, {', and '.join(parts)}."


def sentences(found: Found) -> dict[str, list[str]]:
    """Return the sentence on each claim, by case and reading."""
    return {
        f"Case {case}, {TITLES[reading]}": [
            f"With the base reference from the actual base: {v.sentence[0].lower()}{v.sentence[1:]}"
            if name == "detachment_actual"
            else v.sentence
            for name, v in verdicts.items()
        ]
        for case, what in found.items()
        for reading, verdicts in what.verdicts.items()
    }


def lines(found: Found) -> list[str]:
    """Return the verdicts and the sentence on each claim, in lines for a terminal."""
    said = [[heading, *(f"  {sentence}" for sentence in each), ""] for heading, each in sentences(found).items()]
    return [*overall(found), "", *itertools.chain.from_iterable(said)]


def as_markdown(found: Found) -> str:
    """Return the tables and sentences as Markdown."""

    def row(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"

    lines = []
    for table in tables(found):
        for heading, rows in table.sections:
            lines += [f"**{heading[0].upper()}{heading[1:]}**", ""] if heading else []
            lines += [row(table.columns), row(["---"] * len(table.columns)), *map(row, rows), ""]
    lines += [*(f"- {line}" for line in overall(found)), ""]
    for heading, said in sentences(found).items():
        lines += [f"**{heading}**", "", *(f"- {sentence}" for sentence in said), ""]
    return "\n".join(lines)


def page(found: Found, folder: Path, origin: Origin) -> Page:
    """Return the page of a reproduction whose pictures are in a folder; `origin` is without the scenarios."""
    explorers = {
        f"Case {name}: {case.published.title}": explorer(
            {METHODS[method].title: walk.trajectory for method, walk in case.walks.items()},
            {METHODS[method].title: metrics for method, metrics in case.metrics.items()},
            shown=tuple(METHODS[method].title for method in FIGURE),
        )
        for name, case in found.items()
    }
    pictures = {
        f"Case {name}: {case.published.title}; baseline and both readings of Eq. 3.": folder / f"{stem(name)}.png"
        for name, case in found.items()
    }
    configs = [f"# case {name}\n{scenario.to_yaml()}" for name, scenario in scenarios().items()]
    return Page(
        title="The paper's three cases, walked again",
        origin=origin._replace(name="the paper's cases", config="\n".join(configs), pictures=pictures),
        findings=Findings(verdict(found), notes=overall(found)),
        scenario=next(iter(found.values())).walks[BASELINE].trajectory.scenario,
        explorers=explorers,
        tables=tables(found),
        prose=sentences(found),
        facts={"precision": "float64", "seed": "none: nothing is drawn at random"},
    )
