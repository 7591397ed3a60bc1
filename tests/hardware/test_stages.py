"""Each stage of hardware against its closed form, and its derivative against central differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware import bus as signals
from mjx_climb.hardware import sensors, servo
from mjx_climb.hardware.stages import IDEAL, hardware_of, lacking, stages_of
from mjx_climb.hardware.velocity_commanded import VelocityCommanded
from mjx_climb.robot_import.load import load_robot

STEP = 1e-3
PRESLIDING = mc.Scenario().hardware.servo.presliding


# --- Delays


def late(signal, steps, length=8):
    """The signal (T,) through a delay of `steps`, from a buffer that begins at zero."""

    def one(buffer, value):
        return signals.delayed(buffer, value, signals.weights(jnp.asarray(steps, float), length))

    return jax.lax.scan(one, (jnp.zeros(()),) * length, signal)[1]


@pytest.mark.parametrize("longest", [0.1, 0.3, 1.0, 2.4, 3.0, 3.4, 7.9, 15.0, 16.4])
def test_the_longest_delay_of_a_buffer_is_that_of_an_independent_delay_line(longest):
    """Whole delays give back the samples bit for bit; what is beyond the buffer is cut."""
    times, signal = STEP * np.arange(40), np.random.default_rng(4).normal(size=40)
    expected = np.interp(times - longest * STEP, times, signal, left=0.0)
    first = int(longest) + 1  # before, the buffer's zeros are part of it
    length = signals.buffer_length(np.array([0.0, longest * STEP]), STEP)
    np.testing.assert_allclose(late(signal, longest, length)[first:], expected[first:], rtol=1e-9, atol=1e-12)
    assert length % 4 == 0 and signals.buffer_length(np.zeros(5), STEP) == 0
    if longest.is_integer():
        np.testing.assert_array_equal(late(signal, longest, length)[int(longest) :], signal[: -int(longest)])
    np.testing.assert_array_equal(late(signal, 40, length), late(signal, length - 1, length))


def test_a_delay_that_no_buffer_holds_is_refused():
    with pytest.raises(ValueError, match=r"^delay: expected at most 500 time steps of 0.001 s, got 501$"):
        signals.buffer_length(0.501, STEP)
    assert signals.buffer_length(0.5, STEP) > 500


# --- Resolution, control period


def test_resolution_rounds_and_lets_derivatives_pass():
    force = jnp.asarray([0.24, -0.26, 1.0])
    np.testing.assert_allclose(signals.rounded(force, jnp.asarray(0.1)), [0.2, -0.3, 1.0], rtol=1e-12)
    np.testing.assert_array_equal(signals.rounded(force, jnp.asarray(0.0)), force)
    slope = jax.jvp(lambda f: signals.rounded(f, jnp.asarray(0.1)), (force,), (jnp.ones(3),))[1]
    np.testing.assert_array_equal(slope, np.ones(3))


@pytest.mark.parametrize(("period", "count"), [(0.0, 1), (1e-3, 1), (5e-3, 5), (7e-3, 7)])
def test_the_law_is_evaluated_at_the_first_step_of_each_period(period, count):
    steps = signals.period_steps(jnp.asarray(period), STEP)
    into = [int(signals.steps_into(jnp.asarray(n), steps)) for n in (0, 4, 5, 34, 35, 7999, 8000)]
    assert steps == count and into == [n % count for n in (0, 4, 5, 34, 35, 7999, 8000)]


def test_what_a_law_hands_on_unchanged_is_held_without_an_operation():
    program = jax.make_jaxpr(lambda now, new, same: signals.held(now, (new, same), (0.0 * new, same)))(True, 1.0, 2.0)
    assert program.jaxpr.outvars[1] is program.jaxpr.invars[2]
    assert signals.held(jnp.asarray(False), (1.0, 2.0), (3.0, 4.0)) == (3.0, 4.0)


# --- Noise


def draw(samples, channels, seed=0.0):
    one = lambda n: sensors.normal(jnp.asarray(seed), n, jnp.asarray(channels), jnp.float64)  # noqa: E731
    return np.asarray(jax.vmap(one)(jnp.arange(samples)))


def test_noise_is_white_with_unit_variance():
    """Those of the force sensors and of the base estimate: mean zero, no correlation in time or between them."""
    values = draw(40_000, [*range(12), *range(sensors.BASE_CHANNELS, sensors.BASE_CHANNELS + 6)])
    count = len(values)
    assert np.abs(values.mean(0)).max() < 4.5 / np.sqrt(count)
    assert np.abs(values.var(0) - 1).max() < 4.5 * np.sqrt(2 / count)
    for lag in (1, 2, 7):
        assert abs((values[lag:] * values[:-lag]).mean()) < 4 / np.sqrt(values.size)
    assert np.abs(np.corrcoef(values.T) - np.eye(18)).max() < 4.5 / np.sqrt(count)


def test_noise_has_the_distribution_of_a_sum_of_eight_uniform_numbers():
    values, count = draw(40_000, range(12)).ravel(), 8

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


def test_a_late_base_estimate_keeps_unit_quaternions():
    scenario = mc.Scenario().with_overrides({"hardware.base_estimate.delay": 1.5e-3})
    own = hardware_of(mc.parameters(scenario), stages_of(mc.parameters(scenario), scenario.time_step), STEP)
    turned = jnp.asarray([0.0, 1.0, 0.0, 0.0])
    there = sensors.Base(jnp.zeros(3), jnp.asarray([1.0, 0, 0, 0]), jnp.zeros(3), jnp.zeros(3))
    here = sensors.Base(jnp.ones(3), turned, jnp.ones(3), jnp.ones(3))
    buffers = tuple((value,) * own.stages.base_delay for value in there)
    for n in range(2):
        buffers, found = sensors.estimated_base(buffers, here, jnp.asarray(n), own)
    np.testing.assert_allclose(found.position, 0.5)
    np.testing.assert_allclose(found.orientation, np.array([1.0, 1, 0, 0]) / np.sqrt(2))


def of_keys(keys):
    """Return the hardware of a scenario with these keys of its section."""
    scenario = mc.Scenario().with_overrides({"hardware": keys})
    own = mc.parameters(scenario)
    return hardware_of(own, stages_of(own, scenario.time_step), STEP)


def test_a_force_sensor_is_late_then_biased_noisy_rounded_and_filtered():
    """In this order, each axis of each foot with a noise of its own; the base's place and speed are noisy too."""
    sensor = {"delay": 1.5e-3, "bias": 0.3, "noise": 0.05, "resolution": 0.01, "filter": 60.0, "drift": 2.0}
    own = of_keys({"force_sensor": sensor, "base_estimate": {"position_noise": 0.02, "velocity_noise": 0.3}, "seed": 7})
    forces, share = np.random.default_rng(0).normal(size=(6, 4, 3)), 1 - np.exp(-2 * np.pi * 60.0 * STEP)
    none, filtered, drift = jnp.zeros((4, 3)), 0.0, 0.0
    read = sensors.ForceSensor((none,) * own.stages.force_delay, none, none)
    base = sensors.Base(jnp.ones(3), jnp.asarray([0.0, 1, 0, 0]), jnp.arange(3.0), jnp.arange(3.0))
    step = jax.jit(lambda read, force, n: (sensors.measured_force(read, force, n, own), n)[0])
    for n, force in enumerate(forces):
        read, found = step(read, force, n)
        seen = sum(forces[n - age] / 2 for age in (1, 2) if age <= n) + np.zeros((4, 3))
        noise, steps = (
            sensors.normal(jnp.asarray(7.0), jnp.asarray(n), first + jnp.arange(12), jnp.float64).reshape(3, 4).T
            for first in (0, sensors.DRIFT_CHANNELS)
        )
        drift = drift + 2.0 * math.sqrt(STEP) * steps
        filtered = filtered + share * (np.round((seen + 0.3 + drift + 0.05 * noise) / 0.01) * 0.01 - filtered)
        np.testing.assert_allclose(found, filtered, atol=1e-6)
    _, there = sensors.estimated_base((), base, jnp.asarray(3), own)
    noise = sensors.normal(jnp.asarray(7.0), jnp.asarray(3), sensors.BASE_CHANNELS + jnp.arange(6), jnp.float64)
    np.testing.assert_allclose(there.position, 1 + 0.02 * noise[:3], rtol=1e-6)
    np.testing.assert_allclose(there.linear_velocity, np.arange(3) + 0.3 * noise[3:], rtol=1e-6)
    assert there.orientation is base.orientation and there.angular_velocity is base.angular_velocity


