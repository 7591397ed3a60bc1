"""`mjx-climb tune`: a search for gains."""

import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from mjx_climb.scenario import shipped
from tuning.command_line import completion, options, processes
from tuning.command_line.ending import InputError, Interrupted, kept_in

if TYPE_CHECKING:
    from rich.table import Table

    import mjx_climb as mc
    from tuning.output.beside_search import Beside
    from tuning.output.robust import Judged as JudgedRobustly
    from tuning.output.robust import Robust
    from tuning.output.tuned import Judged as JudgedGains
    from tuning.output.tuned import Tuned
    from tuning.problem.ensemble import Ensemble
    from tuning.problem.evaluation import Problem
    from tuning.problem.search import Search
    from tuning.searches.result import Result
    from tuning.searches.tune import Progress

MethodName = Literal["gradient", "lbfgs", "grid", "cmaes", "optuna"]
SpaceName = Literal["isotropic", "split", "diagonal"]
Value = TypeVar("Value")


def _pairs(metavar: str, text: str) -> Any:
    return typer.Option(metavar=metavar, help=text, show_default=False)


def tune(
    config: options.Config,
    method: Annotated[
        MethodName | None, typer.Option(help="How to search.", show_default="gradient; cmaes on a GPU")
    ] = None,
    space: Annotated[
        SpaceName | None, typer.Option(help="Which axes share their gains.", show_default="isotropic")
    ] = None,
    with_inertia: Annotated[bool, typer.Option("--with-inertia", help="Search the virtual inertia as well.")] = False,
    also: Annotated[
        list[str] | None,
        _pairs("GAIN", "Gain of the law to search that is left alone otherwise; repeatable."),
    ] = None,
    with_joint_gains: Annotated[
        bool | None,
        typer.Option(
            "--with-joint-gains/--without-joint-gains",
            help="Search kp and kd as well.",
            show_default="where there is hardware",
        ),
    ] = None,
    starts: Annotated[
        int | None,
        typer.Option(metavar="N", help="Starts or population; grid: points per gain.", show_default="the method's"),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(metavar="N", help="Rounds of the search.", show_default="the method's")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random draws.", show_default="0")] = None,
    weight: Annotated[
        list[str] | None,
        _pairs("METRIC=W", "Metric to better and its weight, in place of the default three; repeatable."),
    ] = None,
    limit: Annotated[
        list[str] | None, _pairs("METRIC=VALUE", "Limit of a metric, in its unit: base_deviation=5e-3; repeatable.")
    ] = None,
    bound: Annotated[
        list[str] | None, _pairs("GAIN=LOW:HIGH", "Bounds of a gain, SI units: stiffness.rotation=1:1e3; repeatable.")
    ] = None,
    pin: Annotated[
        list[str] | None, _pairs("GAIN=VALUE", "Gain that keeps a value, SI units: damping.z=100; repeatable.")
    ] = None,
    search: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the search, YAML; options change them.")
    ] = None,
    ensemble: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Tune for an ensemble of walks: a YAML file, or ensemble, which comes with the program.",
            autocompletion=completion.ensemble,
        ),
    ] = None,
    members: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Walks of the ensemble.", show_default="the file's")
    ] = None,
    judges: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Walks of the fresh draw.", show_default="128")
    ] = None,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    gains: options.GainsFile = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for the results.", show_default="results/<config>-tune-<method>-<space>"
        ),
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
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
    with processes.joined() as team, options.reserved_stdout() as stdout:
        given = {
            "method": method, "space": space, "inertia": with_inertia or None, "joint_gains": with_joint_gains,
            "starts": starts, "iterations": iterations, "seed": seed, "weights": _mapping("--weight", weight),
            "limits": _mapping("--limit", limit), "also": also and tuple(also),
            "pins": _mapping("--pin", pin), "bounds": _ranges(bound),
        }  # fmt: skip
        from tuning.command_line import progress, report
        from tuning.output import beside_search
        from tuning.output.ahead import ahead
        from tuning.output.folder import check_own
        from tuning.problem import ensemble as ensembles
        from tuning.searches import robust as robust_search
        from tuning.searches import tune as searches

        begin = time.perf_counter()
        scenario, user_law, table = options.asked(config, controller, changes, hardware, law, metric)
        user_law, scenario = options.with_gains(user_law, gains, scenario)
        engine, formats = options.engine_from(engine), options.figures_from(figures)
        for option, value in (("--members", members), ("--judges", judges)):
            if value is not None and ensemble is None:
                raise InputError(f"{option}: expected --ensemble with it")
        changed = {} if members is None else {"members": members}
        drawn = None if ensemble is None else ensembles.load(shipped.found(ensemble), **changed)
        if drawn is not None and weight is None and search is None:
            given["weights"] = robust_search.ROBUST_WEIGHTS
        wanted = _settings(search, given, table)
        if drawn is not None:
            wanted = robust_search.settled(wanted, {}, drawn)
        options.check_space(scenario, wanted, config, None if pin or bound or also else search, user_law)
        wanted = searches.for_this_machine(scenario, wanted, (search, method), engine, user_law)
        kind = "tune" if drawn is None else "robust"
        out = team.folder(out or Path("results") / f"{config.stem}-{kind}-{wanted.method}-{wanted.space}")
        check_own(out, "search.nc")
        console = report.console(stderr=True)
        progress.opening(console, scenario)
        if team.said:
            console.print(team.said, soft_wrap=True)
        meter = progress.Meter(console)
        team.begin(out, scenario)
        with meter.stage("baseline"), options.weighing(None if weight else search):
            if drawn is None:
                problem = searches.problem_of(scenario, wanted, engine=engine, law=user_law, metrics=table)
            else:
                how: dict[str, Any] = {"engine": engine, "law": user_law, "metrics": table}
                problem = robust_search.problem_of(scenario, drawn, wanted, **how)

        with kept_in(out, "rounds") as kept, ahead(busy=1) as begin_work:
            writes = "tuning.output.tuned" if drawn is None else "tuning.output.robust"
            begin_work(lambda _: importlib.import_module(writes))  # matplotlib takes half a second
            beside = None
            if drawn is None:
                beside_search.load_tests(problem, wanted, begin_work)
                beside = beside_search.beside(problem, wanted, begin_work, out=out)
            with meter.stage("search", unit="rounds") as show:
                told = kept.told(show)
                found = searches.run(
                    problem, wanted, out=out, progress=lambda now: told(now.rounds, now.rounds_in_all, _line(now))
                )
            again = "mjx-climb tune config.yaml --search search.yaml" + (
                "" if drawn is None else " --ensemble ensemble.yaml"
            )
            again += f" --out again{options.engine_option(engine)}"
            origin = options.origin(config.stem, again)
            result = _writable(found, problem, beside, drawn, judges)
            if found.interrupted:
                result.write_found(out, origin.name)
                raise Interrupted(
                    f"the best of {kept.done} rounds is in {out}: objective {found.value:.4f}, gains.yaml; "
                    "the same command goes on from there"
                )
            judged = result.write(out, origin=origin, figures=formats, stage=meter.stage)

        tables = console if json else report.console(file=stdout)
        for shown in _tables(judged, problem, tables.width):
            tables.print(shown, soft_wrap=isinstance(shown, str))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {judged.files}", soft_wrap=True)
        if json:
            print(judged.summary, file=stdout)


