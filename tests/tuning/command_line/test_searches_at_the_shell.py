"""The commands that search, from start to end: what they write, that it can be read back, and kills in between."""

import functools
import html
import json
import re

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.scenario.shipped import config_path
from tests.shell import ROOT, finish, killed
from tuning.pages import runs
from tuning.problem import ensemble
from tuning.results import tuned
from tuning.searches.tune import tune

CASE = str(ROOT / "configs" / "case_1_2.yaml")
SHORT = ["--set", "duration=0.3", "--set", "disturbance.cargo.start=0.1"]
ENSEMBLE = ["--ensemble", "ensemble", "--members", "2", "--test-members", "4", "--limit", "base_deviation=1e-4"]
SEARCHES = {  # arguments, and what the result is in
    "tune": (["tune", CASE, *SHORT, "--starts", "2", "--iterations", "3"], "search.nc"),
    "ensemble": (["tune", CASE, *SHORT, *ENSEMBLE, "--starts", "2", "--iterations", "3"], "search.nc"),
    "pareto": (["tune", CASE, *SHORT, "--against", "base_deviation", "--points", "3"], "front.nc"),
    "schedule": (["tune", CASE, *SHORT, "--over", "gravity=0.1,1", "--over", "cargo=0.5"], "schedule.nc"),
}
pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """Return the folder of a search that nothing disturbs; what it prints is in its printed.json."""

    @functools.cache
    def run(search):
        folder = tmp_path_factory.mktemp(search)
        (folder / "printed.json").write_text(finish(*SEARCHES[search][0], "--out", folder, "--json")[0])
        return folder

    return run


@pytest.mark.parametrize("search", SEARCHES)
def test_a_killed_command_goes_on_with_the_same_result(search, quiet, tmp_path):
    """SIGKILL at a random instant once rounds are kept; what the same command ends with is that of a quiet run."""
    (arguments, holds), folder = SEARCHES[search], tmp_path / "killed"
    killed(*arguments, "--out", folder, once=folder, count=2, after=np.random.default_rng().uniform(0, 0.2))
    assert list(folder.glob("parts/part-*.npz"))
    finish(*arguments, "--out", folder)
    with xr.open_dataset(folder / holds) as resumed, xr.open_dataset(quiet(search) / holds) as whole:
        assert set(resumed.variables) == set(whole.variables)
        for name, values in whole.variables.items():
            np.testing.assert_array_equal(resumed[name].values, values.values, err_msg=name)
    assert not (folder / "parts").exists()


def test_a_limit_that_fresh_walks_break_is_named_and_what_the_force_sensor_is_worth(quiet):
    """A tenth of a millimetre is asked of a base that sags further by itself."""
    told = json.loads((quiet("ensemble") / "printed.json").read_text())
    page = (quiet("ensemble") / "report.html").read_text()
    asked = "base deviation at most 0.0001 (set by the user)"
    assert told["robust"]["broken_limits"][asked] == told["pd"]["broken_limits"][asked] == 1.0
    assert f"100.0% of the fresh walks break {asked}" in page
    worth, scores = told["force_sensor"], [told[name]["objective"] for name in ("robust", "retuned_pd", "pd")]
    assert worth["objective"] == pytest.approx(scores[0] / scores[1] - 1) and scores[2] == pytest.approx(1)
    assert worth["in_words"].startswith("4 walks cannot tell what the force sensor is worth: ")
    verdict, *beside = re.findall(r'<p class="verdict">(.*?)</p>|<li>(.*?)</li>', page.partition("<main>")[0])
    best = min(("config", "retuned_pd", "pd"), key=lambda name: told[name]["objective"])
    change = 100 * abs(scores[0] / told[best]["objective"] - 1)
    assert f"objective over 4 unseen walks {scores[0]:.4g}, {change:.1f} % " in verdict[0]
    apart = "; 4 walks do not tell them from retuned_pd."
    assert verdict[0].endswith(f": {told[best]['objective']:.4g}{apart}") and page.count(worth["in_words"][1:40]) == 1
    assert worth["in_words"][1:40] in beside[0][1] and any(f"break {asked}." in line for _, line in beside)
    assert re.search(r"<caption>Gains by axis.*>stiffness<", page.partition('<details class="part">')[0], re.DOTALL)
    (listed,) = runs.below(quiet("ensemble"))
    assert listed.verdict == html.unescape(verdict[0])


def from_python(search, folder):
    scenario = mc.load_scenario(CASE, ["duration=0.3", "disturbance.cargo.start=0.1"])
    if search == "pareto":
        return tuning.pareto(scenario, points=3, out=folder)
    if search == "schedule":
        return tuning.schedule(scenario, gravity=(0.1, 1.0), cargo=(0.5,), out=folder)
    drawn = ensemble.Ensemble.load(config_path("ensemble.yaml"), members=2)
    asked = {"limits": {"base_deviation": 1e-4}, "judges": 4}
    return tuning.robust(scenario, drawn, starts=2, iterations=3, out=folder, **asked)


@pytest.mark.parametrize("search", ["pareto", "schedule", "ensemble"])
def test_a_search_from_python_writes_what_the_command_writes(search, quiet, tmp_path):
    found = from_python(search, tmp_path)
    tuning.write(found, tmp_path)
    shell = quiet(search)
    assert {file.name for file in tmp_path.iterdir()} == {file.name for file in shell.iterdir()} - {"printed.json"}
    for file in tmp_path.glob("*.nc"):
        with xr.open_dataset(file) as ours, xr.open_dataset(shell / file.name) as theirs:
            xr.testing.assert_identical(ours.drop_attrs(), theirs.drop_attrs())
    for name in ("summary.json", "config.yaml", "search.yaml", "ensemble.yaml", "schedule.csv"):
        if (shell / name).exists():
            assert (tmp_path / name).read_text() == (shell / name).read_text(), name


def test_tuned_gains_go_from_file_to_file(quiet, tmp_path):
    """`tune` writes gains that `run` and `sweep` read; its result alone is enough to run the search again."""
    folder = quiet("tune")
    told = json.loads((folder / "printed.json").read_text())
    assert told == json.loads((folder / "summary.json").read_text())
    of_the_best = told["verification"]["metrics"]
    assert told["tuned"]["metrics"] == of_the_best
    assert told["search"]["objective"] < 1 < told["search"]["env_steps"]
    pictures = [f"{name}.png" for name in ("convergence", "path", "walks")]
    for name in (*pictures, "report.html", "config.yaml", "search.yaml", "map.nc"):
        assert (folder / name).stat().st_size > 100, name

    gains = ["--gains", folder / "gains.yaml"]
    run = json.loads(finish("run", CASE, *SHORT, *gains, "--out", tmp_path / "run", "--json")[0])
    grid = ["--stiffness", "1e3:1e5:2", "--damping", "1e2:1e3:2"]
    sweep = json.loads(finish("sweep", CASE, *SHORT, *grid, *gains, "--out", tmp_path / "sweep", "--json")[0])
    for metrics in (run, sweep["gains file"]["metrics"]):
        assert {name: metrics[name] for name in of_the_best} == of_the_best

    stored = tuned.load(folder / "search.nc")
    again = tune(stored.scenario, stored.search)
    np.testing.assert_array_equal(again.gains.stiffness, stored.gains.stiffness)
