"""Maps of ClimbLab (MATLAB's .mat, up to version 7): a grid of heights, or a list of graspable points.

A grid has vectors `x` (N,) and `y` (M,) and a matrix `z` (M, N), m, with NaN where nothing can be held. A list is one
matrix (3, N), m, by any name, as `graspable_points_on_full_testfield`.
"""

import io
from pathlib import Path

import numpy as np

from mjx_climb.child_process import read_apart
from mjx_climb.ground.table import Table, real
from mjx_climb.scenario.messages import ConfigError

SUFFIXES = (".mat",)
# SciPy crashes on damaged files
_READ = """
import sys, numpy, scipy.io
held = scipy.io.loadmat(sys.argv[1])
held = {"_" + name: value for name, value in held.items() if isinstance(value, numpy.ndarray)}
numpy.savez(sys.stdout.buffer, **{name: value for name, value in held.items() if value.dtype.kind in "biufc"})
"""


def read(path: Path, topic: str | None) -> Table:
    """Columns x, y, z of all points; NaN: cannot be held."""
    done = read_apart(_READ, path)
    if done.returncode:
        raise ValueError(done.stderr.decode(errors="replace").strip().rpartition("\n")[2])
    with np.load(io.BytesIO(done.stdout)) as arrays:
        held = {name[1:]: array for name, array in arrays.items()}
    if {"x", "y", "z"} <= {*held}:
        x, y, z = (real(held[name], str(path), name) for name in "xyz")
        if z.shape != (y.size, x.size):
            raise ConfigError(str(path), "z", f"a matrix of {y.size} x {x.size}, as y and x have it", str(z.shape))
        points = np.stack([*np.meshgrid(x, y), z]).reshape(3, -1)
    else:
        lists = [value for value in held.values() if value.shape[:1] == (3,)]
        if len(lists) != 1:
            expected = "x, y and z, or one matrix with three rows"
            raise ConfigError(str(path), "", expected, ", ".join(held) or "nothing")
        points = lists[0].reshape(3, -1)
    return Table(str(path), list(zip("xyz", points, strict=True)))
