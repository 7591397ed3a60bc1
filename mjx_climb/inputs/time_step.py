"""Is the time step short enough for this robot's contacts and joints? Answered before anything is walked.

Held by contact springs, joint loop, back EMF and the joints' friction alone (no admittance law, no gravity, no delays),
the robot is a linear system near each posture, and a step of semi-implicit Euler a matrix: `v += h M^-1 (-K x - D v)`,
then `x += h v`. Light links at the end of a stiff contact take it out of the unit circle. Postures are those
that the gait plans at both ends of each swing and in its middle: a limb is farthest back when it lifts off and farthest
ahead when it lands. The law's part is in `tuning.comparisons.stability_limit`. Where footholds are chosen, limbs may
be stretched farther than the gait plans, and are stiffer at the foot: then the posture with all of them stretched level
outwards, as far as the gait lets them, counts too. A contact or an actuator of the user's own names the springs
of feet or joints; where it does not, these are left out, and a refusal says so.
"""

import functools
import math
import warnings
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import numpy as np

from mjx_climb.execution.batch_axes import is_traced
from mjx_climb.gait.base_path import planned_feet
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.hardware.actuator import Actuator, JointSpring
from mjx_climb.hardware.servo import RELAXATION, Servos
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.gait_values import GAIT
from mjx_climb.mujoco_import import mujoco
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.contact.contact import Contact, Springs
from mjx_climb.physics.contact.gripper import SpringGrip
from mjx_climb.physics.inverse_kinematics import limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import MET, limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import PASSIVE, Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Gait, Scenario, Servo

_ROUNDING = 1e-7  # a free motion is twice the eigenvalue 1: rounding parts the two by its square root, 1e-8
# values that shorten the time step as they grow: stiffness and damping are linear in each
_STIFFENING = (
    "control.kp", "control.kd", "contact.stiffness", "contact.damping", "contact.rotational_stiffness",
    "contact.rotational_damping", "hardware.servo.viscous_friction",
)  # fmt: skip
# a walk sags and overshoots: it may ring 1 % short of the limit of its planned postures
_LONGER = 1.01  # time steps
_BESIDE = 1e-3  # of a swing, from its ends
_AT_ONCE = 1024  # robots
_FARTHEST, _SHARES = 3.0, 512  # of a foot's way outwards; the largest share within reach counts
_STEPS = sorted((digit * 10.0**-power for power in range(1, 8) for digit in (1, 2, 2.5, 5)), reverse=True)


class Own(NamedTuple):
    """Springs of a contact and of an actuator, and a gait, in place of the config's, as numbers; None: there is none.

    Springs that are not known have no stiffness.
    """

    contact: Springs | None = None
    drive: JointSpring | None = None
    gait: Gait | None = None
    chooses: bool = False  # whether limbs may land on any hold within reach, beside the config's rule


_CONFIG = Own()


def growth(scenario: Scenario, time_step: float | None = None, own: Own = _CONFIG) -> float:
    """Growth of a small disturbance in one step, at worst: 1 or less where the step is short enough."""
    h = _LONGER * (scenario.time_step if time_step is None else time_step)
    return _growth(scenario, load_robot(scenario.robot), h, own)


@functools.lru_cache(maxsize=256)
def _growth(scenario: Scenario, robot: Robot, h: float, own: Own) -> float:
    worst = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for mass, stiffness, damping in _systems(scenario, robot, h, own):
            mobility, one = np.linalg.inv(mass), np.eye(len(mass))
            k, d = h * mobility @ stiffness, h * mobility @ damping
            # v+ = v - h M^-1 (K x + D v), x+ = x + h v+, of x and h v
            step = np.block([[one - h * k, h * (one - d)], [-k, one - d]])
            if not np.isfinite(step).all():
                return math.inf
            worst = max(worst, np.abs(np.linalg.eigvals(step)).max())
    return float(worst)


def short_enough(scenario: Scenario, own: Own = _CONFIG) -> bool:
    """Return whether contacts and joints can follow the scenario's time step."""
    return growth(scenario, None, own) <= 1 + _ROUNDING


