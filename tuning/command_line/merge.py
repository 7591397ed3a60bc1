"""`mjx-climb merge`: what shards walked, put together."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError


def merge(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="The shards' folders, or one that holds them all.")
    ],
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="that which holds the shards"),
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
) -> None:
    """Put the shards of a sweep or of judge together, and write what one machine would have written.

    On CPUs sweep.nc and judged.nc are the same files, bit for bit. What stands beside a grid walks here: best, config's
    own and pd. Shards of different settings, files or versions are refused; of one that died it is said which walks are
    missing and which command finishes it. The shards stay as they are. Of a law or metrics of one's
    own the files are run that the shards took along, unless they are given again.

    \b
    Examples:
      mjx-climb merge results/case_1_2-sweep
      mjx-climb merge node1/shard-1-of-2 node2/shard-2-of-2 --out results/both
    """
    with options.reserved_stdout() as stdout:
        from tuning.command_line import progress, report
        from tuning.command_line.judge import print_verdict
        from tuning.command_line.sweep import print_result
        from tuning.output import judged, swept
        from tuning.output.folder import check_own
        from tuning.searches import draw, shards

        begin = time.perf_counter()
        formats = options.figures_from(figures)
        user_law, table = options.own_law(law), options.metrics_from(metric)
        kept = shards.find(folders)
        target = out or shards.home(kept)
        if target is None:
            raise InputError("--out: expected a folder for the result, as the shards lie in several places")
        judging = kept[0].identity["kind"] == draw.KIND
        check_own(target, "judged.nc" if judging else "sweep.nc")
        console, stage = report.console(stderr=True), progress.Meter(report.console(stderr=True)).stage
        tables, about = console if json else report.console(file=stdout), kept[0].about
        origin = options.origin(about.get("name", "the scenario"), about.get("repeat", "the same command"))
        how: dict[str, Any] = {"origin": origin, "figures": formats, "stage": stage}
        if judging:
            walks = judged.merged(kept, user_law, table)
            verdict = walks.write(target, **how)
            print_verdict(walks, verdict, tables)
            files, summary = judged.FILES, verdict.summary
        else:
            found = swept.merged(kept, user_law, table)
            compared = found.write(target, **how)
            print_result(found, compared, tables)
            files, summary = swept.FILES, compared.summary
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"{len(kept)} shards, written to {target} in {seconds}: {files}", soft_wrap=True)
        if json:
            print(summary, file=stdout)
