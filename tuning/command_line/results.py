"""`mjx-climb plot`, `reproduce` and `export`: pictures and other forms of results."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import AfterValidator, BeforeValidator

import mjx_climb as mc
from tuning.command_line.from_models import command
from tuning.command_line.options import (
    ENGINE,
    FIGURES,
    HARDWARE,
    EngineName,
    Figures,
    Output,
    reserved_stdout,
    scenario_from,
)
from tuning.command_line.program import InputError, user_error
from tuning.problem.settings import Options, setting

_BESIDE = "config.yaml"  # of a search, beside its gains


def _inches(text: str) -> tuple[float, float]:
    try:
        width, height = (float(part) / 25.4 for part in text.lower().split("x"))
    except ValueError:
        raise ValueError(f"expected WxH in mm, as 180x120, got {text!r}") from None
    if not (0.4 <= width <= 100 and 0.4 <= height <= 100):
        raise ValueError(f"expected 10 to 2540 mm each way, got {text!r}")
    return width, height


def _style(sheet: str) -> dict[str, object]:
    """Return the settings of a style sheet, a file's or one of matplotlib's by name."""
    from matplotlib import rc_params_from_file, style

    try:
        named = style.library.get(sheet)
        found = rc_params_from_file(sheet, use_default_template=False) if named is None else named
    except (OSError, ValueError) as error:
        raise ValueError(f"expected a style sheet of matplotlib's, got {sheet!r}: {error}") from None
    return {str(name): value for name, value in found.items()}


class Plot(Options):
    """The pictures."""

    folder: Path = setting(..., "folder of a result, as a command wrote it", metavar="FOLDER", argument=True)
    metric: tuple[str, ...] = setting(
        (), "metric to draw by itself, of a map or an ensemble", metavar="NAME", complete="metric"
    )
    figures: Figures = FIGURES
    out: Path | None = setting(None, "folder for the pictures; null: FOLDER", metavar="DIR")
    figure_size: Annotated[tuple[float, float] | None, BeforeValidator(_inches)] = setting(
        None, "width and height, mm; null: a column of a paper", metavar="WxH"
    )
    dpi: int = setting(300, "dots per inch of PNG", ge=20, le=2400)
    style: Annotated[dict[str, object], BeforeValidator(_style)] = setting(
        {}, "style sheet of matplotlib's, over this program's own", metavar="FILE"
    )


@command("How does a result look, drawn otherwise?")
def plot(asked: Plot) -> None:
    """Draw the pictures of a result again: any metric, format, size and style. Nothing is walked.

    For results of run, sweep, tune (--against and --over too) and evaluate.

    \b
    Examples:
      mjx-climb plot results/case_1_2-sweep --metric peak_pull_force --metric min_tsm
      mjx-climb plot results/case_1_2-tune-gradient-isotropic --figures svg,pdf --out paper
      mjx-climb plot results/case_2-pd --figure-size 180x200 --style journal.mplstyle
    """
    from mjx_climb.viz import plots
    from tuning.pages import redrawn

    folder, out = asked.folder, asked.out or asked.folder
    with plots.over_style(asked.style):
        try:
            for name, figure in redrawn.figures(folder, asked.metric):
                if asked.figure_size is not None:
                    figure.set_size_inches(*asked.figure_size)
                for path in plots.save_figure(figure, out / name, asked.figures, dpi=asked.dpi):
                    typer.echo(path)
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
            if user_error(error):
                raise
            # a file of another program, or one with gaps
            got = f"one that cannot be drawn ({type(error).__name__}: {error})"
            raise mc.ConfigError(folder, "", "a result as a command wrote it, with all its files", got) from None


@command("Does what the paper claims hold here?", "results/reproduce")
def reproduce(output: Annotated[Output, "out", "json_only"]) -> None:
    """Walk the paper's three cases under every controller and compare with the paper's statements.

    Runs pd, pd whose base reference follows the actual base, base admittance (Eq. 3) in both readings and
    end-effector admittance (Eq. 2), with the paper's gains and in double precision: a minute or two, most of it
    the compiler's the first time. Where a gripper lets go, the walk is repeated with grippers that never do.

    Prints all metrics beside the paper's numbers, and for each claim whether it holds here. Writes to DIR all of it
    (report.html to look through in a browser, reproduce.json, tables.txt, paper.md), the baseline and the proposed
    controller over time (case_1_1.png, ...), the resolved scenarios (case_1_1.yaml, ...) and each walk
    (case_1_1-pd.nc, ..., 7 MB each, open with xarray).

    \b
    Examples:
      mjx-climb reproduce
      mjx-climb reproduce --out results/paper --json
    """
    with output.session() as shell:
        from tuning.command_line.session import WIDTH, console, print_on
        from tuning.numbers import to_json
        from tuning.reproduce import results

        shell.claim("reproduce.json", "reproduce", settings={"command": "reproduce"})
        shell.opening()
        with shell.whole() as out:
            found = dict(results.reproduced(out, shell.stage))
            said: list[Any] = [*results.tables(found), *results.lines(found)]
            shell.show(*said)
            with (captured := console()).capture() as capture:
                captured.width = WIDTH
                print_on(captured, *said)
            text = to_json(results.as_json(found)) + "\n"
            files = {"reproduce.json": text, "paper.md": results.as_markdown(found), "tables.txt": capture.get()}
            names = shell.fill(out, files, lambda at: results.page(found, out, at), "mjx-climb reproduce --out again")
            count = len(list(out.glob("*.nc")))
        shell.written(f"{names}, figures (.png), scenarios (.yaml), {count} walks (.nc)", text)


def _identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier()):
        raise ValueError(f"expected ASCII letters, digits and underscores, got {name!r}")
    return name


ROBOTS_OWN = ("ros2_control", "admittance_control")  # formats of controllers that integrate Eqs. 2 and 3 by themselves


class Export(Options):
    """The form of the gains, and the scenario that they must hold in."""

    gains: Path = setting(..., "gains file, as tune writes it", metavar="GAINS", argument=True)
    form: Literal["ros2_control", "admittance_control", "json", "csv"] = setting(
        "ros2_control",
        "what to write: parameters of ros2_control's admittance_controller or of the C++ library admittance_control, "
        "or a table",
        flag="--format",
    )
    config: Path | None = setting(
        None,
        f"scenario in which the gains must hold; null: {_BESIDE} beside GAINS, where it runs no file of Python",
        metavar="CONFIG",
        complete="config",
    )
    rate: int | None = setting(
        None,
        "update rate of the controller, Hz; null: the config's, 1000 without one",
        flag="--update-rate",
        metavar="HZ",
        ge=1,
        le=1_000_000,
    )
    name: Annotated[str, AfterValidator(_identifier)] = setting(
        "admittance_controller", "name of the controller in the parameter file", metavar="NAME"
    )
    out: Path | None = setting(None, "file to write, of load transfer a folder; null: standard output", metavar="FILE")
    hardware: str | None = HARDWARE
    engine: EngineName = ENGINE

    def load_transfer(self) -> "mc.Law | None":
        """Return load transfer where the gains are of that law, None elsewhere."""
        from mjx_climb.control import LoadTransfer
        from tuning.gains import gains_file

        if gains_file.shipped_law(self.gains) != LoadTransfer.__name__:
            return None
        if "form" in self.model_fields_set:
            raise InputError(
                f"--format: expected none with gains of LoadTransfer, which have one form, got {self.form}"
            )
        return gains_file.limited(self.gains, LoadTransfer())

    def scenario(self, law: "mc.Law | None") -> "mc.Scenario | None":
        """Return the scenario that the gains of a law (None: the scenario's) must hold in, at the update rate.

        None where there is no config.
        """
        from mjx_climb.scenario.messages import ConfigError
        from tuning.gains import gains_file
        from tuning.gains.own_section import without

        beside = self.gains.parent / _BESIDE
        if (config := beside if self.config is None and beside.is_file() else self.config) is None:
            if self.hardware is not None:
                raise InputError("--hardware: expected --config with it")
            return None
        for place, each in mc.load_scenario(config).kinds.items() if self.config is None else ():
            if each.file is not None:
                expected = f"none in a config that was found, not given (--config {config} runs it)"
                raise ConfigError(str(config), f"{place}.kind", expected, each.kind)
        scenario, _ = gains_file.walker(self.gains, scenario_from(config, {}, self.hardware))
        if self.rate is not None:
            period = 0.0 if self.rate == round(1 / scenario.time_step) else 1 / self.rate
            try:
                scenario = scenario.with_overrides({"hardware.control_period": period})
            except ConfigError:
                expected = f"a whole number of the config's time steps of {scenario.time_step:g} s"
                raise InputError(f"--update-rate: expected one whose period is {expected}, got {self.rate}") from None
        if law is not None:
            return without(scenario)
        control = scenario.control
        if control.controller == "pd":
            raise ConfigError(str(config), "control.controller", "an admittance law, whose gains these are", "pd")
        if control.reading != "virtual_model" and self.form in ROBOTS_OWN:
            expected = "virtual_model, which is what the controller integrates"
            raise ConfigError(str(config), "control.reading", expected, control.reading)
        exact = self.form != "admittance_control"
        return scenario if exact else scenario.with_overrides({"control.integration": "semi_implicit"})


@command("How do gains get onto my robot?")
def export(asked: Export) -> None:
    """Write gains for the robot's own controller.

    First they walk in the config, on its hardware and at the update rate: gains that are unstable there, or tear a
    gripper off, are refused, and a margin of less than twice the hardware (see mjx-climb evaluate) is a warning. A
    force filter that the law has (hardware.force_sensor.filtered_by=law) is written with them.

    ros2_control's admittance_controller integrates the law with explicit damping, so gains that are fine here may
    diverge there: those are refused, and you are told which update rate or virtual inertia would do. The library
    admittance_control has one mass, damping and stiffness for forces and one for moments: gains that differ between
    their axes are refused. docs/guides/ros2_control.md has the mapping of parameters and frames to the law used here.

    Gains of load transfer (`law: LoadTransfer` in GAINS) have one form: load_transfer.yaml, load_transfer_gains.hpp,
    and load_transfer.hpp, which is the law in C++.

    \b
    Examples:
      mjx-climb export results/case_1_2-tune-gradient-isotropic/gains.yaml --hardware dynamixel_x
      mjx-climb export gains.yaml --config case_1_2 --format admittance_control --update-rate 200
      mjx-climb export gains.yaml --format csv --out gains.csv
      mjx-climb export transfer.yaml --config case_1_1 --hardware dynamixel_x --out include
    """
    with reserved_stdout() as stdout:
        from mjx_climb.control import PD
        from mjx_climb.files import dataset
        from mjx_climb.inputs.gait_values import gait_of
        from mjx_climb.scenario.messages import ConfigError
        from tuning.command_line.session import Session
        from tuning.comparisons import deployment
        from tuning.gains import gains_file

        session = Session(stdout)
        source, law = str(asked.gains), asked.load_transfer()
        values = gains_file.by_name(gains_file.load(asked.gains, law))
        if gains_file.shipped_law(asked.gains) == PD.__name__:
            raise ConfigError(source, "law", "an admittance law, whose gains are exported", "pd")
        scenario, gait = asked.scenario(law), gait_of(values)
        scenario = None if scenario is None else gains_file.with_gait(scenario, gait, source)
        gains: Any = {name: value for name, value in values.items() if name not in gait}
        not_said = ""
        if law is None:
            gains = mc.Gains(**gains)
            kind, not_said = _law_in(asked, scenario)
            text, notes = _written(asked, gains, kind, gait, scenario)
            files = {"": text}
        else:
            files, notes = _load_transfer(asked, values, scenario)
        if scenario is None:
            missing = f"no {_BESIDE} beside {asked.gains.name} and no --config: these gains were not walked"
            said = [f"note: {line}" for line in (missing + not_said, *notes)]
        else:
            of_servos = gains_file.registers_in_words(scenario, values)
            said = [f"note: {line}" for line in (*notes, *([of_servos] if of_servos else ()))]
            how: dict[str, Any] = {"law": law, "engine": asked.engine, "stage": session.stage}
            said += [f"warning: {line}" for line in deployment.check(scenario, gains, source, **how)]
        session.say(*(f"mjx-climb: {line}" for line in said))
        if asked.out is None:
            print(next(iter(files.values())), end="", file=stdout)
            return
        written = [
            dataset.write_text_atomically(asked.out / name, text) for name, text in files.items()
        ]  # "": FILE itself
        session.say(f"wrote {', '.join(map(str, written))}")


def _law_in(asked: Export, scenario: "mc.Scenario | None") -> "tuple[type[mc.Law], str]":
    """Return the law whose gains are exported, and a note where nobody says which it is."""
    from mjx_climb.control import SHIPPED, MeasuredPoseAdmittance, VirtualModelAdmittance, law_of
    from mjx_climb.scenario.messages import ConfigError
    from tuning.gains import gains_file

    if scenario is not None:
        return type(law_of(scenario)), ""
    if (name := gains_file.shipped_law(asked.gains)) is None:
        return VirtualModelAdmittance, f", and no law is named: they are taken for {VirtualModelAdmittance.__name__}'s"
    law = SHIPPED[name]
    if law is MeasuredPoseAdmittance and asked.form in ROBOTS_OWN:
        expected = f"{VirtualModelAdmittance.__name__}, which is what the controller integrates"
        raise ConfigError(str(asked.gains), "law", expected, name)
    return law, ""


def _written(
    asked: Export, gains: "mc.Gains", law: "type[mc.Law]", gait: Mapping[str, Any], scenario: "mc.Scenario | None"
) -> tuple[str, list[str]]:
    """Return the gains of a law, and their gait, in the form that was asked for, and notes on it."""
    from mjx_climb.control import law_of
    from mjx_climb.control.virtual_mass import Motion
    from tuning.gains import admittance_control, gains_file, gains_tables, interfaces, ros2_control

    source, rate, cutoff = str(asked.gains), asked.rate or 1000, None
    if asked.form in ("json", "csv"):
        return (gains_tables.write_json if asked.form == "json" else gains_tables.write_csv)(gains, law, gait), []
    own = ", ".join(f"{key.removeprefix('gait.')} {float(value):.4g}" for key, value in gait.items())
    gait_note = [f"the gait that belongs to these gains is no parameter of the controller: {own}"] if gait else []
    if scenario is not None:
        rate = round(1 / (scenario.hardware.control_period or scenario.time_step))
        cutoff = scenario.hardware.force_sensor.filter
    of_axes = interfaces.of_law(gains, law)
    if asked.form == "ros2_control":
        ros2_control.check(of_axes, rate, source)
        notes: list[str] = []
        if scenario is not None and cutoff is not None and scenario.hardware.force_sensor.filtered_by != "law":
            notes.append(
                f"the config's sensors filter their forces at {cutoff:g} Hz: filter_coefficient 1, so that they are "
                "not filtered twice; where admittance_controller is to filter in their place, walk and search with "
                "hardware.force_sensor.filtered_by=law"
            )
        of_servos = "" if scenario is None else gains_file.registers_in_words(scenario, gains)
        parts = asked.name, None if notes else cutoff, of_servos, law
        return ros2_control.write(of_axes, rate, *parts), notes + gait_note
    admittance_control.check(of_axes, 1 / rate, source)
    motion = getattr(None if scenario is None else law_of(scenario), "motion", Motion())
    text = admittance_control.write(of_axes, 1 / rate, motion, law)
    note = f"admittance_control filters nothing: give it forces behind a low pass of {cutoff:g} Hz" if cutoff else ""
    return text, [note, *gait_note] if note else gait_note


def _load_transfer(
    asked: Export, values: Mapping[str, Any], scenario: "mc.Scenario | None"
) -> tuple[dict[str, str], list[str]]:
    """Return the files for a robot under load transfer, by name, and notes on them; values of a whole gains file."""
    from mjx_climb.control import LoadTransfer
    from mjx_climb.inputs.resolve import with_gains
    from tuning.gains import gains_file, load_transfer

    law = LoadTransfer(**vars(with_gains(asked.load_transfer() or LoadTransfer(), values)))
    if scenario is None:
        others = {name: value for name, value in values.items() if name not in LoadTransfer.GAINS}
        return load_transfer.texts(law, 1 / (asked.rate or 1000), given=others), []
    walked = gains_file.applied(scenario, values)
    period, cutoff = walked.hardware.control_period or walked.time_step, walked.hardware.force_sensor.filter
    note = f"load_transfer.hpp filters nothing: give it forces behind a low pass of {cutoff or 0:g} Hz"
    return load_transfer.texts(law, period, walked), [] if cutoff is None else [note]
