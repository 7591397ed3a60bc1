"""The findings, tables and pictures of synthetic fits: each number and line by hand, and no line without a cause."""

import dataclasses
import json
import math

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.fit import inference, report
from tuning.identification.fit.conclusions import identified
from tuning.identification.fit.output import _result, contents, ensemble_of
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.model.schedule import Schedule
from tuning.identification.model.variables import Place, Variable
from tuning.identification.model.windows import KINDS, Rows, Windows
from tuning.identification.readers.log import Log, Signal

SCENARIO, Z = mc.Scenario(), 1.959964
OWN = own_parameters(SCENARIO)
NAMES = ("LF.coxa.position", "LF.coxa.velocity", "RH.femur.effort", "RH.force.z", "base.position.x")
KIND, JOINT, LIMB = np.array([0, 1, 2, 3, 4]), np.array([0, 0, 1, 2, 0]), np.array([0, 0, 2, 2, 0])
WINDOWS, STEPS, STEP, EACH = 12, 100, 0.01, 25  # samples of a signal in a window


@dataclasses.dataclass(frozen=True)
class Structure:
    robot: object
    mass: float
    places: tuple


@dataclasses.dataclass(frozen=True)
class Model:
    variables: tuple
    windows: Windows
    structure: Structure
    parameters: object
    schedule: object = None


class Given(Problem):
    def __init__(self, model, held=None, clock=0.0):
        ahead = model.windows.held_out[model.windows.rows.window]
        vars(self).update(
            model=model, noise=np.ones(len(NAMES)), clock=clock, rate=None, held=held, fitted=~ahead, predicted=ahead
        )

    def evaluate(self, point):
        rows = self.rows
        zero = np.zeros(len(rows.value))
        return None if self.diverges else Evaluated(0.25 + zero, zero, np.zeros((len(zero), 0)), zero)

    diverges = False


class Evaluated:
    def __init__(self, residuals, scaled, along, rate):
        self.residuals, self.scaled, self.along, self.rate = residuals, scaled, along, rate


def variable(key, unit, nominal, sd, *, log=False, lower=-math.inf, upper=math.inf, beside=False):
    mean = math.log(nominal) if log else nominal
    return Variable(key, unit, nominal, mean, sd, lower, upper, log=log, beside=beside)


KP = variable("control.kp", "N m/rad", 50.0, 1.0, log=True, lower=0.05, upper=5e4)
FRICTION = variable("hardware.servo.viscous_friction", "N m s/rad", 0.1, 0.2, lower=0.0)
ARMATURE = variable("hardware.servo.armature", "kg m^2", 0.01, 0.02, lower=0.0)
TILT = variable("gravity.tilt_x", "rad", 0.0, 0.1, lower=-1.0, upper=1.0)
DELAY = variable("hardware.command_delay", "s", 0.0, 0.01, lower=0.0, upper=0.02)
ROUGH = variable("log.LF.force.gain", "1", 1.0, 0.2, lower=0.1, upper=10.0)
LATE = variable("log.velocity.delay", "s", 0.0, 0.005, lower=-0.02, upper=0.1, beside=True)
BEND = variable("hardware.servo.presliding", "rad", 0.01, 1.0, log=True, lower=1e-3, upper=0.05, beside=True)


