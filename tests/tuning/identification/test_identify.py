"""Identify: truths of logs by MuJoCo's C code inside the intervals, and what a log does not tell is said."""

import dataclasses
import functools
import html
import json
import re
import shlex
from types import SimpleNamespace
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.physics.limb_engine import build
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile, validated
from tests.tuning.identification.coverage import counted, width_of
from tests.tuning.identification.recorded import recorded
from tests.tuning.identification.stand_in_mujoco import NOISE, TRUTH, columns_of, log_of
from tuning.identification.fit import identify as fits
from tuning.identification.fit import robot_files
from tuning.identification.fit.problem import Problem
from tuning.identification.fit.report import SHOWN, plot_prediction
from tuning.identification.model.predicted import model_of, with_nuisances
from tuning.identification.model.variables import Place, applied, begin, variables
from tuning.identification.model.windows import KINDS, cut
from tuning.identification.readers import write_csv
from tuning.identification.readers.log import Log, Signal
from tuning.problem import ensemble as ensembles

pytestmark = pytest.mark.usefixtures("optimised")

TRUE = dataclasses.replace(TRUTH, delay=0.004, damping=0.0)
VALUES = {
    "hardware.servo.armature": TRUE.armature, "hardware.servo.coulomb_friction": TRUE.friction, "control.kp": TRUE.kp,
    "control.kd": TRUE.kd, "hardware.command_delay": TRUE.delay,
}  # fmt: skip
SCENARIO = mc.Scenario().with_overrides({"control.kp": 50.0, "control.kd": 0.2})
ROBOT = load_robot("hubrobo_v3_2")


def check_told(found):
    """Each interval is narrow, and holds the truth but for the luck of one draw: see the nightly coverage."""
    for key, truth in VALUES.items():
        estimate = found.estimates[key]
        half = (estimate.high - estimate.low) / 2
        assert abs(estimate.value - truth) < 1.5 * half and half < 0.1 * truth, (key, estimate)


@functools.cache
def identified(truth=TRUE, duration=4.0, fit=tuple(VALUES), starts=1, **how):
    return tuning.identify(SCENARIO, log_of(truth, duration, **how), fit, starts=starts)


@pytest.mark.parametrize(("fit", "late"), [("control.kp", 0.014), ("hardware.command_delay", None)])
def test_windows_begin_once_commands_have_passed_both_delays(fit, late, monkeypatch):
    """The delays in a row; of one that is fitted, its upper bound."""
    own = SCENARIO.with_overrides({"hardware.command_delay": 0.004, "hardware.servo.delay": 0.01})
    columns = recorded(duration=1.0)
    time = columns.pop("time")
    log = Log({name: Signal(time, value) for name, value in columns.items()}, "log.csv")
    cut_at = Mock(side_effect=InterruptedError)
    monkeypatch.setattr(fits, "cut", cut_at)
    with pytest.raises(InterruptedError):
        tuning.identify(own, log, [fit])
    (variable,) = variables(own, [fit], held=True)
    assert cut_at.call_args.kwargs["late"] == pytest.approx(late or variable.upper + 0.01)


@pytest.mark.parametrize(
    ("more", "base", "way"),
    [("LF.coxa.velocity", None, "cut"), ("LF.force.x", None, "cut_gripped"), ("base.position.x", None, "cut_gripped"),
     ("base.position.x", "held", "cut"), ("LF.coxa.velocity", "free", "cut_gripped")],
)  # fmt: skip
def test_a_log_with_forces_or_the_base_is_of_a_gripped_robot_unless_it_is_said(more, base, way, monkeypatch):
    columns = recorded(duration=1.0)
    time = columns.pop("time")
    signals = {name: Signal(time, value) for name, value in columns.items()}
    log = Log(signals | {more: Signal(time, np.sin(time))}, "log.csv")
    ways = {name: Mock(side_effect=InterruptedError) for name in ("cut", "cut_gripped")}
    for name, mock in ways.items():
        monkeypatch.setattr(fits, name, mock)
    with pytest.raises(InterruptedError):
        tuning.identify(SCENARIO, log, ["control.kp"], base=base, held_out=0.3)
    assert [name for name, mock in ways.items() if mock.called] == [way]
    assert ways[way].call_args.args == (log, load_robot(SCENARIO.robot), SCENARIO.time_step, 0.3)


