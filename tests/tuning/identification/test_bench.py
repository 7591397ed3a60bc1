"""A bench: a pendulum on one servo is a robot, whatever its servo is commanded by."""

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.load import load_hardware, with_hardware
from tuning.identification.model import replay
from tuning.identification.readers.log import Log, Signal

PENDULUM = """<mujoco><worldbody><body name="rod" pos="0 0 1">
  <joint name="swing" axis="0 -1 0" range="-3.5 3.5" limited="true"/>
  <inertial pos="0 0 -0.1" mass="0.49" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
MASS, LENGTH, GRAVITY, ARMATURE, VISCOUS = 0.49, 0.1, 9.81, 0.002, 0.02
STALL, FASTEST = 1.03, 20.0  # N m, rad/s


@pytest.fixture
def bench(tmp_path, call):
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    code, out, err = call("robot", tmp_path / "pendulum.xml", "--stand", "--write", tmp_path / "bench.yaml")
    assert code == 0 and "taken    rod  swing" in out, err
    servo = {"armature": ARMATURE, "viscous_friction": VISCOUS}
    return mc.load_scenario(tmp_path / "bench.yaml").with_overrides(
        {f"hardware.servo.{k}": v for k, v in servo.items()}
    )


def swung(asked, duration=3.0, rate=200.0, step=1e-4):
    """Times (T,), angles and what was sent (T,) of a pendulum, by Heun's steps, under a torque of sent, angle, rate."""
    time = np.arange(round(duration * rate)) / rate
    sent = np.sin(2 * np.pi * (0.5 * time + 0.4 * time**2))
    inertia, state, angles = MASS * LENGTH**2 + ARMATURE, np.zeros(2), []

    def slope(state, held):
        torque = asked(held, *state) - VISCOUS * state[1] - MASS * GRAVITY * LENGTH * np.sin(state[0])
        return np.array([state[1], torque / inertia])

    for held in sent:
        angles.append(state[0])
        for _ in range(round(1 / rate / step)):
            first = slope(state, held)
            state = state + step / 2 * (first + slope(state + step * first, held))
    return time, np.array(angles), sent


KINDS = {  # kind of the commands, torque of them, and the servo that has it
    "command": (lambda sent, angle, rate: 3.0 * (sent - angle) - 0.05 * rate, {"control.kp": 3.0, "control.kd": 0.05}),
    "velocity_command": (lambda sent, angle, rate: 0.3 * (5 * sent - rate), {"control.kd": 0.3}),
    "effort_command": (lambda sent, angle, rate: 0.4 * sent, {}),
    "pwm_command": (lambda sent, angle, rate: STALL * (0.3 * sent - rate / FASTEST), {
        "hardware.servo": {"drive": "voltage", "torque_limit": STALL, "no_load_speed": FASTEST, "armature": ARMATURE,
                           "viscous_friction": VISCOUS}}),
}  # fmt: skip
SCALES = {"velocity_command": 5.0, "effort_command": 0.4, "pwm_command": 0.3}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bench_swings_as_its_equation_says_whatever_it_is_commanded_by(bench, kind):
    asked, changes = KINDS[kind]
    time, angles, sent = swung(asked, duration=1.5)
    names = {f"rod.swing.{kind}": SCALES.get(kind, 1.0) * sent, "rod.swing.position": angles}
    log = Log({name: Signal(time, value) for name, value in names.items()}, "log.csv")
    found = replay.simulate(replay.prepare(log, bench.with_overrides(changes), None, 0.0))
    assert found.errors["rod.swing.position"].rms < 2e-3 < 0.2 < np.std(angles)


@pytest.mark.slow
def test_what_moves_a_bench_is_identified_and_written(bench, tmp_path):
    asked, changes = KINDS["command"]
    time, angles, sent = swung(asked)
    angles = angles + 1e-3 * np.random.default_rng(0).normal(size=len(time))
    time = time + 1.0 * (time > 1.5)  # two recordings, a second apart
    log = Log({"rod.swing.command": Signal(time, sent), "rod.swing.position": Signal(time, angles)}, "log.csv")
    start = bench.with_overrides({**changes, "hardware.servo.armature": 0.004, "control.kp": 2.0})
    found = tuning.identify(start, log, ["hardware.servo.armature", "control.kp"], starts=1)
    for key, truth in (("hardware.servo.armature", ARMATURE), ("control.kp", 3.0)):
        estimate = found.estimates[key]
        assert estimate.seen and estimate.value == pytest.approx(truth, rel=0.03), (key, estimate)
    assert found.fitted.ended == "converged"
    assert "pauses: 1, 1 s in all, in which nothing was measured; what follows each begins anew" in found.warnings
    assert not any("commands are missing" in line for line in found.warnings)
    tuning.write(found, tmp_path / "found")
    written = mc.load_scenario(tmp_path / "found" / "identified.yaml")
    assert written.control.kp == pytest.approx(3.0, rel=0.03) and load_robot(written.robot).limbs == ("rod",)


