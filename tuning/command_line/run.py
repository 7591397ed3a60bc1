"""`mjx-climb run`: one robot through one scenario, with pictures, video, snapshots and the viewer."""

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import BeforeValidator

import mjx_climb as mc
from mjx_climb.scenario.kinds import Controller
from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.background import Stage
    from tuning.command_line.session import Session
    from tuning.problem.evaluation import Problem

Walks = Mapping[str, "mc.Trajectory"]  # by the name of the controller, in the order in which they are shown
MOST_SNAPSHOTS = 12


def _pixels(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) == 2 and all(part.isascii() and part.isdecimal() and len(part) < 6 for part in parts):
        width, height = map(int, parts)
        if all(64 <= pixels <= 4096 and pixels % 2 == 0 for pixels in (width, height)):
            return width, height
    raise ValueError(f"expected WIDTHxHEIGHT, even numbers from 64 to 4096, got {text!r}")


class Pictures(Options):
    """What is rendered, and which other walk is shown beside."""

    compare: Controller | None = setting(
        None, "walk under this controller too, and show both side by side, in sync, this one first"
    )
    video: bool = setting(False, "render the walk to walk.mp4 (H.264); works without a display")
    snapshots: bool = setting(False, "render a strip of four snapshots, snapshots.png; other instants with --at")
    at: Annotated[tuple[float, ...], BeforeValidator(lambda text: text.split(","))] = setting(
        (), "instants of the snapshots, s; for example 2.5,4.6", metavar="T,T,..."
    )
    size: Annotated[tuple[int, int] | None, BeforeValidator(_pixels)] = setting(
        None,
        "pixels of one walk's picture; null: 1280x720; two walks 960x720; a snapshot 800x600",
        metavar="WIDTHxHEIGHT",
    )
    view: bool = setting(
        False, "replay the walk in MuJoCo's viewer, with --compare both in turn, until its window is closed"
    )

    def check(self, scenario: "mc.Scenario") -> None:
        """Check, before anything is walked, that what is asked for can be shown."""
        if self.at and not self.snapshots:
            raise InputError("--at: expected --snapshots beside it")
        if len(self.at) > MOST_SNAPSHOTS or not all(0 <= t <= scenario.duration for t in self.at):
            raise InputError(
                f"--at: expected up to {MOST_SNAPSHOTS} times from 0 to {scenario.duration:g} s, separated by commas, "
                f"got {','.join(f'{t:g}' for t in self.at)!r}"
            )
        if self.compare == scenario.control.controller:
            raise InputError(f"--compare: expected a controller other than the walk's own, got {self.compare}")
        if self.video or self.snapshots or self.view:
            from mjx_climb.viz.rendering import backend

            if self.video or self.snapshots:
                backend.find()
            if self.view:
                backend.require_display()

    def write(self, walks: Walks, folder: Path, stage: "Stage") -> list[str]:
        """Render walks side by side, each under its name, into a folder and return the names of the files."""
        from mjx_climb.viz import rendering
        from mjx_climb.viz.rendering import film

        files, shown, labels = [], list(walks.values()), list(walks) if len(walks) > 1 else None
        if self.video:
            with stage("video", compiles=False, unit="frames") as show:
                step = 1 if sys.stderr.isatty() else 50  # in a log, a line every two seconds of film

                def told(done: int, total: int) -> None:
                    if done % step == 0 or done == total:
                        show(done, total)

                show(0, 1)
                size = self.size or (film.SIZE if len(walks) == 1 else film.PAIR_SIZE)
                rendering.save_video(folder / "walk.mp4", *shown, size=size, labels=labels, progress=told)
            files.append("walk.mp4")
        if self.snapshots:
            with stage("snapshots", compiles=False):
                strip = rendering.snapshots(
                    *shown, times=self.at or None, size=self.size or film.SNAPSHOT_SIZE, labels=labels
                )
                rendering.save_image(folder / "snapshots.png", strip)
            files.append("snapshots.png")
        return files


