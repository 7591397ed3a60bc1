"""Each stage of hardware against its closed form, and its derivative against central differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware import sensors, servo, signals
from mjx_climb.hardware.stages import IDEAL, hardware_of, stages_of
from mjx_climb.robot.constants import load_robot

STEP = 1e-3


def hardware(overrides, stages=None):
    """The hardware of a scenario with some overrides."""
    scenario = mc.Scenario().with_overrides({"hardware": overrides})
    parameters = mc.parameters(scenario)
    return hardware_of(parameters, stages or stages_of(scenario, parameters), STEP)


def tangent(function, at):
    at = jnp.asarray(at, float)
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


def check_tangent(function, at, width=1e-6, rtol=1e-7, atol=1e-9):
    central = (function(at + width) - function(at - width)) / (2 * width)
    np.testing.assert_allclose(tangent(function, at), central, rtol=rtol, atol=atol)


# ------------------------------------------------------------------------------------------------------------
# Delays


def late(signal, steps, length=8):
    """The signal (T,) through a delay of `steps`, from a buffer that begins at zero."""

    def one(buffer, value):
        return signals.delayed(buffer, value, signals.weights(jnp.asarray(steps, float), length))

    return jax.lax.scan(one, (jnp.zeros(()),) * length, signal)[1]


def white(seed, count=20):
    return jnp.asarray(np.random.default_rng(seed).normal(size=count))


def test_whole_delays_give_back_the_samples_bit_for_bit():
    for steps in (0, 1, 5, 7):
        np.testing.assert_array_equal(late(white(0), steps)[steps:], white(0)[: 20 - steps])
    np.testing.assert_array_equal(late(white(0), 40), late(white(0), 7))  # beyond the buffer it is cut


@pytest.mark.parametrize("longest", [0.1, 0.3, 1.0, 2.4, 3.0, 3.4, 7.9, 15.0, 16.4])
def test_the_longest_delay_of_a_buffer_is_that_of_an_independent_delay_line(longest):
    times, signal = STEP * np.arange(40), white(4, 40)
    expected = np.interp(times - longest * STEP, times, signal, left=0.0)
    first = int(longest) + 1  # before, the buffer's zeros are part of it
    length = signals.buffer_length(np.array([0.0, longest * STEP]), STEP)
    np.testing.assert_allclose(late(signal, longest, length)[first:], expected[first:], rtol=1e-9, atol=1e-12)
    assert length % 4 == 0 and signals.buffer_length(np.zeros(5), STEP) == 0


def test_a_delay_that_no_buffer_holds_is_refused():
    with pytest.raises(ValueError, match=r"^delay: expected at most 500 time steps of 0.001 s, got 501$"):
        signals.buffer_length(0.501, STEP)


@pytest.mark.parametrize("steps", [0.3, 3.4, 6.9])
def test_derivative_of_a_delay(steps):
    check_tangent(lambda d: late(white(2), d), steps, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("steps", [0.0, 3.0, 5.0])
def test_derivative_at_a_whole_delay_is_that_of_longer_ones(steps):
    ahead = (late(white(3), steps + 1e-6) - late(white(3), steps)) / 1e-6
    assert np.abs(ahead).max() > 0.1
    np.testing.assert_allclose(tangent(lambda d: late(white(3), d), steps), ahead, rtol=1e-6, atol=1e-8)


def test_under_vmap_each_robot_has_its_own_delay():
    delays = jnp.asarray([0.0, 1.5, 4.0])
    batch = jax.jit(jax.vmap(lambda d: late(white(5), d)))(delays)
    for row, steps in enumerate(delays):
        np.testing.assert_allclose(batch[row], late(white(5), steps), rtol=1e-14)


# ------------------------------------------------------------------------------------------------------------
# Filter, resolution, control period


def filtered(cutoff, inputs):
    output = jnp.zeros(())
    for value in inputs:
        output = signals.low_passed(output, value, signals.filter_share(jnp.asarray(cutoff), STEP))
    return output


def test_filter_has_the_step_response_of_a_first_order_low_pass():
    for n in (1, 2, 30, 60):
        np.testing.assert_allclose(filtered(30.0, np.ones(n)), 1 - np.exp(-2 * np.pi * 30.0 * n * STEP), rtol=1e-12)
    assert filtered(jnp.inf, [3.7]) == 3.7  # without a cut-off all passes
    check_tangent(lambda cutoff: filtered(cutoff, np.sin(0.3 * np.arange(20))), 30.0, 1e-4)


def test_resolution_rounds_and_lets_derivatives_pass():
    force = jnp.asarray([0.24, -0.26, 1.0])
    np.testing.assert_allclose(signals.rounded(force, jnp.asarray(0.1)), [0.2, -0.3, 1.0], rtol=1e-12)
    np.testing.assert_array_equal(signals.rounded(force, jnp.asarray(0.0)), force)
    np.testing.assert_array_equal(tangent(lambda f: signals.rounded(f, jnp.asarray(0.1)), force), np.ones(3))


@pytest.mark.parametrize(("period", "count"), [(0.0, 1), (1e-3, 1), (5e-3, 5), (7e-3, 7)])
def test_the_law_is_evaluated_at_the_first_step_of_each_period(period, count):
    steps = signals.period_steps(jnp.asarray(period), STEP)
    assert steps == count
    for n in (0, 4, 5, 34, 35, 7999, 8000):
        assert signals.steps_into(jnp.asarray(n), steps) == n % count


def test_what_a_law_hands_on_unchanged_is_held_without_an_operation():
    program = jax.make_jaxpr(lambda now, new, same: signals.held(now, (new, same), (0.0 * new, same)))(True, 1.0, 2.0)
    assert program.jaxpr.outvars[1] is program.jaxpr.invars[2]
    assert signals.held(jnp.asarray(False), (1.0, 2.0), (3.0, 4.0)) == (3.0, 4.0)


def test_a_line_reaches_each_target_in_the_last_step_of_its_period():
    assert [float(signals.interpolated(2.0, 6.0, i, 4.0)) for i in range(4)] == [3.0, 4.0, 5.0, 6.0]
    assert float(signals.interpolated(2.0, 6.1, 0.0, 1.0)) == 6.1


# ------------------------------------------------------------------------------------------------------------
# Noise


def draw(samples, seed=0.0, channels=12):
    return np.asarray(
        jax.vmap(lambda n: sensors.normal(jnp.asarray(seed), n, jnp.arange(channels), jnp.float64))(jnp.arange(samples))
    )


def check_white(values, sizes):
    """Check that signals (T, n) have mean zero, the standard deviations `sizes` and no correlation, in time or not."""
    values, count = values / sizes, len(values)
    assert np.abs(values.mean(0)).max() < 4.5 / np.sqrt(count)
    assert np.abs(values.var(0) - 1).max() < 4.5 * np.sqrt(2 / count)
    for lag in (1, 2, 7):
        assert abs((values[lag:] * values[:-lag]).mean()) < 4 / np.sqrt(values.size)
    across = np.corrcoef(values.T) - np.eye(values.shape[1])
    assert np.abs(across).max() < 4.5 / np.sqrt(count)


def test_noise_is_white_with_unit_variance():
    check_white(draw(40_000), 1.0)


def test_noise_has_the_distribution_of_a_sum_of_eight_uniform_numbers():
    values, count = draw(40_000).ravel(), 8

    def below(width):
        x = count / 2 + width * math.sqrt(count / 12)
        terms = [(-1) ** k * math.comb(count, k) * (x - k) ** count for k in range(math.floor(x) + 1)]
        return sum(terms) / math.factorial(count)

    for width, bell in ((-3, 0.00135), (-2, 0.02275), (-1, 0.15866), (0, 0.5), (1, 0.84134), (2, 0.97725)):
        share = (values < width).mean()
        assert abs(share - below(width)) < 4 * math.sqrt(0.25 / values.size)
        assert abs(share - bell) < 0.005


def test_noise_is_the_same_in_any_batch_and_precision():
    seeds, channels = jnp.asarray([3.0, 0.0, 16_777_215.0]), jnp.arange(12)
    together = jax.vmap(lambda seed: sensors.normal(seed, jnp.asarray(41), channels, jnp.float32))(seeds)
    for row, seed in enumerate(seeds):
        np.testing.assert_array_equal(together[row], sensors.normal(seed, jnp.asarray(41), channels, jnp.float32))
        double = sensors.normal(seed, jnp.asarray(41), channels, jnp.float64)
        np.testing.assert_allclose(together[row], double, rtol=2e-7, atol=1e-9)
    assert len(np.unique(np.asarray(together))) == 36


SAMPLES = 20_000


def test_each_axis_of_each_force_sensor_has_a_noise_of_its_own():
    own = hardware({"force_sensor": {"noise": 0.3}})
    sensor = sensors.ForceSensor((), ())
    read = jax.vmap(lambda n: sensors.measured_force(sensor, jnp.ones((4, 3)), n, own)[1])(jnp.arange(SAMPLES))
    check_white(np.asarray(read).reshape(SAMPLES, 12) - 1.0, 0.3)


def test_each_axis_of_the_base_estimate_has_a_noise_of_its_own_size():
    """Six signals, and none of those of the force sensors; orientation and turning rate have none."""
    own = hardware({"base_estimate": {"position_noise": 1e-3, "velocity_noise": 0.2}})
    base = sensors.Base(jnp.ones(3), jnp.asarray([1.0, 0, 0, 0]), jnp.ones(3), jnp.ones(3))
    found = jax.vmap(lambda n: sensors.estimated_base((), base, n, own)[1])(jnp.arange(SAMPLES))
    signals_of = np.concatenate([found.position - 1, found.linear_velocity - 1, draw(SAMPLES)], axis=1)
    check_white(signals_of, np.repeat([1e-3, 0.2, 1.0], [3, 3, 12]))
    np.testing.assert_array_equal(found.angular_velocity, np.ones((SAMPLES, 3)))


def test_a_force_sensor_reads_late_with_its_bias_in_steps_of_its_resolution_and_filtered():
    """Delay 2 steps, then bias, rounding and filter, in this order."""
    own = hardware({"force_sensor": {"delay": 2e-3, "bias": 0.3, "resolution": 0.5, "filter": 60.0}})
    forces = np.random.default_rng(7).normal(scale=3, size=(6, 4, 3))
    rest, expected = jnp.asarray(forces[0]), forces[0]
    sensor = sensors.ForceSensor((rest,) * own.stages.force_delay, rest)
    for n, force in enumerate(forces):
        sensor, read = sensors.measured_force(sensor, jnp.asarray(force), jnp.asarray(n), own)
        chain = 0.5 * np.round((forces[max(n - 2, 0)] + 0.3) / 0.5)
        expected = expected + (1 - np.exp(-2 * np.pi * 60.0 * STEP)) * (chain - expected)
        np.testing.assert_allclose(read, expected, rtol=1e-12)


def test_a_late_base_estimate_keeps_unit_quaternions():
    own = hardware({"base_estimate": {"delay": 1.5e-3}})
    turned = jnp.asarray([0.0, 1.0, 0.0, 0.0])
    there = sensors.Base(jnp.zeros(3), jnp.asarray([1.0, 0, 0, 0]), jnp.zeros(3), jnp.zeros(3))
    here = sensors.Base(jnp.ones(3), turned, jnp.ones(3), jnp.ones(3))
    buffers = tuple((value,) * own.stages.base_delay for value in there)
    for n in range(2):
        buffers, found = sensors.estimated_base(buffers, here, jnp.asarray(n), own)
    np.testing.assert_allclose(found.position, 0.5)
    np.testing.assert_allclose(found.orientation, np.array([1.0, 1, 0, 0]) / np.sqrt(2))


# ------------------------------------------------------------------------------------------------------------
# Servos


def test_torque_speed_line():
    def limited(torque, rate, limit=4.0, speed=5.0):
        return float(servo.limited(*map(jnp.asarray, (torque, rate, limit, speed))))

    assert limited(9.0, 0.0) == 4.0 and limited(-9.0, 0.0) == -4.0  # standstill
    assert limited(9.0, 2.5) == pytest.approx(2.0) and limited(-9.0, -2.5) == pytest.approx(-2.0)  # half way
    assert limited(9.0, 5.0) == pytest.approx(0.0, abs=1e-12)  # no load
    assert limited(9.0, 6.0) == pytest.approx(-0.8)  # driven beyond it: it brakes
    assert limited(9.0, -2.5) == 4.0  # against the motion the limit alone
    assert limited(1.3, 2.5) == 1.3  # below the line untouched
    assert limited(9.0, 100.0, np.inf, np.inf) == 9.0
    assert limited(9.0, 100.0, 4.0, np.inf) == 4.0


@pytest.mark.parametrize("place", range(4), ids=["torque", "rate", "limit", "speed"])
def test_derivative_of_the_torque_speed_line(place):
    at = [9.0, 2.0, 4.0, 5.0]
    check_tangent(lambda value: servo.limited(*map(jnp.asarray, (*at[:place], value, *at[place + 1 :]))), at[place])


def slid(force, mass=0.01, coulomb=0.1, steps=4000, step=STEP):
    """Angle and rate of one joint on which `force(t)` N m acts against dry friction, over time."""

    def one(carry, n):
        angle, rate, bristle = carry
        bristle, lost, armature = servo.dry_friction(bristle, rate, coulomb, step)
        rate = rate + step / (mass + armature) * (force(n * step) - 0.05 * rate + lost)
        return (angle + step * rate, rate, bristle), (angle, rate)

    return jax.lax.scan(one, (0.0, 0.0, 0.0), jnp.arange(steps))[1]


def test_a_joint_sticks_below_the_friction_without_creep_and_slips_above():
    angle, rate = slid(lambda t: 0.099 * jnp.minimum(t, 1.0))  # laid on gently: a blow would carry it over
    assert np.abs(angle).max() < 2 * servo.PRESLIDING
    np.testing.assert_allclose(angle[-1], 0.99 * servo.PRESLIDING, rtol=1e-3)
    assert abs(float(angle[-1] - angle[2000])) < 1e-6 * servo.PRESLIDING
    assert abs(float(rate[-1])) < 1e-9
    angle, rate = slid(lambda t: 0.15, steps=6000)
    np.testing.assert_allclose(rate[-1], (0.15 - 0.1) / 0.05, rtol=1e-6)  # what is left against the damper
    assert angle[-1] > 1


@pytest.mark.parametrize("mass", [1e-5, 1e-3, 1.0])
@pytest.mark.parametrize("step", [1e-4, 1e-3, 4e-3])
def test_a_sticking_joint_comes_to_rest_at_any_step_and_mass(mass, step):
    angle, rate = slid(lambda t: 0.05 * (t < 0.3), mass=mass, coulomb=1.0, steps=round(6 / step), step=step)
    assert np.abs(angle).max() < servo.PRESLIDING
    np.testing.assert_allclose(rate[-1], 0, atol=1e-6)


def test_friction_dissipates():
    """A joint that swings to and fro has lost friction times the way, but for the bristles' bend at each turn."""
    angle = jnp.asarray(0.2 * np.sin(2 * np.pi * np.arange(4001) / 4000))

    def one(bristle, rate):
        bristle, lost, _ = servo.dry_friction(bristle, rate, 0.1, STEP)
        return bristle, -lost * rate * STEP

    lost = float(jax.lax.scan(one, jnp.zeros(()), jnp.diff(angle) / STEP)[1].sum())
    way = float(np.abs(np.diff(angle)).sum())
    assert 0.1 * (way - 6 * servo.PRESLIDING) < lost < 0.1 * way


