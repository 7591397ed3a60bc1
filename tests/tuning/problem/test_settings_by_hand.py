"""Settings of searches on both sides of each bound, known gains, and penalties, by hand and by loops."""

import dataclasses
import itertools

import numpy as np
import pytest
from pydantic import ValidationError

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from tuning.problem import known, spaces
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Ensemble, Posterior, Pushes, Worst
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term, in_words, lost, objective, penalty_of, violation
from tuning.problem.search import METHODS, WEIGHTS, Judge, Pareto, Schedule, Search, check_metrics, numbers_of
from tuning.problem.settings import Settings, Shell, setting

CASE = mc.load_scenario("case_1_2")


# --- bounds of settings

ONE = {"keys": ["a.b"], "log": [True], "mean": [0.0], "covariance": [[1.0]], "lower": [0.0], "upper": [1.0]}
KEPT = [
    (Search, {"starts": 1}), (Search, {"starts": 100_000}), (Search, {"iterations": 1}), (Search, {"seed": 0}),
    (Search, {"seed": 2**31 - 1}), (Search, {"iterations": 1_000_000}),
    (Search, {"weights": {"travel": 0.0, "min_tsm": 1.0}}),
    (Pareto, {"points": 2}), (Pareto, {"points": 200}), (Judge, {"members": 1}), (Judge, {"members": 100_000}),
    (Schedule, {"gravity": [0.5], "cargo": [0.0]}), (Ceiling, {"points": 2}), (Ceiling, {"iterations": 2}),
    (Ceiling, {"knots": [0.3, 0.1, 0.05]}), (Ceiling, {"random": 0}), (Ceiling, {"test_members": 0}),
    (Ensemble, {"members": 1}), (Worst, {"share": 1.0}), (Worst, {"weight": 1e-9}),
    (Posterior, ONE), (Pushes, {"count": 0}), (Pushes, {"count": 20}), (Ensemble, {"seed": 2**31 - 1}),
    (Search, {"method": "optuna:tpe"}), (Search, {"method": "a folder/mine.py:Mine"}),
]  # fmt: skip
LEFT = [
    (Search, {"starts": 0}, "starts: expected 1 or more, got 0"),
    (Search, {"starts": 100_001}, "starts: expected 100000 at most, got 100001"),
    (Search, {"iterations": 0}, "iterations: expected 1 or more, got 0"),
    (Search, {"iterations": 1_000_001}, "iterations: expected 1e+06 at most, got 1000001"),
    (Search, {"seed": -1}, "seed: expected 0 or more, got -1"),
    (Search, {"seed": 2**31}, "seed: expected 2.14748e+09 at most, got 2147483648"),
    (Search, {"weights": {"travel": 0.0}}, "weights: expected one above 0"),
    (Search, {"weights": {"travel": -1.0}}, "weights.travel: expected 0 or more, got -1"),
    (Search, {"deviation_factor": 0.0}, "deviation_factor: expected a number above 0, got 0"),
    (Search, {"bounds": {"damping": [1.0, 1.0]}}, "bounds.damping: expected low < high, got 1, 1"),
    (Search, {"pins": {"kp": 1.0}, "bounds": {"kp": [1.0, 2.0]}},
     "pins.kp: expected one setting of this gain, got bounds.kp too"),
    (Search, {"pins": {"kp": 1.0}, "frozen": ["kp"]}, "pins.kp: expected one setting of this gain, got frozen.kp too"),
    (Search, {"frozen": ["kp"], "bounds": {"kp": [1.0, 2.0]}},
     "frozen.kp: expected one setting of this gain, got bounds.kp too"),
    (Search, {"method": "annealing"}, "method: expected "),
    (Search, {"method": "optuna:"}, "method: expected "),
    (Search, {"space": "cubic"}, "space: expected 'isotropic', 'split' or 'diagonal', got 'cubic'"),
    (Pareto, {"points": 1}, "points: expected 2 or more, got 1"),
    (Pareto, {"points": 201}, "points: expected 200 at most, got 201"),
    (Pareto, {"better": "travel", "against": "travel"}, "against: expected another metric than travel"),
    (Judge, {"members": 0}, "members: expected 1 or more, got 0"),
    (Schedule, {"gravity": [1.0, 1.0]}, "gravity: expected ascending numbers, got 1, 1"),
    (Schedule, {"cargo": [0.5, 0.0]}, "cargo: expected ascending numbers, got 0.5, 0"),
    (Schedule, {"gravity": [0.0, 1.0]}, "gravity.0: expected a number above 0, got 0"),
    (Schedule, {"gravity": "1,a"}, "gravity: expected numbers with commas between them, got '1,a'"),
    (Ceiling, {"knots": [0.3, 0.2]}, "knots: expected each spacing to divide the one before it, got 0.3, 0.2"),
    (Ceiling, {"knots": [0.1, 0.1]}, "knots: expected each spacing to divide the one before it, got 0.1, 0.1"),
    (Ceiling, {"knots": [0.1, 0.2]}, "knots: expected each spacing to divide the one before it, got 0.1, 0.2"),
    (Ceiling, {"weights": {"travel": 0.0}}, "weights: expected one above 0"),
    (Ceiling, {"better": "travel", "against": "travel"}, "against: expected another metric than travel"),
    (Ceiling, {"iterations": 1}, "iterations: expected 2 or more, got 1"),
    (Ceiling, {"points": 101}, "points: expected 100 at most, got 101"),
    (Ceiling, {"delays": [-0.001]}, "delays.0: expected 0 or more, got -0.001"),
    (Ensemble, {"members": 0}, "members: expected 1 or more, got 0"),
    (Ensemble, {"robot_mass": [1.1, 0.9]}, "robot_mass: expected low <= high, got 1.1, 0.9"),
    (Worst, {"share": 0.0}, "share: expected a number above 0, got 0"),
    (Worst, {"weight": 1.01}, "weight: expected 1 at most, got 1.01"),
    (Posterior, ONE | {"keys": ["ab"]}, "posterior.keys: expected keys of a scenario, got 'ab'"),
    (Posterior, ONE | {"covariance": [[1.0, 0.0]]}, "posterior.covariance: expected one for each of 1 keys"),
    (Posterior, ONE | {"log": [True, False]}, "posterior.log: expected one for each of 1 keys"),
    (Pushes, {"count": -1}, "count: expected 0 or more, got -1"),
    (Pushes, {"count": 21}, "count: expected 20 at most, got 21"),
    (Ensemble, {"seed": 2**31}, "seed: expected a number below 2.14748e+09, got 2147483648"),
    (Ensemble, {"cargo": {"mass": [2.0, 1.0]}}, "cargo.mass: expected low <= high, got 2, 1"),
    (Ceiling, {"knots": [0.21, 0.1]}, "knots: expected each spacing to divide the one before it, got 0.21, 0.1"),
    (Search, {"bounds": {"kp": [1.0, 2.0, 3.0]}}, "bounds.kp: expected 2 values, got "),
    (Search, {"limits": {"travel": np.inf}}, "limits.travel: expected a finite number, got Infinity"),
    (Schedule, {"gravity": []}, "gravity: tuple should have at least 1 item"),
    *((Search, {"method": name}, f"method: expected {', '.join(METHODS)}, optuna:SAMPLER or FILE.py:NAME, got {name!r}")
      for name in ("optuna:tpe 2", "mine.py:Mine()", "mine.py")),
]  # fmt: skip


