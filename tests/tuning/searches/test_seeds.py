"""One search from several seeds: the best is taken, and how far they agree is said."""

import dataclasses

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import LoadTransfer
from tuning.methods.rounds import Progress
from tuning.problem import spaces
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.results import tuned
from tuning.searches import retuned_pd, tune


def search(seed, value, gains, penalty=0.0):
    """A search of a stiffness, by its logarithm, and a duty, by its unit, that evaluated one point."""
    theta = [[np.log(gains[0]), gains[1]]]
    one = {"value": [value], "penalty": [penalty], "feasible": [not penalty]}
    data = {name: ("point", each) for name, each in one.items()} | {"theta": (("point", "coordinate"), theta)}
    data |= {"unit": ("coordinate", [0.0, 0.1]), "phase": ("point", ["population"])}
    names = {"coordinate": ["stiffness", "gait.duty"]}
    return tuned.Tuned(xr.Dataset(data, names, {"interrupted": 0}), Problem(None), Search(seed=seed))


def test_the_best_of_several_seeds_is_taken_and_their_agreement_said():
    each = search(0, 0.75, (1e3, 0.8)), search(1, 0.7, (2e3, 0.9)), search(2, 0.6, (9e2, 0.8), penalty=1.0)
    best = tuned.of_seeds(each)
    assert (best.value, best.seeds, each[0].seeds, best.interrupted) == (0.7, 3, 1, False)
    # where the user ends a search it is the last, and not always the best
    ended = dataclasses.replace(each[2], data=each[2].data.assign_attrs(interrupted=1))
    assert tuned.of_seeds([*each[:2], ended]).interrupted
    # a search that breaks a limit has found nothing
    assert best.ends == [0.75, 0.7, np.inf] and each[0].ends == [0.75]
    assert best.data.attrs[tuned.AGREEMENT] == (
        "3 seeds end at objectives of 0.6000 to 0.7500, the best is of seed 1, their gains at most a factor of 2.22 "
        "apart (stiffness); 1 of them break a limit"
    )
    assert "break" not in tuned.of_seeds(each[:2]).data.attrs[tuned.AGREEMENT]
    assert tuned.AGREEMENT not in each[1].data.attrs


def test_a_result_is_the_points_that_were_evaluated_and_the_best_of_them(tmp_path):
    """Of a law of one's own, whose gains its file names again; over an ensemble with that."""
    law, ensemble, settings = LoadTransfer(), Ensemble(members=3), Search(seed=2, method="cmaes")
    problem = Problem(mc.load_scenario("case_1_2"), spaces.space(mc.load_scenario("case_1_2"), settings, law), law=law)
    with pytest.raises(ValueError, match="expected a point that was evaluated, got none"):
        tuned.from_rounds(problem, settings, {}, interrupted=True)
    arrays = {"value": [0.9, 0.8, 0.7], "penalty": [0.0, 0.0, 1.0], "feasible": [True, True, False]}
    arrays |= {"env_steps": [10, 20, 30], "force_variation": [9.0, 8.0, 7.0]}
    arrays = {name: np.array(each) for name, each in arrays.items()}
    arrays |= {"phase": np.array(["population"] * 3), "theta": np.ones((3, problem.space.size))}
    for with_them in (None, ensemble):
        own = dataclasses.replace(problem, ensemble=with_them)
        found = tuned.from_rounds(own, settings, arrays, interrupted=True)
        assert type(found) is (tuned.Tuned if with_them is None else tuned.Robust) and found.ensemble is with_them
        assert (found.value, found.best_at, found.env_steps, found.metrics) == (0.8, 20, 30, {"force_variation": 8.0})
        assert (found.search, found.problem, found.interrupted) == (settings, own, True)
        said = "mjx-climb tune mine --ensemble: cmaes, isotropic, 3 members" if with_them else (
            "mjx-climb tune mine: cmaes, isotropic"
        )  # fmt: skip
        assert found.comment("mine") == f"{said}, objective 0.8000 (pd: 1)"
        assert found.data.attrs["law"] == "LoadTransfer" and type(found.law) is LoadTransfer
    file = found.save(tmp_path / "search.nc")
    again = tuned.load(file, law)
    assert again.gains == found.gains and again.search == settings
    with pytest.raises(mc.ConfigError, match="law: expected gains of the config's law, got those of LoadTransfer"):
        tuned.load(file)


