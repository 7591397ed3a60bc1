"""Is the time step short enough for this robot's contacts and joints? Answered before anything is walked.

Held by contact springs, joint loop, back EMF and viscous friction alone (no admittance law, no gravity, no delays), the
robot is a linear system near each posture, and a step of semi-implicit Euler a matrix: `v += h M^-1 (-K x - D v)`, then
`x += h v`. Dry friction that sticks shortens no step, as its bristles are taken at the end of the step. Light links at
the end of a stiff contact take it out of the unit circle. Postures are those that the gait plans at both ends of each
swing and in its middle: a limb is farthest back when it lifts off and farthest ahead when it lands. The law's part is
in `tuning.comparisons.stability_limit`. Where footholds are chosen, limbs may be stretched farther than the gait plans,
and are stiffer at the foot: then the posture with all of them stretched level outwards, as far as the gait lets them,
counts too. A contact or an actuator of the user's own names the springs of feet or joints; where it does not, these are
left out, and a refusal says so.
"""

import functools
import math
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_climb.gait.base_path import planned_feet
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.hardware.actuator import JointSpring
from mjx_climb.hardware.servo import Servos
from mjx_climb.inputs.from_scenario import known_parameters, own_parameters
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.mujoco_import import mujoco
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.contact.contact import Springs
from mjx_climb.physics.contact.gripper import SpringGrip
from mjx_climb.physics.inverse_kinematics import limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import MET, limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import PASSIVE, Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Gait, Scenario

_ROUNDING = 1e-7  # a free motion is twice the eigenvalue 1: rounding parts the two by its square root, 1e-8
# a walk sags and overshoots: it may ring 1 % short of the limit of its planned postures
_LONGER = 1.01  # time steps
_BESIDE = 1e-3  # of a swing, from its ends
_AT_ONCE = 1024  # robots
_FARTHEST, _SHARES = 3.0, 512  # of a foot's way outwards; the largest share within reach counts
_STEPS = sorted((digit * 10.0**-power for power in range(1, 8) for digit in (1, 2, 2.5, 5)), reverse=True)


class Held(NamedTuple):
    """How feet and joints are held, of one robot or with the axes of a batch; springs that are not known are none."""

    contact: Springs
    joint: JointSpring  # of the joint loop, and of the back EMF under a voltage
    armature: Any = 0.0  # kg m^2
    viscous: Any = 0.0  # N m s/rad


# which of these numbers shorten the time step as they grow: the others, inertias, lengthen it
_STIFFENING = np.array(jax.tree.leaves(Held(Springs(1, 1, 1, 1), JointSpring(1, 1, 0), 0, 1)), bool)


class System(NamedTuple):
    """A robot with its gait, by whose postures it moves, and how it is held; hashable."""

    robot: Robot
    gait: Gait
    chooses: bool  # whether limbs may land on any hold within reach
    held: Held


def growth(scenario: Scenario, time_step: float | None = None, parameters: Parameters | None = None) -> float:
    """Growth of a small disturbance in one step, at worst: 1 or less where the step is short enough.

    `parameters` of one robot replace the scenario's.
    """
    system, *_ = _systems(scenario, own_parameters(scenario) if parameters is None else parameters)
    return _growth(system, scenario.time_step if time_step is None else time_step)


@functools.lru_cache(maxsize=256)
def _growth(system: System, time_step: float) -> float:
    worst, h = 0.0, _LONGER * time_step
    with np.errstate(over="ignore", invalid="ignore"):
        for mass, stiffness, damping in _matrices_of(system):
            mobility, one = np.linalg.inv(mass), np.eye(len(mass))
            k, d = h * mobility @ stiffness, h * mobility @ damping
            # v+ = v - h M^-1 (K x + D v), x+ = x + h v+, of x and h v
            step = np.block([[one - h * k, h * (one - d)], [-k, one - d]])
            if not np.isfinite(step).all():
                return math.inf
            worst = max(worst, np.abs(np.linalg.eigvals(step)).max())
    return float(worst)


def short_enough(scenario: Scenario) -> bool:
    """Return whether contacts and joints can follow the scenario's time step."""
    return growth(scenario) <= 1 + _ROUNDING


