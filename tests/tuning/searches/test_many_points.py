"""Searches where a GPU's kernel walks thousands: which method, how many points, and when they are done."""

import types

import numpy as np
import pytest
from cmaes import CMA

import mjx_climb as mc
from tuning.problem.search import Search
from tuning.searches import tune
from tuning.searches.methods import cma_es
from tuning.searches.methods.task import Task

SIZE = 6
BOTTOM = np.linspace(0.2, 0.8, SIZE)


@pytest.fixture
def kernel(monkeypatch):
    """Have the searches believe that there is a GPU whose kernel walks."""
    for module in (cma_es, tune):
        monkeypatch.setattr(module, "kernel_pays", lambda engine, dtype: np.dtype(dtype) == np.float32)


def task(search, members=1):
    space = types.SimpleNamespace(size=SIZE, lower=np.zeros(SIZE), upper=np.ones(SIZE))
    problem = types.SimpleNamespace(space=space, members=members, engine="limb", dtype=np.float32)
    return Task(problem, search, np.full(SIZE, 0.5))


def searched(task):
    """Run CMA-ES over a valley whose axes differ a hundredfold; return sizes and best value of the generations."""
    points, weights = cma_es.run(task), np.geomspace(0.1, 10.0, SIZE)
    request, sizes, best = next(points), [], []
    try:
        while True:
            merit = (weights * (request.theta - BOTTOM) ** 2).sum(1)
            sizes.append(len(merit))
            best.append(merit.min())
            request = points.send(types.SimpleNamespace(merit=merit))
    except StopIteration:
        return sizes, best


def test_many_points_go_to_the_bottom_and_end_there(kernel):
    sizes, best = searched(task(Search()))
    assert set(sizes) == {cma_es.OF_MANY * SIZE}
    assert cma_es.PATIENCE < len(sizes) < cma_es.MANY / 2
    assert best[-1] < 1e-4 < best[0]


@pytest.mark.parametrize("start", [0.5, 0.1])  # most points out of the bounds are drawn again
def test_a_generation_is_what_the_package_draws_one_by_one(start):
    """Through generations, of the same seed: to rounding."""
    mine, theirs = (
        CMA(np.full(SIZE, start), 0.2, np.tile([0.0, 1.0], (SIZE, 1)), seed=3, population_size=40) for _ in range(2)
    )
    for _ in range(5):
        points = cma_es.drawn(mine)
        one_by_one = np.array([theirs.ask() for _ in range(40)])
        np.testing.assert_allclose(points, one_by_one, rtol=0, atol=1e-12)
        for optimizer in (mine, theirs):
            optimizer.tell([(point, float(((point - 0.3) ** 2).sum())) for point in one_by_one])


def test_points_that_no_draw_puts_between_the_bounds_are_taken_there(monkeypatch):
    monkeypatch.setattr(cma_es, "TRIES", 1)
    optimizer = CMA(np.full(SIZE, 0.01), 1.0, np.tile([0.0, 1.0], (SIZE, 1)), seed=3, population_size=40)
    points = cma_es.drawn(optimizer)
    assert points.shape == (40, SIZE) and points.min() == 0 and points.max() == 1


def test_members_and_settings_say_how_many(kernel):
    assert cma_es.population(task(Search(), members=512)) == cma_es.WALKS // 512
    assert cma_es.population(task(Search(), members=10**6)) == 9  # the package's own
    assert cma_es.population(task(Search(starts=5))) == 5
    assert cma_es.rounds(task(Search(iterations=3))) == 3


def test_without_a_kernel_all_is_the_packages():
    sizes, _ = searched(task(Search()))
    assert set(sizes) == {9}
    assert len(sizes) == cma_es.GENERATIONS


def test_the_method_that_suits_the_machine(kernel, case):
    scenario = case("case_1_2", "virtual_model")
    assert tune.for_this_machine(scenario, Search()).method == "cmaes"
    assert tune.for_this_machine(scenario, Search(precision="float64")).method == "gradient"
    one = Search(pins={"damping": 100.0})
    assert tune.for_this_machine(scenario, one).method == "gradient"


def test_a_chosen_method_stays(kernel, monkeypatch):
    asked = []
    monkeypatch.setattr(tune, "problem_of", lambda scenario, search, *_, **__: asked.append(search.method))
    monkeypatch.setattr(tune, "run", lambda *_, **__: None)
    scenario = mc.load_scenario("case_1_2")
    for settings in ({}, {"method": "gradient"}, {"search": Search()}):
        tune.tune(scenario, **settings)
    assert asked == ["cmaes", "gradient", "gradient"]
