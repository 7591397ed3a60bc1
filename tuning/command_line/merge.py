"""`mjx-climb merge`: what shards walked, put together."""

from pathlib import Path

from tuning.command_line.ending import InputError
from tuning.command_line.from_models import command
from tuning.command_line.options import LAW, METRICS, Output, own_objects
from tuning.command_line.typed import origin
from tuning.problem.settings import Options, setting


class Merge(Options):
    """What is put together."""

    folders: tuple[Path, ...] = setting(
        ..., "the shards' folders, or one that holds them all", metavar="FOLDER...", argument=True
    )
    law: str | None = LAW
    metrics: tuple[str, ...] = METRICS


def merge(asked: Merge, output: Output) -> None:
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
    with output.session() as shell:
        from tuning.output.folder import check_own
        from tuning.searches import judge, shards

        law, table = own_objects(asked.law, asked.metrics)
        kept = shards.find(asked.folders)
        target = output.out or shards.home(kept)
        if target is None:
            raise InputError("--out: expected a folder for the result, as the shards lie in several places")
        check_own(target, "judged.nc" if kept[0].identity["kind"] == judge.KIND else "sweep.nc")
        about = kept[0].about
        made = origin(about.get("name", "the scenario"), about.get("repeat") or "the same command")
        found = shards.merged(kept, law, table)
        written = found.write(target, origin=made, figures=output.figures, stage=shell.stage)
        shell.result(target, found.problem, written, before=f"{len(kept)} shards, ")


COMMAND = command(merge, "that which holds the shards")
