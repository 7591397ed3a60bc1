"""The plan of an excitation on a robot that is where it is sent at once: limits, choice, and the files of the result.

Its joints have the angles and rates of the commands, late by the bus; its torque is the viscous friction's. So every
number has a value that can be worked out by hand.
"""

import dataclasses
import functools
import itertools
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.scenario.messages import ConfigError
from tests.tuning.identification.stand_in_mujoco import Truth, welded
from tuning.identification.model.commanded import Carried
from tuning.identification.model.variables import begin
from tuning.identification.plan import excitation, output
from tuning.identification.plan.information import Information
from tuning.identification.plan.motions import Axes
from tuning.identification.plan.rig import Rig, Segment
from tuning.identification.plan.settings import Excitation

TORQUE, SPEED, DAMPING, DELAY, PERIOD = 4.1, 4.8, 0.05, 0.004, 0.01
CONFIG = {
    "hardware": {"control_period": PERIOD, "command_delay": DELAY, "interpolation": "linear", "servo": {
        "torque_limit": TORQUE, "no_load_speed": SPEED, "armature": 0.012, "viscous_friction": DAMPING,
    }}
}  # fmt: skip


def at_once(robot, parameters, commands, lead=0.0):
    """The motion of a robot whose joints are where they are sent; it falls by 1 rad/s while the torque is off."""
    del robot, lead
    sent, rates = commands.sent, commands.rates.targets
    angles = sent.targets - (parameters.bus.command_delay - commands.delay)[:, None, None] * rates
    if sent.on is not None:
        off = 1 - sent.on[:, None, None]
        angles, rates = angles - 1e-3 * jnp.cumsum(off, 0), rates - off
    torque = parameters.drive.viscous_friction * rates
    return Carried(angles, rates, torque, jnp.broadcast_to(parameters.gravity, (*angles.shape[:2], 3)))


class AtOnce(Rig):
    def run(self):
        return at_once

    def at_rest(self):
        return resting()


@functools.cache
def resting():
    with jax.enable_x64(True):
        return Rig.at_rest(rig_of())


def rig_of(changes=None, **asked):
    scenario = mc.load_scenario("configs/case_1_1.yaml", CONFIG).with_overrides(changes or {})
    settings = {"fit": ("hardware.command_delay", "hardware.servo.viscous_friction"), "candidates": 2, "duration": 2}
    rig = excitation.set_up(scenario, Excitation(**settings | asked))
    return AtOnce(*(getattr(rig, field.name) for field in dataclasses.fields(rig)))


@pytest.fixture(scope="module", autouse=True)
def doubles():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def rig():
    return rig_of()


@pytest.fixture(scope="module")
def free():
    return rig_of({"contact.holding_limit": 8.0}, base="free", fit=("contact.stiffness",))


@pytest.fixture(scope="module")
def found(rig):
    asked = rig.asked.changed({"drop": True, "kp": (50.0, 40.0), "rate": 50.0, "candidates": 1})
    made = excitation.chosen(dataclasses.replace(rig, asked=asked))
    return dataclasses.replace(made, best=made.candidates[1])  # the one that drops


def still(rig, steps=40):
    angles = np.broadcast_to(rig.robot.stance_joints, (steps, 4, 3)).copy()
    return angles, Carried(angles.copy(), *(np.zeros((steps, 4, 3)) for _ in range(3)))


# ---------------------------------------------------------------------------------------------------- limits of a rig


@pytest.mark.parametrize(
    ("moved", "share", "which"),
    [
        ({"rates": (2, 1, -2.4)}, 0.5, "speed of RH.femur"),
        ({"torque": (1, 2, -2.05)}, 0.5, "torque of LH.tibia"),
        ({"torque": (1, 2, 2.0), "rates": (1, 2, 2.4)}, 2.0 / (TORQUE * 0.5), "torque of LH.tibia"),
        ({"torque": (1, 2, 2.0), "rates": (1, 2, -2.4)}, 0.5, "speed of LH.tibia"),
        ({"torque": (1, 2, -2.0), "rates": (1, 2, -2.4)}, 2.0 / (TORQUE * 0.5), "torque of LH.tibia"),
        ({"torque": (0, 0, 0.123), "rates": (0, 0, 4.8)}, 1.5, "torque of LF.coxa"),
        ({"targets": (3, 0, 0.6)}, 0.6, "joint limit of RF.coxa"),
        ({"targets": (3, 0, -0.4)}, 0.4, "joint limit of RF.coxa"),
    ],
)  # fmt: skip
def test_the_share_of_a_limit_is_that_of_the_joint_that_uses_most(rig, moved, share, which):
    targets, carried = still(rig)
    robot = rig.robot
    for name, (limb, joint, value) in moved.items():
        if name == "targets":
            way = robot.joint_upper if value > 0 else robot.joint_lower
            targets[7, limb, joint] += abs(value) * (way - robot.stance_joints)[limb, joint]
        else:
            getattr(carried, name)[7, limb, joint] = value
    assert rig.used(targets, carried) == (pytest.approx(share), which)


