"""Labelled results: nothing is lost on the way to a file and back, and a file is whole or not there."""

import dataclasses
import json
import os
import re
import subprocess
from unittest.mock import Mock

import jax
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.files import dataset as ds
from mjx_climb.parameter_types import GAIN_UNITS
from mjx_climb.scenario.messages import section
from mjx_climb.walk.metrics import GRIPS, SENSORS
from tests.trajectories import still

SCENARIO = mc.Scenario().with_overrides({
    "duration": 2.0, "gravity": [0.0, 0.0, -1.635], "control.stiffness": [1e3, 2e3, 3e3, 4e1, 5e1, 6e1],
    "disturbance.pushes": [{"force": [-5.0, 0.0, 0.0], "start": 1.0, "stop": 1.5}],
})  # fmt: skip


@pytest.fixture(scope="module")
def trajectory():
    return mc.rollout(SCENARIO)


def sweep(scenario=SCENARIO):
    """A grid of 3 stiffnesses and 2 dampings; one walk lost a gripper, another diverged."""
    metrics = {name: np.arange(6.0).reshape(3, 2) for name in mc.METRICS.names}
    metrics["detached_limb"] = np.array([[-1, -1], [2, -1], [-1, -1]])
    metrics["detached_at"] = np.where(metrics["detached_limb"] >= 0, 1.5, np.nan)
    metrics["diverged"] = np.zeros((3, 2), bool)
    metrics["diverged"][2, 1] = True
    return ds.sweep_dataset(metrics, {"stiffness": [1e2, 1e3, 1e4], "damping": [1e0, 1e2]}, scenario)


def test_every_array_of_a_walk_is_a_variable_with_units_found_by_label(trajectory):
    arrays = {f.name for f in dataclasses.fields(trajectory)} - {"scenario", "gains", "parameters", "limbs", "law"}
    assert arrays == set(ds.VARIABLES)
    dataset = ds.to_dataset(trajectory)
    assert {*dataset.coords} == {"time", "limb", "joint", "axis", "six", "quaternion"}
    for name, variable in [*dataset.variables.items(), *sweep().variables.items()]:
        assert variable.attrs["units"] and variable.attrs["long_name"], name
    torque = dataset["joint_torque"].sel(limb="RH", joint="femur")
    np.testing.assert_array_equal(torque, trajectory.joint_torque[:, 2, 1])
    np.testing.assert_array_equal(dataset["base_displacement"].sel(six="rz"), trajectory.base_displacement[:, 5])
    np.testing.assert_array_equal(dataset["base_orientation"].sel(quaternion="w"), trajectory.base_orientation[:, 0])
    assert float(dataset["push"].sel(six="x").sel(time=1.2, method="nearest")) == -5.0