def test_settings_at_their_bounds_are_kept():
    for kind, values in KEPT:
        made = kind.make(values)
        assert kind.parse(made.to_yaml()) == made


@pytest.mark.parametrize(("kind", "values", "said"), LEFT)
def test_settings_beyond_their_bounds_are_refused_by_key(kind, values, said):
    with pytest.raises(mc.ConfigError) as refused:
        kind.make(values, "file.yaml")
    assert str(refused.value).startswith(f"file.yaml: {said}")


def test_settings_are_parsed_changed_and_named(tmp_path):
    class Own(Settings):
        count: int = setting(3, "how many")
        name: str = setting(..., "of it")

    assert Own.parse("name: a\ncount: 4\n") == Own(name="a", count=4)
    assert Own.parse("name: a", count=5).count == 5 and Own(name="a").changed({"count": 6}).count == 6
    own = Own(name="a")
    assert own.changed({}) is own
    (tmp_path / "own.yaml").write_text("name: b\n")
    assert Own.load(tmp_path / "own.yaml", count=9) == Own(name="b", count=9)
    for call, said in [
        (lambda: Own.parse("- 1"), "own: expected a mapping"),
        (lambda: Own.parse("", "x.yaml"), "x.yaml: name: expected a value here"),
        (lambda: Own.make({"name": "a", "other": 1}), "own: other: expected a known key, got an unknown one"),
        (lambda: own.changed({"count": 1.5}, "here"), "here: count: expected a whole number, got 1.5"),
        (lambda: Own.load(tmp_path / "own.yaml", count=1.5), f"{tmp_path}/own.yaml: count: expected a whole number"),
    ]:  # fmt: skip
        with pytest.raises(mc.ConfigError) as refused:
            call()
        assert str(refused.value).startswith(said)
    with pytest.raises(ValidationError):
        own.count = 4