# --- Servos


def test_a_servo_has_play_limits_and_friction_in_their_order():
    """Of the error beyond the play; cut by the torque-speed line, then the current; gears rub under what is left."""
    keys = {"torque_limit": 1.0, "no_load_speed": 5.0, "current_limit": 0.6, "backlash": 0.02, "coulomb_friction": 0.05,
            "load_friction": 0.2, "viscous_friction": 0.03}  # fmt: skip
    own, random = of_keys({"servo": keys}), np.random.default_rng(0)
    error, rates = (
        random.normal(0, 0.03, (50, 4, 3)),
        random.normal(0, 2.0, (50, 4, 3)) * random.choice([1e-3, 1], 50)[:, None, None],
    )
    gains = servo.gains_of(own)

    def one(error, rates):
        at = servo.Joints(0 * error, rates, None)
        return servo.joint_loop(servo.begin(0 * error, own.stages), error, at, gains, own)

    found, drive = jax.jit(jax.vmap(one))(error, rates)
    asked = 50.0 * np.sign(error) * np.maximum(abs(error) - 0.01, 0) - float(own.parameters.joint_loop.kd) * rates
    highest, lowest = np.clip(1 - rates / 5, -1, 1), -np.clip(1 + rates / 5, -1, 1)
    motor = np.clip(np.clip(asked, lowest, highest), -0.6, 0.6)
    bend = np.clip(rates * STEP / PRESLIDING, -1, 1)
    share = bend + rates * (servo.RELAXATION + STEP) / PRESLIDING
    lost = (0.05 + 0.2 * abs(motor)) * np.clip(share, -1, 1)
    np.testing.assert_allclose(drive.motor_torque, motor, atol=1e-6)
    np.testing.assert_allclose(drive.joint_torque, motor - lost - 0.03 * rates, atol=1e-6)
    np.testing.assert_allclose(found.bristle, bend, rtol=1e-6)
    sticks = (0.05 + 0.2 * abs(motor)) * (servo.RELAXATION + STEP) / PRESLIDING * STEP
    np.testing.assert_allclose(drive.armature, np.where(abs(share) < 1, sticks, 0), rtol=1e-5)
    assert (abs(motor) == 0.6).any() and (motor == highest).any() and 0.1 < (abs(share) < 1).mean() < 0.9


