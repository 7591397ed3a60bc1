"""Metrics as objects: the shipped ones and a user's own, in every kind of walk, up to where the state is finite."""

import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.dynamics.spatial import norm
from mjx_climb.robot.constants import load_robot
from mjx_climb.walk.metrics import Metric, largest, peak, smallest, total

SPEED = peak("peak_base_speed", "m/s", "largest speed of the base", lambda s, _: norm(s.base_linear_velocity))
ALONG = largest("largest_forward_speed", "m/s", "largest speed forward", lambda s, _: s.base_linear_velocity[0])
LOWEST = smallest("lowest_base", "m", "lowest base", lambda s, _: s.base_position[2])
IMPULSE = total("impulse", "N s", "impulse of all feet", lambda s, _: norm(s.foot_force).sum(0))
MEAN_MASS = Metric(
    "weight", "N", "largest weight", larger_is_better=False,
    init=lambda zero: zero,
    update=lambda running, s, context: jnp.maximum(running, s.cargo_mass + context.robot.total_mass),
    finish=lambda running, context: running * norm(context.gravity),
)  # fmt: skip
OWN = mc.METRICS + (SPEED, ALONG, LOWEST, IMPULSE, MEAN_MASS)  # noqa: RUF005
STIFFNESS = np.array([[1e3], [1e5]])


@pytest.fixture(scope="module")
def scenario(case):
    changes = {"duration": 0.3, "gait.cycle": 0.4, "disturbance.cargo.start": 0.1, "contact.holding_limit": None}
    return case("case_1_2", "virtual_model", tuple(changes.items()))


@pytest.fixture(scope="module")
def alone(scenario):
    return mc.rollout(scenario, mc.Gains(1.0, 100.0, STIFFNESS[0]))


@pytest.fixture(scope="module")
def batch(scenario):
    return mc.rollout_metrics(scenario, mc.Gains(1.0, 100.0, STIFFNESS), metrics=OWN, dtype=np.float64, smooth=True)


def expected(walk):
    """Return the own metrics of a walk from its histories, by numpy."""
    forces = np.linalg.norm(walk.foot_force, axis=-1)
    mass = walk.cargo_mass.max() + 2.2539
    return {
        "peak_base_speed": np.linalg.norm(walk.base_linear_velocity, axis=-1).max(),
        "largest_forward_speed": walk.base_linear_velocity[:, 0].max(),
        "lowest_base": walk.base_position[:, 2].min(),
        "impulse": forces.sum() * walk.scenario.time_step,
        "weight": mass * np.linalg.norm(walk.scenario.gravity),
    }


def test_own_metrics_of_one_walk(alone):
    found = mc.metrics(alone, OWN)
    assert list(found) == list(OWN.names)
    assert {name: found[name] for name in mc.METRICS.names} == mc.metrics(alone)
    for name, value in expected(alone).items():
        assert found[name] == pytest.approx(value, rel=1e-4 if name == "weight" else 1e-12), name


def test_own_metrics_of_a_batch_are_those_of_each_walk(alone, batch):
    for name, value in expected(alone).items():
        assert batch[name][0] == pytest.approx(value, rel=1e-4 if name == "weight" else 1e-9), name


def test_companions_are_near_their_extremes_and_inside(alone, batch):
    """The companion of an extreme averages over all instants, so it lies within it, and not far from it."""
    torques = np.abs(alone.joint_torque)  # of every instant, limb and joint
    assert batch["smooth_peak_joint_torque"][0] == pytest.approx((torques**32).mean() ** (1 / 32), rel=1e-9)
    heights = alone.base_position[:, 2]
    unit = heights[0] / 100
    softest = heights.min() - unit * np.log(np.exp((heights.min() - heights) / unit).mean())
    assert batch["smooth_lowest_base"][0] == pytest.approx(softest, rel=1e-9)
    for name, inside in (("peak_base_speed", 1), ("largest_forward_speed", 1), ("lowest_base", -1)):
        gap = inside * (batch[name] - batch[f"smooth_{name}"])
        assert (gap >= 0).all(), name
        assert (gap <= 0.25 * abs(batch[name])).all(), name
    assert "smooth_impulse" not in batch


def test_companions_are_means_over_instants_and_feet_or_joints(alone, batch):
    """The power mean of order 32; of what may be negative a log-sum-exp in hundredths of the first value."""
    force = np.linalg.norm(alone.foot_force, axis=-1)
    power_mean = force.max() * ((force / force.max()) ** 32).mean() ** (1 / 32)
    assert batch["smooth_peak_foot_force"][0] == pytest.approx(power_mean, rel=1e-9)
    robot = load_robot("hubrobo_v3_2")
    lower, upper = robot.joint_lower[..., 0].T, robot.joint_upper[..., 0].T
    margin = np.minimum(alone.joint_angles - lower, upper - alone.joint_angles)
    unit = abs(margin[0].min()) / 100
    soft = margin.min() - unit * np.log(np.exp((margin.min() - margin) / unit).mean())
    assert batch["smooth_joint_limit_margin"][0] == pytest.approx(soft, rel=1e-9)