def test_numbers_of_a_text_are_fractions():
    assert (
        numbers_of("0, 1/6,1e-3") == [0.0, 1 / 6, 1e-3]
        and numbers_of([1, "a"]) == [1, "a"]
        and numbers_of(None) is None
    )
    for text in ("1,,2", "1/0", "one", ""):
        with pytest.raises(ValueError, match="expected numbers with commas between them"):
            numbers_of(text)


def test_defaults_in_words_are_the_defaults():
    """Of lists of numbers, which help shows as they are typed; weights are shown by name."""
    shown = 0
    for kind in (Schedule, Ceiling, Search):
        for field in kind.model_fields.values():
            (shell,) = (each for each in field.metadata if isinstance(each, Shell))
            if shell.metavar and shell.metavar.endswith(",..."):
                assert tuple(numbers_of(shell.default_in_words)) == field.default
                shown += 1
            elif field.default == WEIGHTS:
                assert shell.default_in_words.split(", ") == [*WEIGHTS]
    assert shown == 4


def test_weights_and_limits_are_of_known_metrics():
    """The share of lost walks over an ensemble alone, and never as a limit; not those that tell how a walk failed."""
    fine = Search(weights={"travel": 1.0}, limits={"min_tsm": 0.1})
    check_metrics(fine, mc.METRICS)
    check_metrics(Search(weights={"lost": 1.0}), mc.METRICS, over_ensemble=True)
    for search, how in [
        (Search(weights={"lost": 1.0}), {}), (Search(limits={"lost": 1.0}), {"over_ensemble": True}),
        (Search(weights={"travl": 1.0}), {"over_ensemble": True}), (Search(limits={"diverged": 0.0}), {}),
        (Search(weights={"detached_at": 1.0}), {}),
    ]:  # fmt: skip
        with pytest.raises(mc.ConfigError, match="is no metric to weigh or limit") as refused:
            check_metrics(search, mc.METRICS, "mine", **how)
        assert str(refused.value).startswith("mine: ")
        assert ("did you mean travel?" in str(refused.value)) == ("travl" in search.weights)
    with pytest.raises(mc.ConfigError, match=r"'peak_joint_force' .*\(did you mean (peak_\w+( or |\?\))){3}"):
        check_metrics(Search(limits={"peak_joint_force": 1.0}), mc.METRICS)


# --- gains that are known


class Defaults(mc.Law):
    """A law whose gains have defaults."""

    damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e5), default=50.0)
    softness: object = mc.gain("m/N", bounds=(1e-6, 1.0), default=1e-3)

    def init(self, start):
        return ()

    def step(self, state, measured, reference):
        return state, mc.control.shifted(reference, 0 * measured.wrench)


def test_known_gains_are_the_stiffest_and_the_laws_defaults():
    """Those that are the start, or each other, count once; joint gains and gait stay at the start's."""
    law = Defaults(damping=np.full(3, 200.0), softness=0.1)
    settings = Search.make({"joint_gains": True, "space": "isotropic"})
    space = spaces.space(CASE, settings, law)
    assert space.names == ("damping", "softness", "kp", "kd")
    start = np.log([200.0, 0.1, 40.0, 0.3])
    problem = Problem(CASE, space, law=law)
    stiff, default = np.array(start), np.array(start)
    stiff[0], default[:2] = np.log(1e5), np.log([50.0, 1e-3])
    np.testing.assert_allclose(known.others(problem, start), [stiff, default])
    np.testing.assert_allclose(known.others(problem, stiff), [np.where([1, 1, 0, 0], np.log([50, 1e-3, 1, 1]), stiff)])
    np.testing.assert_allclose(known.others(problem, default), [np.where([1, 0, 0, 0], stiff, default)])
    shipped = dataclasses.replace(problem, law=VirtualModelAdmittance(), space=spaces.space(CASE, settings))
    own = shipped.space.clip(np.zeros(4))
    found = known.others(shipped, own)
    assert shipped.space.names == ("damping", "stiffness", "kp", "kd")
    np.testing.assert_allclose(found[0], [*shipped.space.upper[:2], *own[2:]])
    default = [float(np.ravel(getattr(VirtualModelAdmittance(), name))[0]) for name in shipped.space.names[:2]]
    np.testing.assert_allclose(found[1], [*np.log(default), *own[2:]])
    assert len(found) == 2


