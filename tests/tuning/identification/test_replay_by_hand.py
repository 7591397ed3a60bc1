"""Replay: what is sent, which pushes act, and how a walk is compared with its log, worked out by hand."""

import dataclasses

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.walk.sample import unknown
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.model.replay import Replay, base_of, errors_of, prepare, remarks
from tuning.identification.readers.log import KP, OFF, Log, Signal

STEP = 0.001
SCENARIO = mc.Scenario().with_overrides({"time_step": STEP, "hardware.control_period": 0.004})


def signal(time, value):
    return Signal(np.array(time, float), np.array(value, float))


def log_of(**signals):
    return Log({name.replace("__", "."): each for name, each in signals.items()}, "log.csv")


COMMAND = signal([0.0, 0.0105, 0.03], [0.1, 0.2, 0.3])


def free(**more):
    return prepare(log_of(LF__coxa__command=COMMAND, **more), SCENARIO, "free")


def test_a_command_is_held_until_the_next_and_joints_without_one_stay_where_they_began():
    found = free(
        LF__femur__position=signal([0, 0.03], [0.7, 0.9]), RF__tibia__command=signal([0.005, 0.02], [-0.1, -0.2])
    )
    assert len(found.targets) == found.scenario.steps == 31 and found.scenario.duration == pytest.approx(0.031)
    expected = np.where(np.arange(31) < 11, 0.1, 0.2)
    expected[30] = 0.3
    np.testing.assert_array_equal(found.targets[:, 0, 0], expected)
    np.testing.assert_array_equal(found.targets[:, 0, 1], 0.7)
    np.testing.assert_array_equal(found.targets[:, 1, 1], ROBOT.stance_joints[1, 1])
    np.testing.assert_array_equal(found.targets[:, 3, 2], np.where(np.arange(31) < 20, -0.1, -0.2))
    assert found.warnings[-1] == "2 joints of 12 have commands, the others are sent where they began"


def test_on_a_stand_targets_reach_the_servos_late_and_as_means_about_a_step():
    late = SCENARIO.with_overrides({"hardware.command_delay": 0.004})
    found = prepare(log_of(LF__coxa__command=signal([0.0, 0.01, 0.03], [0.1, 0.2, 0.2])), late, "held")
    np.testing.assert_allclose(found.targets[[12, 13, 14, 15, 16], 0, 0], [0.1, 0.1, 0.15, 0.2, 0.2])


def test_rates_of_joints_without_commands_are_none():
    found = prepare(log_of(LF__coxa__velocity_command=COMMAND, LF__femur__position=COMMAND), SCENARIO, "held")
    np.testing.assert_array_equal(found.targets[:, 0, 1], 0.0)
    with pytest.raises(mc.ConfigError, match=r"expected commands of joint angles with the base free, got LF.coxa.vel"):
        free_of = log_of(LF__coxa__velocity_command=COMMAND)
        prepare(free_of, SCENARIO, "free")


def test_pushes_are_the_constant_pieces_of_the_log():
    found = free(
        base__force__x=signal([0.002, 0.006, 0.010, 0.014], [0.0, 5.0, 5.0, 0.0]),
        base__moment__z=signal([0.008, 0.020], [0.5, 0.5]),
    )
    pushes = [(p.force, p.moment, p.start, p.stop) for p in found.scenario.disturbance.pushes]
    assert pushes == [
        ((5.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.006, 0.008),
        ((5.0, 0.0, 0.0), (0.0, 0.0, 0.5), 0.008, 0.014),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5), 0.014, pytest.approx(0.021)),
    ]
    assert "pushes of the log: 3" in found.warnings


def test_pushes_of_the_config_act_where_the_log_has_none_and_it_is_said():
    own = {"disturbance.pushes": [{"force": [1.0, 0.0, 0.0], "start": 0.0, "stop": 0.1}]}
    found = prepare(log_of(LF__coxa__command=COMMAND), SCENARIO.with_overrides(own), "free")
    assert len(found.scenario.disturbance.pushes) == 1
    assert found.warnings[0] == "the log has no pushes: those of the config act"
    assert not any("pushes" in text for text in free().warnings)


def test_gains_of_the_log_have_no_part_with_a_free_base():
    gains = {KP: signal([0.0], [25.0]), OFF: signal([0.0], [0.0])}
    log = Log({"LF.coxa.command": COMMAND, **gains}, "log.csv")
    said = f"{KP} and {OFF} of the log have no part in it: the base is free"
    assert said in prepare(log, SCENARIO, "free").warnings and said not in prepare(log, SCENARIO, "held").warnings


@pytest.mark.parametrize(
    ("names", "base", "mass", "expected"),
    [
        (["LF.coxa.command"], None, 0.0, "held"),
        (["LF.force.x"], None, 0.0, "free"),
        (["base.position.x"], None, 0.0, "free"),
        (["LF.force.x"], "held", 0.2, "held"),
        (["LF.coxa.command"], "free", 0.0, "free"),
        (["LF.coxa.command"], None, -0.1, "a mass on each foot of 0 kg or more"),
        (["LF.coxa.command"], None, np.inf, "a mass on each foot of 0 kg or more"),
        (["LF.force.x"], None, 0.2, "none with the base free, got 0.2 kg"),
    ],
)
def test_the_base_is_held_where_neither_it_nor_a_foot_was_measured(names, base, mass, expected):
    log = Log(dict.fromkeys(names, COMMAND), "log.csv")
    if expected in ("held", "free"):
        assert base_of(log, base, mass) == expected
    else:
        with pytest.raises(mc.ConfigError, match=expected):
            base_of(log, base, mass)


