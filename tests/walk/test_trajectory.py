"""What a trajectory and the metrics of grips and sensors tell of made-up histories, against loops over their steps."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb import simulation
from mjx_climb.control import law_of
from mjx_climb.control.sensor_watch import SILENCE
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.trajectory import Trajectory, named
from mjx_climb.walk.metrics import GRIPS, SENSORS, Context, accumulate, failed, finish, start
from mjx_climb.walk.sample import DIMS, Sample, unknown
from mjx_climb.walk.structure import structure
from mjx_climb.walks import LINES, STRETCHES, histories_of, samples_of, stretches, together
from mjx_climb.walks import histories as extremes

STEP, STEPS, LIMBS = 0.01, 40, ("LF", "LH", "RH", "RF")


def histories(seed):
    """Histories of a robot whose feet let go, stand for want of a grip and lose their sensors at random."""
    rng = np.random.default_rng(seed)
    made = {name: rng.normal(size=values.shape) if values.dtype != bool else values
            for name, values in unknown(STEPS, {"limb": 4, "joint": 3}).items()}  # fmt: skip
    none = np.zeros((STEPS, 4), bool)
    for name in ("support", "missed", "stands", "sensor_lost"):
        share = {"support": 0.05, "missed": 0.02, "stands": 0.5, "sensor_lost": 0.01}[name]
        made[name] = none | (rng.uniform(size=none.shape) < share * rng.integers(0, 2))
    made["sensor_lost"] = np.maximum.accumulate(made["sensor_lost"], axis=0)
    for limb in range(4):
        if rng.uniform() < 0.5:  # stands at the walk's end
            made["stands"][rng.integers(1, STEPS) :, limb] = True
    if rng.uniform() < 0.3:
        made["support"][-1, 2] = True
    gap = np.abs(made["grip_gap"])
    made["grip_gap"] = np.where(rng.uniform(size=gap.shape) < 0.3, np.nan, gap)
    made["grip_gap"][0, 0] = 1e-3
    made["time"] = STEP * np.arange(STEPS)
    return made


def by_loops(made):
    """Sensors that are lost, from when on nothing holds, the largest gap, and who stands."""
    lost, standing, falls, gap = {}, {}, None, 0.0
    for n, limb in enumerate(LIMBS):
        for step in range(STEPS):
            if made["sensor_lost"][step, n]:
                lost[limb] = max(step * STEP - SILENCE, 0.0)
                break
        for step in range(STEPS):
            if all(made["stands"][later, n] for later in range(step, STEPS)):
                standing[limb] = step * STEP
                break
    for step in range(STEPS):
        if not any(made["support"][later].any() for later in range(step, STEPS)):
            falls = step * STEP
            break
    for step in range(STEPS):
        gap = np.nanmax([gap, *made["grip_gap"][step]])
        if made["missed"][step].any():
            break
    return lost, standing, falls, gap


@pytest.mark.parametrize("seed", range(12))
def test_a_trajectory_tells_what_loops_over_its_steps_find(seed):
    made = histories(seed)
    scenario = mc.Scenario()
    walk = Trajectory(**made, scenario=scenario, gains={}, parameters=mc.parameters(scenario), limbs=LIMBS)
    lost, standing, falls, gap = by_loops(made)
    assert walk.lost_sensors == pytest.approx(lost) and [*walk.lost_sensors] == [*lost]
    assert walk.standing == pytest.approx(standing) and [*walk.standing] == [*standing]
    assert walk.falls_at == (None if falls is None else pytest.approx(falls))
    assert walk.gap == pytest.approx(gap)


@jax.jit
def evaluated(samples):
    context = Context(None, jnp.zeros(3), jnp.zeros(()), STEP)
    table = SENSORS + GRIPS

    def one(running, sample):
        return accumulate(table, running, sample, context), None

    return finish(table, jax.lax.scan(one, start(table, jnp.result_type(samples.time)), samples)[0], context)


@pytest.mark.parametrize("seed", range(12))
def test_metrics_of_sensors_and_grips_are_those_of_loops(seed):
    """Gaps are known at each step there; the first of several limbs that lose their sensors in one step is named."""
    made = histories(seed)
    made["grip_gap"] = np.nan_to_num(made["grip_gap"])
    found = evaluated(Sample(**made))
    lost, _, _, gap = by_loops(made)
    at = min(lost.values(), default=math.nan)
    assert found["sensor_lost_at"] == pytest.approx(at, nan_ok=True)
    steps = [made["sensor_lost"][:, n].argmax() if made["sensor_lost"][:, n].any() else STEPS for n in range(4)]
    assert found["sensor_lost_limb"] == (int(np.argmin(steps)) if lost else -1)
    assert found["grip_gap"] == pytest.approx(gap)


def test_metrics_of_a_trajectory_are_those_that_are_asked_for():
    """Of the walk's samples, by the names of its limbs."""
    made, scenario = histories(0), mc.load_scenario("case_1_2")
    made |= {"base_position": np.cumsum(np.ones((STEPS, 3)), axis=0), "missed": np.ones((STEPS, 4), bool)}
    made["torn_off"] = np.zeros((STEPS, 4), bool)
    made["torn_off"][7, 2] = True
    walk = Trajectory(**made, scenario=scenario, gains={}, parameters=mc.parameters(scenario), limbs=LIMBS)
    found = mc.metrics(walk, [mc.METRICS[name] for name in ("travel", "missed_grips", "detached_limb")])
    assert found == {"travel": pytest.approx(STEPS - 1), "missed_grips": 4 * STEPS, "detached_limb": "RH"}


