"""The folder of an excitation: commands as CSV and as a trajectory for ROS 2, a picture, a page, JSON."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_climb.scenario.values import G
from mjx_climb.viz import plots
from tuning.identification.plan.excitation import PLAIN, Excited, scale
from tuning.identification.plan.information import SEEN
from tuning.identification.plan.rig import SPEED
from tuning.identification.readers.formats.csv_file import csv_of
from tuning.identification.readers.log import joints_of
from tuning.numbers import to_json
from tuning.pages.contents import Contents, Files, Picture, Written
from tuning.pages.page import Findings, Page, Table
from tuning.problem.evaluation import Problem

TRAJECTORY = "excitation_trajectory.yaml"
APPROACH = 3.0  # s, in which a trajectory controller takes the robot to the first posture
BINS = 150  # of a picture's envelopes


def contents(found: Excited, *_: object) -> Contents:
    """Return the commands, the expectation, a picture and the page."""
    asked = found.asked.model_dump(exclude_unset=True)
    files: Files = {
        found.FILE: csv_of(columns(found)), TRAJECTORY: trajectory(found),
        "excitation.json": to_json(summary(found)) + "\n",
        "excitation": Picture("Commands, rates and torques of the nominal robot", lambda: plot(found)),
    }  # fmt: skip
    page = Page(
        "What to command to identify {}", Findings(found.best.information.unseen(), notes=notes(found)), found.scenario,
        tables=[table(found), limits(found)],
        facts={"seed": found.asked.seed, "candidates": len(found.candidates)},
    )  # fmt: skip
    again = f"tuning.excite(mjx_climb.load_scenario('config.yaml'), **{asked})"
    return Contents(Written(), Problem(found.scenario), files, page.at, again)


def columns(found: Excited) -> dict[str, np.ndarray]:
    """Return the columns of the CSV file: time, commands (NaN: torque off), P gain, and whether the torque is off."""
    kp, off = gains(found)
    each = {
        f"{joint}.command": np.where(off, np.nan, found.best.motion.targets[:, *place].round(6))
        for joint, place in joints_of(found.robot).items()
        if found.robot.driven is None or found.robot.driven[place]
    }
    return {"time": found.time.round(6), **each, "control.kp": np.where(off, np.nan, kp), "torque_off": off * 1.0}


def gains(found: Excited) -> tuple[np.ndarray, np.ndarray]:
    """Return the P gain at each command, N m/rad, and whether the torque is off."""
    kp = np.zeros(len(found.best.motion.targets))
    for segment in found.best.motion.segments:
        kp[segment.start : segment.stop] = segment.kp
    return kp, kp == 0


def trajectory(found: Excited) -> str:
    """Return the commands as a ROS 2 message trajectory_msgs/msg/JointTrajectory in YAML."""
    robot, (_, off) = found.robot, gains(found)
    driven = {
        name: place for name, place in robot.places_in_file().items() if robot.driven is None or robot.driven[place]
    }
    limb, joint = np.transpose([*driven.values()])
    end = int(np.argmax(off)) if off.any() else len(off)
    head = [
        "# trajectory_msgs/msg/JointTrajectory, written by mjx-climb excite; where ros2 reads messages from files:",
        f"# ros2 topic pub --once TOPIC trajectory_msgs/msg/JointTrajectory --yaml-file {TRAJECTORY}",
        f"# The first point is the posture in which the log begins, {APPROACH:g} s after the start.",
        *(["# It ends where the torque is to be switched off: a trajectory cannot do that."] if off.any() else []),
        "header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}",
        # JSON quotes texts that YAML would read as numbers
        f"joint_names: {json.dumps([*driven], ensure_ascii=False)}",
        "points:",
    ]
    return "\n".join([*head, *_points(found.best.motion.targets[:end, limb, joint], found.period)]) + "\n"


def _points(targets: np.ndarray, period: float) -> Iterator[str]:
    for number, row in enumerate(targets):
        sec, nanosec = divmod(round((APPROACH + number * period) * 1e9), 10**9)
        values = ", ".join(f"{value:.6f}" for value in row)
        yield f"- {{positions: [{values}], time_from_start: {{sec: {sec}, nanosec: {nanosec}}}}}"


def summary(found: Excited) -> dict[str, Any]:
    """Return all that is known before the robot is turned on, for machines."""
    best, plain = found.best.information, found.plain.information
    each = {}
    for variable, relative, other in zip(found.chosen, best.deviations, plain.deviations, strict=True):
        each[variable.key] = {
            "value": variable.nominal, "unit": variable.unit, "deviation": float(relative * scale(variable)),
            "relative": float(relative), "plain_chirp": float(other), "seen": bool(relative <= SEEN),
        }  # fmt: skip
    return {
        "chosen": found.best.motion.name, "parameters": each, "times_better_than_plain_chirp": found.gain,
        "unseen": best.unseen(), "weak": [{"relative": float(sd), "parts": parts} for sd, parts in best.weak()],
        "limits": [
            {"motion": part.name, "from": part.start * found.period, "to": part.stop * found.period,
             "kp": part.kp or None, "binds": binds}
            for part, binds in zip(found.best.motion.segments, found.best.motion.bound, strict=True)
        ],
        "rate": found.asked.rate or 1 / found.period, "noise": found.asked.noise, "notes": notes(found),
    }  # fmt: skip


def table(found: Excited) -> Table:
    """The forecast of a log's information, beside the plain chirp's."""
    rows = []
    for variable, *both in zip(
        found.chosen, found.best.information.deviations, found.plain.information.deviations, strict=True
    ):
        relative = [f"{100 * sd:.2g} %" if sd <= SEEN else "not seen" for sd in both]
        absolute = f"{both[0] * scale(variable):.2g}" if both[0] <= SEEN else "-"
        of = "" if scale(variable) == abs(variable.nominal) else f" of {scale(variable):.2g}"
        found_and_plain = (each + of for each in relative)
        rows.append([variable.key, f"{variable.nominal:.4g}", variable.unit, absolute, *found_and_plain])
    heads = ["parameter", "value", "unit", "deviation", "relative", PLAIN]
    return Table("Expected standard deviations", heads, [("", rows)], words=1)


def limits(found: Excited) -> Table:
    """The stretches of the motion, each with its limit."""
    rows = [
        [part.name, f"{part.start * found.period:.2f}", f"{part.stop * found.period:.2f}",
         f"{part.kp:g}" if part.kp else "off", binds]
        for part, binds in zip(found.best.motion.segments, found.best.motion.bound, strict=True)
    ]  # fmt: skip
    return Table("What binds", ["motion", "from s", "to s", "kp N m/rad", "limit"], [("", rows)], words=1)


def notes(found: Excited) -> list[str]:
    """Return the warnings before anyone turns the robot on."""
    asked, value, gravity = found.asked, found.scenario.value, np.linalg.norm(found.scenario.gravity)
    how = "Hold the base, limbs in the air" if asked.base == "held" else "Shut all grippers"
    said = [
        f"{how}, and bring the joints to the first posture before the log begins.",
        "The robot's own body and the stand are not in the limits: look at the picture, and run it slowly first.",
        f"The log's noise is taken for white, {asked.noise:.2g} rad; what an encoder rounds off a slow joint is not.",
        f"The deviations hold if the robot is like its model. They are {found.gain:.2g} times smaller than after the "
        f"plain chirp within the same limits; taken is {found.best.motion.name}.",
    ]
    if value("hardware.servo.torque_limit") is None and found.robot.torque_limit is None:
        said.append("The config has no torque limit (hardware.servo.torque_limit): none was kept.")
    if value("hardware.servo.no_load_speed") is None:
        said.append(f"The config has no speed limit (hardware.servo.no_load_speed): {SPEED:g} rad/s were taken.")
    if abs(gravity - G) > 0.2:
        said.append(
            f"Gravity is the config's, {gravity:.3g} m/s^2; in a laboratory on Earth: --set gravity=[0,0,-9.81]."
        )
    if asked.mass:
        said.append(f"Hang {asked.mass:g} kg on each foot, at the point that counts as its foot.")
    if len(set(asked.kp)) > 1:
        said.append("The P gain changes as the column control.kp says: the log must have been made with it.")
    if asked.drop:
        said.append("Switch the torque off where the column torque_off says 1: the limbs fall.")
    return said


@plots.style()
def plot(found: Excited) -> Figure:
    """Draw the commands, a lane for each joint, and how fast and how hard the joints of each kind move at most."""
    robot, time = found.robot, found.time
    lanes = robot.joint_lower.size
    figure = Figure(figsize=(2 * plots.COLUMN, 2.6 + 0.28 * lanes), layout="constrained")
    ratios = (0.28 * lanes, 1.0, 1.0)
    commanded, rates, torques = figure.subplots(3, 1, sharex=True, height_ratios=ratios)
    _, off = gains(found)
    moved = np.where(off[:, None, None], np.nan, found.best.motion.targets - found.best.motion.targets[0])
    apart = 2.2 * float(np.nanmax(np.abs(moved))) or 1.0
    colors = [plots.BLUE, plots.VERMILLION, plots.GREEN, plots.ORANGE, plots.PURPLE, plots.SKY, plots.BLACK]
    colors = colors[: robot.joints]
    names = list(joints_of(robot))
    for place, values in enumerate(moved.reshape(len(time), lanes).T):
        commanded.plot(time, values - apart * place, color=colors[place % robot.joints], lw=0.5)
    commanded.set_yticks(-apart * np.arange(lanes), names)
    commanded.set(ylim=(-apart * (lanes - 0.4), apart), title=f"commands, {apart:.2g} rad from lane to lane")
    for panel, label, values in (
        (rates, "rate [rad/s]", found.carried.rates),
        (torques, "torque [N m]", found.carried.torque),
    ):
        for joint, color in enumerate(colors):
            panel.plot(*_largest(time, np.asarray(values)[:, :, joint]), color=color, lw=1.0)
        panel.set(ylabel=f"largest\n{label}", ylim=(0, None))
    for segment in found.best.motion.segments:
        start = segment.start * found.period
        for panel in (commanded, rates, torques):
            panel.axvline(start, color="0.5", lw=0.6, ls=":")
        commanded.annotate(
            segment.name, (start, 0.6 * apart), (2, -2), textcoords="offset points", va="top", fontsize=6.5
        )
    torques.set(xlabel="time [s]", xlim=(0, time[-1]))
    handles = [
        plots.key(f"{name}, of all limbs", color=color) for name, color in zip(robot.joint_names, colors, strict=True)
    ]
    plots.legend_below(figure, handles, len(handles))
    return figure


def _largest(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times, and the largest magnitude of the columns of values (time, columns) in each of `BINS` stretches."""
    parts = np.array_split(np.arange(len(time)), min(BINS, len(time)))
    return time[[part[0] for part in parts]], np.array([np.abs(values[part]).max() for part in parts])
