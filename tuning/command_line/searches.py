"""`mjx-climb tune`, `pareto`, `schedule`, `sweep`, `judge`, `compare`, `merge`: searches with finished parts kept."""

import dataclasses
import importlib
import shlex
from json import dumps, loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, get_args

from pydantic import BeforeValidator, Field, model_validator

from mjx_climb.scenario import shipped
from tuning.command_line import processes
from tuning.command_line.from_models import command, in_options, parts_of
from tuning.command_line.interruption import Interrupted
from tuning.command_line.options import (
    ENSEMBLE,
    LAW,
    METRICS,
    SHARD,
    ControllerName,
    Output,
    SearchFile,
    Walk,
    own_objects,
)
from tuning.command_line.program import InputError, origin, repeated, typed_but
from tuning.problem.search import ROBUST_WEIGHTS, Judge, Pareto, Schedule, Search, check_metrics
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.comparisons.judge import Draw
    from tuning.problem.ensemble import Ensemble
    from tuning.searches.sweep import Grid as Work


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
      stiffness and inertia likewise; kp, kd; with --law the law's own gains;
      gait.duty, gait.cycle, gait.step_height (--also), at the same speed of travel

    \b
    Examples:
      mjx-climb tune case_1_2
      mjx-climb tune case_2 --method gradient --space diagonal --limit base_deviation=0.015
      mjx-climb tune case_1_1 --method cmaes --space split --pin damping.rotation=50
      mjx-climb tune case_2 --ensemble ensemble --members 16
      mjx-climb tune case_1_2 --controller pd --also gait.duty --also gait.cycle
    """
    with processes.joined() as team, output.session() as shell:
        from tuning.background import background
        from tuning.comparisons import of_search
        from tuning.searches import tune as searches
        from tuning.writing import record

        loaded, drawn = walk.load_with_gains(), ensemble.load()
        if drawn is not None and "weights" not in search.model_fields_set and file.search is None:
            search = search.model_copy(update={"weights": ROBUST_WEIGHTS})
        wanted = file.settings(search, loaded, walk.config)
        if drawn is not None:
            wanted = searches.over_ensemble(wanted, {}, drawn)
        chosen = search.method if "method" in search.model_fields_set else None
        wanted = searches.for_this_machine(loaded.scenario, wanted, (file.search, chosen), loaded.law)
        kind, name = "tune" if drawn is None else "robust", walk.config.stem
        settings = record.settings_of(
            dataclasses.replace(loaded, ensemble=drawn),
            kind,
            search=wanted.model_dump(mode="json"),
            judges=ensemble.judges,
        )
        how: dict[str, Any] = {"settings": settings, "varied": walk.varied, "team": team}
        out = shell.claim("search.nc", name, kind, wanted.method, wanted.space, *walk.words, **how)
        shell.opening(loaded.scenario)
        shell.say(*filter(None, [team.said]))
        team.begin(out, loaded.scenario.to_yaml())
        with shell.stage("baseline"), file.naming(search):
            problem = searches.problem_of(loaded.scenario, wanted, ensemble=drawn, **loaded.walks)
        files = ["--search", "search.yaml", *([] if drawn is None else ["--ensemble", "ensemble.yaml"])]
        again, begun = repeated(["tune", *files], "--engine"), None
        with shell.keeping("rounds"), background(busy=1) as begin:
            begin(lambda _: importlib.import_module("tuning.kinds"))  # matplotlib takes half a second
            if drawn is None:
                of_search.load_tests(problem, wanted, begin)
                begun = of_search.begin(problem, wanted, begin, out=out)
            with shell.rounds("search") as show:
                found: Any = searches.run(problem, wanted, out=out, progress=show)
            if ensemble.judges is not None:
                found = dataclasses.replace(found, judges=ensemble.judges)
            if found.interrupted:
                from tuning import kinds

                if (before := record.read(out)) is not None and before.whole:  # it stays until all of this one is there
                    raise KeyboardInterrupt
                kinds.write_found(found, out, origin(name, again), settings)
                best = f"objective {found.value:.4f}, gains.yaml; the same command goes on from there"
                raise Interrupted(f"the best of {shell.done} rounds is in {out}: {best}")
            shell.result(found, again, begun)


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
        from mjx_climb.execution import devices

        devices.begin()
        from tuning.searches import pareto as fronts
        from tuning.writing.record import settings_of

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        for option, name in (("--better", asked.better), ("--against", asked.against)):
            check_metrics(Search(weights={name: 1.0}), loaded.metrics, option)
        settings = settings_of(
            loaded, "pareto", search=wanted.model_dump(mode="json"), front=asked.model_dump(mode="json")
        )
        how: dict[str, Any] = {"settings": settings, "varied": walk.varied}
        out = shell.claim("front.nc", walk.config.stem, "pareto", *walk.words, **how)
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, "--better"):
            problem = fronts.problem_of(loaded.scenario, wanted, asked, **loaded.walks)
        with shell.keeping("rounds"):
            with shell.rounds("front") as show:
                found = fronts.run(problem, wanted, asked, out=out, progress=show)
            again = repeated(["pareto", "--search", "search.yaml"], "--better", "--against", "--points", "--engine")
            shell.result(found, again)


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
        from mjx_climb.execution import devices

        devices.begin()
        from tuning.command_line.session import plain_table
        from tuning.numbers import change, gain, number
        from tuning.pages.schedule import rows
        from tuning.searches import schedule as schedules
        from tuning.searches.retuned_pd import NAME
        from tuning.writing.record import settings_of

        loaded = walk.load()
        wanted = file.settings(space, loaded, walk.config)
        settings = settings_of(
            loaded, "schedule", search=wanted.model_dump(mode="json"), operating_points=asked.model_dump(mode="json")
        )
        how: dict[str, Any] = {"settings": settings, "varied": walk.varied}
        out = shell.claim("schedule.nc", walk.config.stem, "schedule", *walk.words, **how)
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(space, walk.config):
            points = schedules.operating_points(loaded.scenario, wanted, asked, **loaded.walks)
        with shell.keeping("rounds"):
            with shell.rounds("schedule") as show:
                found = schedules.run(points, out=out, progress=show)
            gains, beside = found.data.attrs["searched"].split(), ("vs\nconfig %", "vs\nretuned %", "vs\npd %")
            table = plain_table("gravity\nG", "cargo\nkg", *gains, "variation\nN", *beside, "")
            table.columns[-1].no_wrap = False  # words give way to numbers
            for row in rows(found.data):
                tuned, *others = (row["force_variation"][walk] for walk in ("tuned", "config", NAME, "pd"))
                cells = [f"{row['gravity_g']:.3g}", f"{row['cargo_kg']:.3g}", *(gain(row, name) for name in gains)]
                verdict = "" if row["feasible"] else "breaks limits"
                verdict += f" {row['on_bound']} on a bound" if row["on_bound"] else ""
                table.add_row(
                    *cells,
                    "failed" if tuned is None else number(tuned),
                    *(change(tuned, other) for other in others),
                    verdict.strip(),
                )
            shell.result(found, "", table=table)


RANGE = "LOW:HIGH:COUNT"
ROWS = {  # by command: file, stage and unit
    "sweep": ("sweep.nc", "grid", "walks"),
    "judge": ("judged.nc", "fresh draw", "members"),
}

_End = Annotated[float, Field(ge=1e-30, le=1e30)]  # single precision, with room for squares of moderate gains
Range = tuple[_End, _End, Annotated[int, Field(ge=2, le=100_000)]]
_Typed = Annotated[Range | None, BeforeValidator(lambda text: parts_of(text, RANGE))]


class Grid(Options):
    """What is swept."""

    stiffness: _Typed = setting(
        None, "virtual stiffness K, N/m and N m/rad: evenly spaced on a logarithmic scale", metavar=RANGE
    )
    damping: _Typed = setting(None, "virtual damping D, N s/m and N m s/rad, spaced likewise", metavar=RANGE)
    axis: dict[str, Range] = setting(
        {},
        "gain of the law, SI units, spaced likewise; in place of either of these, or twice for both",
        metavar=f"NAME={RANGE}",
    )
    batch_size: int | None = setting(None, "robots that walk at a time; null: parts of a few seconds", ge=1)
    shard: str | None = SHARD

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges by the name of the gain, the horizontal one first."""
        own = {"stiffness": self.stiffness, "damping": self.damping}
        return {name: span for name, span in own.items() if span is not None} | self.axis

    @model_validator(mode="after")
    def _two_in_order(self) -> Self:
        both = [name for name in self.axis if getattr(self, name, None) is not None]
        if both or len(self.ranges) != 2:
            got = ", ".join([*self.ranges, *both]) or "none"
            raise ValueError(f"--stiffness, --damping, --axis: expected two gains to sweep, got {got}")
        for name, (low, high, _) in self.ranges.items():
            if not low < high:
                option = f"--axis {name}" if name in self.axis else f"--{name}"
                raise ValueError(f"{option}: expected {RANGE} with LOW below HIGH, got {low:g} and {high:g}")
        return self

    def work(self, walk: Walk) -> "Work":
        """Return the walks of the grid."""
        import numpy as np

        from tuning.searches.sweep import grid_of

        axes = {name: np.geomspace(*span) for name, span in self.ranges.items()}
        for name, values in axes.items():
            if not (np.diff(values.astype(np.float32)) > 0).all():
                expected = f"{RANGE} whose values single precision tells apart"
                raise InputError(f"--axis {name}: expected {expected}, got {len(values)} too close together")
        loaded = walk.load()
        if loaded.law is None and loaded.scenario.control.controller == "pd":
            raise InputError("--controller: expected a law with gains to sweep, got pd")
        try:
            return grid_of(loaded, axes, walk.values(loaded.law), self.batch_size)
        except ValueError as error:
            raise InputError(str(error).replace("axes", "--axis", 1).replace("--axis.", "--axis ", 1)) from None

    def said(self, work: "Work", here: int, there: int) -> list[str]:
        """Return how many walks there are, on what, and how long they take where that is long."""
        import jax

        from mjx_climb.execution.paths import device_for
        from tuning.command_line.session import duration
        from tuning.results.swept import HISTORIES
        from tuning.searches.sweep import expected_duration

        steps, sizes = work.walked.scenario.steps, " x ".join(f"{len(each)} {name}" for name, each in work.axes.items())
        device = jax.devices(device_for(work.rows, 0, kernel=work.rows > HISTORIES))[0]  # too few for a GPU
        said = [f"{work.rows} walks ({sizes}) of {steps} steps on {device.device_kind}"]
        seconds = expected_duration(here - there, steps, device.platform)
        if seconds > 600:  # of shorter sweeps progress says enough
            said.append(f"expect some {duration(seconds)}, or spread them over machines with --shard")
        return said