def test_a_bench_does_not_walk_and_commands_are_of_one_kind(bench):
    with pytest.raises(mc.ConfigError, match=r"robot.height: expected a height, to walk, got null"):
        mc.Simulation(bench)
    time = np.arange(100) / 100
    kinds = {f"rod.swing.{kind}": Signal(time, np.sin(time)) for kind in ("command", "effort_command", "position")}
    with pytest.raises(mc.ConfigError, match=r"log.csv: expected commands of one kind, got rod.swing.command, rod"):
        tuning.identify(bench, Log(kinds, "log.csv"), ["control.kp"])


def test_rows_of_joints_are_limbs_of_a_stand_and_branches_are_refused(tmp_path, call):
    branched = PENDULUM.replace("</body>", "".join(
        f'<body name="{n}"><joint name="{n}" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
        for n in "ab") + "</body>", 1)  # fmt: skip
    (tmp_path / "branched.xml").write_text(branched)
    code, _, err = call("robot", tmp_path / "branched.xml", "--stand")
    assert code == 2 and "expected rows of joints, got a and b on rod" in err


# ------------------------------------------------------------------------------------------------- real recordings


def recorded(*names, kp=0.0):
    """The log of recordings of an XL-330 one after the other, a second apart; `kp` is that of a P register of 400."""
    begin, parts = 0.0, []
    with np.load("tests/reference/xl330_bench.npz") as of:
        for name in names:
            rows = of[name].astype(float)
            share = int(name[1:4]) / 400
            parts.append(np.column_stack([begin + rows[:, 0], rows[:, 1:], np.full(len(rows), share * kp)]))
            begin = parts[-1][-1, 0] + 1.0
    time, goal, angle, gain = np.concatenate(parts).T
    signals = {"rod.swing.command": goal, "rod.swing.position": angle, "control.kp": gain}
    return Log({name: Signal(time, value) for name, value in signals.items()}, "bench.csv")


@pytest.fixture
def xl330(bench):
    on = with_hardware(bench, load_hardware("xl_330"))
    return on.with_overrides({"hardware.servo.registers": {"p": 400}, "hardware.servo.supply_voltage": 7.4})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["p200_sin_time_square", "p400_sin_time_square"])
def test_the_shipped_profile_moves_as_the_servo_did(xl330, name):
    found = replay.simulate(replay.prepare(recorded(name, kp=xl330.control.kp), xl330, "held", 0.0))
    assert np.degrees(found.errors["rod.swing.position"].rms) < 2.65


@pytest.mark.slow
def test_the_resistance_of_the_supply_by_its_voltage_brings_the_strongest_gain_nearer(xl330):
    """At full PWM 7.09 V of 7.34 V were recorded, at 2.4 A: 0.1 Ohm. The profile was fitted without it."""
    log = recorded("p400_sin_time_square", kp=xl330.control.kp)
    plain, sags = (
        replay.simulate(replay.prepare(log, each, "held", 0.0)).errors["rod.swing.position"].rms
        for each in (xl330, xl330.with_overrides({"hardware.servo.supply_resistance": 0.1}))
    )
    assert sags < 0.97 * plain


@pytest.mark.nightly
@pytest.mark.usefixtures("optimised")
def test_fits_of_recordings_end_at_one_optimum_and_predict_another_p_gain(xl330):
    """What was held out is a P register of 400; those of 100 and 200 are fitted."""
    log = recorded("p100_sin_sin", "p200_sin_time_square", "p400_sin_time_square", kp=xl330.control.kp)
    keys = ["armature", "torque_limit", "coulomb_friction", "viscous_friction", "load_friction"]
    found = tuning.identify(xl330, log, [f"hardware.servo.{key}" for key in keys], starts=3, held_out=1 / 3)
    assert found.fitted.ended == "converged"
    assert max(found.fitted.costs) < 1.01 * min(found.fitted.costs)
    assert np.degrees(found.held_out["error"]["rod.swing.position"]) < 2.65
    assert any("the model is wrong" in line for line in found.warnings)
    assert all(each.low <= each.value <= each.high for each in found.estimates.values())
