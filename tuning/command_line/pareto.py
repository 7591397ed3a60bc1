"""`mjx-climb pareto`: what one metric costs in terms of another."""

from typing import Annotated

from tuning.command_line import processes
from tuning.command_line.ending import kept_in
from tuning.command_line.from_models import command
from tuning.command_line.options import Output, SearchFile, Walk
from tuning.command_line.typed import origin, repeated
from tuning.problem.search import Pareto, Search, check_metrics


def pareto(
    asked: Pareto, space: Annotated[Search, "space"], file: SearchFile, walk: Annotated[Walk, "-gains"], output: Output
) -> None:
    """Search the Pareto front of two metrics, by gradients under a row of limits, all in one batch.

    Prints the front and its knee, the point furthest from the line between the front's ends, and writes to DIR the
    front with its gains and everything that was walked (front.nc), a picture (front.png), the gains at
    the knee (gains.yaml), the front as JSON (summary.json), and all of it as a page for a browser (report.html).
    Finished rounds are kept: after Ctrl-C the same command goes on.

    METRIC is any number that run prints, detached_at apart, or one of --metric.

    \b
    Examples:
      mjx-climb pareto case_1_2
      mjx-climb pareto case_2 --against cost_of_transport --space split
    """
    with output.session() as shell:
        processes.start_devices()
        from tuning.command_line import report
        from tuning.output.folder import check_own
        from tuning.report.pages import front_table
        from tuning.searches import pareto as fronts

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        for option, name in (("--better", asked.better), ("--against", asked.against)):
            check_metrics(Search(weights={name: 1.0}), loaded.metrics, option)
        out = output.folder(walk.config.stem, "pareto")
        check_own(out, "front.nc")
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, "--better"):
            problem = fronts.problem_of(loaded.scenario, wanted, asked, **loaded.how)
        with kept_in(out, "rounds") as kept:
            with shell.stage("front", unit="rounds") as show:
                found = fronts.run(problem, wanted, asked, out=out, progress=kept.rounds(show))
            again = repeated(["pareto", "--search", "search.yaml"], "--better", "--against", "--points", "--engine")
            written = found.write(
                out, origin=origin(walk.config.stem, again), figures=output.figures, stage=shell.stage
            )
        shell.show(report.from_page(front_table(found.data, found.knee, loaded.metrics)), *written.outcome)
        shell.written(out, written.files, written.summary)


COMMAND = command(pareto, "results/<config>-pareto")