def largest_time_step(scenario: Scenario, source: str = "scenario") -> float:
    """Return the largest round time step, s, that is short enough and divides duration and gait cycle.

    Raises:
        ConfigError: there is none above 0.1 microseconds.
    """
    system, *_ = _systems(scenario, own_parameters(scenario, source))
    return _largest(scenario, source, system)


def _largest(scenario: Scenario, source: str, system: System) -> float:
    spans = [scenario.duration, scenario.gait.cycle]
    spans += [scenario.hardware.control_period] if scenario.hardware.control_period else []
    spans += [1 / rate] if (rate := scenario.value("hardware.servo.rate")) else []
    for step in _STEPS:
        whole = all(math.isclose(span / step, round(span / step), rel_tol=1e-9) and round(span / step) >= 1
                    for span in spans)  # fmt: skip
        if whole and _growth(system, step) <= 1 + _ROUNDING:
            return step
    expected = "contacts and joint gains that some step of 0.1 us or more can follow"
    raise ConfigError(source, "time_step", expected, "none")


def check_time_step(scenario: Scenario, source: str = "scenario", parameters: Parameters | None = None) -> None:
    """Refuse a time step too long for the robot's contacts and joint loop.

    Parameters, with any batch axes, replace the scenario's: the step is short enough for each robot. Those that JAX
    traces stay the scenario's, and so do values of the gait that differ from robot to robot. A warning names a contact
    or an actuator that does not name its springs: it is left out.

    Raises:
        ConfigError: in one line, the time step that would do.
    """
    with jax.ensure_compile_time_eval():  # under `jit` too: values that are known
        walked = own_parameters(scenario, source) if parameters is None else known_parameters(scenario, parameters)[0]
        if parameters is not None or scenario.kinds:
            _warn_of_unknown_springs(walked, scenario.time_step)
        system, rows, places = _systems(scenario, walked)
        if (number := _first_unstable(system, rows, scenario.time_step)) is None:
            return
        system = _with(system, rows[number])
        got = f"{scenario.time_step:g} (a disturbance grows {_growth(system, scenario.time_step):.3g}-fold a step)"
        on = f"{load_robot(scenario.robot).name} with {_words(system, walked, places[number])}"
        got = f"{got}: {_largest(scenario, source, system):g} would do"
        raise ConfigError(source, "time_step", f"one short enough for {on}", got)


def _warn_of_unknown_springs(parameters: Parameters, time_step: float) -> None:
    contact, drive = parameters.contact, parameters.drive
    unknown = [(contact, "springs")] if contact.springs() is None else []
    known = isinstance(drive, Servos) or drive.spring(time_step) is not None
    unknown += [] if known else [(drive, "spring")]
    for component, method in unknown:
        lacks = f"{type(component).__name__} has no method {method}"
        warnings.warn(f"{lacks}: the time step of {time_step:g} s is not checked for its stiffness", stacklevel=4)


def _systems(scenario: Scenario, parameters: Parameters) -> tuple[System, np.ndarray, np.ndarray]:
    """Return the first robot of a batch, the numbers by which others are held, a row each, and their places in it."""
    leaves, tree = jax.tree.flatten(_held(parameters, scenario.time_step))
    values = np.stack(np.broadcast_arrays(*(np.asarray(leaf, float) for leaf in leaves)), -1).reshape(-1, len(leaves))
    rows, places = np.unique(values, axis=0, return_index=True)
    chooses = parameters.ground.holds is not None and not (parameters.footholds is parameters.recovery is None)
    held: Held = jax.tree.unflatten(tree, rows[0].tolist())
    return System(load_robot(scenario.robot), _shared_gait(parameters, scenario.gait), chooses, held), rows, places


def _with(system: System, row: np.ndarray) -> System:
    """Return the robot that is held by a row of numbers."""
    return system._replace(held=jax.tree.unflatten(jax.tree.structure(system.held), row.tolist()))


