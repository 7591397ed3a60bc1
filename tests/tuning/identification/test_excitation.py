"""What to command: within limits and as informative as said, by MuJoCo's C code with the base welded."""

import dataclasses
import itertools
import json
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
import yaml

import mjx_climb as mc
import tuning
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.stand_in_mujoco import JOINTS, Truth, welded
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.schedule import schedule_of
from tuning.identification.model.variables import Variable
from tuning.identification.plan import excitation, motions
from tuning.identification.plan.information import information
from tuning.identification.plan.output import columns, plot, summary, table
from tuning.identification.plan.settings import ENCODER, Excitation
from tuning.identification.readers import read_log
from tuning.identification.readers.log import joints_of

ROBOT = load_robot("hubrobo_v3_2")
TRUTH = Truth(armature=0.012, friction=0.0, damping=0.05, kp=50.0, kd=0.2, delay=0.004)
TORQUE, SPEED = 4.1, 4.8
CONFIG = {
    "hardware": {"control_period": 0.01, "command_delay": TRUTH.delay, "servo": {
        "torque_limit": TORQUE, "no_load_speed": SPEED, "armature": TRUTH.armature, "viscous_friction": TRUTH.damping,
    }}
}  # fmt: skip
FIT = ("hardware.servo.armature", "hardware.servo.viscous_friction", "hardware.command_delay")


def scenario(**changes):
    return mc.load_scenario("configs/case_1_1.yaml", CONFIG).with_overrides(changes)


def replayed(truth, targets, period, off=(), lead=0.5, step=2.5e-4):
    """Return positions, rates and torques (T, 12) each step of the log by MuJoCo, and those of the commands' times.

    `off` says at each command whether the torque is off; before the log the first posture is held.
    """
    model, each = welded("hubrobo_v3_2", truth), round(period / step)
    model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, wait, late = mujoco.MjData(model), round(lead / step), truth.delay / step
    data.qpos[:] = targets[0]
    found = []
    for n in range(wait + len(targets) * each):
        # the command in the middle of the step, mixed where it changes within it
        at = (np.array([n, n + 1]) - wait - late) / each
        whole = np.clip(np.floor(at), 0, len(targets) - 1).astype(int)
        share = np.clip((at[1] - whole[1]) * each, 0, 1) if whole[0] != whole[1] else 1.0
        data.ctrl[:] = targets[whole[0]] + share * (targets[whole[1]] - targets[whole[0]])
        if len(off) and off[whole[0]] and n >= wait:
            model.actuator_gainprm[:], model.actuator_biasprm[:] = 0, 0
        mujoco.mj_forward(model, data)
        found.append((data.qpos.copy(), data.qvel.copy(), data.actuator_force.copy()))
        mujoco.mj_step(model, data)
    position, rate, torque = (np.array(value)[wait:] for value in zip(*found, strict=True))
    return position, rate, torque, position[::each]


def by_differences(targets, period, noise):
    """Return the information about FIT by central differences of MuJoCo's positions, in units of the values."""
    columns = []
    for name in ("armature", "damping", "delay"):
        value = getattr(TRUTH, name)
        change = {"delay": 1e-3}.get(name, 0.01 * value)
        ends = [replayed(dataclasses.replace(TRUTH, **{name: value + s * change}), targets, period)[3] for s in (1, -1)]
        columns.append(value * (ends[0] - ends[1]).ravel() / (2 * change) / noise)
    return np.stack(columns) @ np.stack(columns).T


@pytest.fixture(scope="module")
def found():
    return tuning.excite(scenario(), FIT, duration=3, candidates=2, drop=True)


@pytest.mark.nightly
def test_limits_hold_in_mujoco_and_are_used(found):
    values = columns(found)
    off = values["torque_off"] == 1
    targets = found.best.motion.targets.reshape(-1, 12)
    position, rate, torque, _ = replayed(TRUTH, targets, found.period, off)
    line = np.clip(1 - np.sign(torque) * rate / SPEED, 0.02, 1)
    middle = ROBOT.stance_joints.ravel()
    way = np.where(position > middle, ROBOT.joint_upper.ravel() - middle, middle - ROBOT.joint_lower.ravel())
    used = [np.abs(torque) / (TORQUE * line), np.abs(rate) / SPEED, np.abs(position - middle) / way]
    assert off.any() and not off[:300].any() and np.isnan(values["LF.femur.command"][off]).all()
    assert max(share.max() for share in used) < 0.7 * 1.03
    moved = [share[: 300 * 40].max() for share in used]
    assert max(moved) > 0.55, moved


