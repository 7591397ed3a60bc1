"""`mjx-climb reproduce`: the paper's cases, its numbers beside ours, and what becomes of its claims."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from tuning.command_line import options
from tuning.command_line.ending import Interrupted

if TYPE_CHECKING:
    from rich.console import Console

    import mjx_climb as mc
    from tuning.command_line.progress import Meter
    from tuning.judged import paper

FIGURE = ("pd", "virtual_model", "measured_pose")  # the baseline and the proposed controller
READS = {"virtual_model": "virtual model", "measured_pose": "measured pose"}


class Reproduction(NamedTuple):
    """The walks of one case and what they say."""

    published: "paper.Case"
    walks: "dict[str, paper.Walk]"  # by method
    metrics: dict[str, dict[str, Any]]  # by method; of the walk with the holding limit
    verdicts: "dict[str, dict[str, paper.Verdict]]"  # by reading and claim


class Grid(NamedTuple):
    """A table as text; sections are runs of rows with a heading."""

    columns: Sequence[str]
    sections: Sequence[tuple[str, Sequence[Sequence[str]]]]


def reproduce(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")] = Path("results/reproduce"),
    json: options.Json = False,
) -> None:
    """Walk the paper's three cases under every controller and compare with what the paper states.

    Runs pd, pd whose base reference follows the actual base, base admittance (Eq. 3) in both readings and
    end-effector admittance (Eq. 2), with the paper's gains and in double precision: a minute or two, of which the
    compiler takes most the first time. Where a gripper lets go, the walk is repeated with grippers that never do.

    Prints all metrics beside the paper's numbers, and for each claim whether it holds here. Writes to DIR all of it
    (report.html to look through in a browser, reproduce.json, tables.txt, paper.md), the baseline and the proposed
    controller over time (case_1_1.png, ...), the resolved scenarios (case_1_1.yaml, ...) and each walk
    (case_1_1-pd.nc, ..., 7 MB each, open with xarray).

    \b
    Examples:
      mjx-climb reproduce
      mjx-climb reproduce --out results/paper --json
    """
    with options.reserved_stdout() as stdout:
        import mjx_climb as mc
        from mjx_climb import plots
        from mjx_climb.files import dataset
        from mjx_climb.scenario import shipped
        from tuning.command_line import progress, report
        from tuning.judged import paper
        from tuning.output.folder import check_own
        from tuning.report import page
        from tuning.report import reproduce as pages

        begin = time.perf_counter()
        check_own(out, "reproduce.json")
        scenarios = {name: mc.load_scenario(shipped.config_path(case.config)) for name, case in paper.CASES.items()}
        for name, scenario in scenarios.items():
            dataset.write_text_atomically(out / f"{stem(name)}.yaml", scenario.to_yaml())

        console = report.console(stderr=True)
        progress.opening(console)
        meter = progress.Meter(console)
        found: dict[str, Reproduction] = {}
        count = 0
        try:
            for name, scenario in scenarios.items():
                walks = {}
                for method, (title, changes) in paper.METHODS.items():
                    label = f"case {name}, {title}"
                    walks[method] = walk = walked(scenario.with_overrides(changes), meter, label)
                    trajectories = {method: walk.trajectory, f"{method}-unlimited": walk.unlimited}
                    for key, trajectory in trajectories.items():
                        if trajectory is not None:
                            dataset.save(dataset.to_dataset(trajectory), out / f"{stem(name)}-{key}.nc")
                            count += 1
                metrics = {method: mc.metrics(walk.trajectory) for method, walk in walks.items()}
                case = paper.CASES[name]
                found[name] = Reproduction(case, walks, metrics, paper.judge_all(walks, case))
                compared = {paper.METHODS[method].title: walks[method].trajectory for method in FIGURE}
                figure = plots.plot_comparison(compared, f"Case {name}: {case.title}")
                plots.save_figure(figure, out / stem(name))
            text = report.to_json({"cases": {name: as_json(case) for name, case in found.items()}})
            dataset.write_text_atomically(out / "reproduce.json", text + "\n")
            dataset.write_text_atomically(out / "paper.md", as_markdown(found))
            with (captured := report.console()).capture() as capture:
                captured.width = report.WIDTH
                show(found, captured)
            dataset.write_text_atomically(out / "tables.txt", capture.get())
            with meter.stage("report", compiles=False):
                written = pages.page(
                    {name: case.walks for name, case in found.items()},
                    {name: case.metrics for name, case in found.items()},
                    {name: case.verdicts for name, case in found.items()},
                    [
                        page.Table("Metrics beside the paper's numbers", *metrics_grid(found)),
                        page.Table("The paper's claims, and the change of what each is about", *claims_grid(found), 1),
                    ],
                    overall(found),
                    {heading.capitalize(): said for heading, said in sentences(found).items()},
                    origin=options.origin("the paper's cases", "mjx-climb reproduce --out again")._replace(
                        config="\n".join(f"# case {name}\n{scenario.to_yaml()}" for name, scenario in scenarios.items())
                    ),
                    pictures={
                        f"Case {name}: {case.title}; baseline and both readings of Eq. 3.": out / f"{stem(name)}.png"
                        for name, case in paper.CASES.items()
                    },
                )
                page.write(written, out)
        except KeyboardInterrupt:
            raise Interrupted(f"{count} walks are in {out}; the same command starts again") from None

        show(found, console if json else report.console(file=stdout))
        console.print(
            f"written to {out} in {progress.duration(time.perf_counter() - begin)}: report.html, reproduce.json, "
            f"tables.txt, paper.md, figures (.png), scenarios (.yaml), {count} walks (.nc)",
            soft_wrap=True,
        )
        if json:
            print(text, file=stdout)


def stem(case: str) -> str:
    """Return what the files of a case begin with."""
    return f"case_{case.replace('.', '_')}"


def walked(scenario: "mc.Scenario", meter: "Meter", label: str) -> "paper.Walk":
    """Walk a scenario and, if a gripper lets go, once more with grippers that never do."""
    import mjx_climb as mc
    from tuning.judged import paper

    with meter.stage(label):
        trajectory = mc.rollout(scenario)
    if not trajectory.torn_off.any():
        return paper.Walk(trajectory)
    with meter.stage(f"{label}, grippers that never let go"):
        return paper.Walk(trajectory, mc.rollout(scenario.with_overrides({"contact.holding_limit": None})))


# ------------------------------------------------------------------------------------------------------------
# What was found, for machines and for people


def as_json(found: Reproduction) -> dict[str, Any]:
    """Return one case as plain values."""
    import mjx_climb as mc
    from tuning.judged import paper

    runs = {}
    for method, walk in found.walks.items():
        control = walk.trajectory.scenario.control
        runs[method] = {
            "controller": control.controller,
            "reading": control.reading if control.controller == "base_admittance" else None,
            "base_reference": walk.trajectory.scenario.gait.base_reference,
            "gains": None
            if control.controller == "pd"
            else {name: getattr(control, name) for name in ("inertia", "damping", "stiffness")},
            "metrics": found.metrics[method],
            "metrics_without_detachment": None if walk.unlimited is None else mc.metrics(walk.unlimited),
        }
    claims = [
        {"claim": name, "text": claim_text(name), "reading": reading, **verdict._asdict()}
        for reading, verdicts in found.verdicts.items()
        for name, verdict in verdicts.items()
    ]
    case = found.published
    published = {
        "cost_of_transport": paper.before_and_after([case.baseline_cost, case.proposed_cost]),
        "baseline_detaches": case.baseline_fails,
        "claims": {name: claim.text for name, claim in paper.CLAIMS.items()},
    }
    return {"title": case.title, "paper": published, "runs": runs, "claims": claims}


def claim_text(name: str) -> str:
    """Return a claim in words."""
    from tuning.judged import paper

    if name == "detachment_actual":
        return f"{paper.CLAIMS['detachment'].text} (base reference from the actual base)"
    return paper.CLAIMS[name].text


def metrics_grid(found: Mapping[str, Reproduction]) -> Grid:
    """Return all metrics of all walks, with the paper's numbers."""
    from tuning.command_line import report
    from tuning.judged import paper

    columns = ["metric", "unit", "paper, baseline", "paper, proposed", *(m.title for m in paper.METHODS.values())]
    sections = []
    for name, case in found.items():
        rows = []
        for metric in case.metrics[paper.BASELINE]:
            stated = ["", ""]
            if metric == "cost_of_transport":
                values = (case.published.baseline_cost, case.published.proposed_cost)
                stated = ["" if value is None else _short(value) for value in values]
            if metric == "detached_at":
                stated = ["fails", "holds"] if case.published.baseline_fails else ["", ""]
            cells = [_cell(metric, metrics) for metrics in case.metrics.values()]
            rows.append([report.words(metric), report.unit(metric), *stated, *cells])
        sections.append((f"case {name}: {case.published.title}", rows))
    return Grid(columns, sections)


