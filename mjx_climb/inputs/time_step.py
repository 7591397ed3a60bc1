"""Is the time step short enough for this robot's contacts and joints? Answered before anything is walked.

Held by contact springs, joint loop, back EMF and the joints' friction alone (no admittance law, no gravity, no delays),
the robot is a linear system near each posture of its gait, and a step of semi-implicit Euler a matrix: `v += h M^-1 (-K
x - D v)`, then `x += h v`. Light links at the end of a stiff contact are what takes it out of the unit circle. What a
law adds is in `tuning.evaluation.stability_limit`.
"""

import functools
import itertools
import math
import operator
from collections.abc import Iterator, Mapping

import numpy as np

from mjx_climb.execution.batch_axes import is_traced
from mjx_climb.hardware.servo import RELAXATION
from mjx_climb.mujoco_import import mujoco
from mjx_climb.parameter_types import KEYS, Parameters
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import MET, limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import PASSIVE
from mjx_climb.robot_import.load import load_model, load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile, Scenario

_ROUNDING = 1e-7  # a free motion is twice the eigenvalue 1: rounding parts the two by its square root, 1e-8
# parameters that shorten the time step as they grow: stiffness and damping are linear in each
_STIFFENING = (
    "kp", "kd", "contact_stiffness", "contact_damping", "rotational_stiffness", "rotational_damping",
    "viscous_friction",
)  # fmt: skip
_AT_ONCE = 1024  # robots
_STEPS = sorted((digit * 10.0**-power for power in range(1, 8) for digit in (1, 2, 2.5, 5)), reverse=True)


@functools.lru_cache(maxsize=256)
def growth(scenario: Scenario, time_step: float | None = None) -> float:
    """Return by how much a small disturbance grows in one step, at worst: 1 or less where the step is short enough."""
    h = scenario.time_step if time_step is None else time_step
    worst = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for mass, stiffness, damping in _systems(scenario, h):
            mobility, one = np.linalg.inv(mass), np.eye(len(mass))
            k, d = h * mobility @ stiffness, h * mobility @ damping
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
    spans = [scenario.duration, scenario.gait.cycle]
    spans += [scenario.hardware.control_period] if scenario.hardware.control_period else []
    spans += [1 / scenario.hardware.servo.rate] if scenario.hardware.servo.rate else []
    for step in _STEPS:
        whole = all(math.isclose(span / step, round(span / step), rel_tol=1e-9) and round(span / step) >= 1
                    for span in spans)  # fmt: skip
        if whole and growth(scenario, step) <= 1 + _ROUNDING:
            return step
    raise ConfigError(
        f"{source}: time_step: expected contacts and joint gains that some step of 0.1 us or more can follow, got none"
    )


def check_time_step(scenario: Scenario, source: str = "scenario", parameters: Parameters | None = None) -> None:
    """Refuse a time step too long for the robot's contacts and joint loop.

    Parameters, with any batch axes, replace the scenario's: the step is short enough for each robot. Those that JAX
    traces stay the scenario's.

    Raises:
        ConfigError: in one line, the time step that would do.
    """
    scenario = scenario if parameters is None else _stiffest(scenario, parameters)
    grows = growth(scenario)
    if grows <= 1 + _ROUNDING:
        return
    contact, control, friction = scenario.contact, scenario.control, scenario.hardware.servo.coulomb_friction
    emf = _of_loop(scenario)[1] - control.kd
    driven = f", a back EMF of {emf:.3g} N m s/rad" if emf else ""
    sticking = f", hardware.servo.coulomb_friction {friction:g}" if friction else ""
    raise ConfigError(
        f"{source}: time_step: expected one short enough for {load_robot(scenario.robot).name} with contact.stiffness "
        f"{contact.stiffness:g}, contact.damping {contact.damping:g}{sticking}{driven}, control.kp {control.kp:g} and "
        f"control.kd {control.kd:g}, got {scenario.time_step:g} (a disturbance grows {grows:.3g}-fold a step): "
        f"{largest_time_step(scenario, source):g} would do"
    )


def _stiffest(scenario: Scenario, parameters: Parameters) -> Scenario:
    """Return the scenario of a robot that the time step is too long for, of the stiffest where there is none.

    Where the step is short enough for the largest value of each parameter it is for all robots: a disturbance does not
    grow while 4 M - 2 h D - h^2 K is positive definite, of which the three are symmetric.
    """
    known = {n: np.asarray(v, float) for n in _STIFFENING if not is_traced(v := getattr(parameters, n))}
    own = {name: float(operator.attrgetter(KEYS[name])(scenario)) for name in known}
    largest = {name: float(values.max()) for name, values in known.items()}

    def of(values: Mapping[str, float]) -> Scenario:
        others = {KEYS[n]: value for n, value in values.items() if not math.isclose(value, own[n], rel_tol=1e-6)}
        return scenario.with_overrides(others) if others else scenario

    stiffest = of(largest)
    if all(values.size == 1 for values in known.values()) or short_enough(stiffest):
        return stiffest
    rows = np.unique(np.stack(np.broadcast_arrays(*known.values()), -1).reshape(-1, len(known)), axis=0)
    least, change = _definite(stiffest), []
    for name, most in largest.items():
        half = of(largest | {name: most / 2}) if most else stiffest
        change.append((least - _definite(half)) / (most / 2 if most else 1.0))
    for start in range(0, len(rows), _AT_ONCE):
        some = rows[start : start + _AT_ONCE]
        definite = least + np.tensordot(some - [*largest.values()], np.stack(change), 1)
        for row in some[(np.linalg.eigvalsh(definite)[..., 0] < 0).any(1)]:
            if not short_enough(found := of(dict(zip(known, row.tolist(), strict=True)))):
                return found
    return of(dict(zip(known, rows[0].tolist(), strict=True)))