def test_a_walk_fails_that_loses_a_gripper_diverges_or_stands():
    for limb, diverged, stands in [(-1, 0, math.nan), (0, 0, math.nan), (-1, 1, math.nan), (-1, 0, 0.0), (2, 1, 3.0)]:
        metrics = {"detached_limb": np.array([limb]), "diverged": np.array([diverged]), "stands_at": np.array([stands])}
        assert failed(metrics)[0] == (limb >= 0 or bool(diverged) or stands >= 0)
        del metrics["stands_at"]
        assert failed(metrics)[0] == (limb >= 0 or bool(diverged))


def test_values_for_json_have_names_of_limbs_and_nothing_for_what_is_undefined():
    values = {"travel": 1.5, "cost_of_transport": math.nan, "detached_limb": 2, "diverged": True}
    assert named(values, LIMBS) == {"travel": 1.5, "cost_of_transport": None, "detached_limb": "RH", "diverged": True}
    assert named({"detached_limb": 0}, LIMBS) == {"detached_limb": "LF"}
    assert named({"detached_limb": -1}, LIMBS) == {"detached_limb": None}
    assert named({"travel": 1.0}, LIMBS) == {"travel": 1.0}


@pytest.mark.parametrize("steps", [1, 7, 200, 201, 399, 400, 401, 999, 8000])
def test_stretches_of_a_walk_hold_all_its_steps(steps):
    """As long as it takes for no more than so many, and none is empty."""
    count, length = stretches(steps)
    assert length == min(n for n in range(1, steps + 1) if n * STRETCHES >= steps)
    assert count <= STRETCHES and (count - 1) * length < steps <= count * length


@pytest.mark.parametrize(("steps", "of"), [(450, None), (100, None), (450, 150), (402, 201)])
def test_lines_over_time_are_the_extremes_of_each_stretch(steps, of):
    """Of a walk of steps that are as long, or a part of those of the stretches; the last stretch may be shorter."""
    rng = np.random.default_rng(0)
    made = unknown(steps, {"limb": 4, "joint": 3})
    for name in ("foot_force", "base_position", "base_reference", "joint_torque"):
        made[name] = rng.normal(size=made[name].shape)
    scenario = mc.Scenario()
    walk = Trajectory(**made, scenario=scenario, gains={}, parameters=mc.parameters(scenario), limbs=LIMBS)
    found = extremes(walk, of)
    count, length = stretches(of or steps)
    length *= steps // (of or steps)
    assert set(found) == set(LINES)
    for stretch in range(count):
        rows = slice(stretch * length, (stretch + 1) * length)
        force = [max(np.linalg.norm(foot) for foot in feet) for feet in made["foot_force"][rows]]
        off = np.linalg.norm(made["base_position"][rows] - made["base_reference"][rows], axis=1)
        torque = np.abs(made["joint_torque"][rows]).reshape(len(off), -1).max(1)
        for name, line in zip(LINES, (force, off, torque), strict=True):
            assert found[name][:, stretch] == pytest.approx([np.min(line), np.max(line)]), name
    assert all(value.shape == (2, count) for value in found.values())