@pytest.mark.parametrize("torque", [0.08, 0.13])
def test_derivative_through_stick_and_slip(torque):
    def angle(coulomb):
        return slid(lambda t: torque * jnp.sin(8 * t), coulomb=coulomb, steps=600)[0][-1]

    check_tangent(angle, 0.1, 1e-7, rtol=1e-4)


@pytest.mark.parametrize(("limit", "given"), [(None, 2.0), (1.0, 1.0)])
def test_friction_grows_with_the_torque_that_the_motor_gives_and_with_the_rate(limit, given):
    """Asked for 2 N m: 0.1 N m and a quarter of what a motor limited to 1 N m gives, and 0.2 N m s/rad viscous."""
    friction = {"load_friction": 0.25, "coulomb_friction": 0.1, "viscous_friction": 0.2}
    own = hardware({"servo": friction | {"torque_limit": limit}})
    slipping = servo.Servo((), jnp.ones((4, 3)))
    _, drive = servo.driven(slipping, jnp.full((4, 3), -2.0), jnp.full((4, 3), 0.01), own)
    np.testing.assert_array_equal(drive.motor_torque, -given)
    np.testing.assert_allclose(drive.joint_torque, -given - 0.1 - 0.25 * given - 0.2 * 0.01)


def test_backlash_is_a_dead_zone():
    error = jnp.asarray([-0.03, -0.004, 0.0, 0.004, 0.03])
    np.testing.assert_allclose(servo.across_play(error, jnp.asarray(0.01)), [-0.025, 0, 0, 0, 0.025], atol=1e-15)
    np.testing.assert_array_equal(servo.across_play(error, jnp.asarray(0.0)), error)
    check_tangent(lambda play: servo.across_play(error, play), 0.01, rtol=1e-8)


