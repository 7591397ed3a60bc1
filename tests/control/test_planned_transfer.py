"""Laws without a force sensor, and what each law reads: by its program, and by changing what is measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import SHIPPED, LoadTransfer, PlannedTransfer, Start, phased, shipped
from mjx_climb.control.foot_offsets import FootOffsets
from mjx_climb.control.law import SENSORS, beginning
from mjx_climb.control.planned_transfer import base_by_joints
from mjx_climb.physics.spatial import quaternion_to_matrix

STEP, WEIGHT = 5e-3, np.array([1.0, 0.5, -20.0])
FEET = np.array([[0.2, 0.1, 0.0], [-0.2, 0.15, 0.01], [-0.2, -0.1, 0.0], [0.2, -0.1, -0.02]])
UP = np.array([1.0, 0.0, 0.0, 0.0])


def reference(until=(9.0, 0.05, 9.0, 9.0), since=(9.0, 9.0, 0.04, 9.0), turned=0.3):
    yaw = np.array([np.cos(turned / 2), 0.0, 0.0, np.sin(turned / 2)])
    times = np.array(until), np.array(since)
    return jax.tree.map(jnp.asarray, mc.Reference(np.array([0.01, 0.0, 0.12]), yaw, FEET, *times))


def measurement(seed=0, support=(True,) * 4):
    random = np.random.default_rng(seed)
    base = np.array([0.012, 0.001, 0.115]), UP, *random.normal(size=(2, 3))
    forces, wrench, joints = random.normal(size=(4, 3)), random.normal(size=6), random.normal(size=(3, 4, 3))
    lever = FEET - base[0] + 1e-3 * random.normal(size=(4, 3))
    return jax.tree.map(jnp.asarray, mc.Measurement(*base, forces, wrench, np.array(support), *joints, True, lever))


def start(now):
    return Start(STEP, now, jnp.zeros((4, 3)), jnp.asarray(WEIGHT), 1e-3 * jnp.tile(jnp.eye(3), (4, 1, 1)))


def reads(law):
    return set(beginning(law, start(reference())).reads)


@pytest.mark.parametrize(
    ("name", "sensors"),
    [
        ("PD", set()), ("FootOffsets", set()), ("FootOffsets@outward,upward", set()),
        ("PlannedTransfer", {"joint angles"}), ("PlannedTransfer+FootOffsets@upward", {"joint angles"}),
        ("LoadTransfer", {"forces", "base pose"}), ("VirtualModelAdmittance", {"forces"}),
        ("PlannedTransfer+VirtualModelAdmittance", {"forces", "joint angles"}),
        ("MeasuredPoseAdmittance", {"forces", "base pose"}),
    ],
)  # fmt: skip
def test_a_law_reads_by_its_program(name, sensors):
    assert reads(shipped(name)) == sensors


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "ClimbSDK")) for name in sorted(SHIPPED)]
)
def test_other_readings_leave_a_command_as_it_is(name):
    law, now = shipped(name), reference()
    for sensor in set(SENSORS) - reads(law):
        one, other = measurement(0), measurement(1)
        other = one._replace(**{field: getattr(other, field) for field in SENSORS[sensor]})
        for found, expected in zip(*(jax.tree.leaves(law.step(law.init(start(now)), each, now)) for each in (one, other)), strict=True):  # fmt: skip  # noqa: E501
            np.testing.assert_array_equal(found, expected, err_msg=sensor)


def test_the_base_is_where_the_joints_of_standing_feet_put_it():
    """A base moved by millimetres and milliradians; the foot in the air is anywhere."""
    now = reference()
    attitude = Rotation.from_quat(np.asarray(now.base_orientation), scalar_first=True)
    moved = np.array([2e-3, -1e-3, -4e-3])
    turned = attitude * Rotation.from_rotvec([2e-3, -3e-3, 1e-3])
    position = np.asarray(now.base_position) + attitude.apply(moved)
    lever = turned.inv().apply(FEET - position)
    lever[1] += 0.05
    measured = measurement(support=(True, False, True, True))._replace(foot_lever=jnp.asarray(lever))
    feet = (now.foot_position - now.base_position) @ quaternion_to_matrix(now.base_orientation)
    found = base_by_joints(measured, now, feet)
    np.testing.assert_allclose(found.base_position, position, atol=2e-6)  # of second order in the turn
    away = Rotation.from_quat(np.asarray(found.base_orientation), scalar_first=True).inv() * turned
    assert away.magnitude() < 2e-5


def test_planned_loads_are_those_of_a_robot_at_rest():
    """Load transfer that measures the weight, shared evenly, and the true base, commands the same."""
    now, gains = reference(), {"normal_damping": 80.0, "leak": 2.0, "landing": 0.8}
    law, other = PlannedTransfer(load=1.3, sinking=0.0, **gains), LoadTransfer(**gains)
    state, before = law.init(start(now)), other.init(start(now))
    rotation = np.asarray(quaternion_to_matrix(now.base_orientation))
    base = np.asarray(now.base_position)
    grasp = np.hstack([np.vstack([np.eye(3), np.cross(foot - base, np.eye(3)).T]) for foot in FEET])
    forces = (np.linalg.pinv(grasp) @ np.concatenate([-1.3 * WEIGHT, np.zeros(3)])).reshape(4, 3)
    known = measurement()._replace(foot_lever=jnp.asarray((FEET - base) @ rotation))
    sensed = known._replace(
        base_position=now.base_position, base_orientation=now.base_orientation, foot_force=jnp.asarray(forces)
    )
    for _ in range(20):
        state, command = law.step(state, known, now)
        before, expected = other.step(before, sensed, now)
    np.testing.assert_allclose(command.foot_position, expected.foot_position, atol=1e-9)
    assert np.abs(np.asarray(command.foot_position) - FEET).max() > 1e-4


def test_sag_of_the_joints_is_made_up_for():
    """With all feet standing for long, and no transfer, feet go down by load over stiffness."""
    now = reference((9.0,) * 4, (9.0,) * 4, turned=0.0)
    law = PlannedTransfer(gravity=1.0, sinking=0.0, normal_damping=1e9, tangential_damping=1e9, pull_limit=1e3)
    known = measurement()._replace(foot_lever=jnp.asarray(FEET - np.asarray(now.base_position)))
    _, command = law.step(law.init(start(now)), known, now)
    sag = np.asarray(command.foot_position) - FEET
    np.testing.assert_allclose(sag.sum(0), 1e-3 * WEIGHT, rtol=1e-6)


def test_feet_are_held_away_from_the_base_and_up_by_phase():
    law, now = phased(FootOffsets(outward=1e-3, upward=-2e-3), ["outward", "upward"]), reference(turned=0.0)
    _, command = law.step(law.init(start(now)), measurement(), now)
    moved = np.asarray(command.foot_position) - FEET
    flat = (FEET - np.asarray(now.base_position))[:, :2]
    np.testing.assert_allclose(moved[:, :2], 1e-3 * flat / np.linalg.norm(flat, axis=1, keepdims=True), rtol=1e-5)
    np.testing.assert_allclose(moved[:, 2], -2e-3, rtol=1e-6)
    assert set(law.GAINS) >= {"upward_in_swing", "outward_standing"}


def test_feet_lead_on_their_way_seen_from_the_base():
    """The base moves by 8 mm/s, foot 1 by 30 mm/s upward in the base's turned axes: friction holds back all joints."""
    before, law = reference(), FootOffsets(onward=7e-4)
    period, attitude = float(start(before).period), Rotation.from_quat(before.base_orientation, scalar_first=True)
    of_base, of_feet = np.array([8e-3, 0.0, 0.0]), np.zeros((4, 3))
    of_feet[1] = of_base + attitude.apply([0.0, 0.0, 0.03])
    now = before._replace(
        base_position=before.base_position + of_base * period, foot_position=before.foot_position + of_feet * period
    )
    state, resting = law.step(law.init(start(before)), measurement(), before)
    state, command = law.step(state, measurement(), now)
    np.testing.assert_allclose(resting.foot_position, FEET, atol=1e-12)
    way = of_feet - of_base
    length = np.sqrt((way**2).sum(1, keepdims=True) + 0.002**2)
    np.testing.assert_allclose(command.foot_position - now.foot_position, 7e-4 * way / length, atol=2e-8)
    _, rests = law.step(state, measurement(), now)
    np.testing.assert_allclose(rests.foot_position, now.foot_position, atol=1e-9)


def test_loaded_feet_are_as_far_within_the_ground_as_they_sink():
    """Feet that sink by a way for their planned force are feet that do not, seen so much higher from the base."""
    now = reference((9.0,) * 4, (9.0,) * 4, turned=0.0)
    lever = FEET - np.asarray(now.base_position)
    grasp = np.hstack([np.vstack([np.eye(3), np.cross(each, np.eye(3)).T]) for each in lever])
    forces = (np.linalg.pinv(grasp) @ np.concatenate([-WEIGHT, np.zeros(3)])).reshape(4, 3)
    gains = {"normal_damping": 80.0, "leak": 2.0, "landing": 0.8}

    def commanded(sinking, lever):
        law = PlannedTransfer(sinking=sinking, **gains)
        known, state = measurement()._replace(foot_lever=jnp.asarray(lever)), law.init(start(now))
        return np.asarray(law.step(state, known, now)[1].foot_position)

    sunk, higher, neither = (commanded(*each) for each in ((1e-4, lever), (0.0, lever + 1e-4 * forces), (0.0, lever)))
    moved = np.abs(higher - neither).max()
    assert moved > 0 and np.abs(sunk - higher).max() < 0.05 * moved