def test_of_limbs_that_are_alike_to_rounding_the_first_one_is_named(rig, free):
    targets, carried = still(rig)
    carried.rates[7, 1:, 2] = 2.4 * (1 + 1e-12 * np.arange(3))
    assert rig.used(targets, carried) == (pytest.approx(0.5), "speed of LH.tibia")
    carried.rates[:], carried.angles[0, :, 1] = 0.0, rig.robot.stance_joints[:, 1] + 0.3 * (1 + 1e-12 * np.arange(4))
    assert rig.used(targets, carried)[1] == "reach of LF"
    carried.force[5] = np.array([0.0, 0.0, -4.0]) * (1 + 1e-12 * np.arange(4)[:, None])
    assert free.used(targets, carried)[1] == "pull of LF"


def test_a_log_tells_armature_frictions_and_the_command_delay_by_default():
    servo = {f"hardware.servo.{name}" for name in ("armature", "coulomb_friction", "viscous_friction")}
    assert {*Excitation().fit} == servo | {"hardware.command_delay"}


def test_joints_whose_axis_is_upright_fall_neither_way(rig):
    assert rig.falling().tolist() == [[0.0, -1.0, 1.0]] * 4


def test_angles_have_the_limits_of_joints_and_feet_half_the_way_to_the_next_foot(rig):
    targets, carried = still(rig)
    carried.angles[13, 1, 1] += 0.3
    near, wide = (
        dataclasses.replace(rig, robot=dataclasses.replace(rig.robot, joint_upper=rig.robot.stance_joints + room))
        for room in (0.4, 30.0)
    )
    assert near.used(targets, carried) == (pytest.approx(0.75), "joint limit of LH.femur")
    assert wide.used(targets, carried) == (pytest.approx(0.01), "joint limit of LH.femur")  # between two commands
    carried.angles[2 * rig.hold] = carried.angles[13]
    foot = limb_frames(rig.robot, None, carried.angles[13]).foot
    rest = limb_frames(rig.robot, None, rig.robot.stance_joints).foot
    nearest = min(np.linalg.norm(rest[1] - rest[n]) for n in (0, 2, 3))
    expected = np.linalg.norm(foot[1] - rest[1]) / (nearest / 2)
    assert wide.used(targets, carried) == (pytest.approx(expected), "reach of LH")


@pytest.mark.parametrize("where", ["targets", "torque"])
def test_a_motion_out_of_reach_uses_more_than_all(rig, where):
    targets, carried = still(rig)
    (targets if where == "targets" else carried.torque)[3, 1, 1] = np.nan
    assert rig.used(targets, carried) == (np.inf, "reach")


def test_feet_that_pull_use_the_holding_limit_and_feet_that_press_do_not(free):
    targets, carried = still(free)
    carried.force[:, 0], carried.force[:, 1], carried.force[5, 2] = [0.0, 0.0, 7.9], [20.0, 0.0, 0.5], [3.0, 0.0, -4.0]
    assert free.used(targets, carried) == (pytest.approx(5 / 8), "pull of RH")