@pytest.mark.nightly
def test_torque_goes_off_as_late_as_commands_come(found):
    off = columns(found)["torque_off"] == 1
    targets = found.best.motion.targets.reshape(-1, 12)
    theirs = replayed(TRUTH, targets, found.period, off)[3]
    np.testing.assert_allclose(np.reshape(found.carried.angles, theirs.shape), theirs, atol=5e-4)  # at once: 0.011


@pytest.mark.slow
def test_a_command_that_changes_as_the_torque_goes_off_gives_no_kick():
    """With target and gain each a mean of its own over the step the joints were 8 mrad off."""
    moved = np.repeat([[0.0], [0.2]], [20, 8], axis=0) * np.ones(12)
    segments = [
        excitation.Segment("own", 0, 20, TRUTH.kp, moved[:20]),
        excitation.Segment("off", 20, 28, 0.0, moved[20:]),
    ]
    with jax.enable_x64(True):
        rig = excitation.set_up(scenario(), Excitation(fit=FIT))
        targets = rig.targets(moved)
        carried = rig.run()(rig.robot, rig.parameters, rig.commands(targets, segments))
    angles = np.asarray(carried.angles)[rig.lead * rig.hold :: rig.hold].reshape(-1, 12)
    theirs = replayed(TRUTH, targets.reshape(-1, 12), rig.period, np.arange(28) >= 20)[3]
    assert np.ptp(theirs, axis=0).min() > 0
    np.testing.assert_allclose(angles, theirs, atol=5e-4)


@pytest.mark.nightly
def test_information_is_that_of_central_differences_in_mujoco():
    found = tuning.excite(scenario(), FIT, duration=2, candidates=1, family=["multisine"])
    theirs = {}
    for candidate in (found.best, found.plain):
        motion = candidate.motion
        theirs[motion.name] = by_differences(motion.targets.reshape(-1, 12), found.period, found.asked.noise)
        ours = np.asarray(candidate.information.matrix)
        scale = np.sqrt(np.outer(np.diagonal(ours), np.diagonal(ours)))
        np.testing.assert_allclose(ours / scale, theirs[motion.name] / scale, atol=0.02)
    best, plain = (np.linalg.slogdet(np.eye(3) + theirs[c.motion.name])[1] for c in (found.best, found.plain))
    assert found.gain == pytest.approx(np.exp((best - plain) / 6), rel=0.02) and found.gain > 1.1
    expected = np.sqrt(np.diagonal(np.linalg.inv(theirs[found.best.motion.name])))
    np.testing.assert_allclose(found.best.information.deviations, expected, rtol=0.03)


@pytest.mark.nightly
def test_what_is_written_is_read_back(found, tmp_path):
    names = tuning.write(found, tmp_path / "a").files.split(", ")
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == sorted([*names, "settings.json"])
    log = read_log(tmp_path / "a" / "excitation.csv", ROBOT)
    assert set(log.signals) == {*(f"{joint}.command" for joint in JOINTS), "control.kp", "torque_off"}
    signal, off = log.signals["RH.tibia.command"], columns(found)["torque_off"] == 1
    np.testing.assert_allclose(signal.value, found.best.motion.targets[~off, 2, 2], atol=1e-6)
    np.testing.assert_allclose(signal.time, found.time[~off], atol=1e-9)
    schedule = schedule_of(log.signals, 2 * TRUTH.kp)
    np.testing.assert_array_equal(schedule.on, ~off)
    np.testing.assert_array_equal(schedule.share, 0.5 * ~off)
    message = yaml.safe_load((tmp_path / "a" / "excitation_trajectory.yaml").read_text())
    assert message["joint_names"][:4] == ["LF_coxa", "LF_femur", "LF_tibia", "LH_coxa"]
    assert set(message) == {"header", "joint_names", "points"} and len(message["points"]) == (~off).sum()
    time = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    np.testing.assert_allclose(time, 3 + found.time[~off], atol=1e-9)
    positions = [point["positions"] for point in message["points"]]
    np.testing.assert_allclose(positions, found.best.motion.targets[~off].reshape(-1, 12), atol=1e-6)
    assert json.loads((tmp_path / "a" / "excitation.json").read_text()) == json.loads(json.dumps(summary(found)))


