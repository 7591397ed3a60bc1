"""The folder of a result: what it holds is said, the parts of the search go, another command's result stays."""

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.files.dataset import OutputError
from tuning.gains import gains_file
from tuning.output import folder, results
from tuning.output.folder import Folder
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.searches.parts import Parts
from tuning.searches.result import Tuned, Written, load


def found_in(scenario):
    """Return a result of two points, the second of which is the better one."""
    columns = {"value": [0.9, 0.8], "penalty": [0.0, 0.0], "feasible": [True, True], "env_steps": [10, 20]}
    data = xr.Dataset({name: ("point", values) for name, values in columns.items()})
    data["theta"] = (("point", "coordinate"), np.log([[1e2, 1e3], [2e2, 2e3]]))
    attrs = {"search": Search(seed=3).to_yaml(), "interrupted": 0, "scenario": scenario.to_yaml()}
    attrs["gains"] = '{"inertia": 1.0, "damping": 200.0, "stiffness": 2000.0}'
    return Tuned(data.assign_attrs(attrs), Problem(scenario), Search(seed=3), gains=mc.Gains(1.0, 2e2, 2e3))


def test_a_folder_names_what_it_holds_and_a_result_comes_back(monkeypatch, tmp_path):
    def tune(found, place, begun):
        place.found(found)
        return folder.Contents(Written(), {"more.txt": "more"})

    monkeypatch.setattr(results, "tune", tune)
    found = found_in(mc.load_scenario("case_1_2"))
    Parts(tmp_path, {"a": 1}).save(0, {"x": np.arange(2)})
    written = Folder(tmp_path, found.FILE).write(found)
    assert set(written.files.split(", ")) == {file.name for file in tmp_path.iterdir()} > {"more.txt"}
    read = load(tmp_path / "search.nc")
    for name in ("scenario", "search", "value", "best_at", "env_steps", "feasible", "interrupted"):
        assert getattr(read, name) == getattr(found, name), name
    assert (read.value, read.best_at, read.env_steps) == (0.8, 20, 20)
    np.testing.assert_array_equal(read.theta, np.log([2e2, 2e3]))
    assert read.gains.stiffness == gains_file.load(tmp_path / "gains.yaml").stiffness == 2e3
    assert "objective 0.8000 (pd: 1)" in (tmp_path / "gains.yaml").read_text()
    with pytest.raises(OutputError, match=r"expected a folder without another command's result, got search\.nc in it"):
        Folder(tmp_path, "sweep.nc")


def test_an_interrupted_result_keeps_its_parts(tmp_path):
    Parts(tmp_path, {"a": 1}).save(0, {"x": np.arange(2)})
    found_in(mc.load_scenario("case_1_2")).write_found(tmp_path)
    assert Parts(tmp_path, {"a": 1}).load(0) is not None and (tmp_path / "gains.yaml").is_file()