def largest_time_step(scenario: Scenario, source: str = "scenario", own: Own = _CONFIG) -> float:
    """Return the largest round time step, s, that is short enough and divides duration and gait cycle.

    Raises:
        ConfigError: there is none above 0.1 microseconds.
    """
    spans = [scenario.duration, scenario.gait.cycle]
    spans += [scenario.hardware.control_period] if scenario.hardware.control_period else []
    spans += [1 / rate] if (rate := scenario.value("hardware.servo.rate")) else []
    for step in _STEPS:
        whole = all(math.isclose(span / step, round(span / step), rel_tol=1e-9) and round(span / step) >= 1
                    for span in spans)  # fmt: skip
        if whole and growth(scenario, step, own) <= 1 + _ROUNDING:
            return step
    raise ConfigError(
        source, "time_step", "contacts and joint gains that some step of 0.1 us or more can follow", "none"
    )


def check_time_step(scenario: Scenario, source: str = "scenario", parameters: Parameters | None = None) -> None:
    """Refuse a time step too long for the robot's contacts and joint loop.

    Parameters, with any batch axes, replace the scenario's: the step is short enough for each robot. Those that JAX
    traces stay the scenario's, and so do values of the gait that differ from robot to robot. A warning names a contact
    or an actuator that does not name its springs: it is left out.

    Raises:
        ConfigError: in one line, the time step that would do.
    """
    if parameters is None and scenario.kinds:
        parameters = own_parameters(scenario, source)
    if parameters is not None:
        _warn_of_unknown_springs(parameters, scenario.time_step)
    largest, *each = [_CONFIG] if parameters is None else _own_springs(parameters, scenario)
    unstable = _unstable(scenario, parameters, largest)
    if unstable is not None and each:  # no robot of the batch may have all the largest values
        found = (_unstable(scenario, parameters, own) for own in each)
        unstable = next((one for one in found if one is not None), None)
    if unstable is None:
        return
    scenario, own = unstable
    feet, joints = _words(scenario, own, parameters)
    raise ConfigError(
        source,
        "time_step",
        f"one short enough for {load_robot(scenario.robot).name} with {feet}{joints}",
        f"{scenario.time_step:g} (a disturbance grows {growth(scenario, None, own):.3g}-fold a step): "
        f"{largest_time_step(scenario, source, own):g} would do",
    )


def _warn_of_unknown_springs(parameters: Parameters, time_step: float) -> None:
    contact, drive = parameters.contact, parameters.drive
    unknown = [(contact, "springs")] if contact.springs() is None else []
    known = isinstance(drive, Servos) or drive.spring(time_step) is not None
    unknown += [] if known else [(drive, "spring")]
    for component, method in unknown:
        lacks = f"{type(component).__name__} has no method {method}"
        warnings.warn(f"{lacks}: the time step of {time_step:g} s is not checked for its stiffness", stacklevel=4)


def _unstable(scenario: Scenario, parameters: Parameters | None, own: Own) -> tuple[Scenario, Own] | None:
    """Return the scenario and springs of a robot that the time step is too long for, None where there is none."""
    scenario = scenario if parameters is None else _stiffest(scenario, parameters, own)
    return None if short_enough(scenario, own) else (scenario, own)


def _own_springs(parameters: Parameters, scenario: Scenario) -> list[Own]:
    """Return the springs of contact and actuator: the largest values of a batch first, then those of each robot."""
    gait, h = _shared_gait(parameters, scenario.gait), scenario.time_step
    contact = None if isinstance(parameters.contact, SpringGrip) else parameters.contact.springs() or Springs(0.0, 0.0)
    drive = None if isinstance(parameters.drive, Servos) else parameters.drive.spring(h) or JointSpring(0.0, 0.0)
    chooses = parameters.ground.holds is not None and not (parameters.footholds is parameters.recovery is None)
    leaves, tree = jax.tree.flatten((contact, drive))
    if not leaves:
        return [Own(gait=gait, chooses=chooses)]
    values = [np.zeros(()) if is_traced(leaf) else np.asarray(leaf, float) for leaf in leaves]
    rows = np.unique(np.stack(np.broadcast_arrays(*values), -1).reshape(-1, len(values)), axis=0)
    rows = rows if len(rows) == 1 else np.vstack([rows.max(0), rows])
    each = (jax.tree.unflatten(tree, row.tolist()) for row in rows)
    return [Own(contact, drive, gait, chooses) for contact, drive in each]