def fit(chosen, told, x, *, held=(), seed=0, scale=1.0, memory=0.0, clock=0.0, held_out=2, **more):
    """A fit at coordinates x, whose samples tell each variable with a standard deviation `told`.

    Spare variables make eight of them: what is traced is compiled once.
    """
    spare = [variable(f"log.spare{n}", "1", 0.0, 1.0, beside=True) for n in range(8 - len(chosen))]
    chosen, told, x = (*chosen, *spare), [*told, *[0.01] * len(spare)], [*x, *[0.0] * len(spare)]
    draw = np.random.default_rng(seed)
    count = WINDOWS * EACH * len(NAMES)
    window = np.repeat(np.arange(WINDOWS), EACH * len(NAMES))
    signal = np.tile(np.repeat(np.arange(len(NAMES)), EACH), WINDOWS)
    step = np.tile(4 * np.arange(EACH), WINDOWS * len(NAMES))
    value = np.sin(0.3 * (step + 100 * window)) * (1 + signal)
    stamp = np.arange(count) if more.get("apart") else window * EACH + step // 4
    rows = Rows(window, signal, step, np.full(count, 0.25), value, stamp)
    windows = Windows(
        begin=1.0 * np.arange(WINDOWS), abuts=np.arange(WINDOWS) > 0, held_out=np.arange(WINDOWS) >= WINDOWS - held_out,
        steps=STEPS, time_step=STEP, names=NAMES, limb=LIMB, joint=JOINT, kind=KIND, rows=rows,
        start=np.zeros((WINDOWS, 4, 3, 2)), commands={}, commanded="command", resting=np.zeros((4, 3)), gains={},
        unknown=np.reshape(more.get("unknown", ()), (-1, 2)), pauses=np.reshape(more.get("pauses", ()), (-1, 2)),
        constant=more.get("constant", ()),
    )  # fmt: skip
    structure = Structure(ROBOT, 0.25, tuple(Place(v.key, v.log) for v in chosen))
    model = Model(tuple(chosen), windows, structure, OWN, more.get("schedule"))
    held = np.array([v.key in held for v in chosen])
    problem = Given(model, held if held.any() else None, clock)
    noise = draw.normal(size=count)
    for n in range(1, count):
        noise[n] = memory * noise[n - 1] + math.sqrt(1 - memory**2) * noise[n]
    scaled = np.where(problem.fitted, noise, scale * noise)
    along = draw.normal(size=(count, len(chosen)))
    along = np.linalg.qr(along)[0] / np.array(told)
    sigma = np.array(more.get("sigma", [0.01, 0.02, 0.03, 0.04, 0.05]))
    found = Fitted(
        np.array(x, float), np.zeros((1, 0)), sigma, clock, scaled * sigma[signal], scaled, along, along.T @ along,
        np.zeros(count), 10.0, 7, more.get("ended", "converged"), more.get("costs", (10.0,)),
        more.get("unsettled", 0.0),
    )  # fmt: skip
    return found, problem, inference.whiteness(problem, found)


def result(*given, warnings=(), hint="", **how):
    found, problem, tests = fit(*given, **how)
    asked = [v for v in problem.model.variables if not v.beside]
    log = Log({"a": Signal(np.arange(3.0), np.arange(3.0))}, "log.csv")
    return identified(SCENARIO, log, asked, (found, problem, tests), warnings, hint)


def without_spare(keys):
    return [key for key in keys if "spare" not in key]


def deviations(found):
    return np.sqrt(np.diag(found.posterior.covariance))