class Recording(Options):
    """What is written beside the pictures."""

    mcap: bool = setting(False, "write the walk to walk.mcap too, which Foxglove, Rerun and PlotJuggler open")
    rerun: bool = setting(
        False,
        "write the walk to walk.rrd too, with robot, ground and forces in space for Rerun's viewer; needs rerun-sdk",
    )

    def check(self) -> None:
        """Check, before anything is walked, that what is asked for can be written."""
        if self.rerun:
            from mjx_climb.viz import rerun_recording

            try:
                rerun_recording.library()
            except mc.ConfigError as error:
                raise InputError(f"--{error}") from None


@command("How does this walk go?", "results/<config>-<controller>")
def run(walk: Walk, output: Annotated[Output, "-sections"], pictures: Pictures, recording: Recording) -> None:
    """Walk one robot through a scenario, in double precision.

    Prints the metrics with their units and whether the grippers held, and writes to DIR the full time histories
    (trajectory.nc, opens with xarray), the resolved scenario (config.yaml), the metrics (metrics.json), pictures
    over time (walk) and of the feet's paths on the ground (feet), with --compare the plots of both walks (comparison);
    each picture in the formats of --figures. With --mcap the walk is there as messages of ROS 2 (joint states and
    commands, foot forces, poses, transforms), as a robot would have recorded it; with --rerun robot, ground and forces
    are there for Rerun's viewer (rerun DIR/walk.rrd), where rerun-sdk is installed.

    In videos and snapshots the force on a foot is an arrow: light blue where the ground presses, yellow to red as a
    pull nears the holding limit. They need OpenGL (EGL or OSMesa), not a display.

    Exit code 1: the robot lost a gripper or stands for want of one, or the walk diverged; all is written.

    \b
    Examples:
      mjx-climb run case_2
      mjx-climb run case_1_2 --controller pd --json
      mjx-climb run case_1_2 --set control.damping=2e3 --set disturbance.cargo.mass=0.5
      mjx-climb run case_2 --video --compare pd
      mjx-climb run case_2 --law my_law.py:Filtered --gains best.yaml
      mjx-climb run case_1_2 --snapshots --at 2.5,4.6
      mjx-climb run case_1_2 --mcap
      mjx-climb run case_1_2 --rerun
      mjx-climb run case_1_2 --roof --snapshots
    """
    with output.session() as shell:
        from mjx_climb.robot_import.load import load_robot
        from tuning.background import background
        from tuning.writing.record import settings_of, walks_at_home

        loaded = walk.load_with_gains()
        law, scenario = loaded.law, loaded.scenario
        name = scenario.control.controller if law is None else type(law).__name__
        load_robot(scenario.robot)
        pictures.check(scenario)
        recording.check()
        settings = settings_of(loaded, "run", compare=pictures.compare)
        words = dict.fromkeys((walk.config.stem, name, *walk.words))
        shell.claim("trajectory.nc", *words, settings=settings, varied=walk.varied)
        with shell.whole() as place, background(busy=1) as begin:
            begin(lambda _: importlib.import_module("mjx_climb.viz.plots"))  # matplotlib takes half a second
            walks, own, (files, text) = _written(loaded, name, shell, pictures, recording, place)
        shell.written(files, text)
        if pictures.view:
            from mjx_climb.viz import rendering

            rendering.view(*walks_at_home(walks, place, shell.out).values(), until=interruption.requested)
        if own["detached_limb"] is not None or own["diverged"] or own.get("stands_at") is not None:
            raise typer.Exit(1)


