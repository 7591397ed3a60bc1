"""Metrics as objects: the shipped ones and a user's own, of made-up samples by numpy and in every kind of walk."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.physics.spatial import norm
from mjx_climb.robot_import.load import load_robot
from mjx_climb.walk.metrics import (
    FAILURES,
    GRIPS,
    SENSORS,
    Context,
    Metric,
    accumulate,
    finish,
    largest,
    peak,
    smallest,
    start,
    total,
)
from mjx_climb.walk.sample import DIMS, Sample, unknown
from mjx_climb.walk.step import prepare
from mjx_climb.walk.structure import structure

SPEED = peak("peak_base_speed", "m/s", "largest speed of the base", lambda s, _: norm(s.base_linear_velocity))
ALONG = largest("largest_forward_speed", "m/s", "largest speed forward", lambda s, _: s.base_linear_velocity[0])
SLOWEST = smallest("least_forward_speed", "m/s", "least speed forward", lambda s, _: s.base_linear_velocity[0])
LOWEST = smallest("lowest_base", "m", "lowest base", lambda s, _: s.base_position[2])
IMPULSE = total("impulse", "N s", "impulse of all feet", lambda s, _: norm(s.foot_force).sum())
WEIGHT = Metric(
    "weight", "N", "largest weight", larger_is_better=False,
    init=lambda zero: zero,
    update=lambda running, s, context: jnp.maximum(running, s.cargo_mass + context.robot.total_mass),
    finish=lambda running, context: running * norm(context.gravity),
)  # fmt: skip
OWN = mc.METRICS + (SPEED, ALONG, SLOWEST, LOWEST, IMPULSE, WEIGHT)  # noqa: RUF005
EVERY = OWN.with_companions
STIFFNESS = np.array([[1e3], [1e5]])

STEP, STEPS, GRAVITY, HEADING = 1e-3, 60, np.array([0.3, -0.2, -1.6]), 0.4
ROBOT = load_robot("hubrobo_v3_2")
MASKS = [name for name, values in unknown(1, {"limb": 4, "joint": 3}).items() if values.dtype == bool]


def samples_of(seed):
    """Return made-up samples over time: a foot that is pulled while open, and three grippers torn off in two steps."""
    rng, made = np.random.default_rng(seed), {}
    for name, values in unknown(STEPS, {"limb": 4, "joint": 3}).items():
        made[name] = rng.normal(size=values.shape)
    made |= {name: rng.random((STEPS, 4)) < 0.5 for name in MASKS}
    made |= {"time": STEP * np.arange(STEPS), "cargo_mass": np.where(np.arange(STEPS) < 30, 1.0 + seed, 0.0)}
    made["torn_off"] = np.zeros((STEPS, 4), bool)
    made["torn_off"][[20, 20, 40], [1, 3, 0]] = True
    made["stands"] = np.zeros((STEPS, 4), bool)
    made["stands"][12:15, 2] = made["stands"][37:, 1] = True
    made["foot_force"][10, 1], made["support"][10, 1] = [0.0, 0.0, -50.0], False
    made["ground_normal"][10, 1] = [0.0, 0.0, 1.0]
    return Sample(**made)


@jax.jit
def evaluated(samples, table=EVERY):
    """Return the metrics of samples over time."""
    context = Context(ROBOT, jnp.asarray(GRAVITY), jnp.asarray(HEADING), STEP)
    dtype = jnp.result_type(samples.time)

    def one(running, sample):
        return accumulate(table, running, sample, context), None

    return finish(table, jax.lax.scan(one, start(table, dtype), samples)[0], context)


def expected_of(s):
    """Return the metrics of samples, and the values of each instant that extremes are taken of, by numpy."""
    force, torque = np.linalg.norm(s.foot_force, axis=-1), np.abs(s.joint_torque)
    way = s.base_position[-1] - s.base_position[0]
    travel = np.cos(HEADING) * way[0] + np.sin(HEADING) * way[1]
    mass, weight = ROBOT.total_mass + s.cargo_mass.max(), np.linalg.norm(GRAVITY)
    peaks = {
        "peak_foot_force": force,
        "peak_utilization": s.utilization,
        "peak_pull_force": force * (s.support & ((s.foot_force * s.ground_normal).sum(-1) < 0)),
        "peak_joint_torque": torque,
        "base_deviation": np.linalg.norm(s.base_position - s.base_reference, axis=-1),
        "peak_base_speed": np.linalg.norm(s.base_linear_velocity, axis=-1),
    }
    least = {
        "min_tsm": s.tsm,
        "min_gia_margin": s.gia_margin,
        "joint_limit_margin": np.minimum(s.joint_angles - ROBOT.joint_lower, ROBOT.joint_upper - s.joint_angles),
        "least_forward_speed": s.base_linear_velocity[:, 0],
        "lowest_base": s.base_position[:, 2],
    }
    values = {
        "force_variation": np.abs(np.diff(force.max(-1))).sum(),
        "cost_of_transport": STEP * (torque * np.abs(s.joint_rates)).sum() / (mass * weight * abs(travel)),
        "travel": travel,
        "detached_at": 20 * STEP,
        "detached_limb": 1,
        "missed_grips": s.missed.sum(),
        "stands_at": 37 * STEP,
        "diverged": False,
        "largest_forward_speed": s.base_linear_velocity[:, 0].max(),
        "impulse": STEP * force.sum(),
        "weight": mass * weight,
    }
    extremes = {name: v.max() for name, v in peaks.items()} | {name: v.min() for name, v in least.items()}
    return values | extremes, peaks, least


def test_metrics_are_what_numpy_makes_of_the_samples():
    """The largest cargo counts and not the last, supporting feet are pulled, the first of two limbs is named."""
    samples = samples_of(0)
    found, (expected, _, _) = evaluated(samples), expected_of(samples)
    assert set(expected) == set(OWN.names)
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-12), name
    assert found["least_forward_speed"] < 0 < found["largest_forward_speed"]


@pytest.mark.parametrize("size", [1.0, 1e12])
def test_companions_are_means_over_instants_and_feet_or_joints(size):
    """The power mean of order 32; of what may be negative a log-sum-exp in hundredths of the first value.

    No power of a large force overflows.
    """
    samples = samples_of(0)
    large = {name: size * getattr(samples, name) for name in ("foot_force", "joint_torque")}
    samples = dataclasses.replace(samples, **large)
    found, (_, peaks, least) = evaluated(samples), expected_of(samples)
    least["largest_forward_speed"] = -least["least_forward_speed"]
    for name, values in peaks.items():
        power_mean = values.max() * ((values / values.max()) ** 32).mean() ** (1 / 32)
        assert found[f"smooth_{name}"] == pytest.approx(power_mean, rel=1e-9), name
    for name, values in least.items():
        unit, sign = np.abs(values[0].min()) / 100, -1 if name.startswith("largest") else 1
        soft = values.min() - unit * np.log(np.exp((values.min() - values) / unit).mean())
        assert found[f"smooth_{name}"] == pytest.approx(sign * soft, rel=1e-9), name
    assert {f"smooth_{name}" for name in peaks | least} == set(EVERY.names) - set(OWN.names)


@pytest.mark.slow
def test_tangents_are_those_of_finite_differences():
    """The first sample stays: the unit of a companion's exponentials is taken from it, and counts as a constant."""
    samples = samples_of(1)
    along = jax.tree.map(lambda value: np.append(np.zeros_like(value[:1]), value[1:], 0), samples_of(2))
    real = [name for name in DIMS if name not in (*MASKS, "time", "cargo_mass")]

    def moved(share):
        changes = {name: getattr(samples, name) + share * getattr(along, name) for name in real}
        return {n: v for n, v in evaluated(dataclasses.replace(samples, **changes)).items() if n not in FAILURES}

    tangents, width = jax.jvp(moved, (0.0,), (1.0,))[1], 1e-6
    above, below = moved(width), moved(-width)
    for name, value in tangents.items():
        central = (above[name] - below[name]) / (2 * width)
        np.testing.assert_allclose(value, central, rtol=1e-5, atol=1e-7, err_msg=name)


