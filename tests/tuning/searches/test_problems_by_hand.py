"""From settings to the problem of a search: space, method, objective and walks, on both sides of each decision."""

import dataclasses

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.walk.metrics import METRICS
from tuning.methods.method import Function, Method, method_of
from tuning.problem import evaluation
from tuning.problem.ensemble import Ensemble, Hardware, Worst
from tuning.problem.objectives import NO_OBJECTIVE, Objective, Score
from tuning.problem.search import ROBUST_WEIGHTS, Search
from tuning.searches import retuned_pd, tune

CASE = mc.load_scenario("case_1_2")
PD = {name: 1.0 + n for n, name in enumerate(METRICS.with_companions.names)} | {"diverged": 0.0, "stands_at": np.nan}


@pytest.fixture
def walked(monkeypatch):
    """Have pd walk without walking, alone and in the members of an ensemble."""
    calls = []

    def baseline(scenario, engine, metrics):
        calls.append(("alone", engine))
        return PD

    def pd_of(scenario, parameters, **walks):
        calls.append(("members", len(parameters.mass_scale)))
        return {name: np.full((len(parameters.mass_scale), 1), value) for name, value in PD.items()}

    monkeypatch.setattr(evaluation, "baseline", baseline)
    monkeypatch.setattr(evaluation, "pd_of", pd_of)
    return calls


class Goal:
    """An objective that is all of it."""

    limits = ()

    def score(self, metrics):
        return Score(*[metrics["travel"]] * 3, metrics["travel"] > 0)


def test_the_objective_is_relative_to_pd_alone_or_in_each_member(walked):
    settings = Search(weights={"force_variation": 1.0}, precision="float64", joint_gains=False)
    plain = tune.problem_of(CASE, settings, engine="mjx")
    assert walked == [("alone", "mjx")] and plain.members == 1 and plain.parameters is None and plain.ensemble is None
    assert plain.objective.terms[0].baseline == PD["force_variation"] and plain.objective.worst is None
    assert plain.dtype == np.float64 and plain.space.names == ("damping", "stiffness") and plain.own_objective is None
    how = Ensemble(members=3, worst=Worst(share=0.4))
    drawn = tune.problem_of(CASE, settings, ensemble=how)
    assert walked[1:] == [("members", 3)] and drawn.members == 3 and drawn.ensemble is how
    assert drawn.parameters.mass_scale.shape == (3, 1) and drawn.objective.worst == how.worst
    assert tune.problem_of(CASE, settings, ensemble=how, space=plain.space).space is plain.space


def test_an_objective_of_ones_own_is_a_function_or_all_of_it(walked):
    settings, goal = Search(joint_gains=False), Goal()
    whole = tune.problem_of(CASE, settings, goal, ensemble=Ensemble(members=2))
    assert whole.objective is goal is whole.own_objective and not walked and whole.members == 1

    def own(metrics):
        return metrics["travel"] * 2

    found = tune.problem_of(CASE, settings, own)
    assert isinstance(found.objective, Objective) and found.objective.function is own and found.own_objective is own
    assert found.objective.reference == 2 * PD["travel"]
    bare = tune.without_goal(CASE, settings)
    assert bare.objective is NO_OBJECTIVE and bare.own_objective is None


def test_settings_that_make_no_sense_are_refused_before_pd_walks(walked):
    named = CASE.with_overrides({"own.objective": {"file": "mine.py", "name": "goal"}})
    lacking = METRICS[:-1]
    refused = {
        "own.objective: expected none but in a plain search, got goal": lambda: tune.problem_of(named, Search()),
        "metrics: expected the shipped diverged among them": lambda: tune.problem_of(CASE, Search(), metrics=lacking),
        "search: 'lost' is no metric": lambda: tune.problem_of(CASE, Search(weights={"lost": 1.0})),
        "method: expected cmaes, grid or optuna to search gait.cycle, gait.duty in whole steps, got gradient": lambda:
            tune.problem_of(CASE, Search(also=("gait.duty", "gait.cycle"))),
        "bounds: time_step: expected one short enough for hubrobo_v3_2 with ": lambda:
            tune.problem_of(CASE, Search(joint_gains=True, bounds={"kp": (2e4, 3e4)})),
        "bounds: time_step: expected one": lambda: tune.problem_of(CASE, Search(joint_gains=True, pins={"kd": 50.0})),
        "method: expected own.method in the scenario": lambda: tune.prepare(CASE, Search(method="own"), [1]),
        "method: expected at most 4 numbers to search by grid, got 12": lambda:
            tune.prepare(CASE, Search(method="grid", space="diagonal", joint_gains=False), [1]),
        "starts: expected a population of 2 or more for cmaes, got 1": lambda:
            tune.prepare(CASE, Search(method="cmaes", starts=1), [1]),
    }  # fmt: skip
    for said, call in refused.items():
        with pytest.raises(mc.ConfigError) as found:
            call()
        assert str(found.value).startswith(said), str(found.value)
    assert not walked
    tune.problem_of(CASE, Search(weights={"lost": 1.0}), ensemble=Ensemble(members=2))
    fine = tune.problem_of(CASE, Search(also=("gait.duty",), method="cmaes"))
    assert "gait.duty" in fine.space.names


