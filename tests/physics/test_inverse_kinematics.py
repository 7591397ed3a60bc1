"""Inverse kinematics in closed form: exact where it can be, finite everywhere else; by steps: exact at the end."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.robot.constants import robot_from_model
from mjx_climb.robot_import.load import load_robot
from tests.physics.test_shapes import mjcf

ROBOT = load_robot("hubrobo_v3_2")
GEOMETRY = limb_geometry(ROBOT)
solve = jax.jit(jax.vmap(inverse_kinematics, in_axes=(None, 0)))


def feet_of(joint_angles):
    """Return the feet (..., limb, 3) in the base frame."""
    return limb_frames(ROBOT, None, joint_angles).foot


@pytest.fixture(scope="module")
def postures():
    """Ten thousand postures within the joint limits whose feet are ahead of the coxa's axis, and the feet."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(ROBOT.joint_lower.T[..., None], ROBOT.joint_upper.T[..., None], (3, 4, 5000)).T
    feet = feet_of(angles)
    local = np.vecmat(feet - GEOMETRY.hip_position, GEOMETRY.hip_rotation)
    turned = np.cos(angles[..., 0]) * local[..., 0] + np.sin(angles[..., 0]) * local[..., 1]  # outward in limb's plane
    ahead = (turned > 1e-3).all(1)
    return angles[ahead][:2500], feet[ahead][:2500]


def test_ten_thousand_targets_are_met(postures):
    """Every foothold that the joints can reach is met to 1e-9 m, by the posture that had reached it."""
    angles, feet = postures
    assert feet[..., 0].size == 10_000
    solution = solve(GEOMETRY, feet)
    assert solution.reachable.all()
    assert np.abs(feet_of(solution.joint_angles) - feet).max() < 1e-9
    # a limb's foot is off its tibia's axis by 8 mrad, so the joint's last 8 mrad bend the knee the other way
    bent = angles[..., 2] < -0.02
    assert np.abs(solution.joint_angles - angles)[bent].max() < 1e-6


def test_numpy_and_jax_are_one(postures):
    """On the host the same functions take NumPy's arrays, with any leading axes, and return NumPy's."""
    angles, feet = postures
    by_numpy = inverse_kinematics(GEOMETRY, feet)
    assert isinstance(by_numpy.joint_angles, np.ndarray) and isinstance(feet, np.ndarray)
    np.testing.assert_allclose(by_numpy.joint_angles, solve(GEOMETRY, feet).joint_angles, atol=1e-12)
    np.testing.assert_allclose(feet, jax.vmap(feet_of)(jnp.asarray(angles)), atol=1e-15)


def test_derivative_is_the_inverse_of_the_forward_one(postures):
    """Following a moving foothold, the joint rates move the foot as the foothold moves."""
    _, feet = postures
    motion = np.random.default_rng(1).normal(size=feet.T.shape).T
    angles, rates = jax.jvp(lambda f: solve(GEOMETRY, f).joint_angles, (feet,), (motion,))
    followed = jax.jvp(feet_of, (angles,), (rates,))[1]
    calm = np.linalg.norm(rates, axis=-1) < 1e3  # near the stretched limb the joint rates have no bound
    assert calm.mean() > 0.99
    assert np.abs(followed - motion)[calm].max() < 1e-8


def plane_target(out, up, geometry=GEOMETRY):
    """Return the target (limb, 3) at a place in the limbs' own planes, from the femur joint."""
    local = np.stack([geometry.femur_out + out, geometry.lateral, geometry.femur_up + up], axis=-1)
    return geometry.hip_position + np.matvec(geometry.hip_rotation, local)


