"""A fit whose model is a line in its variables: its end, its noise, its starts, and the findings are known by hand."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from tests.tuning.identification.coverage import width_of
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.fit import inference, output, report
from tuning.identification.fit.conclusions import identified
from tuning.identification.fit.identify import _other_frictions, begins, identity_of_fit, rough_noise, searched
from tuning.identification.fit.inference import Whiteness
from tuning.identification.fit.prediction import predicted
from tuning.identification.fit.problem import Problem
from tuning.identification.fit.search import Searches
from tuning.identification.fit.stamps import HUBER
from tuning.identification.model.predicted import PRESLIDING, Fit, model_of
from tuning.identification.model.variables import Variable, variables
from tuning.identification.model.windows import KINDS, cut
from tuning.identification.readers.log import OFF, Log, Signal
from tuning.methods.parts import Parts

STEP, NOISE, TRUTH = 0.01, 0.002, (0.06, 0.015)
KEYS = ("hardware.servo.viscous_friction", "hardware.servo.armature", "hardware.servo.coulomb_friction")
JOINTS = ("coxa", "femur", "tibia")


def waves(time):
    """What the angles move by per unit of the first two variables, (2, ...)."""
    return np.stack([3 * np.sin(2 * np.pi * 0.7 * time), 4 * np.sin(2 * np.pi * 1.3 * time + 1)])


class Line(Fit):
    """Angles that are a sum of the first two variables' waves; the third one moves nothing. It diverges beyond MOST."""

    MOST = math.inf

    def evaluate(self, x, start):
        windows = self.windows
        which = np.arange(len(windows.begin))
        time = windows.moments(which, 2 * windows.steps + 1, windows.steps)[..., None, None] * np.ones((4, 3))
        along = np.zeros((len(which), len(x), *time.shape[1:]))
        along[:, :2] = np.moveaxis(waves(time), 0, 1)
        values = np.einsum("n,wnslj->wslj", x, along) * (math.nan if abs(x[0]) > self.MOST else 1.0)
        yield which, dict.fromkeys(("position", "effort"), values), dict.fromkeys(("position", "effort"), along)


class Sticking(Line):
    """The third variable moves the angles too; the cost has a minimum for every 0.05 of it, the lowest one at 0.03."""

    def evaluate(self, x, start):
        ((which, values, along),) = super().evaluate(x, start)
        off, turn = x[2] - 0.03, 2 * np.pi / 0.05
        wave, slope = along["position"][:, 0] * along["position"][:, 1], 1 + 0.02 * turn * np.cos(turn * off)
        moved = values["position"] + (off + 0.02 * np.sin(turn * off)) * wave
        turned = along["position"].copy()
        turned[:, 2] = slope * wave
        yield which, {"position": moved}, {"position": turned}


def scenario():
    servo = {"viscous_friction": 0.05, "armature": 0.02, "coulomb_friction": 0.1}
    return mc.Scenario().with_overrides({"hardware": {"servo": servo}})


def logged(noise=NOISE, seconds=6.0, joints=JOINTS, more=()):
    time, rng = np.arange(round(seconds * 100)) / 100, np.random.default_rng(1)
    signals = {}
    for joint in joints:
        signals[f"LF.{joint}.command"] = Signal(time, np.sin(time))
        signals[f"LF.{joint}.position"] = Signal(time, TRUTH @ waves(time) + noise * rng.standard_normal(len(time)))
    return Log(signals | dict(more), "log.csv")


def problem_of(log=None, held_out=0.2, kind=Line, **fields):
    chosen = variables(scenario(), KEYS, held=True)
    windows = cut(logged() if log is None else log, ROBOT, STEP, held_out)
    made = model_of(scenario(), dataclasses.replace(windows, **fields), chosen)
    model = kind(made.windows, made.variables, made.structure, made.parameters)
    return Problem(model, rough_noise(model))


class Recorded(Searches):
    """Searches whose problems are kept."""

    def search(self, problem, point, most, text, tolerance=1e-5):
        vars(self).setdefault("seen", []).append((problem, text, most, tolerance))
        return super().search(problem, point, most, text, tolerance)


def fitted(problem, starts=3):
    searches = Recorded(Parts(None, dict))
    return *searched(problem, starts, searches), searches.seen


@pytest.fixture(scope="module")
def line():
    return fitted(problem_of())


# --------------------------------------------------------------------------------------------------- the search's end


def test_a_line_is_found_and_the_noise_is_that_of_the_log(line):
    found, _, seen = line
    np.testing.assert_allclose(found.x[:2], TRUTH, atol=1e-4)
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)
    assert found.ended == "converged" and found.unsettled < 0.05 and found.clock == 0
    assert len(found.costs) == 3 and max(found.costs) < 1.001 * min(found.costs)
    assert [text for _, text, most, _ in seen[:6] if most > 1] == [*(f"start {n} of 3" for n in (1, 2, 3)), "pass 1"]