def test_what_a_robots_file_says_of_its_joints_comes_beside_the_scenario():
    robot, each = load_robot("hubrobo_v3_2"), np.arange(12.0).reshape(4, 3)
    robot = dataclasses.replace(
        robot, friction=0.01 * each, damping=0.02 * each, torque_limit=1 + each,
        passive=((False, False, True),) * 4,
    )  # fmt: skip
    servos = {"coulomb_friction": 0.1, "viscous_friction": 0.2, "torque_limit": 3.0}
    scenario = mc.Scenario().with_overrides({"hardware.servo": servos})
    parameters = mc.parameters(scenario)
    own = hardware_of(parameters, IDEAL, STEP, robot).parameters
    np.testing.assert_allclose(own.coulomb_friction, 0.1 + 0.01 * each)
    np.testing.assert_allclose(own.viscous_friction, 0.2 + 0.02 * each)
    np.testing.assert_allclose(own.torque_limit, np.minimum(3.0, 1 + each))
    np.testing.assert_allclose(own.kp, 50.0 * np.array([1, 1, 0]) * np.ones((4, 1)))
    bare = mc.parameters(mc.Scenario())
    wanted = IDEAL._replace(torque_limit=True, dry_friction=True, viscous_friction=True)
    assert stages_of(mc.Scenario(), bare, robot) == wanted and stages_of(mc.Scenario(), bare) == IDEAL