class Rivals(Judge):
    """Which gains are judged, on what."""

    gains: tuple[Path, ...] = setting(..., "gains file to judge", metavar="FILE")
    ensemble: Path = setting(Path("ensemble"), ENSEMBLE, metavar="FILE", complete="ensemble")
    shard: str | None = SHARD

    def work(self, walk: Walk) -> "Draw":
        """Return the walks of the gains."""
        from tuning.comparisons.judge import draw_of
        from tuning.gains import gains_file
        from tuning.problem.ensemble import Ensemble

        loaded = walk.load()
        if (
            loaded.law is None
            and loaded.scenario.control.controller == "pd"
            and not all(map(gains_file.shipped_law, self.gains))
        ):
            raise InputError("--controller: expected a law whose gains are judged, got pd, which walks beside them")
        named = {file.stem: gains_file.whole(file, loaded.scenario, loaded.law) for file in self.gains}
        if len(named) < len(self.gains) or named.keys() & {"config", "pd"}:
            got = ", ".join(file.stem for file in self.gains)
            raise InputError(f"--gains: expected files of different names, none config or pd, got {got}")
        ensemble = Ensemble.load(shipped.found(self.ensemble))
        return draw_of(loaded, named, ensemble, self.members)

    def said(self, work: "Draw", here: int, _: int) -> list[str]:
        """Return how many walks there are."""
        return [f"{here} members, {len(work.gains) + 1} walks of {work.problem.scenario.steps} steps each"]


