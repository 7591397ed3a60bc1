"""Grippers that close: no force when they shut, continuous forces after, and no more energy than their motor gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.kinematics import Feet, Surface

STEP, TIME, FORCE, STIFFNESS = 1e-3, 0.1, 2.0, 1e4
OPEN, SHUT = jnp.zeros(4, bool), jnp.ones(4, bool)


def gripper(**values):
    own = {"closing_time": TIME, "capture_distance": 0.005, "holding_limit": 15.0} | values
    return Gripper(**{name: jnp.asarray(value) for name, value in own.items()}).compiled_for().set_up(STEP)


def feet(height, velocity=(0.0, 0.0, 0.0), surface=None):
    position = jnp.asarray(np.column_stack([np.zeros((4, 2)), np.broadcast_to(height, 4)]))
    return Feet(position, jnp.broadcast_to(jnp.asarray(velocity), (4, 3)), position, surface)


def shut(contact, *heights, velocity=(0.0, 0.0, 0.0)):
    """Return the grips of steps in which grippers shut over feet at these heights, m, after one in the air."""
    memory = contact.init(jnp.zeros((4, 3)), jnp.zeros((4, 3, 3)))
    memory, _ = contact.step(memory, feet(0.03), None, OPEN, jnp.zeros(4))
    step = jax.jit(lambda memory, now: contact.step(memory, now, None, SHUT, jnp.zeros(4)))
    found = []
    for height in heights:
        memory, grip = step(memory, feet(height, velocity))
        found.append(jax.tree.map(np.asarray, grip))
    return found


def test_a_gripper_that_shuts_off_the_ground_begins_without_force():
    """At 1.2 mm, where one that closes at once pulls 12 N; moving feet too. Then the gap falls to 1/e in 0.1 s."""
    grips = shut(gripper(), *[0.0012] * 300, velocity=(0.05, 0.0, -0.1))
    assert not np.asarray(grips[0].foot_force).any() and grips[0].support.all()
    assert -shut(gripper(closing_time=0.0), 0.0012)[0].foot_force[0, 2] == pytest.approx(12.0)
    force = np.array([grip.foot_force[0] for grip in grips])
    n = np.arange(300)
    closed = 1 - np.exp(-n * STEP / TIME)
    damped = 20.0 * closed[:, None] * np.array([0.05, 0.0, -0.1])
    np.testing.assert_allclose(force, -STIFFNESS * 0.0012 * closed[:, None] * [0, 0, 1] - damped, atol=1e-9)
    assert np.abs(np.diff(force, axis=0)).max() < 0.13  # N a step


def test_a_closing_gripper_pulls_no_harder_than_its_force():
    """A held foot 1.2 mm off: the pull ends at 2 N, and the grip point stays where it gives that."""
    grips = shut(gripper(closing_force=FORCE), *[0.0012] * 400)
    pull = -np.array([grip.foot_force[0, 2] for grip in grips])
    assert pull.max() == pytest.approx(FORCE, rel=1e-9) and pull[-1] == pull.max() and (np.diff(pull) >= -1e-12).all()
    # a foot that is pulled off later is held by the spring, not by the motor
    grips = shut(gripper(closing_force=FORCE), *[0.0012] * 400, 0.0016)
    assert -grips[-1].foot_force[0, 2] == pytest.approx(FORCE + 4.0)


@pytest.mark.parametrize("surface", [False, True])
def test_drawing_in_puts_in_no_more_than_the_closing_force_times_its_way(surface):
    """10,000 feet that move at random on ground of any normal: the work of the grip point against the spring."""
    rng, count = np.random.default_rng(0), 2500
    contact = gripper(closing_force=FORCE, holding_limit=np.inf, damping=0.0)
    normal = rng.normal(size=(count, 4, 3)) if surface else np.tile([0.0, 0.0, 1.0], (count, 4, 1))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    point = rng.normal(size=(count, 4, 3)) if surface else np.zeros((count, 4, 3))
    start = point + normal * rng.uniform(1e-4, 4e-3, (count, 4, 1))
    way = start[None] + np.cumsum(rng.normal(scale=1e-4, size=(60, count, 4, 3)), axis=0)

    def one(point, normal, way):
        face = Surface(point, normal) if surface else None
        far = Feet(point + 0.03 * normal, 0 * point, point, face)
        memory = contact.init(point, jnp.zeros((4, 3, 3)))
        memory, _ = contact.step(memory, far, None, OPEN, jnp.zeros(4))

        def step(memory, position):
            now = Feet(position, 0 * position, position, face)
            after, grip = contact.step(memory, now, None, SHUT, jnp.zeros(4))
            return after, grip.grip_point

        return jax.lax.scan(step, memory, way)[1]

    anchors = np.asarray(jax.jit(jax.vmap(one, in_axes=(0, 0, 1), out_axes=1))(point, normal, way))
    moved, before = anchors[1:] - anchors[:-1], anchors[:-1]
    stretched = [0.5 * STIFFNESS * ((anchor - way[1:]) ** 2).sum(-1) for anchor in (before, anchors[1:])]
    work, length = stretched[1] - stretched[0], np.linalg.norm(moved, axis=-1)
    assert (work <= FORCE * length + 1e-12).all() and work.max() > 0.5 * FORCE * length.max() > 0
    np.testing.assert_allclose(np.cross(moved, normal), 0, atol=1e-12)


def test_a_foot_that_presses_the_ground_keeps_its_push_when_its_gripper_shuts():
    contact = gripper()
    memory = contact.init(jnp.zeros((4, 3)), jnp.zeros((4, 3, 3)))
    memory, _ = contact.step(memory, feet(0.03), None, OPEN, jnp.zeros(4))
    pushes = []
    for height, closed in ((-1e-4, OPEN), (-1e-4, SHUT), (-1e-4, SHUT)):
        memory, grip = contact.step(memory, feet(height, (0.1, 0.0, -0.02)), None, closed, jnp.zeros(4))
        pushes.append(np.asarray(grip.foot_force[0]))
    np.testing.assert_allclose(pushes[1], pushes[0], atol=1e-12)
    np.testing.assert_allclose(pushes[0], [0, 0, 1.0 + 0.4], atol=1e-12)


@pytest.mark.slow
def test_peak_pull_follows_joint_gains_smoothly():
    """Pd of case 1.2 with kd 3 % higher: at once a foot comes down otherwise, and the peak pull more than doubles."""
    gains, factor = {"kp": np.array([17.24, 17.24]), "kd": np.array([0.9705, 0.9705 * 1.03])}, {}
    for time in (0.0, TIME):
        keys = {"control.controller": "pd", "time_step": 2.5e-4, "contact.closing_time": time}
        scenario = mc.load_scenario("case_1_2", keys | {"contact.capture_distance": 0.005})
        one, other = mc.rollout_metrics(scenario, gains, dtype=np.float64, unsteady=True)["peak_pull_force"]
        factor[time] = other / one
    assert factor[0.0] > 2 and 1 / 1.02 < factor[TIME] < 1.02


@pytest.mark.slow
def test_tangents_of_a_walk_with_closing_grips_are_differences():
    """Of the pull by kd, through the shutting of two grippers, in double precision."""
    keys = {
        "control.controller": "pd", "contact.closing_time": 0.02, "contact.closing_force": 5.0,
        "contact.capture_distance": 0.004, "duration": 0.5, "gait.cycle": 0.4, "gait.stride": 0.01,
        "gait.step_height": 0.004,
    }  # fmt: skip
    simulation = mc.Simulation(mc.load_scenario("case_1_2", keys))
    gains = {"kd": np.array([0.2, 0.21])}
    names = ("peak_pull_force", "peak_utilization", "force_variation")
    tangents = simulation.jvp(gains, {"kd": np.ones((1, 2))}, dtype=np.float64)[1]
    ends = [simulation.metrics({"kd": gains["kd"] + h}, dtype=np.float64) for h in (1e-7, -1e-7)]
    for name in names:
        np.testing.assert_allclose(tangents[name][0], (ends[0][name] - ends[1][name]) / 2e-7, rtol=1e-4, err_msg=name)


def test_tangents_of_a_long_stance_are_finite_in_single_precision():
    """4 s after shutting 0.3 um off the gap is 1e-24 m, whose square no single has."""
    contact, above = jax.tree.map(lambda value: jnp.asarray(value, jnp.float32), gripper()), jnp.float32(3e-7)

    def held(height):
        position = jnp.zeros((4, 3), jnp.float32).at[:, 2].set(height)
        each, none = Feet(position, 0 * position, position, None), 0 * position[:, 2]
        memory = contact.init(0 * position, jnp.zeros((4, 3, 3), jnp.float32))
        memory, _ = contact.step(memory, each, None, OPEN, none)

        def step(memory, _):
            memory, grip = contact.step(memory, each, None, SHUT, none)
            return memory, grip.foot_force[0, 2]

        return jax.lax.scan(step, memory, None, 4000)[1][-1]

    force, tangent = jax.jit(lambda above: jax.jvp(held, (above,), (jnp.float32(1.0),)))(above)
    assert (-force, -tangent) == (pytest.approx(STIFFNESS * 3e-7), pytest.approx(STIFFNESS))


@pytest.mark.slow
def test_without_a_closing_time_nothing_changes():
    """To the bit, beside a robot of the batch whose grippers close."""
    scenario = mc.load_scenario("case_1_2", {"duration": 0.3, "gait.cycle": 0.4, "gait.stride": 0.01})
    plain = mc.rollout_metrics(scenario, dtype=np.float64)
    own = mc.parameters(scenario).replace({"contact.closing_time": np.array([0.0, 0.05])})
    both = mc.rollout_metrics(scenario, parameters=own, dtype=np.float64)
    for name, value in plain.items():
        np.testing.assert_allclose(both[name][0], value, rtol=1e-12, err_msg=name)
    assert both["force_variation"][1] < both["force_variation"][0]
