"""A log's commands sent to the simulated robot: its motion beside the real one's, and how far they differ."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.hardware.stages import stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import MAX_STEPS
from mjx_climb.walk.sample import unknown
from tuning.identification.model import held_base as stand
from tuning.identification.model.commanded import Carried, Commands, held
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.schedule import schedule_of, sent_targets
from tuning.identification.model.windows import KINDS
from tuning.identification.readers.log import COMMANDS, KP, OFF, Log, Signal, commanded, joints_of, signals_of

Base = Literal["held", "free"]

_MOST_PUSHES = 500  # of a scenario: each is looked at in every step
_FAR = 0.05  # rad, of a joint from where the simulation begins
# fields of a walk, by the kinds of signals
_FIELDS = dict(zip(KINDS, ("joint_angles", "joint_rates", "joint_torque", "foot_force", *KINDS[4:]), strict=True))


class Error(NamedTuple):
    """How far the simulation is from a logged signal, in the signal's unit."""

    rms: float
    largest: float
    at: float  # s, where it is largest
    moved: float  # standard deviation of the log
    samples: int


@dataclasses.dataclass(frozen=True)
class Replay:
    """A log and the walk that its commands make."""

    log: Log
    scenario: mc.Scenario  # as it was simulated: as long as the log, with its pushes
    base: Base
    walk: mc.Trajectory
    errors: Mapping[str, Error]  # by signal
    warnings: tuple[str, ...]  # on the comparison, a line each

    def logged(self) -> mc.Trajectory:
        """Return the log as a walk, to be shown: quantities that were not logged are as simulated."""
        walk, robot = self.walk, self.walk.robot
        found: dict[str, Any] = {field: np.array(getattr(walk, field)) for field in _FIELDS.values()}
        for name, (field, place) in _comparable(robot).items():
            if (signal := self.log.signals.get(name)) is not None:
                found[field][(..., *place)] = np.interp(walk.time, signal.time, signal.value)
        if not any(".force." in name for name in self.log.signals):
            found["foot_force"] = np.zeros_like(walk.foot_force)
        found["base_orientation"] /= np.linalg.norm(found["base_orientation"], axis=1, keepdims=True)
        base = (found["base_position"], found["base_orientation"], found["joint_angles"])
        return dataclasses.replace(walk, foot_position=_feet(robot, *base), **found)


class Prepared(NamedTuple):
    """All that is needed to simulate a log."""

    log: Log
    scenario: mc.Scenario  # as long as the log, with its pushes
    base: Base
    targets: Float[np.ndarray, "time limb joint"]  # rad
    warnings: tuple[str, ...]
    mass: float  # kg, that hangs on each foot


def replay(
    log: Log, scenario: mc.Scenario, base: Base | None = None, engine: str = DEFAULT_ENGINE, *, mass: float = 0.0
) -> Replay:
    """Return a log beside the simulation that its commands drive; see `prepare`."""
    return simulate(prepare(log, scenario, base, mass), engine)


def prepare(log: Log, scenario: mc.Scenario, base: Base | None = None, mass: float = 0.0) -> Prepared:
    """Return the walk of the servos under a log's commands, and its scenario.

    Commands go to the servos as they were logged: `hardware.control_period` has no part in it, `command_delay` and the
    servos have. With the base held it is a robot on a stand that begins where the log does; else a walk from the rest
    stance, whose grippers shut and open as the scenario's gait has it, under the pushes of the log, where it has any.

    Arguments:
        base: held or free; None: held where the log has neither base nor foot forces.
        mass: that hung on each foot while the log was made, kg.

    Raises:
        ConfigError: a log without commands, or shorter than a time step, or with pushes that are noise; a mass with the
            base free.
    """
    robot, signals, chosen = load_robot(scenario.robot), log.signals, base_of(log, base, mass)
    kind = commanded(log)
    sent = [name for name in signals if name.endswith(f".{kind}")]
    if chosen == "free" and kind != COMMANDS[0]:
        raise ConfigError(log.source, "", "commands of joint angles with the base free", sent[0])
    if not sent:
        raise ConfigError(log.source, "", "commands of joints, such as LF.coxa.command", "none")
    steps = int(log.duration / scenario.time_step + 1e-6) + 1
    if not 2 <= steps <= MAX_STEPS:
        expected = f"a log of two to {MAX_STEPS} time steps of {scenario.time_step:g} s"
        raise ConfigError(log.source, "", expected, f"{log.duration:g} s")
    scenario = scenario.with_overrides({
        "duration": steps * scenario.time_step, "hardware.control_period": 0.0, "hardware.interpolation": "hold",
    })  # fmt: skip
    scenario, said = _with_pushes(scenario, log) if chosen == "free" else (scenario, [])
    targets = _targets(log, robot, scenario, on_a_stand=chosen == "held")
    if len(sent) < (joints := targets[0].size):
        said.append(f"{len(sent)} joints of {joints} have commands, the others are sent where they began")
    if chosen == "held" and scenario.kinds:
        place, named = next(iter(scenario.kinds.items()))  # a stand knows the scenario's servos alone
        raise ConfigError("scenario", f"{place}.kind", "none with the base held", named.name)
    if chosen == "free" and schedule_of(signals, scenario.control.kp) is not None:
        said.append(f"{KP} and {OFF} of the log have no part in it: the base is free")
    if mass:
        said.append(f"{mass:g} kg hang on each foot of the simulated robot, of which config.yaml says nothing")
    return Prepared(log, scenario, chosen, targets, tuple(said), mass)