def _written(
    loaded: "Problem", name: str, shell: "Session", pictures: Pictures, recording: Recording, out: Path
) -> tuple[Walks, dict[str, Any], tuple[str, str]]:
    """Walk, print how it went, and write into a folder; return walks, metrics, names of files, and metrics as JSON."""
    from tuning import scenario_files
    from tuning.numbers import presentable, to_json
    from tuning.results.config_file import write_config

    scenario = write_config(loaded.scenario, out, loaded.law, loaded.metrics)
    shell.opening(scenario)
    with shell.stage(name):
        walks = {name: mc.rollout(scenario, law=loaded.law, engine=loaded.engine)}
    walked = walks[name]
    if (rival := pictures.compare) is not None:
        changes = {"control.controller": rival, "control.reading": "virtual_model"}
        beside = scenario_files.copied(loaded.scenario.with_overrides(changes), out)
        with shell.stage(rival):
            walks = {rival: mc.rollout(beside, engine=loaded.engine), **walks}
    metrics = {name: mc.metrics(walked, loaded.metrics) for name, walked in reversed(walks.items())}
    show(walks, metrics, loaded, shell)

    from mjx_climb.files import dataset
    from mjx_climb.viz import plots, rerun_recording
    from mjx_climb.viz import recording as recordings
    from tuning.pages.contents import Picture

    text = to_json(presentable(metrics[name], None))
    drawn = {"walk": Picture("", lambda: plots.plot_walk(walked)), "feet": Picture("", lambda: plots.plot_feet(walked))}
    if rival is not None:
        drawn["comparison"] = Picture("", lambda: plots.plot_comparison(walks))
    written = shell.fill(out, {"trajectory.nc": dataset.to_dataset(walked), "metrics.json": text + "\n", **drawn})
    names = [written, *pictures.write(walks, out, shell.stage)]
    for asked, save, file in (
        (recording.mcap, recordings.save_mcap, "walk.mcap"),
        (recording.rerun, rerun_recording.save_rrd, "walk.rrd"),
    ):
        if asked:
            with shell.stage(file, compiles=False):
                names.append(save(walked, out / file).name)
    return walks, metrics[name], (", ".join(names), text)


def show(walks: Walks, metrics: Mapping[str, Mapping[str, Any]], loaded: "Problem", shell: "Session") -> None:
    """Print the metrics of a walk, and of the one beside it where there is one, and how they went."""
    from tuning import numbers
    from tuning.command_line.session import comparison_table
    from tuning.comparisons.judge import without_sensors
    from tuning.comparisons.remedies import remedies
    from tuning.comparisons.side_by_side import gains_of
    from tuning.pages.table import Table

    (name, *rivals), about, law = metrics, loaded.metrics, loaded.law
    verdicts = {name: verdict(walks[name], values) for name, values in metrics.items()}
    if not rivals:
        shown = numbers.presentable(metrics[name])
        rows = [[about.in_words(key), numbers.number(value), numbers.unit(key, about)] for key, value in shown.items()]
        shell.show(Table("", ["metric", "value", "unit"], [("", rows)], 1), *verdicts.values())
    else:
        compared = {name: (gains_of(walks[name]), values) for name, values in metrics.items()}
        shell.show(comparison_table(compared, rivals[0], shell.tables.width, about, law))
        shell.show(*(f"{name}: {verdict}" for name, verdict in verdicts.items()))
    shell.show(*(f"{name} {lost}" for name, walked in walks.items() if (lost := without_sensors(walked.lost_sensors))))
    shell.show(*numbers.weightless(metrics))
    if metrics[name]["detached_limb"] is not None:
        with shell.stage("what would help", compiles=False):
            shell.show(remedies(walks[name].scenario, float(metrics[name]["detached_at"] or 0.0), law))


def verdict(trajectory: "mc.Trajectory", metrics: Mapping[str, Any]) -> str:
    """Return in one line how the walk went."""
    import numpy as np

    from tuning.comparisons.remedies import gap_in_words

    failures = []
    if metrics["detached_limb"] is not None:
        failures.append(f"limb {metrics['detached_limb']} let go at {metrics['detached_at']:.3f} s")
    if metrics["diverged"]:
        rows = [trajectory.base_position, trajectory.joint_rates, trajectory.foot_force, trajectory.joint_torque]
        finite = np.all([np.isfinite(values).reshape(len(values), -1).all(1) for values in rows], axis=0)
        at = trajectory.time[np.argmin(finite)] if not finite.all() else trajectory.time[-1]
        failures.append(f"diverged at {at:.3f} s")
    if (falls := trajectory.falls_at) is not None:
        failures.append(f"falls off: no grip holds from {falls:.3f} s on")
    if standing := trajectory.standing:
        failures.append(f"stands from {min(standing.values()):.3f} s, as {' and '.join(standing)} found no grip")
    lines = [", ".join(failures)] if failures else []
    if missed := metrics.get("missed_grips"):
        lines.append(
            f"{missed} grips missed the ground" if failures else f"every grip held, but {missed} missed the ground"
        )
        lines += filter(None, [gap_in_words(trajectory.scenario, trajectory.gap, 0.0, missed)])
    return "; ".join(lines) or "held all the way"