@pytest.mark.parametrize(
    ("kp", "dtype"),
    [
        (40.0, np.float32),
        *(
            pytest.param(*a, marks=pytest.mark.slow)
            for a in ((None, np.float64), (40.0, np.float64), (None, np.float32))
        ),
    ],
)
def test_walk_survives_a_file(trajectory, tmp_path, kp, dtype):
    arrays = {name: getattr(trajectory, name) for name in ds.VARIABLES}
    arrays = {name: array.astype(dtype) for name, array in arrays.items() if array.dtype == np.float64}
    gains = jax.tree.map(dtype, dataclasses.replace(trajectory.gains, kp=kp and np.asarray(kp)))
    walk = dataclasses.replace(trajectory, gains=gains, **arrays)
    path = ds.save(ds.to_dataset(walk), tmp_path / "new" / "walk.nc")
    loaded = ds.load_trajectory(path)
    assert loaded.base_position.dtype == dtype
    for field in dataclasses.fields(walk):
        a, b = getattr(walk, field.name), getattr(loaded, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, field.name
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert (walk.scenario, walk.limbs) == (loaded.scenario, loaded.limbs)
    assert jax.tree.structure(walk.gains) == jax.tree.structure(loaded.gains)
    jax.tree.map(np.testing.assert_array_equal, walk.gains, loaded.gains)
    assert os.listdir(path.parent) == ["walk.nc"]
    # attributes tell how to repeat the run
    dataset = ds.load(path)
    assert ds.scenario_of(dataset) == SCENARIO
    assert json.loads(dataset.attrs["gains"])["stiffness"] == [1e3, 2e3, 3e3, 4e1, 5e1, 6e1]
    assert dataset.attrs["numpy_version"] == np.__version__
    assert dataset.attrs["jax_version"] == jax.__version__


def test_a_walk_of_an_older_version_lacks_some_quantities(trajectory, tmp_path):
    older = ds.to_dataset(trajectory).drop_vars(["missed", "gia_margin"])
    loaded = ds.load_trajectory(ds.save(older, tmp_path / "walk.nc"))
    assert np.isnan(loaded.gia_margin).all() and loaded.gia_margin.shape == trajectory.time.shape
    assert not loaded.missed.any() and loaded.missed.dtype == bool
    found, expected = mc.metrics(loaded), mc.metrics(trajectory)
    assert {name for name in found if found[name] != expected[name]} == {"min_gia_margin"}
    assert found["min_gia_margin"] is None


def test_a_walk_of_an_own_law_under_several_pushes_survives_a_file(tmp_path):
    pushes = [{"force": [n, 0.0, 1.0], "start": 0.01 * n, "stop": 0.03} for n in range(3)]
    scenario = mc.Scenario().with_overrides({"duration": 0.05, "gait.cycle": 0.05, "disturbance.pushes": pushes})
    walk = still(scenario)
    given = walk.parameters.replace({"disturbance.pushes.2.moment": np.arange(3.0), "contact.stiffness": np.array(7e3)})
    gains = {"leak": np.array(2.0), "kp": np.array([40.0])}
    walk = dataclasses.replace(walk, parameters=given, gains=gains, law="Mine")
    loaded = ds.load_trajectory(ds.save(ds.to_dataset(walk), tmp_path / "walk.nc"))
    assert (loaded.law, loaded.scenario, [*loaded.gains]) == ("Mine", scenario, ["leak", "kp"])
    jax.tree.map(np.testing.assert_array_equal, loaded.gains, gains)
    assert [*loaded.parameters.values] == [*given.values]
    for path, value in given.values.items():
        np.testing.assert_array_equal(loaded.parameters.at(path), value, err_msg=path)
    assert "law" not in ds.to_dataset(still(scenario)).attrs
    dataset = ds.to_dataset(walk)
    # the paper's gains of a file that is older than some of the joint loop's
    older = dataset.assign_attrs(gains=json.dumps(dict.fromkeys(mc.Gains.AXES, [1.0] * 6) | {"kp": 50.0}))
    gains = ds.load_trajectory(ds.save(older, tmp_path / "gains.nc")).gains
    assert isinstance(gains, mc.Gains) and (gains.kp, gains.safe_kp) == (50.0, None)
    dataset.attrs["parameters"] = json.dumps({"contact_stiffness": 1e4})
    with pytest.raises(
        mc.ConfigError, match=r"older.nc: expected a walk of release 2, got an older one: walk its conf"
    ):
        ds.load_trajectory(ds.save(dataset, tmp_path / "older.nc"))


def test_a_variable_that_should_be_large_says_so_or_has_the_name_of_a_metric_that_should():
    for name, attributes, larger in (
        ("travel", {}, True), ("peak_foot_force", {}, False), ("mine", {}, False),
        ("mine", {"larger_is_better": 1}, True), ("travel", {"larger_is_better": 0}, False),
    ):  # fmt: skip
        assert ds.larger_is_better(xr.DataArray(0.0, name=name, attrs=attributes)) is larger
    for metric in mc.METRICS:
        assert ds.metric_attributes(metric)["larger_is_better"] == metric.larger_is_better
    # of two walks the one with more way, or more margin, or that fails later is the better one
    better = {"travel", "min_tsm", "min_gia_margin", "joint_limit_margin", "detached_at", "stands_at", "sensor_lost_at"}
    assert {metric.name for metric in (*mc.METRICS, *SENSORS, *GRIPS) if metric.larger_is_better} == better


@pytest.fixture
def checkout(tmp_path):
    """Return a folder under git with a package, and with another one that is ignored, as environments are."""
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").touch()
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "__init__.py").touch()
    (tmp_path / ".gitignore").write_text(".venv")
    who = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    for command in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    return tmp_path


def test_the_revision_is_that_of_the_package(checkout, monkeypatch):
    """And not of the folder that a walk is started in, nor of one that the package is installed into."""
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=checkout, capture_output=True, text=True).stdout.strip()
    before = sweep().attrs
    monkeypatch.chdir(checkout)
    assert sweep().attrs == before and before.get("git_revision", "").removesuffix("-dirty") != head
    for name, found in (("package", head), (".venv", "")):
        monkeypatch.setattr(ds, "PACKAGE_FOLDER", checkout / name)
        assert sweep().attrs.get("git_revision", "") == found
    (checkout / "package" / "__init__.py").write_text("changed")
    ds._revision.cache_clear()
    monkeypatch.setattr(ds, "PACKAGE_FOLDER", checkout / "package")
    assert sweep().attrs["git_revision"] == f"{head}-dirty"
    ds._revision.cache_clear()
    monkeypatch.setenv("PATH", "")
    assert "git_revision" not in sweep().attrs


