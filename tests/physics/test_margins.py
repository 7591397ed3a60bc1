"""Stability margins: against ClimbLab's own on its walks, against geometry by hand, and their derivatives."""

import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from mjx_climb.physics.kinematics import base_wrench_of_foot_force
from mjx_climb.physics.margins import gia_margin, net_external_wrench, support_axes, tumble_stability_margin

REFERENCE = Path(__file__).parents[1] / "reference"
PUSHES = [(1.0, 1.5, (-5, 0, 0)), (4.5, 5.0, (0, 5, 0)), (7.0, 7.5, (0, -10, 0))]  # s, N
WALKS = {"climblab_1G_no_load": (9.81, []), "climblab_microgravity_impacts": (9.81e-6, PUSHES)}  # gravity, m/s^2
HOLDING_FORCE = 15.0
MASS = json.loads((REFERENCE / "dynamics_vectors.json").read_text())["model"]["total_mass"]

SQUARE = np.array([[0.14, 0.14, 0], [-0.14, 0.14, 0], [-0.14, -0.14, 0], [0.14, -0.14, 0]])
PATTERNS = np.array(list(itertools.product([False, True], repeat=4)))


@jax.jit
def both_margins(foot_position, support, com, force, moment, mass, gravity, holding_force):
    """TSM and GIA margin, (T,) each, of arrays with the batch first."""

    def alone(feet, support, com, force, moment, mass, gravity, holding_force):
        axes = support_axes(feet, support)
        tsm = tumble_stability_margin(axes, (force, moment), mass, gravity, holding_force)
        return tsm, gia_margin(axes, com, force, mass, holding_force)

    scalars = (jnp.broadcast_to(value, len(com)) for value in (mass, gravity, holding_force))
    return jax.vmap(alone)(foot_position, support, com, force, moment, *scalars)


def standing_still(com, mass, gravity):
    """Net external wrench on a robot at rest: it cancels gravity at the centre of mass."""
    force = np.array([0, 0, mass * gravity])
    return force, np.cross(com, force)


# --- ClimbLab's walks ---


def grips_unchanged(walk):
    """Rows (T,) more than two rows (10 ms) away from any change of a grip or contact; never the last."""
    changed = np.zeros(len(walk["time"]), bool)
    for key in ("support", "support_for_margins", "contact"):
        changed[1:] |= (walk[key][1:] != walk[key][:-1]).any(1)  # row i differs from row i - 1
    near = np.convolve(changed, np.ones(6), "full")[3:-2] > 0  # rows i - 3 to i + 2
    near[-1] = True
    return ~near


@pytest.mark.parametrize("name", WALKS)
def test_margins_of_foot_forces_and_push_are_those_of_climblab(name):
    with np.load(REFERENCE / f"{name}.npz") as file:
        walk = {key: a.astype(float) if a.dtype == np.float32 else a for key, a in file.items()}
    gravity, pushes = WALKS[name]
    push = np.zeros((len(walk["time"]), 6))
    for start, stop, pushed in pushes:
        push[(walk["time"] > start - 1e-6) & (walk["time"] < stop + 1e-6), :3] = pushed
    lever = walk["foot_pos"] - walk["base_pos"][:, None]
    wrench = jax.vmap(base_wrench_of_foot_force)(lever, walk["foot_force"]) + push
    force, moment = jax.vmap(net_external_wrench)(wrench, walk["base_pos"])
    feet, support, com = walk["foot_pos"], walk["support_for_margins"], walk["com"]
    tsm, margin = both_margins(feet, support, com, force, moment, MASS, gravity, HOLDING_FORCE)
    rows = grips_unchanged(walk)
    assert rows.sum() > 1300
    # Measured: at most 3e-4 (TSM) and 8e-8 (GIA margin, which no inertia enters).
    for ours, theirs, median, most in ((tsm, walk["tsm"], 5e-4, 2e-3), (margin, walk["gia_margin"], 1e-6, 1e-5)):
        error = np.abs(np.asarray(ours) / theirs - 1)[rows]
        assert np.median(error) < median
        assert np.percentile(error, 90) < most


# --- by hand ---


def one(feet, support, com, wrench, mass=2.0, gravity=9.81, holding=0.0):
    batch_of_one = (np.asarray(a)[None] for a in (feet, support, com, *wrench))
    return tuple(float(margin[0]) for margin in both_margins(*batch_of_one, mass, gravity, holding))


def standing(com, support=(True,) * 4, gravity=9.81, holding=0.0, feet=SQUARE):
    """TSM and GIA margin of 2 kg at rest."""
    return one(feet, support, com, standing_still(com, 2.0, gravity), 2.0, gravity, holding)