# ------------------------------------------------------------------------------------------------- a walk and its log


def walk_of(steps=5):
    """A walk at rest but for its first joint, whose feet are where a turned base has them."""
    angles = np.broadcast_to(ROBOT.stance_joints, (steps, 4, 3)).copy()
    angles[:, 0, 0] += 0.1 * np.arange(steps)
    known = {
        "time": STEP * np.arange(steps), "joint_angles": angles, "joint_rates": np.zeros((steps, 4, 3)),
        "joint_torque": np.zeros((steps, 4, 3)), "foot_force": np.full((steps, 4, 3), 7.0),
        "base_position": np.tile([0.1, 0.2, 0.3], (steps, 1)), "base_orientation": np.tile([1.0, 0, 0, 0], (steps, 1)),
        "base_linear_velocity": np.zeros((steps, 3)), "base_angular_velocity": np.zeros((steps, 3)),
        "support": np.ones((steps, 4), bool),
    }  # fmt: skip
    quantities = unknown(steps, {"limb": 4, "joint": 3}) | known
    return mc.Trajectory(
        scenario=SCENARIO, gains={}, parameters=own_parameters(SCENARIO), limbs=ROBOT.limbs, law="x", **quantities
    )


def test_errors_are_at_the_times_of_the_log():
    log = log_of(
        LF__coxa__position=signal([0.0005, 0.0015, 0.003], ROBOT.stance_joints[0, 0] + np.array([0.06, 0.12, 0.3])),
        RH__force__y=signal([0.0, 0.002], [7.0, 10.0]), LF__coxa__command=COMMAND,
    )  # fmt: skip
    found = errors_of(walk_of(), log, ROBOT)
    assert list(found) == ["LF.coxa.position", "RH.force.y"]
    one = found["LF.coxa.position"]
    assert (one.rms, one.largest) == (pytest.approx(np.sqrt((0.01**2 + 0.03**2) / 3)), pytest.approx(0.03))
    assert (one.at, one.samples) == (pytest.approx(0.0015), 3)
    assert one.moved == pytest.approx(np.std([0.06, 0.12, 0.3]))
    assert (found["RH.force.y"].largest, found["RH.force.y"].at) == (3.0, 0.002)


@pytest.mark.parametrize(
    ("off", "support", "said"),
    [
        (0.051, None, ["0.051 rad from where LH.coxa was logged first", "the log does not say when"]),
        (0.049, None, ["the log does not say when"]),
        (0.0, [1, 1, 1, 1, 1], []),
        (0.0, [1, 0, 1, 1, 1], ["other than in the log for 20 % of the time"]),
    ],
)
def test_what_a_comparison_rests_on_is_said(off, support, said):
    time = STEP * np.arange(5)
    signals = {
        "LH.coxa.position": Signal(time, np.full(5, ROBOT.stance_joints[1, 0] - off)),
        "LF.femur.position": Signal(time, np.full(5, ROBOT.stance_joints[0, 1] + off / 2)),
    }
    if support is not None:
        both = {"LF.support": np.ones(5), "RF.support": np.array(support, float)}
        signals |= {name: Signal(time, values) for name, values in both.items()}
    found = list(remarks(walk_of(), Log(signals, "log.csv"), ROBOT))
    assert len(found) == len(said) and all(text in each for text, each in zip(said, found, strict=True))


def test_a_log_as_a_walk_has_what_was_logged_and_its_own_feet():
    walk, time = walk_of(), STEP * np.arange(5)
    half = np.sqrt(0.5)
    log = Log(
        {"RH.femur.position": Signal(time, np.full(5, 0.4)), "base.position.x": Signal(time, np.full(5, 2.0)),
         "base.orientation.w": Signal(time, np.full(5, 3 * half)),
         "base.orientation.z": Signal(time, np.full(5, 3 * half))},
        "log.csv",
    )  # fmt: skip
    found = Replay(log, SCENARIO, "free", walk, {}, ()).logged()
    np.testing.assert_allclose(found.joint_angles[:, 2, 1], 0.4)
    np.testing.assert_array_equal(found.joint_angles[:, 0], walk.joint_angles[:, 0])
    np.testing.assert_allclose(found.base_orientation, np.tile([half, 0, 0, half], (5, 1)))
    np.testing.assert_array_equal(found.foot_force, 0.0)
    feet = limb_frames(ROBOT, None, found.joint_angles).foot
    turned = np.stack([2.0 - feet[..., 1], 0.2 + feet[..., 0], 0.3 + feet[..., 2]], -1)
    np.testing.assert_allclose(found.foot_position, turned, atol=1e-12)
    forces = dataclasses.replace(log, signals={"LH.force.z": Signal(time, np.full(5, 1.5))})
    seen = Replay(forces, SCENARIO, "free", walk, {}, ()).logged().foot_force
    np.testing.assert_array_equal(seen[:, 1], np.tile([7.0, 7.0, 1.5], (5, 1)))
