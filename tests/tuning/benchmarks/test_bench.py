"""The benchmark: its arithmetic, sane ratios, and peers in NumPy, a second implementation, that walk the same walk.

No absolute times: the machine may be busy.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot_import.load import load_model
from tests.robot.test_robot_file import keys, urdf
from tuning.benchmarks import commands, measure, operations, peers
from tuning.command_line import machine
from tuning.problem.evaluation import REVERSE_ABOVE

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


@pytest.mark.slow
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


@pytest.mark.nightly
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


@pytest.mark.nightly
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


def test_exponent_is_the_slope_of_the_logarithms():
    sizes = (1, 2, 4, 8)
    assert measure.exponent(sizes, [3.0 * n**1.25 for n in sizes]) == pytest.approx(1.25)
    assert measure.exponent((), []) is None


def test_reverse_mode_pays_from_where_forward_mode_costs_as_much():
    costs = {"gradient_cost_2": 3.0, "gradient_cost_12": 8.0, "adjoint_cost": 6.0}
    assert measure.reverse_from(costs) == pytest.approx(8.0)
    assert measure.reverse_from(costs | {"adjoint_cost": 1.0}) == 1.0
    assert measure.reverse_from(costs | {"gradient_cost_12": None}) is None
    labels = {name: label for name, label, *_ in machine.ROWS}
    assert labels["adjoint_from"].endswith(f"searches use it from {REVERSE_ABOVE + 1} on")


def test_work_takes_turns_and_the_first_turn_does_not_count():
    order = []
    work = {"a": (1, lambda: order.append("a")), "b": (2, lambda: order.append("b"))}
    assert measure.in_turns(3, work).keys() == work.keys()
    assert order == ["a", "b"] * 4


def test_a_command_is_timed_twice_with_a_cache_of_its_own(monkeypatch):
    """The first run leaves a file in its cache and waits; the second finds it."""
    code = (
        "import os, pathlib, time; cache = pathlib.Path(os.environ['MJX_CLIMB_CACHE']); there = cache.exists();"
        "cache.mkdir(exist_ok=True); end = time.process_time() + (0 if there else 1);\n"
        "while time.process_time() < end: pass"
    )
    monkeypatch.setattr(commands, "COMMANDS", {"wait": ("-c", code)})
    told = []
    seconds = commands.measure(["wait"], told.append)["wait"]
    assert told == ["wait, cold", "wait, warm"]
    assert seconds.cold_cpu > 1 > seconds.warm_cpu and seconds.cold > 1


def test_ratios_are_how_many_times_faster_this_program_is(monkeypatch):
    seconds = {name: float(n) for n, name in enumerate(("closed_loop", "mujoco_c", "mjx", "mujoco_batch"), 1)}
    seconds |= {"value": 2.0, "gradient_2": 10.0, "single": 4.0, "numpy_loop": 12.0}
    times = {"from_start": 9.0, "first": 7.0, "again": 2.0}
    monkeypatch.setattr(commands, "compiled", lambda *_: times)
    monkeypatch.setattr(measure, "in_turns", lambda *_: seconds)
    monkeypatch.setattr(measure, "runs_of", lambda *_: ({}, {}, {}, {}))
    for name in ("growth_of", "operations_of"):
        monkeypatch.setattr(measure, name, lambda *_: {})
    result = measure.measure("limb", 1, measure.Plan(1, 2, 1, (2,), False, (), ()), lambda _: None)
    names = ("vs_mujoco_c", "vs_mjx", "vs_mujoco_batch", "vs_numpy_loop_single", "gradient_cost_2")
    assert [result[name] for name in names] == [2.0, 3.0, 4.0, 3.0, 5.0]
    assert [result[name] for name in ("compile_value_s", "warm_start_s", "gradient_cost_12")] == [5.0, 7.0, None]
    assert result["peers_steps_per_s"]["mjx"] == pytest.approx(1 / 3)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timing
def test_quick_bench_prints_every_figure_and_sane_ratios():
    command = [sys.executable, "-m", "tuning.command_line", "doctor", "--bench", "--quick", "--json", "--batch", "256"]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    result = json.loads(output)
    left_out = {
        "gradient_cost_12",
        "adjoint_cost",
        "adjoint_from",
        "batch_exponent",
        "step_exponent",
        "vs_mujoco_warp",
    }  # the last is for GPUs
    assert {name for name, *_ in machine.ROWS} <= result.keys()
    assert left_out == {name for name, value in result.items() if value is None}
    assert result["vs_mjx"] > 1.5
    assert result["vs_mujoco_c"] > 0.2
    assert result["vs_mujoco_batch"] > 0.5
    assert result["vs_numpy_loop_single"] > 1
    assert 1 < result["gradient_cost_2"] < 10
    assert set(result["waits"]) == set(machine.QUICK)
    run = result["waits"][commands.RUN]
    assert run["warm_cpu"] < run["cold_cpu"] / 1.5
    # fusion within a piece of a step repeats some; fusion of a whole step would repeat all six times
    assert 0.85 < result["flops_per_env_step"] / operations.BY_HAND < 2