def test_a_search_that_ends_beside_the_lowest_minimum_of_a_friction_goes_on_there():
    """Without another begin it ends at 0 for 0.03."""
    found, _, seen = fitted(problem_of(kind=Sticking), starts=1)
    assert found.x[2] == pytest.approx(0.03, abs=2e-3)
    assert len(found.costs) == 2 and found.costs[1] < found.costs[0] / 10
    assert [text for _, text, *_ in seen].count("from another friction") == 1


def test_what_moves_nothing_is_held_at_its_nominal_value(line):
    found, problem, _ = line
    np.testing.assert_array_equal(problem.free, [True, True, False])
    assert found.x[2] == 0.1


def test_starts_are_compared_with_a_tenth_of_what_moves_as_noise_and_roughly(line):
    _, _, seen = line
    windows = seen[0][0].model.windows
    moved = np.array([np.std(windows.rows.value[windows.rows.signal == n]) for n in range(3)])
    for problem, text, most, tolerance in seen[:3]:
        np.testing.assert_allclose(problem.noise, 0.1 * moved)
        assert (most, tolerance) == (100, 1e-4), text
    whole = next(each for each in seen if each[1] == "pass 1")
    np.testing.assert_allclose(whole[0].noise, NOISE, rtol=0.15)
    assert whole[3] == 1e-5


def test_torques_weigh_little_where_starts_are_compared():
    problem = problem_of(logged(more={"LF.tibia.effort": logged().signals["LF.tibia.position"]}))
    _, _, seen = fitted(problem, 1)
    usual = np.array([0.1 * np.std(signal) for signal in values_of(problem)])
    assert problem.model.windows.names[3] == "LF.tibia.effort" and (problem.noise < usual).all()
    np.testing.assert_allclose(seen[0][0].noise, usual * [1, 1, 1, 30])


def values_of(problem):
    rows = problem.rows
    return [rows.value[rows.signal == n] for n in range(len(problem.model.windows.names))]


def test_where_some_starts_diverge_others_begin_and_where_all_do_it_is_said():
    class Some(Line):
        MOST = 0.07

    class None_(Line):
        MOST = -1.0

    found, _, seen = fitted(problem_of(kind=Some), starts=4)
    points = begins(problem_of().model, problem_of().prior, 8)
    assert (np.abs(points[:4, 0]) > Some.MOST).any()
    assert len(found.costs) == 4 and [text for _, text, *_ in seen].count("start 4 of 4") >= 1
    np.testing.assert_allclose(found.x[:2], TRUTH, atol=1e-4)
    with pytest.raises(mc.ConfigError, match="the model diverges at the values that it begins with"):
        fitted(problem_of(kind=None_))


def test_starts_are_around_the_prior_within_the_bounds_the_nominal_one_first():
    delay = Variable("hardware.command_delay", "s", 0.0, 0.0, 0.01, -0.0025, 0.02)
    log = Variable("control.kp", "N m/rad", 50.0, math.log(50.0), 1.0, 5.0, 500.0, log=True)
    small = Variable("hardware.servo.armature", "kg m^2", 0.02, 0.02, 5.0, -9.0, 9.0)
    windows = SimpleNamespace(time_step=0.004)
    model = SimpleNamespace(windows=windows, variables=(delay, log, small), guess=np.zeros((1, 0)))
    prior = Problem.prior.fget(SimpleNamespace(model=model))
    points = begins(model, prior, 4000)
    np.testing.assert_allclose(points[0], [0.008, math.log(50.0), 0.02])
    low, high = np.transpose([v.bounds for v in model.variables])
    assert ((points >= low) & (points <= high)).all()
    assert np.std(points[1:, 1]) == pytest.approx(0.7, rel=0.05)
    # around the value of one, within its size; below its bound a point is mirrored there, and not put on it
    assert np.std(points[1:, 2]) == pytest.approx(0.7 * 0.02, rel=0.06)
    assert (points[1:, 0] <= low[0]).mean() < 0.01
    np.testing.assert_array_equal(begins(model, prior, 5), points[:5])


def test_the_rough_noise_of_a_signal_is_that_of_its_second_differences():
    log, rng = logged(), np.random.default_rng(2)
    time = log.signals["LF.coxa.position"].time
    own = {"LF.coxa.position": 0.5 * time + 0.01 * rng.standard_normal(len(time)), "LF.femur.position": 2 * time}
    noise = problem_of(Log(log.signals | {name: Signal(time, v) for name, v in own.items()}, "log.csv")).noise
    assert noise[0] == pytest.approx(0.01, rel=0.15) and noise[1] == pytest.approx(1e-3 * np.ptp(2 * time), rel=0.01)