# --- pieces of scores


def test_penalties_are_parabolas_and_then_lines():
    """Zero up to the limit; 100 x^2 just outside, a slope of 10 far outside."""
    over = np.array([-1.0, 0.0, 1e-5, 1e3, 1e3 + 1])
    found = np.asarray(penalty_of(over))
    assert found[0] == found[1] == 0.0
    assert found[2] == pytest.approx(100 * 1e-10, rel=1e-3) and found[4] - found[3] == pytest.approx(10.0, rel=1e-4)


def test_violations_are_relative_and_signed_for_one_row_or_each():
    values = np.array([1.0, 2.0, 3.0])
    for larger, by_row in itertools.product((False, True), repeat=2):
        limit = Limit(
            "travel", (1.5, 2.5, 2.5) if by_row else 2.0, (0.5, 1.0, 2.0) if by_row else 0.5, 0.02, "why", larger
        )
        ends, scales = np.broadcast_to(limit.value, 3), np.broadcast_to(limit.scale, 3)
        expected = [(end - v if larger else v - end) / s for v, end, s in zip(values, ends, scales, strict=True)]
        np.testing.assert_allclose(violation(limit, values), expected)
        text = "1.5 to 2.5" if by_row else "2"
        assert in_words(limit) == f"travel at {'least' if larger else 'most'} {text} (why)"


def test_walks_are_lost_that_use_more_than_a_limit_diverge_or_stand():
    for used, diverged, stands in itertools.product((0.5, 1.0, 1.0001), (0.0, 1.0), (np.nan, 0.0, 3.0)):
        metrics = {
            "peak_utilization": np.array([used]),
            "diverged": np.array([diverged]),
            "stands_at": np.array([stands]),
        }
        assert lost(metrics) == float(used > 1 or diverged > 0 or stands >= 0)
        del metrics["stands_at"]
        assert lost(metrics) == float(used > 1 or diverged > 0)


PD = {"force_variation": 2.0, "travel": 0.6, "base_deviation": 0.04, "diverged": False, "peak_utilization": 0.1,
      "smooth_force_variation": 1.5, "stands_at": np.nan}  # fmt: skip


def test_an_objective_weighs_what_the_settings_weigh_relative_to_pd():
    """Smooth companions where there are some; of members the mean and that of the worst in the metric's own sense."""
    search = Search(weights={"force_variation": 2.0, "travel": 1.0, "min_tsm": 0.0})
    assert objective(search, PD).terms == (
        Term("force_variation", 2.0, 2.0, 1.5), Term("travel", 1.0, 0.6, 0.6, larger_is_better=True)
    )  # fmt: skip
    scale = np.array([1.0, 2.0, 3.0, 4.0])
    members = {name: np.asarray(value) * scale for name, value in PD.items()}
    members["diverged"] = np.zeros(4, bool)
    found = objective(search, members, worst=Worst(share=0.5, weight=0.5))
    assert [term[2:4] for term in found.terms] == [pytest.approx((5.0, 3.75)), pytest.approx((1.5, 1.5))]
    assert [term[5:] for term in found.terms] == [pytest.approx((7.0, 5.25)), pytest.approx((0.9, 0.9))]
    assert found.limits[2].value == pytest.approx(3 * 0.16) and found.margin == 0.005
    weighed = objective(Search(weights={"lost": 1.0, "travel": 1.0}), members | {"peak_utilization": 0.5 * scale},
                        worst=Worst(share=0.5))  # fmt: skip
    assert weighed.weighs_lost and weighed.terms[0].baseline == 0.5 and not weighed.terms[0].larger_is_better
    assert [limit.metric for limit in weighed.limits] == ["joint_limit_margin", "base_deviation"]
    endless = objective(search, PD | {"base_deviation": np.inf})
    assert [limit.metric for limit in endless.limits][:2] == ["joint_limit_margin", "peak_utilization"]
    assert "base_deviation" not in [limit.metric for limit in endless.limits]


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"travel": 0.0}, "0 under pd"), ({"travel": np.nan}, "nan under pd"),
     ({"diverged": True}, "a walk that diverges under pd"),
     ({"smooth_force_variation": np.inf}, "2 under pd"), ({"smooth_force_variation": 0.0}, "2 under pd")],
)  # fmt: skip
def test_a_metric_that_pd_does_not_have_is_not_weighed(changes, said):
    with pytest.raises(mc.ConfigError, match=rf"expected a metric that pd has here, got {said}$"):
        objective(Search(weights={"force_variation": 1.0, "travel": 1.0}), PD | changes)


