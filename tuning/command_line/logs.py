"""Commands about a robot's log: the motion for one, the parameters in it, the simulation beside it."""

import contextlib
import importlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import mjx_climb as mc
from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk, fitted
from tuning.command_line.program import InputError, repeated
from tuning.command_line.run import Pictures
from tuning.identification.plan.settings import Excitation
from tuning.problem.settings import NonNegative, Options, setting

if TYPE_CHECKING:
    from tuning.command_line.session import Session
    from tuning.identification.model.replay import Replay
    from tuning.identification.readers.log import Log
    from tuning.problem.evaluation import Problem


@command("What must a robot do to be identified?", "results/<config>-excite")
def excite(
    walk: Annotated[Walk, "config", "hardware", "changes", "slope", "roof"], asked: Excitation, output: Output
) -> None:
    """Find commands with which the robot's own log tells its parameters.

    Candidates are scaled, stretch by stretch, until joint limits, torque, speed and reach (free: pull of the grippers)
    hold with a margin in the nominal model; the one whose log has the most Fisher information is taken. Prints the
    standard deviations to expect, beside those after a plain chirp, and parameters that the log will not tell apart.

    Writes to DIR the commands (excitation.csv: time, and LF.coxa.command ... in rad; excitation_trajectory.yaml, a
    trajectory_msgs/JointTrajectory), the expectation (excitation.json, report.html) and a picture (excitation).

    \b
    Examples:
      mjx-climb excite case_1_1 --hardware dynamixel_x
      mjx-climb excite case_1_1 --fit hardware.servo.armature --family multisine
      mjx-climb excite case_1_1 --hardware dynamixel_x --kp 25 --kp 50 --mass 0.1 --drop
      mjx-climb excite case_1_1 --base free --fit contact.stiffness --fit contact.damping --json
    """
    with output.session() as shell:
        from tuning.identification.plan import excitation
        from tuning.identification.plan import output as written
        from tuning.numbers import to_json

        loaded = fitted(walk, "excite")
        rig = excitation.set_up(loaded.scenario, asked)
        walk.take(shell, excitation.Excited.FILE, loaded, "excite", asked=asked)
        shell.opening()
        found = excitation.chosen(rig, stage=shell.stage)
        options = (f"--{name.replace('_', '-')}" for name in Excitation.model_fields)
        shell.show(written.table(found), written.limits(found))
        shell.show(*written.notes(found), found.best.information.unseen())
        files = shell.write(found, repeated(("excite",), *options)).files
        shell.written(files, to_json(written.summary(found)))


FILES = ("log", "signals")  # fields of Recorded


class Recorded(Options):
    """The log, how it is read, and how the robot stood."""

    log: Path = setting(..., "log of the robot: .csv, .nc, .mcap, .db3, or the folder of a bag", metavar="FILE")
    signals: Path | None = setting(
        None, "where each signal stands in it, YAML; null: by the names of its columns, or guessed", metavar="FILE"
    )
    base: Literal["held", "free"] | None = setting(
        None, "base on a stand, or on its grippers; null: held where neither base nor foot forces were logged"
    )
    mass: NonNegative = setting(0.0, "known mass that hung on each foot while the log was made, kg")

    def read(self, scenario: "mc.Scenario") -> "Log":
        """Return the log."""
        with interruption.at_once():
            from mjx_climb.robot_import.load import load_robot
            from tuning.identification.readers import read_log

            return read_log(self.log, load_robot(scenario.robot), self.signals)

    def files_from(self, folder: Path) -> list[str]:
        """Return the options that name its files, as seen from another folder: a log may be too large to be copied."""
        named = {name: path for name in FILES if (path := getattr(self, name)) is not None}
        return [word for name, path in named.items() for word in (f"--{name}", os.path.relpath(path, folder))]

    def settings(self, log: "Log") -> dict[str, Any]:
        """Return all that is asked for, as plain JSON values, with the log's samples in place of its file."""
        return {**self.model_dump(mode="json", exclude={"log", "signals"}), "log": log.digest}

    def say_read(self, log: "Log", shell: "Session") -> None:
        """Say where each signal was found, where that was guessed, and faults of the log."""
        if log.guessed is not None:
            how = "guessed where each signal stands (save this as signals.yaml, correct it, --signals signals.yaml):"
            shell.say(f"{self.log}: {how}", log.guessed.to_yaml().rstrip())
        shell.say(*(f"warning: {line}" for line in log.warnings))


