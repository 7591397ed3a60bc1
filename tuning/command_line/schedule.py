"""`mjx-climb schedule`: which gains to load when."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

from tuning.command_line import processes
from tuning.command_line.ending import kept_in
from tuning.command_line.from_models import command
from tuning.command_line.options import Output, SearchFile, Walk
from tuning.problem.search import Schedule, Search

if TYPE_CHECKING:
    from rich.table import Table


def schedule(
    asked: Schedule,
    space: Annotated[Search, "space"],
    file: SearchFile,
    walk: Annotated[Walk, "-gains"],
    output: Output,
) -> None:
    """Tune gains for every pair of gravity and cargo, all side by side in one batch.

    The config's gravity gives the direction, its cargo the time of loading. Prints the gains and what they change
    against pd, and against pd with kp and kd of its own for each pair, and writes to DIR the table (schedule.csv,
    schedule.yaml), all metrics and what the gains of one operating point are worth at another (schedule.nc), and a
    picture (schedule.png). Finished rounds are kept: after Ctrl-C the same command goes on.

    \b
    Examples:
      mjx-climb schedule case_1_2
      mjx-climb schedule case_2 --gravity 1e-6,1e-3,1 --cargo 0,1.5 --space split
    """
    with output.session() as shell:
        processes.start_devices()
        from tuning.output.folder import check_own
        from tuning.report.numbers import to_json
        from tuning.searches import schedule as schedules

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        out = output.folder(walk.config.stem, "schedule")
        check_own(out, "schedule.nc")
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, walk.config):
            points = schedules.operating_points(loaded.scenario, wanted, asked, **loaded.how)
        with kept_in(out, "rounds") as kept:
            with shell.stage("schedule", unit="rounds") as show:
                found = schedules.run(points, out=out, progress=kept.rounds(show))
            written = found.write(out, figures=output.figures, stage=shell.stage)
        rows = schedules.rows(found.data)
        table = schedule_table(rows, found.data.attrs["searched"].split())
        shell.show(table, *written.outcome, _one_for_all(*schedules.one_for_all(found.data)))
        shell.written(out, written.files, to_json(rows))


def _one_for_all(level: float, load: float, loss: float) -> str:
    if loss < math.inf:
        return f"one for all: the gains of {level:g} G, {load:g} kg lose at most {loss:.3f} of pd's objective"
    return "one for all: every set of gains breaks a limit at some other operating point"


def schedule_table(rows: list[dict[str, Any]], gains: Sequence[str]) -> "Table":
    """Return the table of a schedule: the gains that were searched, and force variation against pd."""
    from tuning.command_line.report import plain_table
    from tuning.report.numbers import change, gain, number
    from tuning.searches.retuned_pd import NAME

    beside = ("variation\nN", "vs\nconfig %", "vs\nretuned %", "vs\npd %")
    table = plain_table("gravity\nG", "cargo\nkg", *gains, *beside, "")
    table.columns[-1].no_wrap = False  # words give way to numbers
    for row in rows:
        tuned, *others = (row["force_variation"][walk] for walk in ("tuned", "config", NAME, "pd"))
        cells = [f"{row['gravity_g']:.3g}", f"{row['cargo_kg']:.3g}", *(gain(row, name) for name in gains)]
        verdict = "" if row["feasible"] else "breaks limits"
        verdict += f" {row['on_bound']} on a bound" if row["on_bound"] else ""
        table.add_row(*cells, number(tuned), *(change(tuned, other) for other in others), verdict.strip())
    return table


COMMAND = command(schedule, "results/<config>-schedule")
