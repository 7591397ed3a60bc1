"""Height maps: grids of heights from a file, their place in the world, and their samples that can be held."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mjx_climb.ground.readers.csv_file import cells, numbers
from mjx_climb.ground.table import reading, real
from mjx_climb.reading import until_edited
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import HeightMap, HoldMap


def relief(ground: HeightMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A height map in the world: x (N,) m, y (M,) m, heights (M, N) m; NaN is a gap in the map of holds."""
    of_holds = isinstance(ground, HoldMap)
    grid = grid_of(ground.file, f"ground.{'holds.' * of_holds}map.file", gaps=of_holds)
    y, x = (start + ground.resolution * np.arange(n) for start, n in zip(ground.origin[::-1], grid.shape, strict=True))
    return x, y, ground.scale * grid


def holdable(ground: HoldMap) -> tuple[np.ndarray, np.ndarray]:
    """The samples of a map that can be held: positions (n, 3) m and normals (n, 3) 1 of the surface.

    A normal comes from the samples around; next to one that is not a number it points up.

    Raises:
        ConfigError: map or mask cannot be read, or have different shapes.
    """
    x, y, heights = relief(ground)
    held = np.isfinite(heights)
    if ground.mask is not None:
        mask = grid_of(ground.mask, "ground.holds.map.mask", gaps=True)
        if mask.shape != heights.shape:
            expected = f"the {heights.shape[0]} rows and {heights.shape[1]} columns of the map"
            got = f"{mask.shape[0]} and {mask.shape[1]}"
            raise ConfigError(ground.mask, "ground.holds.map.mask", expected, got)
        held &= mask > 0
    slope = np.stack(np.gradient(heights, ground.resolution)[::-1], axis=-1)
    slope = np.where(np.isfinite(slope).all(-1, keepdims=True), slope, 0.0)
    normal = np.concatenate([-slope, np.ones_like(heights)[..., None]], axis=-1)
    position = np.stack([*np.meshgrid(x, y), heights], axis=-1)
    return position[held], normal[held]


@until_edited(lambda file, *_, **__: [file])
def grid_of(file: str, key: str = "ground.map.file", gaps: bool = False) -> np.ndarray:
    """The samples of a grid: rows along y, columns along x, both ascending; `gaps` are NaN.

    Raises:
        ConfigError: in one line that begins with file and key, an unreadable file or no grid.
    """
    readers: dict[str, Callable[[str], np.ndarray]] = {".csv": _csv, ".npy": _npy, ".png": _png}
    suffix = Path(file).suffix.lower()
    if suffix not in readers:
        raise ConfigError(file, key, "a .csv, .npy or .png", suffix or "no suffix")
    with reading(file, key, "a grid of numbers"):
        grid = real(readers[suffix](file), file, key)
    usable = not np.isinf(grid).any() if gaps else np.isfinite(grid).all()
    if grid.ndim != 2 or min(grid.shape) < 2 or not usable:
        got = "values that are not finite" if grid.ndim == 2 and min(grid.shape) > 1 else f"shape {grid.shape}"
        raise ConfigError(file, key, "two rows and columns or more of finite numbers", got)
    return grid


def _csv(file: str) -> np.ndarray:
    rows = cells(Path(file))
    return numbers(rows, len(rows[0][1]) if rows else 0)


def _npy(file: str) -> np.ndarray:
    with open(file, "rb") as content:
        return np.asarray(np.lib.format.read_array(content))


def _png(file: str) -> np.ndarray:
    """The grey levels, 0 to 1; the picture's top row is the far side, the largest y."""
    from matplotlib.image import imread
    from PIL import Image

    with Image.open(file, formats=["PNG"]) as picture:
        # its checksums, to the end
        picture.verify()
    image = imread(file, format="png")
    return (image if image.ndim == 2 else image[..., :3].mean(-1))[::-1]