def test_estimates_are_in_units_with_their_intervals_and_remarks():
    chosen = (KP, FRICTION, ARMATURE, TILT, DELAY, ROUGH, LATE, BEND)
    x = [math.log(55.0), 0.0, 0.01, 0.35, 0.004, 1.1, 0.0004, math.log(0.05)]
    told = [0.01, 0.05, 1.0, 0.02, 0.0005, 2.0, 0.01, 0.2]
    found = result(chosen, told, x, held=("hardware.servo.armature",))
    sd = deviations(found)
    each = {**found.estimates, **found.beside}
    assert list(found.estimates) == [v.key for v in chosen[:6]] and list(found.beside) == [v.key for v in chosen[6:]]
    for n, v in enumerate(chosen):
        estimate = each[v.key]
        ends = [x[n] - Z * sd[n], x[n] + Z * sd[n]]
        value, ends = (math.exp(x[n]), [math.exp(end) for end in ends]) if v.log else (x[n], ends)
        low, high = (min(max(end, v.lower), v.upper) for end in ends)
        assert (estimate.value, estimate.low, estimate.high) == pytest.approx((value, low, high))
        assert (estimate.before, estimate.unit) == (v.nominal, v.unit)
    remarks = {key: estimate.remark for key, estimate in each.items()}
    assert remarks == {
        KP.key: "", FRICTION.key: "on its lower bound, 0 N m s/rad", ARMATURE.key: "not told: stays nominal",
        TILT.key: "3.5 sd off its prior", DELAY.key: "",
        ROUGH.key: "told roughly: the interval is as wide as the prior" if sd[5] > 0.2 else "", LATE.key: "",
        BEND.key: "on its upper bound, 0.05 rad",
    }  # fmt: skip
    assert {key for key, estimate in each.items() if not estimate.seen} == {ARMATURE.key, LATE.key, BEND.key}
    assert found.sentence == (
        f"log.csv tells 5 of 6 parameters, and predicts what it has not seen within "
        f"{found.held_out['error_over_noise']:.3g} of the noise"
    )
    assert found.warnings == (
        "hardware.servo.viscous_friction: on its lower bound, 0 N m s/rad",
        "hardware.servo.armature: not told: stays nominal", "gravity.tilt_x: 3.5 sd off its prior",
        "hardware.servo.presliding: on its upper bound, 0.05 rad",
    ) or found.warnings[0].startswith("this log does not tell")  # fmt: skip


def test_the_held_out_part_is_measured_signal_by_signal():
    found = result((KP, DELAY), [0.01, 0.001], [math.log(50.0), 0.004], scale=1.7)
    rows, scaled, missed = found.problem.rows, found.fitted.scaled, found.fitted.residuals
    ahead = [n for n in range(len(scaled)) if rows.window[n] >= WINDOWS - 2]
    assert found.held_out["error_over_noise"] == pytest.approx(
        math.sqrt(sum(scaled[n] ** 2 for n in ahead) / len(ahead))
    )
    assert found.held_out["seconds"] == pytest.approx(2.0)
    for number, name in enumerate(NAMES):
        own = [n for n in ahead if rows.signal[n] == number]
        assert found.held_out["signals"][name] == pytest.approx(math.sqrt(sum(scaled[n] ** 2 for n in own) / len(own)))
        assert found.held_out["error"][name] == pytest.approx(math.sqrt(sum(missed[n] ** 2 for n in own) / len(own)))
    assert found.warnings == (
        f"what was held out is predicted {found.held_out['error_over_noise']:.3g} times worse than the noise; "
        "intervals are wider by as much",
    )
    none = result((KP, DELAY), [0.01, 0.001], [math.log(50.0), 0.004], held_out=0)
    assert none.held_out == {} and none.sentence == "log.csv tells 2 of 2 parameters"
    assert none.warnings == ("nothing was held out: how well the values predict is not known",)


# noise of the second signal, of an amplitude of 2, over its standard deviation
LEFT = 0.9 / 2 / np.std(np.sin(0.3 * 4 * np.arange(WINDOWS * EACH)))
PLAIN = ((KP, DELAY), [0.01, 0.001], [math.log(50.0), 0.004])


DOUBTS = {
    "pauses": [(2.0, 2.5), (4.0, 4.25)], "unknown": [(1.0, 1.5), (6.0, 7.0)], "constant": ("a", "b", "c"),
    "clock": 0.00123, "ended": "out of iterations", "costs": (10.2, 10.0, 10.05), "unsettled": 0.07,
    "sigma": [0.5, 0.9, 1.4, 1.9, 2.5],
}  # fmt: skip
LINES = [
    "pauses: 2, 0.75 s in all, in which nothing was measured; what follows each begins anew",
    "commands are missing in 2 holes, 1.5 s in all: what happens in one is not fitted, and what follows begins anew",
    "a and 2 more: the same all the time, not fitted",
    "time stamps err by 0.0012 s (standard deviation), what was sampled at once together; this is counted as noise",
    "the search still gained after 7 evaluations: fit fewer keys, or add a motion that tells them apart",
    "2 of 3 starts ended at this optimum (--starts with more of them is surer)",
    "the noise did not settle: estimated once more it would change by 7 %, and the intervals with it",
    f"the fit leaves {100 * LEFT:.0f} % or more of what each signal moves by unexplained",
]


