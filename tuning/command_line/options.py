"""Options that several commands share, each a model, and the objects that they load."""

import contextlib
import math
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, model_validator

import mjx_climb as mc
from mjx_climb.scenario import shipped
from mjx_climb.scenario.kinds import DEFAULT_ENGINE, ENGINES, Controller
from tuning.command_line import processes
from tuning.command_line.from_models import in_options
from tuning.command_line.program import InputError
from tuning.problem.search import Search, check_metrics
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from mjx_climb.inputs.resolve import AnyGains
    from tuning.command_line.processes import Team
    from tuning.command_line.session import Session
    from tuning.problem.ensemble import Ensemble
    from tuning.problem.evaluation import Problem
    from tuning.problem.spaces import Space

    EngineName = str
else:
    EngineName = Literal[ENGINES]

FORMATS = ("png", "svg", "pdf")  # those of `mjx_climb.viz.plots`, which the command line does not wait for


HARDWARE = setting(
    None,
    f"hardware in place of the config's: a YAML file, or one of {', '.join(shipped.profiles())}; null: the config's",
    metavar="NAME",
    complete="hardware",
)
LAW = setting(
    None,
    "control law in place of the config's: a shipped one, as LoadTransfer, or your own, whose file is run",
    metavar="NAME|FILE.py:NAME",
)
METRICS = setting(
    (), "metric of your own beside the shipped ones; the file is run", flag="--metric", metavar="FILE.py:NAME"
)
ENSEMBLE = "an ensemble of walks: a YAML file, or ensemble, which comes with the program"
SHARD = setting(
    None,
    "walk this shard alone, as 3/16; the last one writes the result; 1/1: all; null: a Slurm array's task",
    metavar="I/N",
)
SLOPE = setting(None, "slope of the ground, degrees; 90 is a cliff", metavar="DEG", ge=0, le=180)
ROOF = setting(False, "walk under a roof: a slope of 180 degrees")
ENGINE = setting(DEFAULT_ENGINE, "engine of the dynamics; limb is the fastest")


