"""Identify, base free: truths of sways by MuJoCo's C code inside the intervals, and logs that are no sways refused."""

import dataclasses
import functools
import json

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tests.tuning.identification.gripped_in_mujoco import NOISE, TRUTH, log_of
from tests.tuning.identification.stand_in_mujoco import columns_of
from tuning.identification.fit.problem import Problem
from tuning.identification.model.gripped import cut_gripped, gripped_model
from tuning.identification.model.variables import begin, variables
from tuning.identification.model.windows import KINDS
from tuning.identification.readers import write_csv
from tuning.identification.readers.log import Log, Signal

TRUE = dataclasses.replace(TRUTH, stiffness=1.3e4, damping=30.0, base_mass=0.55, gain=1.05, bias=0.2, delay=0.004)
SCENARIO = mc.load_scenario("case_1_1").with_overrides({"hardware.servo.armature": TRUE.armature})
ROBOT = load_robot("hubrobo_v3_2")
GAINS = [f"log.{limb}.force.gain" for limb in ROBOT.limbs]
VALUES = {
    "contact.stiffness": TRUE.stiffness, "contact.damping": TRUE.damping, "robot.base.mass": TRUE.base_mass,
    "hardware.force_sensor.bias": TRUE.bias / TRUE.gain,
    "hardware.command_delay": TRUE.delay - 5e-5,  # half a step of the log's
    "control.kp": TRUE.kp, "control.kd": TRUE.kd, "hardware.servo.armature": TRUE.armature,
    **dict.fromkeys(GAINS, TRUE.gain),
}  # fmt: skip


@functools.cache
def recorded(duration, kinds=("position", "velocity", "force")):
    return log_of(TRUE, duration, kinds=kinds)


@pytest.mark.nightly
def test_gradient_is_that_of_the_cost_by_finite_differences():
    """Through two windows and what is before them, with a filter, late forces and cross-talk."""
    scenario = SCENARIO.with_overrides({"hardware.force_sensor.filter": 20.0})
    keys = ("contact.*", "robot.base", "hardware.force_sensor.*", "hardware.command_delay", "log.LF.force.gain",
            "log.LF.force.zero.x", "log.RF.force.y_in_z", "robot.LF.tibia.mass")  # fmt: skip
    log = recorded(2.0, ("position", "velocity", "force", "base_position"))
    windows = cut_gripped(log, ROBOT, 0.001, 0.0)
    model = gripped_model(scenario, log, windows, variables(scenario, keys, held=False))
    noise = np.array([NOISE[KINDS[kind]] for kind in windows.kind])
    at = Problem(model, noise)
    chosen, rng = model.variables, np.random.default_rng(0)
    scale = np.array([v.sd for v in chosen])
    x = begin(chosen) + 0.1 * scale * rng.uniform(0.1, 0.5, len(chosen))
    along = rng.normal(0, 1, len(x)) * scale
    middle, *ends = (at.evaluate(x + side * 1e-5 * along) for side in (0, 1, -1))
    slope = (ends[1].scaled - ends[0].scaled)[at.fitted] / 2e-5
    weight = middle.scaled[at.fitted]
    assert weight @ slope == pytest.approx(weight @ (middle.along @ along)[at.fitted], rel=1e-4)


@pytest.mark.nightly
def test_truths_are_inside_their_intervals():
    found = tuning.identify(SCENARIO, recorded(4.0), tuple(VALUES), starts=1)
    for key, truth in VALUES.items():
        estimate = found.estimates[key]
        half = (estimate.high - estimate.low) / 2
        assert estimate.seen
        assert abs(estimate.value - truth) < 1.5 * half, (key, estimate)
        assert half < 0.1 * truth
    assert found.held_out["error_over_noise"] < 1.1
    assert not any("does not tell" in line or "the model is wrong" in line for line in found.warnings)
    assert any("base free" in line for line in found.warnings)
    for signal, noise in zip(found.model.windows.names, found.fitted.noise, strict=True):
        assert noise == pytest.approx(NOISE[signal.rpartition(".")[2] if "force" not in signal else "force"], rel=0.2)