# ------------------------------------------------------------------------------------------------------- the findings


def findings(line, warnings=("before",), hint="", tests=None, chosen=KEYS, **changes):
    found, problem, _ = line
    own = [v for v in problem.model.variables if v.key in chosen]
    tests = inference.whiteness(problem, found) if tests is None else tests
    return identified(scenario(), logged(), own, (found._replace(**changes), problem, tests), warnings, hint)


def test_estimates_have_intervals_that_hold_the_truth_and_say_what_is_not_told(line):
    found = findings(line)
    for key, truth in zip(KEYS, TRUTH, strict=False):
        each = found.estimates[key]
        assert each.seen and each.low < truth < each.high and each.remark == ""
        assert (each.low + each.high) / 2 == pytest.approx(each.value)
    rows = line[1].fitted
    exact = np.sqrt(np.diag(np.linalg.inv((line[0].along[rows].T @ line[0].along[rows])[:2, :2])))
    widths = [found.estimates[key].high - found.estimates[key].low for key in KEYS[:2]]
    assert (np.array(widths) >= 0.999 * 2 * inference.Z * exact).all()
    assert (np.array(widths) < 3 * 2 * inference.Z * exact).all()
    silent = found.estimates[KEYS[2]]
    assert not silent.seen and silent.value == silent.before == 0.1
    assert f"{KEYS[2]}: not told: stays nominal" in found.warnings
    assert found.warnings[0] == "before" and found.known.keys() == {*KEYS[:2]}


def test_the_error_of_what_was_held_out_is_over_its_noise(line):
    fit, problem, _ = line
    found, held = findings(line).held_out, problem.predicted
    assert found["error_over_noise"] == pytest.approx(np.sqrt((fit.scaled[held] ** 2).mean()))
    assert 0.7 < found["error_over_noise"] < 1.3
    windows = problem.model.windows
    assert found["seconds"] == pytest.approx(windows.held_out.sum() * 1.0) and found["seconds"] == 1.0
    own = held & (problem.rows.signal == 1)
    assert found["signals"]["LF.femur.position"] == pytest.approx(np.sqrt((fit.scaled[own] ** 2).mean()))
    assert found["error"]["LF.femur.position"] == pytest.approx(np.sqrt((fit.residuals[own] ** 2).mean()))


@pytest.mark.parametrize(
    ("changes", "said", "silent"),
    [
        ({"clock": 0.003}, "time stamps err by 0.003 s", {}),
        ({"ended": "out of iterations", "iterations": 77}, "the search still gained after 77 evaluations", {}),
        ({"costs": (1.0, 1.009, 1.02)}, "2 of 3 starts ended at this optimum", {"costs": (1.0, 1.009, 1.005)}),
        ({"unsettled": 0.05}, "estimated once more it would change by 5 %", {"unsettled": 0.049}),
    ],
)
def test_what_a_fit_lacks_is_said(line, changes, said, silent):
    usual, off, near = (findings(line, **each).warnings for each in ({}, changes, silent))
    assert any(said in text for text in off), off
    assert not any(said[-20:] in text for text in (*usual, *near))


def test_what_was_held_out_and_missed_is_said_and_so_is_that_nothing_was(line):
    fit, problem, _ = line
    usual = findings(line).held_out["error_over_noise"]
    factors = (1.19 / usual, 1.21 / usual)
    scaled = {factor: np.where(problem.predicted, factor * fit.scaled, fit.scaled) for factor in factors}
    near, far = (findings(line, scaled=each).warnings for each in scaled.values())
    assert not any("times worse than the noise" in text for text in near)
    assert any("times worse than the noise" in text for text in far)
    none = findings(fitted(problem_of(held_out=0.0), 1))
    assert (width_of(none.fitted, none.problem, none.posterior)[:2] < 1.9).all()
    assert none.held_out == {} and any("nothing was held out" in text for text in none.warnings)


def test_a_wrong_model_is_named_with_the_signals_that_say_so(line):
    some, worst, fine = (
        Whiteness(name, np.array([size, 0.1]), 0.01, share, np.zeros(0), np.zeros(0, int))
        for name, size, share in (("a", 0.3, 0.2), ("b", -0.6, 0.4), ("c", 0.9, 0.0))
    )
    found = findings(line, tests=[some, worst, fine], hint="try another")
    (text,) = (text for text in found.warnings if "the model is wrong" in text)
    assert "residuals of b are correlated, -0.60 0.01 s apart (2 of 3 signals" in text
    assert found.warnings[-1] == "try another"


