"""What the profile has and the robot lacks, or the other way round, is found by single changes and named."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.scenario.load import load_hardware, with_hardware
from tests.tuning.identification.recorded import ROBOT, recorded
from tests.tuning.identification.stand_in_mujoco import Truth, log_of
from tuning.identification.fit.problem import Problem
from tuning.identification.fit.profile_changes import Tried, changes, in_words
from tuning.identification.fit.profile_changes import tried as leaving
from tuning.identification.fit.search import Searches
from tuning.identification.model.predicted import model_of, with_nuisances
from tuning.identification.model.variables import begin, variables
from tuning.identification.model.windows import cut
from tuning.identification.readers.log import Log, Signal
from tuning.methods.parts import Parts

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


def test_each_change_is_fitted_from_where_the_fit_ended_and_the_one_that_leaves_least_comes_first():
    columns = recorded(duration=3.0)
    time = columns.pop("time")
    windows = cut(Log({name: Signal(time, values) for name, values in columns.items()}, "log.csv"), ROBOT, 1e-3, 0.0)
    fit = ("hardware.servo.armature", "hardware.command_delay")
    chosen = variables(PROFILE, fit, held=True)
    model = model_of(PROFILE, windows, with_nuisances(PROFILE, chosen, windows.kinds), 0.2)
    problem = Problem(model, np.full(len(windows.names), 0.01), 0.002, np.ones(len(windows.rows.value)))
    x = begin(model.variables) * 1.01 + 1e-4
    found = SimpleNamespace(x=x, start=model.guess + 0.01, cost=4.0)
    asked = {}

    class Made(Searches):
        def search(self, own, point, most, text, tolerance=0.0):
            words = text.partition(" (")[0]
            asked[words] = own, point, most, tolerance
            costs = {"without hardware.servo.backlash": 1.0, "with hardware.servo.load_friction": 1.005}
            return None if "viscous" in words else SimpleNamespace(cost=costs.get(words, 3.0))

    each = leaving(problem, found, PROFILE, chosen, Made(Parts(None, dict)))
    lefts = {change.words.partition(" (")[0]: change.left for change in each}
    assert list(lefts)[:2] == ["without hardware.servo.backlash", "with hardware.servo.load_friction"]
    assert lefts["without hardware.servo.backlash"] == 0.5 and lefts["with hardware.servo.viscous_friction"] == np.inf
    assert list(lefts)[-1] == "with hardware.servo.viscous_friction"
    own, point, most, tolerance = asked["with hardware.servo.load_friction"]
    keys = [v.key for v in own.model.variables]
    known = dict(zip((v.key for v in model.variables), x, strict=True))
    expected = [
        known.get(v.key, nominal) for v, nominal in zip(own.model.variables, begin(own.model.variables), strict=True)
    ]
    np.testing.assert_array_equal(point[: len(keys)], expected)
    assert "hardware.servo.load_friction" in keys and own.model.structure.mass == 0.2 and own.clock == 0.002
    np.testing.assert_array_equal(point[len(keys) :], found.start.ravel())
    assert (most, tolerance) == (15, 1e-3) and own.rate is problem.rate and own.noise is problem.noise


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
