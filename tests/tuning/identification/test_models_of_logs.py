"""The models of logs before anything is simulated: their variables, states, delays, and what their records are."""

import dataclasses
import math
import sys
import types
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.kinematics import limb_frames
from tests.tuning.identification.recorded import ROBOT, recorded
from tuning.identification.model import predicted
from tuning.identification.model import variables as priors
from tuning.identification.model.commanded import swaying
from tuning.identification.model.force_sensors import logged_force
from tuning.identification.model.gripped import (
    check_parts,
    cut_gripped,
    gripped_model,
    gripped_with_nuisances,
)
from tuning.identification.model.predicted import model_of, with_nuisances
from tuning.identification.model.variables import Place, begin, variables
from tuning.identification.model.windows import cut
from tuning.identification.readers.log import Log, Signal, signals_of

STEP = 0.001
SCENARIO = mc.Scenario().with_overrides({"time_step": STEP})


def log_of(extra=None, seconds=4.0):
    columns = recorded(duration=seconds)
    time = columns.pop("time")
    every = columns | {name: np.broadcast_to(value, time.shape) for name, value in (extra or {}).items()}
    return Log({name: Signal(time, np.array(value, float)) for name, value in every.items()}, "log.csv")


def found(keys, servo=None, held=True, kinds=("position",)):
    scenario = SCENARIO.with_overrides({f"hardware.servo.{name}": value for name, value in (servo or {}).items()})
    chosen = variables(scenario, keys, held=held)
    return {v.key: v for v in (with_nuisances if held else gripped_with_nuisances)(scenario, chosen, kinds)}


@pytest.mark.parametrize(
    ("keys", "servo", "kinds", "beside"),
    [
        (["hardware.servo.armature"], {}, ("position",), {"log.command.delay"}),
        (["hardware.command_delay"], {}, ("position",), set()),
        (["hardware.command_delay"], {}, ("position", "velocity"), {"log.velocity.delay"}),
        (["hardware.command_delay"], {}, ("velocity",), set()),
        (["hardware.command_delay"], {}, ("position", "effort"), {"log.effort.delay"}),
        (["hardware.command_delay"], {"coulomb_friction": 0.1}, ("position",),
         {"log.friction.lead", "hardware.servo.presliding"}),
        (["hardware.command_delay", "hardware.servo.coulomb_friction", "hardware.servo.presliding"], {}, ("position",),
         {"log.friction.lead"}),
    ],
)  # fmt: skip
def test_what_would_bend_the_variables_is_fitted_beside_them(keys, servo, kinds, beside):
    every = found(keys, servo, kinds=kinds)
    assert {key for key, v in every.items() if v.beside} == beside and list(every)[: len(keys)] == keys


def test_times_may_be_a_quarter_of_a_step_below_zero_and_a_friction_gives_for_so_long_at_most():
    every = found(
        ["hardware.command_delay"], {"coulomb_friction": 0.1, "presliding": 0.002}, kinds=("position", "effort")
    )
    assert every["hardware.command_delay"].lower == -STEP / 4
    late, lead, bend = (every[k] for k in ("log.effort.delay", "log.friction.lead", "hardware.servo.presliding"))
    assert (late.mean, late.sd, late.lower, late.upper) == (0.0, 0.005, -0.02, 0.1)
    assert (lead.mean, lead.sd, lead.lower, lead.upper) == (0.0, 0.005, -STEP / 4, 0.03)
    assert (bend.sd, bend.upper) == (3.0, pytest.approx(0.012))
    clock = found(["hardware.servo.armature"])["log.command.delay"]
    assert (clock.mean, clock.sd, clock.lower, clock.upper) == (0.0, STEP / 4, -STEP / 4, STEP / 4)


@pytest.mark.parametrize(
    ("keys", "kinds", "late"),
    [
        (["contact.stiffness"], ("position", "force"), {"log.force.delay"}),
        (["contact.stiffness", "hardware.force_sensor.delay"], ("position", "force"), set()),
        (["contact.stiffness"], ("position", "base_position"), {"log.base.delay"}),
        (["contact.stiffness"], ("force",), set()),
        (["contact.stiffness"], ("position", "velocity"), {"log.velocity.delay"}),
    ],
)
def test_records_of_a_gripped_robot_may_be_late(keys, kinds, late):
    every = found(keys, {"coulomb_friction": 0.1}, held=False, kinds=kinds)
    assert {key for key in every if key.startswith("log.")} == late | {"log.command.delay"}


