"""Pictures drawn again from a folder: chosen metrics, formats, size and style; one line for what cannot be."""

import json

import numpy as np
import pytest
import xarray as xr
from PIL import Image

import mjx_climb as mc
from mjx_climb import child_process
from mjx_climb.files import dataset
from tuning.pages import redrawn


@pytest.fixture
def plot(call):
    def run(*arguments):
        code, out, err = call("plot", *arguments)
        return code, [line.rpartition("/")[2] for line in out.split()], err.strip()

    return run


@pytest.fixture
def folder(tmp_path):
    """The grid and the table of a sweep."""
    axes = {"stiffness": [1e2, 1e3, 1e4], "damping": [1e1, 1e2]}
    about = {"units": "N", "long_name": "peak foot force", "larger_is_better": 0}
    forces = xr.DataArray(np.arange(6.0).reshape(3, 2) + 1, axes, list(axes), attrs=about)
    failed = xr.zeros_like(forces, bool).drop_attrs()
    dataset.save(xr.Dataset({"peak_foot_force": forces, "diverged": failed}), tmp_path / "sweep.nc")
    gains = {"inertia": 1.0, "damping": 50.0, "stiffness": 5e3}
    table = {
        "config": {"gains": gains, "metrics": {"peak_foot_force": 2.0}},
        "pd": {"gains": None, "metrics": {"peak_foot_force": 4.0}},
        "grid": {"walks": 6},
    }
    (tmp_path / "comparison.json").write_text(json.dumps(table))
    return tmp_path


def test_a_metric_is_drawn_as_it_is_asked_for(plot, folder, tmp_path):
    (tmp_path / "large.mplstyle").write_text("axes.labelsize: 20")
    out = tmp_path / "out"
    asked = (
        "--metric",
        "peak_foot_force",
        "--figures",
        "png,svg",
        "--figure-size",
        "100x80",
        "--dpi",
        127,
        "--out",
        out,
    )
    assert plot(folder, *asked) == (0, ["maps-peak_foot_force.png", "maps-peak_foot_force.svg"], "")
    with Image.open(out / "maps-peak_foot_force.png") as picture:
        assert picture.size == (500, 400)
    plain = (out / "maps-peak_foot_force.svg").read_text()
    assert plot(folder, *asked, "--style", tmp_path / "large.mplstyle")[0] == 0
    assert (out / "maps-peak_foot_force.svg").read_text() != plain
    assert plot(folder) == (0, ["maps.png"], "") and (folder / "maps.png").is_file()


def test_pd_is_marked_on_the_colours_of_a_map_that_is_drawn_again(folder):
    ((_, figure),) = redrawn.figures(folder, ["peak_foot_force"])
    (mark,) = figure.findobj(lambda artist: artist.get_gid() == "baseline")
    assert list(mark.get_ydata()) == [4.0, 4.0]


def test_a_metric_that_is_not_there_gets_one_line(plot, folder):
    code, out, err = plot(folder, "--metric", "speed")
    assert (code, out) == (2, [])
    assert err == "mjx-climb: error: --metric: expected one of peak_foot_force, got 'speed'"


def _walk(**changes):
    attrs = {"scenario": mc.Scenario().to_yaml(), "gains": "{}", "parameters": "{}"} | changes
    lengths = {"time": 2, "axis": 3, "six": 6, "quaternion": 4, "limb": 4, "joint": 3}
    data = {name: (dims, np.ones([lengths[d] for d in dims])) for name, (dims, *_) in dataset.VARIABLES.items()}
    coords = {"limb": ["LF", "LH", "RH", "RF"]}
    return xr.Dataset(data, coords, {name: value for name, value in attrs.items() if value is not None})


BROKEN = {
    "no table": ("sweep.nc", None, {"comparison.json": None}),
    "table of something else": ("sweep.nc", None, {"comparison.json": '{"pd": {"metrics": 1, "gains": 2}}'}),
    "deep table": ("sweep.nc", None, {"comparison.json": "[" * 100_000}),
    "sweep of other axes": ("sweep.nc", lambda: xr.Dataset({"a": ("b", [1.0])}), {}),
    "empty": ("search.nc", xr.Dataset, {}),
    "no gains": ("trajectory.nc", lambda: _walk(gains=None), {}),
    "no scenario": ("trajectory.nc", lambda: _walk(scenario=None), {}),
    "foreign gains": ("trajectory.nc", lambda: _walk(gains='{"a": "b"}'), {}),
    "deep parameters": ("trajectory.nc", lambda: _walk(parameters="[" * 100_000), {}),
    "foreign parameters": ("trajectory.nc", lambda: _walk(parameters='{"a": 1}'), {}),
    "number for text": ("trajectory.nc", lambda: _walk(parameters=1), {}),
}


def test_a_damaged_file_on_which_hdf5_hangs_gets_one_line(plot, folder, monkeypatch):
    """An object of its heap that is 0 bytes long, and no digest: the end of the file is lost too."""
    with xr.open_dataset(folder / "sweep.nc") as data:
        data.load().to_netcdf(folder / "sweep.nc.new", engine="h5netcdf")
    content = (folder / "sweep.nc.new").read_bytes()
    (folder / "sweep.nc").write_bytes(content)
    assert plot(folder)[:2] == (0, ["maps.png"])
    at = content.index(b"GCOL") + 48  # the size of its second object
    (folder / "sweep.nc").write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    monkeypatch.setattr(child_process, "PATIENCE", 3.0)
    code, out, err = plot(folder)
    assert (code, out) == (2, [])
    assert err.endswith("sweep.nc: expected a netCDF4 file, got another file, or a damaged one")


@pytest.mark.parametrize("case", BROKEN)
def test_what_another_program_wrote_or_what_has_gaps_gets_one_line(plot, folder, case):
    name, made, files = BROKEN[case]
    if made is not None:
        (folder / "sweep.nc").unlink()
        dataset.save(made(), folder / name)
    for file, text in files.items():
        (folder / file).unlink() if text is None else (folder / file).write_text(text)
    code, out, err = plot(folder)
    assert (code, out) == (2, []) and str(folder) in err and "expected" in err and "\n" not in err