def _settings(file: Path | None, given: dict[str, Any], metrics: "mc.MetricTable") -> "Search":
    """Return the settings of a file, the default ones where None, with the options that were given.

    Raises:
        ConfigError: a file that makes no sense.
        InputError: options that make none.
    """
    from mjx_climb.scenario.messages import ConfigError
    from tuning.problem import search as settings

    own = settings.Search() if file is None else settings.load(file)
    settings.check_metrics(own, metrics, str(file))
    try:
        wanted = settings.make({**own.model_dump(), **{k: v for k, v in given.items() if v is not None}}, "")
        settings.check_metrics(wanted, metrics, "")
    except ConfigError as error:
        raise InputError(options.in_options(str(error).removeprefix(": "))) from None
    return wanted


def _writable(
    found: "Result", problem: "Problem", beside: "Beside | None", ensemble: "Ensemble | None", judges: int | None
) -> "Tuned | Robust":
    from tuning.output.robust import JUDGES, Robust
    from tuning.output.tuned import Tuned

    if ensemble is None:
        return Tuned(**vars(found), problem=problem, beside=beside)
    return Robust(**vars(found), problem=problem, ensemble=ensemble, judges=judges or JUDGES)


def _tables(judged: "JudgedGains | JudgedRobustly", problem: "Problem", width: int) -> "list[Table | str]":
    """Return what is printed of a result, in its order."""
    from tuning.command_line import report
    from tuning.output.robust import Judged
    from tuning.report.robust import judged_table

    metrics, law = problem.metrics, problem.law
    if isinstance(judged, Judged):
        return [report.from_page(judged_table(judged.summed, metrics)), *judged.outcome]
    compared = report.comparison_table(judged.compared, "pd", width, metrics, law)
    return [compared, report.gains_table(judged.compared, law), *judged.outcome]


def _line(now: "Progress") -> str:
    slope = f", gradient {now.gradient_norm:.2g}" if now.gradient_norm == now.gradient_norm else ""
    best = f"{now.best:.4f}" if now.best == now.best else "none feasible yet"
    return (
        f"{now.phase} {now.rounds}/{now.rounds_in_all}: best {best}{slope}, {now.alive} of {now.batch} alive, "
        f"{now.env_steps / 1e6:.2f} M env-steps"
    )


def _mapping(option: str, pairs: list[str] | None) -> dict[str, float] | None:
    return _parsed(option, "NUMBER", float, pairs)


def _ranges(pairs: list[str] | None) -> dict[str, tuple[float, float]] | None:
    return _parsed("--bound", "LOW:HIGH", _ends, pairs)


def _ends(text: str) -> tuple[float, float]:
    low, high = (float(end) for end in text.split(":"))
    return low, high


def _parsed(option: str, wanted: str, read: Callable[[str], Value], pairs: list[str] | None) -> dict[str, Value] | None:
    """Return the values of NAME=VALUE pairs, None without any."""
    result = {}
    for pair in pairs or []:
        key, _, value = pair.partition("=")
        try:
            result[key.strip()] = read(value)
        except ValueError:
            raise InputError(f"{option}: expected NAME={wanted}, got {pair!r}") from None
    return result or None
