"""Servos as they are: the loop of a Dynamixel, its motor on a voltage, and friction of BAM's models M1 to M6."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.hardware import servo
from mjx_climb.hardware.actuator import Joints
from mjx_climb.hardware.stages import hardware_of, stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import growth, largest_time_step
from mjx_climb.scenario import registers
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.messages import ConfigError
from tests import derivatives
from tuning.comparisons.stability_limit import spectral_radius

STEP = 1e-3
PRESLIDING = mc.Scenario().hardware.servo.presliding
MOTOR = {"drive": "voltage", "torque_limit": 8.0, "no_load_speed": 6.0}


def hardware(servos=(), control=(), step=STEP):
    """Return the hardware of a scenario with these keys of `hardware.servo` and `control`."""
    keys = {f"hardware.servo.{key}": value for key, value in dict(servos).items()}
    keys |= {f"control.{key}": value for key, value in dict(control).items()}
    scenario = mc.Scenario().with_overrides({"time_step": step} | keys)
    own = mc.parameters(scenario)
    return hardware_of(own, stages_of(own, scenario.time_step), step)


def one_joint(own, target, load, inertia=0.05, steps=3000, angle=0.0):
    """Return angle, rate and motor torque over time of one joint under its servo and a `load(angle, time)` in N m."""
    none = jnp.zeros((1, 1))

    def one(carry, n):
        angle, rate, servos = carry
        now = Joints(angle, rate, None)
        heavy = load(angle, n * own.time_step)
        if own.stages.load_torque:
            servos = servos._replace(load=heavy)
        servos, drive = servo.joint_loop(servos, target(n * own.time_step), now, servo.gains_of(own), own)
        more = 0.0 if drive.armature is None else drive.armature
        later = rate + own.time_step * (drive.joint_torque + heavy) / (inertia + more)
        return (angle + own.time_step * later, later, servos), (angle[0, 0], rate[0, 0], drive.motor_torque[0, 0])

    start = none + angle, none, servo.begin(none + angle, own.stages)
    return jax.lax.scan(one, start, jnp.arange(steps))[1]


# --- Registers


@pytest.mark.parametrize("name", ["dynamixel_x", "mx_64", "mx_106"])
def test_registers_are_what_the_manual_makes_of_them(name):
    """An output worked out count by count, as the firmware does, gives the torque of the gains in SI units."""
    rate, stall, rng = 1000.0, 7.3, np.random.default_rng(1)
    held, scale = registers.Registers(812, 137, 640), load_hardware(name).servo.register_scale
    gains = registers.gains_of(held, scale, stall)
    counts = rng.normal(0, 20, 200).cumsum()  # of the error
    output = 812 / 128 * counts + 137 / 65536 * counts.cumsum() + 640 / 16 * np.diff(counts, prepend=0.0)
    error, h = counts * 2 * np.pi / 4096, 1 / rate
    torque = gains.kp * error + gains.ki * h * error.cumsum() + gains.kd * np.diff(error, prepend=0.0) / h
    np.testing.assert_allclose(torque, stall * output / 885, rtol=0, atol=2e-5 * np.abs(stall * output / 885).max())
    np.testing.assert_allclose(registers.registers_of(gains, scale, stall), held, rtol=1e-12)


# share of the voltage per rad and unit of P, as github.com/Rhoban/bam has it (`error_gain`); of an MX-64 and MX-106 for
# protocol 1, where P is 32 where protocol 2 has 880
MEASURED = {
    "mx_64": 0.158 * 32 / 880,
    "mx_106": 0.158 * 32 / 880,
    "xl_320": 0.05048199,
    "xl_330": 4096 / (2 * np.pi * 256 * 885),
}


@pytest.mark.parametrize("name", MEASURED)
def test_the_scale_of_a_shipped_servo_is_the_measured_one(name):
    scale = load_hardware(name).servo.register_scale
    assert scale.p == pytest.approx(MEASURED[name], rel=0.002)
    assert (scale.i is None) == (scale.d is None) == (name in ("xl_320", "xl_330"))  # which nobody measured


def test_registers_take_the_place_of_the_gains_until_one_is_set():
    held = {"registers": {"p": 850, "i": 40}, "register_scale": {"p": 6e-3, "i": 0.01}}
    scenario = mc.Scenario().with_overrides({"hardware.servo": MOTOR | held})
    found = registers.LoopGains(850 * 6e-3 * 8.0, 40 * 0.01 * 8.0, 0.0)
    assert (scenario.control.kp, scenario.control.ki, scenario.control.kd) == pytest.approx(tuple(found))
    assert mc.Scenario.from_yaml(scenario.to_yaml()) == scenario
    assert float(own_parameters(scenario).joint_loop.ki) == pytest.approx(found.ki)
    stronger = scenario.with_overrides({"hardware.servo.torque_limit": 16.0})
    assert stronger.control.kp == pytest.approx(2 * found.kp, rel=1e-14)
    other = scenario.with_overrides({"control.kd": 0.1})
    assert (
        other.hardware.servo.registers is None and other.control.kd == 0.1 and other.control.kp == scenario.control.kp
    )


# --- The loop


def test_an_integral_term_takes_the_error_that_a_load_leaves():
    target, load = lambda t: jnp.full((1, 1), 0.3), lambda angle, _: -0.8 * jnp.cos(angle)
    gains = {"kp": 20.0, "kd": 1.5}
    angle = one_joint(hardware(control=gains), target, load, steps=8000)[0]
    np.testing.assert_allclose(0.3 - angle[-1], 0.8 * np.cos(angle[-1]) / 20.0, rtol=1e-9)
    angle, _, torque = one_joint(hardware(control=gains | {"ki": 60.0}), target, load, steps=8000)
    np.testing.assert_allclose(angle[-1], 0.3, atol=1e-9)
    np.testing.assert_allclose(torque[-1], 0.8 * np.cos(0.3), rtol=1e-9)


def test_a_loop_goes_through_profile_rate_integral_motor_and_delay():
    """Evaluated every third step towards a goal on its trapezoid; the motor gives late what it was asked for."""
    servos = {"profile_velocity": 2.0, "profile_acceleration": 90.0, "rate": 1000 / 3, "delay": 2e-3,
              "viscous_friction": 0.05, "armature": 0.004}  # fmt: skip
    own, h = hardware(servos, {"kp": 30.0, "kd": 0.4, "ki": 50.0}), 3 * STEP
    random, begun = np.random.default_rng(0), np.array([[0.1, -0.2]])
    step = jax.jit(lambda memory, target, now: servo.joint_loop(memory, target, now, servo.gains_of(own), own))
    memory, goal, rate, integral = servo.begin(jnp.asarray(begun), own.stages), begun, 0 * begun, 0 * begun
    asked = []
    for n in range(14):
        target, angles, rates = begun + 0.02, begun + random.normal(0, 0.01, (1, 2)), random.normal(size=(1, 2))
        memory, drive = step(memory, target, Joints(angles, rates, None))
        if n % 3 == 0:  # `v (v + a h) = 2 a d`
            way, a = target - goal, 90.0
            fastest = np.minimum((np.sqrt((a * h) ** 2 + 8 * a * abs(way)) - a * h) / 2, abs(way) / h)
            rate = rate + np.clip(np.sign(way) * np.minimum(fastest, 2.0) - rate, -a * h, a * h)
            goal = goal + h * rate
            integral = integral + h * (goal - angles)
            asked += [30 * (goal - angles) - 0.4 * rates + 50 * integral] * 3
        late = asked[n - 2] if n >= 2 else 0 * begun
        np.testing.assert_allclose(drive.motor_torque, late, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(drive.joint_torque, late - 0.05 * rates, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(drive.armature, 0.004)
    assert abs(rate).max() > 0.5 and abs(goal - begun).max() > 0.003


def test_servos_that_no_walk_has_set_up_are_refused():
    for asked in (lambda alone: alone.init(jnp.zeros((4, 3))), lambda alone: alone.feels_load):
        with pytest.raises(ValueError, match=r"^Servos: expected servos that a walk has set up$"):
            asked(servo.Servos())


def test_an_output_on_its_limit_does_not_wind_up():
    """The integral is that of a loop written in NumPy, and less than half of what it would be without a limit."""
    servos, control = {"torque_limit": 1.0}, {"kp": 20.0, "kd": 0.5, "ki": 60.0}
    target, load = lambda t: jnp.ones((1, 1)), lambda angle, _: -0.5 + 0 * angle
    angle, rate, torque = one_joint(hardware(servos, control), target, load, steps=4000)
    integral, most, expected = 0.0, 0.0, []
    for a, w in zip(*map(np.asarray, (angle, rate)), strict=True):
        error = 1.0 - a
        more = integral + STEP * error
        asked = 20 * error + 60 * more - 0.5 * w
        if not (abs(asked) > 1.0 and asked * error > 0):
            integral = more
        most = max(most, integral)
        expected.append(np.clip(20 * error + 60 * integral - 0.5 * w, -1.0, 1.0))
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12)
    assert (np.asarray(torque) == 1.0).sum() > 200 and most < STEP * np.cumsum(1 - angle).max() / 2
    np.testing.assert_allclose(angle[-1], 1.0, atol=1e-3)


@pytest.mark.parametrize("drive", [{}, MOTOR])
def test_a_servos_own_rate_holds_what_its_loop_asks_for(drive):
    """A loop of 250 Hz is one of a time step of 4 ms; back EMF and joint go on in between."""
    own = hardware(drive | {"rate": 250.0}, {"kp": 5.0, "ki": 30.0, "kd": 0.02})
    angle, rate, torque = one_joint(own, lambda t: jnp.full((1, 1), 0.3), lambda a, _: -1.0 * jnp.cos(a), steps=400)
    angle, rate, integral, expected = np.asarray(angle), np.asarray(rate), 0.0, []
    for n in range(400):
        if n % 4 == 0:
            integral += 4 * STEP * (0.3 - angle[n])
            asked = 5 * (0.3 - angle[n]) + 30 * integral - 0.02 * rate[n]
        expected.append(asked - (8 / 6 * rate[n] if drive else 0))
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12)
    assert np.ptp(torque) > 0.1


@pytest.mark.parametrize(
    ("way", "velocity", "acceleration"),
    [(-0.1, 2.0, 4.0), *(pytest.param(*a, marks=pytest.mark.slow) for a in ((1.0, 0.8, 4.0), (0.5, 0.7, None)))],
)
def test_a_goal_moves_on_a_trapezoid(way, velocity, acceleration):
    """It takes `d / v + v / a`, or `2 sqrt(d / a)` where it never gets to v, and does not overshoot."""
    a, goal, rate, path = np.inf if acceleration is None else acceleration, 0.0, 0.0, []
    for _ in range(2000):
        goal, rate = servo.profiled(*map(jnp.asarray, (goal, rate, way, velocity, a)), STEP)
        path.append((float(goal), float(rate)))
    goal, rate = np.abs(np.array(path)).T
    far, peak = abs(way), min(velocity, np.sqrt(abs(way) * a))
    np.testing.assert_allclose(rate.max(), peak, rtol=0.02)
    sampled = 1e-12 if acceleration is None else a * STEP**2  # the last steps are no whole multiples
    assert goal.max() <= far + sampled and goal[-1] == pytest.approx(far, rel=1e-12)
    took = (goal < far - 1e-9).sum() * STEP
    assert took == pytest.approx(far / peak + peak / a, abs=6 * STEP)
    assert np.abs(np.diff(rate)).max() <= a * STEP * (1 + 1e-9)


# --- The motor on a voltage


def test_a_motor_on_a_voltage_reaches_its_speed_as_the_first_order_system_that_it_is():
    """Rate `w (1 - exp(-t / T))`, with w the share of the speed without load and `T = J w0 / tau0`."""
    step = 1e-5
    own = hardware(MOTOR | {"pwm_limit": 0.7}, {"kp": 1e4, "kd": 0.0}, step)
    rate = one_joint(own, lambda t: jnp.full((1, 1), 1e3), lambda a, _: 0 * a, inertia=0.05, steps=10000)[1]
    time = np.arange(10000) * step
    np.testing.assert_allclose(rate, 0.7 * 6.0 * -np.expm1(-time * 8.0 / 6.0 / 0.05), atol=2e-3)


@pytest.mark.parametrize("supply", [9.0, pytest.param(None, marks=pytest.mark.slow)])
def test_a_motor_on_a_voltage_is_mujocos_general_actuator(supply):
    """`gain = kp`, `bias = -kp, -(kd + tau0 / w0)`: the gains grow with the supply voltage, the back EMF does not."""
    share, kp, kd = 1.0 if supply is None else 9.0 / 12.0, 12.0, 0.3
    volts = {} if supply is None else {"rated_voltage": 12.0, "supply_voltage": supply}
    own = hardware(MOTOR | volts, {"kp": kp, "kd": kd})
    target = lambda t: 0.4 * jnp.sin(3 * t) + jnp.zeros((1, 1))  # noqa: E731
    found = one_joint(own, target, lambda a, _: -1.0 * jnp.cos(a), inertia=0.05, steps=1500)
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="{STEP}" integrator="Euler" gravity="0 0 -10"><flag eulerdamp="disable"/></option>
        <worldbody><body><joint name="j" axis="0 -1 0"/>
        <inertial mass="0.5" pos="0.2 0 0" diaginertia="0.01 0.03 0.03"/></body>
        </worldbody><actuator><general joint="j" gaintype="fixed" biastype="affine" gainprm="{share * kp}"
        biasprm="0 {-share * kp} {-share * kd - 8 / 6}"/></actuator></mujoco>""")
    data, expected = mujoco.MjData(model), []
    for n in range(1500):
        data.ctrl[0] = float(target(n * STEP)[0, 0])
        mujoco.mj_forward(model, data)
        expected.append((data.qpos[0], data.qvel[0], data.actuator_force[0]))
        mujoco.mj_Euler(model, data)
    np.testing.assert_allclose(np.transpose(found), expected, rtol=0, atol=1e-11)
    assert np.ptp(np.array(expected)[:, 0]) > 0.3