def test_room_is_the_smaller_one_and_the_acceleration_what_the_torque_at_rest_leaves(rig):
    model = welded("hubrobo_v3_2", Truth(armature=0.012, gravity=tuple(rig.scenario.gravity)))
    data, whole = mujoco.MjData(model), np.zeros((12, 12))
    data.qpos[:] = rig.robot.stance_joints.ravel()
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, whole)
    axes, robot = rig.axes(), rig.robot
    np.testing.assert_allclose(rig.at_rest()[1].ravel(), data.qfrc_bias, atol=1e-9)
    each = zip(robot.stance_joints.ravel(), robot.joint_lower.ravel(), robot.joint_upper.ravel(), strict=True)
    np.testing.assert_allclose(axes.room, [0.7 * min(high - at, at - low) for at, low, high in each])
    np.testing.assert_allclose(axes.speed, 0.7 * SPEED)
    left = 0.7 * TORQUE - np.abs(data.qfrc_bias)
    np.testing.assert_allclose(axes.acceleration, left / np.diag(whole), rtol=1e-6)
    passive = ((False, True, False),) * 4
    room = dataclasses.replace(rig, robot=dataclasses.replace(robot, passive=passive)).axes().room.reshape(4, 3)
    assert (room[:, 1] == 0).all() and (room[:, [0, 2]] > 0).all()
    weak = rig_of({"hardware.servo.torque_limit": 0.02})
    with pytest.raises(ConfigError, match=r"takes less than a share of 0.7 of the limit, got .* of 0.02 N m"):
        weak.axes()


def test_commands_that_come_late_have_their_stage_where_only_their_clock_is_fitted():
    late = rig_of({"hardware.command_delay": 0.0}, base="free", fit=("contact.stiffness",))
    assert late.stages.command_delay > 0 and "log.command.delay" in {v.key for v in late.beside}


def test_logged_forces_are_late_by_their_delay_and_off_by_their_bias():
    own = {"hardware.force_sensor": {"delay": 0.01, "bias": 0.3}}
    rig = rig_of(own, base="free", fit=("hardware.force_sensor.delay", "log.LF.force.gain"))
    force = np.zeros((5, 4, 3))
    force[:, 0, 2] = 0.5 * np.arange(5)
    at = begin((*rig.chosen, *rig.beside)) + np.r_[0.002, 0.1, np.zeros(len(rig.beside))]
    found = np.asarray(rig.logged_force(jnp.asarray(at), jnp.asarray(force)))
    slope = 0.5 / rig.scenario.time_step
    bias = np.broadcast_to(0.3, 3) if np.ndim(rig.parameters.force_sensor.bias) == 0 else 0.3
    np.testing.assert_allclose(found[:, 0, 2], 1.1 * (force[:, 0, 2] - 0.002 * slope + 0.3))
    np.testing.assert_allclose(found[:, 1], np.broadcast_to(bias, (5, 3)))


def test_a_sway_is_scaled_from_centimetres_and_the_speed_of_the_joints(free):
    axes = free.axes()
    np.testing.assert_allclose(axes.room, [0.03] * 3 + [0.15] * 3)
    np.testing.assert_allclose(axes.speed, 0.7 * SPEED * axes.room)
    assert np.isinf(axes.acceleration).all()


def test_where_the_config_has_no_speed_five_radians_a_second_are_taken():
    rig = rig_of({"hardware.servo.no_load_speed": None, "hardware.control_period": 0.0})
    assert rig.speed_limit == 5.0 and rig.period == pytest.approx(0.01) and rig.lead == 100


# -------------------------------------------------------------------------------------------------- what is commanded


def test_the_targets_of_a_sway_leave_the_feet_where_they_stand(free):
    moved = np.array([[0.01, -0.02, 0.015, 0.05, -0.08, 0.1], [0.0, 0.0, 0.3, 0.0, 0.0, 0.0]])
    targets, robot = free.targets(moved), free.robot
    assert np.isnan(targets[1]).all()
    vector = moved[0, 3:]
    turn, start = np.zeros(9), np.zeros(9)
    quaternion = np.r_[np.cos(np.linalg.norm(vector) / 2), np.sin(np.linalg.norm(vector) / 2) * vector]
    quaternion[1:] /= np.linalg.norm(vector)
    mujoco.mju_quat2Mat(turn, quaternion)
    mujoco.mju_quat2Mat(start, np.asarray(robot.stance_orientation, float))
    foot = limb_frames(robot, None, targets[0]).foot @ turn.reshape(3, 3).T + start.reshape(3, 3).T @ moved[0, :3]
    np.testing.assert_allclose(foot, limb_frames(robot, None, robot.stance_joints).foot, atol=1e-6)