def _shared_gait(parameters: Parameters, own: Gait) -> Gait:
    """Return the gait with the values that all robots have in place of its own."""
    values = parameters.values
    given = {path.removeprefix("gait."): values[path] for path in GAIT}
    known = {key: np.unique(np.asarray(value, float)) for key, value in given.items() if not is_traced(value)}
    return own.model_copy(update={key: float(values[0]) for key, values in known.items() if len(values) == 1})


def _words(scenario: Scenario, own: Own, parameters: Parameters | None) -> tuple[str, str]:
    """Return the descriptions of the springs of feet and joints, for a refusal."""
    control, friction = scenario.control, scenario.value("hardware.servo.coulomb_friction", 0.0)
    emf = _of_loop(scenario)[1] - control.kd
    driven = f", a back EMF of {emf:.3g} N m s/rad" if emf else ""
    sticking = f", hardware.servo.coulomb_friction {friction:g}" if friction else ""
    joints = f"{sticking}{driven}, control.kp {control.kp:g} and control.kd {control.kd:g}"
    if parameters is not None and own.contact is not None:
        feet = _of_own(parameters.contact, own.contact, "N/m", "N s/m")
    else:
        contact = _springs(scenario)
        feet = f"contact.stiffness {contact.stiffness:g}, contact.damping {contact.damping:g}"
    if parameters is not None and own.drive is not None:
        joints = f" and {_of_own(parameters.drive, own.drive, 'N m/rad', 'N m s/rad')}"
    stretched = ", limbs stretched to the farthest footholds that may be chosen" if _chooses(scenario, own) else ""
    return feet, joints + stretched


def _of_own(component: Contact | Actuator | None, spring: Springs | JointSpring, of_angle: str, of_rate: str) -> str:
    name = type(component).__name__
    if not any(spring):
        return f"{name}, whose springs are not known"
    return f"{name} of {spring.stiffness:g} {of_angle} and {spring.damping:g} {of_rate}"


def _stiffest(scenario: Scenario, parameters: Parameters, springs: Own) -> Scenario:
    """Return the scenario of a robot that the time step is too long for, of the stiffest where there is none.

    Where the step is short enough for the largest value of each parameter it is for all robots: a disturbance does not
    grow while 4 M - 2 h D - h^2 K is positive definite, all three being symmetric.
    """
    values = parameters.values
    known = {n: np.asarray(values[n], float) for n in _STIFFENING if n in values and not is_traced(values[n])}
    own = {path: scenario.value(path, math.nan) for path in known}
    largest = {name: float(values.max()) for name, values in known.items()}

    def of(values: Mapping[str, float]) -> Scenario:
        others = {n: value for n, value in values.items() if not math.isclose(value, own[n], rel_tol=1e-6)}
        return scenario.with_overrides(others) if others else scenario

    stiffest = of(largest)
    if all(values.size == 1 for values in known.values()) or short_enough(stiffest, springs):
        return stiffest
    rows = np.unique(np.stack(np.broadcast_arrays(*known.values()), -1).reshape(-1, len(known)), axis=0)
    least, change = _definite(stiffest, springs), []
    for name, most in largest.items():
        half = of(largest | {name: most / 2}) if most else stiffest
        change.append((least - _definite(half, springs)) / (most / 2 if most else 1.0))
    for start in range(0, len(rows), _AT_ONCE):
        some = rows[start : start + _AT_ONCE]
        definite = least + np.tensordot(some - [*largest.values()], np.stack(change), 1)
        for row in some[(np.linalg.eigvalsh(definite)[..., 0] < 0).any(1)]:
            if not short_enough(found := of(dict(zip(known, row.tolist(), strict=True))), springs):
                return found
    return of(dict(zip(known, rows[0].tolist(), strict=True)))