def test_a_clock_is_not_fitted_where_no_two_signals_share_a_stamp(line):
    said = "no two signals share a time stamp"
    assert not any(said in text for text in findings(line).warnings)
    found, problem, seen = line
    stamps = problem.rows._replace(stamp=np.arange(len(problem.rows.stamp)))
    windows = dataclasses.replace(problem.model.windows, rows=stamps)
    alone = dataclasses.replace(problem, model=dataclasses.replace(problem.model, windows=windows))
    assert any(said in text for text in findings((found, alone, seen)).warnings)


@pytest.mark.parametrize(
    ("x", "remark", "told"),
    [
        (0.0, "on its lower bound, 0 N m s/rad", True),
        (0.05 + 0.2 * 3.1, "3.1 sd off its prior", True),
        (0.05 + 0.2 * 2.9, "", True),
    ],
)  # fmt: skip
def test_a_value_on_its_bound_or_far_off_its_prior_has_a_remark(line, x, remark, told):
    each = findings(line, x=np.array([x, *line[0].x[1:]])).estimates[KEYS[0]]
    assert (each.remark, each.seen) == (remark, told)


@pytest.mark.parametrize(("x", "sd", "seen"), [(0.06, 0.4, True), (0.06, 0.6, False), (0.0, 0.4, False)])
def test_what_is_fitted_beside_is_told_below_half_its_prior_and_off_its_bounds(line, x, sd, seen):
    """A variable beside those that were asked for is never held; a wide one keeps its prior."""
    fit, problem, searches = line
    first, *others = problem.model.variables
    beside = dataclasses.replace(first, beside=True)
    model = dataclasses.replace(problem.model, variables=(beside, *others))
    root = 1 / (sd * first.sd)  # of the samples and the prior together
    information = np.diag([root**2 - first.sd**-2, *np.diag(fit.information)[1:]])
    own = fit._replace(x=np.array([x, *fit.x[1:]]), information=information)
    found = findings((own, dataclasses.replace(problem, model=model), searches), tests=[], chosen=KEYS[1:])
    assert found.beside[KEYS[0]].seen is seen
    bound = any(text.startswith(f"{KEYS[0]}: on its lower bound") for text in found.warnings)
    assert bound == (x == 0)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"unknown": np.array([[1.0, 1.5], [2.0, 2.25]])}, "commands are missing in 2 holes, 0.75 s in all"),
        (
            {"pauses": np.array([[1.0, 1.5]])},
            "pauses: 1, 0.5 s in all, in which nothing was measured; what follows each",
        ),
        ({"constant": ("a", "b")}, "the same all the time, not fitted"),
    ],
)
def test_parts_of_a_log_that_are_not_fitted_are_said(line, fields, said):
    found, problem, seen = line
    windows = dataclasses.replace(problem.model.windows, **fields)
    own = dataclasses.replace(problem, model=dataclasses.replace(problem.model, windows=windows))
    assert any(said in text for text in findings((found, own, seen)).warnings)
    assert not any(said in text for text in findings(line).warnings)


@pytest.mark.parametrize(
    ("late", "sd", "said"),
    [(0.006, 0.0005, True), (-0.006, 0.0005, True), (0.004, 0.0005, False), (0.006, 0.0024, False)],
)
def test_velocities_that_come_late_may_be_a_simulators(line, late, sd, said):
    """Not by less than half a step, and not by less than three standard deviations."""
    fit, problem, tests = line
    variable = Variable("log.velocity.delay", "s", 0.0, 0.0, 0.005, -0.02, 0.1, beside=True)
    model = dataclasses.replace(problem.model, variables=(*problem.model.variables, variable))
    information = np.zeros((4, 4))
    information[:3, :3], information[3, 3] = fit.information, sd**-2 - 0.005**-2
    along = np.column_stack([fit.along, np.zeros(len(fit.along))])
    own = fit._replace(x=np.r_[fit.x, late], information=information, along=along)
    held = np.array([False, False, True, False])
    found = findings((own, dataclasses.replace(problem, model=model, held=held), tests), tests=[])
    heard = [text for text in found.warnings if text.startswith("velocities come")]
    assert len(heard) == said
    if said:
        kd = float(np.asarray(model.parameters.joint_loop.kd))
        doubt = f"hardware.servo.armature by {(kd + fit.x[0]) * abs(late):.2g} kg m^2"
        assert heard[0].startswith(f"velocities come {1e3 * late:.3g} ms after positions") and doubt in heard[0]
        assert "steps of 12 ms" in heard[0]