def _held(parameters: Parameters, time_step: float) -> Held:
    drive, loop = parameters.drive, parameters.joint_loop
    contact = parameters.contact.springs() or Springs(0.0, 0.0)
    _check_kind(parameters.contact, "springs", contact, Springs)
    if not isinstance(drive, Servos):
        spring = drive.spring(time_step) or JointSpring(0.0, 0.0)
        _check_kind(drive, "spring", spring, JointSpring)
        return Held(contact, spring)
    richer: Any = 1.0
    if drive.drive == "voltage":
        known = np.isfinite(drive.supply_voltage) & np.isfinite(drive.rated_voltage)
        supply, rated = (np.where(known, volts, 1.0) for volts in (drive.supply_voltage, drive.rated_voltage))
        richer = supply / rated
    kp, kd = (richer * np.asarray(gain) for gain in (loop.kp, loop.kd))
    return Held(contact, JointSpring(kp, kd + _back_emf(drive)), drive.armature, drive.viscous_friction)


def _check_kind(component: object, method: str, found: object, kind: type) -> None:
    if not isinstance(found, kind):
        raise ConfigError(f"{type(component).__name__}.{method}", "", f"a {kind.__name__} or None", repr(found))


def _back_emf(drive: Servos) -> Any:
    """The damping of the motors' back EMF, N m s/rad."""
    return np.asarray(drive.torque_limit) / drive.no_load_speed if drive.drive == "voltage" else 0.0


def _shared_gait(parameters: Parameters, own: Gait) -> Gait:
    """Return the gait with the values that all robots have in place of its own."""
    walked = parameters.values
    known = {path.removeprefix("gait."): np.unique(np.asarray(walked[path], float)) for path in GAIT}
    return own.model_copy(update={key: float(values[0]) for key, values in known.items() if len(values) == 1})


def _words(system: System, parameters: Parameters, place: int) -> str:
    """Return how the feet and joints of one of the robots are held, for a refusal."""
    shape = np.broadcast_shapes(*map(np.shape, jax.tree.leaves(_held(parameters, 1.0))))

    def value(path: str) -> float:
        return float(np.broadcast_to(np.asarray(parameters.at(path), float), shape).ravel()[place])

    def of_own(component: object, spring: Springs | JointSpring, of_angle: str, of_rate: str) -> str:
        name = type(component).__name__
        if not any(spring):
            return f"{name}, whose springs are not known"
        return f"{name} of {spring.stiffness:g} {of_angle} and {spring.damping:g} {of_rate}"

    feet = of_own(parameters.contact, system.held.contact, "N/m", "N s/m")
    if isinstance(parameters.contact, SpringGrip):
        feet = f"contact.stiffness {value('contact.stiffness'):g}, contact.damping {value('contact.damping'):g}"
    joints = f" and {of_own(parameters.drive, system.held.joint, 'N m/rad', 'N m s/rad')}"
    if isinstance(parameters.drive, Servos):
        kp, kd = map(value, ("control.kp", "control.kd"))
        emf = float(np.broadcast_to(_back_emf(parameters.drive), shape).ravel()[place])
        joints = f", a back EMF of {emf:.3g} N m s/rad" if emf else ""
        joints += f", control.kp {kp:g} and control.kd {kd:g}"
    stretched = ", limbs stretched to the farthest footholds that may be chosen" if system.chooses else ""
    return feet + joints + stretched


def _first_unstable(system: System, rows: np.ndarray, time_step: float) -> int | None:
    """Return the number of the first row that the time step is too long for, None where there is none.

    Where the step is short enough for the stiffest value of each number it is for all robots: a disturbance does not
    grow while 4 M - 2 h D - h^2 K is positive definite, all three being symmetric.
    """

    def unstable(row: np.ndarray) -> bool:
        return _growth(_with(system, row), time_step) > 1 + _ROUNDING

    def definite(row: np.ndarray) -> np.ndarray:
        """Return 4 M - 2 h D - h^2 K of each posture, linear in the numbers of a row."""
        h = _LONGER * time_step
        return np.stack([4 * m - 2 * h * d - h * h * k for m, k, d in _matrices_of(_with(system, row), True)])

    if not unstable(np.where(_STIFFENING, rows.max(0), rows.min(0))):
        return None
    if len(rows) == 1:
        return 0
    none = definite(np.zeros(rows.shape[1]))
    change = np.stack([definite(unit) - none for unit in np.eye(rows.shape[1])])
    for start in range(0, len(rows), _AT_ONCE):
        each = none + np.tensordot(rows[start : start + _AT_ONCE], change, 1)
        for number in start + np.flatnonzero((np.linalg.eigvalsh(each)[..., 0] < 0).any(1)):
            if unstable(rows[number]):
                return int(number)
    return None


