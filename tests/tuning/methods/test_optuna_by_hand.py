"""Which samplers of Optuna are offered, how they are made, and what they ask for: by a stand-in for the library."""

import sys
import types

import numpy as np
import pytest

from mjx_climb.scenario.messages import ConfigError
from tuning.methods.optuna import Optuna
from tuning.problem.search import Search


class Sampler:
    """What it was made with."""

    def __init__(self, **options):
        self.options = options


class TPESampler(Sampler):
    def __init__(self, seed=None, multivariate=False, constant_liar=False):
        super().__init__(seed=seed, multivariate=multivariate, constant_liar=constant_liar)


class NSGAIISampler(Sampler):
    def __init__(self, seed=None, population_size=50):
        super().__init__(seed=seed, population_size=population_size)


class CmaEsSampler(Sampler):
    def __init__(self, seed=None, popsize=None):
        raise ImportError("needs cmaes\nand more")


class EvolutionSampler(Sampler):
    def __init__(self, seed=None, popsize=None):
        super().__init__(seed=seed, popsize=popsize)


class BruteForceSampler(Sampler):
    def __init__(self, seed=None):
        super().__init__(seed=seed)


class GridSampler(Sampler):
    def __init__(self, search_space, seed=None):
        super().__init__()


class SeedlessSampler(Sampler):
    def __init__(self, size=1):
        super().__init__()


@pytest.mark.parametrize("size", [100, 101])
def test_more_than_a_hundred_numbers_are_not_searched(monkeypatch, size):
    monkeypatch.setitem(sys.modules, "optuna", None)
    said = "Optuna to be installed" if size == 100 else "at most 100 numbers"
    with pytest.raises(ConfigError, match=said):
        Optuna().check(types.SimpleNamespace(size=size), Search(method="optuna"))


class Study:
    """Trials that count up from 0 in each of their numbers, in the order of the box; the known ones come first."""

    def __init__(self, sampler):
        self.sampler, self.queue, self.asked, self.told = sampler, [], 0, []

    def enqueue_trial(self, params):
        self.queue.append(params)

    def ask(self, box):
        self.box, number = box, self.asked
        self.asked += 1
        params = self.queue.pop(0) if self.queue else {name: float(number) for name in box}
        return types.SimpleNamespace(params=params, number=number)

    def tell(self, trial, value):
        self.told.append((trial.number, value))


@pytest.fixture
def library(monkeypatch):
    """Return the studies of a stand-in for Optuna."""
    studies = []
    kinds = (TPESampler, NSGAIISampler, CmaEsSampler, EvolutionSampler, BruteForceSampler, GridSampler, SeedlessSampler)
    samplers = types.SimpleNamespace(__all__=[*(kind.__name__ for kind in kinds), "partial"])
    vars(samplers).update({kind.__name__: kind for kind in kinds}, partial=None)
    made = types.ModuleType("optuna")
    made.samplers, made.exceptions = samplers, types.SimpleNamespace(ExperimentalWarning=UserWarning)
    made.logging = types.SimpleNamespace(ERROR=40, set_verbosity=lambda level: studies.append(level))
    made.distributions = types.SimpleNamespace(FloatDistribution=lambda *ends: ends, BaseDistribution=tuple)
    made.create_study = lambda sampler: studies.append(Study(sampler)) or studies[-1]
    monkeypatch.setitem(sys.modules, "optuna", made)
    return studies


@pytest.mark.parametrize(
    ("name", "starts", "options"),
    [("tpe", 5, {"seed": 3, "multivariate": True, "constant_liar": True}), ("nsgaii", 5, {"population_size": 5}),
     ("nsgaii", 1, {"population_size": 2}), ("nsgaii", None, {"population_size": 16}),
     ("evolution", 5, {"popsize": 5}), ("evolution", 1, {"popsize": 2})],
)  # fmt: skip
def test_a_sampler_is_made_with_the_seed_and_one_round_a_generation(library, name, starts, options):
    found = Optuna(sampler=name).made(Search(seed=3, starts=starts))
    assert found.options == {"seed": 3} | options


@pytest.mark.parametrize("name", ["bruteforce", "grid", "seedless", "partial", "mine"])
def test_samplers_of_steps_and_those_that_take_more_than_a_seed_are_not_offered(library, name):
    with pytest.raises(
        ConfigError, match=f"method: expected optuna:SAMPLER, one of tpe, nsgaii, cmaes, evolution, got '{name}'"
    ):
        Optuna(sampler=name).made(Search())


def test_what_is_not_installed_is_said_in_one_line(library, monkeypatch):
    with pytest.raises(ConfigError, match=r"expected what optuna:cmaes needs: needs cmaes$"):
        Optuna(sampler="cmaes").made(Search())
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match="expected Optuna to be installed"):
        Optuna().made(Search())


@pytest.mark.parametrize(("starts", "rounds"), [(3, 2), (None, None)])
def test_batches_of_trials_are_asked_for_and_told_their_merit_until_the_rounds_are_spent(library, starts, rounds):
    space = types.SimpleNamespace(names=("damping", "kp"), lower=np.array([-1.0, 2.0]), upper=np.array([5.0, 9.0]))
    known = np.array([[0.5, 3.0], [1.5, 4.0]])
    search = Search(starts=starts, iterations=rounds, seed=1)
    task = types.SimpleNamespace(problem=types.SimpleNamespace(space=space), search=search, known=known)
    method, merits, asked = Optuna(), iter(range(10_000)), []
    assert method.rounds(task) == (rounds or 40)
    points = method.run(task)
    request = next(points)
    while True:
        asked.append(request)
        found = types.SimpleNamespace(merit=np.array([next(merits) for _ in request.theta], "f4"))
        try:
            request = points.send(found)
        except StopIteration:
            break
    level, study = library
    assert (
        level == 40 and study.sampler.options["seed"] == 1 and study.box == {"damping": (-1.0, 5.0), "kp": (2.0, 9.0)}
    )
    assert [each.theta.shape for each in asked] == [(starts or 16, 2)] * (rounds or 40)
    rows = np.concatenate([each.theta for each in asked])
    np.testing.assert_array_equal(rows, [*known, *([float(n)] * 2 for n in range(2, len(rows)))])
    assert study.told == [(n, float(n)) for n in range(len(rows))]
