"""Searches where a GPU's kernel walks thousands: which method, how many points, and when they are done."""

import functools
import subprocess
import sys
import types

import numpy as np
import pytest
from cmaes import CMA

import mjx_climb as mc
import tuning
from mjx_climb import execution
from tuning.methods import Task, cmaes
from tuning.methods.rounds import follow
from tuning.problem.ensemble import Ensemble
from tuning.problem.search import Search
from tuning.searches import tune

SIZE = 6
BOTTOM = np.linspace(0.2, 0.8, SIZE)


@pytest.fixture
def kernel(monkeypatch):
    """Have the searches believe that there is a GPU whose kernel walks."""
    monkeypatch.setattr(execution, "many_at_once", lambda dtype: np.dtype(dtype) == np.float32, raising=False)


def task(search, members=1):
    space = types.SimpleNamespace(size=SIZE, lower=np.zeros(SIZE), upper=np.ones(SIZE))
    problem = types.SimpleNamespace(space=space, members=members, engine="limb", dtype=np.float32)
    return Task(problem, search, np.full(SIZE, 0.5))


def searched(task):
    """Run CMA-ES over a valley whose axes differ a hundredfold; return sizes and best value of the generations."""
    merits = []

    def evaluate(request):
        merits.append((np.geomspace(0.1, 10.0, SIZE) * (request.theta - BOTTOM) ** 2).sum(1))
        return types.SimpleNamespace(merit=merits[-1])

    follow(cmaes.METHOD.run(task), evaluate)
    return [merit.size for merit in merits], [merit.min() for merit in merits]


def test_many_points_go_to_the_bottom_and_end_there(kernel):
    sizes, best = searched(task(Search()))
    assert set(sizes) == {cmaes.OF_MANY * SIZE}
    assert cmaes.PATIENCE < len(sizes) < cmaes.MANY / 2
    assert best[-1] < 1e-4 < best[0]


@pytest.mark.parametrize("starts", [2, 3])
def test_the_smallest_generations_go_down_without_a_warning(starts):
    sizes, best = searched(task(Search(starts=starts, iterations=100)))
    assert set(sizes) == {starts} and min(best) < 0.1 * best[0]


@pytest.mark.parametrize(
    ("start", "size", "slope"),
    [(0.5, 40, 1.0), (0.1, 40, 1.0), (0.5, 2, 1.0), (0.5, 3, 1.0), (0.5, 40, 0.0)],
)  # 0.1: most points out of the bounds are drawn again; without a slope the package stops after some generations
def test_a_generation_is_what_the_package_draws_and_learns_point_by_point(start, size, slope):
    """Through generations, of the same seed: to rounding."""
    with np.errstate(divide="ignore"):
        mine, theirs = (
            CMA(np.full(SIZE, start), 0.2, np.tile([0.0, 1.0], (SIZE, 1)), seed=3, population_size=size)
            for _ in range(2)
        )
    for _ in range(20):
        points = cmaes.drawn(mine)
        one_by_one = np.array([theirs.ask() for _ in range(size)])
        if size == 40:  # a covariance moved by its path alone has equal eigenvalues, whose axes are anyone's
            np.testing.assert_allclose(points, one_by_one, rtol=0, atol=1e-10)
        merits = slope * ((one_by_one - 0.3) ** 2).sum(1).round(2)
        cmaes.tell(mine, one_by_one, merits)
        theirs.tell(list(zip(one_by_one, merits.tolist(), strict=True)))
        for name in ("_mean", "_sigma", "_C", "_pc", "_p_sigma"):
            np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-9, atol=1e-12)
        assert mine.should_stop() == theirs.should_stop()
    assert mine.should_stop() == (slope == 0)


