"""The benchmark: its arithmetic, sane ratios, and peers in NumPy, a second implementation, that walk the same walk.

No absolute times: the machine may be busy.
"""

import contextlib
import json
import platform
import signal
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.gait import schedule
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.load import load_model, load_robot
from tests.robot.test_robot_file import keys, urdf
from tuning.benchmarks import commands, measure, operations, peers, self_check, walks
from tuning.command_line import machine
from tuning.problem.evaluation import REVERSE_ABOVE
from tuning.problem.search import Search
from tuning.problem.spaces import space

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


@pytest.mark.parametrize("robots", [1, 2])
def test_peers_walk_the_walk_that_is_stored(robots):
    """Half a second with two swings and touchdowns, a cargo, a push and a slope; one robot in a loop of Python."""
    case, own = self_check.SCENARIO, gains([(self_check.DAMPING, self_check.STIFFNESS)] * robots)
    peer = peers.Loop(case, own) if robots == 1 else peers.Batch(case, own, threads=1)
    check(peer, case, self_check.load()["walk"])


def test_a_peers_joint_angles_put_the_feet_where_they_are(of_ones_own):
    """Feet of MuJoCo's kinematics at angles near the rest stance, in a base that is turned by a rotation vector."""
    rng, walker = np.random.default_rng(0), peers.Loop(of_ones_own, gains(SETS)).walker
    model, turn = load_model(of_ones_own.robot), np.array([[0.5, -0.4, 0.9], [1e-7, 0.0, 0.0], [0.0, 2.0, 0.0]]).T
    data, placed = mujoco.MjData(model), []
    for _ in range(3):
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *(model.key_qpos[0][7:] + rng.uniform(-0.2, 0.2, 12))]
        mujoco.mj_kinematics(model, data)
        angles = [
            data.qpos[model.jnt_qposadr[model.body_jntadr[model.site(foot).bodyid[0]] - 2 :][:3]] for foot in peers.FEET
        ]
        placed.append((np.transpose([data.site(foot).xpos for foot in peers.FEET]), np.transpose(angles)))
    feet, angles = (np.stack(each, axis=-1) for each in zip(*placed, strict=True))
    np.testing.assert_allclose(walker.inverse_kinematics(feet), angles, atol=1e-9)
    turned = np.stack([Rotation.from_rotvec(turn[:, n]).apply(feet[..., n].T).T for n in range(3)], axis=-1)
    np.testing.assert_allclose(peers._turned_back(turn, turned), feet, atol=1e-12)


def test_a_peers_feet_and_base_are_led_as_the_gait_leads_them():
    """Read back from its torques while grips are slack: two cycles, swings of 89.6 steps with a wait at their ends."""
    case, own = self_check.SCENARIO, gains([(self_check.DAMPING, self_check.STIFFNESS)])
    case = case.with_overrides({"gait.cycle": 0.4, "gait.duty": 0.776, "gait.settling": 0.3})
    walker, model = peers.Loop(case, own).walker, load_model(case.robot)
    feet, steps, gaits = walker.footholds, np.arange(0, 800, 23), tuple(case.gait.lift_off.items())

    def led(n):
        standing = jnp.asarray(feet.T)
        plan = schedule.plan(load_robot(case.robot), standing, own_parameters(case), gaits, case.time_step)
        now = schedule.schedule(plan, n)
        target = jnp.where(now.closed[:, None], standing, schedule.foot_targets(plan, now, standing))
        return target, schedule.base_reference(plan, now, schedule.planned_start(plan, now.cycle))

    with jax.enable_x64(True):
        targets, bases = map(np.asarray, jax.jit(jax.vmap(led))(jnp.asarray(steps)))
    data, still = mujoco.MjData(model), np.zeros((3, 4, 1))
    for n, target, base in zip(steps, targets, bases, strict=True):
        walker(int(n), walker.base[:, None], feet[:, :, None], still, still, still)
        joints = walker.torque[..., 0] / case.control.kp
        data.qpos[:7] = [*base, 1, 0, 0, 0]
        for limb, foot in enumerate(peers.FEET):
            begin = model.jnt_qposadr[model.body_jntadr[model.site(foot).bodyid[0]] - 2]
            data.qpos[begin : begin + 3] = joints[:, limb]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose([data.site(foot).xpos for foot in peers.FEET], target, atol=1e-9)


