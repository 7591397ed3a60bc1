"""`mjx-climb judge`: gains on many walks that no search has seen."""

import shlex
import time
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mjx_climb.scenario import shipped
from tuning.command_line import completion, launcher, options, processes
from tuning.command_line.ending import InputError, kept_in

if TYPE_CHECKING:
    from rich.console import Console

    import mjx_climb as mc
    from tuning.output.judged import Judged, Verdict


def judge(
    config: options.Config,
    gains: Annotated[
        list[Path],
        typer.Option("--gains", metavar="FILE", help="Gains file to judge; may be given several times."),
    ],
    ensemble: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="What the walks may meet: a YAML file, or ensemble, which comes with the program.",
            autocompletion=completion.ensemble,
        ),
    ] = Path("ensemble"),
    members: Annotated[int, typer.Option(min=1, max=100_000, metavar="N", help="Walks of each set of gains.")] = 128,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-judge"),
    ] = None,
    shard: options.Shard = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Judge gains on walks that no search over the ensemble has seen, beside the config's own and pd.

    As tune --ensemble judges its result: pushes, cargo, slope, grips, masses and hardware are drawn with another seed,
    nothing is torn off, and a walk fails where it pulls beyond the holding limit. Prints mean and worst 5 % of each
    metric; writes to DIR every walk (judged.nc), a picture, the summary and a page. `mjx-climb plot DIR` draws other
    metrics.

    Finished parts are kept in DIR: the same command goes on where it stopped. With --shard, or as a task of a Slurm
    array, the members are spread over machines, and `mjx-climb merge DIR` writes what one machine would have written.

    \b
    Examples:
      mjx-climb judge case_1_2 --gains results/case_1_2-tune/gains.yaml --members 512
      mjx-climb judge case_2 --gains a.yaml --gains b.yaml --ensemble mine.yaml --members 100000 --shard 3/16
    """
    with processes.joined(apart=shard is not None) as team, options.reserved_stdout() as stdout:
        part, which = launcher.shard_from(shard)
        from tuning.command_line import progress, report
        from tuning.output import judged
        from tuning.output.folder import check_own
        from tuning.problem import ensemble as ensembles
        from tuning.searches import finished_parts, shards

        begin = time.perf_counter()
        scenario, user_law, table = options.asked(config, controller, changes, hardware, law, metric)
        if user_law is None and scenario.control.controller == "pd":
            raise InputError("--controller: expected a law whose gains are judged, got pd, which walks beside them")
        rivals = judged.rivals(scenario, _named(gains, user_law), user_law)
        drawn = ensembles.load(shipped.found(ensemble), members=members)
        formats = options.figures_from(figures)
        draw = judged.draw_of(scenario, rivals, drawn, user_law, table, options.engine_from(engine))
        out = team.folder(out or Path("results") / f"{config.stem}-judge")
        check_own(out, "judged.nc")
        one = None if part is None else shards.made(*part)
        if one is None:
            parts, rows = finished_parts.Parts(out, draw.identity()), range(members)
        else:
            parts, rows = shards.claim(draw, out, one), one.rows(members)
            told = {"again": options.typed_but("--shard", shards.SHARD), "name": config.stem}
            judged.keep_beside(one, out, draw, drawn, told)
        there = shards.there(draw, parts, rows)
        console = report.console(stderr=True)
        text = f"{len(rows)} members, {len(rivals) + 1} walks of {scenario.steps} steps each"
        said = [which, team.said, f"{there} are there already" if there else ""]
        console.print("; ".join([text, *filter(None, said)]), soft_wrap=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)
        place = out if one is None else one.folder(out)
        team.begin(place, scenario)
        with kept_in(place, f"of {len(rows)} members", there) as kept:
            with meter.stage("fresh draw", unit="members") as show:
                arrays = shards.walk(draw, parts, kept.told(show), one)
            if one is not None:
                text = f"{place} is whole; once all {one.count} are: mjx-climb merge {shlex.quote(str(out))}"
                console.print(text, soft_wrap=True)
                if json:
                    print(dumps({"shard": one.number, "of": one.count, "members": len(rows)}), file=stdout)
                return
            found = judged.Judged(draw.dataset(arrays), scenario, drawn, table, user_law)
            again = "the same command, with config.yaml and --ensemble ensemble.yaml"
            verdict = found.write(out, origin=options.origin(config.stem, again), figures=formats, stage=meter.stage)
        print_verdict(found, verdict, console if json else report.console(file=stdout))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {judged.FILES}", soft_wrap=True)
        if json:
            print(verdict.summary, file=stdout)


def print_verdict(found: "Judged", verdict: "Verdict", console: "Console") -> None:
    """Print the table of what was judged, and the sentence."""
    from tuning.command_line import report
    from tuning.report.robust import judged_table

    console.print(report.from_page(judged_table(verdict.summed, found.metrics)))
    console.print(verdict.sentence, soft_wrap=True)


def _named(files: list[Path], law: "mc.Law | None") -> dict[str, Any]:
    """Return the gains of some files by the files' names.

    Raises:
        InputError: two of one name, or one that is taken.
    """
    named: dict[str, Any] = {}
    for file in files:
        if file.stem in named or file.stem in ("config", "pd"):
            raise InputError(f"--gains: expected files of different names, none config or pd, got {file.stem!r} again")
        named[file.stem] = options.gains_from(file, law)
    return named