def _cell(metric: str, metrics: Mapping[str, Any]) -> str:
    if metric == "detached_at" and metrics[metric] is None and not metrics["diverged"]:
        return "holds"
    return _short(metrics[metric])


def _short(value: float | str | None) -> str:
    from tuning.command_line import report

    return report.number(value).replace("e+0", "e")


def claims_grid(found: Mapping[str, Reproduction]) -> Grid:
    """Return for each claim whether it holds in each case and reading, with the change of its main quantity."""
    columns = ["claim", *(f"{case} {READS[reading]}" for case in found for reading in READS)]
    names = list(dict.fromkeys(n for case in found.values() for verdicts in case.verdicts.values() for n in verdicts))
    rows = []
    for name in names:
        cells = [case.verdicts[reading].get(name) for case in found.values() for reading in READS]
        rows.append([claim_text(name), *("-" if cell is None else _word(cell) for cell in cells)])
    return Grid(columns, [("", rows)])


def _word(verdict: "paper.Verdict") -> str:
    word = {True: "yes", False: "no", None: "-"}[verdict.holds]
    change = verdict.measured.get("change")
    if verdict.holds is None or change is None:
        return word
    # the base moves 20 times as far: a factor says more than per cent
    return f"{word}, x{change + 1:.3g}" if change > 2 else f"{word}, {100 * change:+.1f} %"