# ------------------------------------------------------------------------------------------------------------
# Which stages a walk has


def test_stages_are_those_with_a_number():
    changed = mc.Scenario().with_overrides(
        {
            "hardware.force_sensor": {"delay": 3e-3, "filter": 30.0},
            "hardware.servo": {"torque_limit": 4.0, "no_load_speed": 4.8, "coulomb_friction": 0.1},
            "hardware.interpolation": "linear",
            "contact.capture_distance": 0.005,
        }
    )
    wanted = IDEAL._replace(force_delay=8, force_filter=True, torque_limit=True, dry_friction=True, capture=True)
    assert stages_of(changed, mc.parameters(changed)) == wanted
    by_law = changed.with_overrides({"hardware.force_sensor.filtered_by": "law"})
    wanted = wanted._replace(force_filter=False, sampled_filter=True)
    assert stages_of(by_law, mc.parameters(by_law)) == wanted


STAGE_OF = {name: name for name in IDEAL._fields if name in vars(mc.parameters(mc.Scenario()))} | {
    "position_noise": "base_noise", "velocity_noise": "base_noise", "coulomb_friction": "dry_friction",
    "load_friction": "dry_friction", "capture_distance": "capture", "rotational_stiffness": "rotational",
}  # fmt: skip


@pytest.mark.parametrize("name", STAGE_OF)
def test_a_parameter_makes_its_stage_and_no_other(name):
    scenario = mc.Scenario().with_overrides({"hardware.interpolation": "linear"})
    parameters = mc.parameters(scenario)
    assert stages_of(scenario, parameters) == IDEAL
    found = stages_of(scenario, dataclasses.replace(parameters, **{name: jnp.asarray([0.0, 2e-3])}))
    there = {stage for stage, value, none in zip(IDEAL._fields, found, IDEAL, strict=True) if value != none}
    assert there == {STAGE_OF[name]} | ({"linear"} if name == "control_period" else set())
    with pytest.raises(TypeError, match=rf"^parameters.{name}: expected an array, got one that JAX traces"):
        jax.eval_shape(lambda v: stages_of(scenario, dataclasses.replace(parameters, **{name: v})) and v, 0.0)
