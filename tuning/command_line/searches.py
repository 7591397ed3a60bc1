"""`mjx-climb tune`, `pareto` and `schedule`: searches for gains."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjx_climb.scenario import shipped
from tuning.command_line import processes
from tuning.command_line.from_models import command
from tuning.command_line.interruption import Interrupted, kept_in
from tuning.command_line.options import ENSEMBLE, Output, SearchFile, Walk
from tuning.command_line.program import InputError, origin, repeated
from tuning.problem.search import ROBUST_WEIGHTS, Pareto, Schedule, Search, check_metrics
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from rich.table import Table

    from tuning.command_line.processes import Team
    from tuning.command_line.session import Session
    from tuning.problem.ensemble import Ensemble


class Many(Options):
    """The ensemble that gains are searched for."""

    ensemble: Path | None = setting(None, f"tune for {ENSEMBLE}", metavar="FILE", complete="ensemble")
    members: int | None = setting(None, "walks of the ensemble; null: the file's", ge=1)
    judges: int | None = setting(None, "walks of the fresh draw; null: 128", ge=1)

    def load(self) -> "Ensemble | None":
        """Return the ensemble, None without one."""
        from tuning.problem.ensemble import Ensemble

        if self.ensemble is None:
            for name in self.model_fields_set:
                raise InputError(f"--{name}: expected --ensemble with it")
            return None
        return Ensemble.load(shipped.found(self.ensemble), **self.model_dump(include={"members"}, exclude_unset=True))


@command("results/<config>-tune-<method>-<space>")
def tune(search: Search, file: SearchFile, ensemble: Many, walk: Walk, output: Output) -> None:
    """Search the gains of the controller, from the config's own gains and from random ones side by side.

    Minimises force variation, peak foot force and cost of transport, each relative to pd, while the grippers hold,
    the joints keep their limits, the base stays within three times pd's deviation, and nothing gets worse than under
    pd. With hardware in the loop kp and kd are searched too. Then walks the result in double precision, tests it, and
    compares it with the config's gains, pd, and pd with kp and kd searched for the same: what no force sensor gives.

    Writes to DIR the gains (gains.yaml, for run and sweep), everything judged (search.nc), the settings (config.yaml,
    search.yaml), the summary (summary.json), the map and the pictures (map.nc, convergence, path, walks, margins), and
    all of it to look through in a browser (report.html). Finished rounds are kept: after Ctrl-C, which ends with the
    best so far, or worse, the same command goes on.

    With --ensemble every set of gains walks through all members (pushes, cargo, slope, grip stiffness, robot mass drawn
    from a seed, and hardware where the file says so), mean and worst count, the peak pulling force with them, and a
    fresh draw judges the result, and says how many of its walks break each limit.

    \b
    METRIC: force_variation, peak_foot_force, peak_pull_force (N), peak_joint_torque (N m),
      cost_of_transport, travel, base_deviation, min_tsm (m), min_gia_margin (m/s^2),
      joint_limit_margin (rad); with --metric the user's own
    GAIN: damping, damping.translation, damping.rotation, damping.x .. damping.rz;
      stiffness and inertia likewise; kp, kd; with --law the law's own gains

    \b
    Examples:
      mjx-climb tune case_1_2
      mjx-climb tune case_2 --method gradient --space diagonal --limit base_deviation=0.015
      mjx-climb tune case_1_1 --method cmaes --space split --pin damping.rotation=50
      mjx-climb tune case_2 --ensemble ensemble --members 16
    """
    with processes.joined() as team, output.session() as shell:
        _tune(search, file, ensemble, walk, shell, team)


def _tune(search: Search, file: SearchFile, ensemble: Many, walk: Walk, shell: "Session", team: "Team") -> None:
    from tuning.background import background
    from tuning.output import comparisons, folder
    from tuning.searches import tune as searches

    loaded, drawn = walk.load_with_gains(), ensemble.load()
    if drawn is not None and "weights" not in search.model_fields_set and file.search is None:
        search = search.model_copy(update={"weights": ROBUST_WEIGHTS})
    wanted = file.settings(search, loaded, walk.config)
    if drawn is not None:
        wanted = searches.over_ensemble(wanted, {}, drawn)
    chosen = search.method if "method" in search.model_fields_set else None
    wanted = searches.for_this_machine(loaded.scenario, wanted, (file.search, chosen), walk.engine, loaded.law)
    kind, name = "tune" if drawn is None else "robust", walk.config.stem
    out = shell.claim("search.nc", name, kind, wanted.method, wanted.space, team=team)
    shell.opening(loaded.scenario)
    shell.say(*filter(None, [team.said]))
    team.begin(out, loaded.scenario.to_yaml())
    with shell.stage("baseline"), file.naming(search):
        problem = searches.problem_of(loaded.scenario, wanted, ensemble=drawn, **loaded.how)
    files = ["--search", "search.yaml", *([] if drawn is None else ["--ensemble", "ensemble.yaml"])]
    again, compared = repeated(["tune", *files], "--engine"), None
    with kept_in(out, "rounds") as kept, background(busy=1) as begin:
        begin(lambda _: folder.writer(kind))  # matplotlib takes half a second
        if drawn is None:
            comparisons.load_tests(problem, wanted, begin)
            compared = comparisons.of_search(problem, wanted, begin, out=out)
        with shell.stage("search", unit="rounds") as show:
            found: Any = searches.run(problem, wanted, out=out, progress=kept.rounds(show))
        if ensemble.judges is not None:
            found = dataclasses.replace(found, judges=ensemble.judges)
        if found.interrupted:
            found.write_found(out, origin(name, again))
            best = f"objective {found.value:.4f}, gains.yaml; the same command goes on from there"
            raise Interrupted(f"the best of {kept.done} rounds is in {out}: {best}")
        written = shell.write(found, again, compared)
    shell.result(problem, written, gains=True)


@command("results/<config>-pareto")
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
        from tuning.command_line.session import from_page
        from tuning.report.pages import front_table
        from tuning.searches import pareto as fronts

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        for option, name in (("--better", asked.better), ("--against", asked.against)):
            check_metrics(Search(weights={name: 1.0}), loaded.metrics, option)
        out = shell.claim("front.nc", walk.config.stem, "pareto")
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, "--better"):
            problem = fronts.problem_of(loaded.scenario, wanted, asked, **loaded.how)
        with kept_in(out, "rounds") as kept:
            with shell.stage("front", unit="rounds") as show:
                found = fronts.run(problem, wanted, asked, out=out, progress=kept.rounds(show))
            again = repeated(["pareto", "--search", "search.yaml"], "--better", "--against", "--points", "--engine")
            written = shell.write(found, again)
        shell.show(from_page(front_table(found.data, found.knee, loaded.metrics)), *written.outcome)
        shell.written(written.files, written.summary)


@command("results/<config>-schedule")
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
        from tuning.report.numbers import to_json
        from tuning.searches import schedule as schedules

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        out = shell.claim("schedule.nc", walk.config.stem, "schedule")
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, walk.config):
            points = schedules.operating_points(loaded.scenario, wanted, asked, **loaded.how)
        with kept_in(out, "rounds") as kept:
            with shell.stage("schedule", unit="rounds") as show:
                found = schedules.run(points, out=out, progress=kept.rounds(show))
            written = shell.write(found, "")
        rows = schedules.rows(found.data)
        table = _schedule_table(rows, found.data.attrs["searched"].split())
        shell.show(table, *written.outcome, _one_for_all(*schedules.one_for_all(found.data)))
        shell.written(written.files, to_json(rows))


def _one_for_all(level: float, load: float, loss: float) -> str:
    if loss < math.inf:
        return f"one for all: the gains of {level:g} G, {load:g} kg lose at most {loss:.3f} of pd's objective"
    return "one for all: every set of gains breaks a limit at some other operating point"


def _schedule_table(rows: list[dict[str, Any]], gains: Sequence[str]) -> "Table":
    """Return the table of a schedule: the gains that were searched, and force variation against pd."""
    from tuning.command_line.session import plain_table
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