@pytest.mark.parametrize(
    ("off", "kp", "chosen", "said", "held_out"),
    [
        ((0.0, 1), 50.0, KEYS, "the torque is off all the while in the log", 0.2),
        ((0.0, 0), 0.0, KEYS, "control.kp is 0 all the while in the log", 0.2),
        ((9.0, 1), 25.0, ("control.kp",), "control.kp stands for what the log calls 50 N m/rad", 0.2),
        ((5.5, 1), 50.0, ("control.kp",), "the torque is off in what is held out alone", 0.2),
        ((4.0, 1), 50.0, KEYS, None, 0.2),
        ((5.5, 1), 50.0, KEYS, None, 0.0),
        ((9.0, 1), 25.0, KEYS, None, 0.2),
    ],
)
def test_gains_and_torques_of_a_log_that_tell_nothing_are_said(off, kp, chosen, said, held_out):
    time = np.arange(601) / 100
    gains = {OFF: Signal(time, (time >= off[0]) * float(off[1])), "control.kp": Signal(time, np.full(601, kp))}
    kinds = variables(scenario(), chosen, held=True)
    windows = dataclasses.replace(cut(logged(), ROBOT, STEP, held_out), gains=gains)
    made = model_of(scenario(), windows, kinds)
    own = Line(windows, kinds, made.structure, made.parameters)
    assert float(own.parameters.joint_loop.kp) == 50.0
    problem, count = Problem(own, np.full(3, NOISE)), len(kinds)
    point = np.array([v.mean for v in kinds])
    if count == 1:
        problem = dataclasses.replace(problem, model=One(windows, kinds, made.structure, made.parameters))
    end = problem.ended(point, 1.0, 1, "converged")
    tests = identified(scenario(), logged(), kinds, (end._replace(costs=(1.0,)), problem, []), [], "").warnings
    words = ("all the while", "stands for", "held out alone")
    heard = [text for text in tests if any(word in text for word in words)]
    assert len(heard) == (said is not None) and all(text.startswith(said) for text in heard)


class One(Line):
    """A line of one variable."""

    def evaluate(self, x, start):
        for which, values, along in super().evaluate(np.r_[x, 0.0], start):
            yield which, values, {"position": along["position"][:, :1]}


def test_a_result_says_what_it_tells_and_changes_what_it_knows(line):
    found = findings(line)
    assert found.sentence.startswith("log.csv tells 2 of 3 parameters, and predicts what it has not seen within ")
    assert found.sentence.endswith(" of the noise") and found.as_json()["parameters"][KEYS[2]]["seen"] is False
    assert found.as_json()["search"]["costs"] == list(line[0].costs)
    assert found.overrides() == {key: found.estimates[key].value for key in KEYS[:2]}
    refuted = findings(line, tests=[Whiteness("a", np.ones(2), 0.01, 0.2, np.zeros(0), np.zeros(0, int))] * 2)
    assert refuted.sentence.endswith("; the residuals refute the model in 2 of 2 signals")
    assert findings(fitted(problem_of(held_out=0.0), 1)).sentence == "log.csv tells 2 of 3 parameters"
    seen, bend, tilt = (dataclasses.replace(found.estimates[KEYS[0]], value=value) for value in (-0.001, 0.004, 0.1))
    own = dataclasses.replace(
        found, estimates={"hardware.command_delay": seen, "gravity.tilt_y": tilt}, beside={PRESLIDING: bend}
    )
    gravity = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix() @ np.asarray(scenario().gravity)
    changes = own.overrides()
    assert (changes["hardware.command_delay"], changes[PRESLIDING]) == (0.0, 0.004)
    np.testing.assert_allclose(changes["gravity"], gravity)
    unseen = dataclasses.replace(own, beside={PRESLIDING: dataclasses.replace(bend, seen=False)})
    assert PRESLIDING not in unseen.overrides()
    level = dataclasses.replace(own, estimates={"gravity.tilt_y": dataclasses.replace(tilt, seen=False)})
    assert "gravity" not in level.overrides()


def test_tables_of_a_fit_have_its_values_and_each_signal(line):
    found, (fit, problem, _) = findings(line), line
    ((_, rows),) = report.table(found).sections
    assert [row[0] for row in rows] == [*KEYS] and rows[2][-1] == "not told: stays nominal"
    tests = [Whiteness("LF.femur.position", np.array([0.2, -0.5]), 0.01, 0.3, np.zeros(0), np.zeros(0, int))]
    sections = dict(report.residual_table(findings(line, tests=tests)).sections)
    (row,) = sections["LF.femur"]
    scaled = fit.scaled[problem.fitted & (problem.rows.signal == 1)]
    assert row[0] == "position" and row[1] == "rad" and row[3] == f"{np.sqrt((scaled**2).mean()):.3f}"
    assert row[4] == f"{found.held_out['signals']['LF.femur.position']:.3f}" and row[5] == "-0.50"
    assert sections["LF.coxa"][0][5] == ""