class Walk(Options):
    """The walk: a scenario, and the options that replace parts of it."""

    config: Path = setting(
        ...,
        f"scenario: a YAML file, or one that comes with the program ({', '.join(shipped.names())})",
        metavar="CONFIG",
        complete="config",
        argument=True,
    )
    controller: Controller | None = setting(None, "control law in place of the config's; null: the config's")
    hardware: str | None = HARDWARE
    changes: tuple[str, ...] = setting(
        (),
        "change a key of the config, SI units, as control.damping=2e3",
        flag="--set",
        metavar="KEY=VALUE",
        complete="key",
    )
    slope: float | None = SLOPE
    roof: bool = ROOF
    gains: Path | None = setting(None, "gains file in place of the config's gains", metavar="FILE")
    law: str | None = LAW
    metrics: tuple[str, ...] = METRICS
    contact: str | None = setting(
        None,
        "what holds feet to the ground, in place of the config's: a shipped one, as polyhedron, or your own",
        metavar="NAME|FILE.py:NAME",
    )
    drive: str | None = setting(
        None,
        "what turns the joints, in place of the config's: a shipped one, as velocity, or your own",
        metavar="NAME|FILE.py:NAME",
    )
    disturbances: tuple[str, ...] = setting(
        (),
        "what acts from outside, in place of the config's beside cargo and pushes: shipped, as link_wrench, or "
        "your own",
        flag="--disturbance",
        metavar="NAME|FILE.py:NAME",
    )
    engine: EngineName = ENGINE

    @model_validator(mode="before")
    @classmethod
    def _controller_as_law(cls, typed: dict[str, Any]) -> dict[str, Any]:
        """Take the name of a controller for that, where it is typed as a law."""
        if typed.get("law") not in get_args(Controller):
            return typed
        if "controller" in typed:
            raise ValueError(f"--controller: expected none with --law, got {typed['controller']}")
        return {"controller" if name == "law" else name: value for name, value in typed.items()}

    @property
    def words(self) -> tuple[str, ...]:
        """The law and hardware in place of the config's, as words of a folder's name."""
        law = None if self.law is None else re.sub(r"[^\w.@+-]", "_", self.law.rpartition(":")[2])
        hardware = None if self.hardware is None else Path(self.hardware).stem
        return tuple(word for word in (self.controller, law, hardware) if word is not None)

    @property
    def varied(self) -> bool:
        """Whether the walk differs from the config by more than `words` say."""
        ground = self.roof or self.slope is not None
        return bool(ground or self.changes or self.gains or self.contact or self.drive or self.disturbances)

    def take(
        self, shell: "Session", file: str, problem: "Problem", command: str, *words: str, team: "Team | None" = None,
        shard: bool = False, **asked: Any,
    ) -> Path:  # fmt: skip
        """Take the folder of a command's result, named after config, command (or `words`) and options in their place.

        Arguments:
            shell: which takes it.
            file: by which the folder is known.
            problem: the walk as loaded.
            team, shard: as of `Session.claim`.
            asked: all else that the result depends on.
        """
        from tuning.writing.record import settings_of

        settings = settings_of(problem, command, **asked)
        names = self.config.stem, *(words or (command,)), *self.words
        return shell.claim(file, *names, settings=settings, varied=self.varied, team=team, shard=shard)

    def load(self) -> "Problem":
        """Return scenario, law, metrics and engine, from options or the config, without the gains file but for its law.

        A change of `control.NAME`, a gain of your own law, is the law's.
        """
        from mjx_climb.control import SHIPPED, is_shipped
        from mjx_climb.inputs.from_scenario import own_parameters
        from mjx_climb.scenario.declared import JOINT_GAINS
        from mjx_climb.scenario.yaml_text import pairs
        from mjx_climb.walk.structure import structure
        from tuning.gains import gains_file
        from tuning.gains.own_section import of_one, taken, without
        from tuning.problem.evaluation import Problem

        named = self.law
        if named is None and self.gains is not None and self.controller is None:
            named = gains_file.shipped_law(self.gains)
            named = None if gains_file.of_scenarios(named) else named
        if named is not None and ":" not in named and not is_shipped(named):
            known = ", ".join([*get_args(Controller), *SHIPPED])
            raise InputError(f"--law: expected one of {known}, or FILE.py:NAME, got {named!r}")
        source, (law, metrics) = str(shipped.found(self.config)), own_objects(named, self.metrics)
        typed = dict(pairs(self.changes, source))
        changes = self._components(source, typed) | typed
        if self.controller is not None:
            if self.law is not None:
                raise InputError(f"--controller: expected none with --law, got {self.controller}")
            changes["own.law"] = None
        own = mc.load_scenario(source, {key: value for key, value in changes.items() if key.split(".")[0] == "own"})
        _, law, metrics = taken(own, law, metrics, source)
        if law is not None:
            gains = {f"control.{name}" for name in law.GAINS}
            mine = {key: changes.pop(key) for key in list(changes) if key in gains}
            for key in changes:
                if key.split(".")[0] == "control" and key.removeprefix("control.") not in JOINT_GAINS:
                    expected = f"one of {', '.join([*law.GAINS, *JOINT_GAINS])} in control"
                    raise InputError(f"--set {key}: expected {expected}, which {type(law).__name__} reads")
            try:
                law = of_one(law, {key[8:]: value for key, value in mine.items()}) if mine else law
            except (TypeError, ValueError) as error:
                raise InputError(f"--set {', '.join(mine)}: {error}") from None
        scenario = without(scenario_from(Path(source), changes, self.hardware, self.controller))
        scenario = scenario.with_overrides({"gravity": inclined(scenario.gravity, self.slope, self.roof)})
        structure(scenario, self.engine, own_parameters(scenario, source))  # refuses a scenario that cannot walk
        if self.gains is not None and self.law is None:
            scenario, law = self._of_file(self.gains, scenario, law, changes)
        elif self.gains is not None and law is not None:
            law = gains_file.limited(self.gains, law)
        return Problem(scenario, law=law, metrics=metrics, engine=self.engine)

    def _components(self, source: str, typed: dict[str, Any]) -> dict[str, Any]:
        """Return contact, drive and disturbances as changes of the config, which those of `--set` may follow.

        Their kinds among the changes `typed` with `--set` are taken out of these.
        """
        from mjx_climb.scenario.load import load_hardware, with_hardware
        from tuning.gains.own_section import named_by

        changes: dict[str, Any] = {}
        hardware = None if self.hardware is None else load_hardware(self.hardware)
        for option, text, place in (("--contact", self.contact, "contact"), ("--drive", self.drive, "hardware.servo")):
            if isinstance(typed.get(f"{place}.kind"), str):
                option, text = f"--set {place}.kind", typed.pop(f"{place}.kind")
            if text is not None:
                base = mc.load_scenario(source)
                base = base if hardware is None else with_hardware(base, hardware)
                section = base.contact if place == "contact" else base.hardware.servo
                changes[place] = named_by(text, place, option, section)
        if self.disturbances:
            named_ones = [named_by(text, "disturbance.others", "--disturbance") for text in self.disturbances]
            changes["disturbance.others"] = named_ones
        return changes

    def _of_file(
        self, file: Path, scenario: "mc.Scenario", law: "mc.Law | None", changes: Mapping[str, Any]
    ) -> "tuple[mc.Scenario, mc.Law | None]":
        """Return scenario and law with the one that a gains file names; options may not ask for another."""
        from tuning.gains import gains_file

        place, own = gains_file.walker(file, scenario, law)
        typed = "--controller" if self.controller else "--set control.controller"
        if (self.controller or "control.controller" in changes) and (place, own) != (scenario, law):
            expected = f"none with {file}, whose gains are of {gains_file.shipped_law(file)}"
            raise InputError(f"{typed}: expected {expected}, got {scenario.control.controller}")
        return place, own

    def load_with_gains(self) -> "Problem":
        """Return the result of `load`, with the values of the gains file in the scenario or the law."""
        from mjx_climb.inputs.time_step import check_time_step

        loaded = self.load()
        if (values := self.values(loaded.law)) is not None:
            loaded = loaded.with_gains(values)
            check_time_step(loaded.scenario, str(self.gains))
        return loaded

    def values(self, law: "mc.Law | None") -> "AnyGains | None":
        """Return the values of the gains file, None without one."""
        from tuning.gains import gains_file

        return None if self.gains is None else gains_file.load(self.gains, law)


