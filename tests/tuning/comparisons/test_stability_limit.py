"""The limit of stability: what it calls unstable diverges, what it calls stable does not; and maps that show it."""

import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import LoadTransfer, VirtualModelAdmittance
from mjx_climb.hardware import bus
from mjx_climb.hardware.sensors import ForceSensor
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import growth
from mjx_climb.viz import plots
from mjx_climb.walk import control_loop
from tuning.comparisons import maps, stability_limit
from tuning.searches.sweep import sweep


def swept(stiffness, damping):
    """What a sweep returns, as far as the limit reads it: the axes of its walks, in their order."""
    none = np.zeros((len(stiffness), len(damping)), bool)
    return xr.Dataset({"diverged": (("stiffness", "damping"), none)}, {"stiffness": stiffness, "damping": damping})


@pytest.mark.nightly
@pytest.mark.slow
def test_a_walk_diverges_where_the_loop_is_unstable(case):
    """The measured pose holds with the paper's damping and loses its stability before damping M / dt twenty-fold."""
    scenario = case("case_2", "measured_pose", {"duration": 1.0, "contact.holding_limit": None})
    walks = swept([5e5], [5e3, 8e3, 1.9e4, 3e4])
    radius = maps.with_stability(walks, scenario)["spectral_radius"]
    assert radius.dims == ("stiffness", "damping")
    gains = mc.Gains(1.0, walks["damping"].values[:, None], 5e5)
    found = mc.rollout_metrics(scenario, gains, dtype=np.float64)
    lost = found["diverged"] | (found["peak_foot_force"] > 1e3)
    assert (radius.values[0] > 1 + 1e-6).tolist() == lost.tolist() == [False, False, True, True]


def test_a_large_map_has_the_limit_at_some_of_its_cells(case, monkeypatch):
    monkeypatch.setattr(
        stability_limit, "spectral_radius", lambda scenario, gains, *_, law, engine: gains["damping"][:, 0] / 1e2
    )
    walks = swept(np.geomspace(1e2, 1e4, 200), np.geomspace(1e1, 1e3, 3))
    walks["stiffness"].attrs["units"] = "N/m"
    with_radius = maps.with_stability(walks, case("case_2", "virtual_model"))
    radius = with_radius["spectral_radius"]
    assert with_radius["stiffness"].attrs == {"units": "N/m"}
    assert radius.shape == (200, 3) and np.isfinite(radius[[0, -1]]).all()
    known = radius.dropna("stiffness")
    assert known.sizes["stiffness"] == 16
    np.testing.assert_allclose(known, np.broadcast_to(walks["damping"] / 1e2, known.shape))


