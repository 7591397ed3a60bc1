"""Arguments and options that several commands share, and what becomes of them."""

import contextlib
import re
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO

import typer

from mjx_climb.scenario import shipped
from tuning.command_line import completion
from tuning.command_line.ending import InputError

if TYPE_CHECKING:
    import mjx_climb as mc
    from mjx_climb.scenario.messages import ConfigError
    from tuning.problem.search import Search
    from tuning.report.page import Origin

ControllerName = Literal["pd", "base_admittance", "end_effector_admittance"]

Config = Annotated[
    Path,
    typer.Argument(
        metavar="CONFIG",
        help=f"Scenario: a YAML file, or one that comes with the program ({', '.join(shipped.names())}).",
        autocompletion=completion.config,
    ),
]
Controller = Annotated[
    ControllerName | None,
    typer.Option(help="Control law in place of the config's.", show_default="the config's"),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key of the config, SI units; may be given several times. Example: control.damping=2e3",
        autocompletion=completion.key,
    ),
]
Hardware = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Hardware in place of the config's: a YAML file, or one of {', '.join(shipped.profiles())}.",
        show_default="the config's",
        autocompletion=completion.hardware,
    ),
]
GainsFile = Annotated[
    Path | None,
    typer.Option("--gains", metavar="FILE", help="Gains file in place of the config's gains."),
]
LawFile = Annotated[
    str | None,
    typer.Option(
        "--law", metavar="FILE.py:NAME", help="Control law of one's own in place of the config's; the file is run."
    ),
]
Metrics = Annotated[
    list[str] | None,
    typer.Option(
        "--metric",
        metavar="FILE.py:NAME",
        help="Metric of one's own beside the shipped ones; the file is run. May be given several times.",
        show_default=False,
    ),
]
Engine = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Dynamics: limb (fast) or mjx (MJX's own stages).",
        show_default="limb",
        autocompletion=completion.engine,
    ),
]
FORMATS = ("png", "svg", "pdf")  # those of `mjx_climb.plots`, which the command line does not wait for
Figures = Annotated[
    str,
    typer.Option(metavar="LIST", help=f"Formats of the pictures, with commas: some of {', '.join(FORMATS)}."),
]
Shard = Annotated[
    str | None,
    typer.Option(
        metavar="I/N",
        help="Walk this shard alone, as 3/16, for merge; 1/1: all.",
        show_default="a Slurm array's task",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON alone on standard output, all else on standard error.")]


ARGUMENTS: ContextVar[tuple[str, ...]] = ContextVar("ARGUMENTS", default=())  # as typed


def typed() -> str:
    """Return the command as it was typed, for others to read."""
    return shlex.join(["mjx-climb", *map(_without_folder, ARGUMENTS.get())])


def typed_but(option: str, value: str) -> str:
    """Return the command as it was typed, to be run again from the same folder, with this value of an option."""
    kept: list[str] = []
    words = iter(ARGUMENTS.get())
    for word in words:
        if word == option:
            next(words, None)
        elif not word.startswith(f"{option}="):
            kept.append(word)
    return f"{shlex.join(['mjx-climb', *kept])} {option} {value}"


def _without_folder(argument: str) -> str:
    """Return an argument, or what stands behind its "=", as a bare name where it is an absolute path."""
    option, equals, value = argument.rpartition("=")
    if re.match(r"[/~]|[A-Za-z]:[/\\]", value):
        value = re.split(r"[/\\]", value.rstrip("/\\"))[-1]
    return f"{option}{equals}{value}"


def origin(name: str, again: str) -> "Origin":
    """Return where a report comes from, but for the scenario: see `tuning.report.page.Origin`."""
    from tuning.report.page import Origin

    return Origin(name, typed(), again)


def figures_from(text: str) -> tuple[str, ...]:
    """Return the formats of `--figures`.

    Raises:
        InputError: another one.
    """
    formats = tuple(dict.fromkeys(name.strip().lower() for name in text.split(",")))
    if unknown := [name for name in formats if name not in FORMATS]:
        raise InputError(f"--figures: expected some of {', '.join(FORMATS)}, got {unknown[0]!r}")
    return formats


def scenario_from(
    config: Path,
    controller: str | None,
    changes: "list[str] | Mapping[str, Any] | None",
    hardware: str | None = None,
) -> "mc.Scenario":
    """Return the scenario of a config with the options applied, `changes` last, before any gains file."""
    import mjx_climb as mc
    from mjx_climb.checks.stance import check_stance
    from mjx_climb.checks.time_step import check_time_step
    from mjx_climb.compilation import probe
    from mjx_climb.quantities.ground import check_reach
    from mjx_climb.scenario import profiles
    from mjx_climb.scenario.model import overridden

    config = shipped.found(config)
    probe.begin()  # the walk of this scenario asks for it
    scenario = mc.load_scenario(config, () if hardware else changes or ())
    if hardware:
        profile = profiles.load_hardware(hardware)
        scenario = overridden(profiles.with_hardware(scenario, profile, hardware), changes or (), str(config))
    if controller is not None:
        scenario = scenario.with_overrides({"control.controller": controller})
    check_stance(scenario, str(config))
    check_time_step(scenario, str(config))
    check_reach(scenario, str(config))
    return scenario


def asked(
    config: Path,
    controller: str | None,
    changes: list[str] | None,
    hardware: str | None,
    law: str | None,
    metrics: list[str] | None = None,
) -> "tuple[mc.Scenario, mc.Law | None, mc.MetricTable]":
    """Return the scenario of `scenario_from`, law (None: the scenario's) and metrics, from options or the config.

    A change of `control.NAME`, a gain of a law of one's own, is the law's.

    Raises:
        ConfigError: no such law or metric, or one whose file is gone or has changed.
        InputError: a change that a law of one's own cannot take.
    """
    import mjx_climb as mc
    from mjx_climb.scenario.overrides import pairs
    from tuning.gains.own_section import taken, without

    source, user_law, table = str(shipped.found(config)), own_law(law), metrics_from(metrics)
    given = dict(pairs(changes or (), source))
    if law is not None and controller is not None:
        raise InputError(f"--controller: expected none with --law, got {controller}")
    if controller is not None:
        given["own.law"] = None
    named = mc.load_scenario(source, {key: value for key, value in given.items() if key.split(".")[0] == "own"})
    _, user_law, table = taken(named, user_law, table, source)
    if user_law is not None:
        given, user_law = _taken_by(user_law, given)
    scenario = scenario_from(Path(source), controller, given, hardware)
    return without(scenario), user_law, table


def _taken_by(law: "mc.Law", changes: dict[str, Any]) -> "tuple[dict[str, Any], mc.Law]":
    """Return the changes that are not of a law of one's own, and the law with the others."""
    from tuning.gains.own_section import of_one

    own = {key: value for key, value in changes.items() if key.startswith("control.") and key[8:] in law.GAINS}
    rest = {key: value for key, value in changes.items() if key not in own}
    for key in rest:
        if key.split(".")[0] == "control" and key not in ("control.kp", "control.kd"):
            expected = ", ".join([*law.GAINS, "kp", "kd"])
            raise InputError(f"--set {key}: expected one of {expected} in control, which {type(law).__name__} reads")
    try:
        return rest, of_one(law, {key[8:]: value for key, value in own.items()}) if own else law
    except (TypeError, ValueError) as error:
        raise InputError(f"--set {', '.join(own)}: {error}") from None


def own_law(text: str | None) -> "mc.Law | None":
    """Return the law of `--law`, None without one.

    Raises:
        ConfigError: no such law.
    """
    from tuning.gains import law_file

    return None if text is None else law_file.load(text)


def metrics_from(texts: list[str] | None) -> "mc.MetricTable":
    """Return the shipped metrics, with those of `--metric` behind them.

    Raises:
        ConfigError: no such metric.
    """
    from tuning.problem import own_file

    return own_file.metrics(texts or ())


def gains_from(file: Path | None, law: "mc.Law | None") -> "mc.Gains | dict[str, Any] | None":
    """Return the values of `--gains`, None without one.

    Raises:
        ConfigError: no such file, or the gains of another law.
    """
    from tuning.gains import gains_file

    return None if file is None else gains_file.load(file, law)


def with_gains(
    law: "mc.Law | None", gains: Path | None, scenario: "mc.Scenario"
) -> "tuple[mc.Law | None, mc.Scenario]":
    """Return a law of one's own, None without one, and the scenario, both with the values of a gains file.

    Raises:
        ConfigError: the gains of another law, or joint gains too stiff for the time step.
    """
    from mjx_climb.checks.time_step import check_time_step
    from tuning.gains import gains_file

    values = gains_from(gains, law)
    if values is None:
        return law, scenario
    scenario, law = gains_file.replaced(scenario, law, values)
    check_time_step(scenario, str(gains))
    return law, scenario


def law_name(law: "mc.Law | None", scenario: "mc.Scenario") -> str:
    """Return the name of the law that walks, as in names of folders."""
    return scenario.control.controller if law is None else type(law).__name__


def search_from(
    file: Path | None,
    space: str | None,
    scenario: "mc.Scenario",
    config: Path,
    law: "mc.Law | None",
    metrics: "mc.MetricTable",
) -> "Search":
    """Return the settings of a search from its file and `--space`, checked against the scenario.

    Raises:
        ConfigError: settings that make no sense, by themselves or for the scenario.
    """
    from tuning.problem import search as settings

    own = settings.Search() if file is None else settings.load(file)
    settings.check_metrics(own, metrics, str(file))
    wanted = own if space is None else settings.make({**own.model_dump(), "space": space}, "options")
    check_space(scenario, wanted, config, file, law)
    return wanted


def check_space(
    scenario: "mc.Scenario", search: "Search", config: Path, file: Path | None, law: "mc.Law | None" = None
) -> None:
    """Refuse a search that has nothing to move, or names gains that are not there, before anything is written.

    Raises:
        ConfigError: in one line, the config, the file of the search or the options, and what is wrong there.
    """
    from mjx_climb.scenario.messages import ConfigError
    from tuning.problem.spaces import space

    try:
        space(scenario, search, law)
    except ConfigError as error:
        raise _placed(error, config if str(error).startswith("control.") else file) from None


@contextlib.contextmanager
def weighing(place: Path | str | None) -> Iterator[None]:
    """Name where the weights stand, None for `--weight`, when one is refused.

    Raises:
        ConfigError: in one line, the place, and what is wrong there.
    """
    from mjx_climb.scenario.messages import ConfigError

    try:
        yield
    except ConfigError as error:
        raise _placed(error, place) from None


def _placed(error: "ConfigError", place: Path | str | None) -> "ConfigError":
    """Return an error on a setting that names its file, or the options where that is None."""
    return type(error)(in_options(str(error)) if place is None else f"{place}: {error}")


def in_options(message: str) -> str:
    """Return a message on a setting of the search in the words of the command's options: pins.x becomes --pin x."""
    return re.sub(r"^(?:(pin|bound|weight|limit)s\.?|(starts|iterations|seed)(?=:))", _option, message)


def _option(found: re.Match[str]) -> str:
    return f"--{found[1]} " if found[1] else f"--{found[2]}"


def engine_from(name: str | None) -> str:
    """Return the engine of that name, the default where None.

    Raises:
        InputError: no such engine.
    """
    from mjx_climb.dynamics import DEFAULT_ENGINE, ENGINES

    if name is not None and name not in ENGINES:
        raise InputError(f"--engine: expected one of {', '.join(ENGINES)}, got {name!r}")
    return name or DEFAULT_ENGINE


def engine_option(engine: str) -> str:
    """Return the option that chooses an engine, with a space before it; empty for the default."""
    from mjx_climb.dynamics import DEFAULT_ENGINE

    return "" if engine == DEFAULT_ENGINE else f" --engine {engine}"


def start_devices() -> None:
    """Begin to start what the command will walk on, before the rest is imported."""
    from mjx_climb.compilation import devices

    devices.begin()


@contextlib.contextmanager
def reserved_stdout() -> Iterator[TextIO]:
    """Give standard output to one writer; what anything else prints goes to standard error."""
    stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        yield stdout
