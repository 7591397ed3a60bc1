"""The contact, the actuator and the disturbance that pages show: alone and in a batch, without a fall back."""

import importlib.util
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.physics.kinematics import Feet, limb_frames
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from tests.pages import fences

DOCS = Path(__file__).parents[2] / "docs" / "guides"
PAGES = {"contact": "Magnet", "actuator": "SeriesElastic", "disturbance": "ThermalBending"}
ALONE = {"contact": 2, "actuator": 2, "disturbance": 1}  # where the batch of the page has the value of its one walk
OPEN = jnp.zeros(4, bool)


def blocks(page):
    """The example of a page and how it is used."""
    return fences((DOCS / f"{page}.md").read_text("utf-8"), "python")


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """The classes of the pages, each from a file as a user has it."""

    def load(page):
        file = tmp_path_factory.mktemp(page) / f"own_{page}.py"
        file.write_text(blocks(page)[0])
        spec = importlib.util.spec_from_file_location(file.stem, file)
        sys.modules[file.stem] = module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return getattr(module, PAGES[page])

    found = {page: load(page) for page in PAGES}
    yield found
    for page in PAGES:
        sys.modules.pop(f"own_{page}")


@pytest.fixture(scope="module")
def plain(case):
    return mc.rollout(case("case_1_2", "pd", {"duration": 0.3}))


@pytest.mark.slow
@pytest.mark.parametrize("page", [pytest.param(p, marks=[pytest.mark.nightly] * (p != "actuator")) for p in PAGES])
def test_the_page_walks_its_example_alone_and_in_a_batch(page, own, plain, monkeypatch):
    """By the page's own lines: in float64 alone, in float32 in a batch. Warnings, as of a fall back, are errors."""
    monkeypatch.setattr(mc, "load_scenario", {"case_1_2": plain.scenario}.__getitem__)
    scope = {"mc": mc, "np": np, PAGES[page]: own[page]}
    exec(compile("".join(blocks(page)[1:]), f"{page}.md", "exec"), scope)
    walk, batch = scope["walk"], scope["metrics"]
    assert np.isfinite(walk.foot_force).all() and np.abs(walk.foot_force - plain.foot_force).max() > 1e-4
    assert batch["peak_foot_force"].shape == (3,) and batch["peak_foot_force"].dtype == np.float32
    alone = mc.metrics(walk)
    for name in ("peak_foot_force", "force_variation", "travel"):
        np.testing.assert_allclose(batch[name][ALONE[page]], alone[name], rtol=1e-3, atol=1e-5, err_msg=name)
    if page != "contact":  # magnets that hold are alike
        assert len({*batch["force_variation"]}) == 3


def test_the_magnet_slides_and_lets_go(own):
    magnet = own["contact"](pull=10.0, friction=0.5, stiffness=1e3, damping=0.0)
    # pushed with 10 N and sheared with 5 and 20 N; pulled with 9 and 11 N
    position = jnp.array([[-0.005, 0.0, -0.01], [0.0, 0.02, -0.01], [0.0, 0.0, 0.009], [0.0, 0.0, 0.011]])
    still = jnp.zeros((4, 3))
    after, grip = magnet.step(magnet.init(still, None), Feet(position, still, position), None, ~OPEN, jnp.zeros(4))
    expected = [[5.0, 0.0, 10.0], [0.0, -10.0, 10.0], [0.0, 0.0, -9.0], [0.0, 0.0, -11.0]]
    np.testing.assert_allclose(grip.foot_force, expected, atol=1e-12)
    np.testing.assert_array_equal(grip.torn_off, [False, False, False, True])
    # a foot that rests where it slid to is held by the friction there
    _, later = magnet.step(after, Feet(position, still, position), None, ~OPEN, jnp.zeros(4))
    np.testing.assert_allclose(later.foot_force[:3], expected[:3], atol=1e-12)
    np.testing.assert_array_equal(later.support, [True, True, True, False])


def test_the_motor_behind_the_spring_lags_and_has_a_largest_rate(own):
    drive = own["actuator"](stiffness=40.0, damping=0.0, lag=0.1, largest_rate=2.0)
    angles, targets = jnp.zeros((4, 3)), jnp.zeros((4, 3)).at[0, 0].set(0.05).at[1, 1].set(-1.0)
    memory, done = drive.step(drive.init(angles), targets, None, mc.Joints(angles, angles, None), 1e-3)
    expected = np.zeros((4, 3))
    expected[0, 0], expected[1, 1] = 40 * 1e-3 * 0.05 / 0.1, -40 * 1e-3 * 2.0
    np.testing.assert_allclose(done.joint_torque, expected, atol=1e-12)
    np.testing.assert_allclose(memory.angles, expected / 40, atol=1e-12)


def test_the_bending_has_no_wrench_and_loads_the_joints_between_its_links(own):
    """By energy: a joint's torque is the moment along its axis, where it turns the last link and not the first."""
    robot = load_robot("hubrobo_v3_2")
    still, joints = jnp.zeros(3), jnp.asarray(robot.stance_joints)
    state = State(still, jnp.array([1.0, 0.0, 0.0, 0.0]), still, still, joints, jnp.zeros_like(joints))
    frames = limb_frames(robot, None, robot.stance_joints)
    body = mc.Body(robot, frames, state)
    external = own["disturbance"](limb=2.0, moment=0.3, warming=10.0).act(jnp.asarray(5.0), body)
    axes = np.asarray(frames.rotation)[2, :, :, 2]
    torque = np.zeros((4, 3))
    torque[2, 1:] = 0.3 * (1 - np.exp(-0.5)) * axes[1:] @ axes[1]
    np.testing.assert_allclose(external.joint_torque, torque, atol=1e-12)
    np.testing.assert_allclose(external.base_wrench, 0, atol=1e-12)
    assert np.abs(torque).max() > 0.1