@pytest.mark.parametrize(
    ("how", "lines"),
    [
        ({"warnings": ("before",), "hint": "after"}, ["before", "after"]),
        ({"costs": (10.0, 10.09, 10.01), "unsettled": 0.049}, []),
        (
            {"apart": True},
            ["no two signals share a time stamp: errors of the stamps are not told from noise, and not fitted"],
        ),
        (DOUBTS, LINES),
    ],
)
def test_each_doubt_has_its_line(how, lines):
    assert list(result(*PLAIN, **how).warnings) == lines


def test_residuals_that_go_on_refute_the_model():
    found = result(*PLAIN, memory=0.6, scale=0.9)
    wrong = inference.suspicious(found.tests)
    assert 0 < len(wrong) <= 5
    assert found.warnings[0] == f"{wrong[0].in_words} ({len(wrong)} of 5 signals; intervals are widened)"
    assert found.sentence.endswith(f"; the residuals refute the model in {len(wrong)} of 5 signals")


SHARE = np.array([1.0, 1.0, 0.5])


@pytest.mark.parametrize(
    ("share", "on", "time", "keys", "line"),
    [
        (SHARE, [1, 1, 1], [0, 1, 2], PLAIN, None),
        (0 * SHARE, [1, 1, 1], [0, 1, 2], PLAIN, "control.kp is 0 all the while in the log, which tells nothing of"),
        (0 * SHARE, [0, 0, 0], [0, 1, 2], PLAIN, "the torque is off all the while in the log, which tells"),
        (0.5 * SHARE, [1, 1, 1], [0, 1, 2], PLAIN, f"control.kp stands for what the log calls {KP.nominal:g} N m"),
        (0.5 * SHARE, [1, 1, 1], [0, 1, 2], ((DELAY,), [0.001], [0.004]), None),
        (0 * SHARE, [1, 1, 0], [0, 1, 2], PLAIN, "control.kp is 0 all the while in the log, which tells nothing of"),
        (SHARE, [1, 0, 0], [0, 5, 10.5], PLAIN, None),
        (SHARE, [1, 1, 0], [0, 1, 9.9], PLAIN, None),
        (SHARE, [1, 1, 0], [0, 1, 10.0], PLAIN, "the torque is off in what is held out alone, and tells nothing"),
    ],
)  # fmt: skip
def test_gains_by_time_have_their_lines(share, on, time, keys, line):
    said = result(*keys, schedule=Schedule(np.array(time, float), share, np.array(on, float))).warnings
    assert len(said) == (line is not None) and all(each.startswith(line) for each in said)


@pytest.mark.parametrize(
    ("late", "sd", "said"),
    [
        (0.008, 0.0002, True),
        (-0.008, 0.0002, True),
        (0.004, 0.0002, False),
        (0.008, 0.004, False),
        (0.008, None, False),
    ],
)
def test_velocities_that_are_late_as_a_simulators_are_a_doubt(late, sd, said):
    chosen, told, x = (KP, DELAY, ARMATURE), [0.01, 0.001, 0.001], [math.log(50.0), 0.004, 0.01]
    if sd is not None:
        chosen, told, x = (*chosen, LATE), [*told, sd], [*x, late]
    lines = result(chosen, told, x).warnings
    kd = float(OWN.at("control.kd")) + float(OWN.at("hardware.servo.viscous_friction"))
    assert (
        list(lines)
        == [
            f"velocities come {1e3 * late:.3g} ms after positions, as those of a simulator with steps of "
            f"{2e3 * abs(late):.3g} ms do: if one made this log, its step is a doubt beside the intervals "
            f"(hardware.command_delay by {abs(late):.2g} s, hardware.servo.armature by {kd * abs(late):.2g} kg m^2)"
        ]
        * said
    )


