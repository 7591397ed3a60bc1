"""Maps of ClimbLab (MATLAB's .mat, up to version 7): a grid of heights, or a list of graspable points.

A grid has vectors `x` (N,) and `y` (M,) and a matrix `z` (M, N), m, with NaN where nothing can be held. A list is one
matrix (3, N), m, by any name, as `graspable_points_on_full_testfield`.
"""

from pathlib import Path

import numpy as np

from mjx_climb.scenario.messages import config_error

SUFFIXES = (".mat",)


def read(path: Path, topic: str | None) -> dict[str, np.ndarray]:
    """Columns x, y, z of all points that can be held."""
    from scipy.io import loadmat

    held = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    if {"x", "y", "z"} <= {*held}:
        x, y = (np.asarray(held[name], float).reshape(-1) for name in "xy")
        z = np.asarray(held["z"], float)
        if z.shape != (y.size, x.size):
            raise config_error(str(path), "z", f"a matrix of {y.size} x {x.size}, as y and x have it", str(z.shape))
        points = np.stack([*np.meshgrid(x, y), z]).reshape(3, -1)
    else:
        lists = [value for value in held.values() if isinstance(value, np.ndarray) and value.shape[:1] == (3,)]
        if len(lists) != 1:
            expected = "x, y and z, or one matrix with three rows"
            raise config_error(str(path), "", expected, ", ".join(held) or "nothing")
        points = np.asarray(lists[0], float).reshape(3, -1)
    return dict(zip("xyz", points[:, np.isfinite(points).all(0)], strict=True))
