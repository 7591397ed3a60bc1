"""What a window of a log would have recorded, for a point of the fit, with exact derivatives: the base held."""

import dataclasses
import functools
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.arrays import AnyArray
from mjx_climb.hardware.actuator import Joints
from mjx_climb.hardware.servo import Servo, begin, gains_of, joint_loop
from mjx_climb.hardware.stages import Stages, hardware_of, stages_of
from mjx_climb.inputs.from_scenario import own_parameters, with_options_of
from mjx_climb.parameter_types import Parameters
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from tuning.identification.model import held_base as stands
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.schedule import Schedule, schedule_of
from tuning.identification.model.variables import Place, Variable, applied, variables, with_all
from tuning.identification.model.windows import Windows

AT_ONCE = 8  # windows in one call of an executable
DELAY, PRESLIDING = "hardware.command_delay", "hardware.servo.presliding"
SERVO_DELAY = "hardware.servo.delay"
LATE = {"log.velocity.delay": "velocity", "log.effort.delay": "effort"}  # of what is recorded, behind the positions
LEAD = "log.friction.lead"  # of dry friction, see `tuning.identification.model.held_base`
CLOCK = "log.command.delay"  # of the commands' clock, where their delay is not fitted
_LEADS = (0.0, 0.005, 0.03)  # s, mean and sd of the prior, and the upper bound
_BENDS = 3.0  # prior sd of the logarithm of presliding: gears bend by mrad, a simulator's friction may not at all
LATENESS = (0.0, 0.005, -0.02, 0.1)  # s, mean and sd of the prior, and bounds: drivers filter what they record


class Structure(NamedTuple):
    """What a compiled window depends on; hashable."""

    robot: str | RobotFile
    places: tuple[Place, ...]
    stages: Stages
    time_step: float
    steps: int
    kinds: tuple[str, ...]  # what is recorded
    mass: float = 0.0  # kg, that hangs on each foot


class Point(NamedTuple):
    """Where the fit is, and what it may move along."""

    x: Any  # (n,) coordinates of the variables
    start: Any  # (limb, joint, S): angle, rate, what the servo remembers of each joint; base free: a `gripped.Moving`
    late: Any  # () s, delay of the commands beyond that of the targets


class Given(NamedTuple):
    """What the log says of a window."""

    before: Any  # (B, limb, joint) rad, targets before it
    sent: stands.Sent  # (steps + 1, ...)
    rates: stands.Sent  # of what is sent, over time


MEMORY = {  # of a joint's servo, that a window begins with: prior sd, and what a window's end may miss
    "bristle": (0.7, 0.02),  # 1
    "loop.goal": (0.05, 1e-4),  # rad
    "loop.goal_rate": (1.0, 1e-2),  # rad/s
    "loop.integral": (0.1, 1e-4),  # rad s
}


def memory(servo: Servo) -> dict[str, Array]:
    """Return the servos' states that the log does not tell, (limb, joint) each."""
    found = {"bristle": servo.bristle, **{f"loop.{name}": value for name, value in servo.loop._asdict().items()}}
    return {name: found[name] for name in MEMORY if found[name] is not None}


def with_memory(servo: Servo, own: Mapping[str, AnyArray]) -> Servo:
    """Return servos that remember something else."""
    loop = servo.loop._replace(**{name[5:]: value for name, value in own.items() if name.startswith("loop.")})
    return servo._replace(bristle=own.get("bristle", servo.bristle), loop=loop)


def simulate(structure: Structure, point: Point, given: Given, parameters: Parameters) -> dict[str, Array]:
    """Return the predicted records at steps 0 to `steps` (steps + 1, limb, joint), and the state at the last one."""
    dtype = point.x.dtype
    parameters, robot = applied(structure.places, point.x, parameters, load_robot(structure.robot))
    robot = with_foot_mass(robot, structure.mass)
    robot = execution.of_limbs(jax.tree.map(lambda value: jnp.asarray(value, dtype), robot))
    hardware = hardware_of(parameters, structure.stages, structure.time_step, robot)
    stand, (angles, rates) = (
        stands.Stand(robot, hardware, _lead(structure, point)),
        (point.start[..., n] for n in (0, 1)),
    )
    moving = stands.begin(stand, angles, rates)
    if structure.stages.servo_delay:  # what is on its way to the motors: of a joint that came at the same rate
        first_sent = jax.tree.map(lambda value: value[0], given.sent)
        moving = _filled(stands.with_gains(stand, first_sent), moving, given.before)
    own = {name: point.start[..., 2 + n] for n, name in enumerate(memory(moving.servo))}
    moving = moving._replace(servo=with_memory(moving.servo, own))

    def step(carry: Any, both: tuple[stands.Sent, stands.Sent]) -> tuple[Any, dict[str, Array]]:
        moving, _ = carry
        sent = jax.tree.map(lambda value, rate: value - point.late * rate, *both)
        after, seen = stands.advance(stands.with_gains(stand, sent), moving, sent.targets)
        last = [moving.state.joint_angles, moving.state.joint_rates, *memory(moving.servo).values()]
        # the rate as it stands, half a step before the angle: right where the target jumps too
        recorded = seen._replace(velocity=moving.state.joint_rates)
        return (after, last), {kind: getattr(recorded, kind) for kind in structure.kinds}

    first = [angles, rates, *memory(moving.servo).values()]
    (_, last), seen = jax.lax.scan(step, (moving, first), (given.sent, given.rates))
    return seen | {"end": jnp.stack(last, axis=-1)}