# -------------------------------------------------------------------------------------------- tables and pictures


def test_tables_have_the_numbers_of_estimates_and_residuals():
    chosen = (KP, ARMATURE, LATE, BEND)
    x = [math.log(55.0), 0.01, 0.008, math.log(0.02)]
    found = result(chosen, [0.01, 1.0, 0.0002, 0.01], x, held=("hardware.servo.armature",), memory=0.5)
    page = report.page_of(found)
    assert page.title == "Identified from log.csv" and page.scenario is SCENARIO
    assert page.facts == {"search": "converged", "iterations": 7, "windows": WINDOWS}
    said = [found.sentence, *(f"warning: {line}" for line in found.warnings), *found.combined]
    assert page.findings.verdict == found.sentence and sorted(page.findings.lines) == sorted(said)
    table = report.table(found)
    assert table.columns == ("parameter", "unit", "before", "after", "95 % interval", "remark")
    rows = {row[0]: row for _, section in table.sections for row in section}
    assert [(name, without_spare(row[0] for row in section)) for name, section in table.sections] == [
        ("", [KP.key, ARMATURE.key]), ("beside these", [LATE.key, BEND.key]),
    ]  # fmt: skip
    e = found.estimates[KP.key]
    assert rows[KP.key] == [KP.key, "N m/rad", "50", "55", f"{e.low:.4g} to {e.high:.4g}", ""]
    assert rows[ARMATURE.key][-1] == "not told: stays nominal"
    residuals = report.residual_table(found)
    assert [name for name, _ in residuals.sections] == ["LF.coxa", "RH.femur", "RH", "base"]
    tests = {test.signal: test for test in found.tests}
    every = [row for _, section in residuals.sections for row in section]
    scaled, rows = found.fitted.scaled, found.problem.rows
    units = ("rad", "rad/s", "N m", "N", "m", "1", "m/s", "rad/s")
    for number, (name, row) in enumerate(zip(NAMES, every, strict=True)):
        fitted = [scaled[n] for n in range(len(scaled)) if rows.signal[n] == number and found.problem.fitted[n]]
        rms = math.sqrt(sum(each**2 for each in fitted) / len(fitted))
        largest = max(tests[name].correlation, key=abs)
        assert row == [
            name.rpartition(".")[2] if number < 3 else name, units[number], f"{found.fitted.noise[number]:.4g}",
            f"{rms:.3f}", f"{found.held_out['signals'][name]:.3f}", f"{largest:+.2f}" if tests[name].share else "",
        ]  # fmt: skip


def points(panel):
    """Times and values of the dots of a panel by colour, lightest last."""
    return {str(line.get_color()): np.array(line.get_data()) for line in panel.lines if len(line.get_xdata())}


def test_residuals_are_drawn_joint_by_joint_and_what_is_held_out_in_grey():
    found = result(*PLAIN)
    figure = report.plot_residuals(found)
    rows, scaled = found.problem.rows, found.fitted.scaled
    time = rows.window + 0.01 * (rows.step + 0.25)
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["LF", "RH"]
    assert [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()] == [
        "coxa, 1",
        "femur, 1",
        "foot, 1",
        "base, 1",
    ]
    assert [axes.get_xlabel() for axes in figure.axes] == [""] * 6 + ["time, s"] * 2
    place = {0: 0, 1: 0, 2: 3, 3: 5, 4: 6}  # of signals among four lanes of two limbs
    for number, panel in place.items():
        own, ahead = rows.signal == number, rows.window >= WINDOWS - 2
        drawn = [np.array(line.get_data()).T for line in figure.axes[panel].lines if len(line.get_xdata())]
        for part in (own & ~ahead, own & ahead):
            expected = np.column_stack([time[part], scaled[part]])
            assert any(each.shape == expected.shape and np.allclose(each, expected) for each in drawn), number
    for axes in figure.axes:
        assert axes.get_ylim() == (-6, 6)
    grey = {
        line.get_color()
        for axes in figure.axes
        for line in axes.lines
        if len(line.get_xdata()) and line.get_xdata().min() > 10
    }
    assert grey == {"0.75"}
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [kind.replace("_", " ") for kind in KINDS[:5]]