def test_a_peers_gripper_lets_go_above_the_largest_pull_of_the_stored_walk():
    case, own = self_check.SCENARIO, gains([(self_check.DAMPING, self_check.STIFFNESS)])
    pull = self_check.load()["walk"]["peak_pull_force"]
    for share, lost in ((1.000001, False), (0.999999, True)):
        peer = peers.Loop(case.with_overrides({"contact.holding_limit": pull * share}), own)
        peer.run(case.steps)
        assert peer.walker.lost.any() == lost


def test_accelerations_of_one_state_are_those_that_are_stored(monkeypatch):
    """Of MuJoCo's C code; engines and walk are made up, a metric has a derivative where it has decimals."""
    asked, stored = [], self_check.load()["acceleration"]
    base, spin, joints = np.split(np.array([*stored.values()]), [3, 6])

    def jvp(self, gains, along, *, dtype):
        asked.append((self.scenario, vars(gains), along, dtype))
        return {"travel": np.array([0.5]), "detached_limb": np.array([1])}, {"travel": np.array([[0.25]])}

    def forward_dynamics(state, *forces, engine):
        assert state.base_position.dtype == np.float64 and [np.shape(each) for each in forces] == [
            (12,),
            (4, 3),
            (6,),
            (),
        ]
        return types.SimpleNamespace(
            base_linear=base, base_angular=spin, joints=joints * (1 + 1e-6 * (engine == "mjx"))
        )

    monkeypatch.setattr(mc.Simulation, "jvp", jvp)
    monkeypatch.setattr(self_check, "forward_dynamics", forward_dynamics)
    found = self_check.measure()
    assert found.pop("walk") == {"travel": 0.5, "detached_limb": "LH"} and found.pop("gradient") == {"travel": 0.25}
    assert found.keys() == {*mc.ENGINES, "mujoco"}
    sizes = {name: each.size for name, each in self_check.deviations(found, self_check.load()).items()}
    assert sizes == {"limb": 0.0, "mjx": pytest.approx(1e-6), "mujoco": pytest.approx(0.0, abs=self_check.TOLERANCE)}
    ((scenario, values, along, dtype),) = asked
    assert scenario is self_check.SCENARIO and dtype is np.float64
    for name, value in (("inertia", 1.0), ("damping", 100.0), ("stiffness", 3000.0)):
        np.testing.assert_array_equal(values[name], np.full(6, value))
        assert name not in along or (along[name] == value).all()
    assert along.keys() == {"damping", "stiffness"}


def test_the_value_that_is_furthest_off_is_named_relative_to_the_stored_one():
    stored = {"walk": {"small": 1e-6, "large": 1e3, "limb": "LH", "none": None}, "acceleration": {"base x": -4.0}}
    near = {"small": 1e-6 * (1 + 2e-7), "large": 1e3 * (1 - 1e-7), "limb": "LH", "none": None, "new": 7.0}
    found = self_check.deviations({"walk": near, "mjx": {"base x": -4.0 - 4e-8}}, stored)
    assert found == {
        "walk": (pytest.approx(2e-7), "small", near["small"], 1e-6),
        "mjx": (pytest.approx(1e-8), "base x", -4.0 - 4e-8, -4.0),
    }
    for name, other in (("limb", "RF"), ("limb", None), ("none", 0.0), ("large", float("nan")), ("small", True)):
        worst = self_check.deviations({"walk": near | {name: other}}, stored)["walk"]
        assert worst[:2] == (float("inf"), name) and worst.stored == stored["walk"][name]


def test_a_gain_that_is_off_by_a_millionth_is_far_above_the_tolerance_and_rounding_far_below():
    stored = self_check.load()
    moved = [abs(slope / stored["walk"][name]) for name, slope in stored["gradient"].items() if stored["walk"][name]]
    assert 100 * 3e-14 < self_check.TOLERANCE < 1e-6 * max(moved) / 100


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