def test_sweep_survives_a_file(tmp_path):
    dataset = sweep()
    loaded = ds.load(ds.save(dataset, tmp_path / "sweep.nc"))
    xr.testing.assert_equal(dataset, loaded)
    assert loaded["peak_foot_force"].dims == ("stiffness", "damping")
    assert loaded["peak_foot_force"].attrs["units"] == "N"
    assert loaded["damping"].attrs["units"] == "N s/m, N m s/rad"
    assert ds.scenario_of(loaded) == SCENARIO
    limb = loaded["detached_limb"]
    flags = dict(zip(limb.attrs["flag_values"].tolist(), limb.attrs["flag_meanings"].split(), strict=True))
    assert flags == {-1: "none", 0: "LF", 1: "LH", 2: "RH", 3: "RF"}
    assert flags[int(limb.sel(stiffness=1e3, damping=1.0))] == "RH"
    assert loaded["diverged"].dtype == bool


def test_sweep_rejects_what_does_not_fit():
    for metric, size, coordinate, expected in (
        ("speed", 2, "stiffness", "metric speed: expected one of peak_foot_force"),
        ("travel", 3, "stiffness", r"metric travel: expected shape \(2,\)"),
        ("travel", 2, "colour", "coordinate colour: expected a gain or a path"),
    ):
        with pytest.raises(ValueError, match=expected):
            ds.sweep_dataset({metric: np.zeros(size)}, {coordinate: [1e2, 1e3]}, SCENARIO)
    for alone in (xr.DataArray(1.0, attrs={"units": "N"}), xr.DataArray(np.ones((1, 1)), attrs={"units": "N"})):
        with pytest.raises(ValueError, match=rf"^coordinate a: expected one axis, got {alone.ndim}$"):
            ds.sweep_dataset({}, {"a": alone}, SCENARIO)
    own = xr.DataArray([1.0, 2.0], dims="slope", attrs={"units": "rad", "long_name": "slope"})
    assert ds.sweep_dataset({"travel": np.zeros(2)}, {"slope": own}, SCENARIO)["slope"].attrs["units"] == "rad"


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "^C"])
def test_failure_in_the_middle_leaves_the_old_file(tmp_path, monkeypatch, broken, error):
    path = ds.write_text_atomically(tmp_path / "result.txt", "old")
    monkeypatch.setattr(os, broken, Mock(side_effect=error))
    refused = ds.OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(refused, match=r"result\.txt: expected a file .*, got no space left on device$|^$"):
        ds.write_text_atomically(path, "new")
    assert (path.read_text(), os.listdir(tmp_path)) == ("old", ["result.txt"])


def test_other_files_are_told_in_one_line(tmp_path):
    (tmp_path / "text.nc").write_text("no netCDF")
    ds.save(sweep(), tmp_path / "sweep.nc")
    files = {"text.nc": "another file", "lacks.nc": "no such file", "sweep.nc": "a dataset without"}
    for name, reason in files.items():
        with pytest.raises(mc.ConfigError, match=rf"{name}: expected .*, got {reason}"):
            ds.load_trajectory(tmp_path / name)


def test_a_damaged_file_is_refused_before_hdf5_opens_it(tmp_path, monkeypatch):
    """HDF5 may hang in one: any block of zeros, in the digest too. A file of another program's has none and is read."""
    path = ds.save(sweep(), tmp_path / "sweep.nc")
    xr.testing.assert_equal(xr.load_dataset(path), sweep())  # by whatever reads netCDF
    whole = path.read_bytes()
    sweep().to_netcdf(tmp_path / "own.nc", engine="h5netcdf")
    xr.testing.assert_equal(ds.load(tmp_path / "own.nc"), sweep())
    monkeypatch.setattr(xr, "load_dataset", lambda *_, **__: pytest.fail("opened"))
    for begin in range(0, len(whole), 512):
        path.write_bytes(whole[:begin] + bytes(len(whole[begin : begin + 512])) + whole[begin + 512 :])
        if path.read_bytes() == whole:  # zeros before
            continue
        with pytest.raises(mc.ConfigError, match=r"sweep\.nc: expected a netCDF4 file, got another file, or a damaged"):
            ds.load(path)


def test_units_are_those_of_the_law_the_config_and_the_metrics():
    own, gains = mc.parameters(SCENARIO), {name: field.unit for name, field in law_of(SCENARIO).GAINS.items()}
    assert gains == {name: unit for name, (unit, _) in GAIN_UNITS.items() if name in gains}
    computed = {"mass_scale", "gait.swing_path", "ground.foothold_height", "hardware.seed"}
    computed |= {"hardware.force_sensor.dead"} | {key for key in own.units if ".pushes." in key}
    for key, (unit, _) in own.units.items():
        if key not in computed:
            *place, name = key.split(".")
            described = section(mc.Scenario, place).model_fields[name].description
            assert re.search(rf", {re.escape(unit)}(;|$)", described), key
    for variable, metric in (
        ("foot_force", "peak_foot_force"), ("joint_torque", "peak_joint_torque"),
        ("joint_angles", "joint_limit_margin"),
        ("base_position", "travel"), ("tsm", "min_tsm"), ("gia_margin", "min_gia_margin"),
    ):  # fmt: skip
        assert ds.VARIABLES[variable][1] == mc.METRICS[metric].unit, variable