def test_a_mass_on_the_feet_is_one_of_the_model(monkeypatch):
    columns = recorded(duration=3.0)
    time = columns.pop("time")
    log = Log({name: Signal(time, value) for name, value in columns.items()}, "log.csv")
    monkeypatch.setattr(fits, "model_of", model := Mock(side_effect=InterruptedError))
    with pytest.raises(InterruptedError):
        tuning.identify(SCENARIO, log, ["control.kp"], mass=0.1)
    assert model.call_args.args[0] is SCENARIO and model.call_args.args[3] == 0.1


@pytest.mark.parametrize(
    ("base", "more", "share", "hint"),
    [(None, "LF.coxa.velocity", 0.11, "try this"), (None, "LF.coxa.velocity", 0.1, ""),
     (None, "LF.force.x", 0.11, ""), ("free", "LF.force.x", 0.11, "")],
)  # fmt: skip
def test_doubts_of_the_log_a_guessed_base_and_the_hint_reach_the_findings(base, more, share, hint, monkeypatch):
    """Other profiles are tried where a tenth of a signal's residuals is the model's, and the base was held."""
    columns = recorded(duration=3.0)
    time = columns.pop("time")
    signals = {name: Signal(time, value) for name, value in columns.items()}
    log = Log(signals | {more: Signal(time, np.sin(time))}, "log.csv", ("a doubt",))
    windows, chosen = cut(log, ROBOT, SCENARIO.time_step, 0.3), variables(SCENARIO, ["control.kp"], held=True)
    model, tests = model_of(SCENARIO, windows, chosen), [SimpleNamespace(share=0.0), SimpleNamespace(share=share)]
    monkeypatch.setattr(fits, "cut_gripped", lambda *_: windows)
    monkeypatch.setattr(fits, "gripped_model", lambda *_: model)
    monkeypatch.setattr(fits, "searched", searched := Mock(side_effect=lambda problem, *_: ("found", problem)))
    monkeypatch.setattr(fits.inference, "whiteness", lambda *_: tests)
    monkeypatch.setattr(fits, "tried", tried := Mock())
    monkeypatch.setattr(fits, "in_words", lambda some: "try this" if some is tried.return_value else "")
    monkeypatch.setattr(fits, "identified", identified := Mock())
    assert tuning.identify(SCENARIO, log, ["control.kp"], base=base, starts=3) is identified.return_value
    scenario, of_log, keys, (found, made, own), warnings, told = identified.call_args.args
    assert (scenario, of_log, [v.key for v in keys], found, own) == (SCENARIO, log, ["control.kp"], "found", tests)
    assert made is searched.call_args.args[0] and searched.call_args.args[1] == 3
    guessed = more == "LF.force.x" and base is None
    assert warnings[0] == "a doubt" and len(warnings) == 1 + guessed
    assert not guessed or warnings[1].startswith("the log has base or foot forces: base free, all grippers shut")
    assert told == hint and tried.called is bool(hint)


def problem(fit, duration=2.0, kinds=("position", "velocity", "effort")):
    log = log_of(TRUE, duration, kinds=kinds)
    windows = cut(log, ROBOT, SCENARIO.time_step, 0.0)
    model = model_of(SCENARIO, windows, with_nuisances(SCENARIO, variables(SCENARIO, fit, held=True), windows.kinds))
    noise = np.array([NOISE[KINDS[kind]] for kind in windows.kind])
    return Problem(model, noise)


@pytest.mark.nightly
def test_gradient_is_that_of_the_cost_by_finite_differences():
    keys = ("hardware.servo.armature", "hardware.servo.delay", "hardware.servo.backlash", "control.kp", "gravity",
            "hardware.command_delay", "robot.LF.femur", "robot.*.tibia.friction")  # fmt: skip
    at = problem(keys)
    chosen = at.model.variables
    x = begin(chosen) + 0.3 * np.array([v.sd for v in chosen]) * np.random.default_rng(0).uniform(0.1, 0.5, len(chosen))
    point, scale = np.r_[x, at.model.guess.ravel()], at.whole_prior.sd
    middle = at.evaluate(point)
    weight = middle.scaled * at.fitted
    for along in np.random.default_rng(1).normal(0, 1, (3, len(point))) * scale:
        ends = [at.evaluate(point + side * 1e-6 * along) for side in (1, -1)]
        slope = weight @ (ends[1].scaled - ends[0].scaled) / 2e-6
        assert slope == pytest.approx(weight @ middle.along @ along, rel=1e-4)