@pytest.mark.nightly
def test_the_picture_has_a_lane_for_each_joint_and_the_largest_rate_and_torque_of_each_kind(found):
    commanded, rates, torques = plot(found).axes
    lanes = [line.get_ydata() for line in commanded.lines[:12]]
    for above, below in itertools.pairwise(lanes):
        assert np.nanmin(above) > np.nanmax(below)
    assert [tick.get_text() for tick in commanded.get_yticklabels()] == list(joints_of(ROBOT))
    for panel, values in ((rates, found.carried.rates), (torques, found.carried.torque)):
        largest = [line.get_ydata().max() for line in panel.lines[:3]]
        np.testing.assert_allclose(largest, np.abs(values).max((0, 1)))


def told(fit, noise, moved, **changes):
    """Return the information about parameters in the log of a motion (time, 12) from the stance."""
    with jax.enable_x64(True):
        rig = excitation.set_up(scenario(**changes), Excitation(fit=fit, noise=noise))
    segment = excitation.Segment("own", 0, len(moved), TRUTH.kp, moved)
    with jax.enable_x64(True):
        one = excitation.Motion("own", (segment,), (), rig.targets(moved))
        return excitation.informations(rig, [one])[0]


@pytest.mark.nightly
def test_a_log_without_motion_tells_no_inertia_and_no_masses_apart():
    """Two joints of a limb sag: two numbers, for three unknowns of its links."""
    still = ("hardware.servo.armature", "hardware.command_delay")
    hanging = ("robot.LF.femur.mass", "robot.LF.tibia.mass", "robot.LF.tibia.center.x")
    found = told(still + hanging, ENCODER, np.zeros((200, 12)))
    assert found.silent == list(still)
    ((_, parts),) = found.weak()
    assert set(parts) <= set(hanging) and len(parts) > 1
    assert (found.deviations[:3] > 0.9).all()
    said = found.unseen()
    assert f"not tell apart {hanging[0]} and {hanging[1]}" in said and "at once look the same" in said
    assert "next to nothing of hardware.servo.armature and hardware.command_delay" in said


@pytest.mark.nightly
def test_armature_and_inertia_about_the_axis_of_a_joint_without_gravity_look_the_same():
    fit = ("robot.LF.coxa.armature", "robot.LF.coxa.inertia.yy", "robot.LF.coxa.damping")
    time, moved = np.arange(200) * 0.01, np.zeros((200, 12))
    moved[:, 0] = 0.3 * np.sin(2 * np.pi * 2 * time)
    found = told(fit, 1e-9, moved)
    ((_, parts),) = found.weak()
    assert found.silent == [] and set(parts) == set(fit[:2])
    assert f"not tell apart {fit[0]} and {fit[1]}" in found.unseen()
    assert found.deviations[2] < 1e-3


def test_information_of_a_line_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    sensitivity, noise = rng.normal(size=(50, 2)), rng.uniform(0.5, 2, 50)
    found = information(("a", "b"), sensitivity, noise)
    covariance = np.linalg.inv(sensitivity.T @ np.diag(noise**-2) @ sensitivity + np.eye(2))
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diagonal(covariance)))
    assert found.score == pytest.approx(-np.log(np.linalg.det(covariance)))


@pytest.mark.parametrize("family", [*motions.FAMILIES, "plain_chirp"])
def test_motions_stay_in_their_room_and_band(family):
    axes = motions.Axes(np.array([0.5, 0.2, 0.3]), np.array([2.0, 3.0, 1.0]), np.array([np.inf, 40.0, 60.0]))
    time, draw = np.arange(2000) * 0.01, np.random.default_rng(0)
    moved = motions.tapered(getattr(motions, family)(axes, time, motions.Band(0.1, 5.0), draw), time)
    assert (np.abs(moved) <= axes.room * (1 + 1e-9)).all() and (moved[[0, -1]] == 0).all()
    assert (np.abs(np.diff(moved[:2], axis=0)) < 1e-4).all()  # from rest
    power = np.abs(np.fft.rfft(moved, axis=0)) ** 2
    below = np.fft.rfftfreq(len(time), 0.01) <= 6.0
    assert (power[below].sum(0) > 0.999 * power.sum(0)).all()
    if family != "plain_chirp":  # no two axes move alike
        assert np.abs(np.corrcoef(moved.T) - np.eye(3)).max() < 0.6