# -------------------------------------------------------------------------------------------------------- a held base


def model(keys, servo=None, **extra):
    scenario = SCENARIO.with_overrides(
        {f"hardware.servo.{name}": value for name, value in (servo or {}).items()} | {"hardware.command_delay": 0.003}
    )
    windows = cut(log_of(extra), ROBOT, STEP, 0.0)
    every = with_nuisances(scenario, variables(scenario, keys, held=True), windows.kinds)
    return model_of(scenario, windows, every, mass=0.1)


def test_commands_and_torques_are_as_late_as_their_variables_say():
    both = model(["hardware.command_delay", "hardware.servo.delay"], {"delay": 0.002})
    x = begin(both.variables)
    assert both.delay(x) == 0.003 and both.torque_delay(x) == 0.005
    x[:2] = 0.007, 0.004
    assert both.delay(x) == 0.007 and both.torque_delay(x) == 0.011
    clock = model(["hardware.servo.armature"], {"delay": 0.002, "armature": 0.01})
    x = begin(clock.variables)
    x[[v.key for v in clock.variables].index("log.command.delay")] = 0.0002
    assert clock.delay(x) == pytest.approx(0.0032) and clock.torque_delay(x) == pytest.approx(0.0052)


def test_variables_of_other_limbs_share_a_tangent_and_each_joint_has_its_state():
    keys = ["robot.LF.coxa.damping", "robot.LF.femur.damping", "robot.RH.coxa.damping", "hardware.command_delay",
            "robot.RH.femur.damping"]  # fmt: skip
    own = model(keys, {"coulomb_friction": 0.1}, **{"LF.coxa.effort": np.sin(np.arange(400))})
    names = [v.key for v in own.variables]
    lanes = [[names[n] for n in lane] for lane in own.lanes]
    assert lanes[:3] == [[keys[0], keys[2]], [keys[1], keys[4]], [keys[3]]]
    assert not any("log.effort.delay" in lane for lane in lanes)
    assert own.memory == ("bristle",) and own.logged.shape[1:] == (4, 3, 3) and own.states == 9
    along, late = own.tangents()
    assert along.shape == (len(lanes) + 9, len(names))
    np.testing.assert_array_equal(along[0], np.isin(names, [keys[0], keys[2]]))
    np.testing.assert_array_equal(late, [lane in (["hardware.command_delay"], ["log.command.delay"]) for lane in lanes]
                                  + [False] * 9)  # fmt: skip
    assert own.moves(own.variables[0], 0) and not own.moves(own.variables[0], 2) and own.moves(own.variables[3], 2)


def test_a_stretch_begins_as_the_log_has_it_with_the_bristle_of_its_rate():
    own = model(["hardware.command_delay"], {"coulomb_friction": 0.1, "profile_velocity": 3.0})
    assert own.memory == ("bristle", "loop.goal", "loop.goal_rate")
    known = own.windows.start[:1]
    np.testing.assert_array_equal(own.guess[..., :2], known)
    np.testing.assert_allclose(own.guess[..., 2], 0.9 * np.tanh(known[..., 1] / 0.05))
    np.testing.assert_array_equal(own.guess[..., 3], known[..., 0])
    np.testing.assert_array_equal(own.guess[..., 4], 0.0)
    np.testing.assert_array_equal(own.guess_sd, [0.2, 3.0, 0.7, 0.05, 1.0])
    assert own.structure.mass == 0.1 and own.structure.stages.command_delay == 0