def test_what_a_loop_may_ask_for_is_cut_by_pwm_or_by_current():
    """Of a voltage by the share of the torque at standstill; the integral does not grow there."""
    voltage = {"drive": "voltage", "torque_limit": 8.0, "no_load_speed": 6.0, "pwm_limit": 0.75, "current_limit": 2.0}
    torques = {"torque_limit": 8.0, "current_limit": 2.0}
    for keys, most in ((voltage, 6.0), (torques, 2.0), ({"torque_limit": 1.5, "current_limit": 2.0}, 1.5)):
        assert float(servo.largest_output(of_keys({"servo": keys}))) == pytest.approx(most)


def test_motors_that_follow_rates_are_commanded_once_a_period_of_their_manager():
    """`p e + d de/dt` of the errors of two commands, within the largest rate; the motor gives its gain of the rest."""
    drive = VelocityCommanded(
        p=12.0, d=0.15, manager_period=3e-3, velocity_gain=5.0, largest_rate=1.5, torque_limit=4.0
    )
    random, memory = np.random.default_rng(0), drive.init(jnp.zeros((4, 3)))
    step = jax.jit(lambda *given: drive.step(*given, STEP))
    last, seen = np.zeros((4, 3)), []
    for n in range(8):
        targets, angles, rates = random.normal(0, [[[0.1]], [[0.02]], [[0.5]]], (3, 4, 3))
        memory, found = step(memory, targets, None, servo.Joints(angles, rates, None))
        if n % 3 == 0:
            error = targets - angles
            rate, last = np.clip(12 * error + 0.15 * (error - last) / 3e-3, -1.5, 1.5), error
        asked = 5 * (rate - rates)
        np.testing.assert_allclose(found.motor_torque, np.clip(asked, -4, 4), atol=1e-6)
        np.testing.assert_allclose(found.joint_torque, found.motor_torque)
        np.testing.assert_allclose(found.armature, np.where(abs(asked) < 4, 5 * STEP, 0), atol=1e-9)
        seen += [abs(rate) == 1.5, abs(asked) > 4]
    assert 0.1 < np.mean(seen[::2]) < 0.9 and 0.05 < np.mean(seen[1::2]) < 0.9
    loaded = dataclasses.replace(drive, armature=0.02)
    *_, found = loaded.step(memory, targets, None, servo.Joints(angles, rates, None), STEP)
    np.testing.assert_allclose(found.armature, 0.02 + np.where(abs(asked) < 4, 5 * STEP, 0), atol=1e-9)
    for each, armature in ((drive, 0.0), (loaded, 0.02)):
        assert [float(value) for value in each.spring(STEP)] == pytest.approx([60.0, 5.75, 5e-3 + armature])