@pytest.mark.nightly
def test_truths_are_inside_their_intervals_with_noise_delay_and_jitter():
    found = identified(jitter=0.0005)
    check_told(found)
    assert all(found.estimates[key].seen for key in VALUES)
    # MuJoCo's friction gives less than the nominal 5e-4; the log does not tell how much less, and the prior stays
    presliding = found.beside["hardware.servo.presliding"]
    assert presliding.value < 3e-4 and not presliding.seen
    assert found.held_out["error_over_noise"] < 1.2
    for signal, noise in zip(found.model.windows.names, found.fitted.noise, strict=True):
        assert noise == pytest.approx(NOISE[signal.rpartition(".")[2]], rel=0.2)


@pytest.mark.nightly
def test_the_picture_of_the_worst_signal_shows_the_model_before_and_after_and_what_each_misses():
    found = identified(jitter=0.0005)
    above, below = plot_prediction(found).axes
    before, after, log = above.lines
    assert [line.get_label() for line in above.lines] == ["model, before", "model, after", "log"]
    assert before.get_linewidth() > 2 * after.get_linewidth()  # nor does the one hide the other
    name, units = above.get_ylabel().partition(" [")[0], {"position": "rad", "velocity": "rad/s", "effort": "N m"}
    assert above.get_ylabel() == f"{name} [{units[name.rpartition('.')[2]]}]"
    noise = found.fitted.noise[found.model.windows.names.index(name)]
    missed = [line.get_ydata() * noise for line in below.lines[:2]]
    for model, own in zip((before, after), missed, strict=True):
        np.testing.assert_allclose(model.get_ydata() + own, log.get_ydata(), atol=1e-12)
    assert np.std(missed[0]) > 3 * np.std(missed[1])
    assert np.ptp(log.get_xdata()) == pytest.approx(SHOWN, abs=0.03)


@pytest.mark.nightly
def test_errors_of_time_stamps_are_told_from_noise():
    """Half a millisecond moves a joint by three times the noise of its position."""
    found = identified(misread=0.0005)
    check_told(found)
    assert found.fitted.clock == pytest.approx(0.0005, rel=0.15)
    for signal, noise in zip(found.model.windows.names, found.fitted.noise, strict=True):
        assert noise == pytest.approx(NOISE[signal.rpartition(".")[2]], rel=0.2)
    assert found.held_out["error_over_noise"] < 1.2
    assert any("time stamps err by 0.000" in line for line in found.warnings)
    assert not any("time stamps" in line for line in identified(jitter=0.0005).warnings)


@pytest.mark.nightly
def test_a_gap_is_cut_out_and_costs_only_what_it_holds():
    whole, gap = identified(jitter=0.0005), identified(jitter=0.0005, drop=((1.3, 2.4),))
    assert not gap.model.windows.abuts.all()
    assert gap.estimates["control.kp"].value == pytest.approx(whole.estimates["control.kp"].value, rel=0.02)


@pytest.mark.nightly
def test_the_command_prints_json_alone_and_writes_what_other_commands_read(tmp_path, call):
    write_csv(tmp_path / "log.csv", columns_of(log_of(TRUE, 4.0)))
    fit = [word for key in VALUES for word in ("--fit", key)]
    code, out, _ = call(
        "identify", "case_1_2", "--log", tmp_path / "log.csv", *fit, "--fit", "robot.LF.tibia.mass", "--starts", 1,
        "--set", "gravity=[0, 0, -9.81]", "--set", "control.kp=45", "--out", tmp_path / "out", "--json",
    )  # fmt: skip
    made = json.loads(out)
    assert code == 0
    assert set(made) == {"parameters", "held_out", "search", "warnings"}
    assert list(made["parameters"]) == [*VALUES, "robot.LF.tibia.mass"]
    for key, truth in VALUES.items():
        assert set(made["parameters"][key]) == {"value", "low", "high", "seen"}
        assert made["parameters"][key]["value"] == pytest.approx(truth, rel=0.1)
    assert made["held_out"]["error_over_noise"] < 1.2
    read = mc.load_scenario(tmp_path / "out" / "identified.yaml")
    assert read.control.kp == made["parameters"]["control.kp"]["value"]
    assert float(load_robot(read.robot).link_mass[0, 2]) == pytest.approx(
        made["parameters"]["robot.LF.tibia.mass"]["value"],
        rel=1e-5,  # MuJoCo writes six digits
    )
    page, hardware = (tmp_path / "out" / "report.html").read_text(), tmp_path / "out" / "hardware.yaml"
    code, out, _ = call("run", "case_1_2", "--hardware", hardware, "--set", "duration=0.1", "--set", "gait.cycle=0.1",
                        "--set", "gait.stride=0", "--json", "--out", tmp_path / "run")  # fmt: skip
    assert json.loads(out)["diverged"] is False
    again = shlex.split(html.unescape(re.search(r"To repeat it.*?<pre>(.*?)</pre>", page, re.DOTALL)[1]))
    assert (tmp_path / "out" / again[again.index("--log") + 1]).samefile(tmp_path / "log.csv")
    ensemble = ensembles.Ensemble.load(tmp_path / "out" / "posterior.yaml", members=400)
    drawn = ensembles.draw(read, ensemble)
    kp = made["parameters"]["control.kp"]
    assert drawn.joint_loop.kp.shape == (400, 1)
    assert np.mean((drawn.joint_loop.kp > kp["low"]) & (drawn.joint_loop.kp < kp["high"])) == pytest.approx(
        0.95, abs=0.03
    )
    assert ensemble.posterior.held == ("robot.LF.tibia.mass",)


