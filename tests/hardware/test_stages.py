"""Each stage of hardware against its closed form, and its derivative against central differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware import backlash, control_period, delay, force_sensor, friction, noise, servo, torque_limit
from mjx_climb.hardware.stages import IDEAL, stages_of

STEP = 1e-3


def central(function, at, width=1e-6):
    return (function(at + width) - function(at - width)) / (2 * width)


def slope(function, at):
    return jax.jvp(function, (jnp.asarray(at),), (jnp.ones_like(jnp.asarray(at)),))[1]


def late(signal, steps, length=8):
    """The signal (T,) through a delay of `steps`, from a buffer that begins at zero."""

    def one(buffer, value):
        return delay.delayed(buffer, value[None], delay.weights(jnp.atleast_1d(steps), length))

    return jax.lax.scan(one, delay.start(jnp.zeros(1), length), signal)[1][:, 0]


def test_delay_of_a_ramp_is_exact_at_any_fraction_of_a_step():
    ramp = jnp.arange(1.0, 21.0)
    np.testing.assert_allclose(late(ramp, 3.4)[4:], ramp[4:] - 3.4, rtol=1e-12)


def test_whole_delays_give_back_the_samples_bit_for_bit():
    signal = jnp.asarray(np.random.default_rng(0).normal(size=20))
    for steps in (0, 1, 5, 7):
        np.testing.assert_array_equal(late(signal, float(steps))[steps:], signal[: 20 - steps])


def test_delay_is_linear_between_samples():
    signal = jnp.asarray(np.random.default_rng(1).normal(size=20))
    whole = 0.6 * late(signal, 3.0) + 0.4 * late(signal, 4.0)
    np.testing.assert_allclose(late(signal, 3.4), whole, rtol=1e-12, atol=1e-12)


def test_delay_beyond_its_buffer_is_cut():
    signal = jnp.arange(20.0)
    np.testing.assert_array_equal(late(signal, 40.0), late(signal, 7.0))


@pytest.mark.parametrize("longest", np.arange(0.3, 17.0, 0.7))
def test_the_longest_delay_of_a_buffer_is_that_of_an_independent_delay_line(longest):
    times, signal = STEP * np.arange(40), np.random.default_rng(4).normal(size=40)
    expected = np.interp(times - longest * STEP, times, signal, left=0.0)
    first = int(longest) + 1  # before, the buffer's zeros are part of it
    found = late(jnp.asarray(signal), longest, delay.samples(longest * STEP, STEP))
    np.testing.assert_allclose(found[first:], expected[first:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("steps", [0.3, 3.4, 6.9])
def test_derivative_of_a_delay(steps):
    signal = jnp.asarray(np.random.default_rng(2).normal(size=20))
    of_delay = lambda d: late(signal, d)  # noqa: E731
    np.testing.assert_allclose(slope(of_delay, steps), central(of_delay, steps), rtol=1e-6, atol=1e-8)


def test_derivative_at_a_whole_delay_is_that_of_longer_ones():
    signal = jnp.asarray(np.random.default_rng(3).normal(size=20))
    of_delay = lambda d: late(signal, d)  # noqa: E731
    for steps in (0.0, 3.0, 6.0):
        ahead = (of_delay(steps + 1e-6) - of_delay(steps)) / 1e-6
        np.testing.assert_allclose(slope(of_delay, steps), ahead, rtol=1e-6, atol=1e-8)


def test_a_batch_may_have_a_delay_for_each_robot():
    signal = jnp.arange(20.0)
    delays = jnp.asarray([0.0, 1.5, 4.0])

    def one(buffer, value):
        return delay.delayed(buffer, jnp.full(3, value), delay.weights(delays, 8))

    batch = jax.lax.scan(one, delay.start(jnp.zeros(3), 8), signal)[1]
    for row, steps in enumerate(delays):
        np.testing.assert_array_equal(batch[:, row], late(signal, steps))


def test_length_of_a_buffer_holds_the_longest_delay():
    assert delay.samples(np.zeros(5), STEP) == 0
    for longest in (1e-4, 1e-3, 3e-3, 3.4e-3, 15e-3):
        length = delay.samples(np.array([0.0, longest]), STEP)
        assert length - 2 >= longest / STEP - 1e-9 and length % 4 == 0


def test_filter_has_the_step_response_of_a_first_order_low_pass():
    cutoff, output = 30.0, jnp.zeros(1)
    for n in range(1, 60):
        output = force_sensor.low_passed(output, jnp.ones(1), force_sensor.share(jnp.asarray(cutoff), STEP))
        np.testing.assert_allclose(output, 1 - np.exp(-2 * np.pi * cutoff * n * STEP), rtol=1e-12)


def test_without_a_cut_off_the_filter_lets_all_pass():
    np.testing.assert_array_equal(
        force_sensor.low_passed(jnp.zeros(1), jnp.asarray([3.7]), force_sensor.share(jnp.asarray(jnp.inf), STEP)), [3.7]
    )


def test_derivative_of_the_filter():
    def output(cutoff):
        value = jnp.zeros(1)
        for n in range(20):
            value = force_sensor.low_passed(value, jnp.sin(jnp.asarray([0.3 * n])), force_sensor.share(cutoff, STEP))
        return value

    np.testing.assert_allclose(slope(output, 30.0), central(output, 30.0, 1e-4), rtol=1e-7)


def test_resolution_rounds_and_lets_derivatives_pass():
    force = jnp.asarray([0.24, -0.26, 1.0])
    np.testing.assert_allclose(force_sensor.rounded(force, jnp.asarray(0.1)), [0.2, -0.3, 1.0], rtol=1e-12)
    np.testing.assert_array_equal(force_sensor.rounded(force, jnp.asarray(0.0)), force)
    np.testing.assert_array_equal(slope(lambda f: force_sensor.rounded(f, jnp.asarray(0.1)), force), np.ones(3))


def draw(samples, seed=0.0, channels=12):
    number = jnp.arange(samples)[:, None]
    return np.asarray(noise.normal(jnp.asarray([seed]), number, jnp.arange(channels), jnp.float64))


def test_noise_is_white_with_unit_variance():
    values = draw(40_000)
    count = values.size
    assert abs(values.mean()) < 4 / np.sqrt(count)
    assert abs(values.var() - 1) < 4 * np.sqrt(2 / count)
    for lag in (1, 2, 7):
        assert abs((values[lag:] * values[:-lag]).mean()) < 4 / np.sqrt(count)
    across = np.corrcoef(values.T) - np.eye(12)
    assert np.abs(across).max() < 4.5 / np.sqrt(len(values))


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
    seeds = jnp.asarray([3.0, 0.0, 16_777_215.0])
    together = noise.normal(seeds, jnp.asarray(41), jnp.arange(12)[:, None], jnp.float32)
    for row, seed in enumerate(seeds):
        alone = noise.normal(seed[None], jnp.asarray(41), jnp.arange(12)[:, None], jnp.float32)
        np.testing.assert_array_equal(together[:, row], alone[:, 0])
    double = noise.normal(seeds, jnp.asarray(41), jnp.arange(12)[:, None], jnp.float64)
    np.testing.assert_allclose(together, double, rtol=2e-7, atol=1e-9)
    assert len(np.unique(np.asarray(together))) == 36


def test_torque_speed_line():
    limit, speed = jnp.asarray(4.0), jnp.asarray(5.0)
    given = lambda torque, rate: float(torque_limit.limited(jnp.asarray(torque), jnp.asarray(rate), limit, speed))  # noqa: E731
    assert given(9.0, 0.0) == 4.0 and given(-9.0, 0.0) == -4.0  # standstill
    assert given(9.0, 2.5) == pytest.approx(2.0) and given(-9.0, -2.5) == pytest.approx(-2.0)  # half way
    assert given(9.0, 5.0) == pytest.approx(0.0, abs=1e-12)  # no load
    assert given(9.0, 6.0) == pytest.approx(-0.8)  # driven beyond it: it brakes
    assert given(9.0, -2.5) == 4.0  # against the motion the limit alone
    assert given(1.3, 2.5) == 1.3  # below the line untouched
    assert float(torque_limit.limited(jnp.asarray(9.0), jnp.asarray(100.0), jnp.inf, jnp.inf)) == 9.0
    assert float(torque_limit.limited(jnp.asarray(9.0), jnp.asarray(100.0), limit, jnp.inf)) == 4.0


@pytest.mark.parametrize("number", ["torque", "rate", "limit", "speed"])
def test_derivative_of_the_torque_speed_line(number):
    at = {"torque": 9.0, "rate": 2.0, "limit": 4.0, "speed": 5.0}

    def torque(value):
        values = {name: jnp.asarray(x) for name, x in (at | {number: value}).items()}
        return torque_limit.limited(values["torque"], values["rate"], values["limit"], values["speed"])

    np.testing.assert_allclose(slope(torque, at[number]), central(torque, at[number]), rtol=1e-8, atol=1e-9)


def slid(force, mass=0.01, coulomb=0.1, steps=4000, step=STEP):
    """Angle and rate of one joint on which `force(t)` N m acts against dry friction, over time."""

    def one(carry, n):
        angle, rate, bristle = carry
        bristle = friction.bent(bristle, rate, step)
        lost, armature = friction.dry(bristle, rate, coulomb, step)
        rate = rate + step / (mass + armature) * (force(n * step) - 0.05 * rate + lost)
        return (angle + step * rate, rate, bristle), (angle, rate)

    return jax.lax.scan(one, (0.0, 0.0, 0.0), jnp.arange(steps))[1]


def test_a_joint_sticks_below_the_friction_and_does_not_creep():
    angle, rate = slid(lambda t: 0.099 * jnp.minimum(t, 1.0))  # laid on gently: a blow would carry it over
    assert np.abs(angle).max() < 2 * friction.PRESLIDING
    np.testing.assert_allclose(angle[-1], 0.99 * friction.PRESLIDING, rtol=1e-3)
    assert abs(float(angle[-1] - angle[2000])) < 1e-6 * friction.PRESLIDING
    assert abs(float(rate[-1])) < 1e-9


def test_a_joint_slips_above_the_friction():
    angle, rate = slid(lambda t: 0.15, steps=6000)
    np.testing.assert_allclose(rate[-1], (0.15 - 0.1) / 0.05, rtol=1e-6)  # what is left against the damper
    assert angle[-1] > 1


@pytest.mark.parametrize("mass", [1e-5, 1e-3, 1.0])
@pytest.mark.parametrize("step", [1e-4, 1e-3, 4e-3])
def test_a_sticking_joint_comes_to_rest_at_any_step_and_mass(mass, step):
    angle, rate = slid(lambda t: 0.05 * (t < 0.3), mass=mass, coulomb=1.0, steps=round(6 / step), step=step)
    assert np.abs(angle).max() < friction.PRESLIDING
    np.testing.assert_allclose(rate[-1], 0, atol=1e-6)


def test_friction_dissipates():
    """A joint that swings to and fro has lost friction times the way, but for the bristles' bend at each turn."""
    amplitude, steps = 0.2, 4000
    angle = amplitude * np.sin(2 * np.pi * np.arange(steps + 1) / steps)
    bristle, lost = jnp.zeros(()), 0.0
    for rate in np.diff(angle) / STEP:
        bristle = friction.bent(bristle, rate, STEP)
        lost -= float(friction.dry(bristle, rate, 0.1, STEP)[0]) * rate * STEP
    way = np.abs(np.diff(angle)).sum()
    assert 0.1 * (way - 6 * friction.PRESLIDING) < lost < 0.1 * way