def base_of(log: Log, base: Base | None, mass: float) -> Base:
    """Return whether the base was held: as set, or, of None, where the log has neither base nor foot forces.

    Raises:
        ConfigError: a mass that hung on each foot, kg, which is none or of a free base.
    """
    grounded = any(name.startswith("base.") or ".force." in name for name in log.signals)
    found: Base = base or ("free" if grounded else "held")
    if not 0 <= mass < math.inf:
        raise ConfigError("", "mass", "a mass on each foot of 0 kg or more", mass)
    if mass and found == "free":
        raise ConfigError("", "mass", "none with the base free", f"{mass:g} kg")
    return found


def simulate(prepared: Prepared, engine: str = DEFAULT_ENGINE) -> Replay:
    """Return a log beside the simulation that its commands drive."""
    log, scenario, base, targets, said, _ = prepared
    robot = load_robot(scenario.robot)
    if base == "held":
        walk = _on_a_stand(prepared, robot)
    else:
        walk = mc.Simulation(scenario, engine=engine).rollout(targets=targets)
        said = (*said, *remarks(walk, log, robot))
    return Replay(log, scenario, base, walk, errors_of(walk, log, robot), said)


def _targets(log: Log, robot: Robot, scenario: mc.Scenario, on_a_stand: bool) -> Float[np.ndarray, "time limb joint"]:
    """Return the joint targets of every step, each command held until the next; of a stand as they reach the servos."""
    at, delay = scenario.time_step * np.arange(scenario.steps), scenario.hardware.command_delay
    schedule, kind = schedule_of(log.signals, scenario.control.kp) if on_a_stand else None, commanded(log)
    targets = np.empty((len(at), len(robot.limbs), robot.joints))
    for joint, (row, column) in joints_of(robot).items():
        command, position = (log.signals.get(f"{joint}.{what}") for what in (kind, "position"))
        if command is None and kind != COMMANDS[0]:
            targets[:, row, column] = 0.0
        elif command is None:
            targets[:, row, column] = robot.stance_joints[row, column] if position is None else position.value[0]
        elif on_a_stand:
            targets[:, row, column], _ = sent_targets(command, at - delay, scenario.time_step, schedule)
        else:
            targets[:, row, column] = command.held(at + 1e-6 * scenario.time_step)
    return targets


def _with_pushes(scenario: mc.Scenario, log: Log) -> tuple[mc.Scenario, list[str]]:
    """Return the scenario with the pushes that were logged in place of its own, and remarks on that."""
    named = {name: log.signals[name] for name in log.signals if name.startswith(("base.force.", "base.moment."))}
    if not named:
        own = scenario.disturbance.pushes
        return scenario, ["the log has no pushes: those of the config act"] if own else []
    times = np.unique(np.concatenate([signal.time for signal in named.values()]))
    wrench = np.zeros((len(times), 6))
    for name, signal in named.items():
        _, what, axis = name.split(".")
        column = "xyz".index(axis) + (3 if what == "moment" else 0)
        wrench[:, column] = np.where(times < signal.time[0], 0.0, signal.held(times))
    begins = np.flatnonzero(np.r_[True, (np.diff(wrench, axis=0) != 0).any(1)])
    ends = [*times[begins[1:]].tolist(), float(times[-1]) + scenario.time_step]
    pushes: list[dict[str, Any]] = [
        {"force": wrench[row, :3].tolist(), "moment": wrench[row, 3:].tolist(), "start": float(times[row]), "stop": end}
        for row, end in zip(begins, ends, strict=True)
        if wrench[row].any()
    ]
    if len(pushes) > _MOST_PUSHES:
        expected = f"pushes on the base in {_MOST_PUSHES} constant pieces at most (smooth or thin out what is noise)"
        raise ConfigError(log.source, "base.force, base.moment", expected, len(pushes))
    changed = scenario.with_overrides({"disturbance.pushes": pushes})
    return changed, [f"pushes of the log: {len(pushes)}"]


def remarks(walk: mc.Trajectory, log: Log, robot: Robot) -> Iterator[str]:
    """Yield the assumptions of a walk's comparison."""
    begins = {
        joint: abs(signal.value[0] - walk.joint_angles[(0, *place)])
        for joint, place in joints_of(robot).items()
        if (signal := log.signals.get(f"{joint}.position")) is not None
    }
    if begins and (far := max(begins.values())) > _FAR:
        joint = max(begins, key=lambda name: begins[name])
        yield f"the walk begins in its rest stance, {far:.3g} rad from where {joint} was logged first"
    differ = [
        float(np.mean(np.interp(walk.time, signal.time, signal.value).round() != walk.support[:, row]))
        for row, limb in enumerate(robot.limbs)
        if (signal := log.signals.get(f"{limb}.support")) is not None
    ]
    if not differ:
        yield "grippers shut and open as the config's gait has it: the log does not say when"
    elif max(differ) > 0.01:
        share = f"{100 * max(differ):.0f} % of the time"
        yield f"grippers shut and open as the config's gait has it, other than in the log for {share}"