def test_a_metric_that_pd_does_not_have_in_all_members_is_not_weighed():
    """By its mean over them; zero in some of them is no fault."""
    members = {name: np.asarray(value) * np.ones(2) for name, value in PD.items()} | {"diverged": np.zeros(2, bool)}
    search, worst = Search(weights={"travel": 1.0}), Worst(share=1.0)
    assert objective(search, members | {"travel": np.array([0.0, 2.0])}, worst=worst).terms[0].baseline == 1.0
    for changes, said in [
        ({"travel": np.array([-1.0, 1.0])}, "0 in the mean"), ({"travel": np.array([np.nan, 1.0])}, "nan in the mean"),
        ({"diverged": np.array([False, True])}, "a walk that diverges under pd"),
    ]:  # fmt: skip
        with pytest.raises(mc.ConfigError, match=rf"expected a metric that pd has in every member, got {said}$"):
            objective(search, members | changes, worst=worst)


def test_a_function_of_ones_own_takes_the_place_of_the_terms():
    """Its value under pd is the reference; it sees companions where a metric has none of its own."""
    search = Search(weights={"force_variation": 1.0, "travel": 1.0}, no_worse_than_pd=True)
    goal = objective(search, PD, lambda m: m["smooth_force_variation"] + 2 * m["smooth_travel"])
    assert goal.terms == () and goal.reference == pytest.approx(1.5 + 1.2)
    assert [limit.reason for limit in goal.limits] == ["joint limits", "limit of the grips", "3 times pd's"]
    points = {name: np.array([1.0, 2.0]) for name in ("force_variation", "smooth_force_variation", "travel")}
    points |= {"diverged": np.array([False, True]), "joint_limit_margin": np.ones(2), "peak_utilization": np.zeros(2),
               "base_deviation": np.zeros(2)}  # fmt: skip
    score = goal.score(points)
    assert (
        score.value[0] == pytest.approx(3.0) and np.isnan(score.value[1]) and score.feasible.tolist() == [True, False]
    )
    with pytest.raises(mc.ConfigError, match="expected a number of pd's walk"):
        objective(search, PD, lambda m: m["travel"] * np.nan)


def test_walks_that_lose_a_grip_break_no_limit_where_their_number_is_weighed():
    worst = Worst(share=1.0, weight=0.5)
    limit, term = Limit("peak_foot_force", 1.0, 1.0, 0.0, ""), Term("lost", 1.0, 0.5, 0.5, worst=1.0, smooth_worst=1.0)
    metrics = {"peak_foot_force": np.array([[3.0, 3.0], [0.5, 0.5]]),
               "peak_utilization": np.array([[2.0, 0.5], [0.1, 0.1]]),
               "diverged": np.zeros((2, 2), bool)}  # fmt: skip
    score = Objective((term,), (limit,), worst=worst).score(metrics)
    assert score.feasible.tolist() == [True, False]
    np.testing.assert_allclose(score.penalty, [0.0, float(penalty_of(np.array(2.0))) / 2])
    # half of the members are lost: as many as under pd, and a half of the worst, which are all
    np.testing.assert_allclose(score.value, [0.5 * 1.0 + 0.5 * 0.5, 0.0])


def test_points_that_diverged_are_worth_nothing_to_who_compares():
    ones = np.ones(3)
    found = Evaluation(np.array([1.0, np.nan, 2.0]), np.array([1.0, 1.0, np.inf]), ones, ones > 0, ones, ones, {})
    assert found.alive.tolist() == [True, True, False] and found.merit.tolist() == [2.0, 1e6, 3.0]