LINE = {  # torque asked for, rate, limit and no-load speed, and the torque given
    "standstill": (9.0, 0.0, 4.0, 5.0, 4.0), "standstill, backwards": (-9.0, 0.0, 4.0, 5.0, -4.0),
    "half way": (9.0, 2.5, 4.0, 5.0, 2.0), "half way, backwards": (-9.0, -2.5, 4.0, 5.0, -2.0),
    "no load": (9.0, 5.0, 4.0, 5.0, 0.0), "driven beyond it: it brakes": (9.0, 6.0, 4.0, 5.0, -0.8),
    "against the motion": (9.0, -2.5, 4.0, 5.0, 4.0), "below the line": (1.3, 2.5, 4.0, 5.0, 1.3),
    "no limit": (9.0, 100.0, np.inf, np.inf, 9.0), "the same at any speed": (9.0, 100.0, 4.0, np.inf, 4.0),
}  # fmt: skip


@pytest.mark.parametrize("name", LINE)
def test_torque_speed_line(name):
    *at, expected = LINE[name]
    assert float(servo.limited(*map(jnp.asarray, at))) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.slow
def test_derivatives_of_the_torque_speed_line():
    """By torque, rate, limit and no-load speed."""
    at, width = jnp.array([9.0, 2.0, 4.0, 5.0]), 1e-6
    central = [(servo.limited(*(at + way)) - servo.limited(*(at - way))) / (2 * width) for way in width * np.eye(4)]
    np.testing.assert_allclose(jax.jacfwd(lambda at: servo.limited(*at))(at), central, rtol=1e-7, atol=1e-9)


def slid(force, mass=0.01, coulomb=0.1, steps=4000, step=STEP):
    """Angle and rate of one joint on which `force(t)` N m acts against dry friction, over time."""

    def one(carry, n):
        angle, rate, bristle = carry
        bristle, lost, armature = servo.dry_friction(bristle, rate, coulomb, PRESLIDING, step)
        rate = rate + step / (mass + armature) * (force(n * step) - 0.05 * rate + lost)
        return (angle + step * rate, rate, bristle), (angle, rate)

    return jax.lax.scan(one, (0.0, 0.0, 0.0), jnp.arange(steps))[1]


def test_a_joint_sticks_below_the_friction_without_creep_and_slips_above():
    angle, rate = slid(lambda t: 0.099 * jnp.minimum(t, 1.0))  # laid on gently: a blow would carry it over
    assert np.abs(angle).max() < 2 * PRESLIDING
    np.testing.assert_allclose(angle[-1], 0.99 * PRESLIDING, rtol=1e-3)
    assert abs(float(angle[-1] - angle[2000])) < 1e-6 * PRESLIDING
    assert abs(float(rate[-1])) < 1e-9
    angle, rate = slid(lambda t: 0.15, steps=6000)
    np.testing.assert_allclose(rate[-1], (0.15 - 0.1) / 0.05, rtol=1e-6)  # what is left against the damper
    assert angle[-1] > 1


@pytest.mark.parametrize("mass", [1e-5, 1e-3, 1.0])
@pytest.mark.parametrize("step", [1e-4, 1e-3, 4e-3])
def test_a_sticking_joint_comes_to_rest_at_any_step_and_mass(mass, step):
    angle, rate = slid(lambda t: 0.05 * (t < 0.3), mass=mass, coulomb=1.0, steps=round(6 / step), step=step)
    assert np.abs(angle).max() < PRESLIDING
    np.testing.assert_allclose(rate[-1], 0, atol=1e-6)