TABLE = [  # settings, what was chosen, whether thousands walk at once, and the method
    ({}, [], False, "gradient"), ({}, [], True, "cmaes"), ({}, [None, None], True, "cmaes"),
    ({}, [None, 1], True, "gradient"),
    ({"method": "grid"}, [1], True, "grid"), ({"also": ["gait.duty"]}, [], False, "cmaes"),
    ({"also": ["gait.duty"], "pins": {"damping": 1e2, "stiffness": 1e4}}, [], False, "grid"),
    ({"pins": {"damping": 1e2}}, [], True, "gradient"), ({"precision": "float64"}, [], True, "gradient"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "chosen", "many", "method"), TABLE)
def test_the_method_is_the_best_here_where_nobody_says_how(settings, chosen, many, method, monkeypatch):
    """On a machine that walks thousands at once, of times of the gait, of one number."""
    monkeypatch.setattr(execution, "many_at_once", lambda dtype: many and np.dtype(dtype) == np.float32)
    search = Search.make({"joint_gains": False, **settings})
    found = tune.prepare(CASE, search, chosen)
    assert found.search.method == method and found.method is None
    assert found.search == search.model_copy(update={"method": method})


def test_a_robust_search_weighs_pulls_and_searches_the_joint_loop_of_hardware():
    plain, hardware = Ensemble(), Ensemble(hardware=Hardware())
    assert tune.over_ensemble(None, {}, plain) == Search(weights=ROBUST_WEIGHTS)
    assert tune.over_ensemble(None, {"seed": 3}, plain) == Search(weights=ROBUST_WEIGHTS, seed=3)
    assert tune.over_ensemble(Search(), {}, plain) == Search()
    assert tune.over_ensemble(Search(), {}, hardware) == Search(joint_gains=True)
    for given in (True, False):
        assert tune.over_ensemble(Search(joint_gains=given), {}, hardware).joint_gains is given


class Own(Method):
    """A method that asks for the start alone."""

    def run(self, task):
        yield None


def test_methods_go_by_name_class_instance_or_function():
    assert type(method_of("grid")).__name__ == "Grid" and isinstance(method_of(Own), Own)
    own = Own()
    assert method_of(own) is own
    function = method_of(lambda task: iter(()))
    assert isinstance(function, Function)
    assert [*function.run(None)] == []
    search, found = tune.own_method(Search(), CASE, own)
    assert search.method == "own" and found is own
    search, found = tune.own_method(Search(), CASE, "cmaes")
    assert search.method == "cmaes" and found is None
    for wrong in (3, int):
        with pytest.raises(mc.ConfigError, match="expected a name, a Method, or a function of a Task"):
            method_of(wrong)

    class Needs(Own):
        def __init__(self, more):
            self.more = more

    with pytest.raises(mc.ConfigError, match="expected Needs to need no arguments"):
        method_of(Needs)


def test_load_transfer_by_plan_is_a_rival_where_loads_can_be_handed_over(monkeypatch):
    """A time on all feet, or a duty that is searched; and the law reads forces."""
    problem = tune.without_goal(CASE, Search(joint_gains=False))
    searched = tune.without_goal(CASE, Search(also=("gait.duty",), method="cmaes", joint_gains=False))
    for reads in (True, False):
        monkeypatch.setattr(retuned_pd, "reads_forces", lambda _, reads=reads: reads)
        assert (retuned_pd.by_plan(problem) is not None) == reads
        for duty, on_all_feet in ((0.75, False), (0.7501, True), (0.9, True)):
            scenario = CASE.with_overrides({"gait.duty": duty})
            assert retuned_pd.can_plan(dataclasses.replace(problem, scenario=scenario)) == (reads and on_all_feet)
            assert retuned_pd.can_plan(dataclasses.replace(searched, scenario=scenario)) == reads