OF_THE_STATE = ("base_position", "base_linear_velocity", "base_angular_velocity", "joint_angles", "joint_rates")


@pytest.mark.parametrize("name", [*OF_THE_STATE, "joint_torque", "foot_force"])
def test_a_diverged_walk_has_the_metrics_of_its_finite_part(name):
    """From the first sample on that is not finite nothing counts, be they finite again; a gripper lost before does."""
    samples, cut = samples_of(0), 45
    broken = {name: value.copy() for name, value in vars(samples).items()}
    broken[name][cut : cut + 5, -1] = np.nan
    broken["foot_force"][cut + 5 :] *= 100
    diverged = evaluated(Sample(**broken))
    finite = evaluated(jax.tree.map(lambda value: value[:cut], samples))
    assert (diverged.pop("diverged"), finite.pop("diverged")) == (True, False)
    for name, value in finite.items():
        np.testing.assert_allclose(diverged[name], value, rtol=1e-12, err_msg=name)
    assert (diverged["detached_at"], diverged["detached_limb"]) == (pytest.approx(20 * STEP), 1)


def test_a_walk_that_is_finite_but_for_its_last_sample_has_diverged():
    samples = samples_of(0)
    position = samples.base_position.copy()
    position[-1] = np.nan
    last = evaluated(dataclasses.replace(samples, base_position=position))
    assert last["diverged"] and not evaluated(samples)["diverged"]


