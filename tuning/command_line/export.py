"""`mjx-climb export`: gains in the form that a robot's controller takes."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tuning.command_line import completion, options
from tuning.command_line.ending import InputError

if TYPE_CHECKING:
    import mjx_climb as mc

_BESIDE = "config.yaml"  # what a search leaves beside its gains


def export(
    gains: Annotated[Path, typer.Argument(metavar="GAINS", help="Gains file, as tune writes it.")],
    form: Annotated[
        Literal["ros2_control", "admittance_control", "json", "csv"],
        typer.Option(
            "--format",
            help="What to write: parameters of ros2_control's admittance_controller or of the C++ library "
            "admittance_control, or a table.",
        ),
    ] = "ros2_control",
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="CONFIG",
            help="Scenario in which the gains must hold.",
            show_default=f"{_BESIDE} beside GAINS",
            autocompletion=completion.config,
        ),
    ] = None,
    hardware: options.Hardware = None,
    rate: Annotated[
        int | None,
        typer.Option(
            "--update-rate",
            min=1,
            max=1_000_000,
            metavar="HZ",
            help="Update rate of the controller, Hz.",
            show_default="the config's, 1000 without one",
        ),
    ] = None,
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the controller in the parameter file.")
    ] = "admittance_controller",
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File to write.", show_default="standard output")
    ] = None,
    engine: options.Engine = None,
) -> None:
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
    with options.reserved_stdout() as stdout:
        from mjx_climb.control import law_of
        from mjx_climb.control.motion import Motion
        from mjx_climb.files import dataset
        from tuning.gains import admittance_control, gains_file, gains_tables, ros2_control
        from tuning.judged import deployment

        loaded, source = gains_file.load(gains), str(gains)
        if not (name.isascii() and name.isidentifier()):
            raise InputError(f"--name: expected ASCII letters, digits and underscores, got {name!r}")
        if config is None and (gains.parent / _BESIDE).is_file():
            config = gains.parent / _BESIDE
        if hardware is not None and config is None:
            raise InputError("--hardware: expected --config with it")
        scenario = None if config is None else _at_rate(options.scenario_from(config, None, None, hardware), rate)
        if scenario is not None and config is not None:
            _check_law(scenario, form, config)
            rate = round(1 / (scenario.hardware.control_period or scenario.time_step))
            if form == "admittance_control":
                scenario = scenario.with_overrides({"control.integration": "semi_implicit"})
        rate, notes = rate or 1000, []
        cutoff = None if scenario is None else scenario.hardware.force_sensor.filter

        if form == "ros2_control":
            ros2_control.check(loaded, rate, source)
            if scenario is not None and cutoff is not None and scenario.hardware.force_sensor.filtered_by == "sensor":
                notes.append(
                    f"the config's sensors filter their forces at {cutoff:g} Hz: filter_coefficient 1, so that they "
                    "are not filtered twice; where admittance_controller is to filter in their place, walk and search "
                    "with hardware.force_sensor.filtered_by=law"
                )
                cutoff = None
            text = ros2_control.write(loaded, rate, name, cutoff)
        elif form == "admittance_control":
            admittance_control.check(loaded, 1 / rate, source)
            law = None if scenario is None else law_of(scenario)
            motion = getattr(law, "motion", Motion())
            forces = scenario is not None and scenario.control.controller == "end_effector_admittance"
            text = admittance_control.write(loaded, 1 / rate, motion, forces_only=forces)
            if cutoff is not None:
                notes.append(f"admittance_control filters nothing: give it forces behind a low pass of {cutoff:g} Hz")
        else:
            text = {"json": gains_tables.write_json, "csv": gains_tables.write_csv}[form](loaded)
        if scenario is None:
            said = [f"note: no {_BESIDE} beside {gains.name} and no --config: these gains were not walked"]
        else:
            said = deployment.check(scenario, loaded, source, engine=options.engine_from(engine))
            said = [f"note: {line}" for line in notes] + [f"warning: {line}" for line in said]
        for line in said:
            print(f"mjx-climb: {line}", file=sys.stderr)
        if out is None:
            print(text, end="", file=stdout)
        else:
            dataset.write_text_atomically(out, text)


def _check_law(scenario: "mc.Scenario", form: str, config: Path) -> None:
    """Refuse a config whose law is not the one that is written.

    Raises:
        ConfigError: in one line, the key.
    """
    from mjx_climb.scenario.messages import config_error

    control = scenario.control
    if control.controller == "pd":
        raise config_error(str(config), "control.controller", "an admittance law, whose gains these are", "pd")
    if control.reading != "virtual_model" and form in ("ros2_control", "admittance_control"):
        expected = "virtual_model, which is what the controller integrates"
        raise config_error(str(config), "control.reading", expected, control.reading)


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