class Fitted(Recorded):
    """The parameters that are fitted, and the log."""

    fit: tuple[str, ...] = setting(..., "key that is fitted, or a pattern of keys, as hardware.servo.*", metavar="KEY")
    held_out: float = setting(0.2, "share of the log, at its end, that is predicted and not fitted", ge=0, le=0.8)
    starts: int = setting(4, "points from which the search begins, the config's own among them", ge=1, le=64)


@command("Which parameters does my robot have?", "none: nothing is written")
def identify(
    asked: Fitted, walk: Annotated[Walk, "config", "hardware", "changes", "slope", "roof"], output: Output
) -> None:
    """Fit parameters of a scenario to the robot's own log, made on a stand or as it sways on shut grippers.

    The log holds the commands of the joints and the motion after them, as excite asks for. KEY is one of a scenario's
    (hardware.servo.armature, hardware.command_delay, control.kp), gravity (its direction), or one of the robot's own:
    robot.LF.coxa.armature, friction, damping, zero; robot.LF.coxa.mass, center, inertia. With the base free also
    contact.stiffness, contact.damping, robot.base.mass, hardware.force_sensor.bias and delay, and of one force sensor
    log.LF.force.gain, zero.x, y_in_x.

    Prints values before and after, with 95 % intervals, parameters that the log does not tell, and whether the model is
    right. With --out writes to DIR the scenario as identified (identified.yaml, hardware.yaml for --hardware, and a
    robot's file where it was fitted), an ensemble of the remaining uncertainty (posterior.yaml, for tune and evaluate),
    all numbers (result.json), pictures, and a page (report.html). Every search that ended is kept in DIR: after
    Ctrl-C, or worse, the same command goes on from there.

    \b
    Examples:
      mjx-climb identify case_1_2 --log log.csv --fit hardware.servo.armature --fit control.kp
      mjx-climb identify case_1_2 --log log.mcap --fit control.kp --signals signals.yaml
      mjx-climb identify case_1_2 --log log.csv --fit "robot.*.armature" --out found --json
      mjx-climb identify case_1_1 --log sway.csv --fit contact.stiffness --base free
    """
    with output.session() as shell:
        from tuning.identification.fit import identify as fitting
        from tuning.identification.fit.report import findings, table
        from tuning.identification.fit.result import Identified
        from tuning.methods.parts import FOLDER
        from tuning.writing.record import check_own, settings_of

        if output.out is not None:
            check_own(output.out, Identified.FILE)  # before the log is read
        loaded = walk.load()
        scenario = loaded.scenario
        log = asked.read(scenario)
        asked.say_read(log, shell)
        if output.out is not None:
            settings = settings_of(loaded, "identify", asked=asked.settings(log))
            if (shell.claim(Identified.FILE, walk.config.stem, settings=settings) / FOLDER).exists():
                shell.say(f"an interrupted fit is kept in {output.out}: goes on where it stopped")
        keeping = contextlib.nullcontext() if output.out is None else shell.keeping("iterations")
        with keeping, shell.stage("fit", unit="iterations", keeps=True) as show:
            found = fitting.identify(scenario, progress=show, out=output.out, **dict(asked) | {"log": log})
        shell.show(table(found), *findings(found).lines)
        if output.out is not None:
            options = (f"--{name.replace('_', '-')}" for name in Fitted.model_fields if name not in FILES)
            again = repeated(["identify", *asked.files_from(output.out)], *options)
            shell.written(shell.write(found, again).files, json.dumps(found.as_json(), indent=2))
        else:
            shell.print_json(json.dumps(found.as_json(), indent=2))


class Replayed(Recorded):
    """The log that is replayed, and its rivals."""

    with_law: bool = setting(False, "walk under the config's law too, with the pushes that were logged, and compare")


