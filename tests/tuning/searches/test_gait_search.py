"""Gait and law searched together: spaces, methods, and results that walk again from their files."""

import dataclasses
import json

import jax
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.inputs import gait_values
from mjx_climb.scenario.messages import ConfigError
from tuning.comparisons.judge import draw_of, evaluate, read_asked
from tuning.comparisons.worth import worth_of
from tuning.gains import gains_file
from tuning.kinds import write_found
from tuning.problem import spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.results.tuned import load
from tuning.searches import retuned_pd
from tuning.searches.pareto import pareto
from tuning.searches.schedule import schedule
from tuning.searches.shards import Kept, Shard
from tuning.searches.tune import prepare, problem_of, start_of, tune

SHORT = mc.load_scenario("case_1_2", {"duration": 0.8, "gait.cycle": 0.8, "gait.stride": 0.01})
PD = SHORT.with_overrides(["control.controller=pd"])
TIMES = ("gait.duty", "gait.cycle")
ASKED = Search.make({"also": (*TIMES, "gait.step_height"), "joint_gains": True, "method": "cmaes"})


def test_the_default_bounds_keep_the_order_of_the_swings():
    space = spaces.space(SHORT, ASKED)
    ends = dict(zip(space.names, np.exp([space.lower, space.upper]).T.tolist(), strict=True))
    assert list(ends) == ["damping", "stiffness", "kp", "kd", "gait.step_height", "gait.cycle", "gait.duty"]
    assert ends["gait.duty"] == pytest.approx([0.75, 0.95]) and ends["gait.cycle"] == pytest.approx([0.4, 1.6])
    assert ends["gait.step_height"] == pytest.approx([0.015, 0.06])
    assert [name for name, smooth in zip(space.names, space.smooth, strict=True) if not smooth] == [*TIMES[::-1]]
    together = SHORT.with_overrides({"gait.sequence": [["LH", "RF"], ["LF", "RH"]], "gait.duty": 0.6})
    assert np.exp(spaces.space(together, ASKED).lower[-1]) == pytest.approx(0.5)
    for theta in (space.lower, space.upper):  # what a search may ask for can be walked
        gains = spaces.to_gains64(space, theta)
        assert gains_file.applied(SHORT, gains).gait.duty == pytest.approx(gains["gait.duty"])
    wanted = ASKED.changed({"pins": {"gait.duty": 0.8, "gait.stride": 0.01}, "bounds": {"gait.cycle": (0.7, 1.0)}})
    space = spaces.space(SHORT, wanted)
    assert "gait.duty" not in space.names
    gains = spaces.to_gains64(space, space.upper)
    assert [gains[name] for name in ("gait.duty", "gait.stride", "gait.cycle")] == pytest.approx([0.8, 0.01, 1.0])


@pytest.mark.slow
def test_sway_height_and_landing_speed_are_searched_by_gradients_too():
    """From the nearest bound where the scenario has none; with ideal hardware the joint gains stay."""
    moving = ("gait.sway", "gait.height", "gait.landing_speed")
    problem = problem_of(SHORT, Search.make({"also": moving, "method": "gradient"}))
    space = problem.space
    assert space.names == ("damping", "stiffness", "gait.height", "gait.sway", "gait.landing_speed")
    assert space.smooth.all()
    ends = np.exp([space.lower, space.upper])[:, 2:].T
    np.testing.assert_allclose(ends, [[0.85, 1.15], [0.02, 0.5], [1e-3, 0.2]])
    np.testing.assert_allclose(np.exp(start_of(problem))[2:], [1.0, 0.02, 1e-3])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"also": ("gait.stride",)}, "also: expected gains of the law, inertia, damping, stiffness, ki, gait."),
        ({"bounds": {"gait.duty": (0.7, 0.9)}}, "bounds.gait.duty: expected a number from 0.75 to below 1, so that"),
        ({"bounds": {"gait.duty": (0.8, 1.2)}}, "bounds.gait.duty: expected a number above 0 and below 1, got 1.2"),
        ({"pins": {"gait.cycle": 0.001}}, "bounds.gait.duty: expected a swing, (1 - duty) cycle, of two time steps"),
        ({"also": ("gait.height",), "bounds": {"gait.height": (0.9, 3.0)}}, "bounds.gait.height: expected at most 1."),
        ({"also": ("gait.sway",), "bounds": {"gait.sway": (0.1, 1.2)}}, "bounds.gait.sway: expected a number from 0"),
        ({"pins": {"gait.step_height": 200.0}}, "bounds.gait.step_height: expected a number above 0, 100 at most"),
        ({"method": "gradient"}, "method: expected cmaes, grid or optuna to search gait.cycle, gait.duty in whole"),
        ({"method": "gradient", "also": ("gait.duty",)}, "optuna to search gait.duty in whole steps, got gradient"),
    ],
)  # fmt: skip
def test_a_gait_that_cannot_be_searched_is_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError) as refused:
        problem_of(SHORT, ASKED.changed(settings))
    assert message in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("search", [pareto, schedule])
def test_fronts_and_schedules_have_no_gait_of_their_own(search):
    with pytest.raises(ConfigError, match=r"^also: expected gains of the law, as tune alone .* got gait\.step_height$"):
        search(SHORT, also=("gait.step_height",))


def test_times_are_searched_without_gradients_where_nobody_says_how():
    chosen = prepare(SHORT, Search(also=TIMES)).search
    assert chosen.method == "cmaes"
    assert prepare(SHORT, Search(also=TIMES), ("gradient",)).search.method == "gradient"
    alone = {"also": ("gait.cycle",), "pins": {"stiffness": 1e4, "damping": 1e3}}
    assert prepare(SHORT, Search.make(alone)).search.method == "grid"


