"""Inverse kinematics: exact where it can be, finite everywhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.dynamics.kinematics import limb_frames
from mjx_climb.dynamics.spatial import rotate, rotate_back
from mjx_climb.robot.constants import load_robot
from mjx_climb.walk.inverse_kinematics import inverse_kinematics, limb_geometry

ROBOT = load_robot("hubrobo_v3_2")
GEOMETRY = limb_geometry(ROBOT)
solve = jax.jit(inverse_kinematics)


def feet_of(joint_angles):
    """Return the feet (3, L, B) in the base frame."""
    level = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, joint_angles.shape[-1]))
    return limb_frames(ROBOT, level, joint_angles).foot


@pytest.fixture(scope="module")
def postures():
    """10,000 postures within the joint limits whose feet are ahead of the coxa's axis, and the feet."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(ROBOT.joint_lower, ROBOT.joint_upper, (3, 4, 5000))
    feet = np.asarray(feet_of(angles))
    local = rotate_back(GEOMETRY.hip_rotation, feet - GEOMETRY.hip_position)
    turned = np.cos(angles[0]) * local[0] + np.sin(angles[0]) * local[1]  # outward in the plane of the limb
    ahead = (np.asarray(turned) > 1e-3).all(0)
    return angles[..., ahead][..., :2500], feet[..., ahead][..., :2500]


def test_ten_thousand_targets_are_met(postures):
    """Every foothold that the joints can reach is met to 1e-9 m, by the posture that had reached it."""
    angles, feet = postures
    assert feet[0].size == 10_000
    solution = solve(GEOMETRY, feet)
    assert solution.reachable.all()
    assert np.abs(feet_of(solution.joint_angles) - feet).max() < 1e-9
    # a limb's foot is off its tibia's axis by 8 mrad, so the joint's last 8 mrad bend the knee the other way
    bent = angles[2] < -0.02
    assert np.abs(solution.joint_angles - angles)[:, bent].max() < 1e-6


def test_derivative_is_the_inverse_of_the_forward_one(postures):
    """Following a moving foothold, the joint rates move the foot as the foothold moves."""
    _, feet = postures
    rng = np.random.default_rng(1)
    motion = rng.normal(size=feet.shape)
    angles, rates = jax.jvp(lambda f: solve(GEOMETRY, f).joint_angles, (feet,), (motion,))
    followed = jax.jvp(feet_of, (angles,), (rates,))[1]
    stretch = np.linalg.norm(rates, axis=0) < 1e3  # near the stretched limb the joint rates have no bound
    assert stretch.mean() > 0.99
    assert np.abs(followed - motion).max(0)[stretch].max() < 1e-8


def plane_target(out, up, geometry=GEOMETRY):
    """Return the target (3, L, 1) at a place in the limbs' own planes, from the femur joint."""
    zero = np.zeros_like(geometry.lateral)
    local = np.stack([geometry.femur_out + out + zero, geometry.lateral + zero, geometry.femur_up + up + zero])
    return np.asarray(geometry.hip_position + rotate(geometry.hip_rotation, local))


REACH = float((GEOMETRY.femur_length + GEOMETRY.tibia_length).min())
FOLD = float(np.abs(GEOMETRY.femur_length - GEOMETRY.tibia_length).max())
ON_AXIS = np.broadcast_to(GEOMETRY.hip_position, (3, 4, 1)).copy()
BELOW_AXIS = ON_AXIS - np.array([0, 0, 0.1])[:, None, None]
EQUAL_LINKS = GEOMETRY._replace(tibia_length=GEOMETRY.femur_length)
HARD = {  # target, geometry
    "a mile away": (plane_target(1609.0, 10.0), GEOMETRY),
    "a hair too far": (plane_target(REACH * (1 + 1e-9), 0.0), GEOMETRY),
    "stretched": (plane_target(REACH, 0.0), GEOMETRY),
    "too near": (plane_target(FOLD / 2, 0.0), GEOMETRY),
    "folded": (plane_target(FOLD, 0.0), GEOMETRY),
    "at the femur joint": (plane_target(0.0, 0.0), GEOMETRY),
    "folded, links of one length": (plane_target(0.0, 0.0, EQUAL_LINKS), EQUAL_LINKS),
    "at the hip": (ON_AXIS, GEOMETRY),
    "below the hip": (BELOW_AXIS, GEOMETRY),
    "within the lateral offset": (BELOW_AXIS + np.array([2e-4, 0, 0])[:, None, None], GEOMETRY),
    "at the base": (np.zeros((3, 4, 1)), GEOMETRY),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", HARD)
def test_no_target_gives_nan(name, dtype):
    """Out of reach, on the axes, stretched or folded: value and derivative in every direction are finite."""
    target, geometry = jax.tree.map(lambda a: jnp.asarray(a, dtype), HARD[name])
    angles = lambda foot: solve(geometry, foot).joint_angles  # noqa: E731
    for axis in range(3):
        value, slope = jax.jvp(angles, (target,), (jnp.zeros_like(target).at[axis].set(1.0),))
        assert value.dtype == dtype
        assert np.isfinite(value).all() and np.isfinite(slope).all()
    gradient = jax.grad(lambda foot: angles(foot).sum())(target)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("name", ["a mile away", "a hair too far", "too near", "at the femur joint", "below the hip"])
def test_what_is_out_of_reach_is_flagged(name):
    """The flag is down where no posture puts the foot on the target."""
    target, geometry = HARD[name]
    solution = solve(geometry, target)
    assert not solution.reachable.any()
    assert (np.linalg.norm(feet_of(solution.joint_angles) - target, axis=0) > 1e-12).all()


def test_out_of_reach_points_at_the_target():
    """A target too far away gives the limb stretched straight towards it."""
    target = plane_target(3 * REACH, -REACH)
    solution = solve(GEOMETRY, target)
    femur_joint = plane_target(0.0, 0.0)
    arm, wish = np.asarray(feet_of(solution.joint_angles)) - femur_joint, target - femur_joint
    np.testing.assert_allclose(np.linalg.norm(arm, axis=0), GEOMETRY.femur_length + GEOMETRY.tibia_length, rtol=1e-9)
    np.testing.assert_allclose(np.sum(arm * wish, 0), np.linalg.norm(arm, axis=0) * np.linalg.norm(wish, axis=0))


def test_targets_at_random_never_claim_what_they_miss():
    """Wherever a target lies, the flag is up exactly where the foot meets it, and nothing is NaN."""
    targets = np.random.default_rng(2).uniform(-0.4, 0.4, (3, 4, 20_000))
    solution = solve(GEOMETRY, targets)
    miss = np.linalg.norm(feet_of(solution.joint_angles) - targets, axis=0)
    assert np.isfinite(miss).all()
    assert 0.1 < solution.reachable.mean() < 0.9
    assert miss[solution.reachable].max() < 1e-9
    assert miss[~solution.reachable].min() > 1e-9
