"""Resuming compares all that the result depends on: each field of a search's identity, changed by one, is another."""

import dataclasses
import json

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import LoadTransfer, VirtualModelAdmittance
from mjx_climb.files.dataset import OutputError
from tuning.comparisons import judge
from tuning.methods.method import Function
from tuning.methods.parts import Parts
from tuning.problem import search, spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Objective
from tuning.searches import pareto, schedule, sweep, tune

SHORT = mc.load_scenario("case_1_2", ["duration=0.3"])
PROBLEM, SETTINGS = Problem(SHORT), search.Search()
OTHERS = {  # another value of each setting
    "method": "cmaes", "space": "split", "inertia": True, "also": ("kp",), "joint_gains": True,
    "bounds": {"stiffness": (1.0, 2.0)}, "pins": {"damping": 3.0}, "frozen": ("damping",),
    "weights": {"travel": 1.0}, "limits": {"base_deviation": 0.1}, "deviation_factor": 2.0,
    "no_worse_than_pd": False, "starts": 5, "iterations": 7,
    "seed": 1, "precision": "float64",
}  # fmt: skip
GAINS = mc.Gains(2.0, 1e2, 1e3)
AXES = {"stiffness": np.array([1e3, 1e4]), "damping": np.array([1e2, 1e3])}
METRICS = mc.MetricTable(tuple(mc.METRICS)[:-1])
PARAMETERS = mc.parameters(SHORT)
OF_WALKS = {
    "scenario": SHORT.with_overrides({"contact.damping": 21.0}), "law": LoadTransfer(), "engine": "mjx",
    "metrics": METRICS,
}  # fmt: skip
OF_PROBLEMS = OF_WALKS | {
    "parameters": PARAMETERS.replace({"disturbance.cargo.mass": np.float32(0.7)}),
    "own_objective": lambda metrics: metrics["peak_joint_torque"],
    "own_method": Function(lambda task: iter(())),
    "ensemble": Ensemble(members=2),
}


def swept(problem=PROBLEM, axes=AXES, gains=None, batch_size=4):
    return sweep.grid_of(problem, axes, gains, batch_size).identity()


def judged(problem=PROBLEM, gains=GAINS, name="mine", members=2, seed=0):
    return judge.draw_of(problem, {name: gains}, Ensemble(seed=seed), members).identity()


def tuned(problem=PROBLEM, settings=SETTINGS, **more):
    return tune.search_identity(problem, settings, **more)


class Asked(Exception):
    """A search has said what it is."""


@pytest.fixture
def said(monkeypatch):
    """Return a function that gives the identity by which a search keeps its rounds."""

    class Rounds:
        def __init__(self, in_all, out, identity, progress):
            raise Asked(identity())

    monkeypatch.setattr(pareto, "Rounds", Rounds)
    monkeypatch.setattr(schedule, "Rounds", Rounds)

    def run(call):
        with pytest.raises(Asked) as stopped:
            call()
        return stopped.value.args[0]

    return run


def differ(identities, folder):
    """Check that no two of some identities are the same, and that work of one is not taken for that of another."""
    texts = {name: json.dumps(each) for name, each in identities.items()}
    first, *_ = texts
    Parts(folder, identities[first])
    for name, text in texts.items():
        assert not [other for other, theirs in texts.items() if other != name and theirs == text], name
        if name != first:
            with pytest.raises(OutputError, match="expected no unfinished computation but this one, got another"):
                Parts(folder, identities[name])


def test_every_setting_of_a_search_is_compared(tmp_path):
    assert OTHERS.keys() == search.Search.model_fields.keys()
    each = {name: tuned(settings=search.Search().model_copy(update={name: value})) for name, value in OTHERS.items()}
    differ({"as it is": tuned(), **each}, tmp_path)


def test_every_part_of_a_problem_is_compared(tmp_path):
    """But for what settings say already, which all identities of searches hold: space, objective, precision."""
    known = {"space", "objective", "dtype", "members"}
    assert {field.name for field in dataclasses.fields(Problem)} == OF_PROBLEMS.keys() | known
    changed = {name: tuned(dataclasses.replace(Problem(SHORT), **{name: v})) for name, v in OF_PROBLEMS.items()}
    members = tuned(dataclasses.replace(Problem(SHORT), ensemble=Ensemble(members=3)))
    differ({"as it is": tuned(), "members": members, **changed}, tmp_path)


def test_all_that_a_sweep_walks_is_compared(tmp_path):
    others = OF_WALKS | {"law": VirtualModelAdmittance()}
    walks = {name: swept(dataclasses.replace(Problem(SHORT), **{name: v})) for name, v in others.items()}
    own = {
        "as it is": swept(), "precision": swept(Problem(SHORT, dtype=np.float64)), "batch": swept(batch_size=2),
        "an axis": swept(axes={**AXES, "damping": np.array([1e2, 2e3])}),
        "the order": swept(axes=dict(reversed(AXES.items()))),
        "gains": swept(gains=GAINS), "other gains": swept(gains=mc.Gains(3.0, 1e2, 1e3)),
    }  # fmt: skip
    differ(own | walks, tmp_path)


def test_all_that_judge_walks_is_compared(tmp_path):
    walks = {name: judged(dataclasses.replace(Problem(SHORT), **{name: v})) for name, v in OF_WALKS.items()}
    own = {
        "as it is": judged(), "gains": judged(gains=mc.Gains(2.0, 1e2, 1001.0)), "name": judged(name="other"),
        "members": judged(members=3), "seed": judged(seed=1),
    }  # fmt: skip
    differ(own | {name: walk for name, walk in walks.items() if name != "law"}, tmp_path)


def test_the_front_and_the_operating_points_are_compared(said, tmp_path):
    settings = search.Search()
    problem = dataclasses.replace(Problem(SHORT), space=spaces.space(SHORT, settings), objective=Objective((), ()))
    fronts, points = {"points": 3, "better": "travel", "against": "min_tsm"}, {"gravity": (1.0,), "cargo": (0.0,)}
    assert fronts.keys() == search.Pareto.model_fields.keys() and points.keys() == search.Schedule.model_fields.keys()

    def front(seed=0, **asked):
        seeded = settings.changed({"seed": seed})
        return said(lambda: pareto.run(problem, seeded, search.Pareto(**asked)))

    def scheduled(seed=0, **asked):
        own = schedule.OperatingPoints(problem, settings.changed({"seed": seed}), search.Schedule(**asked), [None])
        return said(lambda: schedule.run(own))

    for name, run, others in (("front", front, fronts), ("schedule", scheduled, points)):
        changed = {key: run(**{key: value}) for key, value in others.items()}
        differ({"as it is": run(), "seed": run(seed=1), **changed}, tmp_path / name)