def test_without_a_finite_sample_there_are_no_metrics():
    samples = samples_of(0)
    found = evaluated(dataclasses.replace(samples, base_position=np.full_like(samples.base_position, np.nan)))
    assert (found.pop("diverged"), found.pop("missed_grips"), found.pop("detached_limb")) == (True, 0, -1)
    assert np.isnan(list(found.values())).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"update": lambda running, s, _: (running, running)}, "`update` to return a value structured as `init` does"),
        ({"update": lambda running, s, _: s.base_position}, r"`update` to keep float64 \(\), got float64 \(3,\)"),
        ({"update": lambda running, s, _: running + s.foot_force.sum(0)}, r"`update` to keep float64 \(\), got"),
        ({"finish": lambda running, _: running * jnp.ones(2)}, r"`finish` to return one number, got shape \(2,\)"),
    ],
)
def test_a_metric_that_does_not_keep_its_shapes_is_refused(change, message):
    table = mc.MetricTable((dataclasses.replace(IMPULSE, **change),))
    with pytest.raises(ValueError, match=f"^metric impulse: expected {message}"):
        jax.eval_shape(lambda samples: evaluated.__wrapped__(samples, table), samples_of(0))


def test_a_table_is_immutable_and_known_by_names():
    assert mc.METRICS["travel"] is mc.METRICS[6] and mc.METRICS["travel"].unit == "m"
    assert OWN[-2:].names == ("impulse", "weight") and OWN != mc.METRICS and len(OWN) == len(mc.METRICS) + 6
    assert hash(mc.METRICS + (SPEED,)) == hash(mc.METRICS + [SPEED])  # noqa: RUF005
    again = pickle.loads(pickle.dumps(mc.METRICS.with_companions))
    assert all(one is other for one, other in zip(again, mc.METRICS.with_companions, strict=True))
    assert copy.deepcopy(mc.METRICS) == mc.METRICS
    for table in (SENSORS, GRIPS):
        assert all(one is other for one, other in zip(pickle.loads(pickle.dumps(table)), table, strict=True))
    assert mc.METRICS.in_words("min_tsm") == "min TSM" and mc.METRICS.in_words("peak_base_speed") == "peak base speed"
    assert repr(SENSORS) == "MetricTable(sensor_lost_at, sensor_lost_limb)"
    with pytest.raises(KeyError, match="metric speed: expected one of peak_foot_force, "):
        mc.METRICS["speed"]


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        ((SPEED, SPEED), "metric peak_base_speed: expected one of this name, got two"),
        ((dataclasses.replace(SPEED, name="a b"),), "metric 'a b': expected a name of letters, digits and underscores"),
        (("travel",), "metrics: expected objects of mjx_climb.Metric, got 'travel'"),
    ],
)
def test_a_table_refuses_what_it_cannot_tell_apart(metrics, message):
    with pytest.raises(ValueError, match=message):
        mc.METRICS + metrics


# --- In walks


@pytest.fixture(scope="module")
def scenario(case):
    changes = {"duration": 0.3, "gait.cycle": 0.4, "disturbance.cargo.start": 0.1, "contact.holding_limit": None}
    return case("case_1_2", "virtual_model", tuple(changes.items()))


@pytest.mark.slow
def test_own_metrics_of_a_walk_and_of_a_batch(scenario):
    walk = mc.rollout(scenario, mc.Gains(1.0, 100.0, STIFFNESS[0]))
    batch = mc.rollout_metrics(scenario, mc.Gains(1.0, 100.0, STIFFNESS), metrics=OWN, dtype=np.float64, smooth=True)
    found = mc.metrics(walk, OWN)
    assert list(found) == list(OWN.names)
    assert {name: found[name] for name in mc.METRICS.names} == mc.metrics(walk)
    for name in set(OWN.names) - set(FAILURES):
        assert batch[name][0] == pytest.approx(found[name], rel=1e-9), name
    force = np.linalg.norm(walk.foot_force, axis=-1)
    power_mean = force.max() * ((force / force.max()) ** 32).mean() ** (1 / 32)
    assert batch["smooth_peak_foot_force"][0] == pytest.approx(power_mean, rel=1e-9)
    assert "smooth_impulse" not in batch


@pytest.mark.slow
def test_another_metric_of_the_same_name_is_another_program(scenario):
    """What is compiled knows a metric by what it is, not by its name."""
    walk = mc.rollout(scenario, mc.Gains(1.0, 100.0, STIFFNESS[0]))
    twice = total("impulse", "N s", "twice the impulse", lambda s, _: 2 * norm(s.foot_force).sum())
    once, double = (mc.metrics(walk, (metric,))["impulse"] for metric in (IMPULSE, twice))
    assert double == pytest.approx(2 * once, rel=1e-12)


def test_margins_of_a_smooth_walk_count_on_the_holding_limit(case):
    """Nothing is torn off there, but grippers pull as ever: without them margins are those of bare feet."""
    scenario, law = case("case_1_2", "pd"), PD()
    own = resolve_in(scenario, law, None, None, np.float64).own
    plain, smooth = (
        prepare(structure(scenario, "limb", own, law=law, smooth=smooth), law, own) for smooth in (False, True)
    )
    assert smooth.holding_force == plain.holding_force == scenario.contact.holding_limit
    assert plain.contact.breaks and not smooth.contact.breaks