@pytest.fixture(scope="module")
def found():
    """A tiny search of pd's joint gains and gait, for the force variation."""
    asked = {"weights": {"force_variation": 1.0}, "no_worse_than_pd": False, "starts": 6, "iterations": 3}
    return tune(PD, ASKED.changed(asked))


@pytest.mark.nightly
def test_pd_with_its_gait_retuned_is_better_and_walks_again_from_its_file(found, tmp_path, call):
    assert found.value < 0.9 and found.feasible
    write_found(found, tmp_path)
    text = yaml.safe_load((tmp_path / "gains.yaml").read_text())
    assert text["law"] == "PD" and set(text) == {"law", "kp", "kd", "gait"}
    assert set(text["gait"]) == {key.removeprefix("gait.") for key in gait_values.GAIT}
    assert text["gait"]["stride"] / text["gait"]["cycle"] == pytest.approx(0.01 / 0.8)  # as fast
    expected = mc.metrics(mc.rollout(PD, found.gains))
    (tmp_path / "config.yaml").write_text(SHORT.to_yaml())  # under another law: the file has its own
    arguments = ["run", tmp_path / "config.yaml", "--gains", tmp_path / "gains.yaml", "--out", tmp_path / "run"]
    code, out, err = call(*arguments, "--json", "--figures", "svg")
    assert code == 0, err
    told = json.loads(out)
    assert {name: told[name] for name in expected} == expected
    assert jax.tree.map(np.array_equal, load(found.save(tmp_path / "s.nc")).gains, found.gains)["gait.cycle"]


@pytest.mark.slow
def test_the_rival_of_a_law_has_the_same_freedom(monkeypatch):
    """pd is searched over the same gait, in the same way."""
    problem, asked = problem_of(SHORT, ASKED), []
    monkeypatch.setattr("tuning.searches.tune.run", lambda *task, **_: asked.append(task) or dataclasses.replace)
    with pytest.raises(AttributeError):  # nothing was found
        retuned_pd.search(problem, ASKED.changed({"pins": {"gait.stride": 0.01, "stiffness": 1e4}}))
    ((rival, settings),) = asked
    assert rival.space.names == ("kp", "kd", "gait.step_height", "gait.cycle", "gait.duty")
    assert (rival.scenario.control.controller, settings.method) == ("pd", "cmaes")
    joint = {"kp": 17.0, "kd": 1.0, "gait.duty": 0.8, "gait.cycle": 0.9}
    walked = retuned_pd.walker(SHORT, joint)
    assert (walked.gait.duty, walked.gait.cycle, walked.control.kp) == (0.8, 0.9, 17.0)
    told = worth_of({"objective": 0.8}, {"objective": 1.0}, retuned_pd.Rival(joint, 1.0)).in_words
    assert "than pd with kp 17, kd 1, duty 0.8, cycle 0.9, which needs none" in told


@pytest.mark.nightly
def test_files_of_other_laws_and_gaits_are_judged_in_one_call(tmp_path):
    """Each as it walks by itself."""
    files = {
        "pd": mc.Gains(1.0, 1.0, 1.0, 40.0, 0.4),
        "feet": {"inertia": 1.0, "damping": 2e3, "stiffness": 1e4, "gait.duty": 0.8, "gait.cycle": 0.76},
    }
    laws = {"pd": mc.control.PD(), "feet": mc.control.EndEffectorAdmittance(1.0, 1.0, 1.0)}
    for name, gains in files.items():
        gains_file.save(gains, tmp_path / f"{name}.yaml", law=laws[name])
    whole = {f"{name}'s": gains_file.whole(tmp_path / f"{name}.yaml", SHORT) for name in files}
    still = Ensemble.make({"members": 2, "pushes": None, "cargo": None, "gravity": None})
    walks = evaluate(SHORT, whole, still, members=2).data
    draw = {name: float(value) for name, value in walks.isel(member=0).sel(gains="feet's").items() if value.ndim == 0}
    feet = gains_file.applied(SHORT.with_overrides(["control.controller=end_effector_admittance"]), files["feet"])
    drawn = {name: np.asarray(draw[name]) for name in ("contact.stiffness", "mass_scale")}
    parameters = mc.parameters(feet).replace(drawn)
    alone = mc.rollout_metrics(feet, files["feet"], parameters, smooth=True)
    for name in ("force_variation", "travel", "peak_foot_force"):
        np.testing.assert_allclose(draw[name], alone[name], rtol=1e-3)
        assert draw[name] != float(walks[name].isel(member=0).sel(gains="config"))


def test_a_shard_keeps_laws_and_gaits(tmp_path):
    """What is read again from its folder walks as what was written, and is known as the same."""
    still = Ensemble.make({"members": 2, "pushes": None, "cargo": None, "gravity": None})
    pd = gains_file.Whole(mc.control.PD(), {"kp": np.asarray(40.0), "gait.duty": np.asarray(0.8)})
    draw = draw_of(Problem(SHORT), {"mine": mc.Gains(1.0, 2e3, 1e4), "retuned": pd}, still, 2)
    draw.write_asked(tmp_path)
    asked = json.loads(json.dumps(draw.identity()))
    again = read_asked(Kept(tmp_path, Shard(1, 1), asked, {}), SHORT, None, mc.METRICS)
    assert type(again.gains["retuned"].law) is mc.control.PD
    assert again.gains["mine"].law is None
    assert json.loads(json.dumps(again.identity()))["gains"] == asked["gains"]
