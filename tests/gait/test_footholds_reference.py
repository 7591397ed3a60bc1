"""The references of the choice of footholds give what a figure shows: cases with a known answer."""

import numpy as np
import pytest

from mjx_climb.physics.contact.polyhedron import magnet, microspines
from tests.gait import footholds_reference as reference

# LF, LH, RH, RF around the origin, and points ahead, on the spot and behind
FEET = np.array([[0.1, 0.1, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0]])
ROW = np.array([[x, 0.1, 0] for x in (0.05, 0.1, 0.14, 0.22, 0.3)])
AHEAD = np.array([1.0, 0, 0])


def all_of(points, limbs=4):
    return np.ones((limbs, len(points)), bool)


def test_nearest_farthest_and_climblab_on_a_row():
    """LF at 0.1 m: nearest to 0.15 is 0.14, farthest 0.3, and with a cap of 0.13 m the step to 0.22."""
    planned = FEET + 0.05 * AHEAD
    assert reference.nearest(ROW, all_of(ROW), planned)[0] == 2
    assert reference.farthest(ROW, all_of(ROW), FEET, AHEAD).tolist() == [4] * 4
    assert reference.farthest(ROW, all_of(ROW), FEET, -AHEAD).tolist() == [0] * 4
    assert reference.climblab(ROW, all_of(ROW), FEET, AHEAD, 0.13)[0] == 3
    # a cap is of the level way alone, and no point within it is no choice
    above = ROW + np.array([0, 0, 5.0])
    assert reference.climblab(above, all_of(ROW), FEET, AHEAD, 0.13)[0] == 3
    assert reference.climblab(ROW, all_of(ROW), FEET, AHEAD, 0.01).tolist() == [1, -1, -1, -1]


def test_only_what_is_allowed_and_the_first_of_equals():
    allowed = all_of(ROW)
    allowed[0, 2:] = False
    allowed[1] = False
    assert reference.farthest(ROW, allowed, FEET, AHEAD)[:3].tolist() == [1, reference.NONE, 4]
    twice = np.vstack([ROW, ROW])
    assert reference.farthest(twice, all_of(twice), FEET, AHEAD)[0] == 4


def test_the_limb_with_most_points_ahead():
    """Of points within 0.2 m ahead LF has three, LH none behind it; of equals the first limb swings."""
    assert reference.climblab_limb(ROW, all_of(ROW), FEET, AHEAD) == 0
    assert reference.climblab_limb(ROW, all_of(ROW), FEET, AHEAD, ahead=0.01) == 0
    beside = ROW * [1, -1, 1]
    assert reference.climblab_limb(beside, all_of(ROW), FEET, AHEAD) == 3


def test_lines_of_opposite_feet_meet():
    np.testing.assert_allclose(reference.diagonals(FEET + np.array([0.3, 0.2, 0.1])), [0.3, 0.2, 0.1], atol=1e-12)
    moved = FEET + np.eye(4)[:, :1] * [0.2, 0, 0.04]
    # LF (0.3, 0.1) to RH (-0.1, -0.1), y = x / 2 - 0.05, meets y = -x
    np.testing.assert_allclose(reference.diagonals(moved), [0.1 / 3, -0.1 / 3, 0.01], atol=1e-12)
    angle = np.deg2rad([30, 90, 150, 210, 270, 330])
    six = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    np.testing.assert_allclose(reference.diagonals(six), 0, atol=1e-12)
    np.testing.assert_allclose(reference.diagonals(six[:5]), six[:5].mean(0), atol=1e-12)


def test_a_robot_tumbles_over_the_axis_nearest_to_its_weight():
    """10 N, 0.1 m from each axis of the square, 2 N of pull with an arm of 0.2 m; beside the square it tumbles."""
    com, weight, up = np.array([0, 0, 0.1]), np.array([0, 0, -10.0]), np.tile([0, 0, 1.0], (4, 1))
    assert reference.tumbling_margin(FEET, com, weight, 0 * up) == pytest.approx(1.0)
    assert reference.tumbling_margin(FEET, com, weight, 2 * up) == pytest.approx(1.4)
    assert reference.tumbling_margin(FEET, com + 0.2 * AHEAD, weight, 0 * up) == 0.0
    # hanging, only pulls hold
    assert reference.tumbling_margin(FEET, com, -weight, 6 * up) == pytest.approx(0.2)
    assert reference.tumbling_margin(FEET, com, -weight, 4 * up) == 0.0