# ------------------------------------------------------------------------------- what the log has beside commands

SCHEDULE = ((0.0, 50.0), (1.5, 25.0), (3.0, 50.0), (3.6, 0.0), (3.8, 50.0))  # s, N m/rad; 0: torque off


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("schedule", "duration"),
    [(SCHEDULE[:3], 4.0), pytest.param(SCHEDULE, 6.0, marks=pytest.mark.nightly)],
    ids=["gains", "gains and a drop"],
)
def test_p_gains_and_a_drop_are_read_and_without_them_the_answer_is_another(schedule, duration):
    log = log_of(TRUE, duration, gains=schedule)
    found = tuning.identify(SCENARIO, log, tuple(VALUES), starts=1)
    blind = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if k.count(".") == 2})
    without = tuning.identify(SCENARIO, blind, tuple(VALUES), starts=1)
    check_told(found)
    assert found.held_out["error_over_noise"] < 1.2
    assert not any("wrong" in line for line in found.warnings), found.warnings
    assert max(abs(without.estimates[key].value / truth - 1) for key, truth in VALUES.items()) > 0.1
    assert any("the model is wrong" in line for line in without.warnings)


@pytest.mark.nightly
def test_velocities_sampled_as_the_command_jumps_are_predicted():
    """By the mean over the step about the jump the armature of the coxa was 0.7 % too small."""
    log = log_of(dataclasses.replace(TRUE, delay=0.0), 3.0, noise={"position": 1e-4, "velocity": 3e-3})
    log = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if k.startswith("LF")})
    fit = ("robot.LF.*.armature", "hardware.servo.coulomb_friction")
    known = {key: VALUES[key] for key in ("control.kp", "control.kd")}
    found = tuning.identify(SCENARIO.with_overrides(known), log, fit, starts=1)
    for joint in ("coxa", "femur", "tibia"):
        assert found.estimates[f"robot.LF.{joint}.armature"].value == pytest.approx(TRUE.armature, rel=0.005)


@pytest.mark.nightly
def test_a_bound_that_binds_beside_what_is_asked_for_is_named():
    """Commands come 1 ms late, which the config does not say: their clock may take a quarter of a time step."""
    log = log_of(dataclasses.replace(TRUE, delay=0.001), 2.0)
    log = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if k.startswith("LF")})
    known = {key: VALUES[key] for key in ("control.kp", "control.kd")}
    fit = ("hardware.servo.armature", "hardware.servo.coulomb_friction")
    found = tuning.identify(SCENARIO.with_overrides(known), log, fit, starts=1, held_out=0.0)
    assert "log.command.delay: on its upper bound, 0.00025 s" in found.warnings


@pytest.mark.nightly
@pytest.mark.slow
def test_a_known_mass_on_the_feet_tells_torques_from_masses_where_no_effort_is_recorded():
    """Without it masses, gains, armature and friction, all smaller by a sixth, make the same motion: the start."""
    log = log_of(dataclasses.replace(TRUE, heavier=1.2, mass=0.1), 3.0)
    log = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if k.startswith("LF")})
    fit = ("control.kp", "control.kd", "hardware.servo.armature", "hardware.servo.coulomb_friction", "robot.LF.*.mass")
    changes = {key: VALUES[key] / 1.2 for key in fit[:4]} | {"hardware.command_delay": TRUE.delay}
    found = tuning.identify(SCENARIO.with_overrides(changes), log, fit, mass=0.1, starts=1)
    kp = found.estimates["control.kp"]
    assert kp.before < kp.low < TRUE.kp < kp.high < 1.15 * TRUE.kp, kp
    assert float(found.robot().link_mass[0, 2]) == pytest.approx(1.2 * float(ROBOT.link_mass[0, 2]), rel=0.1)