@pytest.mark.parametrize(("name", "place"), [("xy", (0, 1)), ("yz", (1, 2))])
def test_an_inertia_has_its_interval_in_its_own_unit(name, place):
    kinds = variables(scenario(), (f"robot.LF.tibia.inertia.{name}",), held=True)
    windows = cut(logged(), ROBOT, STEP, 0.2)
    made = model_of(scenario(), windows, kinds)
    problem = Problem(One(windows, kinds, made.structure, made.parameters), np.full(3, NOISE))
    end = problem.ended(np.array([kinds[0].mean]), 1.0, 1, "converged")
    each = identified(scenario(), logged(), kinds, (end._replace(costs=(1.0,)), problem, []), [], "").estimates
    (only,) = each.values()
    assert only.value == pytest.approx(ROBOT.link_inertia[0, 2][place], abs=1e-9) and only.low < only.value < only.high
    assert (only.low + only.high) / 2 == pytest.approx(only.value, abs=1e-9)


# ------------------------------------------------------------------------------- the states that stretches begin with


class Standing(Line):
    """A line whose joints begin each stretch off by a state of their own, and keep it."""

    states = 3
    memory = ()

    @property
    def guess(self):
        return np.full((int((~self.windows.abuts).sum()), 4, 3, 1), 0.05)

    guess_sd = np.array([0.2])

    def evaluate(self, x, start):
        for which, values, along in super().evaluate(x, start):
            off = start[self.windows.stretch[which], :, :, 0][:, None]
            own = np.eye(3)[None, :, None, None] * np.ones((len(which), 1, along["position"].shape[2], 4, 1))
            tangents = np.concatenate([along["position"], own], axis=1)
            yield which, {"position": values["position"] + off}, {"position": tangents}


def standing():
    log = logged()
    there = {name: (each.time < 2.5) | (each.time > 3.2) for name, each in log.signals.items()}
    gap = {name: Signal(each.time[there[name]], each.value[there[name]])
           for name, each in log.signals.items()}  # fmt: skip
    return problem_of(Log(gap, "log.csv"), kind=Standing)


def test_each_stretch_and_joint_has_a_state_and_rows_their_derivatives():
    problem = standing()
    assert problem.model.guess.shape == (2, 4, 3, 1)
    point = np.r_[0.06, 0.015, 0.1, np.linspace(0.0, 0.2, 24)]
    found = problem.evaluate(point)
    for place in range(len(point)):
        step = np.zeros(len(point))
        step[place] = 1e-4
        ends = [problem.evaluate(point + side * step).scaled for side in (1, -1)]
        np.testing.assert_allclose(found.along[:, place], (ends[1] - ends[0]) / 2e-4, atol=1e-6)
    used = np.abs(found.along[:, 3:]).max(0) > 0
    np.testing.assert_array_equal(used.reshape(2, 4, 3), np.broadcast_to(np.arange(4)[:, None] == 0, (2, 4, 3)))


def test_states_are_eliminated_from_what_a_fit_knows():
    """As from the information about all of them, their priors included."""
    problem = standing()
    point = np.r_[0.06, 0.015, 0.1, np.full(24, 0.05)]
    made, found = problem.evaluate(point), problem.ended(point, 1.0, 7, "converged")
    np.testing.assert_allclose(found.weight[problem.fitted], np.minimum(1, HUBER / np.abs(made.scaled[problem.fitted])))
    weight = found.weight * problem.fitted
    whole = (made.along * weight[:, None]).T @ made.along + np.diag(np.r_[np.zeros(3), np.full(24, 0.2**-2)])
    rest = np.linalg.inv(whole[3:, 3:])
    expected = whole[:3, :3] - whole[:3, 3:] @ rest @ whole[3:, :3]
    np.testing.assert_allclose(found.information, expected, rtol=1e-6, atol=1e-6 * expected.max())
    assert found.start.shape == (2, 4, 3, 1) and found.iterations == 7


def test_priors_of_states_are_about_their_guess_and_a_bristle_bends_by_one_at_most():
    problem = standing()
    prior = problem.whole_prior
    np.testing.assert_array_equal(prior.mean[3:], 0.05)
    np.testing.assert_array_equal(prior.sd[3:], 0.2)
    assert np.isinf(prior.upper[3:]).all() and np.isneginf(prior.lower[3:]).all()

    class Bristles(Standing):
        memory = ("loop.goal", "bristle")
        guess_sd = np.array([0.2, 3.0, 0.05, 0.7])

        @property
        def guess(self):
            return np.zeros((2, 4, 3, 4))

    own = problem.model
    model = Bristles(own.windows, own.variables, own.structure, own.parameters)
    upper = dataclasses.replace(problem, model=model).whole_prior.upper[3:].reshape(-1, 4)
    np.testing.assert_array_equal(upper, np.tile([np.inf, np.inf, np.inf, 1.0], (24, 1)))


