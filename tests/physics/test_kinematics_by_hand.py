"""Rotations, link frames and steps of inverse kinematics, against SciPy's rotations and loops over limbs and joints."""

import dataclasses
import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mjx_climb.physics import noise, spatial
from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry, solve_to_convergence
from mjx_climb.physics.kinematics import (
    Feet,
    Surface,
    base_wrench_of_foot_force,
    center_of_mass,
    foot_jacobian,
    foot_kinematics,
    foot_turning,
    ground_normal,
    joint_axes,
    limb_frames,
    turn_between,
)
from mjx_climb.physics.postures import least_singular_values, limb_joints, moving_joints
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import robot_from_model
from mjx_climb.robot_import.load import load_robot
from tests.physics.test_shapes import mjcf

HUBROBO = load_robot("hubrobo_v3_2")


def made(limbs, joints, slides=(), passive=()):
    """A robot at random, limits about its rest posture, which is none of zeros."""
    robot = robot_from_model(mujoco.MjModel.from_xml_string(mjcf(limbs, joints, slides)), "random")
    rng = np.random.default_rng(1)
    middle, half = rng.normal(0, 0.2, (2, limbs, joints)) + np.array([[[0.0]], [[1.5]]])
    stance = middle + 0.3 * half * rng.uniform(-1, 1, half.shape)
    driven = tuple(tuple(joint in passive for joint in range(joints)) for _ in range(limbs)) if passive else ()
    return dataclasses.replace(
        robot, joint_lower=middle - half, joint_upper=middle + half, stance_joints=stance, passive=driven
    )


