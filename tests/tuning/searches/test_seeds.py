"""One search from several seeds: the best is taken, and how far they agree is said."""

import numpy as np
import pytest
import xarray as xr

from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.results import tuned


def search(seed, value, gains, *, feasible=True):
    """A search of a stiffness, by its logarithm, and a duty, by its unit, that evaluated one point."""
    theta = [[np.log(gains[0]), gains[1]]]
    one = {"value": [value], "penalty": [0.0 if feasible else 1.0], "feasible": [feasible]}
    data = {name: ("point", each) for name, each in one.items()} | {"theta": (("point", "coordinate"), theta)}
    data["unit"] = ("coordinate", [0.0, 0.1])
    names = {"coordinate": ["stiffness", "gait.duty"]}
    return tuned.Tuned(xr.Dataset(data, names), Problem(None), Search(seed=seed))


def test_the_best_of_several_seeds_is_taken_and_their_agreement_said():
    each = search(0, 0.75, (1e3, 0.8)), search(1, 0.7, (2e3, 0.9)), search(2, 0.6, (9e2, 0.8), feasible=False)
    best = tuned.of_seeds(each)
    assert (best.search.seed, best.value) == (1, 0.7)
    assert best.data.attrs[tuned.AGREEMENT] == (
        "3 seeds end at objectives of 0.6000 to 0.7500, their gains at most a factor of 2.22 apart (stiffness); "
        "1 of them break a limit"
    )
    assert "break" not in tuned.of_seeds(each[:2]).data.attrs[tuned.AGREEMENT]
    assert tuned.AGREEMENT not in each[1].data.attrs


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
    assert not (tmp_path / "out" / "parts").exists()