TO_DIAGONAL = (0.03 + 0.01) / np.sqrt(2)  # LH to RF, through the origin
HAND = {  # TSM without holding: distance of the centre of mass to the nearest edge. GIA: g times the sine to it.
    "square": ({"com": [0.03, -0.05, 0.1]}, 0.09, 9.81 * 0.09 / np.hypot(0.09, 0.1)),
    "triangle": (
        {"com": [0.03, 0.01, 0.1], "support": [True, True, False, True], "gravity": 1.635},
        TO_DIAGONAL, 1.635 * TO_DIAGONAL / np.hypot(TO_DIAGONAL, 0.1),
    ),
    # TSM: one gripper at the far edge (the longest arm). GIA margin: both of them.
    "holding": (
        {"com": [0.0, 0.0, 0.1], "holding": 15.0}, 0.14 + 15.0 * 0.28 / (2.0 * 9.81),
        (9.81 * 0.14 + 2 * 15.0 * 0.28 / 2.0) / np.hypot(0.14, 0.1),
    ),
    "outside of the polygon": ({"com": [0.2, 0.0, 0.1]}, 0.0, 0.0),
    **{f"no polygon {n}": ({"com": [0, 0, 0.1], "support": two, "holding": 15.0}, 0.0, 0.0)
       for n, two in enumerate(PATTERNS[PATTERNS.sum(1) < 3])},
}  # fmt: skip


@pytest.mark.parametrize("name", HAND)
def test_margins_by_hand(name):
    scene, tsm, margin = HAND[name]
    assert standing(**scene) == pytest.approx((tsm, margin), rel=1e-12)


def test_a_gripper_across_an_axis_does_not_hold():
    """A polygon with a notch at RH: RF and LH lie beyond the axes that RH ends, and could only tip the robot there."""
    feet = np.array([[0.05, 0.05, 0], [-0.1, 0.1, 0], [0.02, 0.02, 0], [0.1, -0.1, 0]])
    com, mass, gravity, holding = np.array([0.035, 0.035, 0.1]), 2.0, 9.81, 15.0
    tumbling, inside = [], []
    for a, b, others in ((0, 1, (2, 3)), (1, 2, (3, 0)), (2, 3, (0, 1)), (3, 0, (1, 2))):
        along = (feet[b] - feet[a])[:2] / np.linalg.norm(feet[b] - feet[a])
        across = np.array([-along[1], along[0]])
        side = lambda point, a=a, across=across: (point - feet[a])[:2] @ across  # noqa: E731  # m, inwards
        tumbling.append(side(com) + holding * max(0, *(side(feet[j]) for j in others)) / (mass * gravity))
        held = holding * sum(side(feet[j]) for j in others) / mass
        inside.append((gravity * side(com) + held) / np.hypot(side(com), com[2]))
    assert standing(com, holding=holding, feet=feet) == pytest.approx((min(tumbling), min(inside)), rel=1e-12)


def test_without_gravity_the_tsm_has_no_length():
    weightless = {"com": [0.0, 0.0, 0.1], "gravity": 0.0, "holding": 15.0}
    at_rest = one(SQUARE, [True] * 4, wrench=(np.zeros(3), np.zeros(3)), **weightless)
    assert at_rest[0] == np.inf and np.isfinite(at_rest[1])
    torn_off = one(SQUARE, [True] * 4, wrench=(np.array([0, 0, -100.0]), np.zeros(3)), **weightless)
    assert torn_off == (0.0, 0.0)


# --- on holds ---