def _matrices_of(system: System, whole: bool = False) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield mass, stiffness and damping matrix (18, 18) at each posture.

    `whole` asks for the damping of feet that turn where no stiffness holds them against it too.
    """
    robot, gait, chooses, held = system
    model, (contact, loop) = robot.model, held[:2]
    joint = np.repeat([0.0, 1.0], [6, model.nv - 6])  # 1: of a joint
    driven, spring = np.ones(model.nv), np.zeros(model.nv)
    driven[6:], spring[6:] = model.jnt_group[1:] != PASSIVE, model.jnt_stiffness[1:]
    postures = _planned(robot, gait)
    if chooses:
        postures = [*postures, (np.ones(model.nsite, bool), _stretched(robot))]
    for grips, (mass, *jacobians) in postures:
        places, turns = (jacobian[grips].reshape(-1, model.nv) for jacobian in jacobians)
        stiff = contact.stiffness * places.T @ places + contact.rotational_stiffness * turns.T @ turns
        resisted = contact.damping * places.T @ places
        if contact.rotational_stiffness or whole:
            resisted += contact.rotational_damping * turns.T @ turns
        of_rates = loop.damping * driven + held.viscous + model.dof_damping
        yield (
            mass + np.diag((held.armature + loop.armature * driven) * joint),
            np.diag((loop.stiffness * driven + spring) * joint) + stiff,
            np.diag(of_rates * joint) + resisted,
        )


@functools.lru_cache(maxsize=64)
def _planned(robot: Robot, gait: Gait) -> list[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """Return which feet are held, (L,) bool, and the matrices of `_matrices`, at the moments of a gait."""
    feet, swing = planned_feet(robot, gait, _moments(gait))
    angles = _posture(robot, feet @ quaternion_to_matrix(robot.stance_orientation))
    held = (swing < 0) | (swing > 1)
    return [(grips, _matrices(robot, each)) for grips, each in zip(held, angles, strict=True)]


def _moments(gait: Gait) -> np.ndarray:
    """Return phases of the cycle beside both ends of each swing, and in its middle."""
    swing, moves = 1 - gait.duty, 1 - gait.settling
    shares = np.array([-_BESIDE, _BESIDE, moves / 2, moves * (1 - _BESIDE), 1 - _BESIDE, 1 + _BESIDE])
    moments = np.add.outer(list(gait.lift_off.values()), swing * shares)
    return np.unique((moments % 1).round(9))


@functools.lru_cache(maxsize=64)
def _stretched(robot: Robot) -> tuple[np.ndarray, ...]:
    """Return the matrices with all limbs stretched level outwards, as far as a gait chooses footholds."""
    frames, up = limb_frames(robot, None, robot.stance_joints), quaternion_to_matrix(robot.stance_orientation)[2]
    lever = frames.foot - robot.frame_position[:, 0]
    outwards = lever - (lever @ up)[:, None] * up
    feet = frames.foot + np.linspace(0.0, _FARTHEST, _SHARES)[:, None, None] * outwards
    may = within_reach(robot, limb_geometry(robot), feet)
    farthest = feet[_SHARES - 1 - may[::-1].argmax(0), np.arange(len(outwards))]
    return _matrices(robot, _posture(robot, farthest))


def _matrices(robot: Robot, angles: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return mass matrix and foot Jacobians (L, 3, 18), of places and of turning, at joint angles (L, N) rad."""
    model = robot.model
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    data.qpos[7:] = angles.ravel()
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    places, turns = np.empty((2, model.nsite, 3, model.nv))
    for site in range(model.nsite):
        mujoco.mj_jacSite(model, data, places[site], turns[site], site)
    return mass, places, turns


def _posture(robot: Robot, feet: np.ndarray) -> np.ndarray:
    """Return joint angles (..., L, N) for feet (..., L, 3) m in the base's axes; where a limb misses, its stance."""
    solved = limb_joints(robot, feet, robot.stance_joints)
    return np.where(solved.errors[..., None] < MET, solved.angles, robot.stance_joints)