def test_a_supply_voltage_moves_the_torque_speed_line_and_leaves_a_loop_of_torques():
    own = hardware(
        {"torque_limit": 8.0, "no_load_speed": 6.0, "rated_voltage": 12.0, "supply_voltage": 15.0}
    ).parameters
    assert (float(own.drive.torque_limit), float(own.drive.no_load_speed), float(own.joint_loop.kp)) == (
        10.0,
        7.5,
        50.0,
    )


@pytest.mark.parametrize("share", [0.3, -1.0])
def test_a_supply_sags_by_the_power_that_the_motor_takes(share):
    """At the solution the power of the source is that lost in it and that of the winding."""
    stall, fastest, volts, outer, rate = 8.0, 6.0, 12.0, 0.7, -1.5
    own = hardware(MOTOR | {"rated_voltage": volts, "supply_voltage": volts, "supply_resistance": outer})
    found = servo.voltage_driven(jnp.array(share * stall), jnp.array(rate), own.parameters.drive, sags=True)
    constant = volts / fastest  # V s/rad, N m/A
    winding = constant * volts / stall  # Ohm
    current = float(found) / constant
    at_servo = (winding * current + constant * rate) / share
    assert at_servo == pytest.approx(volts - outer * share * current, rel=1e-12)
    assert (at_servo < volts) == (share * current > 0) and abs(at_servo - volts) > 0.1