@command("How far is the simulation from my robot?", "results/<config>-replay")
def replay(
    walk: Annotated[Walk, "-metrics"],
    asked: Replayed,
    output: Annotated[Output, "-sections"],
    pictures: Annotated[Pictures, "video", "size"],
) -> None:
    """Send the commands of a robot's log to the simulated robot, and show how far the two are apart.

    The commands drive the servos of the config (gains of its joint loop, hardware) in place of the law. With the base
    held the robot begins where the log does; else it begins in its rest stance, and its grippers shut and open as the
    config's gait has it, under the pushes that were logged, where any were. Prints the error of each signal. Writes
    replay.json (errors), replay (angles commanded, logged and simulated, and foot forces), simulation.nc, config.yaml
    and, where it was guessed, signals.yaml.

    With --with-law the law of the config, or of --gains, walks under the pushes that were logged, too.

    \b
    Examples:
      mjx-climb replay case_1_2 --log walk.mcap
      mjx-climb replay case_1_2 --hardware dynamixel_x --log excitation.csv --base held
      mjx-climb replay case_1_1 --log drop.csv --mass 0.1
      mjx-climb replay case_2 --log walk.db3 --signals signals.yaml --video
      mjx-climb replay case_2 --log walk.mcap --gains best.yaml --with-law
    """
    with output.session() as shell:
        from tuning.background import background
        from tuning.identification.model import replay as replays
        from tuning.results.config_file import write_config

        loaded = walk.load_with_gains()
        pictures.check(loaded.scenario)
        log = asked.read(loaded.scenario)
        if asked.with_law and not any(name.startswith(("base.force.", "base.moment.")) for name in log.signals):
            raise InputError(f"--with-law: expected pushes in {log.source} (base.force.x ...), got none")
        prepared = replays.prepare(log, loaded.scenario, asked.base, asked.mass)
        walk.take(shell, "replay.json", loaded, "replay", asked=asked.settings(log))
        asked.say_read(log, shell)
        shell.opening()
        with background(busy=1) as begin:
            begin(lambda _: importlib.import_module("mjx_climb.viz.plots"))  # matplotlib takes half a second
            with shell.stage("replay"):
                found = replays.simulate(prepared, loaded.engine)
        under_law = walked_under_law(found, loaded, shell) if asked.with_law else {}
        with shell.whole() as out:
            write_config(found.scenario, out, loaded.law)
            files, text = _write(found, under_law, shell, pictures, out)
        shell.written(files, text)


def walked_under_law(found: "Replay", loaded: "Problem", shell: "Session") -> dict[str, dict[str, Any]]:
    """Walk under the law with the pushes that were logged, and print and return the metrics of both walks."""
    from tuning import numbers
    from tuning.command_line.run import verdict
    from tuning.pages.table import Table

    with shell.stage("law on the logged pushes"):
        pushes = [push.model_dump() for push in found.scenario.disturbance.pushes]
        changes: dict[str, Any] = {"disturbance.pushes": pushes, "duration": found.scenario.duration}
        walked = mc.rollout(loaded.scenario.with_overrides(changes), law=loaded.law, engine=loaded.engine)
    walks, about = {"law": walked, "logged commands": found.walk}, loaded.metrics
    metrics = {name: dict(mc.metrics(walk, about)) for name, walk in walks.items()}
    both = {name: [numbers.number(values[name]) for values in metrics.values()] for name in metrics["law"]}
    rows = [[about.in_words(name), *values, numbers.unit(name, about)] for name, values in both.items()]
    table = Table("", ["metric", *metrics, "unit"], [("", rows)], 1)
    shell.show(table, *(f"{name}: {verdict(walks[name], values)}" for name, values in metrics.items()))
    return metrics


def _write(
    found: "Replay", under_law: Mapping[str, Any], shell: "Session", pictures: Pictures, out: Path
) -> tuple[str, str]:
    """Write a replay into a folder and print its errors; return the names of the files, and the errors as JSON."""
    from mjx_climb.files import dataset
    from tuning import numbers
    from tuning.identification.readers.log import signals_of
    from tuning.pages.contents import Picture
    from tuning.pages.table import Table

    units = {name: each.unit for name, each in signals_of(found.walk.robot).items()}
    rows = [[name, *map(numbers.number, error[:4]), units[name]] for name, error in found.errors.items()]
    table = Table("", ["signal", "rms error", "largest", "at s", "moved", "unit"], [("", rows)], 1)
    shell.show(table, *found.warnings, f"base {found.base}; moved: standard deviation of what was logged")

    from tuning.identification.model.replay_picture import plot_replay

    by_signal = {name: {**error._asdict(), "unit": units[name]} for name, error in found.errors.items()}
    whole = {"base": found.base, "signals": by_signal, "warnings": [*found.log.warnings, *found.warnings]}
    text = numbers.to_json({**whole, "judged": under_law} if under_law else whole) + "\n"
    files: dict[str, Any] = {"replay.json": text, "simulation.nc": dataset.to_dataset(found.walk)}
    if found.log.guessed is not None:
        files["signals.yaml"] = found.log.guessed.to_yaml()
    files["replay"] = Picture("", lambda: plot_replay(found))
    written = shell.fill(out, files)
    more = pictures.write({"logged": found.logged(), "simulated": found.walk}, out, shell.stage)
    return ", ".join([written, *more]), text