def test_the_settings_of_several_seeds_are_those_that_repeat_them_all():
    best = tuned.of_seeds([search(3, 0.75, (1e3, 0.8)), search(4, 0.7, (2e3, 0.9))])
    assert best.value == 0.7 and best.search == Search(seed=3)
    assert Search.parse(best.data.attrs["search"], "search.nc") == Search(seed=3)


def test_where_no_seed_keeps_the_limits_the_nearest_to_them_is_taken():
    """As of the points of one search."""
    each = search(0, 0.9, (1e3, 0.8), penalty=0.1), search(1, 0.6, (2e3, 0.9), penalty=2.0)
    assert tuned.of_seeds(each).value == 0.9


def test_pd_is_searched_from_as_many_seeds(monkeypatch, tmp_path):
    """And the best of them counts, each with its rounds in a folder of its own."""
    values, asked = {5: 0.8, 6: 0.7, 7: 0.75}, []

    def found(problem, settings, *, out, progress):
        asked.append((settings.seed, out.name))
        return search(settings.seed, values[settings.seed], (1e3, 0.8))

    monkeypatch.setattr(tune, "run", found)
    settings = Search(seed=5)
    problem = Problem(mc.load_scenario("case_1_2"), space=spaces.space(mc.load_scenario("case_1_2"), settings))
    again = retuned_pd.search(problem, settings, seeds=3, out=tmp_path)
    assert asked == [(5, "retuned_pd"), (6, "seed-6"), (7, "seed-7")]
    assert (again.value, again.search.seed) == (0.7, 5)


def test_where_the_user_stops_a_seed_the_best_so_far_is_given(monkeypatch):
    """And the rounds of all seeds are counted."""
    told = []

    def stopped_in_the_second(problem, settings, *, out, progress):
        for number in (1, 2):
            progress(Progress(number, 2, "points", *[0] * 5, walked=True))
        one = search(settings.seed, {5: 0.8, 6: 0.9}[settings.seed], (1e3, 0.8))
        return dataclasses.replace(one, data=one.data.assign_attrs(interrupted=settings.seed - 5))

    monkeypatch.setattr(tune, "run", stopped_in_the_second)
    best = tune.from_seeds(Problem(None), Search(seed=5), 3, out=None, progress=told.append)
    assert (best.value, best.seeds, best.interrupted) == (0.8, 2, True)
    assert [f"{now.phase} {now.rounds}/{now.rounds_in_all}" for now in told] == [
        "seed 5, points 1/6", "seed 5, points 2/6", "seed 6, points 3/6", "seed 6, points 4/6",
    ]  # fmt: skip


def test_a_grid_has_no_seeds(call, tmp_path):
    code, out, err = call("tune", "case_1_2", "--method", "grid", "--seeds", "2", "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert err == "mjx-climb: error: --seeds: expected 1 of a grid, which draws nothing, got 2\n"


@pytest.mark.nightly
@pytest.mark.slow
def test_tune_searches_from_several_seeds(call, tmp_path):
    short = ("--set", "duration=0.3", "--starts", "4", "--iterations", "2", "--method", "cmaes", "--space", "split")
    code, out, _ = call("tune", "case_1_2", *short, "--seeds", "2", "--out", tmp_path / "out")
    assert code == 0 and "2 seeds end at objectives of" in out
    assert "--search search.yaml --seeds 2 --out again" in (tmp_path / "out" / "report.html").read_text()
    assert not (tmp_path / "out" / "parts").exists()
