"""`mjx-climb reproduce`: the paper's cases, its numbers beside ours, and what becomes of its claims."""

from typing import TYPE_CHECKING, Annotated

from tuning.command_line.from_models import command
from tuning.command_line.interruption import Interrupted
from tuning.command_line.options import Output
from tuning.command_line.program import origin

if TYPE_CHECKING:
    from rich.console import Console

    from tuning.reproduce.results import Found


@command("results/reproduce")
def reproduce(output: Annotated[Output, "out", "json_only"]) -> None:
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
    with output.session() as shell:
        from mjx_climb.files import dataset
        from tuning.command_line.session import WIDTH, console
        from tuning.report import page
        from tuning.report.numbers import to_json
        from tuning.reproduce import results

        out = shell.claim("reproduce.json", "reproduce")
        shell.opening()
        try:
            found = dict(results.reproduced(out, shell.stage))
            text = to_json(results.as_json(found))
            dataset.write_text_atomically(out / "reproduce.json", text + "\n")
            dataset.write_text_atomically(out / "paper.md", results.as_markdown(found))
            with (captured := console()).capture() as capture:
                captured.width = WIDTH
                show(found, captured)
            dataset.write_text_atomically(out / "tables.txt", capture.get())
            with shell.stage("report", compiles=False):
                made = results.page(found, out, origin("the paper's cases", "mjx-climb reproduce --out again"))
                page.write(made, out)
        except KeyboardInterrupt:
            count = len(list(out.glob("*.nc")))
            raise Interrupted(f"{count} walks are in {out}; the same command starts again") from None

        show(found, shell.tables)
        files = "report.html, reproduce.json, tables.txt, paper.md, figures (.png), scenarios (.yaml)"
        shell.written(f"{files}, {len(list(out.glob('*.nc')))} walks (.nc)", text)


def show(found: "Found", console: "Console") -> None:
    """Print the tables and sentences."""
    from rich import box
    from rich.table import Table

    from tuning.reproduce import results

    for made in results.tables(found):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for number, name in enumerate(made.columns):
            words = number == 0 or name == "unit"
            header, whole = name if number == 0 else name.replace(" ", "\n"), number > 0 or bool(made.sections[0][0])
            table.add_column(header, justify="left" if words else "right", no_wrap=whole)
        for heading, rows in made.sections:
            if heading:
                table.add_row(heading.split(":")[0], end_section=False, style="bold")
            for row in rows:
                table.add_row(*row, end_section=row is rows[-1])
        console.print(table)
    for line in results.overall(found):
        console.print(line)
    console.print()
    for heading, said in results.sentences(found).items():
        console.print(heading)
        for sentence in said:
            console.print(f"  {sentence}")
        console.print()
