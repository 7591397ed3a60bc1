"""`mjx-climb export`: gains in the form that a robot's controller takes."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator

from tuning.command_line.from_models import command
from tuning.command_line.options import ENGINE, HARDWARE, EngineName, reserved_stdout, scenario_from
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    import mjx_climb as mc

_BESIDE = "config.yaml"  # what a search leaves beside its gains


def _identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier()):
        raise ValueError(f"expected ASCII letters, digits and underscores, got {name!r}")
    return name


class Export(Options):
    """What is written, and in which scenario it must hold."""

    gains: Path = setting(..., "gains file, as tune writes it", metavar="GAINS", argument=True)
    form: Literal["ros2_control", "admittance_control", "json", "csv"] = setting(
        "ros2_control",
        "what to write: parameters of ros2_control's admittance_controller or of the C++ library admittance_control, "
        "or a table",
        flag="--format",
    )
    config: Path | None = setting(
        None,
        f"scenario in which the gains must hold; null: {_BESIDE} beside GAINS",
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
    out: Path | None = setting(None, "file to write; null: standard output", metavar="FILE")
    hardware: str | None = HARDWARE
    engine: EngineName = ENGINE

    def scenario(self) -> "mc.Scenario | None":
        """Return the scenario in which the gains must hold, at the update rate, None without one."""
        from mjx_climb.scenario.messages import config_error

        beside = self.gains.parent / _BESIDE
        config = beside if self.config is None and beside.is_file() else self.config
        if config is None:
            if self.hardware is not None:
                raise InputError("--hardware: expected --config with it")
            return None
        scenario = _at_rate(scenario_from(config, hardware=self.hardware), self.rate)
        control = scenario.control
        if control.controller == "pd":
            raise config_error(str(config), "control.controller", "an admittance law, whose gains these are", "pd")
        if control.reading != "virtual_model" and self.form in ("ros2_control", "admittance_control"):
            expected = "virtual_model, which is what the controller integrates"
            raise config_error(str(config), "control.reading", expected, control.reading)
        exact = self.form != "admittance_control"
        return scenario if exact else scenario.with_overrides({"control.integration": "semi_implicit"})


@command()
def export(asked: Export) -> None:
    """Write gains for the robot's own controller.

    First they walk in the config, on its hardware and at the update rate: gains that are unstable there, or tear a
    gripper off, are refused, and a margin of less than twice the hardware (see mjx-climb margins) is a warning. A
    force filter that the law has (hardware.force_sensor.filtered_by=law) is written with them.

    ros2_control's admittance_controller integrates the law with explicit damping, so gains that are fine here may
    diverge there: those are refused, and you are told which update rate or virtual inertia would do. The library
    admittance_control has one mass, damping and stiffness for forces and one for moments: gains that differ between
    their axes are refused. docs/ros2_control.md has the mapping of parameters and frames to the law used here.

    \b
    Examples:
      mjx-climb export results/case_1_2-tune-gradient-isotropic/gains.yaml --hardware dynamixel_x
      mjx-climb export gains.yaml --config case_1_2 --format admittance_control --update-rate 200
      mjx-climb export gains.yaml --format csv --out gains.csv
    """
    with reserved_stdout() as stdout:
        from mjx_climb.files import dataset
        from tuning.evaluation import deployment
        from tuning.gains import gains_file

        gains, source = gains_file.load(asked.gains), str(asked.gains)
        scenario = asked.scenario()
        text, notes = _written(asked, gains, scenario)
        if scenario is None:
            said = [f"note: no {_BESIDE} beside {asked.gains.name} and no --config: these gains were not walked"]
        else:
            said = [f"note: {line}" for line in notes]
            said += [f"warning: {line}" for line in deployment.check(scenario, gains, source, engine=asked.engine)]
        for line in said:
            print(f"mjx-climb: {line}", file=sys.stderr)
        if asked.out is None:
            print(text, end="", file=stdout)
        else:
            dataset.write_text_atomically(asked.out, text)


def _written(asked: Export, gains: "mc.Gains", scenario: "mc.Scenario | None") -> tuple[str, list[str]]:
    """Return the gains in the form that was asked for, and notes on it."""
    from mjx_climb.control import law_of
    from mjx_climb.control.virtual_mass import Motion
    from tuning.gains import admittance_control, gains_tables, ros2_control

    source, rate, cutoff = str(asked.gains), asked.rate or 1000, None
    if scenario is not None:
        rate = round(1 / (scenario.hardware.control_period or scenario.time_step))
        cutoff = scenario.hardware.force_sensor.filter
    if asked.form == "ros2_control":
        ros2_control.check(gains, rate, source)
        if scenario is None or cutoff is None or scenario.hardware.force_sensor.filtered_by == "law":
            return ros2_control.write(gains, rate, asked.name, cutoff), []
        note = (
            f"the config's sensors filter their forces at {cutoff:g} Hz: filter_coefficient 1, so that they are not "
            "filtered twice; where admittance_controller is to filter in their place, walk and search with "
            "hardware.force_sensor.filtered_by=law"
        )
        return ros2_control.write(gains, rate, asked.name, None), [note]
    if asked.form == "admittance_control":
        admittance_control.check(gains, 1 / rate, source)
        motion = getattr(None if scenario is None else law_of(scenario), "motion", Motion())
        forces = scenario is not None and scenario.control.controller == "end_effector_admittance"
        text = admittance_control.write(gains, 1 / rate, motion, forces_only=forces)
        note = (
            f"admittance_control filters nothing: give it forces behind a low pass of {cutoff:g} Hz" if cutoff else ""
        )
        return text, [note] if note else []
    return (gains_tables.write_json if asked.form == "json" else gains_tables.write_csv)(gains), []


def _at_rate(scenario: "mc.Scenario", rate: int | None) -> "mc.Scenario":
    """Return the scenario with its law at an update rate in Hz."""
    from mjx_climb.scenario.messages import ConfigError

    if rate is None or rate == round(1 / scenario.time_step):
        return scenario if rate is None else scenario.with_overrides({"hardware.control_period": 0.0})
    try:
        return scenario.with_overrides({"hardware.control_period": 1 / rate})
    except ConfigError:
        step = scenario.time_step
        raise InputError(
            f"--update-rate: expected one whose period is a whole number of the config's time steps of {step:g} s, "
            f"got {rate}"
        ) from None
