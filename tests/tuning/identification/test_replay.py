"""Replay: a walk's own log gives the walk again, and a stand is MuJoCo's with the base welded."""

import dataclasses
import json
import types

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.load import load_model
from mjx_climb.viz.plots import styling
from mjx_climb.viz.recording import save_mcap
from tests.tuning.identification.recorded import JOINTS, ROBOT, recorded
from tests.tuning.identification.stand_in_mujoco import TRUTH, sines
from tests.tuning.identification.stand_in_mujoco import recorded as on_a_stand
from tuning.identification.model.replay import Error, prepare, replay
from tuning.identification.model.replay_picture import plot_replay
from tuning.identification.readers import read_log, write_csv
from tuning.identification.readers.log import Log, Signal

SCENARIO = mc.Scenario().with_overrides({
    "duration": 0.4, "gait.cycle": 0.4, "gait.stride": 0.005, "gait.step_height": 0.005,
    "hardware.control_period": 0.004, "hardware.servo.coulomb_friction": 0.02,
    "disturbance.pushes": [
        {"force": [-5.0, 0.0, 0.0], "moment": [0.0, 0.0, 1.0], "start": 0.05, "stop": 0.08},
        {"force": [0.0, 3.0, 0.0], "start": 0.07, "stop": 0.2},
    ],
})  # fmt: skip


@pytest.fixture(scope="module")
def walk():
    return mc.rollout(SCENARIO)


@pytest.fixture(scope="module")
def log(walk, tmp_path_factory):
    return read_log(save_mcap(walk, tmp_path_factory.mktemp("log") / "walk.mcap"), ROBOT)


@pytest.mark.nightly
def test_the_log_of_a_walk_gives_the_walk_again_with_its_pushes(walk, log):
    quiet = SCENARIO.with_overrides({"disturbance.pushes": [], "control.stiffness": 1.0})
    found = replay(log, quiet)
    assert (found.base, len(found.scenario.disturbance.pushes)) == ("free", 3)  # of two that overlap
    np.testing.assert_array_equal(found.walk.push, walk.push)
    np.testing.assert_allclose(found.walk.joint_angles, walk.joint_angles, atol=1e-12)
    np.testing.assert_allclose(found.walk.foot_force, walk.foot_force, atol=1e-8)
    without = (".command", ".support", "base.force", "base.moment")  # what is sent, or acts
    assert set(found.errors) == {name for name in log.signals if not any(part in name for part in without)}
    assert found.warnings == ("pushes of the log: 3",)
    np.testing.assert_allclose(found.logged().foot_position, walk.foot_position, atol=1e-12)


@pytest.mark.slow
def test_errors_are_those_of_each_signal(walk, log):
    late = {name: Signal(s.time, s.value + 0.01 * s.time if name == "RH.femur.position" else s.value)
            for name, s in log.signals.items()}  # fmt: skip
    found = replay(dataclasses.replace(log, signals=late), SCENARIO)
    error, time = found.errors["RH.femur.position"], walk.time
    assert error.rms == pytest.approx(np.sqrt(np.mean((0.01 * time) ** 2)), rel=1e-9)
    assert (error.largest, error.at, error.samples) == (pytest.approx(0.01 * time[-1]), time[-1], len(time))
    assert max(e.largest for n, e in found.errors.items() if n != "RH.femur.position" and ".position" in n) < 1e-12


@pytest.mark.slow
def test_a_log_of_another_start_and_gait_says_so(log):
    signals = {name: Signal(s.time, s.value + 0.2 if name == "LF.tibia.position" else 1.0 - s.value
                            if name == "RF.support" else s.value) for name, s in log.signals.items()}  # fmt: skip
    start, _, gait = sorted(replay(dataclasses.replace(log, signals=signals), SCENARIO).warnings, reverse=True)
    assert start.startswith("the walk begins in its rest stance, 0.2 rad from where LF.tibia")
    assert gait.startswith("grippers shut and open as the config's gait has it, other than in the log for 100 %")