def _on_a_stand(prepared: Prepared, robot: Robot) -> mc.Trajectory:
    """Return the motion of a robot whose base is held, in the form of a walk: no foot touches anything."""
    log, scenario, _, targets, _, mass = prepared
    kind = commanded(log)
    begin = targets[0].copy() if kind == COMMANDS[0] else np.array(robot.stance_joints, float)
    for joint, place in joints_of(robot).items():
        if (signal := log.signals.get(f"{joint}.position")) is not None:
            begin[place] = signal.value[0]
    own, sent = own_parameters(scenario), stand.Sent(targets)
    if (schedule := schedule_of(log.signals, scenario.control.kp)) is not None:
        at = scenario.time_step * np.arange(len(targets)) - scenario.hardware.command_delay
        sent = sent._replace(**schedule.at(at, scenario.time_step)[0])
    commands = Commands(sent, jax.tree.map(np.zeros_like, sent), np.full(len(targets), own.bus.command_delay))
    with devices.on_host(), jax.enable_x64(True):
        robot = with_foot_mass(robot, mass)
        run = held(stages_of(own, scenario.time_step, robot), scenario.time_step, kind)
        carried = jax.tree.map(np.asarray, jax.jit(run)(robot, own, commands, begin))
    return _as_walk(scenario, robot, own, targets, carried)


def _as_walk(
    scenario: mc.Scenario, robot: Robot, parameters: Parameters, targets: np.ndarray, carried: Carried
) -> mc.Trajectory:
    """Return a motion on a stand as a walk: undefined quantities are NaN, loads that do not act are 0."""
    angles, rates, torque, of_feet = carried
    steps, limbs = targets.shape[:2]
    position = np.broadcast_to(robot.stance_position, (steps, 3))
    turned = np.broadcast_to(robot.stance_orientation, (steps, 4))
    feet = _feet(robot, position, turned, angles)
    speed, later = (np.gradient(values, scenario.time_step, axis=0) for values in (feet, rates))
    still, wrench = np.zeros((steps, 3)), np.zeros((steps, 6))
    known = dict(
        time=scenario.time_step * np.arange(steps),
        base_position=position, base_orientation=turned, base_linear_velocity=still, base_angular_velocity=still,
        base_linear_acceleration=still, base_angular_acceleration=still, joint_angles=angles,
        joint_rates=rates, joint_accelerations=later, joint_targets=targets,
        joint_torque=torque, foot_position=feet, foot_velocity=speed, foot_target=feet, foot_force=of_feet,
        foot_moment=of_feet, grip_point=feet, reachable=np.ones((steps, limbs), bool), base_reference=position,
        base_displacement=wrench, base_wrench=wrench, push=wrench, cargo_mass=np.zeros(steps),
    )  # fmt: skip
    quantities = unknown(steps, {"limb": limbs, "joint": robot.joints}) | known
    return mc.Trajectory(
        scenario=scenario, gains={}, parameters=parameters, limbs=robot.limbs, law="JointTargets", **quantities
    )


def _feet(
    robot: Robot,
    position: Float[np.ndarray, "time 3"],
    orientation: Float[np.ndarray, "time 4"],
    angles: Float[np.ndarray, "time limb joint"],
) -> Float[np.ndarray, "time limb 3"]:
    """Return where the feet are, m, world axes."""
    w, v = orientation[:, None, :1], orientation[:, None, 1:]
    feet = np.asarray(limb_frames(robot, None, angles).foot)
    turned = feet + 2 * np.cross(v, np.cross(v, feet) + w * feet)  # by a quaternion
    return np.asarray(position[:, None] + turned)


def _comparable(robot: Robot) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return the signals that a walk has too: by name, the walk's field and the place in it behind time."""
    return {name: (_FIELDS[m.kind], m.place) for name, m in signals_of(robot).items() if m.kind in _FIELDS}


def errors_of(walk: mc.Trajectory, log: Log, robot: Robot) -> dict[str, Error]:
    """Return how far the simulation is from every logged signal that it has, at the times of the log."""
    found, fields = {}, _comparable(robot)
    for name, signal in log.signals.items():
        if name in fields:
            field, place = fields[name]
            simulated = getattr(walk, field)[(..., *place)]
            found[name] = _error(signal, np.interp(signal.time, walk.time, simulated))
    return found


def _error(signal: Signal, simulated: Float[np.ndarray, " samples"]) -> Error:
    off = np.abs(simulated - signal.value)
    worst = int(np.argmax(off))
    rms = float(np.sqrt(np.mean(off**2)))
    return Error(rms, float(off[worst]), float(signal.time[worst]), float(np.std(signal.value)), len(off))
