"""What the profile has and the robot lacks, or the other way round, is found by single changes and named."""

import dataclasses

import pytest

import mjx_climb as mc
import tuning
from mjx_climb.scenario.load import load_hardware, with_hardware
from tests.tuning.identification.stand_in_mujoco import Truth, log_of
from tuning.identification.fit.profile_changes import Tried, changes, in_words
from tuning.identification.model.variables import variables

PROFILE = with_hardware(mc.load_scenario("case_1_1"), load_hardware("dynamixel_x"))


def tried(scenario, *fit):
    return {
        change.words.partition(" (")[0]: change for change in changes(scenario, variables(scenario, fit, held=True))
    }


def test_single_changes_take_away_what_the_profile_has_and_add_what_it_has_not():
    found = tried(PROFILE, "hardware.servo.armature")
    assert list(found) == [
        "without hardware.servo.backlash", "without hardware.servo.no_load_speed",
        "without hardware.servo.torque_limit and hardware.servo.no_load_speed", "with hardware.servo.viscous_friction",
        "with hardware.servo.stribeck_friction", "with hardware.servo.load_friction",
    ]  # fmt: skip
    line = found["without hardware.servo.no_load_speed"]
    assert line.scenario.hardware.servo.no_load_speed is None and not line.beside
    assert line.scenario.hardware.servo.backlash == PROFILE.hardware.servo.backlash  # one change at a time
    assert "(--set hardware.servo.no_load_speed=null)" in line.words
    added = found["with hardware.servo.load_friction"]
    assert [v.key for v in added.beside] == ["hardware.servo.load_friction"] and added.beside[0].nominal > 0


def test_what_is_fitted_is_not_changed():
    found = tried(PROFILE, "hardware.servo.backlash", "hardware.servo.viscous_friction")
    assert not any("backlash" in words or "viscous" in words for words in found)


@pytest.mark.parametrize(("volts", "proposed"), [(7.4, True), (None, False)])
def test_a_supply_that_sags_is_proposed_for_a_servo_on_a_known_voltage(volts, proposed):
    servo = with_hardware(mc.load_scenario("case_1_1"), load_hardware("xl_330"))
    found = tried(servo.with_overrides({"hardware.servo.supply_voltage": volts}), "hardware.servo.armature")
    assert ("with hardware.servo.supply_resistance" in found) == proposed
    assert "with hardware.servo.backlash" in found


@pytest.mark.parametrize(("left", "said"), [
    ((0.2, 0.5, 1.0), "the residuals are explained best without a: 0.2 of them are left; next, without b: 0.5 of them"),
    ((0.7, 0.9), "the residuals are explained best without a: 0.7 of them are left"),
    ((0.95, 1.0), "none of 2 single changes of hardware.servo explains the residuals"),
    ((0.28, 0.282, 0.9), "the residuals are explained best without a: 0.28 of them are left"),
    ((), ""),
])  # fmt: skip
def test_the_change_that_explains_most_is_named(left, said):
    each = zip("abc", left, strict=False)
    assert in_words([Tried(f"without {name}", share) for name, share in each]) == said


@pytest.mark.nightly
@pytest.mark.usefixtures("optimised")
def test_the_part_of_the_profile_that_the_robot_lacks_is_named():
    """A robot without backlash and torque-speed line: under the profile armature came out as 0.0073 for 0.012."""
    kp, kd = PROFILE.control.kp, PROFILE.control.kd
    log = log_of(Truth(0.012, 0.09, 0.0, kp, kd, 0.004, tuple(PROFILE.gravity)), 4.0)
    log = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if k.startswith("LF")})
    fit = ("hardware.servo.armature", "hardware.servo.coulomb_friction", "hardware.command_delay")
    found = tuning.identify(PROFILE, log, fit, starts=1)
    (line,) = [each for each in found.warnings if each.startswith("the residuals are explained best")]
    assert "without hardware.servo.no_load_speed (--set hardware.servo.no_load_speed=null)" in line
    assert not any(each.seen for each in found.estimates.values())
    whole = PROFILE.with_overrides({"hardware.servo.no_load_speed": None})
    again = tuning.identify(whole, log, fit, starts=1)
    assert again.held_out["error_over_noise"] < 0.2 * found.held_out["error_over_noise"]
