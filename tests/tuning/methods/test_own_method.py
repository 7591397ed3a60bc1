"""Methods of the user's own, of `docs/guides/method.md`, and Optuna's samplers by name."""

import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import mjx_climb as mc
from tests.tuning.searches.test_tune import Bowl
from tuning.methods import Method, Request, Task, method_of
from tuning.methods.rounds import follow
from tuning.problem import spaces
from tuning.problem.search import METHODS, OWN_METHOD, Search
from tuning.results import tuned
from tuning.searches.tune import check_method, own_method, run, start_of, tune

SCRIPT = Path(__file__).parents[3] / "docs" / "guides" / "closing_in.py"
NAMED = f"{SCRIPT}:ClosingIn"
SHORT = {"duration": 0.3, "disturbance.cargo.mass": 1.0, "disturbance.cargo.start": 0.05}
HOW = {"starts": 4, "iterations": 3}


@pytest.fixture(scope="module")
def bowl():
    scenario = mc.Scenario()
    return Bowl(scenario, spaces.space(scenario, Search()))


def searched(bowl, method, **settings):
    """Return the points of all requests of a method in a bowl, and the best value."""
    search, requests, values = Search.make(settings), [], []
    method.check(bowl.space, search)

    def evaluate(request):
        requests.append(request.theta)
        answer = bowl.evaluate(request.theta, request.directions)
        values.append(np.nanmin(answer.value, initial=np.inf))
        return answer

    task = Task(bowl, search, start_of(bowl))
    follow(method.run(task), evaluate)
    assert method.rounds(task) in (0, len(requests))
    return requests, min(values)


def test_the_method_of_the_page_finds_the_bottom_of_a_bowl_and_repeats_itself(bowl):
    requests, best = searched(bowl, method_of(NAMED))
    np.testing.assert_array_equal(requests[0][0], start_of(bowl))
    assert best < 0.5 + 0.01
    np.testing.assert_array_equal(requests, searched(bowl, method_of(NAMED))[0])


def bare(task):
    """A method of one line."""
    yield Request(task.start[None], None, "")


@dataclasses.dataclass(frozen=True)
class Once(Method):
    """A method with a setting of its own."""

    factor: float = 1.0

    def run(self, task):
        yield Request(self.factor * task.start[None], None, "once")


class Needing(Method):
    def __init__(self, size):
        self.size = size

    def run(self, task):
        yield from ()


INSTANCE = Once(0.9)


@pytest.mark.parametrize(("name", "factor"), [("bare", 1.0), ("Once", 1.0), ("INSTANCE", 0.9)])
def test_a_class_an_instance_or_a_function_is_a_method(bowl, name, factor):
    requests, _ = searched(bowl, method_of(f"{__file__}:{name}"))
    np.testing.assert_allclose(requests[0][0], factor * start_of(bowl))


@pytest.mark.parametrize(
    ("named", "said"),
    [
        (f"{__file__}:HOW", "method: expected a name, a Method, or a function of a Task, got"),
        (f"{__file__}:Needing", "method: expected Needing to need no arguments: "),
        (f"{__file__}:Nobody", "expected a method named Nobody, got none"),
        ("nothing.py:Method", "nothing.py: expected a file of Python, got none"),
    ],
)
def test_what_is_no_method_is_refused_in_one_line(named, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)) as refused:
        method_of(named)
    assert "\n" not in str(refused.value)


def nothing(task):
    yield from ()


def listing(task):
    return [Request(task.start[None], None, "")]


def failing(task):
    raise KeyError("no such thing\nand more")


def later(task):
    yield Request(task.start[None], None, "")
    return task.nothing


def ending(task):
    yield Request(task.start[None], None, "")
    sys.exit(3)


def asking_for_none(task):
    yield Request(task.start[None], None, "")
    yield None


class Refusing(Once):
    def check(self, space, search):
        raise mc.ConfigError("method: expected a smaller space")


class Unchecked(Once):
    def check(self, space, search):
        sys.exit()


@pytest.mark.parametrize(
    ("method", "said"),
    [
        (nothing, "method nothing: expected at least one Request of points, got none"),
        (listing, "method listing: expected a generator of Requests, got list"),
        (failing, "method failing: KeyError: 'no such thing\\nand more'"),
        (later, "method later: AttributeError: 'Task' object has no attribute 'nothing'"),
        (ending, "method ending: SystemExit: 3"),
        (asking_for_none, "method: expected a Request of finite theta (B, 2), got a NoneType"),
        (Refusing, "method: expected a smaller space"),
        (Unchecked, "method: SystemExit: "),
    ],
)
def test_a_method_that_fails_is_refused_in_one_line(bowl, method, said, tmp_path):
    own = method_of(method)
    problem = dataclasses.replace(bowl, own_method=own)
    with pytest.raises(mc.ConfigError, match=f"^{re.escape(said)}$"):
        check_method(Search(method=OWN_METHOD), own, bowl.space)
        run(problem, Search(method=OWN_METHOD), out=tmp_path)


def test_a_search_by_a_method_of_ones_own_has_each_of_its_points(bowl):
    found = run(dataclasses.replace(bowl, own_method=method_of(bare)), Search(method=OWN_METHOD))
    np.testing.assert_array_equal(found.data["theta"], start_of(bowl)[None])


