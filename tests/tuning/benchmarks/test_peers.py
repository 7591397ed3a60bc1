"""The NumPy peers of the benchmark walk the same walk: a second implementation of the closed loop."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot.constants import load_model
from tests.robot.test_robot_file import keys, urdf
from tuning.benchmarks import peers

CASE = "configs/case_1_2.yaml"
SETS = [(5e3, 5e4), (1e2, 3e3), (1e4, 4e5)]  # damping, stiffness; inertia 1


def gains(rows):
    damping, stiffness = np.repeat(np.array(rows)[:, :, None], 6, axis=2).transpose(1, 0, 2)
    return {"inertia": np.ones_like(damping), "damping": damping, "stiffness": stiffness}


def check(peer, scenario, ours):
    """Compare the metrics that need no stability margin, from what a peer shows of every step."""
    model, rows = load_model(scenario.robot), []

    def watch(step, walker, qpos, qvel):
        force = np.sqrt((walker.foot_force**2).sum(0)).T
        torque = walker.torque.transpose(2, 1, 0).reshape(len(qpos), -1)
        pull = np.where(walker.foot_force[2].T < 0, force, 0.0).max(1)
        rows.append((qpos[:, :3].copy(), qpos[:, 7:].copy(), qvel[:, 6:].copy(), force.max(1), pull, torque))

    peer.run(scenario.steps, watch)
    base, angles, rates, force, pull, torque = map(np.stack, zip(*rows, strict=True))
    gait, dt, cargo, (low, high) = scenario.gait, scenario.time_step, scenario.disturbance.cargo, model.jnt_range[1:].T
    phase = (np.arange(len(base)) * dt) % gait.cycle / gait.cycle
    reference = base[0] + gait.stride * (3 * phase**2 - 2 * phase**3)[:, None, None] * np.array([1.0, 0, 0])
    travel = base[-1, :, 0] - base[0, :, 0]
    mass = model.body_subtreemass[1] + (cargo.mass if cargo.start < scenario.duration else 0.0)
    weight = mass * np.linalg.norm(scenario.gravity)
    expected = {
        "peak_foot_force": force.max(0),
        "force_variation": np.abs(np.diff(force, axis=0)).sum(0),
        "peak_pull_force": pull.max(0),
        "peak_joint_torque": np.abs(torque).max((0, 2)),
        "cost_of_transport": np.abs(torque * rates).sum((0, 2)) * dt / (weight * np.abs(travel)),
        "travel": travel,
        "base_deviation": np.linalg.norm(base - reference, axis=2).max(0),
        "joint_limit_margin": np.minimum(angles - low, high - angles).min((0, 2)),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(value, ours[name], rtol=1e-6, err_msg=name)


@pytest.fixture(scope="module")
def scenario():
    """Within 1 s: cargo, a push with a moment, a swing of two limbs and their touchdown."""
    push = "disturbance.pushes=[{force: [-2, 1, 0.5], moment: [0.02, -0.01, 0.03], start: 0.5, stop: 0.7}]"
    return mc.load_scenario(CASE, ["duration=1.0", "gait.cycle=1.6", "disturbance.cargo.start=0.3", push])


@pytest.fixture(scope="module")
def ours(scenario):
    return mc.rollout_metrics(scenario, mc.Gains(**gains(SETS)), dtype=np.float64)


@pytest.mark.slow
def test_mujoco_batch_walks_the_same_walk(scenario, ours):
    check(peers.Batch(scenario, gains(SETS), threads=2), scenario, ours)


def test_loop_over_mj_step_walks_the_same_walk(scenario, ours):
    second = {name: values[1:2] for name, values in ours.items()}
    check(peers.Loop(scenario, gains(SETS[1:2])), scenario, second)


@pytest.fixture(scope="module", params=range(2))
def of_ones_own(request, tmp_path_factory):
    """Return a scenario with a user's own robot: knees up and down, limbs out of order, links beside their planes."""
    text, reach = urdf(request.param)
    path = tmp_path_factory.mktemp("robot") / "robot.urdf"
    path.write_text(text)
    scenario = mc.Scenario.model_validate({"duration": 0.4, "time_step": 2.5e-4, **keys(path, reach)})
    changes = ["gait.cycle=0.8", "gravity=[0.2,0.1,-1.6]", "control.damping=100", "control.stiffness=3e3"]
    return scenario.with_overrides(changes)


@pytest.mark.slow
def test_robots_of_ones_own_walk_the_same_walk(of_ones_own):
    walked = mc.rollout_metrics(of_ones_own, mc.Gains(**gains(SETS)), dtype=np.float64)
    check(peers.Batch(of_ones_own, gains(SETS), threads=2), of_ones_own, walked)


def test_robots_of_ones_own_fall_freely(of_ones_own):
    """Everything falls alike, so joints and attitude stay; n steps of semi-implicit Euler fall g dt^2 n (n + 1) / 2."""
    steps, start = 20, load_model(of_ones_own.robot).key_qpos[0]
    peer = peers.Rollout(of_ones_own, 2, steps, threads=1)
    peer.run()
    peer.pool.close()
    path = np.asarray(of_ones_own.gravity) * of_ones_own.time_step**2 * steps * (steps + 1) / 2
    ends = peer.states[:, -1, 1:20]  # after the time
    np.testing.assert_allclose(ends, [start + np.pad(path, (0, 16))] * 2, atol=1e-12)


def test_mujoco_warp_falls_as_mujoco_does(of_ones_own):
    pytest.importorskip("mujoco_warp")
    peer, other = peers.Warp(of_ones_own, 2), peers.Rollout(of_ones_own, 2, 20, threads=1)
    peer.run(19)  # and one to compile
    other.run()
    other.pool.close()
    np.testing.assert_allclose(peer.data.qpos.numpy(), other.states[:, -1, 1:20], atol=1e-6)


def test_peers_lose_a_gripper_in_the_same_step():
    scenario = mc.load_scenario(CASE, ["duration=0.4", "contact.holding_limit=1.0", "gait.cycle=1.6"])
    ours = mc.rollout_metrics(scenario, mc.Gains(**gains(SETS)), dtype=np.float64)
    lost = []
    peer = peers.Batch(scenario, gains(SETS), threads=1)
    peer.run(scenario.steps, lambda step, walker, *_: lost.append(walker.lost.copy()))
    lost = np.stack(lost)
    assert lost.any(1)[-1].all(), "the test needs a limit that is passed"
    np.testing.assert_allclose(ours["detached_at"], lost.any(1).argmax(0) * scenario.time_step, atol=1e-9)


def test_peers_refuse_another_law():
    scenario = mc.load_scenario(CASE, ["control.controller=pd"])
    with pytest.raises(ValueError, match="base admittance"):
        peers.Loop(scenario, gains(SETS[:1]))
