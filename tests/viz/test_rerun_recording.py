"""A walk for Rerun's viewer, where rerun-sdk is installed; refused in a line where it is not."""

import dataclasses
import importlib
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import mjx_climb as mc
from mjx_climb.viz import recording, rerun_recording
from mjx_climb.viz.plots import events
from mjx_climb.viz.rendering import canvas, marks, surroundings
from tests.shell import ROOT
from tests.trajectories import still
from tuning.command_line import main


def test_without_the_package_the_command_says_so_before_it_walks(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setattr(mc, "rollout", None)
    with pytest.raises(SystemExit) as ended:
        main(["run", "case_1_2", "--rerun", "--out", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    expected = "--rerun: expected rerun-sdk to be installed, as by pip install 'mjx-climb[view]'"
    assert (ended.value.code, out, err) == (2, "", f"mjx-climb: error: {expected}\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_robot_ground_and_forces_are_recorded_in_the_frames_of_the_mcap_file(tmp_path):
    rerun = pytest.importorskip("rerun")
    walk = mc.rollout(mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3"]))
    file = rerun_recording.save_rrd(walk, tmp_path / "walk.rrd")
    program = importlib.import_module("rerun_cli").__file__.replace("__init__.py", "rerun")
    done = subprocess.run([program, "rrd", "print", file], capture_output=True, text=True, check=True)
    chunks = [line for line in done.stdout.splitlines() if line.startswith("Chunk")]
    moving = {line.split(" - ")[1] for line in chunks if "with 30 rows" in line}
    assert rerun and {f"/world/force/{limb}" for limb in walk.limbs} | {"/world/push", "/support/LF"} <= moving
    assert sum(name.startswith("/world/robot/") for name in moving) >= 13  # a base and three links of four limbs
    assert any("/world/ground/" in line and "Mesh3D" in line for line in chunks)


class Recorder:
    """A stand-in for the package rerun: each archetype is its arguments, and a stream keeps all that it is sent."""

    def __getattr__(self, kind):
        def made(*values, **named):
            return types.SimpleNamespace(kind=kind, values=values, named=named, **named)

        def columns(**named):
            partitioned = lambda lengths: types.SimpleNamespace(kind=kind, lengths=lengths, **named)  # noqa: E731
            return types.SimpleNamespace(kind=kind, partition=partitioned, **named)

        made.columns, made.RIGHT_HAND_Z_UP = columns, "z up"
        return made

    def RecordingStream(self, application, recording_id):
        self.begun, self.still, self.moving = (application, recording_id), {}, {}
        self.save, self.flush, self.disconnect = lambda file: file.write_bytes(b"walk"), lambda: None, lambda: None
        return self

    def log(self, entity, what, static):
        assert static
        self.still.setdefault(entity, []).append(what)

    def send_columns(self, entity, indexes, columns):
        assert len(indexes) == 1 and entity not in self.moving
        self.moving[entity] = indexes[0], columns


def recorded(scenario, monkeypatch, tmp_path):
    """Return a walk of random numbers, the rows that are shown of it, and what a stand-in was sent of it."""
    draw, walk, rr = np.random.default_rng(2), still(scenario, base_position=[0.1, 0.0, 0.2]), Recorder()
    series = {name: draw.normal(size=getattr(walk, name).shape) for name in ("foot_position", "foot_force", "push")}
    walk = dataclasses.replace(
        walk, joint_angles=0.1 * draw.normal(size=walk.joint_angles.shape), support=draw.random((60, 4)) < 0.5, **series
    )
    walk.base_orientation[:, 0] = 1.0
    monkeypatch.setitem(sys.modules, "rerun", rr)
    assert rerun_recording.save_rrd(walk, tmp_path / "one.rrd").read_bytes() == b"walk"
    return walk, np.arange(0, 60, recording.rows_of_a_frame(walk)), rr


HELD = {"points": [{"at": [0.2, 0.1, 0.01], "limit": 3.0}, {"at": [0.1, 0.1, 0.0]}]}
SHORT = {"duration": 0.06, "gait.cycle": 0.06, "contact.holding_limit": 2.0}


def test_forces_pushes_and_holds_are_those_of_the_walk(monkeypatch, tmp_path):
    """By a stand-in for the package."""
    scenario = mc.Scenario().with_overrides({**SHORT, "ground.holds": HELD})
    walk, rows, rr = recorded(scenario, monkeypatch, tmp_path)
    assert rr.begun == ("mjx_climb", "one") and rr.still["world"] == ["z up"]
    assert len({id(times) for times, _ in rr.moving.values()}) == 1 < len(rows)
    times, _ = rr.moving["world/push"]
    assert (times.kind, times.values) == ("TimeColumn", ("walk",))
    np.testing.assert_array_equal(times.duration, walk.time[rows])
    length, [points] = marks.scale([walk]), rr.still["world/holds"]
    np.testing.assert_allclose(points.values[0], [each["at"] for each in HELD["points"]])
    assert points.radii == pytest.approx(0.004 * events.size_of(walk))

    def arrows(entity, tail, vector, rgb):
        found = rr.moving[f"world/{entity}"][1]
        assert (found.kind, found.lengths) == ("Arrows3D", [1] * len(rows))
        np.testing.assert_allclose(found.origins, tail)
        np.testing.assert_allclose(found.vectors, vector)
        np.testing.assert_array_equal(found.colors, np.round(255 * np.array(rgb)))

    for n, limb in enumerate(walk.limbs):
        forces = walk.foot_force[rows, n]
        arrows(f"force/{limb}", walk.foot_position[rows, n], length * forces, [marks.color(f, 2.0) for f in forces])
        for name, values in (("force", np.sqrt((forces**2).sum(1))), ("support", walk.support[rows, n])):
            found = rr.moving[f"{name}/{limb}"][1].scalars
            np.testing.assert_allclose(found, values)
            assert found.dtype == float
    push = length * walk.push[rows, :3]
    arrows("push", walk.base_position[rows] - push, push, [to_rgb("#E24FB0")] * len(rows))


@pytest.mark.parametrize("gravity", [[0.0, 0.0, 0.0], [0.0, 0.0, -9.81]])
def test_shapes_of_robot_and_ground_are_where_mujoco_has_them(gravity, monkeypatch, tmp_path):
    """Boxes, cylinders, capsules and relief; handrails on the station."""
    walk, rows, rr = recorded(mc.Scenario().with_overrides({**SHORT, "gravity": gravity}), monkeypatch, tmp_path)
    model = surroundings.model([walk])
    data = mujoco.MjData(model)
    robot = [n for n in range(model.ngeom) if model.geom_bodyid[n]]
    entities = {n: f"world/{'robot' if n in robot else 'ground'}/{n}" for n in range(model.ngeom)}
    assert {*rr.still} == {"world", *entities.values()}
    for frame, row in enumerate(rows):
        canvas.pose(model, data, walk, row)
        for n, entity in entities.items():
            found = rr.moving[entity][1] if n in robot else rr.still[entity][0]
            each = found.translation, found.mat3x3
            place, turn = (value[frame] for value in each) if n in robot else each
            np.testing.assert_allclose(place, data.geom_xpos[n])
            np.testing.assert_allclose(turn, data.geom_xmat[n].reshape(3, 3))
    shapes = {n: rr.still[entity][-1] for n, entity in entities.items()}
    kinds = {"Boxes3D": "BOX", "Cylinders3D": "CYLINDER", "Capsules3D": "CAPSULE", "Mesh3D": "HFIELD"}
    assert {shape.kind for shape in shapes.values()} == {*kinds}
    for n, shape in shapes.items():
        assert mujoco.mjtGeom(model.geom_type[n]).name == f"mjGEOM_{kinds[shape.kind]}"
        if shape.kind == "Mesh3D":
            continue
        (wide, long, _), own = model.geom_size[n], model.geom_matid[n] >= 0
        rgba = model.mat_rgba[model.geom_matid[n]] if own else model.geom_rgba[n]
        named = (
            {"half_sizes": [model.geom_size[n]]}
            if shape.kind == "Boxes3D"
            else {"lengths": [2 * long], "radii": [wide]}
        )
        named |= {"translations": [[0, 0, -long]]} if shape.kind == "Capsules3D" else {}
        assert {*shape.named} == {*named, "colors", "fill_mode"} and shape.fill_mode == "solid"
        np.testing.assert_allclose(shape.colors, [255 * rgba], atol=0.5)
        for name, value in named.items():
            np.testing.assert_allclose(shape.named[name], value)
    [relief] = [shape for n, shape in shapes.items() if model.geom_type[n] == mujoco.mjtGeom.mjGEOM_HFIELD]
    high = model.hfield_data.reshape(model.hfield_nrow[0], model.hfield_ncol[0]) * model.hfield_size[0, 2]
    points, (x, y) = relief.vertex_positions.reshape(*high.shape, 3), model.hfield_size[0, :2]
    np.testing.assert_allclose(points[..., 2], high)
    np.testing.assert_allclose(points[..., 0], np.tile(np.linspace(-x, x, high.shape[1]), (high.shape[0], 1)))
    np.testing.assert_allclose(points[..., 1].T, np.tile(np.linspace(-y, y, high.shape[0]), (high.shape[1], 1)))
    # two triangles of each square, seen from above
    corners = relief.vertex_positions[relief.triangle_indices]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    np.testing.assert_allclose(areas, 2 * x * y / ((high.shape[0] - 1) * (high.shape[1] - 1)))
    assert len({*map(frozenset, relief.triangle_indices.tolist())}) == 2 * (high.shape[0] - 1) * (high.shape[1] - 1)
    share = (high - high.min()) / max(np.ptp(high), 1e-9)
    shade = relief.vertex_colors.reshape(*high.shape, 3)
    np.testing.assert_allclose(shade, np.repeat((100 + 110 * share)[..., None], 3, 2), atol=1)
