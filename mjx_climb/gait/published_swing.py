"""Swings that others have planned, read from their files and scaled to a gait's stride and step height.

RAMP (Ribeiro et al., ICRA 2023; https://github.com/Space-Robotics-Laboratory/RAMP) plans a Bezier curve of order seven:
eight control points as columns of a matrix of three rows, m. It writes no file: the matrix is read as text.
ReSTO (https://github.com/Space-Robotics-Laboratory/ReSTO) has its plans, and RAMP's, in recordings of ROS 2: transforms
of `planned/LINK` on `/tf`; PlotJuggler's exports of them are CSV.
"""

import csv
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.gait.swing import COUNT, added_shapes, lift, rest_to_rest
from mjx_climb.ground.table import reading
from mjx_climb.reading import until_edited
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Gait, SwingFile

_SAMPLES = 201  # of a curve
_STILL = 1e-6  # of the way of a swing, which begins slowly: nearer to its ends a foot is at rest
_LEAST = 8  # samples of a recorded swing


class Swing(NamedTuple):
    """The way of one foot through the air, in its file's frame."""

    phase: np.ndarray  # (S,) 1, from 0 to 1
    position: np.ndarray  # (S, 3) m, z up


def published_path(swing: SwingFile, gait: Gait, limbs: int) -> np.ndarray:
    """Coefficients (limb, 3, K) in step heights, as `swing_path` has them, of a published swing for all limbs.

    The way along the line between its ends becomes the stride, its height in the middle the step height, and the way
    aside has the scale of the stride. Least squares: position, velocity and acceleration at both ends and the height in
    the middle are the cubic's.

    Raises:
        ConfigError: in one line, a file that cannot be read, or no swing in it.
    """
    read = _read(swing.file, swing.frame)
    way = read.position - read.position[0]
    length = float(np.linalg.norm(way[-1]))
    ahead = way[-1] / max(length, 1e-12)
    up = np.array([0.0, 0.0, 1.0]) - ahead[2] * ahead
    height = float(np.interp(0.5, read.phase, way @ up) / max(np.linalg.norm(up), 1e-12))
    if length < 1e-6 or not height > 0:
        got = f"{length:g} m long and {height:g} m high"
        raise ConfigError(swing.file, "gait.swing_file", "a swing that rises on its way, z up", got)
    up = up / np.linalg.norm(up)
    share = np.stack([way @ ahead, way @ np.cross(up, ahead)]) / length
    horizontal, vertical = (np.stack(shapes, axis=1) for shapes in added_shapes(read.phase))
    strides = np.stack([share[0] - rest_to_rest(read.phase), share[1]], axis=1)
    path = np.empty((3, COUNT))
    path[:2] = gait.stride / gait.step_height * np.linalg.lstsq(horizontal, strides, rcond=None)[0].T
    path[2] = np.linalg.lstsq(vertical, way @ up / height - lift(read.phase), rcond=None)[0]
    return np.tile(path, (limbs, 1, 1))


@until_edited(lambda file, frame: [file])
def _read(file: str, frame: str) -> Swing:
    """The swing in a file.

    Raises:
        ConfigError: in one line, another format, a damaged file, or no swing.
    """
    readers: Mapping[str, Callable[[Path, str], Swing]]
    readers = {".txt": _bezier, ".csv": _exported, ".db3": _recorded, ".mcap": _recorded}
    path = Path(file)
    if (reader := readers.get(path.suffix.lower())) is None:
        raise ConfigError(file, "gait.swing_file", f"a swing as {', '.join(readers)}", path.suffix or "no suffix")
    with reading(file, "gait.swing_file", "a whole file with a swing"):
        return reader(path, frame)


def _bezier(path: Path, frame: str) -> Swing:
    """A Bezier curve by its control points, (3, order + 1) m."""
    points = np.loadtxt(path, ndmin=2)
    if points.shape[0] != 3 or points.shape[1] < 2:
        raise ValueError(f"a matrix of {points.shape[0]} rows and {points.shape[1]} columns in place of three rows")
    order, phase = points.shape[1] - 1, np.linspace(0, 1, _SAMPLES)
    number = np.arange(order + 1)
    ways = [math.comb(order, each) for each in number.tolist()]
    weight = ways * phase[:, None] ** number * (1 - phase[:, None]) ** (order - number)
    return Swing(phase, weight @ points.T)


def _exported(path: Path, frame: str) -> Swing:
    """PlotJuggler's export: the first column is time, s; cells of other topics' rows are empty."""
    with path.open(newline="") as lines:
        rows = csv.reader(lines)
        names = next(rows)
        ends = tuple(f"/{frame}/translation/{axis}" for axis in "xyz")
        places = {name[-1]: place for place, name in enumerate(names) if name.endswith(ends)}
        if len(places) != 3:
            raise ValueError(f"{len(places)} columns in place of three that end with /{frame}/translation/x, y, z")
        cells = [[row[0], *(row[places[axis]] for axis in "xyz")] for row in rows if len(row) == len(names)]
    table = np.array([list(map(float, row)) for row in cells if all(row)]).reshape(-1, 4)
    return _trimmed(table[:, 0], table[:, 1:], frame)


def _recorded(path: Path, frame: str) -> Swing:
    """A recording of ROS 2 with the frame's transforms on `/tf`."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    times, places = [], []
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        found = [each for each in reader.connections if each.topic == "/tf"]
        for connection, time, raw in reader.messages(found):
            message: Any = reader.deserialize(raw, connection.msgtype)
            for each in message.transforms:
                if each.child_frame_id == frame:
                    at = each.transform.translation
                    times.append(time - reader.start_time)
                    places.append([at.x, at.y, at.z])
    return _trimmed(np.array(times), np.array(places).reshape(-1, 3), frame)


def _trimmed(time: np.ndarray, position: np.ndarray, frame: str) -> Swing:
    """The swing between two rests of a foot (S, 3) m at some times (S,), in any unit."""
    if len(time):
        way = np.linalg.norm(position[-1] - position[0])
        begun = np.linalg.norm(position - position[0], axis=1) > _STILL * way
        going = np.linalg.norm(position - position[-1], axis=1) > _STILL * way
        first, last = max(int(begun.argmax()) - 1, 0), len(time) - int(going[::-1].argmax())
        time, position = time[first : last + 1], position[first : last + 1]
    if len(time) < _LEAST or not (np.diff(time) > 0).all():
        raise ValueError(f"{len(time)} samples in order of a swing of {frame}")
    return Swing((time - time[0]) / (time[-1] - time[0]), position)