def test_commands_hold_for_their_period_after_a_lead_and_come_as_late_as_the_bus():
    rig = rig_of({"hardware.interpolation": "hold"})
    targets = rig.targets(np.arange(1, 4)[:, None] * np.full(12, 0.01))
    segments = [Segment("a", 0, 2, 25.0, None), Segment("b", 2, 3, 0.0, None)]
    made, lead = rig.commands(targets, segments), rig.lead * rig.hold
    nominal = float(rig.parameters.joint_loop.kp)
    assert len(made.delay) == lead + 3 * rig.hold and (made.delay == DELAY).all()
    late = round(DELAY / rig.scenario.time_step)
    middle = lead + late + rig.hold // 2 + np.arange(2) * rig.hold
    np.testing.assert_allclose(made.sent.targets[middle], targets[:2])
    np.testing.assert_allclose(made.sent.targets[: lead + late], np.broadcast_to(targets[0], (lead + late, 4, 3)))
    np.testing.assert_allclose(made.sent.share[middle], 25.0 / nominal)
    np.testing.assert_allclose([*made.sent.share[-2:], *made.sent.on[-2:]], 0.0)
    np.testing.assert_allclose(made.sent.on[middle], 1.0)
    np.testing.assert_allclose(made.rates.targets[middle], 0.0)
    assert made.rates.targets[lead + late + rig.hold].max() > 0


def test_a_line_between_commands_reaches_a_target_at_the_end_of_its_period():
    rig = rig_of({"hardware.command_delay": 0.0})
    targets = rig.targets(np.arange(3)[:, None] * np.full(12, 0.1))
    sent = rig.commands(targets, []).sent.targets[rig.lead * rig.hold :, 0, 0] - targets[0, 0, 0]
    reached = 0.1 * (np.arange(2 * rig.hold) + 1) / rig.hold
    np.testing.assert_allclose(sent[rig.hold :], reached, atol=0.1 / rig.hold / 2)


def test_candidates_are_of_one_length_and_begin_with_the_plain_chirp(rig):
    made = excitation.candidates(dataclasses.replace(rig, asked=rig.asked.changed({"kp": (25.0, 50.0)})))
    assert list(made) == ["plain chirp", "1: multisine, 0.1 to 10 Hz", "2: multisine, reversals, 0.1 to 10 Hz"]
    assert [(s.name, s.start, s.stop, s.kp) for s in made["2: multisine, reversals, 0.1 to 10 Hz"]] == [
        ("multisine", 0, 50, 25.0), ("reversals", 50, 100, 25.0), ("multisine", 100, 150, 50.0),
        ("reversals", 150, 200, 50.0),
    ]  # fmt: skip
    assert [(s.start, s.stop, s.kp) for s in made["plain chirp"]] == [(0, 100, 25.0), (100, 200, 50.0)]
    more = excitation.candidates(dataclasses.replace(rig, asked=rig.asked.changed({"candidates": 5})))
    assert list(more)[-1] == "5: multisine, 0.1 to 3.33 Hz"
    slow = excitation.candidates(dataclasses.replace(rig, asked=rig.asked.changed({"candidates": 5, "high": 0.3})))
    assert list(slow)[-1] == "5: multisine, 0.1 to 0.2 Hz"


def test_one_limb_moves_after_the_other(rig):
    asked = rig.asked.changed({"limb_by_limb": True, "family": ("chirp",), "candidates": 1})
    (segment,) = excitation.candidates(dataclasses.replace(rig, asked=asked))["1: chirp, 0.1 to 10 Hz"]
    moves = np.abs(segment.moved.reshape(4, 50, 4, 3)).max((1, 3)) > 0
    np.testing.assert_array_equal(moves, np.eye(4, dtype=bool))


def test_motions_are_scaled_until_the_limit_that_binds_has_its_margin(rig):
    far = np.zeros((100, 12))
    far[:, 4] = 0.4 * np.sin(2 * np.pi * np.arange(100) / 50)
    made = {"large": [Segment("a", 0, 100, 50.0, 9 * far)], "small": [Segment("b", 0, 100, 50.0, far / 8)]}
    motions, done = excitation.within_limits(rig, made)
    for motion, carried in zip(motions, done, strict=True):
        share, which = rig.used(motion.targets, Carried(*(value[rig.lead * rig.hold :] for value in carried)))
        assert 0.55 < share <= 0.7, which
        assert motion.bound == (f"{which}, {100 * share:.0f} % of it",)
    grown = motions[1].targets - rig.robot.stance_joints
    np.testing.assert_allclose(motions[0].targets - rig.robot.stance_joints, grown, atol=0.02)


