"""The predicted records of a window, for a point of the fit, with exact derivatives: the base held."""

import dataclasses
import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

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
from tuning.identification.model import held_base as stands
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.schedule import Schedule, schedule_of
from tuning.identification.model.variables import Place, Variable, applied, variables, with_all
from tuning.identification.model.windows import Windows
from tuning.identification.readers.log import COMMANDS

DELAY, PRESLIDING = "hardware.command_delay", "hardware.servo.presliding"
SERVO_DELAY = "hardware.servo.delay"
LATE = {"log.velocity.delay": ("velocity",), "log.effort.delay": ("effort",)}  # of recorded kinds, behind the positions
LEAD = "log.friction.lead"  # of dry friction, see `tuning.identification.model.held_base`
CLOCK = "log.command.delay"  # of the commands' clock, where their delay is not fitted
_LEADS = (0.0, 0.005, 0.03)  # s, mean and sd of the prior, and the upper bound
_BENDS = 3.0  # prior sd of the logarithm of presliding: gears bend by mrad, a simulator's friction may not at all
_STATE = (0.2, 3.0)  # prior sd of a start from its guess: rad, rad/s
LATENESS = (0.0, 0.005, -0.02, 0.1)  # s, mean and sd of the prior, and bounds: drivers filter their records


class Structure(NamedTuple):
    """The static part of a compiled window; hashable."""

    robot: Robot
    places: tuple[Place, ...]
    stages: Stages
    time_step: float
    steps: int
    kinds: tuple[str, ...]  # of the records
    mass: float = 0.0  # kg, that hangs on each foot
    commanded: str = COMMANDS[0]  # kind of the commands


class Point(NamedTuple):
    """A point of the fit."""

    x: Any  # (n,) coordinates of the variables
    start: Any  # as each window begins: `held_base.Moving`, or `held_feet.Moving` with the base free
    late: Any  # () s, delay of the commands beyond that of the targets


class Given(NamedTuple):
    """The log of a window."""

    sent: stands.Sent  # (steps + 1, ...)
    rates: stands.Sent  # of `sent`, over time
    common: Any = ()  # data of all windows


class Before(NamedTuple):
    """The log before a stretch."""

    targets: Any  # (B, limb, joint) rad
    sent: stands.Sent  # in the first step


MEMORY = {  # of a joint's servo, that a stretch begins with: prior sd
    "bristle": 0.7,  # 1
    "loop.goal": 0.05,  # rad
    "loop.goal_rate": 1.0,  # rad/s
    "loop.integral": 0.1,  # rad s
}


def memory(servo: Servo) -> dict[str, Array]:
    """The servos' states that the log does not tell, (limb, joint) each."""
    found = {"bristle": servo.bristle, **{f"loop.{name}": value for name, value in servo.loop._asdict().items()}}
    return {name: found[name] for name in MEMORY if found[name] is not None}


def with_memory(servo: Servo, own: Mapping[str, AnyArray]) -> Servo:
    """Servos that remember something else."""
    loop = servo.loop._replace(**{name[5:]: value for name, value in own.items() if name.startswith("loop.")})
    return servo._replace(bristle=own.get("bristle", servo.bristle), loop=loop)


def moving_at(structure: Structure, point: Point, before: Before, parameters: Parameters) -> stands.Moving:
    """The robot at a start (limb, joint, S): angle, rate, memory of the servo."""
    stand = _stand(structure, point, parameters)
    angles, rates = (point.start[..., n] for n in (0, 1))
    moving = stands.begin(stand, angles, rates)
    if structure.stages.servo_delay:  # torques on their way to the motors: of a joint that came at the same rate
        moving = _filled(stands.with_gains(stand, before.sent), moving, before.targets)
    own = {name: point.start[..., 2 + n] for n, name in enumerate(memory(moving.servo))}
    return moving._replace(servo=with_memory(moving.servo, own))


def placed(structure: Structure, point: Point, before: Before, parameters: Parameters) -> dict[str, Array]:
    """The leaves of `moving_at`."""
    return leaves_of(moving_at(structure, point, before, parameters))


def simulate(structure: Structure, point: Point, given: Given, parameters: Parameters) -> dict[str, Array]:
    """The predicted records at steps 0 to `steps` (steps + 1, limb, joint), and the leaves of the state at the last."""
    stand = _stand(structure, point, parameters)

    def advance(moving: stands.Moving, sent: stands.Sent) -> tuple[stands.Moving, stands.Recorded]:
        after, seen = stands.advance(stands.with_gains(stand, sent), moving, sent.targets)
        # the rate as it stands, half a step before the angle: right where the target jumps too
        return after, seen._replace(velocity=moving.state.joint_rates)

    first = point.start._replace(state=execution.of_limbs(point.start.state))
    last, seen = over_steps(advance, structure, point, given, first)
    return seen | leaves_of(last)


