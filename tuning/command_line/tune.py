"""`mjx-climb tune`: gains of one law, of several side by side, along a front, over operating points."""

import dataclasses
import importlib
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import mjx_climb as mc
from mjx_climb.scenario import shipped
from tuning.command_line import processes
from tuning.command_line.from_models import command, in_options, made
from tuning.command_line.interruption import Interrupted
from tuning.command_line.options import ENSEMBLE, Members, Output, SearchFile, Walk
from tuning.command_line.program import InputError, origin, repeated
from tuning.problem.search import ROBUST_WEIGHTS, Judge, Pareto, Schedule, Search, check_metrics
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.problem.ensemble import Ensemble


class Many(Members):
    """Which walks gains are searched for: those of an ensemble in place of the config's."""

    ensemble: Path | None = setting(
        None, f"{ENSEMBLE}; of several laws null: that of --hardware", metavar="FILE", complete="ensemble"
    )
    test_members: int | None = setting(None, "walks of the fresh draw that tests the result; null: 128", ge=1)

    def of_laws(self, hardware: str | None) -> "Ensemble":
        """Return the ensemble that laws are compared on, by default the shipped one of a profile of hardware."""
        own = f"ensemble_{hardware}"
        return self.loaded(self.ensemble or Path(own if own in shipped.ensembles() else "ensemble"))


class Goal(Options):
    """The goal."""

    objective: str | None = setting(
        None,
        "function of the metrics that is minimised in place of the weights; its file is run",
        metavar="FILE.py:NAME",
    )


class Laws(Options):
    """The walk: one law, or several that are compared."""

    law: tuple[str, ...] = setting(
        (),
        "law in place of the config's: pd, base_admittance, end_effector_admittance, a shipped one as LoadTransfer, or "
        "your own, whose file is run; several are tuned alike and compared with pd",
        metavar="NAME|FILE.py:NAME",
    )
    seeds: int | None = setting(
        None, "searches, from --seed on; null: 1; of each of several laws 3, on a GPU 8, of a grid 1", ge=1, le=100
    )


class Over(Options):
    """Which operating points gains are searched for."""

    over: tuple[str, ...] = setting(
        (),
        "tune for each gravity (G = 9.81 m/s^2), or each cargo (kg), or each pair, as gravity=1e-6,1/6,1",
        metavar="gravity|cargo[=V,V,...]",
    )

    def points(self, scenario: "mc.Scenario") -> Schedule:
        """Return the operating points, with the scenario's own gravity or cargo where that is not named."""
        from mjx_climb.scenario.values import G

        strength, load = math.hypot(*scenario.gravity) / G, scenario.disturbance.cargo.mass
        values: dict[str, Any] = {"gravity": (strength,), "cargo": (load,)}
        for text in self.over:
            names, equals, numbers = text.partition("=")
            for name in map(str.strip, names.split(",")):
                if name not in Schedule.model_fields:
                    raise InputError(f"--over: expected gravity, cargo or both, got {name!r}")
                values[name] = numbers if equals else Schedule.model_fields[name].default
        try:
            points = made(Schedule, values)
        except InputError as error:
            raise InputError(str(error).replace("--", "--over ", 1)) from None
        assert isinstance(points, Schedule)
        return points


# the search of a front or of operating points has one method, whose rounds are fixed
_OfPoints = Annotated[Search, "-method", "-starts", "-iterations"]
_OfFront = Annotated[Search, "-method", "-starts", "-iterations", "-weights", "-no_worse_than_pd"]
_FromConfig = Annotated[Walk, "-gains"]