# ---------------------------------------------------------------------------------------------- what is not told


@pytest.mark.nightly
@pytest.mark.parametrize(("fit", "unseen", "words"), [
    # without torques recorded, what brakes a joint is one number: where the search ends decides which stays nominal
    (("control.kd", "hardware.servo.viscous_friction"), {"control.kd", "hardware.servo.viscous_friction"},
     "does not tell control.kd from hardware.servo.viscous_friction"),
    # the coxa turns about the vertical: how high its link's mass lies moves nothing
    pytest.param(("control.kp", "robot.LF.coxa.center.z"), {"robot.LF.coxa.center.z"},
                 "does not tell robot.LF.coxa.center.z", marks=pytest.mark.nightly),
    # no joint comes near a torque of 50 N m
    pytest.param(("control.kp", "hardware.servo.torque_limit"), {"hardware.servo.torque_limit"},
                 "does not tell hardware.servo.torque_limit", marks=pytest.mark.nightly),
])  # fmt: skip
def test_what_the_log_cannot_see_is_said(fit, unseen, words):
    scenario = SCENARIO.with_overrides({
        "control.kp": 40.0, "hardware.servo.armature": 0.012, "hardware.servo.coulomb_friction": 0.05,
        "hardware.command_delay": 0.004, "hardware.servo.torque_limit": 50.0,
        **({} if "control.kd" in fit else {"control.kd": 0.3}),
    })  # fmt: skip
    found = tuning.identify(scenario, log_of(TRUE, 3.0), fit, starts=1)
    untold = {key for key, estimate in found.estimates.items() if not estimate.seen}
    assert len(untold) == 1 and untold <= unseen
    assert any(words in line for line in found.warnings), found.warnings
    if "control.kd" in fit:
        assert any("control.kd" in line and "viscous" in line for line in found.combined)
        assert sum(estimate.value for estimate in found.estimates.values()) == pytest.approx(TRUE.kd, rel=0.02)


@pytest.mark.nightly
@pytest.mark.parametrize("change", [{"stribeck": 0.15}, pytest.param({"flexible": 4.0}, marks=pytest.mark.nightly)])
def test_a_truth_that_the_model_does_not_have_is_never_a_narrow_wrong_answer(change):
    found = identified(dataclasses.replace(TRUE, **change))
    told = [line for line in found.warnings if "the model is wrong" in line]
    assert bool(told) == ("; the residuals refute the model in " in found.sentence)
    given = {key: each for key, each in found.estimates.items() if each.low is not None}
    wrong = [key for key, each in given.items() if not each.low < VALUES[key] < each.high]
    widened = dict(zip(VALUES, width_of(found.fitted, found.problem, found.posterior), strict=False))
    assert not wrong or (told and min(widened[key] for key in wrong) > 3)


@pytest.mark.nightly
def test_dry_friction_as_mujoco_has_it_by_default_is_in_the_model():
    found = identified(dataclasses.replace(TRUE, soft=True))
    for key, truth in VALUES.items():
        estimate = found.estimates[key]
        assert abs(estimate.value - truth) < 0.75 * (estimate.high - estimate.low), (key, estimate)  # of one draw
    assert found.estimates["hardware.servo.coulomb_friction"].high < 1.1 * TRUE.friction
    lead = found.beside["log.friction.lead"]
    assert lead.value == pytest.approx(0.02 * 0.95 / 2, abs=1e-3)  # timeconst dmax / 2


def of_one_limb(log):
    kept = {k: v for k, v in log.signals.items() if k.startswith("LF") or k.count(".") < 2}
    return dataclasses.replace(log, signals=kept)


def without_rows(log, holes):
    signals = {}
    for name, signal in log.signals.items():
        there = np.all([(signal.time <= start) | (signal.time >= end) for start, end in holes], axis=0)
        signals[name] = Signal(signal.time[there], signal.value[there])
    return dataclasses.replace(log, signals=signals)


@pytest.mark.nightly
def test_rows_that_were_lost_with_their_commands_cost_only_what_they_hold():
    """Eighteen holes of 60 ms: friction was 0.271 (0.271 to 0.271) for 0.05."""
    starts = np.sort(np.random.default_rng(5).uniform(0.2, 5.8, 18))
    log = without_rows(of_one_limb(log_of(TRUE, 6.0)), [(start, start + 0.06) for start in starts])
    found = tuning.identify(SCENARIO, log, tuple(VALUES), starts=1)
    check_told(found)
    assert found.held_out["error_over_noise"] < 1.2
    assert any(line.startswith("commands are missing in 12 holes") for line in found.warnings)
    assert any(line.startswith("pauses: 2, 0.24 s in all") for line in found.warnings)  # where holes overlap