def _walk_rows(asked: Any, walk: Walk, output: Output, kind: str, again: str) -> None:
    """Walk the rows of a grid or a draw, all or a shard's, and write the result of all."""
    with processes.joined(apart=asked.shard is not None) as team, output.session() as shell:
        part, which = processes.shard_from(asked.shard)
        from tuning.background import background
        from tuning.searches import shards
        from tuning.writing import record

        work, name, (file, stage, unit) = asked.work(walk), walk.config.stem, ROWS[kind]
        rows_of = record.without_machine(work.identity())
        settings = record.settings_of(work.problem, kind, rows=rows_of)
        out = shell.claim(file, name, kind, *walk.words, settings=settings, varied=walk.varied, team=team)
        about = {"again": typed_but("--shard", shards.SHARD), "name": name, "repeat": again}
        about["settings"] = dumps(settings)  # for the folder of what is merged
        rows = shards.Rows(work, out, part, about)
        here, there, folder = len(rows.rows), rows.there, rows.folder or out
        said = [*asked.said(work, here, there), which, team.said, f"{there} are there already" if there else ""]
        shell.say("; ".join(filter(None, said)))
        shell.opening(work.problem.scenario)
        team.begin(folder, work.identity())
        with shell.keeping(f"of {here} {unit}", folder, there), background() as begin:
            begun = None
            if kind == "sweep" and rows.shard is None:
                from tuning.comparisons import of_sweep

                begin(lambda _: importlib.import_module("tuning.kinds"))  # matplotlib takes half a second
                begun = of_sweep.begin(work.problem, work.gains, work.axes, begin)
            with shell.stage(stage, unit=unit, keeps=True) as show:
                arrays = rows.walk(show)
            if rows.shard is not None:
                merge = f"mjx-climb merge {shlex.quote(str(out))}"
                shell.say(f"{folder} is whole; once all {rows.shard.count} are: {merge}")
                shell.print_json(dumps({"shard": rows.shard.number, "of": rows.shard.count, unit: here}))
                return
            shell.result(work.result(arrays), again, begun)