def fitted(walk: Walk, command: str) -> "Problem":
    """Return the result of `Walk.load`, for a command that models grippers and servos alone.

    Raises InputError for another contact, drive or disturbance: the log tells how the robot was disturbed.
    """
    loaded = walk.load()
    for place, named in loaded.scenario.kinds.items():
        raise InputError(f"{walk.config}: {place}.kind: expected none with {command}, got {named.name}")
    return loaded


def inclined(gravity: tuple[float, float, float], slope: float | None, roof: bool) -> tuple[float, float, float]:
    """Return gravity in the axes of ground that lies as --slope and --roof say, m/s^2, x up the slope.

    It is as strong as `gravity`, and the same where neither is given. Raises InputError: both are, or gravity is none.
    """
    if roof and slope is not None:
        raise InputError(f"--roof: expected none with --slope {slope:g}")
    slope = 180.0 if roof else slope
    if slope is None:
        return gravity
    if not (strength := math.hypot(*gravity)):
        raise InputError(f"{'--roof' if roof else '--slope'}: expected gravity, got none")
    sine, cosine = (round(turn(math.radians(slope)), 12) for turn in (math.sin, math.cos))
    return -strength * sine + 0.0, 0.0, -strength * cosine + 0.0


def _formats(text: str) -> tuple[str, ...]:
    formats = tuple(dict.fromkeys(name.strip().lower() for name in text.split(",")))
    if unknown := [name for name in formats if name not in FORMATS]:
        raise ValueError(f"expected some of {', '.join(FORMATS)}, got {unknown[0]!r}")
    return formats


Figures = Annotated[tuple[str, ...], BeforeValidator(_formats)]
FIGURES = setting("png", f"formats of the pictures, with commas: some of {', '.join(FORMATS)}", metavar="LIST")


class Output(Options):
    """The output."""

    out: Path | None = setting(None, "folder for the results", metavar="DIR")
    figures: Figures = FIGURES
    sections: tuple[str, ...] = setting(
        (), "section of your own for the report; the file is run", flag="--section", metavar="FILE.py:NAME"
    )
    json_only: bool = setting(False, "print JSON alone on standard output, all else on standard error", flag="--json")

    @contextlib.contextmanager
    def session(self, *, walks: bool = False) -> Iterator["Session"]:
        """Give the session that the command prints to; where it walks, JAX's devices begin to start.

        Raises ConfigError: a section is not there.
        """
        from tuning.command_line.session import Session

        sections = []
        if self.sections:
            from tuning.pages.section import load_section

            sections = [load_section(text) for text in self.sections]
        with reserved_stdout() as stdout, processes.devices_begun() if walks else contextlib.nullcontext():
            with contextlib.closing(Session(stdout, self.out, self.json_only, self.figures, sections)) as session:
                yield session


