"""From the coordinates of a fit to a robot, its file and a scenario: each number at its place."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.fit import robot_files
from tuning.identification.fit.result import turned
from tuning.identification.fit.stamps import Noise, change
from tuning.identification.model.variables import Variable, applied, begin, in_units, variables

SCENARIO = mc.Scenario()
OWN = own_parameters(SCENARIO)


def at(keys, off):
    """Return parameters and robot whose coordinates of some keys are off the nominal ones, and the values there."""
    chosen = variables(SCENARIO, keys, held=False)
    assert [v.key for v in chosen] == list(keys)
    with jax.enable_x64(True):
        point = jnp.asarray(begin(chosen) + np.asarray(off))
        parameters, robot = applied([v.place for v in chosen], point, OWN, ROBOT)
        values = in_units(chosen, point, ROBOT)
        return parameters, jax.tree.map(np.asarray, robot), np.asarray(values)


def test_numbers_of_a_link_go_to_their_limb_and_joint():
    keys = ("robot.LH.femur.mass", "robot.LH.femur.center.y", "robot.RF.coxa.armature", "robot.LF.tibia.zero",
            "robot.RH.coxa.damping")  # fmt: skip
    _, robot, values = at(keys, [math.log(1.2), 0.003, 0.01, 0.02, 0.4])
    mass = ROBOT.link_mass.copy()
    mass[1, 1] *= 1.2
    np.testing.assert_allclose(robot.link_mass, mass)
    center = ROBOT.link_center.copy()
    center[1, 1, 1] += 0.003
    np.testing.assert_allclose(robot.link_center, center, atol=1e-15)
    inertia = ROBOT.link_inertia.copy()
    inertia[1, 1] *= 1.2  # a mass alone scales the inertia with it
    np.testing.assert_allclose(robot.link_inertia, inertia, rtol=1e-6, atol=1e-15)
    expected = np.zeros((4, 3))
    expected[3, 0] = 0.01
    np.testing.assert_allclose(robot.armature, expected + (0 if ROBOT.armature is None else ROBOT.armature))
    turn = ROBOT.frame_rotation.copy()
    turn[0, 2] = turn[0, 2] @ Rotation.from_rotvec([0, 0, 0.02]).as_matrix()
    np.testing.assert_allclose(robot.frame_rotation, turn, atol=1e-12)
    np.testing.assert_allclose(values, [mass[1, 1], center[1, 1, 1], 0.01, 0.02, 0.4], rtol=1e-9)
    assert robot.damping[2, 0] == pytest.approx(0.4) and np.count_nonzero(robot.damping) == 1
    assert robot.base_mass == ROBOT.base_mass and robot.friction is None


def test_the_base_moves_its_hips_and_keeps_a_body_that_can_exist():
    keys = ("robot.base.mass", "robot.base.center.x", "robot.base.inertia.xx", "robot.base.inertia.xy")
    _, robot, values = at(keys, [math.log(1.5), 0.004, 0.2, 0.01])
    assert robot.base_mass == pytest.approx(1.5 * ROBOT.base_mass)
    np.testing.assert_allclose(robot.frame_position[:, 0], ROBOT.frame_position[:, 0] - [0.004, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(robot.frame_position[:, 1:], ROBOT.frame_position[:, 1:])
    moments = np.linalg.eigvalsh(robot.base_inertia)
    assert (moments > 0).all() and moments[2] < moments[0] + moments[1]
    np.testing.assert_allclose(values[2:], [robot.base_inertia[0, 0], robot.base_inertia[0, 1]])
    # along x the mass is spread by a factor, as far as no other axis says where it is
    plain = at(keys[:3], [0.0, 0.0, 0.2])[1].base_inertia
    before, after = (0.5 * np.trace(moment) * np.eye(3) - moment for moment in (ROBOT.base_inertia, plain))
    own = np.linalg.det(before) / np.linalg.det(before[1:, 1:])
    assert after[0, 0] == pytest.approx(before[0, 0] + own * (math.exp(0.4) - 1), rel=1e-6)


def test_values_of_the_scenario_and_a_tilt_go_to_the_parameters():
    keys = ("contact.stiffness", "hardware.servo.viscous_friction", "gravity.tilt_x", "gravity.tilt_y")
    parameters, _, values = at(keys, [math.log(2.0), 0.07, 0.1, -0.05])
    assert float(parameters.at("contact.stiffness")) == pytest.approx(2 * float(OWN.at("contact.stiffness")))
    np.testing.assert_allclose(values, [2 * float(OWN.at("contact.stiffness")), 0.07, 0.1, -0.05])
    assert float(parameters.at("hardware.servo.viscous_friction")) == pytest.approx(0.07)
    gravity = Rotation.from_rotvec([0.1, -0.05, 0.0]).as_matrix() @ np.asarray(SCENARIO.gravity)
    np.testing.assert_allclose(parameters.gravity, gravity, atol=1e-12)
    np.testing.assert_allclose(turned([0.1, -0.05]) @ SCENARIO.gravity, gravity, atol=1e-12)
    np.testing.assert_array_equal(turned([0.0, 0.0]), np.eye(3))
    alone, _, _ = at(("gravity.tilt_y",), [0.2])
    np.testing.assert_allclose(alone.gravity, turned([0.0, 0.2]) @ SCENARIO.gravity, atol=1e-12)


@pytest.mark.parametrize(
    ("key", "nominal", "bounds", "sd", "log"),
    [
        ("control.kp", 50.0, (0.05, 5e4), 1.0, True),
        ("hardware.servo.viscous_friction", 0.0, (0.0, math.inf), 0.2, False),
        ("hardware.command_delay", 0.0, (0.0, 0.02), 0.01, False),
        ("gravity.tilt_x", 0.0, (-1.0, 1.0), 0.1, False),
        ("log.LF.force.gain", 1.0, (0.1, 10.0), 0.2, False),
        ("log.LF.force.zero.x", 0.0, (-math.inf, math.inf), 2.0, False),
        ("log.LF.force.y_in_x", 0.0, (-1.0, 1.0), 0.05, False),
        ("robot.LF.femur.zero", 0.0, (-0.5, 0.5), 0.05, False),
        ("robot.LF.femur.friction", 0.0, (0.0, math.inf), 0.2, False),
    ],
)
def test_each_key_has_its_prior_and_its_bounds(key, nominal, bounds, sd, log):
    (found,) = variables(SCENARIO, [key], held=False)
    assert (found.nominal, found.sd, found.log) == (pytest.approx(nominal), pytest.approx(sd), log)
    assert (found.lower, found.upper) == pytest.approx(bounds)
    assert found.mean == pytest.approx(math.log(nominal) if log else nominal)
    assert found.limb == (0 if ".LF." in key else None)


@pytest.mark.parametrize(("own", "upper"), [(0.03, 0.06), (0.004, 0.02)])
def test_delays_reach_to_twice_their_value_or_twenty_milliseconds(own, upper):
    (found,) = variables(
        SCENARIO.with_overrides({"hardware.command_delay": own}), ["hardware.command_delay"], held=True
    )
    assert found.upper == pytest.approx(upper)


@pytest.mark.parametrize(
    ("x", "side"), [(-2.0, "lower"), (-2.0 + 2e-5, ""), (3.0, "upper"), (3.0 - 0.5e-6, "upper"), (0.0, "")]
)
def test_a_coordinate_is_on_a_bound_within_a_millionth_of_its_prior(x, side):
    assert Variable("a", "1", 0.0, 0.0, 1.0, -2.0, 3.0).bound_at(x) == side
    assert Variable("a", "1", 0.0, 0.0, 1.0, -math.inf, math.inf).bound_at(x) == ""


def test_changes_replace_fields_and_frozen_variables_are_left_out():
    keys = ["control.kp", "control.kd"]
    (kp,) = variables(SCENARIO, keys, held=True, changes={"control.kd": {"frozen": True}, "control.kp": {"sd": 0.3}})
    assert (kp.key, kp.sd) == ("control.kp", 0.3)
    with pytest.raises(mc.ConfigError, match=r"control.ki: expected one of the keys that are fitted, control.kp"):
        variables(SCENARIO, keys, held=True, changes={"control.ki": {"sd": 0.3}})


def test_a_robot_goes_to_its_file_and_back(tmp_path):
    rng = np.random.default_rng(0)
    turn = ROBOT.frame_rotation @ Rotation.from_rotvec(
        np.stack([np.zeros(12), np.zeros(12), rng.uniform(-0.05, 0.05, 12)], -1)
    ).as_matrix().reshape(4, 3, 3, 3)  # fmt: skip
    own = dataclasses.replace(
        ROBOT, link_mass=ROBOT.link_mass * rng.uniform(0.8, 1.2, (4, 3)), base_mass=ROBOT.base_mass * 1.3,
        link_center=ROBOT.link_center + rng.uniform(-2e-3, 2e-3, (4, 3, 3)), base_inertia=ROBOT.base_inertia * 1.1,
        link_inertia=ROBOT.link_inertia * rng.uniform(0.9, 1.1, (4, 3, 1, 1)), frame_rotation=turn,
        armature=rng.uniform(0.01, 0.02, (4, 3)), damping=rng.uniform(0.1, 0.2, (4, 3)),
        friction=rng.uniform(0.01, 0.02, (4, 3)),
        frame_position=ROBOT.frame_position - np.array([[0.003, -0.002, 0.001], np.zeros(3), np.zeros(3)]),
    )  # fmt: skip
    section = robot_files.write(SCENARIO.robot, own, tmp_path / "robot.xml")
    back = load_robot(RobotFile.model_validate(section))
    order = [back.limbs.index(limb) for limb in own.limbs]
    for field in ("link_mass", "armature", "damping", "friction"):
        np.testing.assert_allclose(getattr(back, field)[order], getattr(own, field), rtol=1e-5, err_msg=field)
    np.testing.assert_allclose(back.base_mass, own.base_mass, rtol=1e-5)
    np.testing.assert_allclose(back.base_inertia, own.base_inertia, rtol=1e-5, atol=1e-9)
    angles = ROBOT.stance_joints + rng.uniform(-0.3, 0.3, (4, 3))
    first, second = (limb_frames(robot, None, each) for robot, each in ((own, angles), (back, angles[order])))
    np.testing.assert_allclose(second.foot[order], first.foot, atol=1e-6)
    for found in (lambda f, r: f.position + np.matvec(f.rotation, r.link_center),
                  lambda f, r: 1e3 * f.rotation @ r.link_inertia @ f.rotation.mT):  # fmt: skip
        np.testing.assert_allclose(found(second, back)[order], found(first, own), atol=1e-6)


def test_noise_has_changed_by_its_largest_logarithm_or_that_of_the_clock():
    before = Noise(np.array([1.0, 2.0]), 0.0)
    assert change(before, Noise(np.array([1.1, 1.9]), 0.0)) == pytest.approx(math.log(1.1))
    assert change(before._replace(clock=0.004), Noise(before.signals, 0.003)) == pytest.approx(0.25)
    assert change(before, Noise(np.array([1.0, 1.0]), 0.003)) == pytest.approx(1.0)


def test_an_inertia_has_its_prior_by_the_triangle_of_its_second_moments():
    """Upper triangular, as its product with its transpose, from the last axis on."""
    chosen = variables(SCENARIO, ["robot.LF.tibia.inertia"], held=False)
    inertia, mass = ROBOT.link_inertia[0, 2], ROBOT.link_mass[0, 2]
    moment = (np.trace(inertia) / 2 * np.eye(3) - inertia) / mass
    c = math.sqrt(moment[2, 2])
    e, f = moment[1, 2] / c, moment[0, 2] / c
    b = math.sqrt(moment[1, 1] - e * e)
    d = (moment[0, 1] - e * f) / b
    a = math.sqrt(moment[0, 0] - d * d - f * f)
    means = dict(xx=math.log(a), yy=math.log(b), zz=math.log(c), xy=d, xz=f, yz=e)
    sds = dict(xx=0.3, yy=0.3, zz=0.3, xy=0.3 * a, xz=0.3 * a, yz=0.3 * b)
    found = {v.key.rpartition(".")[2]: v for v in chosen}
    assert {name: v.mean for name, v in found.items()} == pytest.approx(means, rel=1e-5, abs=1e-7)
    assert {name: v.sd for name, v in found.items()} == pytest.approx(sds, rel=1e-5)