def test_samples_of_one_stamp_are_whitened_together_by_the_error_of_their_time():
    problem = problem_of()
    point = np.array([0.05, 0.01, 0.1])
    plain = problem.evaluate(point)
    both = dataclasses.replace(problem, clock=0.004, rate=plain.rate).evaluate(point)
    stamps = problem.rows.stamp
    rows = np.flatnonzero(stamps == stamps[100])
    assert len(rows) == 3
    late = plain.rate[rows] * 0.004 / problem.noise[problem.rows.signal[rows]]
    covariance = np.eye(3) + np.outer(late, late)
    assert both.scaled[rows] @ both.scaled[rows] == pytest.approx(
        plain.scaled[rows] @ np.linalg.solve(covariance, plain.scaled[rows])
    )
    np.testing.assert_array_equal(both.residuals, plain.residuals)


# -------------------------------------------------------------------------------------------- between a model's steps


class Cubic(Fit):
    """Angles that are a parabola of time, and rates that are one: means over the steps, half a step before them."""

    def evaluate(self, x, start):
        windows = self.windows
        which, h = np.arange(len(windows.begin)), windows.time_step
        time = windows.moments(which, 2 * windows.steps + 1, windows.steps)[..., None, None] * np.ones((4, 3))
        rate = (time**3 - (time - h) ** 3) / (3 * h)
        values = {"position": x[0] * time**2, "velocity": x[0] * rate, "effort": x[0] * time}
        yield which, values, {name: value[:, None] / x[0] for name, value in values.items()}