def overall(found: Mapping[str, Reproduction]) -> list[str]:
    """Return one line for each reading: which claims hold, and where."""
    from tuning.judged import paper

    lines = []
    for reading, title in READS.items():
        parts: dict[str, list[str]] = {"yes": [], "in part": [], "no": []}
        for name, claim in paper.CLAIMS.items():
            judged = {case: what.verdicts[reading][name].holds for case, what in found.items()}
            judged = {case: holds for case, holds in judged.items() if holds is not None}
            where = [case for case, holds in judged.items() if holds]
            if where:
                everywhere = len(where) == len(judged)
                only = "" if everywhere else f" (only in case{'s' * (len(where) > 1)} {' and '.join(where)})"
                parts["yes" if everywhere else "in part"].append(claim.text + only)
            elif judged:
                parts["no"].append(claim.text)
        lines.append(f"{title.capitalize()}: " + "; ".join(f"{k}: {', '.join(v)}" for k, v in parts.items() if v) + ".")
    return lines


def sentences(found: Mapping[str, Reproduction]) -> dict[str, list[str]]:
    """Return what is said of each claim, by case and reading."""
    return {
        f"case {case}, {READS[reading]}": [
            f"With the base reference from the actual base: {v.sentence[0].lower()}{v.sentence[1:]}"
            if name == "detachment_actual"
            else v.sentence
            for name, v in verdicts.items()
        ]
        for case, what in found.items()
        for reading, verdicts in what.verdicts.items()
    }


def show(found: Mapping[str, Reproduction], console: "Console") -> None:
    """Print the tables and sentences."""
    from rich import box
    from rich.table import Table

    for grid in (metrics_grid(found), claims_grid(found)):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for number, name in enumerate(grid.columns):
            words = number == 0 or name == "unit"
            name = name if number == 0 else name.replace(" ", "\n")
            table.add_column(
                name, justify="left" if words else "right", no_wrap=number > 0 or bool(grid.sections[0][0])
            )
        for heading, rows in grid.sections:
            if heading:
                table.add_row(heading.split(":")[0], end_section=False, style="bold")
            for row in rows:
                table.add_row(*row, end_section=row is rows[-1])
        console.print(table)
    for line in overall(found):
        console.print(line)
    console.print()
    for heading, said in sentences(found).items():
        console.print(heading.capitalize())
        for sentence in said:
            console.print(f"  {sentence}")
        console.print()


def as_markdown(found: Mapping[str, Reproduction]) -> str:
    """Return the tables and sentences as Markdown."""
    lines = []
    for grid in (metrics_grid(found), claims_grid(found)):
        for heading, rows in grid.sections:
            lines += [f"**{heading[0].upper()}{heading[1:]}**", ""] if heading else []
            lines += [_row(grid.columns), _row(["---"] * len(grid.columns)), *map(_row, rows), ""]
    lines += [*(f"- {line}" for line in overall(found)), ""]
    for heading, said in sentences(found).items():
        lines += [f"**{heading[0].upper()}{heading[1:]}**", "", *(f"- {sentence}" for sentence in said), ""]
    return "\n".join(lines)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