def _lead(structure: Structure, point: Point) -> Any:
    at = [n for n, place in enumerate(structure.places) if place.key == LEAD]
    return point.x[at[0]] if at else 0.0


def _filled(stand: stands.Stand, moving: stands.Moving, before: Array) -> stands.Moving:
    state, step = moving.state, stand.hardware.time_step
    gains, servo = gains_of(stand.hardware), moving.servo
    for n in range(len(before)):
        angles = state.joint_angles - (len(before) - n) * step * state.joint_rates
        servo, _ = joint_loop(servo, before[n], Joints(angles, state.joint_rates, None), gains, stand.hardware)
    return moving._replace(servo=servo)


@dataclasses.dataclass(frozen=True)
class Fit:
    """What is fitted to the windows of a log."""

    windows: Windows
    variables: tuple[Variable, ...]
    structure: Structure
    parameters: Parameters  # of the scenario, in double precision

    @property
    def memory(self) -> tuple[str, ...]:
        """What servos remember where a window begins, by the names of MEMORY, as far as it is fitted."""
        return ()

    def delay(self, x: np.ndarray) -> float:
        """Return the delay of commands at a point of coordinates (n,), s."""
        own = {v.key: float(value) for v, value in zip(self.variables, x, strict=True)}
        return own.get(DELAY, float(self.parameters.bus.command_delay)) + own.get(CLOCK, 0.0)

    def torque_delay(self, x: np.ndarray) -> float:
        """Return how late torques change after commands at a point of coordinates (n,), s."""
        own = [float(x[n]) for n, v in enumerate(self.variables) if v.key == SERVO_DELAY]
        return self.delay(x) + (own or [float(self.parameters.drive.delay)])[0]

    @functools.cached_property
    def schedule(self) -> Schedule | None:
        """P gains and torque off, as the log has them."""
        return schedule_of(self.windows.gains, float(np.asarray(self.parameters.joint_loop.kp)))

    def sent(self, which: np.ndarray, delay: float, before: int = 0) -> tuple[stands.Sent, stands.Sent]:
        """Return the commands `delay` s late, from `before` steps before each window, and their rates over time."""
        windows = self.windows
        sent, changing = (stands.Sent(value) for value in windows.targets(which, delay, before, self.schedule))
        if self.schedule is not None:
            moments = windows.moments(which, before + windows.steps + 1, before) - delay
            gains, rate = self.schedule.at(moments, windows.time_step)
            sent, changing = sent._replace(**gains), changing._replace(**rate)
        return sent, changing