def test_margins_on_holds_of_any_normal_are_answers_of_linear_programs():
    """Of pulls that holds bear along their normals: one gripper's for the TSM, those of all for the GIA margin."""
    rng = np.random.default_rng(1)
    for support in PATTERNS[PATTERNS.sum(1) >= 3]:
        feet, _, com, force, moment = (each[0] for each in random_scene(rng, support[None]))
        normal = rng.normal([0, 0, 1], 0.7, (4, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        limit = rng.uniform(0, 20, 4)
        stands, tumbling, inside = np.flatnonzero(support), [], []
        for a, b in zip(stands, np.roll(stands, -1), strict=True):
            along = (feet[a] - feet[b]) / np.linalg.norm(feet[a] - feet[b])
            off = [j for j in stands if j not in (a, b)]
            # the moment about the axis of a pull of 1 N at each foot
            each = np.array([along @ np.cross(feet[j] - feet[b], -normal[j]) for j in off])
            alone = [linprog([-m], bounds=[(0, limit[j])]).x[0] * m for m, j in zip(each, off, strict=True)]
            together = -linprog(-each, bounds=[(0, limit[j]) for j in off]).fun
            tumbling.append(max(alone) - along @ (moment - np.cross(feet[b], force)))
            edge = np.cross(com - feet[a], com - feet[b])
            inside.append((together * np.linalg.norm(feet[a] - feet[b]) + edge @ force) / (2.0 * np.linalg.norm(edge)))
        axes, pull = support_axes(jnp.asarray(feet), jnp.asarray(support)), jnp.asarray(limit[:, None] * normal)
        tsm = tumble_stability_margin(axes, (force, moment), 2.0, 1.0, pull)
        np.testing.assert_allclose(tsm, max(min(tumbling), 0.0) / 2.0, rtol=1e-9, atol=1e-12)
        margin = gia_margin(axes, jnp.asarray(com), force, 2.0, pull)
        np.testing.assert_allclose(margin, max(min(inside), 0.0), rtol=1e-9, atol=1e-12)


# --- invariance and derivatives ---


def random_scene(rng, patterns):
    """Uneven ground and a wrench that leaves most scenes stable, batch first."""
    count = len(patterns)
    feet = SQUARE + rng.uniform(-0.02, 0.02, (count, 4, 3))
    com = np.array([0, 0, 0.1]) + rng.uniform(-0.02, 0.02, (count, 3))
    force = np.array([0, 0, 20.0]) + rng.uniform(-4, 4, (count, 3))
    moment = np.cross(com, force) + rng.uniform(-0.1, 0.1, (count, 3))
    return feet, patterns, com, force, moment


def test_margins_do_not_depend_on_where_the_scene_is_or_the_limbs_begin():
    feet, support, com, force, moment = random_scene(np.random.default_rng(0), np.repeat(PATTERNS, 4, 0))
    here = both_margins(feet, support, com, force, moment, 2.2, 9.81, 15.0)
    assert (np.array(here)[:, support.sum(1) >= 3] > 0).all()
    turn, shift = Rotation.from_euler("z", 0.7).as_matrix(), np.array([3.0, -2.0, 0.5])
    feet, com, force = feet @ turn.T + shift, com @ turn.T + shift, force @ turn.T
    moment = moment @ turn.T + np.cross(shift, force)
    feet, support = np.roll(feet, 1, 1), np.roll(support, 1, 1)
    there = both_margins(feet, support, com, force, moment, 2.2, 9.81, 15.0)
    np.testing.assert_allclose(there, here, rtol=1e-10, atol=1e-12)


def test_derivatives_for_every_support_pattern():
    rng = np.random.default_rng(2)
    feet, support, *rest = random_scene(rng, PATTERNS)
    point = (feet, *rest, np.full(16, 2.2), np.full(16, 9.81), np.full(16, 15.0))
    direction = tuple(rng.normal(size=a.shape) * np.abs(a).max() for a in point)

    def margins(feet, *others):
        return jnp.stack(both_margins(feet, support, *others))

    value, slope = jax.jvp(margins, point, direction)
    assert np.isfinite(value).all() and np.isfinite(slope).all()
    assert (np.abs(slope[:, support.sum(1) >= 3]) > 0).all()
    step = 1e-7
    ahead = margins(*(a + step * da for a, da in zip(point, direction, strict=True)))
    behind = margins(*(a - step * da for a, da in zip(point, direction, strict=True)))
    np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("collapse", ["feet", "center_of_mass", "everything"])
def test_degenerate_geometry_stays_finite(collapse):
    """Two feet in one place, the centre of mass on an axis, all in one point; both derivatives."""
    feet, support, com, force, moment = random_scene(np.random.default_rng(3), PATTERNS)
    if collapse == "feet":
        feet[:, 1] = feet[:, 0]
    elif collapse == "center_of_mass":
        com = (feet[:, 0] + feet[:, 1]) / 2
    else:
        feet, com = np.zeros_like(feet), np.zeros_like(com)

    def margins(feet, com, force, moment):
        return jnp.stack(both_margins(feet, support, com, force, moment, 2.2, 9.81, 15.0))

    point = (feet, com, force, moment)
    value, slope = jax.jvp(margins, point, tuple(np.ones_like(a) for a in point))
    gradient = jax.grad(lambda *a: margins(*a).sum(), argnums=(0, 1, 2, 3))(*point)
    assert all(np.isfinite(a).all() for a in (value, slope, *gradient))


def test_single_precision_is_good_enough():
    scene = random_scene(np.random.default_rng(4), np.repeat(PATTERNS, 4, 0))
    exact = both_margins(*scene, 2.2, 9.81, 15.0)
    scene32 = [a.astype(np.float32) if a.dtype == float else a for a in scene]
    single = both_margins(*scene32, *(np.float32(a) for a in (2.2, 9.81, 15.0)))
    assert all(a.dtype == np.float32 for a in single)
    np.testing.assert_allclose(single, exact, rtol=1e-4)
