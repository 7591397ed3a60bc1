"""Results as labelled arrays with units."""

import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from mjx_climb.child_process import read_apart
from mjx_climb.disturbances.on_base import Push
from mjx_climb.files.writing import OutputError as OutputError
from mjx_climb.files.writing import check_folder as check_folder
from mjx_climb.files.writing import write_bytes_atomically as write_bytes_atomically
from mjx_climb.files.writing import write_text_atomically as write_text_atomically
from mjx_climb.inputs.from_scenario import parameters
from mjx_climb.parameter_types import GAIN_UNITS, Gains, Parameters
from mjx_climb.physics.state import State
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.trajectory import Trajectory
from mjx_climb.walk.metrics import METRICS, Metric, MetricTable
from mjx_climb.walk.sample import DIMS, Sample, unknown

if TYPE_CHECKING:
    import xarray as xr  # walks do not wait for it

PACKAGE_FOLDER = Path(__file__).parents[1]
_TIMES = 16  # more than one damaged block of a disk takes away
_READ = """
import sys, h5netcdf
with h5netcdf.File(sys.argv[1]) as file:
    [(dict(each.attrs), each[...]) for each in file.variables.values()], dict(file.attrs)
"""
PACKAGES = {"mjx_climb": "mjx-climb", "mujoco": "mujoco", "mjx": "mujoco-mjx", "jax": "jax", "numpy": "numpy"}

AXES = ["x", "y", "z"]
QUATERNION = ["w", "x", "y", "z"]
SIX = ["x", "y", "z", "rx", "ry", "rz"]

_COMPONENTS = {"3": "axis", "4": "quaternion", "6": "six"}  # the dimension of so many
# name: dimensions, units, long name
VARIABLES: dict[str, tuple[tuple[str, ...], str, str]] = {
    field.name: (
        ("time", *(_COMPONENTS.get(dim, dim) for dim in DIMS[field.name])),
        field.metadata["unit"],
        field.metadata["long_name"],
    )
    for field in dataclasses.fields(Sample)
}
# a walk has these at least: the state, and the quantities that tell divergence
_NEEDED = {"time", "limb", "joint", *(field.name for field in dataclasses.fields(State)), "joint_torque", "foot_force"}


def to_dataset(trajectory: Trajectory) -> "xr.Dataset":
    """Return a walk as labelled arrays: every variable has units and a long name.

    The attributes hold the resolved scenario (YAML), the gains (JSON), versions and git revision: the same walk gives
    the same file.
    """
    import xarray as xr

    labels: dict[str, tuple[Sequence[str], str]] = {
        "limb": (list(trajectory.limbs), "limb"),
        "joint": (list(trajectory.robot.joint_names), "joint, from the base outwards"),
        "axis": (AXES, "axis of the world frame, z up"),
        "six": (SIX, "translations, then rotations"),
        "quaternion": (QUATERNION, "component of the quaternion"),
    }
    coords: dict[str, Any] = {
        name: (name, values, {"units": "1", "long_name": text}) for name, (values, text) in labels.items()
    }
    data = {
        name: (dims, getattr(trajectory, name), {"units": units, "long_name": text})
        for name, (dims, units, text) in VARIABLES.items()
    }
    attrs = {"title": "walk of a limbed climbing robot", **provenance(trajectory.scenario)}
    attrs |= {name: fields_as_json(getattr(trajectory, name)) for name in ("gains", "parameters")}
    return xr.Dataset(data, coords, attrs | ({"law": trajectory.law} if trajectory.law else {}))