def test_extremes_of_a_batch_come_together_behind_its_axes():
    rng = np.random.default_rng(1)
    name = next(iter(LINES))
    least, most, travel = rng.normal(size=(2, 3, 5)), rng.normal(size=(2, 3, 5)), rng.normal(size=(2, 3))
    found = together({f"least of {name}": least, name: most, "travel": travel})
    assert set(found) == {name, "travel"} and found[name].shape == (2, 3, 2, 5)
    np.testing.assert_array_equal(found[name][..., 0, :], least)
    np.testing.assert_array_equal(found[name][..., 1, :], most)
    assert found["travel"] is travel


@pytest.mark.parametrize("recovery", [None, {"shift": 0.01}])
def test_walks_of_any_gait_have_histories_and_samples(recovery):
    """By their program alone: of a gait that looks ahead too, whose steps come in periods."""
    changes = {"duration": 0.4, "gait.cycle": 0.4} | ({} if recovery is None else {"control.recovery": recovery})
    scenario = mc.load_scenario("case_1_2", changes)
    found = resolve_in(scenario, law_of(scenario), None, None, np.float64)
    shape = structure(scenario, DEFAULT_ENGINE, found.walked, law=found.law)
    assert bool(shape.planning) == (recovery is not None)
    count, _ = stretches(shape.steps)
    shapes = dict.fromkeys(mc.METRICS.names, ())
    shapes |= {f"{of}{name}": (count,) for name in LINES for of in ("", "least of ")}
    made = jax.eval_shape(functools.partial(histories_of, shape), found.law, found.parameters)
    assert {name: value.shape for name, value in made.items()} == shapes
    samples = jax.eval_shape(functools.partial(samples_of, shape), found.law, found.parameters)
    assert samples.foot_force.shape == (shape.steps, 4, 3) and samples.time.shape == (shape.steps,)


@pytest.mark.slow
@pytest.mark.parametrize("recovery", [None, pytest.param({"shift": 0.01}, marks=pytest.mark.nightly)])
def test_a_walk_is_made_in_parts_by_a_program_that_serves_walks_of_any_length_and_time_step(recovery, monkeypatch):
    """The parts are the walk in one go, of a gait that looks ahead too; its metrics are those of the batch."""
    changes = {"duration": 0.4, "gait.cycle": 0.4} | ({} if recovery is None else {"control.recovery": recovery})
    scenario = mc.load_scenario("case_1_2", changes)
    whole = mc.rollout(scenario)
    monkeypatch.setattr(simulation, "PART", 150)
    found, traced = mc.rollout(scenario), list[str]()
    for name in DIMS:
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-9, atol=1e-12)
    batch, metrics = mc.rollout_metrics(scenario, dtype=np.float64), mc.metrics(found)
    assert metrics["force_variation"] == pytest.approx(float(batch["force_variation"]), rel=1e-9)
    if recovery is not None:  # the steps between decisions are its program's
        return

    def told(event, *_, **__):
        traced.extend([event] if event.endswith("jaxpr_trace_duration") else [])

    jax.monitoring.register_event_duration_secs_listener(told)
    other = scenario.with_overrides({"duration": 0.3, "time_step": 0.0005})
    walk = mc.rollout(other)
    assert len(walk.time) == other.steps == 600 and mc.metrics(walk)["force_variation"] > 0
    jax.monitoring.unregister_event_duration_listener(told)
    assert traced == []