def test_stances_begin_halve_and_end_the_times_in_which_the_same_feet_hold(case):
    """Two steps clear of where that changes; where the law is worked out; on uneven ground in each cycle of two."""
    turn = case("case_1_2", "virtual_model")
    ends = [[2, 998], [1002, 1998], [2002, 2998], [3002, 3998]]
    expected = np.sort([at for first, last in ends for at in (first, (first + last) // 2, last)])
    found = np.sort(stability_limit.linearised_at(turn, np.array([1]), uneven=True))
    np.testing.assert_array_equal(found, [[*expected, *(expected + 4000)]])
    slow = stability_limit.linearised_at(turn, np.array([1, 8]), uneven=False)[1]
    assert not (slow % 8).any() and ((np.sort(slow).reshape(4, 3) // 1000).T == np.arange(4)).all()
    standing = stability_limit.linearised_at(turn.with_overrides({"gait.duty": 0.8}), np.array([1]), uneven=False)
    assert {802, 900, 998} < {*standing[0]}  # between two swings of 800 steps


@pytest.mark.nightly
def test_grips_that_keep_attitudes_are_in_the_loop(case):
    """Held too stiffly for the time step, feet shake about as fast as the check of the time step says of its stance."""
    scenario = case("case_1_2", "virtual_model", {"control.controller": "pd", "contact.rotational_stiffness": 1.0})
    stiffness = np.array([1.0, 3e3])
    parameters = own_parameters(scenario).replace({"contact.rotational_stiffness": stiffness})
    radius = stability_limit.spectral_radius(scenario, {"kp": 50.0, "kd": 0.2}, parameters)
    contact = scenario.contact.model_copy(update={"rotational_stiffness": 3e3})
    assert radius[0] < 1
    np.testing.assert_allclose(radius[1], growth(scenario.model_copy(update={"contact": contact})), rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "reading", "stiffness", "damping", "least"),
    [
        ("case_1_2", "measured_pose", 1e5, 1.3e4, 1.04),
        pytest.param("case_2", "virtual_model", 2e4, 7.4, 1.002, marks=pytest.mark.nightly),
    ],
)
def test_a_loop_that_is_stable_in_the_first_mid_swing_alone_is_unstable(case, name, reading, stiffness, damping, least):
    """Walks with these gains reach 3,070 and 11,344 N of force variation, where pd has 100 and 131."""
    scenario, gains = case(name, reading), mc.Gains(1.0, damping, stiffness)
    radii = stability_limit.by_stance(scenario, gains)
    first_middle = radii.reshape(-1, 3, 4)[:, 1, 0]
    assert first_middle.max() < 1 and stability_limit.spectral_radius(scenario, gains) == radii.max() > least


@pytest.mark.nightly
def test_the_worst_stance_is_the_limit_of_walks_and_all_feet_count_where_the_gait_has_them(case):
    """K 3e3, D 150: a walk loses a gripper at 9.54 ms of delay, and diverges at 7 ms where it pauses on all feet."""
    turn, gains = case("case_1_2", "virtual_model"), mc.Gains(1.0, 150.0, 3e3)
    late = own_parameters(turn).replace(
        {"hardware.force_sensor.delay": np.array([5.9e-3, 7e-3, 8.9e-3, 9.37e-3, 10.377e-3])}
    )
    assert (stability_limit.spectral_radius(turn, gains, late) > 1).tolist() == [False, False, False, True, True]
    pauses = case("case_1_2", "virtual_model", {"gait.duty": 0.875})
    late = own_parameters(pauses).replace({"hardware.force_sensor.delay": late.force_sensor.delay})
    assert (stability_limit.spectral_radius(pauses, gains, late) > 1).tolist() == [False, True, True, True, True]


@pytest.fixture
def asked(monkeypatch):
    """Have radii counted, not computed; return what they are asked for."""
    kept = []

    def radii_of(walk, robots, axes, delays, periods, first, *, stances):
        assert len(periods) % stances == 0
        kept.append((walk, *robots, delays, periods, first))
        return np.arange(float(len(periods)))

    monkeypatch.setattr(stability_limit, "radii_of", radii_of)
    return kept


SOFT = mc.Gains(1.0, 100.0, np.array([[1e3] * 6, [2e3] * 6]))
BEGIN, MIDDLE, END = [4, 1004, 2004, 3004], [500, 1500, 2500, 3500], [992, 1992, 2992, 3992]  # of a period of 4 ms


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_a_loop_is_looked_at_in_each_stance_without_cargo_and_with_it(interpolation, asked):
    """Without weight and pushes, and without what is not linear: its cargo is there all the time, its law unbounded."""
    changes = {
        "hardware.force_sensor.delay": 0.0025, "hardware.control_period": 0.004, "hardware.force_sensor.noise": 0.1,
        "hardware.interpolation": interpolation, "control.deadband": 0.3, "control.max_offset": 0.01,
        "control.max_velocity": 0.1, "contact.capture_distance": 0.005, "disturbance.cargo.start": 1.0,
        "disturbance.cargo.stop": 2.0, "disturbance.cargo.mass": 1.5, "control.kp": 40.0,
        "disturbance.pushes": [{"force": [1, 0, 0], "start": 0.5, "stop": 0.6}],
    }  # fmt: skip
    scenario = mc.load_scenario("case_1_2", changes)
    found = stability_limit.by_stance(scenario, SOFT)
    np.testing.assert_array_equal(found, np.arange(48.0).reshape(2, 24))
    stability_limit.by_stance(scenario, SOFT, only=13)
    for (walk, law, parameters, delays, periods, first), rows in zip(asked, (slice(None), [13, 37]), strict=True):
        np.testing.assert_array_equal(first, np.tile([*BEGIN, *MIDDLE, *END], 4)[rows])
        np.testing.assert_array_equal(
            parameters.at("disturbance.cargo.mass"), np.tile(np.repeat([0, 1.5], 12), 2)[rows]
        )
        np.testing.assert_array_equal(law.stiffness[:, 0], np.repeat([1e3, 2e3], 24)[rows])
        assert law.damping.shape == (len(first), 6) and (periods == 4).all() and len(periods) == len(first)
        assert [*delays] == ["force"] and delays["force"] == pytest.approx(np.full(len(first), 2.5))
        assert parameters.at("hardware.force_sensor.delay") == pytest.approx(np.full(len(first), 1e-3))
        assert not np.any(parameters.gravity) and len(parameters.disturbances) == 1
        cargo = [float(parameters.at(f"disturbance.cargo.{name}")) for name in ("start", "stop")]
        assert [*cargo, float(parameters.at("contact.capture_distance"))] == [0.0, np.inf, np.inf]
        assert set(np.ravel(parameters.at("control.kp"))) == {40.0}
        motion, stages = law.motion, walk.stages
        assert (motion.deadband, motion.max_offset, motion.max_velocity) == ((0, 0), (np.inf,) * 2, (np.inf,) * 2)
        assert stages.linear is (interpolation == "linear") and stages.control_period and not stages.force_noise
        assert (stages.force_delay, stages.base_delay, stages.command_delay) == (2, 0, 0)


def test_a_loop_has_the_stages_of_hardware_that_is_varied_besides(asked):
    """None of these late, and a period of one time step; without cargo half as many stances."""
    scenario = mc.load_scenario("case_1_2", {"disturbance.cargo.mass": 0.0})
    radius = stability_limit.spectral_radius(scenario, SOFT)
    assert radius.tolist() == [11.0, 23.0] and stability_limit.by_stance(scenario, SOFT, only=2).shape == (2, 1)
    stability_limit.by_stance(scenario, SOFT, hardware=stability_limit.HARDWARE)
    plain, one, every = ((walk.stages, delays, periods, first) for walk, _, _, delays, periods, first in asked)
    for stages, delays, periods, _ in (plain, one):
        late = (stages.force_delay, stages.base_delay, stages.command_delay)
        assert late == (0, 0, 0) and not stages.control_period and not delays and (periods == 1).all()
    assert one[3].tolist() == [2002, 2002]
    stages, delays, periods, first = every
    assert (stages.force_delay, stages.base_delay, stages.command_delay, stages.control_period) == (2, 2, 2, True)
    assert [*delays] == ["base", "command", "force"] and not np.any([*delays.values()])
    assert not stages.linear and (periods == 1).all() and first.tolist() == plain[3].tolist()


def test_the_radius_is_that_of_one_step_whatever_the_period():
    """Of turns that shrink what they turn, the first step of a period more than the others, beside a state alone."""
    turn = np.zeros((3, 3))
    turn[:2, :2], turn[2, 2] = [[0.6, 0.8], [-0.8, 0.6]], 0.3
    periods = np.array([1, 2, 5])
    steps = [np.stack([share * turn] * 4) for share in (0.5, 0.9)]  # a row more than there are robots
    expected = (0.5 * 0.9 ** (periods - 1)) ** (1 / periods)
    np.testing.assert_allclose(stability_limit._radii(steps, periods), expected)
    steps[0][:, 2, 2] = 1.8  # a state that acts on itself alone grows
    expected = (1.8 * 0.27 ** (periods - 1)) ** (1 / periods)
    np.testing.assert_allclose(stability_limit._radii(steps, periods)[:2], np.maximum(expected[:2], [0.5, 0.45**0.5]))
    steps[1][1, 0, 0] = np.nan
    assert np.isinf(stability_limit._radii(steps, periods)).tolist() == [False, True, False]


def stepped(whole, core, sizes, weights):
    """The values of a loop after a step: the rest, then the samples of two signals, the newest of each first."""
    first, second, rest = sizes
    rows = [len(weight) - 1 for weight in weights]
    rest, *kept = np.split(whole, np.cumsum([rest, rows[0] * first]))
    kept = [samples.reshape(row, size) for samples, row, size in zip(kept, rows, sizes, strict=False)]
    late = [weight[1:] @ samples for weight, samples in zip(weights, kept, strict=True)]
    end = first + second
    later = late[1] + weights[1][0] * (rest @ core[end:, first:end])
    sooner = late[0] + weights[0][0] * (later @ core[first:end, :first] + rest @ core[end:, :first])
    new = np.concatenate([sooner, later, rest]) @ core
    after = [
        np.concatenate([each[None], old])[: len(old)]
        for each, old in zip((new[:first], new[first:end]), kept, strict=True)
    ]
    return np.concatenate([new[end:], *(each.ravel() for each in after)])


@pytest.mark.parametrize("delayed", list(itertools.product((False, True), repeat=4)))
def test_the_newest_samples_are_taken_out_of_a_memory_and_put_back_for_all(delayed):
    """Buffers of what comes late are states by themselves; what does not stays where it is."""
    force, base, command, reports = delayed
    rng = np.random.default_rng(0)

    def buffer(size):
        return tuple(rng.normal(size=(3, size)))

    sensor = ForceSensor(*[None] * len(ForceSensor._fields))._replace(buffer=buffer(2))
    of_reports = control_loop.Reports((buffer(1), buffer(4)), rng.normal(size=2)) if reports else None
    memory = control_loop.Memory(*[None] * len(control_loop.Memory._fields))._replace(
        law=1.0, force_sensor=sensor, base_estimate=(buffer(3), buffer(4)), targets=buffer(5),
        joint_gains=(buffer(2), buffer(6)), reports=of_reports,
    )  # fmt: skip
    stages = types.SimpleNamespace(force_delay=force, base_delay=base, command_delay=command)
    samples, rest = stability_limit._taken(memory, types.SimpleNamespace(stages=stages))
    assert samples.keys() == {name for name, late in (("force", force), ("base", base), ("command", command)) if late}
    assert rest.force_sensor.buffer == (() if force else sensor.buffer) and rest.law == 1.0
    assert rest.base_estimate == (() if base else memory.base_estimate)
    assert (rest.targets, rest.joint_gains) == (((), ()) if command else (memory.targets, memory.joint_gains))
    if force:
        assert samples["force"] is sensor.buffer[0]
    if base:
        assert [each is own[0] for each, own in zip(samples["base"], memory.base_estimate, strict=True)] == [True] * 2
    if command:
        targets, gains, reported = samples["command"]
        assert targets is memory.targets[0]
        assert [id(each) for each in gains] == [id(own[0]) for own in memory.joint_gains]
        assert [id(each) for each in reported] == [id(own[0]) for own in (of_reports.buffers if reports else ())]
        assert rest.reports is None if not reports else rest.reports.buffers == ()
    back = stability_limit._put(rest, samples)

    def ids(own):
        return tuple(map(id, own))

    def twice(own):
        return ids((own[0], own[0]))

    assert ids(back.force_sensor.buffer) == (twice if force else ids)(sensor.buffer)
    for own, were in zip(back.base_estimate, memory.base_estimate, strict=True):
        assert ids(own) == (twice if base else ids)(were)
    assert ids(back.targets) == (twice if command else ids)(memory.targets)
    for own, were in zip(back.joint_gains, memory.joint_gains, strict=True):
        assert ids(own) == (twice if command else ids)(were)
    if reports:
        assert back.reports.torque is of_reports.torque
        for own, were in zip(back.reports.buffers, of_reports.buffers, strict=True):
            assert ids(own) == (twice if command else ids)(were)
    else:
        assert back.reports is None


@pytest.mark.parametrize("linear", [False, True])
def test_radii_are_those_of_loops_that_are_stepped_one_by_one(linear, monkeypatch):
    """More robots than are linearised at once; some differ in their delays or their periods alone."""
    rng, sizes, count = np.random.default_rng(1), {"base": (2,), "force": (3, 1), "rest": (4,)}, 1200
    parts = 0.4 * rng.normal(size=(4, 9, 9))
    parts[:, :2, :5] = parts[:, 2:5, 2:5] = (
        0.0  # transposed: the first acts on no signal, the second on the first alone
    )
    given = {"k": rng.uniform(size=count), "m": rng.choice([0.2, 0.9], size=(count, 2)), "own": np.array([0.3, 0.4])}
    given["k"][600:] = given["k"][:600]
    axes = ({"k": 0}, {"m": 1, "own": 1})
    first, periods = rng.choice([40, 47], size=count), rng.integers(1, 5, size=count)
    given["m"][600:], first[600:] = given["m"][:600], first[:600]
    delays = {"force": rng.choice([0.0, 0.4, 2.3], size=count), "base": rng.choice([1.0, 1.5], size=count)}
    asked = []

    def core_of(k, m, own, step):
        each = parts[0] + parts[1] * k[..., None, None] + parts[2] * (m @ own)[..., None, None]
        return each + 0.1 * parts[3] * (step[..., None, None] % 7)

    def shapes_of(_, walk, off, law, parameters, step):
        assert (off.shape, step.shape, step.dtype) == ((), (), np.int32) and law["k"].shape == ()
        assert {name: value.shape for name, value in parameters.items()} == {"m": (2,), "own": (2,)}
        return sizes

    def run(_, walk, robots, *, batch_size, compile_briefly):
        still, law, parameters, step = robots.arguments
        asked.append((len(step), batch_size, len(np.unique(law["k"]))))
        assert robots.axes == (1, *axes, 0) and not still.any() and step.dtype == np.int32 and compile_briefly
        after = np.asarray(robots.directions) @ core_of(law["k"], parameters["m"], parameters["own"], step)
        return None, dict(zip(sizes, np.split(after, [2, 5], axis=-1), strict=True))

    monkeypatch.setattr(stability_limit.execution, "shapes_of", shapes_of)
    monkeypatch.setattr(stability_limit.execution, "run", run)
    walk = types.SimpleNamespace(stages=types.SimpleNamespace(linear=linear))
    robots = {"k": given["k"]}, {"m": given["m"], "own": given["own"]}
    found = stability_limit.radii_of(walk, robots, axes, delays, periods, first)
    cores = len({(k, *m, at) for k, m, at in zip(given["k"], given["m"].tolist(), first, strict=True)})
    assert {each[1] for each in asked} == {16} and cores == 600
    assert [each[0] for each in asked] == [512] * (4 if linear else 2) + [88] * (4 if linear else 2)
    for row in [0, 599, 600, 1199, *rng.integers(count, size=12)]:
        weights = [
            bus.weights(jnp.asarray(delays[name][row]), int(np.ceil(delays[name][row])) + 1)
            for name in ("base", "force")
        ]
        weights = [np.asarray(weight) for weight in weights]
        states = 4 + 2 * (len(weights[0]) - 1) + 3 * (len(weights[1]) - 1)
        whole = np.eye(states)
        for step in range(periods[row]):
            kind = step if linear else min(step, 1)
            core = core_of(given["k"][row], given["m"][row], given["own"], first[row] + np.array(kind))
            whole = np.stack([stepped(each, core, (2, 3, 4), weights) for each in whole])
        expected = np.abs(np.linalg.eigvals(whole)).max() ** (1 / periods[row])
        assert found[row] == pytest.approx(expected, rel=1e-6), row


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize("linear", [False, True])
def test_radii_of_a_map_are_those_of_robots_one_by_one(alike, linear, monkeypatch):
    """Of Jacobians that are sums of three by the same weights in every stance, and where one stance is an exception.

    Few are asked for in the first case. Delays are the axis of a map too: robots that differ in them alone.
    """
    rng, cells, stances = np.random.default_rng(2), 40, 5
    parts = 0.4 * rng.normal(size=(stances, 3, 6, 6))
    parts[:, :, :2, :2] = 0.0
    gains, asked = np.resize(rng.uniform(size=(20, 2)), (cells, 2)), []

    def core_of(k, m, step):
        stance, kind = np.divmod(step, 100)
        weights = np.stack([np.ones_like(k), k + m**2, 1e-5 * k * m], axis=1)
        if not alike:
            weights[:, 1] += np.where(stance == 3, k**3, 0.0)
        return np.einsum("cf,cfij->cij", weights, parts[stance]) * (1 + 0.1 * kind[:, None, None])

    def run(_, walk, robots, *, batch_size, compile_briefly):
        _, law, parameters, step = robots.arguments
        asked.append(len(step))
        after = core_of(law["k"], parameters["m"], step)
        return None, dict(zip(sizes, np.split(after, [2], axis=-1), strict=True))

    sizes = {"force": (2,), "rest": (4,)}
    monkeypatch.setattr(stability_limit.execution, "shapes_of", lambda *_: sizes)
    monkeypatch.setattr(stability_limit.execution, "run", run)
    k, m = np.repeat(gains, stances, axis=0).T
    first, delays = (
        np.tile(100 * np.arange(stances), cells),
        np.repeat(np.where(np.arange(cells) < 20, 0.4, 2.3), stances),
    )
    walk, periods = types.SimpleNamespace(stages=types.SimpleNamespace(linear=linear)), np.full(len(k), 3)
    found = stability_limit.radii_of(
        walk, ({"k": k}, {"m": m}), ({"k": 0}, {"m": 0}), {"force": delays}, periods, first, stances=stances
    )
    kinds = 3 if linear else 2
    assert (sum(asked) < kinds * (20 + 4 * 7)) == alike
    for row in range(0, len(k), 7):
        weights = stability_limit._weights(delays[row])
        whole = np.eye(4 + 2 * (len(weights) - 1))
        for step in range(3):
            core = core_of(k[[row]], m[[row]], first[[row]] + (step if linear else min(step, 1)))
            whole = whole @ stability_limit._with_delays(core, (2, 4), [weights])[0]
        assert found[row] == pytest.approx(np.abs(np.linalg.eigvals(whole)).max() ** (1 / 3), rel=1e-9), row


@pytest.mark.parametrize("delays", [(0.0, 2.6), (0.3, 1.0), (0.0, 0.0)])
def test_delays_are_put_around_a_loop_that_is_one_step_late(delays):
    """Two signals, the first made of the second within the step: as if samples were kept and read one by one."""
    rng, sizes = np.random.default_rng(0), (2, 3, 4)
    core = rng.normal(size=(9, 9))
    core[:2, :5] = core[2:5, 2:5] = 0.0  # transposed: the first acts on no signal, the second on the first alone
    weights = [stability_limit._weights(delay) for delay in delays]
    for delay, found in zip(delays, weights, strict=True):
        np.testing.assert_allclose(found, bus.weights(jnp.asarray(delay), len(found)), atol=1e-12)
    (found,) = stability_limit._with_delays(core[None], sizes, weights)
    whole = rng.normal(size=len(found))
    np.testing.assert_allclose(whole @ found, stepped(whole, core, sizes, weights), atol=1e-12)


@pytest.mark.nightly
@pytest.mark.slow
def test_one_program_serves_whatever_part_of_the_hardware_gets_worse(case, monkeypatch):
    scenario, gains, run, programs = case("case_1_2", "virtual_model"), mc.Gains(1.0, 150.0, 3e3), execution.run, set()

    def recorded(function, structure, robots, **how):
        leaves = [jax.tree.leaves(each) for each in (robots.arguments, robots.axes)]
        kinds = [(value.shape[value.ndim - own :], value.ndim > own) for value, own in zip(*leaves, strict=True)]
        programs.add((function, structure, tuple(kinds), tuple(how.items())))
        return run(function, structure, robots, **how)

    def radius(changed):
        parameters = own_parameters(scenario).replace(changed)
        return stability_limit.by_stance(scenario, gains, parameters, only=0, hardware=hardware)

    monkeypatch.setattr(stability_limit.execution, "run", recorded)
    hardware = stability_limit.HARDWARE
    late = np.array([0.0, 3.4e-3])
    by_delay = radius({"hardware.force_sensor.delay": late, "hardware.base_estimate.delay": late})
    others = [
        radius({"hardware.command_delay": late}), radius({"hardware.control_period": np.array([1e-3, 8e-3])}),
        radius({"control.kp": np.array(50.0)}),
    ]  # fmt: skip
    assert len(programs) == 1
    hardware = ()  # what there is not is not in the loop
    np.testing.assert_allclose([each.ravel()[0] for each in (by_delay, *others)], radius({}).item(), rtol=1e-9)
    assert len(programs) == 2 and abs(by_delay[1, 0] / by_delay[0, 0] - 1) > 1e-4


@pytest.mark.parametrize("shape", [(), (2,)])
def test_one_robot_and_a_batch_are_looked_at_over_their_control_period(case, monkeypatch, shape):
    monkeypatch.setattr(
        stability_limit, "radii_of", lambda walk, robots, axes, delays, periods, first, **_: 1.0 * periods
    )
    scenario = case("case_2", "virtual_model", {"hardware.control_period": 0.004})
    found = stability_limit.spectral_radius(scenario, mc.Gains(np.ones((*shape, 6)), 150.0, 3000.0))
    np.testing.assert_array_equal(found, np.full(shape, 4.0))  # steps


@pytest.mark.nightly
def test_a_disturbance_grows_by_the_radius_where_forces_come_late(case, monkeypatch):
    """Soft gains, a law at 250 Hz, a cargo from the start: 5 ms of delay are borne, 15 ms are not.

    In the first swing, which the walk does not leave.
    """
    monkeypatch.setattr(stability_limit, "linearised_at", lambda _, periods, uneven: np.full((len(periods), 1), 500.0))
    push = {"force": [1.0, 1.0, 1.0], "moment": [0.1, 0.1, 0.1], "start": 0.2, "stop": 0.22}
    still = {"gait.stride": 1e-4, "gait.step_height": 0.01, "duration": 1.0, "contact.holding_limit": None}
    loaded = {"disturbance.pushes": [push], "disturbance.cargo": {"mass": 1.0, "start": 0.0}}
    scenario = case("case_2", "virtual_model", still | loaded | {"hardware.control_period": 0.004})
    gains = mc.Gains(1.0, 150.0, 3000.0)
    with jax.enable_x64(True):
        parameters = jax.tree.map(np.asarray, mc.parameters(scenario))
    late = parameters.replace({"hardware.force_sensor.delay": np.array([5e-3, 15e-3])})
    radius = stability_limit.spectral_radius(scenario, gains, late)
    force = mc.rollout_histories(scenario, gains, late, dtype=np.float64)["foot_force_history"][:, 1]
    early, end = force[:, 80:120].max(1), force[:, 160:].max(1)  # of 200 stretches
    assert radius[0] < 0.995 and force[0, 160:].max() < 0.5 * force[0, 40:60].max()
    assert (end[1] / early[1]) ** (1 / 400) - 1 == pytest.approx(radius[1] - 1, rel=0.1)
    assert radius[1] > 1.004


@pytest.mark.nightly
def test_a_law_whose_sensors_may_die_is_in_the_loop(case):
    """No force is no dead sensor: feet that give way much faster than their grips and forces allow are unstable."""
    sensor = {"delay": 0.005, "resolution": 0.1, "dead": {"LF": 0.0}}
    scenario = case("case_1_1", "pd", {"hardware.control_period": 0.005, "hardware.force_sensor": sensor})
    gains = {name: np.array([200.0, 1.0]) for name in ("normal_damping", "tangential_damping")}
    radius = stability_limit.by_stance(scenario, gains, only=0, law=LoadTransfer())[:, 0]
    assert radius[0] < 1 < 1.01 < radius[1]


class Rewritten(VirtualModelAdmittance):
    """The same law, whose step hands on as a new value what it leaves as it is."""

    def step(self, mass, measured, reference):
        return super().step(jax.tree.map(lambda value: value * 1, mass), measured, reference)


@pytest.mark.nightly
@pytest.mark.slow
def test_what_a_law_hands_on_as_a_new_value_is_no_state(case):
    """As a state it had an eigenvalue of one, which is no growth of the walk."""
    scenario, gains = case("case_1_1", "pd"), {"damping": 150.0, "stiffness": 3e3}
    laws = VirtualModelAdmittance(), Rewritten()
    found = [stability_limit.by_stance(scenario, gains, only=0, law=law) for law in laws]
    np.testing.assert_allclose(*found, rtol=1e-6)
    assert (found[0] < 0.9999).all()


def made(radius):
    cells = np.arange(6.0).reshape(3, 2)
    data = {"objective": (("stiffness", "damping"), cells), "spectral_radius": (("stiffness", "damping"), radius)}
    data["feasible"] = (("stiffness", "damping"), cells > 1)
    return xr.Dataset(data, {"stiffness": [1e2, 1e3, 1e4], "damping": [1e0, 1e1]})


def test_best_cell_keeps_every_limit():
    judged = made(np.full((3, 2), 0.9))
    cell = maps.best_cell(judged)
    assert (float(cell["stiffness"]), float(cell["damping"])) == (1e3, 1e0)
    assert maps.best_cell(judged.assign(feasible=judged["feasible"] & False)) is None


def test_a_map_shows_where_the_loop_turns_unstable():
    legends = {}
    for name, radius in (("some", [[1.1, 0.9], [0.9, 0.9], [np.inf, 0.9]]), ("none", np.full((3, 2), 0.9))):
        figure = plots.plot_map(made(np.asarray(radius)), "objective")
        legends[name] = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert legends == {"some": ["stability limit"], "none": []}


@pytest.mark.nightly
def test_a_sweep_gets_its_objective_and_radius(case):
    scenario = case("case_2", "virtual_model", {"duration": 0.2})
    swept = sweep(scenario, {"stiffness": [1e3, 1e6], "damping": [1e0, 1e2, 1e4]}).data
    judged = maps.with_stability(maps.with_objective(swept, scenario), scenario)
    assert judged["objective"].dims == judged["spectral_radius"].dims == ("stiffness", "damping")
    assert judged["objective"].sel(stiffness=1e6, damping=1e4) == pytest.approx(1.0, abs=0.01)  # as good as rigid
    unstable = judged["spectral_radius"] > 1
    assert unstable.sel(stiffness=1e6, damping=1e0) and not unstable.sel(damping=1e4).any()