def pareto(asked: Pareto, search: _OfFront, file: SearchFile, walk: _FromConfig, output: Output) -> None:
    """Search the front of two metrics."""
    with output.session(walks=True) as shell:
        from tuning.searches import pareto as fronts

        loaded = walk.load()
        wanted, space = file.settings(search, loaded, walk.config)
        for option, name in (("--better", asked.better), ("--against", asked.against)):
            check_metrics(Search(weights={name: 1.0}), loaded.metrics, option)
        folder = walk.take(shell, "front.nc", loaded, "pareto", search=wanted, front=asked)
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(search, "--better"):
            problem = fronts.problem_of(loaded.scenario, wanted, asked, space=space, **loaded.walks)
        with shell.keeping("rounds"):
            with shell.rounds("front") as show:
                found = fronts.run(problem, wanted, asked, out=folder, progress=show)
            again = repeated(["tune", "--search", "search.yaml"], "--better", "--against", "--points", "--engine")
            shell.result(found, again)


def schedule(asked: Over, search: _OfPoints, file: SearchFile, walk: _FromConfig, output: Output) -> None:
    """Tune gains for every operating point, all side by side in one batch."""
    with output.session(walks=True) as shell:
        from tuning.searches import schedule as schedules

        loaded = walk.load()
        points, (wanted, space) = asked.points(loaded.scenario), file.settings(search, loaded, walk.config)
        folder = walk.take(shell, "schedule.nc", loaded, "schedule", search=wanted, operating_points=points)
        shell.opening(loaded.scenario)
        with shell.stage("baseline"), file.naming(search, walk.config):
            problem = schedules.operating_points(loaded.scenario, wanted, points, space=space, **loaded.walks)
        with shell.keeping("rounds"):
            with shell.rounds("schedule") as show:
                found = schedules.run(problem, out=folder, progress=show)
            shell.result(found, repeated(["tune", "--search", "search.yaml"], "--over", "--engine"))


def compare(
    asked: Laws,
    search: Annotated[Search, "-joint_gains"],
    file: SearchFile,
    many: Many,
    walk: Annotated[Walk, "-gains", "-law", "-controller"],
    output: Output,
) -> None:
    """Tune several laws from several seeds until they converge, and test them on the same unseen walks."""
    with output.session(walks=True) as shell:
        from mjx_climb.scenario.messages import ConfigError
        from tuning.comparisons import compare as comparing
        from tuning.comparisons import paired
        from tuning.problem.evaluation import Problem
        from tuning.searches import tune as searches
        from tuning.writing.record import settings_of

        loaded, ensemble, members = walk.load(), many.of_laws(walk.hardware), many.test_members or Judge().members
        joined = file.joined(search, loaded)
        own = Search.load(file.search) if file.search is not None else None
        if "weights" not in search.model_fields_set and own is None:
            joined = joined.model_copy(update={"weights": ROBUST_WEIGHTS})
        try:
            with file.naming(search):
                wanted = comparing.alike(searches.over_ensemble(joined, {}, ensemble), search, own)
                wanted, method = searches.own_method(wanted, loaded.scenario)
                laws = comparing.contestants(loaded.scenario, asked.law, wanted, method)
        except ConfigError as error:
            raise error.moved(key=in_options("law" if error.key == "laws" else error.key, Laws)) from None
        each = {name: settings_of(Problem(one.scenario, law=one.law), "law") for name, one in laws.items()}
        seeds = comparing.seeds_for(wanted, asked.seeds)
        record: dict[str, Any] = {"search": wanted, "members": members, "seeds": seeds, "laws": each}
        walked = dataclasses.replace(loaded, own_method=method, ensemble=ensemble)
        folder = walk.take(shell, "compared.nc", walked, "compare", "laws", **record)
        shell.opening(loaded.scenario, *paired.without_interval(members, ensemble.worst, seeds=seeds))
        with shell.stage("baseline"), file.naming(search, walk.config):
            walks = {"metrics": loaded.metrics, "engine": loaded.engine, "own_method": method}
            problem = comparing.problem_of(loaded.scenario, laws, ensemble, **walks)
        with shell.keeping("rounds"):
            found = comparing.run(laws, problem, wanted, members, seeds, out=folder, stage=shell.stage)
            files = ["--search", "search.yaml", "--ensemble", "ensemble.yaml"]
            shell.result(found, repeated(["tune", *files], "--law", "--test-members", "--seeds", "--engine"))