@pytest.mark.nightly
def test_what_a_log_with_the_torque_off_or_a_p_gain_of_nothing_cannot_tell_keeps_its_prior(tmp_path):
    log = of_one_limb(log_of(TRUE, 3.0))
    time = log.signals["LF.coxa.command"].time
    log = dataclasses.replace(log, signals={**log.signals, "control.kp": Signal(time, 0 * time)})
    found = tuning.identify(SCENARIO, log, tuple(VALUES), starts=1)
    kp = found.estimates["control.kp"]
    assert not kp.seen and kp.value == pytest.approx(50.0)
    np.testing.assert_allclose((kp.low, kp.high), 50.0 * np.exp([-1.96, 1.96]), rtol=1e-3)
    assert not {"control.kp", "hardware.command_delay"} & found.known.keys()
    assert any("control.kp is 0 all the while" in line for line in found.warnings)
    tuning.write(found, tmp_path / "out")
    written = mc.load_scenario(tmp_path / "out" / "identified.yaml")
    assert written.control.kp == SCENARIO.control.kp


@pytest.mark.nightly
@pytest.mark.slow
def test_limits_that_the_robot_does_not_have_widen_intervals_and_are_said(tmp_path):
    scenario = SCENARIO.with_overrides({"hardware.servo.torque_limit": 0.3})
    found = tuning.identify(scenario, of_one_limb(log_of(TRUE, 3.0)), tuple(VALUES), starts=1)
    assert width_of(found.fitted, found.problem, found.posterior).max() > 5
    assert any("the model is wrong" in line for line in found.warnings), found.warnings
    tuning.write(found, tmp_path / "out")
    written = mc.load_scenario(tmp_path / "out" / "identified.yaml")
    drawn = ensembles.Ensemble.load(tmp_path / "out" / "posterior.yaml").posterior
    for key, estimate in found.estimates.items():
        value = float(np.asarray(mc.parameters(written).at(key)))
        assert value == pytest.approx(estimate.value) and estimate.low <= value <= estimate.high
        assert estimate.seen or value == pytest.approx(estimate.before)
        mean = drawn.mean[drawn.keys.index(key)]
        assert (np.exp(mean) if drawn.log[drawn.keys.index(key)] else mean) == pytest.approx(value)


@pytest.mark.nightly
def test_the_step_of_a_simulator_that_made_the_log_is_a_doubt():
    """Armature is 0.0117 for 0.012, the delay 2.1 ms for 4; a search that ended where damping let it gain little was
    59 in the cost above the minimum."""
    truth = dataclasses.replace(TRUE, integrator="EULER")
    log = of_one_limb(log_of(truth, 4.0, rate=125.0, step=0.004))
    found = tuning.identify(SCENARIO, log, tuple(VALUES), starts=1)
    assert found.sentence.startswith("log.csv tells 5 of 5 parameters") and found.fitted.ended == "converged"
    (line,) = [line for line in found.warnings if "if one made this log, its step is a doubt" in line]
    steps = float(re.search(r"steps of ([\d.]+) ms", line)[1])
    assert steps == pytest.approx(4.0, rel=0.1)
    doubt = float(re.search(r"hardware.servo.armature by ([\d.e-]+) kg", line)[1])
    armature = found.estimates["hardware.servo.armature"]
    assert armature.low - doubt < TRUE.armature < armature.high + doubt


# ------------------------------------------------------------------------------------- starts, bounds, bad input


@pytest.mark.nightly
def test_a_start_on_a_bound_and_a_link_without_weight_are_no_obstacle():
    scenario = SCENARIO.with_overrides({"hardware.servo.armature": 0.0, "hardware.servo.coulomb_friction": 0.0})
    key, truth = "robot.LF.tibia.mass", float(ROBOT.link_mass[0, 2])
    light = {key: {"nominal": 1e-6, "mean": float(np.log(1e-3)), "sd": 3.0, "lower": 1e-9}}
    found = tuning.identify(scenario, log_of(TRUE, 4.0), (*VALUES, key), changes=light, starts=2)
    assert found.estimates["hardware.servo.armature"].value == pytest.approx(TRUE.armature, rel=0.05)
    assert found.estimates[key].value == pytest.approx(truth, rel=0.1)