@command("results/<config>-sweep")
def sweep(grid: Grid, walk: Walk, output: Output) -> None:
    """Walk a grid of stiffness and damping, or of two other gains, the same on all axes, in single precision.

    Prints the best gains (least force variation among the walks in which all grippers hold), the config's own and pd
    side by side, walked again in double precision. Writes to DIR the grid (sweep.nc, opens with xarray), a sheet with a
    map of each metric and the law's limit of stability (maps.png), the table (comparison.json), the resolved scenario
    (config.yaml), and all of it with the walks over time as a page for a browser (report.html). `mjx-climb plot DIR`
    draws each of them by itself.

    Finished parts are kept in DIR: after Ctrl-C, or worse, the same command goes on where it stopped. A gains file
    gives the inertia and the joint gains of the grid, and a further walk to compare with.

    With --shard, or as a task of a Slurm array, a sweep is spread over machines: each walks its part of the grid into
    a folder below DIR, and `mjx-climb merge DIR` writes what one machine would have written.

    \b
    Examples:
      mjx-climb sweep case_1_2 --stiffness 1e2:1e6:16 --damping 1e0:1e5:16
      mjx-climb sweep case_2 --stiffness 1e3:1e5:8 --damping 1e1:1e4:8 --gains best.yaml
      mjx-climb sweep case_2 --stiffness 1e2:1e6:128 --damping 1e0:1e5:128 --shard 3/16
      mjx-climb sweep case_2 --law my_law.py:Filtered --axis cutoff=1:100:8 --damping 1e1:1e4:8
    """
    again = repeated(["sweep"], "--stiffness", "--damping", "--axis", "--batch-size", "--engine")
    _walk_rows(grid, walk, output, "sweep", again)


@command("results/<config>-judge")
def judge(rivals: Rivals, walk: Annotated[Walk, "-gains"], output: Output) -> None:
    """Judge gains on walks that no search over the ensemble has seen, beside the config's own and pd.

    As tune --ensemble judges its result: pushes, cargo, slope, grips, masses and hardware are drawn with another seed,
    nothing is torn off, and a walk fails where it pulls beyond the holding limit. A file that names its law or gait
    walks with these. Prints mean and worst 5 % of each metric; writes to DIR every walk (judged.nc), a picture, the
    summary and a page. `mjx-climb plot DIR` draws other metrics.

    Finished parts are kept in DIR: the same command goes on where it stopped. With --shard, or as a task of a Slurm
    array, the members are spread over machines, and `mjx-climb merge DIR` writes what one machine would have written.

    \b
    Examples:
      mjx-climb judge case_1_2 --gains results/case_1_2-tune-gradient-isotropic/gains.yaml
      mjx-climb judge case_2 --gains gains.yaml --ensemble mine.yaml --members 100000 --shard 3/16
    """
    again = "the same command, with config.yaml and --ensemble ensemble.yaml"
    _walk_rows(rivals, walk, output, "judge", again)


_CONTROLLERS = get_args(ControllerName)


def _names(text: str) -> tuple[str, ...]:
    found: list[str] = []
    for name in filter(None, map(str.strip, text.split(","))):
        gain = found and "@" in found[-1] and ":" not in name and name[0].islower() and name not in _CONTROLLERS
        found[-1:] = [f"{found[-1]},{name}"] if gain else [*found[-1:], name]  # of Law@damping,stiffness
    return tuple(found)


class Laws(Judge):
    """Which laws are compared, on what."""

    laws: Annotated[tuple[str, ...], BeforeValidator(_names)] = setting(
        ...,
        "laws to compare with pd, with commas: base_admittance, end_effector_admittance, or what --law takes; "
        "files are run",
        metavar="LAW,LAW,...",
    )
    ensemble: Path | None = setting(
        None, f"{ENSEMBLE}; null: that of --hardware, else ensemble", metavar="FILE", complete="ensemble"
    )

    def draw(self, hardware: str | None) -> "Ensemble":
        """Return the ensemble, by default the shipped one of a profile of hardware."""
        from tuning.problem.ensemble import Ensemble

        own = f"ensemble_{hardware}"
        default = Path(own if own in shipped.ensembles() else "ensemble")
        return Ensemble.load(shipped.found(self.ensemble or default))