@pytest.mark.parametrize("cuda", [False, True])
def test_mujoco_warp_steps_so_many_robots_and_is_waited_for(monkeypatch, cuda):
    """By a stand-in for the package: on a GPU a step is captured after one that compiles, then launched."""
    told, capture = [], types.SimpleNamespace(graph="graph")

    def put_data(model, start, **how):
        told.append(("data", model, start.qpos.tolist(), start.qacc_smooth.any(), how))
        return "data"

    warp = types.SimpleNamespace(
        config=types.SimpleNamespace(), LOG_WARNING=30, get_device=lambda: types.SimpleNamespace(is_cuda=cuda),
        ScopedCapture=lambda: contextlib.nullcontext(capture), capture_launch=told.append,
        synchronize=lambda: told.append("waited"),
    )  # fmt: skip
    library = types.SimpleNamespace(
        put_model=lambda model: model, put_data=put_data, step=lambda model, data: told.append(("step", model, data))
    )
    monkeypatch.setitem(sys.modules, "warp", warp)
    monkeypatch.setitem(sys.modules, "mujoco_warp", library)
    case = self_check.SCENARIO
    peer = peers.Warp(case, 7)
    model = peer.model
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    assert (model.opt.disableflags & disabled, model.opt.timestep) == (disabled, case.time_step)
    assert model.opt.gravity.tolist() == [*case.gravity] and warp.config.log_level == 30
    step, rest = ("step", model, "data"), model.key_qpos[0].tolist()
    # forces have been worked out at the start
    assert told == [("data", model, rest, True, {"nworld": 7, "nconmax": 0, "njmax": 1}), *[step] * (1 + cuda)]
    told.clear()
    peer.run(3)
    assert told == ["graph" if cuda else step] * 3 + ["waited"]


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


@pytest.mark.parametrize(
    "changes",
    [
        {"control.controller": "pd"}, {"control.reading": "measured_pose"}, {"gait.base_reference": "actual"},
        {"gait.heading": 0.1}, {"gait.swing": "low_reaction"},
    ],
)  # fmt: skip
def test_peers_refuse_a_law_and_a_gait_that_they_do_not_know(changes):
    scenario = mc.load_scenario(CASE, changes)
    known = "base admittance with its virtual model" if "gait" not in next(iter(changes)) else "walk along x"
    with pytest.raises(ValueError, match=f"the NumPy peers (know )?{known}.* alone"):
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


def test_each_row_of_a_bench_is_another_number_and_says_which():
    names, labels, _, _ = zip(*machine.ROWS, strict=True)
    assert len({*names}) == len({*labels}) == len(names)
    for gains in ("2", "12"):
        assert [label for name, label in zip(names, labels, strict=True) if name == f"gradient_cost_{gains}"] == [
            f"value and gradient by {gains} gains, in values"
        ]


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


@pytest.fixture
def clock(monkeypatch):
    """A clock of `commands` that stands still, and goes on by what is added to `now`."""
    clock = types.SimpleNamespace(now=100.0)
    clock.time, clock.perf_counter = (lambda: 1e6 + clock.now), (lambda: clock.now)
    monkeypatch.setattr(commands, "time", clock)
    return clock


def test_a_wait_is_on_the_clock_and_of_processors_by_programs_and_for_them(monkeypatch, clock):
    """Of children alone: 3 s and 1 s of them on the clock, 0.5 s and 0.25 s, and as much again, of processors."""
    spent, folders = [9.0, 9.0, 0.0, 0.0, 0.0], []

    def run(command, *, env, cwd, **how):
        first = cwd not in folders
        folders.append(cwd)
        clock.now += 3.0 if first else 1.0
        for n in (2, 3):
            spent[n] += 0.5 if first else 0.25
        spent[0] += 7.0
        assert env["MJX_CLIMB_CACHE"] == f"{cwd}/cache"
        return types.SimpleNamespace(stdout="")

    monkeypatch.setattr(commands.subprocess, "run", run)
    monkeypatch.setattr(commands.os, "times", lambda: tuple(spent))
    found = commands.measure([commands.RUN, commands.HELP], lambda _: None)
    assert found == dict.fromkeys((commands.RUN, commands.HELP), (3.0, 1.0, 1.0, 0.5))
    assert folders[0] == folders[1] != folders[2] == folders[3]


def test_the_search_that_is_timed_has_the_gains_that_its_name_says():
    typed = commands.COMMANDS[commands.TUNE]
    layout = typed[typed.index("--space") + 1]
    case = mc.load_scenario(typed[typed.index("tune") + 1])
    assert commands.TUNE.endswith(", twelve gains") and space(case, Search(space=layout)).size == 12