def test_a_limit_that_holds_at_no_amplitude_is_told_in_one_line(rig):
    low = dataclasses.replace(rig.robot, joint_upper=rig.robot.stance_joints + 1e-9)
    moved = np.full((4, 12), 0.1)
    with pytest.raises(ConfigError, match=r"expected limits that hold with a share of 0.7 of each, got .* at any"):
        excitation.within_limits(dataclasses.replace(rig, robot=low), {"a": [Segment("drop", 0, 4, 0.0, moved)]})


def test_a_fall_that_uses_more_than_its_margin_is_refused_though_the_limits_hold(rig):
    """It is not scaled: of a joint's way to its limit 0.85 are too much, 0.65 are not."""
    room, moved = (rig.robot.joint_upper - rig.robot.stance_joints)[1, 0], np.zeros((300, 12))
    for share in (0.65, 0.85):
        moved[:, 3] = share * room * np.linspace(0, 1, 300)
        made = {"a": [Segment("raise", 0, 300, 50.0, moved)]}
        if share < 0.7:
            assert excitation.within_limits(rig, made)[0][0].bound == ("joint limit of LH.coxa, 65 % of it",)
            continue
        with pytest.raises(ConfigError, match=r"joint limit of LH.coxa: expected .* a share of 0.7 .* got 0.85 of it"):
            excitation.within_limits(rig, made)


# --------------------------------------------------------------------------------------------------------- the result


def test_the_log_that_tells_most_is_chosen_and_its_information_is_that_of_rates(rig):
    found = excitation.chosen(rig)
    assert found.plain.motion.name == "plain chirp" and found.candidates[0] is found.plain
    scores = [each.information.score for each in found.candidates]
    assert found.best is found.candidates[int(np.argmax(scores))]
    assert found.gain == pytest.approx(np.exp((max(scores) - scores[0]) / 4))
    np.testing.assert_allclose(found.time, PERIOD * np.arange(200))
    # the angles of a command are late by the delay alone; nothing else of it is in the log
    np.testing.assert_allclose(found.carried.torque, DAMPING * found.carried.rates)
    own = np.sum((DELAY * found.carried.rates / rig.asked.noise) ** 2)
    np.testing.assert_allclose(found.best.information.matrix, [[own, 0], [0, 0]], rtol=1e-6, atol=1e-6 * own)
    assert found.best.information.silent == ["hardware.servo.viscous_friction"]


def test_half_the_samples_tell_half(rig):
    moved = np.repeat(0.1 * np.sin(2 * np.pi * np.arange(200) / 25)[:, None], 12, 1)
    segments = (Segment("a", 0, 200, 50.0, moved),)
    motion = excitation.Motion("a", segments, (), rig.targets(moved))
    every, half, loud = (
        excitation.informations(dataclasses.replace(rig, asked=rig.asked.changed(changes)), [motion])[0].matrix[0, 0]
        for changes in ({}, {"rate": 50.0}, {"noise": 2 * rig.asked.noise})
    )
    assert half == pytest.approx(every / 2, rel=0.01) and loud == pytest.approx(every / 4)


def test_forces_of_a_sway_are_in_its_log_with_a_tenth_of_a_newton_of_noise():
    rig = rig_of(base="free", fit=("log.LF.force.zero.z",), noise=1.0)
    motion = excitation.Motion("a", (), (), rig.targets(np.zeros((50, 6))))
    found = excitation.informations(rig, [motion])[0]
    np.testing.assert_allclose(found.matrix, [[50 * (2.0 / 0.1) ** 2]])  # of an offset of 2 N