def test_a_mass_on_the_feet_is_that_of_mujoco():
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body><inertial mass="0.1" pos="0.01 0.02 0.03" fullinertia="3e-4 4e-4 5e-4 1e-5 2e-5 3e-5"'
        '/><freejoint/><body pos="0.05 -0.02 0.1"><inertial mass="0.3" pos="0 0 0" diaginertia="1e-12 1e-12 1e-12"/>'
        "</body></body></worldbody></mujoco>"
    )
    spec.option.gravity = 0, 0, 0
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole = np.zeros((6, 6))
    mujoco.mj_fullM(model, data, whole)
    own = np.array([[3e-4, 1e-5, 2e-5], [1e-5, 4e-4, 3e-5], [2e-5, 3e-5, 5e-4]])
    robot = dataclasses.replace(
        ROBOT, link_mass=np.full((4, 3), 0.1), link_center=np.tile([0.01, 0.02, 0.03], (4, 3, 1)),
        link_inertia=np.tile(own, (4, 3, 1, 1)), foot_center=np.tile([0.05, -0.02, 0.1], (4, 1)),
    )  # fmt: skip
    with jax.enable_x64(True):
        loaded = with_foot_mass(robot, 0.3)
    mass, center = loaded.link_mass[1, -1], np.asarray(loaded.link_center[1, -1])
    about = np.asarray(loaded.link_inertia[1, -1]) + mass * (center @ center * np.eye(3) - np.outer(center, center))
    np.testing.assert_allclose(mass, whole[0, 0])
    np.testing.assert_allclose(about, whole[3:, 3:], atol=1e-9)
    np.testing.assert_allclose(loaded.link_mass[:, :-1], 0.1)


def test_a_deviation_is_relative_to_the_value_or_to_the_prior_of_one_that_is_zero():
    delay = Variable("hardware.command_delay", "s", 0.0, mean=0.0, sd=0.02, lower=0.0, upper=0.1)
    friction = Variable("hardware.servo.viscous_friction", "N m s/rad", 0.5, mean=0.5, sd=2.0, lower=0.0, upper=9.0)
    told = information((delay.key, friction.key), np.eye(2), np.array([1 / 7, 1 / 3]))
    of = SimpleNamespace(information=told, motion=SimpleNamespace(name="own", segments=(), bound=()))
    none = SimpleNamespace(information=information((delay.key, friction.key), 1e-6 * np.eye(2), np.ones(2)))
    found = SimpleNamespace(
        chosen=[delay, friction], best=of, plain=none, gain=1.0, period=0.01, asked=Excitation(), scenario=scenario(),
        robot=ROBOT,
    )  # fmt: skip
    relative = np.array([50, 10]) ** -0.5
    each = [summary(found)["parameters"][variable.key] for variable in found.chosen]
    np.testing.assert_allclose([one["relative"] for one in each], relative)
    np.testing.assert_allclose([one["deviation"] for one in each], relative * [0.02, 0.5])
    assert all(one["seen"] and one["plain_chirp"] == pytest.approx(1.0) for one in each)
    ((_, rows),) = table(found).sections
    assert all(row[5].startswith("not seen") for row in rows)
    assert [row[3] for row in rows] == [f"{value:.2g}" for value in relative * [0.02, 0.5]]
    assert [" of 0.02" in row[4] for row in rows] == [True, False]