REACH = float((GEOMETRY.femur_length + GEOMETRY.tibia_length).min())
FOLD = float(np.abs(GEOMETRY.femur_length - GEOMETRY.tibia_length).max())
BELOW_AXIS = GEOMETRY.hip_position - [0, 0, 0.1]
EQUAL_LINKS = GEOMETRY._replace(tibia_length=GEOMETRY.femur_length)
HARD = {  # target, geometry, whether no posture puts the foot there
    "a mile away": (plane_target(1609.0, 10.0), GEOMETRY, True),
    "a hair too far": (plane_target(REACH * (1 + 1e-9), 0.0), GEOMETRY, True),
    "stretched": (plane_target(REACH, 0.0), GEOMETRY, False),
    "too near": (plane_target(FOLD / 2, 0.0), GEOMETRY, True),
    "folded": (plane_target(FOLD, 0.0), GEOMETRY, False),
    "at the femur joint": (plane_target(0.0, 0.0), GEOMETRY, True),
    "folded, links of one length": (plane_target(0.0, 0.0, EQUAL_LINKS), EQUAL_LINKS, False),
    "at the hip": (GEOMETRY.hip_position, GEOMETRY, False),
    "below the hip": (BELOW_AXIS, GEOMETRY, True),
    "within the lateral offset": (BELOW_AXIS + np.array([2e-4, 0, 0]), GEOMETRY, False),
    "at the base": (np.zeros((4, 3)), GEOMETRY, False),
}


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", HARD)
def test_no_target_gives_nan(name, dtype):
    """Out of reach, on the axes, stretched or folded: value and derivative in every direction are finite."""
    target, geometry, missed = HARD[name]
    geometry, target = jax.tree.map(lambda a: jnp.asarray(a, dtype), (geometry, target))
    angles = jax.jit(lambda foot: inverse_kinematics(geometry, foot).joint_angles)
    assert angles(target).dtype == dtype
    assert np.isfinite(angles(target)).all()
    assert np.isfinite(jax.jacfwd(angles)(target)).all()
    assert np.isfinite(jax.grad(lambda foot: angles(foot).sum())(target)).all()
    if missed and dtype == np.float64:
        solution = inverse_kinematics(geometry, target)
        assert not solution.reachable.any()
        assert (np.linalg.norm(feet_of(solution.joint_angles) - target, axis=-1) > 1e-12).all()


def test_out_of_reach_points_at_the_target():
    """A target too far away gives the limb stretched straight towards it."""
    target, femur_joint = plane_target(3 * REACH, -REACH), plane_target(0.0, 0.0)
    arm, wish = feet_of(inverse_kinematics(GEOMETRY, target).joint_angles) - femur_joint, target - femur_joint
    length = np.linalg.norm(arm, axis=-1)
    np.testing.assert_allclose(length, GEOMETRY.femur_length + GEOMETRY.tibia_length, rtol=1e-9)
    np.testing.assert_allclose(np.vecdot(arm, wish), length * np.linalg.norm(wish, axis=-1))


def test_targets_at_random_never_claim_what_they_miss():
    """Wherever a target lies, the flag is up exactly where the foot meets it, and nothing is NaN."""
    targets = np.random.default_rng(2).uniform(-0.4, 0.4, (20_000, 4, 3))
    solution = solve(GEOMETRY, targets)
    miss = np.linalg.norm(feet_of(np.asarray(solution.joint_angles)) - targets, axis=-1)
    assert np.isfinite(miss).all()
    assert 0.1 < solution.reachable.mean() < 0.9
    assert miss[solution.reachable].max() < 1e-9
    assert miss[~solution.reachable].min() > 1e-9


@pytest.mark.parametrize("joints", [4, 5])
def test_the_last_steps_go_to_the_target_alone(joints):
    """A limb to spare, its foot on the target, far from its rest posture: it moves there, and its foot does not."""
    robot = robot_from_model(mujoco.MjModel.from_xml_string(mjcf(2, joints)), "random")
    angles = np.random.default_rng(3).uniform(0.3, 1.0, (2, joints))
    feet = limb_frames(robot, None, angles).foot
    solution = inverse_kinematics(Chain(robot), feet, angles)
    assert solution.reachable.all() and np.abs(solution.joint_angles - angles).max(-1).min() > 1e-3
    np.testing.assert_allclose(limb_frames(robot, None, solution.joint_angles).foot, feet, atol=1e-12)
