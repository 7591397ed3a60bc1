"""`mjx-climb merge`: what shards walked, put together."""

import time
from pathlib import Path
from typing import Annotated

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
    """Put the shards of a sweep together, and write what one machine would have written.

    On CPUs the grid (sweep.nc) is the same file, bit for bit. The walks beside it are walked here: best, config's own
    and pd. Shards of different settings, files or versions are refused, and of one that died it is said which walks are
    missing and which command finishes it. The shards stay as they are. A law or metrics of one's own are given again.

    \b
    Examples:
      mjx-climb merge results/case_1_2-sweep
      mjx-climb merge node1/shard-1-of-2 node2/shard-2-of-2 --out results/both
    """
    with options.reserved_stdout() as stdout:
        from mjx_climb.files import dataset
        from tuning.command_line import progress, report
        from tuning.command_line.sweep import print_result
        from tuning.output import swept
        from tuning.searches import shards

        begin = time.perf_counter()
        formats = options.figures_from(figures)
        user_law, table = options.own_law(law), options.metrics_from(metric)
        kept = shards.find(folders)
        target = out or shards.home(kept)
        if target is None:
            raise InputError("--out: expected a folder for the result, as the shards lie in several places")
        dataset.check_folder(target)
        found = swept.merged(kept, user_law, table)
        console = report.console(stderr=True)
        about = kept[0].about
        console.print(f"{found.data['diverged'].size} walks of {kept[0].shard.count} shards", soft_wrap=True)
        origin = options.origin(about.get("name", "the scenario"), about.get("repeat", "tuning.sweep(...)"))
        judged = found.write(target, origin=origin, figures=formats, stage=progress.Meter(console).stage)
        print_result(found, judged, console if json else report.console(file=stdout))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {target} in {seconds}: {swept.FILES}", soft_wrap=True)
        if json:
            print(judged.summary, file=stdout)