@command("results/<config>-compare")
def compare(
    asked: Laws,
    search: Annotated[Search, "-joint_gains"],
    file: SearchFile,
    walk: Annotated[Walk, "-gains", "-law", "-controller"],
    output: Output,
) -> None:
    """Tune several laws for as many evaluations on the same draws, and judge them on the same unseen walks.

    pd with kp and kd retuned is always among them, and all search kp and kd. Prints mean and worst 5 % of each metric,
    the difference from retuned pd with intervals of 95 % for all rows at once (~: the interval holds 0),
    and in a sentence which law is better, what the force sensor is worth, and what better hardware would be worth:
    retuned pd judged again with half the delay, half the friction, twice the rate.

    Writes to DIR every walk and the differences (compared.nc), the table (compared.csv), the gains of each law
    (gains-<law>.yaml), a picture, the summary (summary.json), and all of it as a page for a browser (report.html).
    Finished rounds are kept: after Ctrl-C the same command goes on.

    GAIN of --also, --bound, --pin and --freeze may be one of any law; laws without it are searched without it.

    \b
    Examples:
      mjx-climb compare case_1_2 --laws base_admittance,my_law.py:Mine --hardware dynamixel_x
      mjx-climb compare case_1_1 --laws base_admittance --starts 32 --iterations 20 --members 512
    """
    with output.session() as shell:
        from mjx_climb.execution import devices
        from mjx_climb.scenario.messages import ConfigError

        devices.begin()
        from tuning.comparisons import compare as comparing
        from tuning.problem.evaluation import Problem
        from tuning.searches import tune as searches
        from tuning.writing.record import settings_of

        loaded, ensemble = walk.load(), asked.draw(walk.hardware)
        joined = file.joined(search, loaded)
        own = Search.load(file.search) if file.search is not None else None
        if "weights" not in search.model_fields_set and own is None:
            joined = joined.model_copy(update={"weights": ROBUST_WEIGHTS})
        try:
            with file.naming(search):
                wanted = comparing.alike(searches.over_ensemble(joined, {}, ensemble), search, own)
                laws = comparing.contestants(loaded.scenario, asked.laws, wanted)
        except ConfigError as error:
            raise ConfigError(in_options(str(error), Laws)) from None
        each = {name: settings_of(Problem(own.scenario, law=own.law), "law") for name, own in laws.items()}
        settings = settings_of(
            dataclasses.replace(loaded, ensemble=ensemble),
            "compare",
            search=wanted.model_dump(mode="json"),
            members=asked.members,
            laws=each,
        )
        how: dict[str, Any] = {"settings": settings, "varied": walk.varied}
        out = shell.claim("compared.nc", walk.config.stem, "compare", *walk.words, **how)
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(search, walk.config):
            problem = comparing.problem_of(
                loaded.scenario, laws, ensemble, metrics=loaded.metrics, engine=loaded.engine
            )
        with shell.keeping("rounds"):
            found = comparing.run(laws, problem, wanted, asked.members, out=out, stage=shell.stage)
            files = ["--search", "search.yaml", "--ensemble", "ensemble.yaml"]
            shell.result(found, repeated(["compare", *files], "--laws", "--members", "--engine"))


class Merge(Options):
    """What is put together."""

    folders: tuple[Path, ...] = setting(
        ..., "the shards' folders, or one that holds them all", metavar="FOLDER...", argument=True
    )
    law: str | None = LAW
    metrics: tuple[str, ...] = METRICS


@command("that which holds the shards")
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
        from tuning.comparisons.merge import merged
        from tuning.results.judged import Judged
        from tuning.searches import shards

        law, table = own_objects(asked.law, asked.metrics)
        kept = shards.find(asked.folders)
        target, about = output.out or shards.home(kept), kept[0].about
        if target is None:
            raise InputError("--out: expected a folder for the result, as the shards lie in several places")
        kind = "judge" if kept[0].identity["kind"] == Judged.KIND else "sweep"
        settings = loads(about["settings"]) if "settings" in about else None
        shell.claim(ROWS[kind][0], about.get("name", "the scenario"), settings=settings, at=target)
        found = merged(kept, law, table)
        shell.result(found, about.get("repeat") or "the same command", before=f"{len(kept)} shards, ")
