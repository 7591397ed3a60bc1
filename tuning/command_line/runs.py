"""`mjx-climb runs`: the results below a folder, the differences of their settings, and their verdicts."""

from json import dumps
from pathlib import Path
from typing import Annotated

from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import Output
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting


class Place(Options):
    """Which results are listed."""

    folder: Path = setting(Path("results"), "folder below which results lie", metavar="FOLDER", argument=True)


@command("What have I run, and what came of it?", "no page", {})
def runs(place: Place, output: Annotated[Output, "-figures", "-sections"]) -> None:
    """List the results below a folder, the newest first: time, folder, settings that differ, and verdict.

    Of settings those are shown that differ among the listed results: keys of the config among all, others
    among the results of one command. A verdict is that of the result's own page. A result that is not finished is
    listed as such: the same command goes on with it.

    Reads the files of commands in their folders (settings.json, report.html, metrics.json) and walks nothing. --out
    writes runs.html, a page with the table and a link to each result's page.

    \b
    Examples:
      mjx-climb runs
      mjx-climb runs results/servos --out results
      mjx-climb runs --json
    """
    with output.session() as shell:
        from tuning.pages import runs as pages
        from tuning.pages.table import Table
        from tuning.results.result import RESULTS

        if not place.folder.is_dir():
            raise InputError(f"{place.folder}: expected a folder with results below it, got none")
        found = pages.below(place.folder, interruption.check)
        if not found:
            raise InputError(f"{place.folder}: expected results below it ({', '.join(RESULTS)}), got none")
        rows = [[f"{run.when:%Y-%m-%d %H:%M}", run.name, run.differs, run.said] for run in found]
        shell.show(Table("", ["when", "folder", "differs in", "verdict"], [("", rows)], 4))
        if output.out is not None:
            shell.say(f"written to {pages.write(found, place.folder, output.out)}")
        shell.print_json(dumps([run.plain for run in found], indent=1))