@pytest.mark.parametrize(("seed", "known"), [(3, 0), (4, 2), (5, 40)])
def test_generations_are_the_packages_from_the_best_of_the_first_points_on(seed, known):
    """The known ones, as many as there is room for, and others spread about the start over a fifth of the box."""
    rng, count, low, width = np.random.default_rng(seed + 9), 12, np.linspace(-2, 0, SIZE), np.linspace(1.0, 4.0, SIZE)
    own = task(Search(starts=count, iterations=4, seed=seed))
    own.problem.space.lower, own.problem.space.upper = low, low + width
    own = own._replace(start=low + 0.3 * width, others=low + width * rng.uniform(size=(known, SIZE)))
    asked = []

    def evaluate(request):
        asked.append((request.theta - low) / width)
        assert request.directions is None
        return types.SimpleNamespace(merit=((asked[-1] - BOTTOM) ** 2).sum(1))

    follow(cmaes.METHOD.run(own), evaluate)
    first = np.clip(0.3 + 0.2 * np.random.default_rng(seed).standard_normal((count, SIZE)), 0, 1)
    first[: 1 + known] = ((own.known - low) / width)[:count]
    mean = min(first, key=lambda point: ((point - BOTTOM) ** 2).sum())
    theirs = CMA(mean, 0.2, np.tile([0.0, 1.0], (SIZE, 1)), seed=seed, population_size=count)
    wanted = [first]
    for _ in range(3):
        wanted.append(cmaes.drawn(theirs))
        theirs.tell([(point, float(((point - BOTTOM) ** 2).sum())) for point in wanted[-1]])
    np.testing.assert_allclose(asked, wanted, atol=1e-12)


@pytest.mark.parametrize(("apart", "ends"), [(0.9e-4, True), (1.1e-4, False)])
def test_generations_whose_best_hardly_differ_are_the_last_where_a_kernel_walks(kernel, apart, ends):
    """The best of ten, whatever the others are worth."""
    generations = 0

    def evaluate(request):
        nonlocal generations
        generations += 1
        merit = np.random.default_rng(generations).uniform(2, 9, len(request.theta))
        merit[0] = 1 + apart * (generations % 2)
        return types.SimpleNamespace(merit=merit)

    follow(cmaes.METHOD.run(task(Search(iterations=30))), evaluate)
    assert generations == (1 + 10 if ends else 30)


def test_points_that_no_draw_puts_between_the_bounds_are_taken_there(monkeypatch):
    monkeypatch.setattr(cmaes, "TRIES", 1)
    optimizer = CMA(np.full(SIZE, 0.01), 1.0, np.tile([0.0, 1.0], (SIZE, 1)), seed=3, population_size=40)
    points = cmaes.drawn(optimizer)
    assert points.shape == (40, SIZE) and points.min() == 0 and points.max() == 1


def test_members_and_settings_say_how_many(kernel):
    assert cmaes.population(task(Search(), members=512)) == cmaes.WALKS // 512
    assert cmaes.population(task(Search(), members=10**6)) == 9  # the package's own
    assert cmaes.population(task(Search(starts=5))) == 5
    assert cmaes.METHOD.rounds(task(Search(iterations=3))) == 3


def test_without_a_kernel_all_is_the_packages(cpu_alone):
    sizes, _ = searched(task(Search()))
    assert set(sizes) == {9}
    assert len(sizes) == cmaes.GENERATIONS


def test_the_method_that_suits_the_machine(kernel, case):
    scenario = case("case_1_2", "virtual_model")
    assert tune.prepare(scenario, Search()).search.method == "cmaes"
    assert tune.prepare(scenario, Search(precision="float64")).search.method == "gradient"
    one = Search(pins={"damping": 100.0})
    assert tune.prepare(scenario, one).search.method == "gradient"


@pytest.mark.parametrize("robust", [False, True])
def test_a_chosen_method_stays(kernel, monkeypatch, robust):
    """By the one rule that the command has too: settings or a method that are given, and nothing else, choose."""

    def run(problem, search, *_, **__):
        pytest.fail(f"asked for {search.method}")

    monkeypatch.setattr(tune, "run", run)
    monkeypatch.setattr(tune, "problem_of", lambda *_, **__: None)
    search = functools.partial(tuning.robust, ensemble=Ensemble(members=2)) if robust else tuning.tune
    given = {"method": "gradient"}, {"search": Search()}
    for settings, expected in (({}, "cmaes"), ({"space": "split"}, "cmaes"), *((each, "gradient") for each in given)):
        with pytest.raises(pytest.fail.Exception, match=expected):
            search(mc.load_scenario("case_1_2"), **settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [
        "import tuning.searches.tune",
        *(pytest.param(n, marks=pytest.mark.nightly) for n in ("import tuning", "from tuning import tune")),
    ],
)
def test_the_search_is_a_call_of_the_package(first):
    """Whatever is imported first."""
    code = f"{first}\nimport tuning\nfrom tuning import tune\nfrom mjx_climb import load_scenario\n"
    code += "scenario = load_scenario('case_1_2')\ntry: tuning.tune(scenario, method='none')\n"
    code += "except Exception as error: print(type(error).__name__)\nprint(callable(tune))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["ConfigError", "True"], done.stderr