@pytest.mark.nightly
def test_a_load_off_the_middle_of_the_base_is_found():
    """Where its centre of mass is, from 6 mm off, and its inertia, of 1.5 times as much; found again in the file."""
    center = (0.006, -0.004, 0.005)
    log = log_of(dataclasses.replace(TRUTH, delay=0.004, base_mass=0.55, base_center=center, base_spread=1.5), 4.0)
    fit = ["robot.base", "contact.stiffness", "contact.damping", "hardware.command_delay"]
    found = tuning.identify(SCENARIO, log, fit, starts=1)
    inertia = 1.5 * 0.55 / ROBOT.base_mass * ROBOT.base_inertia
    truths = {"mass": 0.55, **{f"center.{axis}": value for axis, value in zip("xyz", center, strict=True)}}
    truths |= {f"inertia.{axis * 2}": inertia[n, n] for n, axis in enumerate("xyz")}
    for name, truth in truths.items():
        estimate = found.estimates[f"robot.base.{name}"]
        half = (estimate.high - estimate.low) / 2
        assert abs(estimate.value - truth) < 1.5 * half < 0.5 * abs(truth), (name, estimate)


@pytest.mark.nightly
def test_what_stays_wrong_and_what_is_not_told_is_said():
    """Grips a third too soft, held there; without forces a sensor's gain is not told."""
    found = tuning.identify(SCENARIO, recorded(4.0), ["hardware.servo.armature"], base="free", starts=1)
    assert any("the model is wrong" in line for line in found.warnings)
    found = tuning.identify(
        SCENARIO, recorded(4.0, ("position", "velocity")), ["contact.stiffness", GAINS[0]], base="free", starts=1
    )
    assert not found.estimates[GAINS[0]].seen
    assert any(f"does not tell {GAINS[0]}" in line for line in found.warnings)
    assert not any("grip" in line for line in found.warnings)


@pytest.mark.nightly
def test_the_log_of_a_commanded_sway_by_the_command(tmp_path, call):
    """From excite to identified.yaml; MuJoCo carries out what was to be commanded."""
    code, _, errors = call("excite", "case_1_1", "--base", "free", "--duration", 4, "--candidates", 2,
                           "--high", 4, "--fit", "contact.stiffness", "--fit", "contact.damping",
                           "--out", tmp_path / "e")  # fmt: skip
    assert code == 0, errors
    sent = np.genfromtxt(tmp_path / "e" / "excitation.csv", delimiter=",", names=True)
    targets = np.stack([sent[name] for name in sent.dtype.names[1:13]], axis=1)
    write_csv(tmp_path / "log.csv", columns_of(log_of(dataclasses.replace(TRUE, armature=0.0), targets=targets)))
    fit = ("contact.stiffness", "contact.damping", "robot.base.mass", "hardware.command_delay")
    code, out, errors = call(
        "identify", "case_1_1", "--log", tmp_path / "log.csv", "--base", "free", "--starts", 1,
        *(word for key in (*fit, *GAINS, "hardware.force_sensor.bias") for word in ("--fit", key)),
        "--out", tmp_path / "out", "--json",
    )  # fmt: skip
    assert code == 0, errors
    made = json.loads(out)["parameters"]
    for key in fit:
        assert made[key]["value"] == pytest.approx(VALUES[key], rel=0.1), key
    read = mc.load_scenario(tmp_path / "out" / "identified.yaml")
    assert read.contact.stiffness == made["contact.stiffness"]["value"]
    assert float(load_robot(read.robot).base_mass) == pytest.approx(made["robot.base.mass"]["value"], rel=1e-5)


# ------------------------------------------------------------------------------------------------------- bad input


def log_with(**more):
    time = np.arange(300) / 100
    joints = [f"{limb}.{joint}" for limb in ROBOT.limbs for joint in ROBOT.joint_names]
    names = [f"{joint}.{kind}" for joint in joints for kind in ("command", "position")]
    signals = dict.fromkeys(names, Signal(time, 0.1 * np.sin(time)))
    return Log(signals | {name: Signal(time, value + 0 * time) for name, value in more.items()}, "log.csv")


@pytest.mark.parametrize(("more", "words"), [
    ({"LF.support": np.where(np.arange(300) < 100, 1.0, 0.0)},
     "expected all grippers shut (a sway), got LF.support 0 at 1 s"),
    ({"base.force.x": 1.0}, "expected no push on the base of a robot that is identified, got base.force.x"),
])  # fmt: skip
def test_a_log_that_is_no_sway_is_refused(more, words):
    with pytest.raises(ConfigError, match=r"^log.csv: ") as refused:
        tuning.identify(SCENARIO, log_with(**more), ["contact.stiffness"], base="free")
    assert words in str(refused.value)


def test_a_joint_without_commands_is_refused():
    log = log_with(**{"LF.force.z": 5.0})
    signals = {name: signal for name, signal in log.signals.items() if name != "RH.femur.command"}
    with pytest.raises(ConfigError, match=r"expected the commands of all joints of a gripped robot, got none of RH"):
        tuning.identify(SCENARIO, Log(signals, "log.csv"), ["contact.stiffness"])