@pytest.mark.slow
def test_slopes_of_own_metrics_are_those_of_finite_differences(scenario):
    gains = mc.Gains(*(np.full((1, 6), value) for value in (1.0, 100.0, 3e3)))
    along = mc.Gains(np.zeros((1, 6)), np.full((1, 6), 100.0), np.zeros((1, 6)))
    how = {"metrics": OWN, "dtype": np.float64, "smooth": True}
    _, slopes = mc.rollout_slopes(scenario, gains, along, **how)
    step = 1e-4
    sides = mc.Gains(gains.inertia, 100.0 * (1 + step * np.array([[1.0], [-1.0]])) * np.ones(6), gains.stiffness)
    above, below = (mc.rollout_metrics(scenario, sides, **how)[n] for n in ("impulse", "smooth_peak_base_speed"))
    for name, values in (("impulse", above), ("smooth_peak_base_speed", below)):
        assert slopes[name][0, 0] == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4), name


def test_another_metric_of_the_same_name_is_another_program(alone, scenario):
    """What is compiled knows a metric by what it is, not by its name."""
    twice = total("impulse", "N s", "twice the impulse", lambda s, _: 2 * norm(s.foot_force).sum(0))
    once, double = (mc.metrics(alone, (metric,))["impulse"] for metric in (IMPULSE, twice))
    assert double == pytest.approx(2 * once, rel=1e-12)


OF_THE_STATE = ("base_position", "base_linear_velocity", "base_angular_velocity", "joint_angles", "joint_rates")


@pytest.mark.parametrize("name", [*OF_THE_STATE, "joint_torque", "foot_force"])
def test_a_diverged_walk_has_the_metrics_of_its_finite_part(alone, name):
    """From the first sample on that is not finite nothing counts, be they again; a gripper lost before is told."""
    cut, lost = 200, 150
    histories = {
        field.name: getattr(alone, field.name).copy()
        for field in dataclasses.fields(alone)
        if isinstance(getattr(alone, field.name), np.ndarray)
    }
    histories["torn_off"][lost, 2] = True
    before = {name: value[:cut] for name, value in histories.items()}
    histories[name][cut : cut + 10, -1] = np.nan
    histories["foot_force"][cut + 10 :] *= 100
    diverged = mc.metrics(dataclasses.replace(alone, **histories), OWN)
    finite = mc.metrics(dataclasses.replace(alone, **before), OWN)
    assert (diverged.pop("diverged"), finite.pop("diverged")) == (True, False)
    assert diverged == finite
    assert (diverged["detached_at"], diverged["detached_limb"]) == (pytest.approx(lost * 1e-3), "RH")


def test_a_walk_without_a_finite_sample_has_no_metrics(alone):
    lost = dataclasses.replace(alone, base_position=np.full_like(alone.base_position, np.nan))
    found = mc.metrics(lost)
    assert (found.pop("diverged"), found.pop("missed_grips")) == (True, 0)
    assert set(found.values()) == {None}


def test_a_table_is_immutable_and_known_by_names():
    assert mc.METRICS["travel"] is mc.METRICS[5] and mc.METRICS["travel"].unit == "m"
    assert OWN[-2:].names == ("impulse", "weight") and OWN != mc.METRICS and len(OWN) == len(mc.METRICS) + 5
    assert hash(mc.METRICS + (SPEED,)) == hash(mc.METRICS + [SPEED])  # noqa: RUF005
    again = pickle.loads(pickle.dumps(mc.METRICS.with_companions))
    assert all(one is other for one, other in zip(again, mc.METRICS.with_companions, strict=True))
    assert copy.deepcopy(mc.METRICS) == mc.METRICS
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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"update": lambda running, s, _: (running, running)}, "`update` to return a value structured as `init` does"),
        ({"update": lambda running, s, _: s.base_position}, "`update` to keep float32 .1,., got float32 .3, 1."),
        ({"update": lambda running, s, _: running + s.foot_force.sum(0)}, "`update` to keep float32 .1,., got"),
        ({"finish": lambda running, _: running.sum()}, "`finish` to return shape .1,., got .."),
    ],
)
def test_a_metric_that_does_not_keep_its_shapes_is_refused(scenario, change, message):
    simulate = mc.simulator(scenario, metrics=(dataclasses.replace(IMPULSE, **change),))
    gains = mc.Gains(*(np.ones((1, 6), np.float32) for _ in range(3)))
    with jax.enable_x64(False), pytest.raises(ValueError, match=f"metric impulse: expected {message}"):
        jax.eval_shape(simulate, gains)