def _definite(scenario: Scenario, own: Own) -> np.ndarray:
    """Return 4 M - 2 h D - h^2 K of each posture, (S, 18, 18)."""
    h = _LONGER * scenario.time_step
    return np.stack(
        [4 * m - 2 * h * d - h * h * k for m, k, d in _systems(scenario, load_robot(scenario.robot), h, own)]
    )


def _systems(
    scenario: Scenario, robot: Robot, h: float, own: Own
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield mass, stiffness and damping matrix (18, 18) at each posture, by steps of `h`."""
    model = robot.model
    servo = _servo(scenario) if own.drive is None else Servo()
    joint = np.repeat([0.0, 1.0], [6, model.nv - 6])  # 1: of a joint
    driven, spring = np.ones(model.nv), np.zeros(model.nv)
    driven[6:], spring[6:] = model.jnt_group[1:] != PASSIVE, model.jnt_stiffness[1:]
    dry, viscous = servo.coulomb_friction + servo.stribeck_friction + model.dof_frictionloss, servo.viscous_friction
    loop = JointSpring(*_of_loop(scenario)) if own.drive is None else own.drive
    if own.drive is not None:
        dry = 0 * dry
    springs = _springs(scenario) if own.contact is None else own.contact
    postures = _planned(robot, own.gait or scenario.gait)
    if _chooses(scenario, own):
        postures = [*postures, (np.ones(model.nsite, bool), _stretched(robot))]
    for grips, (mass, *jacobians) in postures:
        places, turns = (jacobian[grips].reshape(-1, model.nv) for jacobian in jacobians)
        held = springs.stiffness * places.T @ places + springs.rotational_stiffness * turns.T @ turns
        resisted = springs.damping * places.T @ places
        if springs.rotational_stiffness:
            resisted += springs.rotational_damping * turns.T @ turns
        for bristle in (0 * dry, dry / servo.presliding) if dry.any() else (0 * dry,):  # slipping, sticking
            damping = bristle * (RELAXATION + h)
            of_rates = loop.damping * driven + viscous + model.dof_damping + damping
            yield (
                mass + np.diag((servo.armature + loop.armature * driven + h * damping) * joint),
                np.diag((loop.stiffness * driven + spring + bristle) * joint) + held,
                np.diag(of_rates * joint) + resisted,
            )


def _chooses(scenario: Scenario, own: Own) -> bool:
    """Return whether limbs may land on any hold within reach."""
    return own.chooses or (scenario.gait.footholds != "planned" and scenario.ground.holds is not None)


def _springs(scenario: Scenario) -> Springs:
    """The springs of a config's contact; one without such a key has none there."""
    return Springs(*(scenario.value(f"contact.{name}", 0.0) for name in Springs._fields))


def _servo(scenario: Scenario) -> Servo:
    """The servos of a config; a kind of its own has their defaults where it names no value."""
    servo = scenario.hardware.servo
    if isinstance(servo, Servo):
        return servo
    return Servo(**{key: value for key, value in servo.items() if key in Servo.model_fields and key != "kind"})


def _of_loop(scenario: Scenario) -> tuple[float, float]:
    """Return stiffness, N m/rad, and damping, N m s/rad, of the joint loop and of the back EMF under a voltage."""
    control, servo = scenario.control, _servo(scenario)
    if servo.drive == "torque" or servo.torque_limit is None or servo.no_load_speed is None:
        return control.kp, control.kd
    richer = 1.0
    if servo.supply_voltage is not None and servo.rated_voltage is not None:
        richer = servo.supply_voltage / servo.rated_voltage
    return richer * control.kp, richer * control.kd + servo.torque_limit / servo.no_load_speed


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