def test_a_fresh_process_says_what_its_walk_or_its_gradient_took(monkeypatch, capsys, clock):
    """The first result with what is compiled for it, the same again, and when the first one was there."""
    asked, kept = [], signal.getsignal(signal.SIGINT)

    def waiting(name, took):
        def made(*given):
            asked.append((name, *given))
            clock.now += 5.0
            return lambda: setattr(clock, "now", clock.now + took.pop(0))

        return made

    monkeypatch.setattr(walks, "walk", waiting("walk", [3.0, 0.25]))
    monkeypatch.setattr(walks, "gradient", waiting("gradient", [7.0, 0.5]))
    found = []
    try:
        for what in ("value", "gradient"):
            clock.now = 100.0
            commands._time_a_walk(what, 5, 40, "mjx")
            found.append(json.loads(capsys.readouterr().out))
    finally:
        signal.signal(signal.SIGINT, kept)
    assert asked == [("walk", 5, 40, "mjx"), ("gradient", 2, 5, 40, "mjx")]
    assert found == [
        {"first": 8.0, "again": 0.25, "done": 1e6 + 108.0}, {"first": 12.0, "again": 0.5, "done": 1e6 + 112.0},
    ]  # fmt: skip


def test_times_of_a_fresh_process_count_from_before_it_starts(monkeypatch, clock):
    calls = []

    def run(command, *, env, **how):
        calls.append((command[1:], env["MJX_CLIMB_CACHE"], "JAX_COMPILATION_CACHE_DIR" in env))
        told = {"first": 3.0, "again": 1.0, "done": clock.time() + 5}
        clock.now += 20
        return types.SimpleNamespace(stdout=f"a line before\n{json.dumps(told)}\n")

    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    monkeypatch.setattr(commands.subprocess, "run", run)
    found = commands.compiled("gradient", 5, 40, "mjx", "cache")
    assert found == {"from_start": 5.0, "first": 3.0, "again": 1.0}
    assert calls == [(["-m", "tuning.benchmarks.commands", "gradient", "5", "40", "mjx"], "cache", False)]


def test_a_plan_has_batches_and_lengths_about_its_own_and_a_quick_one_has_none():
    """Medians are of one round: there is an odd number of them."""
    full, quick = measure.Plan.full(64), measure.Plan.quick(64)
    assert np.divide(full.batches, 64).tolist() == [0.25, 0.5, 1, 2, 4]
    assert np.divide(full.lengths, full.steps).tolist() == [0.25, 0.5, 1, 2]
    assert (quick.batches, quick.lengths, quick.adjoint, full.adjoint) == ((), (), False, True)
    assert [quick.tangents, full.tangents] == [(2,), (2, 12)]
    assert full.rounds % 2 and quick.rounds % 2 and 1 < quick.rounds < full.rounds
    assert (quick.steps, quick.peer_steps) == (full.steps / 2, full.peer_steps / 2)


def test_a_bench_says_on_which_processor_it_ran():
    model = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    machine = measure._machine()
    assert machine["processor"] == (model[0].split(": ", 1)[1].strip() if model else platform.processor())
    assert machine["versions"]["python"] == platform.python_version()
    assert machine["versions"]["numpy"] == np.__version__ and machine["versions"]["jax"] == jax.__version__


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


