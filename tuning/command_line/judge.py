"""`mjx-climb judge`: gains on many walks that no search has seen."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mjx_climb.scenario import shipped
from tuning.command_line import launcher, processes
from tuning.command_line.ending import InputError, kept_in
from tuning.command_line.from_models import command
from tuning.command_line.options import ENSEMBLE, SHARD, Output, Walk
from tuning.command_line.rows import Rows
from tuning.command_line.typed import origin
from tuning.problem.search import Judge
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.searches.judge import Draw


class Rivals(Options):
    """Which gains are judged, on what."""

    gains: tuple[Path, ...] = setting(..., "gains file to judge", metavar="FILE")
    ensemble: Path = setting(Path("ensemble"), ENSEMBLE, metavar="FILE", complete="ensemble")
    shard: str | None = SHARD

    def draw(self, walk: Walk, members: int) -> "Draw":
        """Return the walks of the gains.

        Raises:
            ConfigError, InputError: options that cannot be used.
        """
        from tuning.gains import gains_file
        from tuning.problem.ensemble import Ensemble
        from tuning.problem.evaluation import Problem
        from tuning.searches.judge import draw_of

        loaded = walk.load()
        if loaded.law is None and loaded.scenario.control.controller == "pd":
            raise InputError("--controller: expected a law whose gains are judged, got pd, which walks beside them")
        named = {file.stem: gains_file.load(file, loaded.law) for file in self.gains}
        if len(named) < len(self.gains) or named.keys() & {"config", "pd"}:
            got = ", ".join(file.stem for file in self.gains)
            raise InputError(f"--gains: expected files of different names, none config or pd, got {got}")
        ensemble = Ensemble.load(shipped.found(self.ensemble))
        return draw_of(Problem(loaded.scenario, **loaded.how), named, ensemble, members)


def judge(rivals: Rivals, fresh: Judge, walk: Annotated[Walk, "-gains"], output: Output) -> None:
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
    with processes.joined(apart=rivals.shard is not None) as team, output.session() as shell:
        part, which = launcher.shard_from(rivals.shard)
        from tuning.output.folder import check_own

        draw = rivals.draw(walk, fresh.members)
        out = team.folder(output.folder(walk.config.stem, "judge"))
        check_own(out, "judged.nc")
        scenario = draw.problem.scenario
        rows = Rows(draw, out, part, walk.config.stem)
        text = f"{rows.here} members, {len(draw.gains) + 1} walks of {scenario.steps} steps each"
        shell.say("; ".join(filter(None, [text, which, team.said, rows.kept_already])))
        shell.opening(scenario)
        team.begin(rows.folder, scenario)
        with kept_in(rows.folder, f"of {rows.here} members", rows.there) as kept:
            arrays = rows.walk(shell, kept, "fresh draw", "members")
            if arrays is None:
                return
            made = origin(walk.config.stem, "the same command, with config.yaml and --ensemble ensemble.yaml")
            written = draw.result(arrays).write(out, origin=made, figures=output.figures, stage=shell.stage)
        shell.result(out, draw.problem, written)


COMMAND = command(judge, "results/<config>-judge")