def test_what_a_robots_file_says_of_its_joints_comes_beside_the_scenario():
    robot, each = load_robot("hubrobo_v3_2"), np.arange(12.0).reshape(4, 3)
    robot = dataclasses.replace(
        robot, friction=0.01 * each, damping=0.02 * each, torque_limit=1 + each,
        passive=((False, False, True),) * 4,
    )  # fmt: skip
    servos = {"coulomb_friction": 0.1, "viscous_friction": 0.2, "torque_limit": 3.0}
    parameters = mc.parameters(mc.Scenario().with_overrides({"hardware.servo": servos}))
    own = hardware_of(parameters, IDEAL, STEP, robot).parameters
    np.testing.assert_allclose(own.drive.coulomb_friction, 0.1 + 0.01 * each)
    np.testing.assert_allclose(own.drive.viscous_friction, 0.2 + 0.02 * each)
    np.testing.assert_allclose(own.drive.torque_limit, np.minimum(3.0, 1 + each))
    np.testing.assert_allclose(own.joint_loop.kp, 50.0 * np.array([1, 1, 0]) * np.ones((4, 1)))
    wanted = IDEAL._replace(torque_limit=True, dry_friction=True, viscous_friction=True)
    assert stages_of(mc.parameters(mc.Scenario()), mc.Scenario().time_step, robot) == wanted


# --- Dead sensors


def test_a_dead_sensor_reads_nothing_from_its_instant_on():
    scenario = mc.Scenario().with_overrides({"hardware.force_sensor.dead": {"LF": 0.003, "RH": 0.0}})
    own = mc.parameters(scenario)
    hardware, force = hardware_of(own, stages_of(own, scenario.time_step), STEP), jnp.arange(1.0, 13.0).reshape(4, 3)
    for step, alive in ((0, [1, 1, 0, 1]), (2, [1, 1, 0, 1]), (3, [0, 1, 0, 1]), (9, [0, 1, 0, 1])):
        _, read = sensors.measured_force(sensors.ForceSensor(()), force, jnp.asarray(step), hardware)
        np.testing.assert_array_equal(read, force * jnp.asarray(alive)[:, None])


# --- Which stages a walk has


SENSOR, BASE, MOTORS = "hardware.force_sensor", "hardware.base_estimate", "hardware.servo"
OF_LOAD = {"dry_friction": True, "load_torque": True}
# a value of one of two robots, the other's being none, and the stages that it asks for
ASKED = {
    f"{SENSOR}.delay": (2.4e-3, {"force_delay": 4}), f"{SENSOR}.drift": (0.1, {"force_drift": True}),
    f"{SENSOR}.noise": (0.1, {"force_noise": True}), f"{SENSOR}.bias": (0.1, {"force_bias": True}),
    f"{SENSOR}.resolution": (0.1, {"force_resolution": True}), f"{SENSOR}.filter": (30.0, {"force_filter": True}),
    f"{SENSOR}.dead": (0.1, {"force_dead": True}), f"{BASE}.delay": (6e-3, {"base_delay": 8}),
    f"{BASE}.position_noise": (0.1, {"base_noise": True}), f"{BASE}.velocity_noise": (0.1, {"base_noise": True}),
    "hardware.control_period": (5e-3, {"control_period": True}), "hardware.command_delay": (1e-3, {"command_delay": 4}),
    f"{MOTORS}.delay": (3e-3, {"servo_delay": 8}), f"{MOTORS}.rate": (500.0, {"servo_rate": True}),
    f"{MOTORS}.profile_velocity": (1.0, {"profile": True}), f"{MOTORS}.profile_acceleration": (1.0, {}),
    "control.ki": (1.0, {"integral": True}), f"{MOTORS}.supply_voltage": (12.0, {"supply_voltage": True}),
    f"{MOTORS}.rated_voltage": (12.0, {}), f"{MOTORS}.supply_resistance": (0.1, {"supply_resistance": True}),
    f"{MOTORS}.torque_limit": (2.0, {"torque_limit": True}), f"{MOTORS}.current_limit": (2.0, {"current_limit": True}),
    f"{MOTORS}.no_load_speed": (6.0, {}), f"{MOTORS}.armature": (0.1, {"armature": True}),
    f"{MOTORS}.coulomb_friction": (0.1, {"dry_friction": True}),
    f"{MOTORS}.load_friction": (0.1, {"dry_friction": True}),
    f"{MOTORS}.external_load_friction": (0.1, OF_LOAD),
    f"{MOTORS}.stribeck_friction": (0.1, {"dry_friction": True, "stribeck": True}),
    f"{MOTORS}.stribeck_load_friction": (0.1, {"dry_friction": True, "stribeck": True}),
    f"{MOTORS}.stribeck_external_load_friction": (0.1, OF_LOAD | {"stribeck": True}),
    f"{MOTORS}.quadratic_load_friction": (0.1, OF_LOAD | {"stribeck": True}),
    f"{MOTORS}.quadratic_external_load_friction": (0.1, OF_LOAD | {"stribeck": True}),
    f"{MOTORS}.viscous_friction": (0.1, {"viscous_friction": True}), f"{MOTORS}.backlash": (0.1, {"backlash": True}),
    "gait.height": (0.9, {"height": True}), "gait.sway": (0.01, {"sway": True}),
    "gait.landing_speed": (0.1, {"landing_speed": True}),
}  # fmt: skip
OF_FORCES = {
    "force_delay",
    "force_drift",
    "force_noise",
    "force_bias",
    "force_resolution",
    "force_filter",
    "force_dead",
}


