"""The time step that contacts and joints can follow: of joints that move alone, of a base on its contacts, in words."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.base_path import planned_feet
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.hardware.servo import Servos
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step, growth, largest_time_step, short_enough
from mjx_climb.physics.inverse_kinematics import limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot
from tests.robot import climbers

ARMATURE = 0.5  # kg m^2, beside which links weigh nothing: each joint moves alone
SOFT = {"contact.stiffness": 1.0, "contact.damping": 1e-3, "hardware.servo.armature": ARMATURE}
LONGER = 1.01  # time steps, by which a walk may ring beyond its planned postures


def scenario(**changes):
    return mc.load_scenario("case_1_1").with_overrides(SOFT | changes)


def critical(case, low=1e-5, high=10.0):
    """Return the longest time step that a scenario can follow, s."""
    assert growth(case, low) <= 1 + 1e-7 and growth(case, high) > 1 + 1e-7
    for _ in range(22):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if growth(case, middle) <= 1 + 1e-7 else (low, middle)
    return low


def alone(stiffness, damping):
    """Return the longest time step of a joint alone, s: the root of 4 m - 2 h d - h^2 k."""
    return (math.sqrt(damping**2 + 4 * ARMATURE * stiffness) - damping) / stiffness / LONGER


VOLTAGE = {"hardware.servo.drive": "voltage", "hardware.servo.torque_limit": 4.0, "hardware.servo.no_load_speed": 2.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"control.kp": 50.0, "control.kd": 0.0}, alone(50.0, 0.0)),
        ({"control.kp": 50.0, "control.kd": 5.0}, alone(50.0, 5.0)),
        ({"control.kp": 50.0, "control.kd": 0.0, "hardware.servo.viscous_friction": 3.0}, alone(50.0, 3.0)),
        ({"control.kp": 50.0, "control.kd": 1.0, **VOLTAGE}, alone(50.0, 1.0 + 4.0 / 2.0)),
        ({"control.kp": 50.0, "control.kd": 1.0, **VOLTAGE, "hardware.servo.rated_voltage": 10.0,
          "hardware.servo.supply_voltage": 12.0}, alone(60.0, 1.2 + 2.0 * 1.0)),
        ({"control.kp": 50.0, "control.kd": 0.0, "hardware.servo.coulomb_friction": 0.2}, alone(50.0, 0.0)),
    ],
)  # fmt: skip
def test_a_heavy_joint_alone_follows_the_step_of_its_own_equation(changes, expected):
    assert critical(scenario(**changes)) == pytest.approx(expected, rel=0.02)


RIGID = {"hardware.servo.armature": 1e4, "control.kp": 1.0, "control.kd": 1e-3}


@pytest.mark.parametrize(
    ("springs", "power"),
    [
        ({"contact.stiffness": 4e4, "contact.damping": 1e-3}, 0.5),
        ({"contact.stiffness": 1.0, "contact.damping": 400.0}, 1.0),
        ({"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_stiffness": 400.0}, 0.5),
        ({"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_stiffness": 1e-3,
          "contact.rotational_damping": 9.0}, 1.0),
    ],
)  # fmt: skip
def test_a_base_on_stiff_feet_follows_a_step_by_the_root_of_the_stiffness_or_the_damping(springs, power):
    """Joints that hardly move: the base is a rigid body on its contacts, stiffer ones of which shorten the step."""
    name = max(springs, key=springs.__getitem__)
    once, four = (critical(scenario(**RIGID, **springs | {name: factor * springs[name]})) for factor in (1, 4))
    assert once / four == pytest.approx(4**power, rel=0.01)


def test_feet_that_tilt_with_their_damping_count_where_they_are_held_against_turning_alone():
    free = {"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_damping": 9.0}
    held = {"contact.rotational_stiffness": 1e-3}
    assert critical(scenario(**RIGID, **free)) > 5 * critical(scenario(**RIGID, **free, **held))


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({"duration": 0.3, "gait.cycle": 0.4}, 0.1),
        ({"duration": 0.3, "gait.cycle": 0.375}, 0.025),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.control_period": 0.004}, 0.002),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.servo.rate": 250.0}, 0.002),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.servo.rate": 250.0, "hardware.control_period": 0.025}, 0.001),
    ],
)
def test_the_largest_step_divides_all_that_is_counted_in_steps(changes, step):
    assert largest_time_step(scenario(**changes)) == step


def test_the_largest_step_is_short_enough_and_the_next_one_is_not():
    case = mc.load_scenario("case_1_1").with_overrides({"duration": 1.0, "gait.cycle": 1.0, "contact.stiffness": 3e5})
    step = largest_time_step(case)
    longest = critical(case, 1e-6, 0.1)
    assert step <= longest < 2.5 * step and short_enough(case.with_overrides({"time_step": step}))
    assert not short_enough(case.with_overrides({"time_step": 1e-3})) and growth(case) == growth(case, case.time_step)
    with pytest.raises(mc.ConfigError, match=r"expected contacts and joint gains that some step of 0.1 us or more"):
        largest_time_step(case.with_overrides({"contact.stiffness": 1e18}))


def test_a_refusal_names_what_holds_the_robot_and_the_step_that_would_do():
    case = mc.load_scenario("case_1_1").with_overrides({"contact.stiffness": 3e6, "control.kp": 40.0})
    check_time_step(mc.load_scenario("case_1_1"))
    with pytest.raises(mc.ConfigError) as refused:
        check_time_step(case, "mine.yaml")
    said = str(refused.value)
    assert said.startswith("mine.yaml: time_step: expected one short enough for ")
    assert "with contact.stiffness 3e+06, contact.damping" in said and "control.kp 40 and control.kd" in said
    assert f"{growth(case):.3g}-fold a step): {largest_time_step(case):g} would do" in said
    assert "back EMF" not in said and "stretched" not in said
    with pytest.raises(
        mc.ConfigError, match=r"contact.damping 20, a back EMF of 2 N m s/rad, control.kp 40 and contro"
    ):
        check_time_step(case.with_overrides(VOLTAGE))


def test_of_many_robots_the_one_that_cannot_follow_is_named():
    case = mc.load_scenario("case_1_1")
    stiffness = np.array([[1e4, 2e4, 3e4], [1e4, 4e6, 2e4]])
    own = own_parameters(case)
    check_time_step(case, parameters=own.replace({"contact.stiffness": np.minimum(stiffness, 5e4)}))
    with pytest.raises(mc.ConfigError, match=r"contact.stiffness 4e\+06, contact.damping 20, control.kp 50 and"):
        check_time_step(case, parameters=own.replace({"contact.stiffness": stiffness}))
    # the stiffest of each together would not, but no robot has both
    stiff = 1.5 * next(
        each for each in np.geomspace(1e4, 1e7, 60) if growth(case.with_overrides({"contact.stiffness": each})) > 1.001
    )
    apart = {"contact.stiffness": np.array([1e4, stiff]), "hardware.servo.armature": np.array([0.0, 0.05])}
    assert growth(case.with_overrides({"contact.stiffness": stiff})) > 1.001
    check_time_step(case, parameters=own.replace(apart))


def test_values_of_the_gait_that_all_robots_share_move_the_postures():
    case = mc.load_scenario("case_1_1").with_overrides({"contact.stiffness": 3e5})
    own = own_parameters(case)
    longer = growth(case, parameters=own.replace({"gait.stride": 0.1}))
    assert longer == growth(case.with_overrides({"gait.stride": 0.1})) != growth(case)
    apart = own.replace({"gait.stride": np.array([0.05, 0.1])})
    assert growth(case, parameters=apart) == growth(case)


# ------------------------------------------------------------------------------------------- a second implementation


class Sprung(mc.Actuator):
    """It holds joints as a spring with an inertia of its own."""

    def spring(self, period):
        return mc.JointSpring(40.0, 0.3, 0.02)

    def init(self, angles):
        return ()

    def step(self, memory, targets, gains, joints, period):
        raise AssertionError("nobody walks")


def one_step(mass, stiffness, damping, h):
    """Return the growth by a step of semi-implicit Euler, of all unit states side by side."""
    x, v = np.split(np.eye(2 * len(mass)), 2)
    v = v - h * np.linalg.solve(mass, stiffness @ x + damping @ v)
    return np.abs(np.linalg.eigvals(np.concatenate([x + h * v, v]))).max()


def by_hand(case, parameters, joint, stretched):
    """Return mass, stiffness and damping of each posture, spring by spring.

    `joint` has stiffness, damping and inertia of the loop, `stretched` whether limbs may be stretched too.
    """
    robot, gait, found = load_robot(case.robot), case.gait, []
    model, rotation = robot.model, quaternion_to_matrix(robot.stance_orientation)
    swing, moves, e = 1 - gait.duty, 1 - gait.settling, 1e-3
    postures = []
    for begin in gait.lift_off.values():
        for share in (-e, e, moves / 2, moves * (1 - e), 1 - e, 1 + e):
            feet, shares = planned_feet(robot, gait, np.array([round((begin + swing * share) % 1, 9) % 1]))
            postures.append((feet[0] @ rotation, [not 0 <= each <= 1 for each in shares[0]]))
    if stretched:
        rest = limb_frames(robot, None, robot.stance_joints).foot
        up = rotation[2]
        ways = [
            foot - hip - up * ((foot - hip) @ up) for foot, hip in zip(rest, robot.frame_position[:, 0], strict=True)
        ]
        shares = np.linspace(0, 3, 512)
        may = within_reach(robot, limb_geometry(robot), rest + np.multiply.outer(shares, ways))
        far = [rest[limb] + shares[may[:, limb]].max() * way for limb, way in enumerate(ways)]
        postures.append((np.array(far), [True] * len(far)))
    for feet, held in postures:
        solved = limb_joints(robot, feet, robot.stance_joints)
        angles = np.where(solved.errors[:, None] < 1e-9, solved.angles, robot.stance_joints)
        data = mujoco.MjData(model)
        data.qpos[:] = [*model.key_qpos[0][:7], *angles.ravel()]
        mujoco.mj_forward(model, data)
        mass, stiffness, damping = np.zeros((3, model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        for foot in np.flatnonzero(held):
            place, turn = np.zeros((2, 3, model.nv))
            mujoco.mj_jacSite(model, data, place, turn, foot)
            stiffness += parameters.at("contact.stiffness") * place.T @ place
            damping += parameters.at("contact.damping") * place.T @ place
            if parameters.at("contact.rotational_stiffness"):
                stiffness += parameters.at("contact.rotational_stiffness") * turn.T @ turn
                damping += parameters.at("contact.rotational_damping") * turn.T @ turn
        driven = np.ones(model.nv - 6) if robot.driven is None else robot.driven.ravel()
        for n in range(6, model.nv):
            own = np.array(joint) * driven[n - 6]
            stiffness[n, n] += own[0] + model.jnt_stiffness[n - 5]
            damping[n, n] += own[1] + model.dof_damping[n]
            mass[n, n] += own[2]
            if isinstance(parameters.drive, Servos):
                damping[n, n] += parameters.drive.viscous_friction
                mass[n, n] += parameters.drive.armature
        found.append((mass, stiffness, damping))
    return found


@pytest.mark.parametrize("seed", range(8))
def test_the_growth_is_that_of_each_spring_and_posture_in_turn(seed, tmp_path):
    """Of steps that are too long; with passive joints, grips against turning, and limbs that may be stretched."""
    draw = np.random.default_rng(seed)
    walked = {
        "duration": 1.0, "gait.cycle": 1.0, "gait.settling": draw.choice([0.0, 0.3, 0.6]), "gait.duty": 0.8,
        "gait.sway": draw.choice([0.0, 0.2]), "contact.stiffness": 10 ** draw.uniform(2, 4),
        "contact.damping": draw.uniform(1, 20), "control.kp": draw.uniform(10, 90), "control.kd": draw.uniform(0, 0.5),
        "hardware.servo.armature": draw.uniform(0, 0.01), "hardware.servo.viscous_friction": draw.uniform(0, 0.3),
    }  # fmt: skip
    if own := seed % 2:
        attributes = 'damping="0.06" armature="0.003" stiffness="0.7"'
        (tmp_path / "own.xml").write_text(climbers.mjcf(4, 4, attributes=attributes))
        springs = {f"L{n}_3": {"stiffness": 4.0, "rest": -0.4, "damping": 0.02} for n in range(4)}
        case = mc.Scenario.model_validate(climbers.config(tmp_path / "own.xml", 4, 4, springs=springs))
    else:
        case = mc.Scenario()
        turning = {"contact.rotational_stiffness": draw.uniform(1, 9), "contact.rotational_damping": 0.4}
        walked |= turning if seed % 4 else {}
    chosen = {2: {"gait.footholds": "nearest"}, 4: {"control.recovery.shift": 0.1}}.get(seed, {})
    walked |= chosen | ({"ground.holds": {"wall": {"pitch": 0.1}}} if seed in (2, 4, 6) else {})
    case = case.with_overrides({key: float(v) if isinstance(v, np.floating) else v for key, v in walked.items()})
    parameters = own_parameters(case)
    joint = (case.control.kp, case.control.kd, 0.0)
    if seed > 4:
        parameters, joint = dataclasses.replace(parameters, drive=Sprung()), (40.0, 0.3, 0.02)
    postures = by_hand(case, parameters, joint, bool(chosen))
    for time_step in (0.02, 0.2):
        found = growth(case, time_step, parameters)
        assert found == pytest.approx(max(one_step(*each, LONGER * time_step) for each in postures), rel=1e-7)
    assert found > 1.1
    assert own or load_robot(case.robot).driven is None