@pytest.mark.parametrize("late", [0.0, 0.0037, -0.004])
def test_samples_between_steps_are_on_parabolas_and_late_ones_on_those_before(late):
    time = np.sort(np.random.default_rng(0).uniform(0, 4, 300))
    kinds = ("command", "position", "velocity", "effort")
    signals = {
        f"LF.{joint}.{kind}": Signal(time, np.where(kind == "command", 0.3, np.sin(time)))
        for joint in JOINTS for kind in kinds
    }  # fmt: skip
    windows = cut(Log(signals, "log.csv"), ROBOT, STEP, 0.0)
    first = Variable("a", "1", 2.0, 2.0, 1.0, 0.0, 9.0)
    delay = Variable("log.velocity.delay", "s", late, 0.0, 0.01, -0.02, 0.1)
    model = Cubic(windows, (first, delay), SimpleNamespace(), SimpleNamespace(
        bus=SimpleNamespace(command_delay=0.0), drive=SimpleNamespace(delay=0.0)))  # fmt: skip
    made = predicted(model, np.array([2.0, late]), model.guess)
    rows = windows.rows
    kind = windows.kind[rows.signal]
    at = windows.begin[rows.window] + (rows.step + rows.share - (kind == 1) / 2) * STEP
    inside = (at - windows.begin[0] > 0.05) & (at < windows.begin[-1] + 0.9)
    expected = np.select([kind == 0, kind == 1], [2 * at**2, 2 * (at - late) ** 2], 2 * at)
    slope = np.select([kind == 0, kind == 1], [4 * at, 4 * (at - late)], 2.0)
    np.testing.assert_allclose(made.value[inside], expected[inside], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(made.along[inside, 0], expected[inside] / 2, rtol=1e-9, atol=1e-9)
    smooth = inside & (kind != 2)
    np.testing.assert_allclose(made.rate[smooth], slope[smooth], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(made.along[:, 1], np.where(kind == 1, -made.rate, 0.0))
    assert KINDS[1] == "velocity" and made.finite


def test_other_dry_frictions_are_a_third_and_three_times_and_the_nominal_one_within_the_bounds():
    """None of a viscous one, nor of one that is fitted beside; of a logarithm its third and threefold too."""
    dry = Variable("hardware.servo.coulomb_friction", "N m", 0.2, 0.2, 1.0, 0.0, 1.0)
    of_joint = Variable("robot.LF.coxa.friction", "N m", 0.3, np.log(0.3), 1.0, 0.05, 2.0, log=True)
    viscous = dataclasses.replace(dry, key="hardware.servo.viscous_friction")
    beside = dataclasses.replace(dry, key="robot.RH.coxa.friction", beside=True)
    other = dataclasses.replace(dry, key="contact.damping")
    every = [viscous, dry, beside, of_joint, other]
    point = np.array([0.5, 0.9, 0.7, np.log(1.5), 0.9, 7.0])
    found = list(_other_frictions(SimpleNamespace(model=SimpleNamespace(variables=every)), point))
    wanted = [(1, value) for value in (0.2, 0.3, 1.0)] + [(3, np.log(value)) for value in (0.3, 0.5, 2.0)]
    assert len(found) == len(wanted)
    for each, (place, value) in zip(found, wanted, strict=True):
        expected = point.copy()
        expected[place] = value
        np.testing.assert_allclose(each, expected)
    point[1], point[3] = 0.2, np.log(0.3)  # the nominal ones are no others
    found = [*_other_frictions(SimpleNamespace(model=SimpleNamespace(variables=every)), point)]
    np.testing.assert_allclose([each[1] for each in found[:2]], [0.2 / 3, 0.6])
    np.testing.assert_allclose([np.exp(each[3]) for each in found[2:]], [0.1, 0.9])


def test_members_are_drawn_from_what_the_scenario_has_of_a_fit_and_times_are_none_below_zero():
    every = [
        Variable("hardware.command_delay", "s", 0.0, 0.0, 0.01, -0.001, 0.02),
        Variable("robot.LF.coxa.friction", "N m", 0.3, 0.3, 1.0, 0.0, 1.0),
        Variable("contact.stiffness", "N/m", 1e4, math.log(1e4), 1.0, 10.0, 1e7, log=True),
        Variable("gravity.tilt_x", "rad", 0.0, 0.0, 0.1, -0.5, 0.5),
        Variable("log.clock", "s", 0.0, 0.0, 1.0, 0.0, 1.0),
    ]  # fmt: skip
    model = SimpleNamespace(
        parameters=SimpleNamespace(paths={each.key: None for each in every[::2][:2]}), variables=every
    )
    covariance = np.arange(25.0).reshape(5, 5) + np.arange(25.0).reshape(5, 5).T
    found = SimpleNamespace(
        model=model, fitted=SimpleNamespace(x=np.arange(5.0)), posterior=SimpleNamespace(covariance=covariance),
        estimates=dict.fromkeys(each.key for each in every),
    )  # fmt: skip
    made = output.ensemble_of(found)
    assert (made.pushes, made.cargo, made.gravity, made.grip_stiffness, made.robot_mass) == (
        None, None, None, (1.0, 1.0), (1.0, 1.0)
    )  # fmt: skip
    drawn = made.posterior
    assert drawn.keys == ("hardware.command_delay", "contact.stiffness", "gravity.tilt_x")
    assert (drawn.log, drawn.mean, drawn.held) == ((False, True, False), (0.0, 2.0, 3.0), ("robot.LF.coxa.friction",))
    assert (drawn.lower, drawn.upper) == ((0.0, 10.0, -0.5), (0.02, 1e7, 0.5))
    np.testing.assert_array_equal(drawn.covariance, covariance[[0, 2, 3]][:, [0, 2, 3]])


def test_a_fit_is_another_with_another_log_share_number_of_starts_mass_prior_or_scenario():
    model, log = problem_of().model, logged()
    heavy = dataclasses.replace(model, structure=model.structure._replace(mass=0.1))
    first, *others = model.variables
    narrow = dataclasses.replace(model, variables=(dataclasses.replace(first, sd=0.3), *others))
    other = scenario().with_overrides({"control.kp": 40.0})
    own = identity_of_fit(scenario(), log, model, 0.2, 3)
    assert own == identity_of_fit(scenario(), logged(), problem_of().model, 0.2, 3)
    for changed in (
        (other, log, model, 0.2, 3), (scenario(), logged(seconds=5.0), model, 0.2, 3),
        (scenario(), log, heavy, 0.2, 3), (scenario(), log, narrow, 0.2, 3), (scenario(), log, model, 0.3, 3),
        (scenario(), log, model, 0.2, 4),
    ):  # fmt: skip
        assert identity_of_fit(*changed) != own


def test_evaluations_are_counted_over_all_searches_and_the_least_cost_of_each_is_shown():
    told = []
    searched(problem_of(), 2, Searches(Parts(None, dict), lambda *now: told.append(now)))
    assert [done for done, *_ in told] == list(range(1, len(told) + 1))
    assert all(most >= done for done, most, _ in told) and told[0][1] == 100
    each = {}
    for _, _, text in told:
        name, _, cost = text.partition(": cost ")
        each.setdefault(name, []).append(float(cost))
    assert {"start 1 of 2", "start 2 of 2", "pass 1"} <= each.keys()
    assert all(later <= before for name in each if name.startswith("start")
               for before, later in zip(each[name], each[name][1:], strict=False))  # fmt: skip