@command(
    "Which gains are best, and which law?",
    "results/<config>-tune-<method>-<space>, or -pareto, -schedule, -laws",
    {"against": pareto, "over": schedule, "law law": compare},
)
def tune(
    search: Search,
    file: SearchFile,
    goal: Goal,
    many: Many,
    asked: Annotated[Laws, "seeds"],
    walk: Walk,
    output: Output,
) -> None:
    """Search the gains of the controller, from the config's own gains, other known and random ones side by side.

    Minimises force variation, peak foot force and cost of transport, each relative to pd, while the grippers hold,
    the joints keep their limits, the base stays within three times pd's deviation, and nothing gets worse than under
    pd. With hardware in the loop kp and kd are searched too. Then walks the result in double precision, tests it, and
    compares it with the config's gains, pd, and pd with kp and kd searched for the same, which needs no force sensor.

    Writes to DIR the gains (gains.yaml, for run, sweep and evaluate), everything that was evaluated (search.nc), the
    settings (config.yaml, search.yaml), the summary (summary.json), the map and the pictures (map.nc, convergence,
    path, walks, margins), and all of it to look through in a browser (report.html). Finished rounds are kept: after
    Ctrl-C, which ends with the best so far, or worse, the same command goes on.

    One search has its own luck: with --seeds K it is done from K seeds, the best is taken, and a line says how far the
    seeds agree.

    --ensemble: every set of gains walks through all members (pushes, cargo, slope, grip stiffness, robot mass drawn
    from a seed, and hardware where the file says so), mean and worst count, the peak pulling force with them, and a
    fresh draw tests the result, and says how many of its walks break each limit.

    Several --law: each is tuned from several --seeds on the same draws, kp and kd among the gains, until ten rounds of
    points find nothing better by a thousandth or --iterations rounds are spent, and tested on the same unseen walks,
    beside pd with kp and kd retuned. Prints mean and worst 5 % of each metric, the difference from retuned pd with
    intervals of 95 % for all rows at once, of a search once more (~: holds 0), and in a sentence which law is
    better, and the worth of the force sensor, of half the delay, of half the friction and of twice the rate.
    DIR has every walk and the differences (compared.nc, compared.csv) and the gains of each law (gains-<law>.yaml). A
    GAIN may be one of any law; laws without it are searched without it.

    --against: the front of --better and this metric, by gradients under a row of limits, all in one batch. DIR has
    the front with its gains (front.nc) and the gains at its knee, the point furthest from the line between its ends.

    --over: gains for each operating point, all in one batch; the config's gravity gives the direction, its cargo the
    time of loading. DIR has the table (schedule.csv, schedule.yaml), and the worth of the gains of one point at
    another (schedule.nc).

    \b
    METRIC: force_variation, peak_foot_force, peak_pull_force (N), peak_joint_torque (N m),
      cost_of_transport, travel, base_deviation, min_tsm (m), min_gia_margin (m/s^2),
      joint_limit_margin (rad); with --metric the user's own; --objective: any function of them
    GAIN: damping, damping.translation, damping.rotation, damping.x .. damping.rz;
      stiffness and inertia likewise; kp, kd; with --law the law's own gains;
      gait.duty, gait.cycle, gait.step_height (--also), at the same speed of travel

    \b
    Examples:
      mjx-climb tune case_1_2
      mjx-climb tune case_2 --method gradient --space diagonal --limit base_deviation=0.015
      mjx-climb tune case_1_1 --method cmaes --space split --pin damping.rotation=50
      mjx-climb tune case_1_2 --controller pd --also gait.duty --also gait.cycle
      mjx-climb tune case_2 --ensemble ensemble --members 16
      mjx-climb tune case_1_2 --law base_admittance --law my_law.py:Mine --hardware dynamixel_x
      mjx-climb tune case_2 --against cost_of_transport --space split
      mjx-climb tune case_2 --over gravity=1e-6,1e-3,1 --over cargo --space split
    """
    with processes.joined() as team, output.session() as shell:
        from tuning.background import background
        from tuning.comparisons import of_search, paired
        from tuning.searches import tune as searches
        from tuning.writing import record

        loaded, drawn = walk.load_with_gains(), many.load()
        if drawn is not None and "weights" not in search.model_fields_set and file.search is None:
            search = search.model_copy(update={"weights": ROBUST_WEIGHTS})
        wanted = file.joined(search, loaded)
        if drawn is not None:
            wanted = searches.over_ensemble(wanted, {}, drawn)
        chosen = search.method if "method" in search.model_fields_set else None
        with file.naming(search, walk.config):
            how = searches.prepare(loaded.scenario, wanted, (file.search, chosen), law=loaded.law)
            scenario, objective = searches.own_objective(loaded.scenario, goal.objective)
        named = how.search.method if how.method is None else wanted.method
        word = re.sub(r"\W", "_", named.rpartition(":")[2])  # as folders are called by it
        wanted, space, method = how
        if objective is not None and drawn is not None:
            raise InputError("--objective: expected none with --ensemble, whose members are scored by weights")
        loaded = dataclasses.replace(loaded, scenario=scenario, own_method=method, own_objective=objective)
        kind, name = "tune" if drawn is None else "robust", walk.config.stem
        seeds = asked.seeds or 1
        if seeds > 1 and wanted.method == "grid":
            raise InputError(f"--seeds: expected 1 of a grid, which draws nothing, got {seeds}")
        own: dict[str, Any] = {"search": wanted, "judges": many.test_members} | ({"seeds": seeds} if seeds > 1 else {})
        walked, words = dataclasses.replace(loaded, ensemble=drawn), (kind, word, wanted.space)
        folder = walk.take(shell, "search.nc", walked, kind, *words, team=team, **own)
        judges, worst = many.test_members or Judge().members, None if drawn is None else drawn.worst
        lacks = [] if drawn is None else paired.without_interval(judges, worst, tails=False)
        shell.opening(loaded.scenario, *lacks)
        shell.say(*filter(None, [team.said]))
        team.begin(folder, loaded.scenario.to_yaml())
        with shell.stage("baseline"), file.naming(search):
            walks = {**loaded.walks, "own_method": method, "space": space}
            problem = searches.problem_of(loaded.scenario, wanted, objective, ensemble=drawn, **walks)
        files = ["--search", "search.yaml", *([] if drawn is None else ["--ensemble", "ensemble.yaml"])]
        again, begun = repeated(["tune", *files], "--test-members", "--seeds", "--engine"), None
        with shell.keeping("rounds"), background(busy=1) as begin:
            begin(lambda _: importlib.import_module("tuning.kinds"))  # matplotlib takes half a second
            if drawn is None:
                of_search.load_tests(problem, wanted, begin)
                begun = of_search.begin(problem, wanted, begin, seeds=seeds, out=folder)
            with shell.rounds("search") as show:
                found: Any = searches.from_seeds(problem, wanted, seeds, out=folder, progress=show)
            if many.test_members is not None:
                found = dataclasses.replace(found, judges=many.test_members)
            if found.interrupted:
                from tuning import kinds

                # a whole result stays until all of this one is there
                if (before := record.read(folder)) is not None and before.whole:
                    raise KeyboardInterrupt
                kinds.write_found(found, folder, origin(name, again), shell.settings)
                best = f"objective {found.value:.4f}, gains.yaml; the same command goes on from there"
                raise Interrupted(f"the best of {shell.done} rounds is in {folder}: {best}")
            shell.result(found, again, begun)