def test_correlations_are_drawn_by_their_lags_with_the_band_of_chance():
    found = result(*PLAIN, memory=0.6, scale=0.9)
    (axes,) = report.plot_correlation(found).axes
    lines = [line for line in axes.lines if len(line.get_xdata()) == 20]
    assert len(lines) == 5
    for line, test in zip(lines, found.tests, strict=True):
        np.testing.assert_allclose(line.get_xdata(), 0.04 * np.arange(1, 21))
        np.testing.assert_allclose(line.get_ydata(), test.correlation)
        assert (line.get_label() == test.signal) == (test.share > 0)
    (band,) = axes.patches
    assert band.get_bbox().intervaly == pytest.approx([-2 / math.sqrt(WINDOWS * EACH), 2 / math.sqrt(WINDOWS * EACH)])
    assert (axes.get_legend() is not None) == any(test.share for test in found.tests)


def test_the_worst_signal_is_drawn_before_and_after_where_it_misses_most():
    found, problem, tests = fit(*PLAIN)
    scaled, residuals = found.scaled.copy(), found.residuals.copy()
    worst = problem.rows.signal == 2
    scaled[worst], residuals[worst] = 3 * scaled[worst], 0.1
    peak = np.flatnonzero(worst & (problem.rows.window == 6))[10]
    residuals[peak] = -0.9
    log = Log({"a": Signal(np.arange(3.0), np.arange(3.0))}, "log.csv")
    made = identified(
        SCENARIO, log, [KP, DELAY], (found._replace(scaled=scaled, residuals=residuals), problem, tests), (), ""
    )
    above, below = report.plot_prediction(made).axes
    rows = problem.rows
    time = rows.window + 0.01 * (rows.step + 0.25)
    own = np.flatnonzero(worst & (np.abs(time - time[peak]) <= 1.0))
    before, after, dots = (np.array(line.get_data()) for line in above.lines)
    np.testing.assert_allclose(after, [time[own], rows.value[own] - residuals[own]])
    np.testing.assert_allclose(before, [time[own], rows.value[own] - 0.25])
    np.testing.assert_allclose(dots, [time[own], rows.value[own]])
    first, last = (np.array(line.get_data())[1] for line in below.lines)
    np.testing.assert_allclose(first, 0.25 / 0.03 + 0 * own)
    np.testing.assert_allclose(last, residuals[own] / 0.03)
    assert above.get_ylabel() == "RH.femur.effort [N m]" and below.get_ylabel() == "log - model [noise]"