def test_the_time_step_counts_back_emf_as_damping_and_the_supply_as_stiffness():
    volts = {"rated_voltage": 12.0, "supply_voltage": 15.0}
    base = mc.Scenario().with_overrides({"control.kp": 40.0, "control.kd": 0.1})
    motors = base.with_overrides({"hardware.servo": MOTOR | volts})
    alike = base.with_overrides({"control.kp": 50.0, "control.kd": 0.125 + 8 / 6})
    assert growth(motors) == pytest.approx(growth(alike), rel=1e-12)
    assert growth(motors) > 1.001 > growth(base)
    slow = motors.with_overrides({"hardware.servo.rate": 500.0, "hardware.servo.armature": 0.001})
    assert (0.002 / largest_time_step(slow)).is_integer()


# --- Friction


def bound(of, motor, load, rate):
    """The published equations of M1 to M6, of names as in github.com/Rhoban/bam; `of` has those of one model."""
    get = lambda name: of.get(name, 0.0)  # noqa: E731
    found, still = get("friction_base"), 0.0
    if "dtheta_stribeck" in of:
        still = np.exp(-(np.abs(rate / of["dtheta_stribeck"]) ** of["alpha"]))
    found = found + still * get("friction_stribeck")
    if "load_friction_base" in of:  # M3, M4
        gears = np.abs(load - motor)
        return found + of["load_friction_base"] * gears + still * get("load_friction_stribeck") * gears
    found = found + np.abs(load * get("load_friction_external") - motor * get("load_friction_motor"))
    found = found + still * np.abs(
        load * get("load_friction_external_stribeck") - motor * get("load_friction_motor_stribeck")
    )
    if np.sign(load) != np.sign(motor):
        if abs(load) < abs(motor):
            found = found + still * get("load_friction_external_quad") * load**2
        if abs(load) > abs(motor):
            found = found + still * get("load_friction_motor_quad") * motor**2
    return found