def test_settings_and_scenario_name_a_method_of_ones_own(tmp_path):
    scenario = mc.Scenario()
    assert [own_method(Search(method=name), scenario)[1] for name in METHODS] == [None] * len(METHODS)
    settings, own = own_method(Search(method=NAMED), scenario)
    assert settings.method == OWN_METHOD and type(own).__name__ == "ClosingIn"
    named = scenario.with_overrides({"own": {"method": {"file": str(SCRIPT), "name": "ClosingIn"}}})
    assert type(own_method(settings, named)[1]).__name__ == "ClosingIn"
    gone = scenario.with_overrides({"own": {"method": {"name": "ClosingIn"}}})
    with pytest.raises(mc.ConfigError, match=r"own\.method\.file: .* ClosingIn was defined in a session"):
        own_method(settings, gone)


@pytest.mark.slow
@pytest.mark.nightly
def test_searched_at_the_shell_and_repeated_from_the_folder(tmp_path, call, monkeypatch):
    """Its folder holds the file; the commands of the folder find it there, and pd is searched by it too."""
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "short.yaml"
    config.write_text(mc.load_scenario("case_1_2", SHORT).to_yaml())
    own = tmp_path / "mine.py"
    own.write_text(SCRIPT.read_text())
    asked = ["--starts", "4", "--iterations", "3", "--json"]
    code, out, err = call("tune", config, "--method", "mine.py:ClosingIn", *asked)
    assert code == 0, err
    folder = tmp_path / "results" / "short-tune-ClosingIn-isotropic"
    data = tuned.load(folder / "search.nc").data
    assert set(data["phase"].values) == {"closing in"} and data.sizes["point"] == 12
    assert "ClosingIn, isotropic" in (folder / "gains.yaml").read_text()
    assert yaml.safe_load((folder / "search.yaml").read_text())["method"] == OWN_METHOD
    named = yaml.safe_load((folder / "config.yaml").read_text())["own"]["method"]
    assert named["file"] == "inputs/method/mine.py" and named["name"] == "ClosingIn"
    own.unlink()
    monkeypatch.chdir(folder)
    code, again, err = call("tune", "config.yaml", "--search", "search.yaml", "--out", "again", "--json")
    assert code == 0, err
    first, second = (json.loads(text)["tuned"]["gains"] for text in (out, again))
    assert first == second
    (folder / "inputs" / "method" / "mine.py").write_text(SCRIPT.read_text().replace("0.8", "0.7"))
    code, _, err = call("tune", "config.yaml", "--search", "search.yaml", "--out", "other")
    assert code == 2 and "own.method.digest: expected" in err and err.count("\n") == 1
    code, _, err = call("run", "config.yaml", "--out", "walk")  # what walks does not ask for it
    assert code == 0, err


def test_optuna_that_is_not_installed_is_refused_before_anything_walks(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    for method in ("optuna", "optuna:nsgaii"):
        with pytest.raises(mc.ConfigError, match=r"^method: expected Optuna to be installed: pip install"):
            tune(mc.load_scenario("case_1_2"), method=method)


@pytest.mark.parametrize("sampler", ["tpe", "nsgaii", "random", "cmaes", "qmc"])
def test_a_sampler_of_optuna_by_its_name(bowl, sampler):
    pytest.importorskip("optuna")
    requests, best = searched(bowl, method_of(f"optuna:{sampler}"), starts=8, iterations=30)
    assert np.shape(requests) == (30, 8, 2) and best < 0.5 + 0.1
    np.testing.assert_array_equal(requests[0][0], start_of(bowl))
    for request in requests:
        assert (request >= bowl.space.lower).all() and (request <= bowl.space.upper).all()
    np.testing.assert_array_equal(requests, searched(bowl, method_of(f"optuna:{sampler}"), starts=8, iterations=30)[0])


def test_cmaes_draws_about_the_best_of_its_first_points(bowl):
    """Whichever that is, here the one nearest to the middle of the box."""
    requests = []

    def evaluate(request):
        requests.append((request.theta - bowl.space.lower) / (bowl.space.upper - bowl.space.lower))
        worth = abs(requests[0] - 0.5).max(1)
        return bowl.evaluate(request.theta)._replace(value=worth, penalty=0 * worth)

    settings = Search.make({"method": "cmaes", "starts": 600, "iterations": 2})
    follow(method_of("cmaes").run(Task(bowl, settings, start_of(bowl))), evaluate)
    first, second = requests
    assert min(map(np.min, requests)) >= 0 and max(map(np.max, requests)) <= 1
    best = first[abs(first - 0.5).max(1).argmin()]
    np.testing.assert_allclose(np.median(second, axis=0), best, atol=0.05)
    np.testing.assert_allclose(np.std(second, axis=0), 0.2, rtol=0.15)
    assert abs(best - first[0]).max() > 0.1


@pytest.mark.parametrize("sampler", ["nothing", "grid", "partialfixed", "base", "bruteforce"])
def test_samplers_that_need_more_than_a_seed_are_refused(bowl, sampler):
    pytest.importorskip("optuna")
    with pytest.raises(mc.ConfigError, match=rf"^method: expected optuna:SAMPLER, one of .*nsgaii.*, got '{sampler}'$"):
        method_of(f"optuna:{sampler}").check(bowl.space, Search())


def test_each_sampler_that_is_offered_can_be_asked_for_gains(bowl):
    """Optuna's new ones too; one that needs another package may say so."""
    pytest.importorskip("optuna")
    with pytest.raises(mc.ConfigError) as refused:
        method_of("optuna:nothing").check(bowl.space, Search())
    offered = re.search("one of (.*), got", str(refused.value))[1].split(", ")
    assert {"tpe", "cmaes"} < {*offered}
    for name in offered:
        method = method_of(f"optuna:{name}")
        try:
            method.check(bowl.space, Search())
        except mc.ConfigError as error:
            assert f"expected what optuna:{name} needs" in str(error)
            continue
        assert next(method.run(Task(bowl, Search(), start_of(bowl)))).theta.shape == (16, 2)