@pytest.mark.parametrize("abuts", [[False, True] * 6, [False] * 12])
def test_windows_run_in_calls_of_as_many_as_there_are_stretches_eight_at_most(abuts, monkeypatch):
    """The last call is filled up; commands are late by their delay, gains of the log beside them."""
    keys = ["hardware.command_delay", "robot.LF.coxa.damping", "hardware.servo.armature"]
    own = model(keys, {"armature": 0.01}, **{"control.kp": 40.0 + np.arange(400) // 100})
    count, calls = 11, []
    begins = own.windows.begin[0] + 0.01 * np.arange(12)
    start, out = np.resize(own.windows.start, (12, *own.windows.start.shape[1:])), np.zeros(12, bool)
    windows = dataclasses.replace(own.windows, abuts=np.array(abuts), begin=begins, start=start, held_out=out)
    own = dataclasses.replace(own, windows=windows)

    def run(function, structure, robots, *, batch_size):
        assert function is predicted.simulate and structure is own.structure
        (point, given, parameters), (axes, of_given, of_parameters) = robots.arguments, robots.axes
        assert (axes.x, axes.start, axes.late) == (1, 1, 0) and set(jax.tree.leaves(of_parameters)) <= {0, 1, 2, 3}
        assert of_given.sent.targets == 3 and jax.tree.structure(of_parameters) == jax.tree.structure(parameters)
        calls.append((batch_size, robots.shape, point, given, robots.directions))
        return {"position": point.start[:, :1]}, {"position": robots.directions.x}

    monkeypatch.setattr(predicted.execution, "run", run)
    which, x = np.arange(count), np.arange(float(len(own.variables)))
    x[0] = 0.003
    state = np.arange(2.0 * count).reshape(count, 2)
    values, tangents = own.run(x, (state, np.ones((count, 2, 2))), which, early=False)
    np.testing.assert_array_equal(values["position"], state[:, :1])
    ((size, shape, point, given, along),) = calls
    stretches = abuts.count(False)
    assert size == min(8, stretches) and shape == (-(-count // size) * size,)
    filled = [*range(count), *range(shape[0] - count)]
    np.testing.assert_array_equal(point.start, state[filled])
    np.testing.assert_array_equal(point.x, np.tile(x, (shape[0], 1)))
    of_x, late = own.tangents()
    for row in range(count):
        np.testing.assert_array_equal(tangents["position"][row], of_x)
    assert along.late.shape == (shape[0], len(late)) and len(along.start) == shape[0]
    targets, rates = windows.targets(which, own.delay(x), 0, own.schedule)
    np.testing.assert_array_equal(given.sent.targets, targets[filled])
    np.testing.assert_array_equal(given.rates.targets, rates[filled])
    gains, _ = own.schedule.at(windows.moments(which, windows.steps + 1) - own.delay(x), STEP)
    for name, each in gains.items():
        np.testing.assert_array_equal(getattr(given.sent, name), each[filled])


def test_windows_follow_each_other_and_know_the_records_before():
    """By a model whose record is the number of its window and of the step in it."""
    windows = cut(log_of(), ROBOT, STEP, 0.0)
    abuts = np.array([False, True, False, True])

    class Counting(predicted.Fit):
        states = 0

        def begun(self, x, start, firsts):
            return (np.array([n for n in firsts]),) * 2

        def run(self, x, state, which, *, early):
            count = np.arange(self.windows.steps + 1)[:, None, None] * np.ones((1, 1))
            kept = {"position": 1e4 * which[:, None, None, None] + count, "end 0": state[0]}
            return kept, kept

    own = Counting(dataclasses.replace(windows, abuts=abuts), (), SimpleNamespace(), SimpleNamespace())
    seen = {}
    for which, values, _ in own.evaluate(np.zeros(0), np.zeros((2, 1, 1, 0))):
        for n, each in zip(which, values["position"][..., 0, 0], strict=True):
            seen[int(n)] = each
    steps = windows.steps
    for n, each in seen.items():
        assert each.shape == (2 * steps + 1,)
        np.testing.assert_array_equal(each[steps:], 1e4 * n + np.arange(steps + 1))
        before = 1e4 * n + np.zeros(steps) if n in (0, 2) else 1e4 * (n - 1) + np.arange(steps)
        np.testing.assert_array_equal(each[:steps], before)
    assert sorted(seen) == [0, 1, 2, 3]


# ---------------------------------------------------------------------------------------------------- a gripped robot


def test_forces_are_logged_with_a_gain_an_offset_and_a_share_of_another_axis():
    keys = ["log.LF.force.gain", "log.LF.force.zero.y", "log.RF.force.z_in_x"]
    places = [Place(key, False) for key in keys]
    force = np.arange(24.0).reshape(2, 4, 3)
    expected = force.copy()
    expected[:, 0] = 1.1 * force[:, 0] + [0, 0.5, 0]
    expected[:, 3, 0] += 0.2 * force[:, 3, 2]
    seen = logged_force(places, jnp.array([1.1, 0.5, 0.2]), ROBOT.limbs, jnp.asarray(force))
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
    assert logged_force([Place("control.kp", False)], jnp.ones(1), ROBOT.limbs, force) is force


def gripped_log():
    """A log of a robot whose base is turned by 30 degrees about z and lifted, at rest for its first window."""
    half = math.radians(15)
    return log_of({
        "base.position.x": 0.3, "base.position.z": 0.25, "base.orientation.w": 2 * math.cos(half),
        "base.orientation.z": 2 * math.sin(half), "LF.force.z": np.sin(np.arange(400)),
        "base.linear_velocity.y": np.sin(np.arange(400)), "LH.support": 1.0,
    })  # fmt: skip


def test_signals_of_feet_and_base_have_their_axis():
    meanings = signals_of(ROBOT)
    assert {name: meanings[name] for name in gripped_log().signals if name.startswith(("base", "LF.force"))} == {
        "LF.force.z": ("N", "force", (0, 2)), "base.position.x": ("m", "base_position", (0,)),
        "base.position.z": ("m", "base_position", (2,)), "base.orientation.w": ("1", "base_orientation", (0,)),
        "base.orientation.z": ("1", "base_orientation", (3,)),
        "base.linear_velocity.y": ("m/s", "base_linear_velocity", (1,)),
    }  # fmt: skip


def test_grips_are_where_feet_are_seen_less_what_they_hang_by_their_load():
    log, stiff = gripped_log(), SCENARIO.with_overrides({"contact.stiffness": 1000.0})
    windows = cut_gripped(log, ROBOT, STEP, 0.2)
    own = gripped_model(stiff, log, windows, variables(stiff, ["contact.stiffness"], held=False))
    angles = windows.start[0, :, :, 0]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array([math.cos(math.radians(15)), 0, 0, math.sin(math.radians(15))]))
    turn = turn.reshape(3, 3)
    position = np.array([0.3, ROBOT.stance_position[1], 0.25])
    feet = position + np.asarray(limb_frames(ROBOT, None, angles).foot) @ turn.T
    hangs = np.array([0, 0, 9.81]) * float(ROBOT.total_mass) / 4 / 1000.0
    np.testing.assert_allclose(own.points, feet + hangs, atol=1e-9)
    np.testing.assert_allclose(own.stood.base_position, position, atol=1e-9)
    np.testing.assert_allclose(np.abs(own.stood.base_orientation @ [math.cos(math.radians(15)), 0, 0,
                               math.sin(math.radians(15))]), 1.0)  # fmt: skip
    np.testing.assert_array_equal(own.stood.joint_angles, angles)
    grips = [v for v in own.variables if ".grip." in v.key]
    assert len(grips) == 12 and all((v.sd, v.lower, v.upper, v.beside) == (0.003, -0.1, 0.1, True) for v in grips)
    assert own.LEADS == 0.5 and own.guess.shape[-1] == 0


@pytest.mark.parametrize(
    ("changes", "held", "said"),
    [
        ({}, True, None),
        ({}, False, None),
        ({"disturbance.cargo.mass": 0.5}, True, None),
        ({"disturbance.others": [{"kind": "link_wrench"}]}, True, "none with a log, got LinkWrench"),
        ({"hardware.servo.kind": "velocity"}, True, "servos with the base held"),
        ({"hardware.servo.kind": "velocity"}, False, None),
    ],
)
def test_parts_that_no_model_of_a_log_has_are_refused(changes, held, said):
    own = own_parameters(SCENARIO.with_overrides(changes))
    if said is None:
        check_parts(own, held=held)
    else:
        with pytest.raises(mc.ConfigError, match=said):
            check_parts(own, held=held)


def test_a_bound_of_a_variable_in_seconds_is_where_its_stage_is_looked_for():
    assert predicted.stages_for(SCENARIO, variables(SCENARIO, ["hardware.servo.delay"], held=True)).servo_delay > 0


def test_priors_are_a_factor_of_e_or_the_scale_of_the_unit_and_delays_are_looked_for_within_20_ms():
    positive = priors._positive("k", "N/m", 3e4)
    assert (positive.mean, positive.sd, positive.log) == (pytest.approx(np.log(3e4)), 1.0, True)
    assert (positive.lower, positive.upper) == (pytest.approx(30.0), pytest.approx(3e7))
    assert np.isnan(priors._positive("k", "N/m", 0.0).mean) and np.isnan(priors._positive("k", "N/m", np.inf).mean)
    for unit, nominal, sd in (
        ("s", 0.002, 0.01),
        ("s", 0.03, 0.03),
        ("N m", -0.5, 0.5),
        ("Ohm", 0.1, 0.5),
        ("K", 0.2, 1.0),
    ):
        linear = priors._linear("k", unit, nominal, -1.0)
        assert (linear.mean, linear.sd, linear.lower, linear.upper) == (nominal, sd, -1.0, np.inf) and not linear.log
    bounds = {"inside": (0.5, 40.0), "wide": (1e-9, 1e9)}
    field = {name: types.SimpleNamespace(bounds=ends, unit="N/m") for name, ends in bounds.items()}
    found = priors._of_scenario("k", field["inside"], 10.0, 1e-3)
    assert (found.lower, found.upper) == (0.5, 40.0)
    found = priors._of_scenario("k", field["wide"], 10.0, 1e-3)
    assert (found.lower, found.upper) == (pytest.approx(0.01), pytest.approx(1e4))
    most = sys.float_info.max
    for nominal, step, upper in ((0.0, 1e-3, 0.02), (0.015, 1e-3, 0.03), (0.001, 0.011, 0.022)):
        late = priors._of_scenario("k", types.SimpleNamespace(bounds=(0.0, most), unit="s"), nominal, step)
        assert (late.lower, late.upper) == (0.0, upper)
    free = priors._of_scenario("k", types.SimpleNamespace(bounds=(-most, most), unit="1"), 0.1, 1e-3)
    assert (free.lower, free.upper, free.sd) == (-np.inf, np.inf, 0.3)


def test_a_sensor_of_a_foot_has_a_gain_and_each_axis_an_offset_and_shares_of_the_two_others():
    gain, *rest = priors._of_sensor("log.LF", 2)
    assert (gain.key, gain.nominal, gain.mean, gain.sd, gain.lower, gain.upper) == (
        "log.LF.gain",
        1.0,
        1.0,
        0.2,
        0.1,
        10.0,
    )
    keys = [each.key.removeprefix("log.LF.") for each in rest]
    assert keys == ["zero.x", "y_in_x", "z_in_x", "zero.y", "x_in_y", "z_in_y", "zero.z", "x_in_z", "y_in_z"]
    for each in rest:
        ends = (2.0, -np.inf, np.inf) if "zero" in each.key else (0.05, -1.0, 1.0)
        assert (each.nominal, each.mean, each.sd, each.lower, each.upper) == (0.0, 0.0, *ends)
        assert each.limb == gain.limb == 2 and not each.log


def test_a_robot_sways_under_pd_without_loads_for_ten_times_its_log_before_it_would_step():
    push = {"force": [1.0, 0.0, 0.0], "start": 0.1, "stop": 0.2}
    changes = {"disturbance.pushes": [push], "control.reading": "measured_pose"}
    own = mc.load_scenario("configs/case_1_2.yaml", changes)
    found = swaying(own, 3.0005)
    assert 30.005 <= found.gait.cycle < 30.0065 and (found.gait.stride, found.gait.duty) == (0.0, 0.95)
    assert found.gait.phases.model_dump() == pytest.approx({"LF": 0.2, "LH": 0.28, "RH": 0.36, "RF": 0.44})
    assert found.disturbance.cargo.mass == 0 and not found.disturbance.pushes
    assert (found.control.controller, found.control.reading) == ("pd", "virtual_model")
    assert (found.control.kp, found.duration, found.gravity) == (own.control.kp, own.duration, own.gravity)


def test_what_is_recorded_late_has_no_tangent_of_its_own_and_commands_no_stage_of_their_own():
    late = type("Late", (predicted.Fit,), {"LATE": {"b": ("force",)}})
    own = [priors.Variable(key, "s", 0.0, 0.0, 1.0, -1.0, 1.0) for key in ("a", "b", "log.velocity.delay")]
    assert late(None, tuple(own), None, None).lanes == [[0], [2]]
    changes = {"hardware.command_delay": 0.01, "hardware.control_period": 0.01, "hardware.interpolation": "linear"}
    stages = predicted.stages_for(mc.Scenario().with_overrides(changes), [])
    assert (stages.command_delay, stages.control_period, stages.linear) == (0, False, False)