class Model(Fit):
    """The model of a log's windows, the base held: each begins in a state of its own."""

    @functools.cached_property
    def sizes(self) -> tuple[int, int, int]:
        """Limbs, joints, and how many numbers a joint's state has."""
        robot = load_robot(self.structure.robot)
        return len(robot.limbs), robot.joints, 2 + len(self.memory)

    @functools.cached_property
    def memory(self) -> tuple[str, ...]:
        """What the servos remember, by the names of MEMORY."""
        return tuple(memory(begin(jnp.zeros((1, 1)), self.structure.stages)))

    @functools.cached_property
    def lanes(self) -> list[list[int]]:
        """The variables by tangent: those of different limbs share one, as these do not feel each other."""
        lanes: list[list[int]] = []
        for n, variable in enumerate(self.variables):
            if variable.key in LATE:
                continue
            for lane in lanes:
                limbs = [self.variables[m].limb for m in lane]
                if variable.limb is not None and None not in limbs and variable.limb not in limbs:
                    lane.append(n)
                    break
            else:
                lanes.append([n])
        return lanes

    def directions(self) -> Point:
        """Return the tangents that are asked for: of the variables by lanes, then of each joint's state."""
        limbs, joints, size = self.sizes
        count = len(self.lanes) + joints * size
        x, late = np.zeros((1, count, len(self.variables))), np.zeros((1, count))
        start = np.zeros((1, count, limbs, joints, size))
        for n, lane in enumerate(self.lanes):
            x[0, n, lane] = 1.0
            late[0, n] = float(any(self.variables[m].key in (DELAY, CLOCK) for m in lane))
        for n in range(joints * size):
            start[0, len(self.lanes) + n, :, n // size, n % size] = 1.0
        return Point(x, start, late)

    def _given(self, which: np.ndarray, delay: float, before: int) -> Given:
        """Return the windows' records, with the commands `delay` s late."""
        early, changing = self.sent(which, delay, before)
        sent, changing = (jax.tree.map(lambda value: value[:, before:], each) for each in (early, changing))
        return Given(early.targets[:, :before], sent, changing)

    def evaluate(self, x: np.ndarray, start: np.ndarray, which: np.ndarray) -> tuple[dict[str, np.ndarray], Any]:
        """Return the predicted records of windows, and their tangents.

        Arguments:
            x: (points, n).
            start: (points, windows, limb, joint, S), of the windows `which`.
            which: indices of windows.

        Returns:
            By kind (points, windows, steps + 1, limb, joint), `end` (points, windows, limb, joint, S); and of each the
            tangents with an axis of them behind that of the windows.
        """
        points, windows, before = len(x), len(which), self.structure.stages.servo_delay
        each = [self._given(which, self.delay(point), before) for point in x]
        given = jax.tree.map(lambda *parts: np.concatenate(parts), *each)
        point = Point(np.repeat(x, windows, axis=0), start.reshape(-1, *start.shape[2:]), np.zeros(points * windows))
        count = points * windows
        rows = np.arange(-(-count // AT_ONCE) * AT_ONCE) % count  # whole calls of one executable
        point, given = (jax.tree.map(lambda value: value[rows], each) for each in (point, given))
        own = jax.tree.map(lambda value: np.ndim(value) - 1, given)
        axes = (Point(1, 3, 0), own, jax.tree.map(np.ndim, self.parameters))
        robots = execution.Robots((point, given, self.parameters), axes, (len(rows),), self.directions())
        values, tangents = execution.run(simulate, self.structure, robots, batch_size=AT_ONCE)

        def shaped(found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {name: v[:count].reshape(points, windows, *v.shape[1:]) for name, v in found.items()}

        return shaped(values), shaped(tangents)


def with_nuisances(scenario: mc.Scenario, chosen: Sequence[Variable], kinds: Collection[str]) -> list[Variable]:
    """Return variables, and beside them what no log is free of, which would bend them if it were held.

    These are delays of recorded velocities, efforts and commands, and how far dry friction gives before it slips. A
    time of a log is known to a part of a time step, so that a delay may come out as much below zero.

    Arguments:
        scenario: whose stages count.
        chosen: what is asked for.
        kinds: those of KINDS that are recorded.
    """
    least, keys = -scenario.time_step / 4, {v.key for v in chosen}
    found = [dataclasses.replace(v, lower=least) if v.key == DELAY else v for v in chosen]
    beside = [Variable(key, "s", 0.0, *LATENESS) for key, kind in LATE.items() if {kind, "position"} <= {*kinds}]
    if DELAY not in keys:
        beside.append(Variable(CLOCK, "s", 0.0, 0.0, -least, least, -least))
    if stages_for(scenario, chosen).dry_friction:
        beside.append(Variable(LEAD, "s", 0.0, _LEADS[0], _LEADS[1], least, _LEADS[2]))
        if PRESLIDING not in keys:
            (bend,) = variables(scenario, [PRESLIDING], held=True)  # a friction that gives for longer is a spring
            beside.append(dataclasses.replace(bend, sd=_BENDS, upper=bend.nominal * 6))
    return [*found, *(dataclasses.replace(v, beside=True) for v in beside)]


def stages_for(scenario: mc.Scenario, chosen: Sequence[Variable]) -> Stages:
    """Return the stages of hardware that the scenario has, or that are fitted, but for those of the control law."""
    parameters, robot = _with_all(scenario, chosen)
    return stages_of(parameters, scenario.time_step, robot)._replace(
        command_delay=0, control_period=False, linear=False
    )


def _with_all(scenario: mc.Scenario, chosen: Sequence[Variable]) -> tuple[Parameters, Robot]:
    """Return parameters and robot that need all that is fitted."""

    def value(each: Variable) -> float:
        return each.upper if each.unit == "s" else max(each.nominal, each.sd)

    return with_all(chosen, value, own_parameters(scenario), load_robot(scenario.robot))


def model_of(scenario: mc.Scenario, windows: Windows, chosen: Sequence[Variable], mass: float = 0.0) -> Model:
    """Return the model of a log: it has the stages of hardware that the scenario has, or that are fitted.

    A `mass` in kg hung on each foot while the log was made.
    """
    places = tuple(each.place for each in chosen)
    stages = stages_for(scenario, chosen)
    structure = Structure(scenario.robot, places, stages, windows.time_step, windows.steps, windows.kinds, mass)
    own = own_parameters(scenario)
    own = with_options_of(own, _with_all(scenario, chosen)[0])
    return Model(windows, tuple(chosen), structure, own)