@pytest.mark.parametrize("path", ASKED)
def test_a_value_of_some_robot_asks_for_its_stages_and_no_others(path):
    """And so does one whose derivative is asked for, whatever its value; of delays the buffers are then shortest."""
    own, (value, stages) = mc.parameters(mc.Scenario()), ASKED[path]
    none = np.asarray(own.at(path))
    both = np.stack([none, np.where(np.ones_like(none, bool), value, none)])
    found = stages_of(own.replace_alone({path: both}), STEP)
    assert found == IDEAL._replace(**stages)
    assert (found.force, found.silent_sensors) == (
        bool(OF_FORCES & {*stages}),
        bool({"force_dead", "force_resolution"} & {*stages}),
    )
    assert stages_of(own, STEP) == IDEAL
    moving = {name: 4 if name.endswith("_delay") else asked for name, asked in stages.items()}
    assert stages_of(own, STEP, moving=(path,)) == IDEAL._replace(**moving)
    assert lacking(IDEAL, found) == bool(stages) and not lacking(found, IDEAL) and not lacking(found, found)


@pytest.mark.parametrize(
    ("keys", "stages"),
    [
        ({"force_sensor": {"source": "joint_effort"}}, {"joint_effort": True}),
        ({"force_sensor": {"axes": "z"}}, {"force_along_normal": True}),
        ({"interpolation": "linear"}, {}),
        ({"interpolation": "linear", "control_period": 5e-3}, {"linear": True, "control_period": True}),
        ({"servo": {"drive": "voltage", "torque_limit": 4.0, "no_load_speed": 6.0}},
         {"voltage": True, "torque_limit": True}),
    ],
)  # fmt: skip
def test_a_choice_asks_for_its_stages(keys, stages):
    own = mc.parameters(mc.Scenario().with_overrides({"hardware": keys}))
    found = stages_of(own, STEP)
    assert found == IDEAL._replace(**stages) and found.force == ("force_sensor" in keys)
    robot = dataclasses.replace(load_robot("hubrobo_v3_2"), torque_limit=np.ones((4, 3)), friction=None, damping=None)
    of_motors = {"torque_limit": True, "current_limit": found.voltage}
    assert stages_of(own, STEP, robot) == IDEAL._replace(**stages | of_motors)


def test_values_that_are_traced_cannot_decide():
    own = mc.parameters(mc.Scenario())

    def asked(value):
        stages_of(own.replace_alone({f"{SENSOR}.noise": value}), STEP)

    with pytest.raises(
        TypeError, match=r"^parameters.hardware.force_sensor.noise: expected an array, got one that JAX"
    ):
        jax.jit(asked)(1.0)