def sweep_dataset(
    metrics: Mapping[str, np.ndarray],
    coordinates: "Mapping[str, np.ndarray | xr.DataArray]",
    scenario: Scenario,
    table: MetricTable = METRICS,
) -> "xr.Dataset":
    """Return the metrics of a grid of walks as labelled arrays.

    Arguments:
        metrics: arrays of metrics, with one axis per coordinate, in their order.
        coordinates: the values along each axis: names of gains or paths of the scenario's parameters, or others with a
            DataArray that has units.
        scenario: the common part of all walks.
        table: the metrics themselves.

    Raises:
        ValueError: an unknown metric or coordinate, or shapes that do not fit.
    """
    import xarray as xr

    coords, shape = {}, []
    for name, values in coordinates.items():
        if not isinstance(values, xr.DataArray) or "units" not in values.attrs:
            known = GAIN_UNITS if name in GAIN_UNITS else parameters(scenario).units
            if name not in known:
                raise ValueError(f"coordinate {name}: expected a gain or a path of the scenario, or units of its own")
            units, text = known[name]
            values = xr.DataArray(np.asarray(values), dims=name, attrs={"units": units, "long_name": text})
        if values.ndim != 1:
            raise ValueError(f"coordinate {name}: expected one axis, got {values.ndim}")
        coords[name] = (name, values.values, values.attrs)
        shape.append(values.size)
    data = {}
    for name, values in metrics.items():
        values = np.asarray(values)
        if name not in table.names:
            raise ValueError(f"metric {name}: expected one of {', '.join(table.names)}")
        if values.shape != tuple(shape):
            raise ValueError(f"metric {name}: expected shape {tuple(shape)} as the coordinates, got {values.shape}")
        attrs = metric_attributes(table[name])
        if name == "detached_limb":
            values = values.astype(np.int32)
            attrs["flag_values"] = np.arange(-1, len(scenario.limbs), dtype=np.int32)
            attrs["flag_meanings"] = " ".join(["none", *scenario.limbs])
        data[name] = (tuple(coords), values, attrs)
    attrs = {"title": "metrics of walks of a limbed climbing robot", **provenance(scenario)}
    return xr.Dataset(data, coords, attrs)


def metric_attributes(metric: Metric) -> dict[str, Any]:
    """Return the attributes of a variable that holds values of a metric."""
    larger = int(metric.larger_is_better)
    return {"units": metric.unit, "long_name": metric.long_name, "larger_is_better": larger}


def larger_is_better(variable: "xr.DataArray") -> bool:
    """Return whether a variable should be large: as its attributes say, else as the shipped metric of its name."""
    name = str(variable.name)
    by_name = name in METRICS.names and METRICS[name].larger_is_better
    return bool(variable.attrs.get("larger_is_better", by_name))


def scenario_of(dataset: "xr.Dataset") -> Scenario:
    """Return the scenario that a dataset was made from.

    Raises:
        ConfigError: the dataset holds none, or not a valid one.
    """
    source = str(dataset.encoding.get("source", "dataset"))
    if "scenario" not in dataset.attrs:
        raise ConfigError(source, "", "an attribute 'scenario'", "none")
    return Scenario.from_yaml(dataset.attrs["scenario"], source).beside(Path(source).parent)


def provenance(scenario: Scenario) -> dict[str, str]:
    """The attributes that allow a computation to be repeated: scenario, versions, revision."""
    attrs = {"scenario": scenario.to_yaml()}
    for name, distribution in PACKAGES.items():
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            attrs[f"{name}_version"] = importlib.metadata.version(distribution)
    return attrs | ({"git_revision": revision} if (revision := _revision(PACKAGE_FOLDER)) else {})


@functools.cache
def _revision(package: Path) -> str:
    """Return the commit of the checkout that a package is part of, "-dirty" where its files differ from it; or "".

    It is part of none where no file of it is tracked: where it is installed into an environment in somebody's checkout.
    """
    git = ["git", "-C", str(package)]
    how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 5, "check": True}
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        if subprocess.run([*git, "ls-files", "__init__.py"], **how).stdout.strip():
            describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
            return str(subprocess.run([*git, *describe], **how).stdout.strip())
    return ""


def fields_as_json(values: Gains | Parameters | Mapping[str, Any]) -> str:
    """Return numbers by name as JSON, arrays as lists."""
    by_name = values if isinstance(values, Mapping) else getattr(values, "values", None) or vars(values)
    return json.dumps({n: None if v is None else np.asarray(v).tolist() for n, v in by_name.items()})


def _from_json(text: str, dtype: np.dtype) -> dict[str, Any]:
    return {n: None if v is None else np.asarray(v, dtype) for n, v in json.loads(text).items()}