def test_friction_grows_with_the_load_and_the_rate():
    scenario = mc.Scenario().with_overrides({"hardware.servo": {"load_friction": 0.25, "coulomb_friction": 0.1}})
    numbers = mc.parameters(scenario)
    rest = jnp.ones((3, 4, 1))
    memory = servo.Servo((), rest)
    _, drive = servo.driven(memory, -2.0 * rest, 0.01 * rest, numbers, stages_of(scenario, numbers), (), STEP)
    np.testing.assert_allclose(drive.joint_torque, -2.0 - 0.6)
    np.testing.assert_array_equal(drive.motor_torque, -2.0)
    assert float(friction.viscous(jnp.asarray(3.0), jnp.asarray(0.2))) == pytest.approx(-0.6)


@pytest.mark.parametrize("torque", [0.08, 0.13])
def test_derivative_through_stick_and_slip(torque):
    def angle(coulomb):
        return slid(lambda t: torque * jnp.sin(8 * t), coulomb=coulomb, steps=600)[0][-1]

    np.testing.assert_allclose(slope(angle, 0.1), central(angle, 0.1, 1e-7), rtol=1e-4, atol=1e-9)


def test_backlash_is_a_dead_zone():
    error = jnp.asarray([-0.03, -0.004, 0.0, 0.004, 0.03])
    np.testing.assert_allclose(backlash.across(error, jnp.asarray(0.01)), [-0.025, 0, 0, 0, 0.025], atol=1e-15)
    np.testing.assert_array_equal(backlash.across(error, jnp.asarray(0.0)), error)
    passed = lambda play: backlash.across(error, play)  # noqa: E731
    np.testing.assert_allclose(slope(passed, 0.01), central(passed, 0.01), rtol=1e-8, atol=1e-9)