def over_steps(
    advance: Callable[[Any, stands.Sent], tuple[Any, Any]], structure: Structure, point: Point, given: Any, first: Any
) -> tuple[Any, dict[str, Array]]:
    """The state at the last step of a window that begins in the state `first`, and the records at all steps, by kind.

    `advance` takes a state and the commands that reach the servos, and gives the next state and the records.
    """

    def step(carry: Any, both: tuple[stands.Sent, stands.Sent]) -> tuple[Any, dict[str, Array]]:
        moving, _ = carry
        after, seen = advance(moving, jax.tree.map(lambda value, rate: value - point.late * rate, *both))
        return (after, moving), {kind: getattr(seen, kind) for kind in structure.kinds}

    (_, last), seen = jax.lax.scan(step, (first, first), (given.sent, given.rates))
    return last, seen


def leaves_of(moving: Any) -> dict[str, Array]:
    """The leaves of a state by number, as `parted` takes them."""
    return {f"end {n}": leaf for n, leaf in enumerate(jax.tree.leaves(moving))}


def parted(found: Mapping[str, np.ndarray], like: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Split results of `simulate` into the state at the end, a tree like `like`, and the records by kind."""
    leaves = [found[f"end {n}"] for n in range(len(jax.tree.leaves(like)))]
    state = jax.tree.unflatten(jax.tree.structure(like), leaves)
    return state, {kind: value for kind, value in found.items() if not kind.startswith("end ")}


def _stand(structure: Structure, point: Point, parameters: Parameters) -> stands.Stand:
    dtype = point.x.dtype
    parameters, robot = applied(structure.places, point.x, parameters, structure.robot)
    robot = with_foot_mass(robot, structure.mass)
    robot = execution.of_limbs(jax.tree.map(lambda value: jnp.asarray(value, dtype), robot))
    hardware = hardware_of(parameters, structure.stages, structure.time_step, robot)
    return stands.Stand(robot, hardware, _lead(structure, point), structure.commanded)


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
    """A model of the windows of a log."""

    windows: Windows
    variables: tuple[Variable, ...]
    structure: Structure
    parameters: Parameters  # of the scenario, in double precision

    LEADS: ClassVar[float] = 0.0  # s, a stretch's first samples, not fitted; above 0 it is simulated from before it
    LATE: ClassVar[Mapping[str, tuple[str, ...]]] = LATE
    APART: ClassVar[bool] = False  # limbs do not feel each other
    AT_ONCE: ClassVar[int] = 1  # windows in one call of an executable
    SIMULATE: ClassVar[Any]  # `simulate`, or that of another model

    @property
    def memory(self) -> tuple[str, ...]:
        """The fitted memory of servos where a stretch begins, by the names of MEMORY."""
        return ()

    @property
    def guess(self) -> Float[np.ndarray, "stretch limb joint S"]:
        """First guesses of the states that stretches begin with, as far as they are fitted."""
        return np.zeros((int((~self.windows.abuts).sum()), 1, 1, 0))

    @property
    def guess_sd(self) -> Float[np.ndarray, " S"]:
        """Prior standard deviations of these."""
        return np.zeros(0)

    @functools.cached_property
    def lanes(self) -> list[list[int]]:
        """The variables by tangent: those of different limbs share one where these do not feel each other."""
        lanes: list[list[int]] = []
        for n, variable in enumerate(self.variables):
            if variable.key in self.LATE:
                continue
            for lane in lanes if self.APART else ():
                limbs = [self.variables[m].limb for m in lane]
                if variable.limb is not None and None not in limbs and variable.limb not in limbs:
                    lane.append(n)
                    break
            else:
                lanes.append([n])
        return lanes

    @property
    def in_pieces(self) -> "Fit":
        """A model of the same log whose cost has few local minima, from which the search begins."""
        return self

    def moves(self, variable: Variable, limb: int) -> bool:
        """Whether a variable moves the records of a limb."""
        return not self.APART or variable.limb in (None, limb)

    def begun(self, x: np.ndarray, start: np.ndarray, firsts: np.ndarray) -> tuple[Any, Any]:
        """The states in which stretches begin, whose first windows are given, and their tangents (stretch, k, ...)."""
        raise NotImplementedError

    @property
    def common(self) -> Any:
        """The data of all windows that the simulation takes."""
        return ()

    def run(self, x: np.ndarray, state: tuple[Any, Any], which: np.ndarray, *, early: bool) -> tuple[Any, Any]:
        """Results of `simulate` for windows, or for the same time before each, and their tangents."""
        (moving, turned), count, steps = state, len(which), self.windows.steps
        sent = Given(*self.sent(which, self.delay(x), early * steps))
        given = jax.tree.map(lambda value: value[:, : steps + 1], sent)._replace(common=self.common)
        of_x, late = (np.broadcast_to(each, (count, *each.shape)) for each in self.tangents())
        point = Point(np.broadcast_to(x, (count, len(x))), moving, np.zeros(count))
        of_point, of_given = jax.tree.map(lambda value: np.ndim(value) - 1, (point, given))
        axes = of_point, of_given._replace(common=jax.tree.map(np.ndim, self.common))
        return self.carried(self.SIMULATE, point, given, axes, Point(of_x, turned, late))

    def carried(self, function: Any, point: Point, given: Any, axes: Any, along: Point) -> tuple[Any, Any]:
        """Results of a function of points and their data, which have so many axes each, and their tangents."""
        count, at_once = len(point.x), min(self.AT_ONCE, int((~self.windows.abuts).sum()))
        rows = np.arange(-(-count // at_once) * at_once) % count  # whole calls of one executable
        point, given = jax.tree.map(lambda v, own: v[rows] if np.ndim(v) > own else v, (point, given), axes)
        along = jax.tree.map(lambda value: value if len(value) == 1 else value[rows], along)
        axes = (*axes, jax.tree.map(np.ndim, self.parameters))
        robots = execution.Robots((point, given, self.parameters), axes, (len(rows),), along)
        values, tangents = execution.run(function, self.structure, robots, batch_size=at_once)
        values, tangents = ({name: v[:count] for name, v in each.items()} for each in (values, tangents))
        return values, tangents

    def evaluate(self, x: np.ndarray, start: np.ndarray) -> Iterator[tuple[np.ndarray, dict[str, Any], dict[str, Any]]]:
        """Yield windows that run at the same time, the records of these and of those before, and the tangents.

        Arguments:
            x: (n,).
            start: (stretch, limb, joint, S).

        Yields:
            Windows; by kind (windows, 2 steps + 1, limb, joint), from the beginning of the windows before them; and the
            tangents (windows, k, 2 steps + 1, limb, joint) along the lanes, then along each number of a joint's state.
        """
        abuts, steps = self.windows.abuts, self.windows.steps
        firsts = np.flatnonzero(~abuts)
        lengths, kept = np.diff(np.r_[firsts, len(abuts)]), None
        state = self.begun(x, start, firsts)
        for n in range(-1 if self.LEADS else 0, int(lengths.max())):
            goes_on = lengths > n
            firsts, lengths = firsts[goes_on], lengths[goes_on]
            state, kept = jax.tree.map(lambda value, own=goes_on: value[own], (state, kept))
            found = self.run(x, state, firsts + max(n, 0), early=n < 0)
            state, records = zip(*(parted(each, state[0]) for each in found), strict=True)
            if kept is None:  # nothing is known of before
                kept = jax.tree.map(lambda value: np.repeat(value[..., :1, :, :], steps + 1, axis=-3), records)
            if n >= 0:
                joined = jax.tree.map(
                    lambda before, value: np.concatenate([before[..., :steps, :, :], value], axis=-3), kept, records
                )
                yield firsts + n, *joined
            kept = records

    @property
    def states(self) -> int:
        """How many numbers of a limb's state are fitted at the beginning of a stretch."""
        return int(np.prod(self.guess.shape[2:]))

    def tangents(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of x (k, n) and of the delay (k,) along the lanes, then none along a limb's state."""
        count = len(self.lanes) + self.states
        x, late = np.zeros((count, len(self.variables))), np.zeros(count)
        for n, lane in enumerate(self.lanes):
            x[n, lane] = 1.0
            late[n] = float(any(self.variables[m].key in (DELAY, CLOCK) for m in lane))
        return x, late

    def delay(self, x: np.ndarray) -> float:
        """Return the delay of commands at a point of coordinates (n,), s."""
        own = {v.key: float(value) for v, value in zip(self.variables, x, strict=True)}
        return own.get(DELAY, float(self.parameters.bus.command_delay)) + own.get(CLOCK, 0.0)

    def torque_delay(self, x: np.ndarray) -> float:
        """Return how late torques change after commands at a point of coordinates (n,), s."""
        own = [float(x[n]) for n, v in enumerate(self.variables) if v.key == SERVO_DELAY]
        return self.delay(x) + (own or [float(getattr(self.parameters.drive, "delay", 0.0))])[0]

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
    """The model of a log, the base held: each limb begins each stretch in a state of its own."""

    APART, AT_ONCE, SIMULATE = True, 8, staticmethod(simulate)

    @property
    def in_pieces(self) -> Fit:
        """The model of the same log in which each window begins as the log has it."""
        windows = dataclasses.replace(self.windows, abuts=np.zeros_like(self.windows.abuts))
        return Pieces(windows, self.variables, self.structure, self.parameters)

    @functools.cached_property
    def memory(self) -> tuple[str, ...]:
        """The servos' memory, by the names of MEMORY."""
        return tuple(memory(begin(jnp.zeros((1, 1)), self.structure.stages)))

    @property
    def guess(self) -> Float[np.ndarray, "stretch limb joint S"]:
        """First guesses of the states that stretches begin with, as far as they are fitted."""
        return self.logged

    @property
    def logged(self) -> Float[np.ndarray, "stretch limb joint S"]:
        """The states that stretches begin with by the log alone: a bristle is bent by the motion."""
        known = self.windows.start[~self.windows.abuts]
        guesses = {"bristle": 0.9 * np.tanh(known[..., 1] / 0.05), "loop.goal": known[..., 0]}
        own = [guesses.get(name, np.zeros(known.shape[:-1])) for name in self.memory]
        return np.concatenate([known, *(each[..., None] for each in own)], axis=-1)

    @property
    def guess_sd(self) -> Float[np.ndarray, " S"]:
        """Prior standard deviations of these."""
        return np.array([*_STATE, *(MEMORY[name] for name in self.memory)])

    def begun(self, x: np.ndarray, start: np.ndarray, firsts: np.ndarray) -> tuple[Any, Any]:
        """The states in which stretches begin, whose first windows are given, and their tangents (stretch, k, ...)."""
        before, count = self.structure.stages.servo_delay, len(firsts)
        sent, _ = self.sent(firsts, self.delay(x), before)
        given = Before(sent.targets[:, :before], jax.tree.map(lambda value: value[:, before], sent))
        _, limbs, joints, size = start.shape
        of_x, late = self.tangents()
        turned = np.zeros((1, len(late), limbs, joints, size))
        for n in range(self.states):
            turned[0, len(self.lanes) + n, :, n // size, n % size] = 1.0
        point = Point(np.broadcast_to(x, (count, len(x))), start, np.zeros(count))
        axes = (Point(1, 3, 0), jax.tree.map(lambda value: np.ndim(value) - 1, given))
        found = self.carried(placed, point, given, axes, Point(of_x[None], turned, late[None]))
        one, own = (jax.tree.map(lambda value: value[0], each) for each in (point, given))
        like = jax.eval_shape(functools.partial(moving_at, self.structure), one, own, self.parameters)
        state, turned_state = (parted(each, like)[0] for each in found)
        return state, turned_state


class Pieces(Model):
    """The model of a log in which no state is fitted: each stretch begins with the first guess of its angles and rates.

    A joint that sticks or slips by a hair then ends where it does for one window alone, not for the rest of the log.
    """

    guess = Fit.guess
    guess_sd = Fit.guess_sd

    def begun(self, x: np.ndarray, start: np.ndarray, firsts: np.ndarray) -> tuple[Any, Any]:
        """The states in which stretches begin, whose first windows are given, and their tangents (stretch, k, ...)."""
        return super().begun(x, self.logged, firsts)


def with_nuisances(scenario: mc.Scenario, chosen: Sequence[Variable], kinds: Collection[str]) -> list[Variable]:
    """Variables, and beside them the nuisances of a log, which would bend them if they were held.

    These are delays of recorded velocities, efforts and commands, and how far dry friction gives before it slips. A
    time of a log is known to a part of a time step, so that a delay may come out as much below zero.

    Arguments:
        scenario: whose stages count.
        chosen: the variables that are asked for.
        kinds: those of KINDS that are recorded.
    """
    least, keys = -scenario.time_step / 4, {v.key for v in chosen}
    found = [dataclasses.replace(v, lower=least) if v.key == DELAY else v for v in chosen]
    beside = [Variable(key, "s", 0.0, *LATENESS) for key, (kind,) in LATE.items() if {kind, "position"} <= {*kinds}]
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


def structure_of(
    scenario: mc.Scenario, places: tuple[Place, ...], stages: Stages, windows: Windows, mass: float = 0.0
) -> Structure:
    """Structure of the windows of a log; a `mass` in kg hung on each foot."""
    robot = load_robot(scenario.robot)
    return Structure(robot, places, stages, windows.time_step, windows.steps, windows.kinds, mass, windows.commanded)


def model_of(scenario: mc.Scenario, windows: Windows, chosen: Sequence[Variable], mass: float = 0.0) -> Model:
    """Return the model of a log: it has the stages of hardware that the scenario has, or that are fitted.

    A `mass` in kg hung on each foot while the log was made.
    """
    places = tuple(each.place for each in chosen)
    structure = structure_of(scenario, places, stages_for(scenario, chosen), windows, mass)
    own = own_parameters(scenario)
    own = with_options_of(own, _with_all(scenario, chosen)[0])
    return Model(windows, tuple(chosen), structure, own)