def save(dataset: "xr.Dataset", path: str | os.PathLike[str]) -> Path:
    """Write a dataset as netCDF4 and return its path; a crash leaves the old file or the new one.

    Files in the same folder that its scenario names are named relative to it: the folder can be moved.

    Raises:
        OutputError: the file cannot be written.
    """
    encoding = {
        name: {"zlib": True, "complevel": 1, "shuffle": True}
        for name, variable in dataset.variables.items()
        if variable.ndim and variable.dtype.kind in "fiub"
    }
    if "scenario" in dataset.attrs:
        dataset = dataset.assign_attrs(scenario=scenario_of(dataset).relative_to(Path(path).parent).to_yaml())
    content = bytes(dataset.to_netcdf(engine="h5netcdf", encoding=encoding))
    return write_bytes_atomically(path, content + _seal(content))


def _seal(content: bytes) -> bytes:
    """Return the bytes after the end of a netCDF file, which readers ignore: its digest, repeated."""
    return f"sha256 {hashlib.sha256(content).hexdigest()}\n".encode() * _TIMES


def load(path: str | os.PathLike[str]) -> "xr.Dataset":
    """Read a dataset that `save` wrote, or another program.

    HDF5 may hang where a file is damaged: one without the digest of `save` is read by another process first.

    Raises:
        ConfigError: no netCDF4 file, a damaged one, or one that is not read in time.
    """
    import xarray as xr

    try:
        content = Path(path).read_bytes()
        seal = content[-len(_seal(b"")) :]
        if not seal.count(b"sha256 "):
            read_apart(_READ, path)
        elif seal != _seal(content[: -len(seal)]):
            raise ValueError("damaged")
        return xr.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError, LookupError, TypeError, RuntimeError) as error:  # its readers' errors
        number = getattr(error, "errno", None)  # HDF5's own text is long
        reason = os.strerror(number) if number else "another file, or a damaged one"
        raise ConfigError(os.fspath(path), "", "a netCDF4 file", reason.lower()) from None


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read the walk that `save(to_dataset(trajectory), path)` wrote.

    Quantities that the file lacks, of an older version, are NaN, or False where they are flags.

    Raises:
        ConfigError: no netCDF4 file, or one without a walk.
    """
    dataset = load(path)
    if missing := sorted(_NEEDED - set(dataset.variables)):
        raise ConfigError(os.fspath(path), "", "a walk", f"a dataset without {missing[0]}")
    dtype = dataset["base_position"].dtype
    # a file of an older version lacks newer quantities
    arrays = unknown(dataset.sizes["time"], {str(dim): size for dim, size in dataset.sizes.items()}, dtype)
    arrays |= {name: dataset[name].values for name in arrays if name in dataset.variables}
    by_name = _from_json(dataset.attrs["gains"], dtype)
    of_the_paper = {field.name for field in dataclasses.fields(Gains)} >= set(by_name)
    gains = Gains(**by_name) if of_the_paper else by_name
    with jax.enable_x64(dtype == np.float64):
        # to read a walk runs no file
        bare = scenario_of(dataset).without_kinds()
        own: Parameters = jax.tree.map(np.asarray, parameters(bare, dtype))
    numbers = _from_json(dataset.attrs["parameters"], dtype)
    if "contact_stiffness" in numbers:
        raise ConfigError(os.fspath(path), "", "a walk of release 2", "an older one: walk its config again")
    pushes = {name.split(".")[2] for name in numbers if name.startswith("disturbance.pushes.")}
    own = dataclasses.replace(own, disturbances=(*own.disturbances[:1], *(Push() for _ in pushes)))
    shaped = {n: v.reshape(np.shape(own.at(n))) if not v.size else v for n, v in numbers.items() if n in own.paths}
    given = own.replace(shaped)
    limbs = tuple(str(limb) for limb in dataset["limb"].values)
    law = dataset.attrs.get("law", "")
    return Trajectory(scenario=scenario_of(dataset), gains=gains, parameters=given, limbs=limbs, law=law, **arrays)
