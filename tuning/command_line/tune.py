"""`mjx-climb tune`: a search for gains."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from mjx_climb.scenario import shipped
from tuning.command_line import completion, options
from tuning.command_line.ending import InputError, Interrupted
from tuning.command_line.robust import tune_robustly

if TYPE_CHECKING:
    from tuning.searches.tune import Progress

MethodName = Literal["gradient", "lbfgs", "grid", "cmaes", "optuna"]
SpaceName = Literal["isotropic", "split", "diagonal"]
Value = TypeVar("Value")

JUDGES = 128  # walks of each set of gains in the fresh draw


def _pairs(metavar: str, text: str) -> Any:
    return typer.Option(metavar=metavar, help=text, show_default=False)


def tune(
    config: options.Config,
    method: Annotated[MethodName | None, typer.Option(help="How to search.", show_default="gradient")] = None,
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
        int | None, typer.Option(min=1, metavar="N", help="Walks of the fresh draw.", show_default=str(JUDGES))
    ] = None,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    gains: options.GainsFile = None,
    law: options.LawFile = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for the results.", show_default="results/<config>-tune-<method>-<space>"
        ),
    ] = None,
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
      joint_limit_margin (rad)
    GAIN: damping, damping.translation, damping.rotation, damping.x .. damping.rz;
      stiffness and inertia likewise; kp, kd; with --law the law's own gains

    \b
    Examples:
      mjx-climb tune case_1_2
      mjx-climb tune case_2 --method gradient --space diagonal --limit base_deviation=0.015
      mjx-climb tune case_1_1 --method cmaes --space split --pin damping.rotation=50
      mjx-climb tune case_2 --ensemble ensemble --members 16
    """
    with options.reserved_stdout() as stdout:
        import mjx_climb as mc
        from mjx_climb.files import dataset
        from tuning.command_line import progress, report
        from tuning.output import tuned
        from tuning.problem import ensemble as ensembles
        from tuning.problem import search as settings
        from tuning.searches import finished_parts
        from tuning.searches import robust as robust_search
        from tuning.searches import tune as tuning_tune

        begin = time.perf_counter()
        scenario = options.scenario_from(config, controller, changes, hardware)
        user_law, scenario = options.law_from(law, gains, scenario)
        engine = options.engine_from(engine)
        for option, value in (("--members", members), ("--judges", judges)):
            if value is not None and ensemble is None:
                raise InputError(f"{option}: expected --ensemble with it")
        changed = {} if members is None else {"members": members}
        drawn = None if ensemble is None else ensembles.load(shipped.found(ensemble), **changed)
        given = {
            "method": method, "space": space, "inertia": with_inertia or None, "joint_gains": with_joint_gains,
            "starts": starts, "iterations": iterations, "seed": seed, "weights": _mapping("--weight", weight),
            "limits": _mapping("--limit", limit), "also": also and tuple(also),
            "pins": _mapping("--pin", pin), "bounds": _ranges(bound),
        }  # fmt: skip
        if ensemble is not None and weight is None and search is None:
            given["weights"] = robust_search.ROBUST_WEIGHTS
        own = settings.Search() if search is None else settings.load(search)
        settings.check_metrics(own, mc.METRICS, str(search))
        try:
            wanted = settings.make({**own.model_dump(), **{k: v for k, v in given.items() if v is not None}}, "")
            settings.check_metrics(wanted, mc.METRICS, "")
        except mc.ConfigError as error:
            raise InputError(options.in_options(str(error).removeprefix(": "))) from None
        if drawn is not None:
            wanted = robust_search.settled(wanted, drawn)
        options.check_space(scenario, wanted, config, None if pin or bound or also else search, user_law)
        kind = "tune" if ensemble is None else "robust"
        out = out or Path("results") / f"{config.stem}-{kind}-{wanted.method}-{wanted.space}"
        dataset.check_folder(out)
        console = report.console(stderr=True)
        console.print(progress.cache_state(), soft_wrap=True)
        meter = progress.Meter(console)
        with meter.stage("baseline"), options.weighing(None if weight else search):
            if drawn is None:
                tuning_tune.problem_of(scenario, wanted, engine=engine, law=user_law)
            else:
                robust_search.goal(scenario, drawn, wanted, engine)
        scenario = tuned.write_settings(out, scenario, wanted.to_yaml())
        if drawn is not None:
            return tune_robustly(
                scenario,
                wanted,
                drawn,
                judges or JUDGES,
                out,
                engine,
                config.stem,
                _line,
                meter,
                stdout,
                json=json,
                law=user_law,
            )

        kept = 0

        def round_done(now: tuning_tune.Progress) -> None:
            nonlocal kept
            kept = now.rounds
            show(now.rounds, now.rounds_in_all, _line(now))

        try:
            with meter.stage("search", unit="rounds") as show:
                found = tuning_tune.tune(scenario, wanted, law=user_law, engine=engine, out=out, progress=round_done)
            if found.interrupted:
                comment = f"{wanted.method}, {wanted.space}, objective {found.value:.4f} (pd: 1)"
                tuned.write_found(found, out, f"mjx-climb tune {config.stem}: {comment}", user_law)
                raise Interrupted(
                    f"the best of {kept} rounds is in {out}: objective {found.value:.4f}, gains.yaml; "
                    "the same command goes on from there"
                )
            again = f"mjx-climb tune config.yaml --search search.yaml{options.law_option(law)} --out again"
            again += options.engine_option(engine)
            origin = options.origin(config.stem, again)
            judged = tuned.write(found, out, law=user_law, origin=origin, engine=engine, stage=meter.stage)
            finished_parts.clear(out)
        except KeyboardInterrupt:
            raise Interrupted(f"{kept} rounds are kept in {out}; the same command goes on from there") from None

        tables = console if json else report.console(file=stdout)
        tables.print(report.comparison_table(judged.compared, "pd", tables.width))
        tables.print(report.gains_table(judged.compared))
        for line in judged.outcome:
            tables.print(line, soft_wrap=True)
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {tuned.FILES}", soft_wrap=True)
        if json:
            print(judged.summary, file=stdout)


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