def test_lines_of_a_picture_break_in_the_holes_of_the_log():
    found, problem, tests = fit(*PLAIN)
    rows, scaled = problem.rows, found.scaled.copy()
    scaled[rows.signal == 2] *= 3
    late = (rows.signal == 2) & (rows.window == 6) & (rows.step >= 48)
    scaled[np.flatnonzero(late)[0]] = 90.0
    moved = rows._replace(step=np.where(late, 80 + (rows.step - 48) // 4, rows.step))  # a hole of 0.36 s for 0.04 s
    windows = dataclasses.replace(problem.model.windows, rows=moved)
    vars(problem)["model"] = dataclasses.replace(problem.model, windows=windows)
    log = Log({"a": Signal(np.arange(3.0), np.arange(3.0))}, "log.csv")
    made = identified(
        SCENARIO, log, [KP, DELAY], (found._replace(scaled=scaled, residuals=scaled), problem, tests), (), ""
    )
    above, _ = report.plot_prediction(made).axes
    assert [int(np.isnan(line.get_xdata()).sum()) for line in above.lines] == [1, 1, 0]


# ------------------------------------------------------------------------------------- what other commands read


@pytest.mark.parametrize("held", [(), (KP.key, DELAY.key)])
def test_the_folder_of_a_fit_has_its_files_and_a_posterior_where_anything_is_told(held, tmp_path):
    found = result(*PLAIN, held=held)
    files = contents(found).files(SCENARIO, tmp_path, "asked")
    names = [
        "identified.yaml",
        "hardware.yaml",
        "posterior.yaml",
        "result.json",
        "residuals",
        "autocorrelation",
        "prediction",
    ]
    assert list(files) == [name for name in names if not (held and name == "posterior.yaml")]
    (tmp_path / "identified.yaml").write_text(files["identified.yaml"])
    read = mc.load_scenario(tmp_path / "identified.yaml")
    assert read.hardware.command_delay == pytest.approx(0.0 if held else 0.004)
    assert f"command_delay: {read.hardware.command_delay}" in files["hardware.yaml"]
    assert json.loads(files["result.json"])["command"] == "asked"


def test_the_posterior_as_an_ensemble_has_the_keys_of_the_scenario():
    chosen = (KP, ROUGH, TILT, DELAY, LATE)
    x = [math.log(55.0), 1.1, 0.02, 0.004, 0.0]
    found = result(chosen, [0.01, 0.02, 0.02, 0.0005, 0.0002], x)
    made = ensemble_of(found).posterior
    at = [0, 2, 3]
    assert made.keys == (KP.key, TILT.key, DELAY.key) and made.log == (True, False, False)
    np.testing.assert_allclose(made.mean, np.array(x)[at])
    np.testing.assert_allclose(made.covariance, found.posterior.covariance[np.ix_(at, at)])
    assert made.lower == (0.05, -1.0, 0.0) and made.upper == (5e4, 1.0, 0.02) and made.held == ()


def test_what_is_found_goes_to_the_scenario_and_into_json():
    late = dataclasses.replace(DELAY, lower=-0.0003)
    chosen = (KP, TILT, late, ARMATURE, BEND)
    x = [math.log(55.0), 0.1, -0.0002, 0.03, math.log(0.02)]
    found = result(chosen, [0.01, 0.002, 1e-5, 9.0, 0.01], x, held=(ARMATURE.key,))
    new = found.overrides()
    gravity = new.pop("gravity")
    np.testing.assert_allclose(gravity, [0, 9.81 * math.sin(0.1), -9.81 * math.cos(0.1)], atol=1e-12)
    assert new == pytest.approx({KP.key: 55.0, late.key: 0.0, BEND.key: 0.02})
    data = json.loads(json.dumps(_result(found, "asked")))
    assert data["search"] == {"ended": "converged", "iterations": 7, "costs": [10.0]}
    assert data["parameters"][ARMATURE.key]["seen"] is False and data["parameters"][KP.key]["value"] == pytest.approx(
        55.0
    )
    assert data["noise"] == dict(zip(NAMES, [0.01, 0.02, 0.03, 0.04, 0.05], strict=True))
    assert (data["mass"], data["command"], data["log"], data["clock"]) == (0.25, "asked", "log.csv", 0.0)
    assert data["estimates"][KP.key]["before"] == pytest.approx(50.0) and without_spare(data["beside"]) == [BEND.key]
    assert data["log_sha256"] == found.log.digest and "scenario" not in data["provenance"]
    assert float(np.asarray(found.robot().base_mass)) == ROBOT.base_mass and not found.own