def test_a_supply_moves_the_gains_of_a_loop_of_voltages():
    """Torque at standstill, speed without load and, on a voltage, gains in proportion; where both are known."""
    motor = {"torque_limit": 8.0, "no_load_speed": 6.0, "rated_voltage": 12.0, "supply_voltage": 15.0}
    for changes, drive, scale, of_gains in (
        ({}, "torque", 1.25, 1.0), ({}, "voltage", 1.25, 1.25), ({"supply_voltage": np.inf}, "voltage", 1.0, 1.0),
        ({"rated_voltage": np.inf}, "voltage", 1.0, 1.0),
    ):  # fmt: skip
        own = of_keys({"servo": motor | {"drive": drive}})
        asked = mc.parameters(mc.Scenario().with_overrides({"hardware.servo": motor | {"drive": drive}}))
        unknown = asked.replace_alone({f"{MOTORS}.{name}": np.asarray(value) for name, value in changes.items()})
        own = hardware_of(unknown, own.stages, STEP).parameters  # of a batch in which others have both
        assert [float(own.drive.torque_limit), float(own.drive.no_load_speed)] == [8.0 * scale, 6.0 * scale]
        assert [float(own.joint_loop.kp), float(own.joint_loop.kd)] == pytest.approx([50 * of_gains, 0.2 * of_gains])


def test_a_filter_is_the_sensors_or_the_laws():
    by_law = mc.Scenario().with_overrides({"hardware.force_sensor": {"filter": 30.0, "filtered_by": "law"}})
    assert stages_of(mc.parameters(by_law), by_law.time_step) == IDEAL._replace(sampled_filter=True)


@pytest.mark.parametrize(("who", "period"), [("law", 5e-3), ("sensor", STEP)])
def test_a_filter_takes_in_what_its_own_samples_bring(who, period):
    """The law's samples come once a control period, the sensor's every time step."""
    sensor = {"filter": 30.0, "filtered_by": who}
    scenario = mc.Scenario().with_overrides({"hardware": {"force_sensor": sensor, "control_period": 5e-3}})
    own = mc.parameters(scenario)
    share = hardware_of(own, stages_of(own, scenario.time_step), STEP).pace.filter_share
    assert float(share) == pytest.approx(1 - np.exp(-2 * np.pi * 30.0 * period), rel=1e-6)


_FORCE, _BASE, _SERVO = "hardware.force_sensor", "hardware.base_estimate", "hardware.servo"
STAGE_OF = {
    **{f"{_FORCE}.{name}": f"force_{name}" for name in ("delay", "noise", "bias", "resolution", "filter", "dead")},
    f"{_BASE}.delay": "base_delay", f"{_BASE}.position_noise": "base_noise", f"{_BASE}.velocity_noise": "base_noise",
    "hardware.control_period": "control_period", "hardware.command_delay": "command_delay",
    f"{_SERVO}.delay": "servo_delay", f"{_SERVO}.rate": "servo_rate", f"{_SERVO}.profile_velocity": "profile",
    f"{_SERVO}.coulomb_friction": "dry_friction", f"{_SERVO}.load_friction": "dry_friction",
    **{f"{_SERVO}.{name}": name for name in ("supply_voltage", "supply_resistance", "torque_limit", "current_limit",
                                             "armature", "viscous_friction", "backlash")},
    "control.ki": "integral", "gait.height": "height", "gait.sway": "sway", "gait.landing_speed": "landing_speed",
}  # fmt: skip


@pytest.mark.parametrize("name", STAGE_OF)
def test_a_parameter_makes_its_stage_and_no_other(name):
    scenario = mc.Scenario().with_overrides({"hardware.interpolation": "linear"})
    parameters = mc.parameters(scenario)
    assert stages_of(parameters, scenario.time_step) == IDEAL
    values = jnp.asarray([0.0, 2e-3] * (2 if name.endswith("dead") else 1))  # of limbs
    found = stages_of(parameters.replace({name: values}), scenario.time_step)
    there = {stage for stage, value, none in zip(IDEAL._fields, found, IDEAL, strict=True) if value != none}
    assert there == {STAGE_OF[name]} | ({"linear"} if name == "hardware.control_period" else set())
    with pytest.raises(TypeError, match=rf"^parameters.{name}: expected an array, got one that JAX traces"):
        jax.eval_shape(lambda v: stages_of(parameters.replace({name: v}), scenario.time_step) and v, values)