def _definite(scenario: Scenario) -> np.ndarray:
    """Return 4 M - 2 h D - h^2 K of each posture, (S, 18, 18)."""
    h = scenario.time_step
    return np.stack([4 * m - 2 * h * d - h * h * k for m, k, d in _systems(scenario, h)])


def _systems(scenario: Scenario, h: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield mass, stiffness and damping matrix (18, 18) at stance and on the way of every swing, by steps of `h`."""
    model = load_model(scenario.robot)
    contact, walk, servo = scenario.contact, scenario.gait, scenario.hardware.servo
    feet, joint = np.arange(model.nsite), np.repeat([0.0, 1.0], [6, model.nv - 6])  # 1: of a joint
    driven, spring = np.ones(model.nv), np.zeros(model.nv)
    driven[6:], spring[6:] = model.jnt_group[1:] != PASSIVE, model.jnt_stiffness[1:]
    dry = servo.coulomb_friction + servo.stribeck_friction + model.dof_frictionloss
    kp, kd = _of_loop(scenario)
    swings = itertools.product(feet, ((walk.stride / 2, walk.step_height), (walk.stride, 0.0), (-walk.stride, 0.0)))
    for limb, away in ((None, (0.0, 0.0)), *swings):
        mass, *jacobians = _at(scenario.robot, limb, *away)
        places, turns = (jacobian[feet != limb].reshape(-1, model.nv) for jacobian in jacobians)
        held = contact.stiffness * places.T @ places + contact.rotational_stiffness * turns.T @ turns
        resisted = contact.damping * places.T @ places
        if contact.rotational_stiffness:
            resisted += contact.rotational_damping * turns.T @ turns
        for bristle in (0 * dry, dry / servo.presliding) if dry.any() else (0 * dry,):  # slipping, sticking
            damping = bristle * (RELAXATION + h)
            viscous = kd * driven + servo.viscous_friction + model.dof_damping + damping
            yield (
                mass + np.diag((servo.armature + h * damping) * joint),
                np.diag((kp * driven + spring + bristle) * joint) + held,
                np.diag(viscous * joint) + resisted,
            )


def _of_loop(scenario: Scenario) -> tuple[float, float]:
    """Return stiffness, N m/rad, and damping, N m s/rad, of the joint loop and of the back EMF under a voltage."""
    control, servo = scenario.control, scenario.hardware.servo
    if servo.drive == "torque" or servo.torque_limit is None or servo.no_load_speed is None:
        return control.kp, control.kd
    richer = 1.0
    if servo.supply_voltage is not None and servo.rated_voltage is not None:
        richer = servo.supply_voltage / servo.rated_voltage
    return richer * control.kp, richer * control.kd + servo.torque_limit / servo.no_load_speed


@functools.lru_cache(maxsize=256)
def _at(robot: str | RobotFile, swinging: int | None, ahead: float, up: float) -> tuple[np.ndarray, ...]:
    """Return mass matrix and foot Jacobians (L, 3, 18), of places and of turning, at stance or with one foot moved."""
    model = load_model(robot)
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[0]
    if swinging is not None:
        data.qpos[7:].reshape(model.nsite, -1)[swinging] = _moved(robot, ahead, up)[swinging]
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    places, turns = np.empty((2, model.nsite, 3, model.nv))
    for site in range(model.nsite):
        mujoco.mj_jacSite(model, data, places[site], turns[site], site)
    return mass, places, turns


@functools.lru_cache(maxsize=64)
def _moved(robot: str | RobotFile, ahead: float, up: float) -> np.ndarray:
    """Return joint angles (L, N) with all feet as far from the stance; those of the stance where one cannot be."""
    loaded = load_robot(robot)
    feet = limb_frames(loaded, None, loaded.stance_joints).foot
    # ahead and up are the world's, the feet in the frame of the base
    turned = quaternion_to_matrix(loaded.stance_orientation).T @ np.array([ahead, 0, up])
    solved = limb_joints(loaded, feet + turned)
    return np.where(solved.errors[:, None] < MET, solved.angles, loaded.stance_joints)