def test_the_law_is_worked_out_at_the_first_step_of_each_period():
    steps = control_period.period_steps(jnp.asarray([0.0, 1e-3, 5e-3, 7e-3]), STEP)
    np.testing.assert_array_equal(steps, [1, 1, 5, 7])
    for n in (0, 4, 5, 34, 35, 7999, 8000):
        np.testing.assert_array_equal(control_period.steps_into(jnp.asarray(n), steps), [0, 0, n % 5, n % 7])


def test_a_line_reaches_each_target_in_the_last_step_of_its_period():
    steps = jnp.asarray([4.0])
    line = [float(control_period.interpolated(2.0, 6.0, jnp.asarray([i]), steps)[0]) for i in range(4)]
    assert line == [3.0, 4.0, 5.0, 6.0]
    assert float(control_period.interpolated(2.0, 6.1, jnp.asarray([0.0]), jnp.ones(1))[0]) == 6.1


def test_stages_are_those_with_a_number():
    scenario = mc.Scenario()
    assert stages_of(scenario, mc.parameters(scenario)) == IDEAL
    changed = scenario.with_overrides(
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
def test_a_number_makes_its_stage_and_no_other(name):
    scenario = mc.Scenario().with_overrides({"hardware.interpolation": "linear"})
    numbers = mc.parameters(scenario)
    assert stages_of(scenario, numbers) == IDEAL
    found = stages_of(scenario, dataclasses.replace(numbers, **{name: jnp.asarray([0.0, 2e-3])}))
    there = {stage for stage, value, none in zip(IDEAL._fields, found, IDEAL, strict=True) if value != none}
    assert there == {STAGE_OF[name]} | ({"linear"} if name == "control_period" else set())