class Members(Options):
    """Which members of an ensemble walk in place of the config's own walk."""

    ensemble: Path | None = setting(None, ENSEMBLE, metavar="FILE", complete="ensemble")
    members: int | None = setting(None, "walks of the ensemble; null: the file's", ge=1)

    def load(self) -> "Ensemble | None":
        """Return the ensemble, None without one."""
        if self.ensemble is not None:
            return self.loaded(self.ensemble)
        for name in self.model_fields_set & {"members", "test_members"}:
            raise InputError(f"--{name.replace('_', '-')}: expected --ensemble with it")
        return None

    def loaded(self, file: Path) -> "Ensemble":
        """Return an ensemble with as many members as were asked for."""
        from tuning.problem.ensemble import Ensemble

        return Ensemble.load(shipped.found(file), **self.model_dump(include={"members"}, exclude_unset=True))


class SearchFile(Options):
    """A search for gains: the file of its settings."""

    search: Path | None = setting(None, "settings of the search, YAML; options change them", metavar="FILE")

    def settings(self, typed: Search, loaded: "Problem", config: Path) -> "tuple[Search, Space]":
        """Return the settings of the file with those that were typed in their place, and the space of the scenario."""
        from tuning.problem.spaces import space

        wanted = self.joined(typed, loaded)
        with self.naming(typed, config):
            return wanted, space(loaded.scenario, wanted, loaded.law)

    def joined(self, typed: Search, loaded: "Problem") -> Search:
        """Return the result of `settings`, before the gains that they name are looked for."""
        own = Search() if self.search is None else Search.load(self.search)
        check_metrics(own, loaded.metrics, str(self.search), over_ensemble=True)
        wanted = own.changed(typed.model_dump(exclude_unset=True), "options")
        check_metrics(wanted, loaded.metrics, "--weight, --limit", over_ensemble=True)
        return wanted

    @contextlib.contextmanager
    def naming(self, typed: Search, otherwise: Path | str | None = None) -> Iterator[None]:
        """Name where a setting that is refused stands: its option, the file, or `otherwise`."""
        from mjx_climb.scenario.messages import ConfigError

        try:
            yield
        except ConfigError as error:
            key = "" if error.source else error.key.partition(".")[0]
            file = self.search if key in Search.model_fields else None
            if (place := None if key in typed.model_fields_set else file or otherwise) is not None:
                raise error.moved(source=": ".join(filter(None, (str(place), error.source)))) from None
            raise error.moved(key=in_options(error.key, Search) if key else error.key) from None


def scenario_from(
    config: Path, changes: Mapping[str, Any], hardware: str | None = None, controller: str | None = None
) -> "mc.Scenario":
    """Return the scenario of a config with the options applied, `changes` last, before any gains file."""
    from mjx_climb.execution import paths
    from mjx_climb.gait.base_path import check_base
    from mjx_climb.gait.first_holds import check_first_holds
    from mjx_climb.inputs.time_step import check_time_step
    from mjx_climb.robot_import.load import check_stance
    from mjx_climb.scenario.load import load_hardware, with_hardware
    from mjx_climb.scenario.model import overridden
    from mjx_climb.terrain import check_reach

    config = shipped.found(config)
    paths.begin()  # the walk of this scenario asks for it
    scenario = mc.load_scenario(config, () if hardware else changes)
    if hardware:
        scenario = overridden(with_hardware(scenario, load_hardware(hardware), hardware), changes, str(config))
    if controller is not None:
        scenario = scenario.with_overrides({"control.controller": controller})
    on_stand = not isinstance(scenario.robot, str) and scenario.robot.on_stand  # walks are refused later
    for check in () if on_stand else (check_stance, check_base, check_first_holds, check_reach, check_time_step):
        check(scenario, str(config))
    return scenario


def own_objects(law: str | None, metrics: tuple[str, ...]) -> "tuple[mc.Law | None, mc.MetricTable]":
    """Return the law of `--law`, None without one, and the shipped metrics with those of `--metric` behind them."""
    from tuning.gains.own_section import load_law, load_metrics

    return None if law is None else load_law(law), load_metrics(metrics)


@contextlib.contextmanager
def reserved_stdout() -> Iterator[Any]:
    """Give standard output to one writer; all other prints go to standard error."""
    stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        yield stdout