def forward(robot, limb, angles):
    """The foot's place, the last link's attitude, and place and axis of each joint, by one matrix after the other."""
    whole, places, axes = np.eye(4), [], []
    for joint, angle in enumerate(angles):
        slides = bool(robot.slides) and robot.slides[limb][joint]
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = robot.frame_rotation[limb, joint], robot.frame_position[limb, joint]
        move = np.eye(4)
        if slides:
            move[2, 3] = angle
        else:
            move[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
        whole = whole @ frame @ move
        places.append(whole[:3, 3])
        axes.append(whole[:3, 2])
    return (whole @ [*robot.foot_center[limb], 1.0])[:3], whole[:3, :3], places, axes


def jacobian(robot, limb, angles):
    """Rows of the foot's place and of its turn, by joint."""
    foot, _, places, axes = forward(robot, limb, angles)
    columns = []
    for joint, (place, axis) in enumerate(zip(places, axes, strict=True)):
        slides = bool(robot.slides) and robot.slides[limb][joint]
        columns.append(np.concatenate([axis, 0 * axis] if slides else [np.cross(axis, foot - place), axis]))
    return np.array(columns).T


ROBOTS = {"three": (4, 3, (), ()), "slides": (3, 4, (2,), ()), "five": (2, 5, (), (1,)), "six": (2, 6, (), ()),
          "two": (3, 2, (), ())}  # fmt: skip


@pytest.mark.parametrize("name", ROBOTS)
def test_frames_axes_and_jacobians_are_those_of_matrices_one_after_the_other(name):
    """Over leading axes too, and in world axes where the base is turned."""
    robot, rng = made(*ROBOTS[name]), np.random.default_rng(2)
    angles = rng.normal(0, 0.7, (2, *robot.stance_joints.shape))
    turn = Rotation.random(random_state=0).as_matrix()
    frames, turned = limb_frames(robot, None, angles), limb_frames(robot, turn, angles)
    columns, axes = foot_jacobian(robot, frames), joint_axes(robot, frames)
    for n, limb in itertools.product(range(2), range(len(robot.limbs))):
        foot, last, places, _ = forward(robot, limb, angles[n, limb])
        whole = jacobian(robot, limb, angles[n, limb])
        np.testing.assert_allclose(frames.foot[n, limb], foot, atol=1e-12)
        np.testing.assert_allclose(frames.rotation[n, limb, -1], last, atol=1e-12)
        np.testing.assert_allclose(frames.position[n, limb], places, atol=1e-12)
        np.testing.assert_allclose(turned.foot[n, limb], turn @ foot, atol=1e-12)
        np.testing.assert_allclose(turned.rotation[n, limb, -1], turn @ last, atol=1e-12)
        np.testing.assert_allclose(columns[n, limb], whole[:3], atol=1e-12)
        np.testing.assert_allclose(axes.angular[n, limb].T, whole[3:], atol=1e-12)


@pytest.mark.parametrize("name", [pytest.param("three", marks=pytest.mark.slow), "slides"])
def test_feet_of_a_moving_robot_are_where_its_velocities_take_them(name):
    """Places, velocities and attitudes by the motion of a millionth of a second; the centre of mass with a cargo."""
    robot, rng = made(*ROBOTS[name]), np.random.default_rng(3)
    shape, step = robot.stance_joints.shape, 1e-6
    position, velocity, spin = rng.normal(size=(3, 3))
    turn, angles, rates = Rotation.random(random_state=4), rng.normal(0, 0.5, shape), rng.normal(size=shape)
    quaternion = turn.as_quat(scalar_first=True)
    state = State(position, jnp.asarray(quaternion), velocity, spin, angles, rates)
    frames = limb_frames(robot, None, angles)
    feet, turning = foot_kinematics(robot, frames, state), foot_turning(robot, frames, state)

    def at(time):
        base = Rotation.from_rotvec(time * spin) * turn
        each = [forward(robot, limb, angles[limb] + time * rates[limb]) for limb in range(shape[0])]
        places = [position + time * velocity + base.apply(foot) for foot, *_ in each]
        return np.array(places), np.array([base.as_matrix() @ last for _, last, *_ in each])

    (here, attitudes), (later, after) = at(0.0), at(step)
    np.testing.assert_allclose(feet.position, here, atol=1e-12)
    np.testing.assert_allclose(feet.lever, here - position, atol=1e-12)
    np.testing.assert_allclose(feet.velocity, (later - here) / step, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(turning.rotation, attitudes, atol=1e-12)
    spins = (Rotation.from_matrix(after) * Rotation.from_matrix(attitudes).inv()).as_rotvec() / step
    np.testing.assert_allclose(turning.velocity, spins, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.matvec(turning.jacobian, rates) + spin, turning.velocity, rtol=1e-9)
    total, moment = float(robot.base_mass) + 0.7, (float(robot.base_mass) + 0.7) * position
    for limb in range(shape[0]):
        for joint in range(shape[1]):
            link = limb_frames(robot, None, angles).rotation[limb, joint] @ robot.link_center[limb, joint]
            mass = robot.link_mass[limb, joint]
            total, moment = total + mass, moment + mass * (position + turn.apply(frames.position[limb, joint] + link))
    # the cargo is at the base's centre of mass
    np.testing.assert_allclose(center_of_mass(robot, frames, state, jnp.asarray(0.7)), moment / total, rtol=1e-9)
    force, own = rng.normal(size=(2, *feet.position.shape))
    wrench = base_wrench_of_foot_force(feet.lever, force, own)
    arms = sum(np.cross(here[n] - position, force[n]) + own[n] for n in range(shape[0]))
    np.testing.assert_allclose(wrench, [*force.sum(0), *arms], rtol=1e-9)
    np.testing.assert_array_equal(ground_normal(feet), np.tile([0, 0, 1.0], (shape[0], 1)))
    normal = rng.normal(size=force.shape)
    held = Feet(feet.position, feet.velocity, feet.lever, Surface(feet.position, jnp.asarray(normal)))
    np.testing.assert_array_equal(ground_normal(held), normal)


# --- inverse kinematics of limbs without a closed form


def errors(robot, limb, target, angles, attitude):
    """The rows to be brought to zero, and their slopes by the driven joints."""
    foot, last, *_ = forward(robot, limb, angles)
    slopes, error = jacobian(robot, limb, angles), target - foot
    if attitude is None:
        slopes = slopes[:3]
    else:
        links = [np.linalg.norm(robot.frame_position[limb, n]) for n in range(1, robot.joints)]
        length = (np.linalg.norm(robot.foot_center[limb]) + sum(links)) / robot.joints
        turn = sum(np.cross(last[:, n], attitude[:, n]) for n in range(3)) / 2
        error, slopes = np.concatenate([error, length * turn]), slopes * np.repeat([1.0, length], 3)[:, None]
    if robot.passive:
        slopes = np.where(robot.passive[limb], 0.0, slopes)
    return error, slopes


def changed(robot, limb, target, angles, attitude, damping, pull, longest=0.3):
    """A step of damped least squares with what moves no foot, by the normal equations of NumPy."""
    error, slopes = errors(robot, limb, target, angles, attitude)
    least = max(1e-10, 8 * np.finfo(float).eps) / robot.joints
    damped = damping * error @ error + least * (slopes**2).sum()
    spare = pull is not None and robot.joints > len(error)
    if spare:
        error = error - slopes @ pull
    if robot.joints < len(error):
        step = np.linalg.solve(slopes.T @ slopes + damped * np.eye(robot.joints), slopes.T @ error)
    else:
        step = slopes.T @ np.linalg.solve(slopes @ slopes.T + damped * np.eye(len(error)), error)
    step = step + pull if spare else step
    return step * min(1.0, longest / max(np.abs(step).max(), 1e-300))


def to_rest(robot, limb, angles):
    """Weights of the joints by how near to their limits they are, and their ways to the rest posture."""
    low, high = robot.joint_lower[limb], robot.joint_upper[limb]
    share = (angles - (low + high) / 2) / ((high - low) / 2)
    way = robot.stance_joints[limb] - angles
    return 1 + np.clip(share**8, 0, 8), np.where(robot.passive[limb], 0.0, way) if robot.passive else way


CHAINS = {name: each for name, each in ROBOTS.items() if name != "three"} | {"seven": (2, 7, (3,), (2,))}


@pytest.mark.parametrize("name", CHAINS)
def test_steps_towards_a_target_are_those_of_the_normal_equations(name):
    """From near and far, beyond limits, out of reach; six joints and more keep an attitude, turned with the base."""
    robot, rng = made(*CHAINS[name]), np.random.default_rng(5)
    geometry = limb_geometry(robot, turned=True)
    driven = robot.joints - len(CHAINS[name][3])
    assert isinstance(geometry, Chain) and (geometry.attitude is not None) == (driven >= 6)
    turn = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    met = 0
    for spread in (0.0, 0.02, 0.3, 2.0):
        last = robot.stance_joints + rng.normal(0, max(spread, 0.01), robot.stance_joints.shape)
        goal = last + rng.normal(0, spread, last.shape)
        target = limb_frames(robot, None, goal).foot
        found = inverse_kinematics(geometry, target, last, turn)
        for limb in range(len(robot.limbs)):
            attitude = None
            if geometry.attitude is not None:
                attitude = turn @ forward(robot, limb, robot.stance_joints[limb])[1]
            angles = last[limb]
            for step in range(4):
                weight, way = to_rest(robot, limb, angles)
                pull = 0.05 * weight * way if step < 2 else None
                angles = angles + changed(robot, limb, target[limb], angles, attitude, 0.5, pull)
            np.testing.assert_allclose(found.joint_angles[limb], angles, rtol=1e-6, atol=1e-7)
            error, _ = errors(robot, limb, target[limb], angles, attitude)
            assert found.reachable[limb] == (np.linalg.norm(error) < 1e-4)
            met += found.reachable[limb]
    assert 0 < met < 4 * len(robot.limbs) or geometry.attitude is not None
    own = inverse_kinematics(geometry, target)
    again = inverse_kinematics(geometry, target, robot.stance_joints)
    np.testing.assert_array_equal(own.joint_angles, again.joint_angles)


@pytest.mark.parametrize("pull", [True, False])
def test_as_many_steps_as_it_takes_end_at_the_target(pull):
    """Spare joints go as near to the rest posture as they may, or stay where the steps leave them."""
    robot = made(2, 5)
    goal = robot.stance_joints + np.random.default_rng(6).normal(0, 0.2, robot.stance_joints.shape)
    target, start = limb_frames(robot, None, goal).foot, robot.stance_joints + 0.3
    found, missed = solve_to_convergence(Chain(robot), target, start, 100, pull, 0.2)
    assert missed.max() < 1e-9
    for limb in range(2):
        angles = start[limb]
        for _ in range(100):
            weight, way = to_rest(robot, limb, angles)
            rest = weight / weight.max() * way if pull else None
            step = changed(robot, limb, target[limb], angles, None, 0.0, rest, 0.2)
            angles = angles + step
        np.testing.assert_allclose(found[limb], angles, atol=1e-7)
    few, missed = solve_to_convergence(Chain(robot), target, start, 2, pull, 0.05)
    assert np.abs(few - start).max() <= 0.1 + 1e-12 and missed.min() > 1e-6
    np.testing.assert_allclose(missed, np.linalg.norm(target - limb_frames(robot, None, few).foot, axis=-1))


def test_a_foot_that_some_posture_within_the_limits_reaches_is_reached():
    """Also one at a limit of its joints, which few starts reach: the others end short, less bent."""
    robot, rng = HUBROBO, np.random.default_rng(11)
    low, high = robot.joint_lower, robot.joint_upper
    shares = np.clip(rng.uniform(-0.2, 1.2, (60, *low.shape)), 0.01, 0.99)
    for share in shares:
        goal = low + (high - low) * share
        found = limb_joints(robot, limb_frames(robot, None, goal).foot)
        assert found.errors.max() < 1e-6
        np.testing.assert_allclose(limb_frames(robot, None, found.angles).foot, limb_frames(robot, None, goal).foot,
                                   atol=1e-6)  # fmt: skip


def test_of_several_postures_the_one_whose_knee_is_nearest_the_middle():
    """Of a limb of three: all postures by least squares from many starts, those within the limits ranked by hand."""
    robot, rng = HUBROBO, np.random.default_rng(7)
    low, high = robot.joint_lower, robot.joint_upper
    goal = low + (high - low) * rng.uniform(0.3, 0.7, low.shape)
    feet = limb_frames(robot, None, goal).foot
    found = limb_joints(robot, feet)
    assert found.errors.max() < 1e-9
    near = limb_joints(robot, feet, goal)
    np.testing.assert_allclose(near.angles, goal, atol=1e-9)
    for limb in range(4):
        middle, half, best = (low[limb] + high[limb]) / 2, (high[limb] - low[limb]) / 2, {}
        for share in itertools.product([0.2, 0.8], repeat=3):
            end = least_squares(
                lambda q, n=limb: forward(robot, n, q)[0] - feet[n], low[limb] + np.array(share) * 2 * half
            )
            angles = (end.x + np.pi) % (2 * np.pi) - np.pi
            if end.cost < 1e-20 and (angles >= low[limb] - 1e-9).all() and (angles <= high[limb] + 1e-9).all():
                off = np.abs(angles - middle)
                best[tuple(angles.round(6))] = off[2] + 1e-3 * ((off / half) ** 2).mean()
        np.testing.assert_allclose(found.angles[limb], min(best, key=best.get), atol=1e-5)
    far = limb_joints(robot, feet * 10)
    assert np.isinf(far.errors).all() or far.errors.min() > 0.01
    both = limb_joints(robot, np.stack([feet, feet + 1e-3]), goal)
    np.testing.assert_allclose(both.angles[0], goal, atol=1e-9)
    assert both.errors.shape == (2, 4) and both.errors.max() < 1e-9


def test_the_least_singular_value_is_that_of_the_matrix_of_moving_joints():
    robot = HUBROBO
    angles = robot.stance_joints + np.random.default_rng(8).normal(0, 0.3, (3, 4, 3))
    assert moving_joints(robot).all()
    for turned in (False, True):
        found = least_singular_values(robot, angles, turned)
        for n, limb in itertools.product(range(3), range(4)):
            foot, _, places, _ = forward(robot, limb, angles[n, limb])
            reach = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise([*places, foot]))
            whole = jacobian(robot, limb, angles[n, limb])
            whole = np.vstack([whole[:3] / reach, whole[3:]]) if turned else whole[:3] / reach
            assert found[n, limb] == pytest.approx(np.linalg.svd(whole)[1][-1])


# --- rotations


def test_quaternions_and_matrices_are_scipys():
    rng = np.random.default_rng(9)
    for _ in range(2):
        one, other = Rotation.random(random_state=rng), Rotation.random(random_state=rng)
        a, b = (each.as_quat(scalar_first=True) for each in (one, other))
        np.testing.assert_allclose(spatial.quaternion_to_matrix(a), one.as_matrix(), atol=1e-12)
        product = (one * other).as_quat(scalar_first=True)
        found = np.asarray(spatial.quaternion_multiply(jnp.asarray(a), jnp.asarray(b)))
        np.testing.assert_allclose(found * np.sign(found @ product), product, atol=1e-12)
        back = spatial.quaternion_multiply(jnp.asarray(a), spatial.quaternion_conjugate(jnp.asarray(a)))
        np.testing.assert_allclose(back, [1, 0, 0, 0], atol=1e-12)
        np.testing.assert_allclose(spatial.quaternion_normalize(jnp.asarray(3 * a)), a, atol=1e-12)
        angle = rng.uniform(-3, 3)
        turned = one.as_matrix() @ Rotation.from_euler("z", angle).as_matrix()
        np.testing.assert_allclose(spatial.turn_about_z(one.as_matrix(), np.asarray(angle)), turned, atol=1e-12)
        relative = (other * one.inv()).as_rotvec()
        size = np.linalg.norm(relative)
        between = turn_between(one.as_matrix(), other.as_matrix())
        np.testing.assert_allclose(between, relative / size * np.sin(size), atol=1e-12)
    # on both sides of where the series takes over, and at zero
    for size in (0.0, 1e-9, 9.9e-4, 1.01e-3, 0.3, 3.0):
        vector = size * np.array([0.6, -0.48, 0.64])
        found = spatial.quaternion_from_rotation_vector(jnp.asarray(vector))
        np.testing.assert_allclose(
            found, Rotation.from_rotvec(vector).as_quat(scalar_first=True), rtol=1e-14, atol=1e-16
        )


def test_vectors_and_symmetric_systems_are_numpys():
    rng = np.random.default_rng(10)
    vectors = np.vstack([rng.normal(size=(4, 3)), np.zeros(3)])
    np.testing.assert_allclose(spatial.norm(vectors, at_zero=1.0), [*np.linalg.norm(vectors[:4], axis=1), 1.0])
    assert spatial.norm(np.zeros(3)) == 0.0
    one, other = rng.normal(size=(2, 3))
    np.testing.assert_allclose(spatial.skew(jnp.asarray(one)) @ other, np.cross(one, other))
    for size in (1, 2, 3, 6):
        root = rng.normal(size=(2, size, size))
        matrix, right = root @ root.mT + np.eye(size), rng.normal(size=(2, size, 2))
        np.testing.assert_allclose(spatial.solve_symmetric(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
    np.testing.assert_allclose(
        spatial.inverse_3x3(matrix := root[0, :3, :3] @ root[0, :3, :3].T), np.linalg.inv(matrix), rtol=1e-6
    )
    skewed = np.arange(9.0).reshape(3, 3)
    lower = spatial.symmetric(skewed)
    np.testing.assert_array_equal(lower, np.tril(skewed) + np.tril(skewed, -1).T)


def test_noise_is_that_of_whole_numbers_of_python():
    """The hash of seed, sample and channel, and the sum of eight numbers of 16 bits."""
    mask = 2**32 - 1

    def mixed(word):
        word = (word ^ word >> 16) * 0x7FEB352D & mask
        word = (word ^ word >> 15) * 0x846CA68B & mask
        return word ^ word >> 16

    for seed, sample, channel in [(0, 0, 0), (7, 41, 3), (16_777_215, 8000, 2011), (1, 0, 1)]:
        word = mixed(mixed(mixed(seed + 0x9E3779B9 & mask) ^ sample) ^ (channel * 0x9E3779B9 & mask))
        total = 0
        for _ in range(4):
            word = mixed(word + 0x9E3779B9 & mask)
            total += (word >> 16) + (word & 0xFFFF)
        expected = (total - 4 * 65535) / np.sqrt(8 * (2.0**32 - 1) / 12)
        given = jnp.asarray(float(seed)), jnp.asarray(sample), jnp.asarray(channel)
        assert noise.normal(*given, jnp.float64) == pytest.approx(expected, rel=1e-12)