def test_limbs_fall_until_a_limit_is_near(found, rig):
    raised, falling = found.best.motion.segments[-2:]
    assert (raised.name, falling.name) == ("raise", "drop") and (raised.kp, falling.kp) == (40.0, 0.0)
    assert raised.start == 200 and raised.stop == falling.start == 350 and falling.stop <= 500
    down = (np.sign(rig.at_rest()[1]) * [0, 1, 1]).ravel()  # the first joint of a limb has an upright axis
    np.testing.assert_allclose(raised.moved[-1], 0.7 * rig.axes().room * down, atol=1e-12)
    np.testing.assert_allclose(falling.moved, np.broadcast_to(raised.moved[-1], falling.moved.shape))
    assert (np.abs(np.diff(raised.moved[100:], axis=0)) < 1e-12).all() and np.abs(raised.moved[98]).max() > 0
    # it falls by 1 rad/s: the first joint that comes within the margin ends it
    robot, begin = rig.robot, rig.robot.stance_joints.ravel() + raised.moved[-1]
    room = begin - (robot.stance_joints - 0.7 * (robot.stance_joints - robot.joint_lower)).ravel()
    assert 5 < falling.stop - falling.start <= np.ceil(room.min() / PERIOD) + 1


def test_columns_trajectory_and_summary_are_those_of_the_motion(found):
    motion, off = found.best.motion, output.gains(found)[1]
    length, end = len(found.time), motion.segments[-1].start
    np.testing.assert_array_equal(off, np.arange(length) >= end)
    columns = output.columns(found)
    np.testing.assert_allclose(columns["RH.tibia.command"][:end], motion.targets[:end, 2, 2], atol=1e-6)
    assert np.isnan(columns["RH.tibia.command"][end:]).all() and np.isnan(columns["control.kp"][end:]).all()
    assert columns["control.kp"][0] == 50 and columns["control.kp"][end - 1] == 40
    np.testing.assert_array_equal(columns["torque_off"], off)
    passive = ((False,) * 3, (False, True, False), (False,) * 3, (False,) * 3)
    rowing = dataclasses.replace(found, robot=dataclasses.replace(found.robot, passive=passive))
    assert columns.keys() - output.columns(rowing).keys() == {"LH.femur.command"}
    message = yaml.safe_load(output.trajectory(found))
    assert message["joint_names"][:4] == ["LF_coxa", "LF_femur", "LF_tibia", "LH_coxa"]
    assert len(message["points"]) == end
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    np.testing.assert_allclose(times, 3 + found.time[:end], atol=1e-9)
    positions = [point["positions"] for point in message["points"]]
    np.testing.assert_allclose(positions, motion.targets[:end].reshape(-1, 12), atol=1e-6)
    said = json.loads(json.dumps(output.summary(found)))
    delay = said["parameters"]["hardware.command_delay"]
    assert delay["value"] == DELAY and delay["seen"] and delay["deviation"] == pytest.approx(DELAY * delay["relative"])
    assert not said["parameters"]["hardware.servo.viscous_friction"]["seen"]
    assert [(p["from"], p["to"], p["kp"]) for p in said["limits"]][-2:] == [
        (pytest.approx(2.0), pytest.approx(3.5), 40.0), (pytest.approx(3.5), pytest.approx(length * PERIOD), None),
    ]  # fmt: skip
    scores = (found.best.information.score, found.plain.information.score)
    assert found.gain == pytest.approx(np.exp((scores[0] - scores[1]) / 4)) and scores[0] != scores[1]
    assert said["rate"] == 50.0 and said["times_better_than_plain_chirp"] == found.gain
    ((_, rows),) = output.limits(found).sections
    assert rows[-1][1:4] == ["3.50", f"{length * PERIOD:.2f}", "off"] and rows[-2][3] == "40"
    ((_, rows),) = output.table(found).sections
    assert rows[0][4].endswith("%") and rows[1][3:5] == ["-", "not seen"]


def test_the_picture_has_lanes_apart_and_the_largest_of_each_stretch(found):
    commanded, rates, torques = output.plot(found).axes
    lanes = [line.get_ydata() for line in commanded.lines[:12]]
    assert all(np.nanmin(above) > np.nanmax(below) for above, below in itertools.pairwise(lanes))
    for panel, values in ((rates, found.carried.rates), (torques, found.carried.torque)):
        for joint, line in enumerate(panel.lines[:3]):
            parts = np.array_split(np.abs(values[:, :, joint]).max(1), output.BINS)
            np.testing.assert_allclose(line.get_ydata(), [part.max() for part in parts])