def test_each_figure_is_of_the_walks_that_its_name_says(monkeypatch):
    """Without walking: env-steps of a plan's runs by name, robots, steps and engines of each."""
    asked, closed = [], []

    def recorded(name):
        return lambda *given: asked.append((name, *given)) or (lambda *steps: asked.append((f"{name} ran", *steps)))

    def peer(name):
        def made(case, *rest):
            count = len(rest[0]["stiffness"]) if isinstance(rest[0], dict) else rest[0]
            asked.append((name, case.steps, count, *rest[1:]))
            return types.SimpleNamespace(
                run=recorded(f"{name} run"), pool=types.SimpleNamespace(close=lambda: closed.append(1))
            )

        return made

    def in_turns(rounds, work):
        asked.append(("turns", rounds, {name: steps for name, (steps, _) in work.items()}))
        for _, run in work.values():
            run()
        return {name: 1e-3 * (n + 1) for n, name in enumerate(work)}

    for name in ("walk", "gradient", "adjoint"):
        monkeypatch.setattr(measure, name, recorded(name))
    for name in ("Rollout", "Batch", "Loop"):
        monkeypatch.setattr(peers, name, peer(name))
    monkeypatch.setattr(measure, "in_turns", in_turns)
    monkeypatch.setattr(measure, "operations_of", lambda engine, batch, steps: {"operations": (engine, batch, steps)})
    monkeypatch.setattr(
        commands, "compiled", lambda *given: asked.append(given) or dict(first=1, again=0, from_start=2)
    )
    plan = measure.Plan(5, 40, 20, (2, 12), True, (2, 8), (10, 80))
    result = measure.measure("limb", 8, plan, lambda _: None)
    turns = [each[1:] for each in asked if each[0] == "turns"]
    ours = {"closed_loop": 320, "mjx": 160, "value": 160, "gradient_2": 160, "gradient_12": 80, "adjoint": 160}
    assert turns == [
        (5, ours | {"mujoco_c": 160, "mujoco_batch": 80}), (5, {"single": 8000, "numpy_loop": 20}),
        (2, {"2": 80, "8": 320}), (2, {"10": 80, "80": 640}),
    ]  # fmt: skip
    begun = [each for each in asked if not each[0].endswith(("ran", "turns"))]
    assert begun[:3] == [
        (what, 8, steps, "limb", begun[0][4]) for what, steps in (("value", 40), ("value", 40), ("gradient", 20))
    ]
    cores = measure.devices.usable_cores()
    assert begun[3:] == [
        ("walk", 8, 40, "limb"), ("walk", 8, 20, "mjx"), ("walk", 8, 20, "limb"), ("gradient", 2, 8, 20, "limb"),
        ("gradient", 12, 8, 10, "limb"), ("adjoint", 8, 20, "limb"), ("Rollout", 40, 8, 20, cores),
        ("Batch", 40, 8, cores), ("Loop", 20, 1), ("walk", 1, 8000, "limb"), ("Rollout run",),
        ("Batch run", 10), ("Loop run", 20),
        ("walk", 2, 40, "limb"), ("walk", 8, 40, "limb"), ("walk", 8, 10, "limb"), ("walk", 8, 80, "limb"),
    ]  # fmt: skip
    assert closed == [1] and result["operations"] == ("limb", 8, 40)
    assert result["seconds_by_batch"] == {"2": pytest.approx(0.08), "8": pytest.approx(0.64)}
    assert result["batch_exponent"] == pytest.approx(1.5) and result["step_exponent"] == pytest.approx(4 / 3)
    assert {n: result[f"gradient_cost_{n}"] for n in (2, 12)} == {2: pytest.approx(4 / 3), 12: pytest.approx(5 / 3)}


def test_what_is_timed_are_the_calls_of_a_user(monkeypatch):
    """Gains of a sweep, a cargo from the start, derivatives along the logarithms of damping and stiffness."""
    asked = []

    def rollout_metrics(scenario, gains, **how):
        asked.append((scenario.steps, scenario.disturbance.cargo.start, gains.stiffness[:, 0], how))

    def vjp(self, gains, cotangents):
        asked.append((self.scenario.steps, gains.damping, cotangents))

    def jvp(self, gains, along):
        asked.append((self.scenario.steps, vars(gains), along))

    monkeypatch.setattr(mc, "rollout_metrics", rollout_metrics)
    monkeypatch.setattr(mc.Simulation, "vjp", vjp)
    monkeypatch.setattr(mc.Simulation, "jvp", jvp)
    for run in (
        walks.walk(3, 20, "mjx"),
        walks.adjoint(3, 20, "limb"),
        walks.gradient(2, 3, 20, "limb"),
        walks.gradient(12, 3, 20, "limb"),
    ):
        run()
    (steps, start, stiffness, how), (_, damping, cotangents), two, twelve = asked
    assert (steps, start, how) == (20, 0.0, {"dtype": np.float32, "engine": "mjx"}) and (damping == 1e3).all()
    np.testing.assert_allclose(stiffness, [1e3, 1e4, 1e5])
    assert cotangents.keys() == {"force_variation"} and cotangents["force_variation"].tolist() == [[1.0, 1.0, 1.0]]
    for (steps, gains, along), count in ((two, 2), (twelve, 12)):
        assert steps == 20 and along.keys() == {"damping", "stiffness"}
        both = np.concatenate([along["damping"] / gains["damping"], along["stiffness"] / gains["stiffness"]], axis=-1)
        rows = np.repeat(np.eye(2), 6, axis=1) if count == 2 else np.eye(12)
        np.testing.assert_allclose(both, np.broadcast_to(rows[:, None], (count, 3, 12)))


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