STRIBECK = {"friction_stribeck": 0.1, "dtheta_stribeck": 0.8, "alpha": 0.85}
DIRECTED = {
    "load_friction_motor": 0.3, "load_friction_external": 0.1, "load_friction_motor_stribeck": 0.15,
    "load_friction_external_stribeck": 0.07,
}  # fmt: skip
MODELS = {
    "M1": {"friction_base": 0.05},
    "M2": {"friction_base": 0.05, **STRIBECK},
    "M3": {"friction_base": 0.05, "load_friction_base": 0.2},
    "M4": {"friction_base": 0.05, **STRIBECK, "load_friction_base": 0.2, "load_friction_stribeck": 0.1},
    "M5": {"friction_base": 0.05, **STRIBECK, **DIRECTED},
    "M6": {
        "friction_base": 0.05, **STRIBECK, **DIRECTED, "load_friction_motor_quad": 0.04,
        "load_friction_external_quad": 0.02,
    },
}  # fmt: skip
OURS = {
    "friction_base": ["coulomb_friction"], "friction_stribeck": ["stribeck_friction"],
    "dtheta_stribeck": ["stribeck_velocity"], "alpha": ["stribeck_exponent"],
    "load_friction_base": ["load_friction", "external_load_friction"],
    "load_friction_stribeck": ["stribeck_load_friction", "stribeck_external_load_friction"],
    "load_friction_motor": ["load_friction"], "load_friction_external": ["external_load_friction"],
    "load_friction_motor_stribeck": ["stribeck_load_friction"],
    "load_friction_external_stribeck": ["stribeck_external_load_friction"],
    "load_friction_motor_quad": ["quadratic_load_friction"],
    "load_friction_external_quad": ["quadratic_external_load_friction"],
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_the_bound_of_friction_is_the_published_one(name):
    of, rng = MODELS[name], np.random.default_rng(0)
    own = hardware({ours: value for key, value in of.items() for ours in OURS[key]})
    assert own.stages.stribeck == ("alpha" in of) and own.stages.load_torque == (name >= "M3")
    motor, load, rate = rng.normal(0, 2, (3, 200))
    rate[:5] = 0.0
    found = servo.friction_bound(*map(jnp.asarray, (motor, load, rate)), own)
    np.testing.assert_allclose(found, [bound(of, *at) for at in zip(motor, load, rate, strict=True)], rtol=1e-12)
    slope = jax.vmap(jax.grad(lambda *at: servo.friction_bound(*at, own), (0, 1, 2)))(motor, load, rate)
    width = 1e-6
    for axis, values in enumerate(slope):
        sides = []
        for sign in (1, -1):
            at = np.array([motor, load, rate])
            at[axis] += sign * width
            sides.append(np.array([bound(of, *point) for point in at.T]))
        np.testing.assert_allclose(values[5:], (sides[0] - sides[1])[5:] / (2 * width), rtol=2e-4, atol=1e-7)
        assert np.isfinite(values).all()


@pytest.mark.parametrize("step", [2.5e-4, 1e-3, 4e-3])
def test_friction_of_standstill_holds_a_load_at_any_time_step(step):
    """A load below what the gears bear under it, laid on gently, stays; one above falls."""
    servos = {"stribeck_friction": 0.5, "external_load_friction": 0.3, "stribeck_velocity": 0.3}
    own = hardware(servos, {"kp": 1e-9, "kd": 0.0}, step)
    for weight, holds in ((0.69, True), (0.74, False)):  # 0.5 + 0.3 w = w at 0.714
        angle = one_joint(
            own,
            lambda t: jnp.zeros((1, 1)),
            lambda a, t, w=weight: 0 * a - w * jnp.minimum(t, 1),
            steps=round(2 / step),
        )[0]
        assert (abs(angle[-1]) < 2 * PRESLIDING) == holds


# --- Files and scenarios

BAM = {  # kt N m/A, R Ohm, armature kg m^2 of the identified models M6
    "mx_64": (1.6016832750318712, 2.3164043271967447, 0.012265893049213158),
    "mx_106": (2.209828156174588, 2.033661749312417, 0.026016184370993383),
    "xl_320": (1.0088269677439867, 31.585877261639528, 0.0011629864934131363),
}


@pytest.mark.parametrize("name", BAM)
def test_shipped_servos_are_the_identified_motors(name):
    torque_constant, resistance, armature = BAM[name]
    there = load_hardware(name).servo
    assert there.drive == "voltage" and there.armature == pytest.approx(armature, rel=1e-5)
    assert there.rated_voltage / there.no_load_speed == pytest.approx(torque_constant, rel=1e-5)
    assert there.torque_limit / there.rated_voltage == pytest.approx(torque_constant / resistance, rel=1e-5)
    scenario = with_hardware(mc.Scenario(), load_hardware(name))
    stages = stages_of(own_parameters(scenario), scenario.time_step)
    assert stages.voltage and stages.stribeck and stages.load_torque and stages.dry_friction


REFUSED = {
    "hardware.servo.drive=volts": "hardware.servo.drive: expected 'torque' or 'voltage', got \"volts\"",
    "hardware.servo.drive=voltage": "hardware.servo.torque_limit: expected a number with drive: voltage, got null",
    "hardware.servo.registers.p=0": "hardware.servo.registers.p: expected a register of 1 or more",
    "hardware.servo.registers.p=8.5": "hardware.servo.registers.p: expected a whole number from 0 to 16383",
    "hardware.servo.registers.p=800": "hardware.servo.torque_limit: expected a number beside registers, got null",
    "hardware.servo={torque_limit: 8, registers: {p: 800}}": "hardware.servo.register_scale: expected the scale of th",
    "hardware.servo={torque_limit: 8, registers: {p: 8, d: 1}, register_scale: {p: 0.1}}": "hardware.servo."
    "register_scale.d: expected a number beside registers.d, got null",
    "hardware.servo={torque_limit: 8, registers: {p: 300}, register_scale: {p: 0.1, largest: 254}}": "hardware.servo."
    "registers.p: expected a whole number from 0 to 254, as register_scale.largest says, got 300",
    "hardware.servo.register_scale.p=0": "hardware.servo.register_scale.p: expected a finite number above 0, got 0",
    "hardware.servo.rate=300": "hardware.servo.rate: expected a rate whose period is a whole number of time steps",
    "hardware.servo.supply_voltage=12": "hardware.servo.rated_voltage: expected a number beside supply_voltage",
    "hardware.servo.supply_resistance=0.5": "hardware.servo.supply_resistance: expected 0 but with drive",
    "hardware.servo.profile_acceleration=9": "hardware.servo.profile_velocity: expected a number beside profile_acc",
    "hardware.servo.pwm_limit=1.5": "hardware.servo.pwm_limit: expected a number above 0, 1 at most, got 1.5",
    "hardware.servo.pwm_limit=0.5": "hardware.servo.pwm_limit: expected 1 with drive: torque",
    "hardware.servo.stribeck_velocity=0": "hardware.servo.stribeck_velocity: expected a finite number above 0, got 0",
    "control.ki=-1": "control.ki: expected a finite number, 0 or above, got -1",
}


@pytest.mark.parametrize("override", REFUSED)
def test_bad_servos_are_refused_in_one_line(override):
    with pytest.raises(ConfigError, match=rf"^scenario: {re.escape(REFUSED[override])}") as refused:
        mc.Scenario().with_overrides([override])
    assert "\n" not in str(refused.value)


def test_a_voltage_without_a_stall_torque_is_refused_in_a_batch_too():
    scenario = mc.Scenario().with_overrides({"hardware.servo": MOTOR})
    endless = own_parameters(scenario).replace({"hardware.servo.torque_limit": np.array([8.0, np.inf])})
    with pytest.raises(
        ValueError, match=r"^parameters.hardware.servo.torque_limit: expected finite numbers with drive: voltage, got"
    ):
        stages_of(endless, scenario.time_step)


# --- Walks

SERVOS = {
    "duration": 0.15, "gait.cycle": 0.4, "gait.stride": 0.005, "gait.step_height": 0.002, "control.ki": 60.0,
    "control.controller": "pd", "disturbance.pushes": [{"start": 0.01, "stop": 0.1, "force": [3.0, 1.0, 1.0]}],
    "hardware.servo": {
        "drive": "voltage", "torque_limit": 4.0, "no_load_speed": 6.0, "pwm_limit": 0.9, "rate": 500.0,
        "rated_voltage": 12.0, "supply_voltage": 10.5, "profile_velocity": 0.2, "profile_acceleration": 6.0,
        "armature": 0.002, "coulomb_friction": 0.005, "load_friction": 0.1, "external_load_friction": 0.05,
        "stribeck_friction": 0.01, "stribeck_load_friction": 0.07, "stribeck_external_load_friction": 0.03,
        "stribeck_velocity": 0.5, "stribeck_exponent": 0.8, "quadratic_load_friction": 0.3,
        "quadratic_external_load_friction": 0.2,
    },
}  # fmt: skip
MOVED = (
    "control.ki", "hardware.servo.profile_velocity", "hardware.servo.profile_acceleration",
    "hardware.servo.no_load_speed", "hardware.servo.torque_limit", "hardware.servo.supply_voltage",
    "hardware.servo.external_load_friction", "hardware.servo.stribeck_friction",
    "hardware.servo.stribeck_load_friction", "hardware.servo.stribeck_external_load_friction",
    "hardware.servo.stribeck_velocity", "hardware.servo.stribeck_exponent",
    "hardware.servo.quadratic_load_friction", "hardware.servo.quadratic_external_load_friction",
    "hardware.servo.presliding",
)  # fmt: skip


@pytest.fixture(scope="module")
def tangents():
    return derivatives.by_each(mc.Scenario().with_overrides(SERVOS), MOVED, "cost_of_transport")


@pytest.mark.nightly
@pytest.mark.parametrize("name", MOVED)
def test_derivative_of_a_walk_by_its_servos(tangents, name):
    exact, differences = tangents[name]
    assert abs(exact) > 0
    np.testing.assert_allclose(exact, differences, rtol=1e-4)


@pytest.mark.nightly
@pytest.mark.slow
def test_robots_of_a_batch_walk_with_servos_as_they_do_alone():
    scenario = mc.Scenario().with_overrides(SERVOS)
    own, rng = own_parameters(scenario), np.random.default_rng(0)
    varied = {path: own.at(path) * rng.uniform(0.7, 1.0, 6) for path in MOVED}
    parameters = own.replace({**varied, "hardware.servo.rate": np.array([500.0, np.inf, 250.0, 500.0, 200.0, 1000.0])})
    together = mc.rollout_metrics(scenario, parameters=parameters, dtype=np.float64)
    alone = mc.rollout_metrics(scenario, parameters=parameters, dtype=np.float64, batch_size=1)
    for name, values in together.items():
        np.testing.assert_allclose(alone[name], values, rtol=1e-9, atol=1e-12, err_msg=name)
    assert len(np.unique(together["peak_joint_torque"])) == 6


@pytest.mark.nightly
def test_the_linear_limit_has_back_emf_and_integral_term_in_the_loop():
    """Of motors on a voltage it is that of torques with as much more damping; an integral term changes it."""
    base = mc.load_scenario("case_1_2", {"control.kp": 40.0, "control.kd": 0.1, "hardware.servo.armature": 0.01})
    volts = {"rated_voltage": 12.0, "supply_voltage": 15.0, "pwm_limit": 0.9, "rate": 500.0, "profile_velocity": 1.0}
    motors = base.with_overrides({"hardware.servo": MOTOR | volts | {"external_load_friction": 0.1}})
    alike = base.with_overrides({"control.kp": 50.0, "control.kd": 0.125 + 8 / 6})
    ours, expected = (float(spectral_radius(each, {})) for each in (motors, alike))
    assert ours == pytest.approx(expected, rel=1e-9) and ours != pytest.approx(
        float(spectral_radius(base, {})), rel=1e-6
    )
    pulled = float(spectral_radius(motors.with_overrides({"control.ki": 1e4}), {}))
    assert pulled > 1.0001 > ours


def test_gains_in_registers_follow_the_torque_at_standstill_in_parameters_as_in_a_config():
    """A fit, a draw and a sweep change parameters; kp stayed at 0.685 where the config that is written has 1.548."""
    held = {"registers": {"p": 850, "i": 40}, "register_scale": {"p": 6e-3, "i": 0.01}}
    scenario = mc.Scenario().with_overrides({"hardware.servo": {**held, "torque_limit": 8.0}})
    for changes in ({"hardware.servo.torque_limit": 5.0}, {"hardware.servo.torque_limit": 5.0, "control.kp": 20.0}):
        found = mc.parameters(scenario).replace(changes)
        expected = mc.parameters(scenario.with_overrides(changes))
        for path in ("control.kp", "control.ki", "control.kd", "hardware.servo.torque_limit"):
            if not (path == "control.ki" and "control.kp" in changes):  # without registers gains stay
                np.testing.assert_allclose(found.at(path), expected.at(path), rtol=1e-6)
    drawn = mc.parameters(scenario).replace({"hardware.servo.torque_limit": np.array([4.0, 16.0])})
    np.testing.assert_allclose(drawn.at("control.kp"), 850 * 6e-3 * np.array([4.0, 16.0]), rtol=1e-6)