def test_a_grip_pulls_along_its_own_normal():
    """Of a square the level part of a pull has no arm; a foot that is 0.1 m higher pulls back with that arm."""
    com, weight = np.array([0, 0, 0.1]), np.array([0, 0, 10.0])
    aside = np.tile([0.6, 0, 0.8], (4, 1))
    # hanging: 0.8 of the pull with an arm of 0.2 m less 10 N with one of 0.1 m
    assert reference.tumbling_margin(FEET, com, weight, 6 * aside) == 0.0
    assert reference.tumbling_margin(FEET, com, weight, 7.5 * aside) == pytest.approx(0.2)
    # standing 0.05 m behind the front axis, RH higher
    raised, ahead = FEET + np.outer([0, 0, 1, 0], [0, 0, 0.1]), com + 0.05 * AHEAD
    for normal, margin in ((AHEAD, 0.8), (-AHEAD, 0.5)):
        pull = np.outer([0, 0, 3.0, 0], normal)
        assert reference.tumbling_margin(raised, ahead, -weight, pull) == pytest.approx(margin)


def test_the_best_margin_is_a_wider_stance_unless_it_is_too_far():
    """LF swings, and the axis in front is 0.05, 0.089 or 0.079 m from the centre of mass."""
    points = np.array([[0.1, 0.1, 0], [0.2, 0.1, 0], [0.2, 0.2, 0]])
    stands, com, weight = np.array([False, True, True, True]), np.array([0.05, 0, 0.1]), np.array([0, 0, -10.0])
    up, bare = np.tile([0, 0, 1.0], (3, 1)), np.zeros((4, 3))
    arguments = points, up, np.zeros(3), all_of(points), FEET, FEET, stands, com, weight, bare
    assert reference.best_margin(*arguments, distance_weight=0.0)[0] == 1
    assert reference.best_margin(*arguments, distance_weight=10.0)[0] == 0


# --- polyhedra in any direction


DIRECTIONS = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0.48, -0.6, 0.64]]


@pytest.mark.parametrize("normal", DIRECTIONS)
@pytest.mark.parametrize("gravity", [[0, 0, -9.81], [0, 0, 0], [-3.0, 0, -1.6]])
def test_the_axes_of_a_hold(normal, gravity):
    axes = reference.frame(np.array(normal), gravity)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[:, 2], normal, atol=1e-12)
    up = -np.array(gravity)
    if np.linalg.norm(np.cross(up, normal)) > 1e-9:
        assert axes[:, 0] @ up > 0 and axes[:, 1] @ up == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("normal", DIRECTIONS)
def test_what_magnets_bear_in_any_direction(normal):
    """Two magnets of 20 N bear 40 N off their surface, half of it beside, and a push of any size; with it no moment."""
    shape, normal = magnet(20.0, 0.5, sides=64), np.array(normal, float)
    axes = np.array([reference.frame(normal, [0, 0, -9.81])] * 2)
    position = np.array([axes[0, :, 0], -axes[0, :, 0]])
    polyhedra = np.array([shape["normals"]] * 2), np.array([shape["limits"]] * 2)

    def most(force, moment=(0, 0, 0)):
        return reference.largest_share(position, axes, *polyhedra, [*force, *moment], np.zeros(3))

    assert most(normal) == pytest.approx(40.0)
    assert most(axes[0, :, 1]) == pytest.approx(20.0, rel=2e-3)
    assert most(-normal) == np.inf
    assert most((0, 0, 0), axes[0, :, 0]) == 0.0
    # one magnet pulls by 20 N, the other one is pushed
    assert most((0, 0, 0), axes[0, :, 1]) == pytest.approx(40.0)
    assert reference.largest_pull(shape["normals"], shape["limits"]) == pytest.approx(20.0)
    spines = microspines(1.0, 30.0)
    assert reference.largest_pull(spines["normals"], spines["limits"]) == pytest.approx(0.5)