@pytest.mark.slow
@pytest.mark.parametrize("mass", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_without_base_and_forces_the_robot_is_on_a_stand_as_in_mujoco(tmp_path, mass):
    """Of a mass on the feet too, which no config says."""
    time, targets = sines(1.0, 0.001)
    truth = dataclasses.replace(TRUTH, friction=0.0, mass=mass)
    of_mujoco = on_a_stand(truth, time, targets, step=5e-5)
    columns = {"time": time} | {f"{joint}.command": targets[:, n] for n, joint in enumerate(JOINTS)}
    for what in ("position", "velocity", "effort"):
        columns |= {f"{joint}.{what}": of_mujoco[what][:, n] for n, joint in enumerate(JOINTS)}
    write_csv(tmp_path / "log.csv", columns)
    servo = {"armature": truth.armature, "viscous_friction": truth.damping}
    scenario = mc.load_scenario("configs/case_1_1.yaml", {
        "control.kp": truth.kp, "control.kd": truth.kd, **{f"hardware.servo.{k}": v for k, v in servo.items()}
    })  # fmt: skip
    log = read_log(tmp_path / "log.csv", ROBOT)
    found = replay(log, scenario, mass=mass)
    assert found.base == "held" and len(found.warnings) == (mass > 0) == any("0.1 kg" in w for w in found.warnings)
    bounds = {"position": 4e-4, "velocity": 1e-2, "effort": 0.15}
    for name, error in found.errors.items():
        assert error.largest < bounds[name.rpartition(".")[2]], (name, error)
    wrong = replay(log, scenario.with_overrides({} if mass else {"hardware.servo.armature": 0.0}))
    assert max(error.largest for error in wrong.errors.values()) > 0.15
    model = load_model(scenario.robot)  # feet by MuJoCo's kinematics
    data, row = mujoco.MjData(model), 700
    data.qpos[:] = np.concatenate(
        [ROBOT.stance_position, ROBOT.stance_orientation, found.walk.joint_angles[row].ravel()]
    )
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(found.walk.foot_position[row], data.site_xpos[:4], atol=1e-12)


@pytest.mark.slow
def test_p_gains_and_torque_off_of_the_log_are_those_of_mujoco():
    time, targets = sines(1.0, 0.001)
    truth = dataclasses.replace(TRUTH, friction=0.0)
    share = np.select([time < 0.4 - 1e-9, time < 0.6 - 1e-9, time < 0.75 - 1e-9], [1.0, 0.5, 0.0], 1.0)
    of_mujoco, on = on_a_stand(truth, time, targets, step=5e-5, share=share), share > 0
    signals = {f"{joint}.command": Signal(time[on], targets[on, n]) for n, joint in enumerate(JOINTS)}
    for what in ("position", "velocity"):
        signals |= {f"{joint}.{what}": Signal(time, of_mujoco[what][:, n]) for n, joint in enumerate(JOINTS)}
    signals |= {"control.kp": Signal(time[on], 40.0 * share[on]), "torque_off": Signal(time, 1.0 - on)}
    servo = {"hardware.servo.armature": truth.armature, "hardware.servo.viscous_friction": truth.damping}
    overrides = {"control.kp": 40.0, "control.kd": truth.kd, "hardware.servo.torque_limit": 1e3, **servo}
    found = replay(Log(signals, "log.csv"), mc.load_scenario("configs/case_1_1.yaml", overrides))
    for name, error in found.errors.items():  # rates have a kink where the gain changes
        assert error.largest < 1e-3 if name.endswith("position") else error.rms < 0.02, (name, error)
    assert (found.walk.joint_torque[610:740] == 0).all()


def test_commands_go_to_the_servos_as_logged_whatever_the_period_of_the_law(tmp_path):
    write_csv(tmp_path / "log.csv", recorded())
    scenario = SCENARIO.with_overrides({"hardware.interpolation": "linear", "hardware.command_delay": 0.003})
    own = prepare(read_log(tmp_path / "log.csv", ROBOT), scenario, "held").scenario.hardware
    assert (own.control_period, own.interpolation, own.command_delay) == (0.0, "hold", 0.003)


def test_what_cannot_be_replayed_is_said_in_one_line(tmp_path):
    columns = recorded()
    write_csv(tmp_path / "log.csv", {name: values for name, values in columns.items() if not name.endswith("command")})
    with pytest.raises(
        mc.ConfigError, match=r"log.csv: expected commands of joints, such as LF.coxa.command, got none"
    ):
        replay(read_log(tmp_path / "log.csv", ROBOT), SCENARIO)
    noise = np.random.default_rng(0).standard_normal(1000)
    write_csv(tmp_path / "log.csv", columns | {"base.force.x": noise})
    with pytest.raises(
        mc.ConfigError, match=r"log.csv: base.force, .*: expected .* in 500 constant pieces .*, got 1000"
    ):
        replay(read_log(tmp_path / "log.csv", ROBOT), SCENARIO)


@pytest.mark.slow
def test_the_picture_shows_what_was_commanded_logged_and_simulated(log):
    found = replay(log, SCENARIO)
    figure = plot_replay(found)
    assert len(figure.axes) == 4 * (2 * 3 + 1)
    lines = [line.get_ydata() for line in figure.axes[0].lines]
    np.testing.assert_array_equal(lines[0], log.signals["LF.coxa.command"].value)
    np.testing.assert_array_equal(lines[1], log.signals["LF.coxa.position"].value)
    assert not any(panel.texts for panel in figure.axes)  # nothing is written over the curves
    error = found.errors["LF.coxa.position"]
    missed = figure.axes[4].lines[0].get_ydata()
    logged = log.signals["LF.coxa.position"]
    simulated = np.interp(logged.time, found.walk.time, found.walk.joint_angles[:, 0, 0])
    np.testing.assert_allclose(missed, 1e3 * (logged.value - simulated))
    assert 1e-3 * np.sqrt(np.mean(missed**2)) == pytest.approx(error.rms, abs=1e-12)
    assert figure.axes[4].get_title(loc="right") == f"{1e3 * error.rms:.3g} mrad"
    assert len(figure.axes[24].lines) == 6


@pytest.mark.nightly
@pytest.mark.slow
def test_at_the_shell(walk, tmp_path, capsys):
    from tuning.command_line import program

    config, out = tmp_path / "walk.yaml", tmp_path / "out"
    config.write_text(SCENARIO.to_yaml())
    save_mcap(walk, tmp_path / "walk.mcap")
    typed = ["replay", str(config), "--log", str(tmp_path / "walk.mcap"), "--out", str(out)]
    assert program.run([*typed, "--with-law", "--json"]) == 0
    printed = capsys.readouterr()
    written = json.loads((out / "replay.json").read_text())
    assert json.loads(printed.out) == written
    assert written["base"] == "free" and written["signals"]["LF.coxa.position"]["largest"] < 1e-12
    assert written["judged"]["law"]["peak_foot_force"] == pytest.approx(mc.metrics(walk)["peak_foot_force"], rel=1e-6)
    assert "LF.coxa.position: {topic: /joint_states, field: position.LF_coxa}" in printed.err
    files = {"replay.json", "replay.png", "simulation.nc", "signals.yaml", "config.yaml", "settings.json"}
    assert {path.name for path in out.iterdir()} == files
    again = dataset.load_trajectory(out / "simulation.nc")
    np.testing.assert_allclose(again.joint_angles, walk.joint_angles, atol=1e-12)
    assert program.run([*typed, "--with-law", "--signals", str(out / "signals.yaml")]) == 0  # into the same folder
    assert "guessed" not in capsys.readouterr().err
    write_csv(tmp_path / "log.csv", recorded())
    assert program.run([*typed[:2], "--log", str(tmp_path / "log.csv"), "--with-law"]) == 2
    assert "--with-law: expected pushes in" in capsys.readouterr().err


@pytest.mark.parametrize("forces", [False, True])
def test_the_picture_has_a_panel_for_each_joint_and_its_error_and_one_for_the_forces(forces):
    """Every line by colour and numbers; of a long log each second sample is drawn."""
    rng, time, logged_at = np.random.default_rng(0), np.arange(50) / 50, np.arange(8001) / 8001
    robot = types.SimpleNamespace(limbs=("LF", "RH"), joint_names=("coxa", "tibia"), joints=2)
    angles, force = rng.normal(size=(50, 2, 2)), rng.normal(size=(50, 2, 3))
    walk = types.SimpleNamespace(robot=robot, time=time, joint_angles=angles, foot_force=force)
    names = {"RH.tibia.command", "RH.tibia.position", *(["RH.force.y"] if forces else [])}
    signals = {name: Signal(logged_at, rng.normal(size=8001)) for name in names}
    error = Error(0.01234, 0.2, 0.5, 1.0, 8001)
    log = types.SimpleNamespace(signals=signals)
    figure = plot_replay(types.SimpleNamespace(walk=walk, log=log, errors={"RH.tibia.position": error}))
    panels = np.reshape(figure.axes, (5 if forces else 4, 2))
    heights = panels[0, 0].get_gridspec().get_height_ratios()
    assert [*heights] == [2.0, 1.0, 2.0, 1.0, *([2.0] if forces else [])]
    assert figure.get_size_inches() == pytest.approx([2 * styling.COLUMN, 0.6 + 0.62 * sum(heights)])

    def lines(panel):
        return [(line.get_color(), line.get_linewidth(), *line.get_data()) for line in panel.lines]

    every, thin, wide = slice(None, None, 2), 0.7, 1.8
    for column, limb in enumerate(robot.limbs):
        assert panels[0, column].get_title(loc="left") == limb and panels[-1, column].get_xlabel() == "time [s]"
        for row, joint in enumerate(robot.joint_names):
            panel, missed = panels[2 * row, column], panels[2 * row + 1, column]
            simulated = (styling.BLUE, thin, time, angles[:, column, row])
            expected, off = [simulated], []
            if (limb, joint) == ("RH", "tibia"):
                command, position = (signals[f"RH.tibia.{what}"].value for what in ("command", "position"))
                expected = [
                    (styling.GREY, wide, logged_at[every], command[every]),
                    (styling.BLACK, thin, logged_at[every], position[every]), simulated,
                ]  # fmt: skip
                missing = 1e3 * (position - np.interp(logged_at, time, angles[:, 1, 1]))
                off = [(styling.VERMILLION, thin, logged_at[every], missing[every])]
            np.testing.assert_equal(lines(panel), expected)
            np.testing.assert_equal(lines(missed)[:-1], off)
            assert missed.lines[-1].get_ydata() == [0, 0]
            assert missed.get_title(loc="right") == ("12.3 mrad" if off else "not logged")
        if forces:
            expected = [(color, thin, time, force[:, column, n]) for n, color in enumerate(styling.AXIS_COLORS)]
            if limb == "RH":
                expected.insert(1, (styling.AXIS_COLORS[1], wide, logged_at[every], signals["RH.force.y"].value[every]))
            np.testing.assert_equal(lines(panels[4, column]), expected)
    labels = ["coxa [rad]", "[mrad]", "tibia [rad]", "[mrad]", "foot force [N]"][: len(panels)]
    assert [panel.get_ylabel() for panel in panels[:, 0]] == labels
    (legend,) = figure.legends
    words = ["commanded", "logged", "simulated", "logged - simulated, and its rms"]
    words += ["force x", "force y", "force z", "logged forces: broad"] * forces
    assert [text.get_text() for text in legend.get_texts()] == words
