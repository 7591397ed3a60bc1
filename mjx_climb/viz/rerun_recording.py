"""A walk as a recording of Rerun, with robot, ground and forces in space; needs the extra `view` (rerun-sdk)."""

import importlib
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.files.writing import write_bytes_atomically
from mjx_climb.ground import holds_of
from mjx_climb.mujoco_import import mujoco
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import size_of
from mjx_climb.viz.recording import rows_of_a_frame
from mjx_climb.viz.rendering import marks, surroundings
from mjx_climb.viz.rendering.canvas import pose

TIMELINE = "walk"


def library() -> Any:
    """Return the package rerun.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module("rerun")
    except ImportError:
        raise ConfigError("", "rerun", "rerun-sdk to be installed, as by pip install 'mjx-climb[view]'") from None


def save_rrd(trajectory: Trajectory, path: str | os.PathLike[str]) -> Path:
    """Write a walk as a file for Rerun's viewer and return its path; the instants are those of `save_mcap`'s `/tf`.

    Entities: `world/ground`, `world/holds` (points that can be held), `world/robot/N` (the geoms of the robot's file),
    `world/force/LIMB` (an arrow: of the ground on the foot), `world/push`, and over time `force/LIMB` (N) and
    `support/LIMB`. Frame `world`, SI units.

    Raises:
        ConfigError: rerun-sdk is not installed.
        OutputError: the file cannot be written.
    """
    rr, rows = library(), np.arange(0, len(trajectory.time), rows_of_a_frame(trajectory))
    times = rr.TimeColumn(TIMELINE, duration=trajectory.time[rows])
    stream = rr.RecordingStream("mjx_climb", recording_id=Path(path).stem)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "walk.rrd"
        stream.save(file)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_bodies(rr, stream, trajectory, rows, times)
        if (holds := holds_of(trajectory.scenario.ground)) is not None:
            stream.log("world/holds", rr.Points3D(holds.shown()[0], radii=0.004 * size_of(trajectory)), static=True)
        limit, length = trajectory.scenario.value("contact.holding_limit"), marks.scale([trajectory])

        def arrows(entity: str, at: np.ndarray, forces: np.ndarray, colors: np.ndarray) -> None:
            lengths = [1] * len(rows)
            columns = rr.Arrows3D.columns(origins=at, vectors=length * forces, colors=colors).partition(lengths)
            stream.send_columns(entity, indexes=[times], columns=columns)

        for place, limb in enumerate(trajectory.limbs):
            forces = trajectory.foot_force[rows, place]
            colors = _bytes([marks.color(force, limit) for force in forces])
            arrows(f"world/force/{limb}", trajectory.foot_position[rows, place], forces, colors)
            force, support = np.linalg.norm(forces, axis=-1), trajectory.support[rows, place]
            for name, values in (("force", force), ("support", support)):
                columns = rr.Scalars.columns(scalars=values.astype(float))
                stream.send_columns(f"{name}/{limb}", indexes=[times], columns=columns)
        push, pink = trajectory.push[rows, :3], np.tile(_bytes(marks.PUSH), (len(rows), 1))
        arrows("world/push", trajectory.base_position[rows] - length * push, push, pink)
        stream.flush()
        stream.disconnect()
        return write_bytes_atomically(path, file.read_bytes())


def _bytes(rgb: marks.RGB | Sequence[marks.RGB]) -> np.ndarray:
    return np.round(255 * np.asarray(rgb)).astype(np.uint8)


def _log_bodies(rr: Any, stream: Any, walk: Trajectory, rows: np.ndarray, times: Any) -> None:
    """Log the shapes of ground and robot once, and where the robot's are in each frame."""
    model = surroundings.model([walk])
    data = mujoco.MjData(model)
    places, turns = np.empty((len(rows), model.ngeom, 3)), np.empty((len(rows), model.ngeom, 3, 3))
    for frame, row in enumerate(rows):
        pose(model, data, walk, row)
        places[frame], turns[frame] = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)
    for geom in range(model.ngeom):
        shape = _shape(rr, model, geom)
        if model.geom_bodyid[geom]:
            entity = f"world/robot/{geom}"
            columns = rr.Transform3D.columns(translation=places[:, geom], mat3x3=turns[:, geom])
            stream.send_columns(entity, indexes=[times], columns=columns)
            stream.log(entity, shape, static=True)
        else:
            turned = rr.Transform3D(translation=places[0, geom], mat3x3=turns[0, geom])
            stream.log(f"world/ground/{geom}", turned, static=True)
            stream.log(f"world/ground/{geom}", shape, static=True)


def _shape(rr: Any, model: mujoco.MjModel, geom: int) -> Any:
    """Return a geom as Rerun has it: robots are drawn of boxes, cylinders and capsules, the ground has a relief too."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    solid: dict[str, Any] = {"colors": [np.round(255 * rgba).astype(np.uint8)], "fill_mode": "solid"}
    long: dict[str, Any] = {"lengths": [2 * size[1]], "radii": [size[0]], **solid}
    match kind.name.removeprefix("mjGEOM_"):
        case "BOX":
            return rr.Boxes3D(half_sizes=[size], **solid)
        case "CYLINDER":
            return rr.Cylinders3D(**long)
        case "CAPSULE":  # Rerun's begins at the origin
            return rr.Capsules3D(translations=[[0.0, 0.0, -size[1]]], **long)
    return _relief(rr, model, model.geom_dataid[geom])


def _relief(rr: Any, model: mujoco.MjModel, number: int) -> Any:
    """Return a field of heights as a mesh."""
    count = model.hfield_nrow[number], model.hfield_ncol[number]
    (half_x, half_y, high, _), begin = model.hfield_size[number], model.hfield_adr[number]
    height = high * model.hfield_data[begin : begin + count[0] * count[1]].reshape(count)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, count[1]), np.linspace(-half_y, half_y, count[0]))
    corner = np.arange(count[0] * count[1]).reshape(count)
    one, right, above, both = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    faces = np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in ((one, right, both), (one, both, above))])
    points = np.stack([x, y, height], -1).reshape(-1, 3)
    shade = np.clip(100 + 110 * (height - height.min()) / max(np.ptp(height), 1e-9), 0, 255).astype(np.uint8)
    colors = np.repeat(shade.reshape(-1, 1), 3, axis=1)
    return rr.Mesh3D(vertex_positions=points, triangle_indices=faces, vertex_colors=colors)