@pytest.mark.parametrize(("fit", "drop", "words"), [
    ("hardware.servo.armatur", "", "did you mean hardware.servo.armature"),
    ("contact.stiffness", "", "a key that a robot on a stand can tell"),
    ("hardware.servo.rate", "", "a key with a derivative, got one that works by steps .on a log it acts as a delay"),
    ("hardware.servo.torque_limit", "", "expected a value in the config to begin at, got null"),
    ("control.kp", "command", "expected the commands of all joints of a limb, as LF.coxa.command"),
    ("control.kp", "position", "expected positions, velocities or efforts, as LF.coxa.position"),
])  # fmt: skip
def test_a_key_or_a_log_that_cannot_be_used_is_told_in_one_line(fit, drop, words):
    log = log_of(TRUE, 2.0, kinds=("position",))
    log = dataclasses.replace(log, signals={k: v for k, v in log.signals.items() if not drop or not k.endswith(drop)})
    with pytest.raises(mc.ConfigError, match=words) as refused:
        tuning.identify(SCENARIO, log, [fit])
    assert "\n" not in str(refused.value)


def test_a_pattern_is_of_keys_with_a_derivative_and_a_value():
    scenario = SCENARIO.with_overrides({"hardware.servo.rate": 500.0})
    found = {v.key for v in variables(scenario, ["hardware.*"], held=True)}
    assert {"hardware.command_delay", "hardware.servo.armature", "hardware.servo.backlash"} < found
    without = {"hardware.servo.rate", "hardware.control_period", "hardware.servo.profile_velocity"}
    assert not found & (without | {"hardware.force_sensor.delay"})


# --------------------------------------------------------------------------------------------------- what is written


@pytest.mark.nightly
def test_a_fit_that_is_interrupted_goes_on_where_it_stopped_and_ends_alike(tmp_path):
    scenario = SCENARIO.with_overrides({"hardware.servo.armature": 0.01, "hardware.command_delay": 0.004})
    log, fit, calls, heard = log_of(TRUE, 2.0, kinds=("position",)), ("control.kp", "control.kd"), [], []

    def stop(done, most, text):
        if text.startswith("pass 1"):
            raise KeyboardInterrupt

    whole = tuning.identify(
        scenario, log, fit, starts=2, progress=lambda done, most, text: heard.append(text.partition(":")[0])
    )
    searches = list(dict.fromkeys(heard))
    before = searches[: next(n for n, name in enumerate(searches) if name.startswith("pass 1"))]
    with pytest.raises(KeyboardInterrupt):
        tuning.identify(scenario, log, fit, starts=2, out=tmp_path, progress=stop)
    kept = len(list((tmp_path / "parts").glob("part-*.npz")))
    found = tuning.identify(
        scenario, log, fit, starts=2, out=tmp_path, progress=lambda done, most, text: calls.append(text)
    )
    assert kept == len(before) >= 2 and not {text.partition(":")[0] for text in calls} & {*before}
    np.testing.assert_array_equal(found.fitted.x, whole.fitted.x)
    np.testing.assert_array_equal(found.posterior.covariance, whole.posterior.covariance)
    with pytest.raises(mc.files.dataset.OutputError, match="another that differs in starts"):
        tuning.identify(scenario, log, fit, starts=3, out=tmp_path)
    tuning.write(found, tmp_path)
    made = json.loads((tmp_path / "result.json").read_text())
    assert made["log_sha256"] == log.digest and made["provenance"]["jax_version"]
    assert "tuning.identify" in made["command"]
    assert not (tmp_path / "parts").exists()


