"""Every setting of a search changes what is searched: space, objective, precision, rounds, or the first points."""

import dataclasses

import pytest

import mjx_climb as mc
from tuning.methods import Task, method_of
from tuning.problem.objectives import objective
from tuning.problem.search import Search
from tuning.searches import tune

OTHERS = {
    "method": "grid", "space": "split", "inertia": True, "also": ("gait.step_height",), "joint_gains": True,
    "bounds": {"damping": (10.0, 200.0)}, "pins": {"stiffness": 50.0}, "frozen": ("damping",),
    "weights": {"peak_foot_force": 2.0}, "limits": {"base_deviation": 0.01}, "deviation_factor": 2.0,
    "no_worse_than_pd": False, "starts": 5, "iterations": 3, "seed": 7, "precision": "float64",
}  # fmt: skip


def asked(**settings):
    """Return all that a search of these settings asks for until its first points are walked, as text."""
    scenario, search = mc.load_scenario("case_1_2"), Search.make(settings)
    pd = dict.fromkeys(mc.METRICS.names, 1.0) | {"diverged": False}
    problem = tune.without_goal(scenario, search)
    task, method = Task(problem, search, tune.start_of(problem)), method_of(search.method)
    first = next(method.run(task))
    goal = objective(search, pd)
    return repr((dataclasses.astuple(problem.space), goal, problem.dtype, method.rounds(task), first, method.run))


@pytest.mark.parametrize("name", Search.model_fields)
def test_every_setting_changes_what_is_searched(name):
    assert asked() == asked()  # else all would differ
    assert asked(**{name: OTHERS[name]}) != asked()


@pytest.mark.parametrize(
    ("method", "name"),
    [*((m, n) for m in ("gradient", "cmaes") for n in ("starts", "iterations", "seed")), ("grid", "starts")],
)
def test_every_method_reads_the_settings_of_its_rounds(method, name):
    assert asked(method=method, **{name: OTHERS[name]}) != asked(method=method)