@pytest.mark.nightly
def test_a_sway_keeps_all_feet_where_they_grip_and_pulls_less_than_they_hold():
    fit = ("contact.stiffness", "log.LF.force.gain", "log.LF.force.zero.z", "hardware.force_sensor.bias")
    found = tuning.excite(scenario(**{"contact.holding_limit": 8.0}), fit, base="free", duration=2, candidates=1)
    targets, model = found.best.motion.targets, ROBOT.model
    data, sites = mujoco.MjData(model), []
    for angles in [ROBOT.stance_joints, *targets[::10]]:
        data.qpos[:7], data.qpos[7:] = [0, 0, 0, 1, 0, 0, 0], np.ravel(angles)
        mujoco.mj_kinematics(model, data)
        sites.append(data.site_xpos.copy())
    feet = np.array(sites)
    apart = np.linalg.norm(feet[:, :, None] - feet[:, None], axis=-1)
    np.testing.assert_allclose(apart[1:], np.broadcast_to(apart[0], apart[1:].shape), atol=1e-6)
    assert np.abs(feet - feet[0]).max() > 2e-3
    force = np.asarray(found.carried.force)
    pulled = np.where(force[..., 2] < 0, np.linalg.norm(force, axis=-1), 0.0)
    assert pulled.max() < 0.7 * 8.0
    assert found.gain > 1 and found.best.information.deviations[0] < 0.1
    of_sensors = np.zeros((3, *force.shape))  # what a sensor's own numbers move in the log, by their scales
    of_sensors[0, :, 0], of_sensors[1, :, 0, 2], of_sensors[2] = force[:, 0], 2.0, 1.0
    flat = of_sensors.reshape(3, -1) / excitation.FORCE_NOISE
    alone, told = flat @ flat.T, found.best.information.matrix[1:, 1:]
    # what else `identify` fits takes a little of it, in no direction the other way
    taken = np.linalg.eigvalsh(alone - told)
    assert taken.min() > -1e-9 * taken.max() and taken.max() > 0
    np.testing.assert_allclose(told, alone, rtol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--fit", "hardware.servo.armatur"], "--fit hardware.servo.armatur: expected a key that can be fitted"),
        (["--fit", "contact.stiffness"], "a robot on a stand"),
        (["--high", "0.05"], "--high: expected a frequency above low = 0.1 Hz, got 0.05"),
        (["--family", "waltz"], "--family: expected 'chirp', 'multisine', 'steps' or 'reversals'"),
        (["--base", "free", "--drop"], "--drop: expected none with base free"),
        (
            ["--base", "free", "--fit", "robot.LF.tibia.mass"],
            "--fit robot.LF.tibia.mass: expected a key of the scenario or of the log",
        ),
    ],
)
def test_bad_input_is_one_line(call, arguments, said):
    code, out, errors = call("excite", "case_1_1", *arguments)
    assert code == 2 and out == "" and said in errors.strip().splitlines()[-1] and "Traceback" not in errors


@pytest.mark.slow
def test_the_command_says_what_binds_and_what_to_expect(call, tmp_path):
    config = tmp_path / "own.yaml"
    config.write_text(scenario().to_yaml())
    short = ["--duration", "2", "--candidates", "1", "--fit", FIT[0], "--rate", "10"]
    code, out, errors = call("excite", config, *short, "--json", "--out", tmp_path / "out")
    found = json.loads(out)
    assert code == 0 and found == json.loads((tmp_path / "out" / "excitation.json").read_text())
    assert found["parameters"][FIT[0]]["seen"] and 0 < found["parameters"][FIT[0]]["relative"] < 0.1
    assert all(" of it" in stretch["binds"] for stretch in found["limits"]) and found["rate"] == 10
    assert found["unseen"] in errors
    code, out, errors = call("excite", config, *short, "--set", "hardware.servo.torque_limit=0.05")
    assert code == 2 and "torque of LF.femur: expected a rest stance that takes less than a share of 0.7" in errors


def test_nuisances_are_eliminated_from_what_a_log_will_tell():
    """The same as the inverse of the information about all of them, less the nuisances' rows."""
    rng = np.random.default_rng(1)
    own, beside, deviation = rng.normal(size=(50, 2)), rng.normal(size=(50, 3)), rng.uniform(0.5, 2, 50)
    found = information(("a", "b"), own, deviation, beside)
    every = np.hstack([own, beside]) / deviation[:, None]
    expected = np.linalg.inv(every.T @ every + np.eye(5))[:2, :2]
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diagonal(expected)))
    assert (found.deviations > information(("a", "b"), own, deviation).deviations).all()


@pytest.mark.parametrize(("friction", "fit", "beside"), [
    (0.05, ("hardware.servo.armature",), {"log.command.delay", "log.friction.lead", "hardware.servo.presliding"}),
    (0.0, ("hardware.servo.armature", "hardware.command_delay"), set()),
])  # fmt: skip
def test_what_identify_fits_beside_is_planned_for(friction, fit, beside):
    rig = excitation.set_up(scenario(**{"hardware.servo.coulomb_friction": friction}), Excitation(fit=fit))
    assert {v.key for v in rig.beside} == beside
    assert [place.key for place in rig.places] == [*fit, *(v.key for v in rig.beside)]