@pytest.mark.nightly
def test_any_point_is_a_body_that_can_exist_and_its_mjcf_moves_alike(tmp_path):
    chosen = variables(SCENARIO, ["robot.LF.femur", "robot.RH.tibia", "robot.*.armature", "robot.base"], held=False)
    rng = np.random.default_rng(3)
    x = begin(chosen) + np.array([v.sd for v in chosen]) * rng.normal(0, 1.0, len(chosen))
    x = np.clip(x, *np.reshape([v.bounds for v in chosen], (-1, 2)).T)
    places = [Place(v.key, v.log) for v in chosen]
    _, robot = applied(places, jnp.asarray(x), mc.parameters(SCENARIO), ROBOT)
    for inertia in [*np.asarray(robot.link_inertia).reshape(-1, 3, 3), np.asarray(robot.base_inertia)]:
        a, b, c = np.linalg.eigvalsh(inertia)
        assert a > 0 and a + b >= c * (1 - 1e-9)
    section = robot_files.write("hubrobo_v3_2", robot, tmp_path / "robot.xml")
    read = load_robot(validated(RobotFile, section, "robot"))
    assert read.limbs == robot.limbs
    center = ROBOT.frame_position[0, 0] - np.asarray(robot.frame_position)[0, 0]
    np.testing.assert_allclose(read.stance_position, ROBOT.stance_position + center, atol=1e-6)
    # feet of the limbs whose zeros are as before stand where they stood
    np.testing.assert_allclose(read.stance_joints[1::2], ROBOT.stance_joints[1::2], atol=1e-5)
    still, gravity = jnp.zeros(3), jnp.array([0.5, -1.0, -9.0])
    angles, rates, torque, force = (jnp.asarray(rng.normal(0, s, (4, 3))) for s in (0.3, 2.0, 1.0, 5.0))
    state = State(still, jnp.array([0.8, 0, 0.6, 0]), still, jnp.array([0.5, 1.0, -2.0]), angles, rates)
    moved = [build(each)(state, torque, force, jnp.zeros(6), jnp.zeros(()), gravity) for each in (read, robot)]
    jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4), *moved)


def test_a_posterior_is_drawn_with_its_covariance_and_leaves_other_draws_alone():
    covariance = np.array([[1e-6, 5e-5, 0], [5e-5, 0.01, 0], [0, 0, 1e-4]])
    posterior = ensembles.Posterior(
        keys=("hardware.servo.armature", "control.kp", "gravity.tilt_x"), log=(False, True, False),
        mean=(0.012, float(np.log(40.0)), 0.1), covariance=tuple(map(tuple, covariance.tolist())),
        lower=(0.0, 0.0, -1.0), upper=(np.inf, np.inf, 1.0),
    )  # fmt: skip
    alone, with_it = ensembles.Ensemble(members=4000), ensembles.Ensemble(members=4000, posterior=posterior)
    assert ensembles.Ensemble.parse(with_it.to_yaml()) == with_it
    drawn, before = ensembles.draw(SCENARIO, with_it), ensembles.draw(SCENARIO, alone)
    for path in ("disturbance.pushes.0.force", "disturbance.pushes.1.force"):
        np.testing.assert_array_equal(drawn.at(path), before.at(path))
    points = np.stack([drawn.drive.armature[:, 0], np.log(drawn.joint_loop.kp[:, 0])])
    np.testing.assert_allclose(np.cov(points), covariance[:2, :2], rtol=0.1)
    down = ensembles.draw(SCENARIO, with_it.model_copy(update={"gravity": None})).gravity[:, 0]
    np.testing.assert_allclose(np.linalg.norm(down, axis=1), 9.81)
    assert np.arctan2(down[:, 1], -down[:, 2]).mean() == pytest.approx(0.1, abs=0.001)


# --------------------------------------------------------------------------------------- how often, and beside others


@pytest.mark.nightly
@pytest.mark.parametrize("misread", [0.0, 5e-4])  # s, of time stamps
def test_intervals_hold_as_often_as_they_say_and_are_no_wider_than_they_need_be(misread):
    found = counted(20, 5.0, misread)
    assert found.inside.mean() > 0.85  # of a hundred that hold in 95 %, three standard deviations below
    assert 0.75 < np.nanstd(found.error) < 1.3  # three standard deviations, some parameters go together; see the docs
    assert found.width.mean() < 1.5
    assert found.ahead.max() < 1.2
    told = [line for line in found.warned if "time stamps err" in line]
    assert len(told) == (20 if misread else 0)


@pytest.mark.nightly
@pytest.mark.parametrize("delay", [0.004, 0.0])  # s; without one commands jump as samples are taken
def test_a_chain_in_the_air_comes_out_near_the_truth_and_its_friction_nearer_than_by_mujoco_sysid(delay):
    """Both at steps of 1 ms, at which MuJoCo's own friction is softer; armature is nearer by `mujoco.sysid`."""
    pytest.importorskip("tabulate", reason="mujoco[sysid] is not installed")
    from tests.tuning.identification import beside_sysid

    truth = beside_sysid.truth_of(0, delay)
    log = log_of(truth, 6.0)
    fits = (beside_sysid.by_identify, beside_sysid.by_sysid)
    ours, theirs = (beside_sysid.errors_of(truth, fit(truth, log)) for fit in fits)
    assert ours[0] < 0.005 and ours[1] < min(0.02, 0.1 * theirs[1])