@pytest.mark.parametrize(
    ("changes", "asked", "said"),
    [
        ({}, {}, []),
        ({"hardware.servo.no_load_speed": None}, {}, ["5 rad/s were taken"]),
        (dict.fromkeys(("hardware.servo.no_load_speed", "hardware.servo.torque_limit")), {},
         ["no torque limit", "5 rad/s were taken"]),
        ({"gravity": [0, 0, -1.62]}, {}, ["Gravity is the config's, 1.62 m/s^2"]),
        ({"gravity": [0, 0, -9.7]}, {}, []),
        ({}, {"mass": 0.25}, ["Hang 0.25 kg on each foot"]),
        ({}, {"kp": (50.0,)}, []),
        ({}, {"kp": (25.0, 50.0)}, ["The P gain changes"]),
        ({}, {"drop": True}, ["Switch the torque off"]),
    ],
)  # fmt: skip
def test_what_to_know_before_the_robot_is_on(found, changes, asked, said):
    scenario = found.scenario.with_overrides({"gravity": [0, 0, -9.81], **changes})
    own = dataclasses.replace(found, scenario=scenario, asked=Excitation(**asked))
    more = output.notes(own)[4:]
    assert len(more) == len(said) and all(text in each for text, each in zip(said, more, strict=True))


# ---------------------------------------------------------------------------------------------------- its information


def test_what_a_log_does_not_tell_apart_is_named_with_its_direction():
    root = np.array([[100.0, 100.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.9]])
    found = Information(("a", "b", "c"), root)
    assert found.silent == ["c"]
    ((deviation, parts),) = found.weak()
    values = np.linalg.svd(root[:, :2])[1]
    assert deviation == pytest.approx(1 / values[-1]) and parts["a"] == pytest.approx(-parts["b"], rel=0.01)
    assert found.unseen().startswith("Of this log: it will not tell apart a and b (a ")
    assert "b -100 %" in found.unseen() or "b +100 %" in found.unseen()
    assert found.unseen().endswith("at once look the same); it will say next to nothing of c.")
    told = Information(("a", "b"), np.diag([4.0, 2.1]))
    assert told.silent == [] and told.weak() == []
    assert (
        told.unseen() == "This log will tell all of them apart; it says least of b, to 48 % (one standard deviation)."
    )
    assert Information(("a",), np.array([[1.0]])).weak() == []


def test_a_small_part_of_a_direction_is_not_named():
    turned = np.linalg.qr(np.array([[1.0, -1.0, 0.1], [1.0, 1.0, 0.0], [0.0, 0.1, 1.0]]))[0]
    found = Information(("a", "b", "c"), np.diag([1.2, 50.0, 60.0]) @ turned.T)
    ((_, parts),) = found.weak()
    assert set(parts) == {"a", "b"} and max(parts.values(), key=abs) > 0


def test_the_amplitude_of_a_sine_is_that_of_the_limit_that_binds():
    axes = Axes(np.array([0.1, 1.0, 1.0]), np.array([9.0, 2.0, 9.0]), np.array([900.0, 900.0, 3.0]))
    turning = 2 * np.pi * 2.0
    np.testing.assert_allclose(axes.amplitude(np.full(3, 2.0)), [0.1, 2 / turning, 3 / turning**2])


@pytest.mark.parametrize(("last", "named"), [(0.17, "abc"), (0.1, "ab")])
def test_a_direction_names_what_has_a_third_of_its_largest_effect(last, named):
    vector = np.array([0.9, 0.0, last])
    vector[1] = np.sqrt(1 - vector @ vector)
    root = 10 * (np.eye(3) - np.outer(vector, vector)) + 0.1 * np.outer(vector, vector)
    ((sd, parts),) = Information(("a", "b", "c"), root).weak()
    assert sd == pytest.approx(10.0) and "".join(parts) == named
    assert parts["a"] == pytest.approx(0.9) and parts["b"] == pytest.approx(vector[1])


def test_the_motion_that_is_carried_out_is_the_one_that_is_chosen(rig, monkeypatch):
    told = [Information(rig.asked.fit[:1], size * np.eye(1)) for size in (1.0, 3.0, 2.0)]
    monkeypatch.setattr(excitation, "informations", lambda *_: told)
    found = excitation.chosen(rig)
    assert found.best is found.candidates[1] and found.best.information is told[1]
    missed = [np.abs(found.carried.angles - each.motion.targets).mean() for each in found.candidates]
    assert missed[1] < missed[0] / 3 and missed[1] < missed[2] / 3
    assert found.gain == pytest.approx(np.sqrt(3.0))
