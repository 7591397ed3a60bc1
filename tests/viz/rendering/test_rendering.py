"""Rendered walks: what must be seen on them is there, and a machine that cannot render says what it lacks."""

import contextlib
import ctypes.util
import dataclasses
import itertools
import os
import platform
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path

import mujoco
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import mjx_climb as mc
from mjx_climb.robot_import.load import load_model
from mjx_climb.viz import rendering
from mjx_climb.viz.plots.events import whole
from mjx_climb.viz.rendering import backend, canvas, captions, film, marks, surroundings
from tests.robot import climbers
from tests.trajectories import still
from tuning.command_line import main

CONFIG = Path(__file__).parents[3] / "configs" / "case_1_2.yaml"
SMALL = (320, 240)
FEET = np.array([[0.14, 0.14, 0], [-0.14, 0.14, 0], [-0.14, -0.14, 0], [0.14, -0.14, 0]])
PRESSED, PULLED, UNLOADED = (0.0, 0.0, 4.0), (0.0, 0.0, -14.9), (0.0, 0.0, 0.0)


def walk_of(force=UNLOADED, push=UNLOADED, duration=0.4, shift=(0.0, 0.0, 0.0), **overrides):
    """Return a robot that stands, is shifted at an even rate, and has the same force on all feet."""
    scenario = mc.load_scenario(CONFIG, {"duration": duration, "time_step": 0.01, "gait.cycle": 0.4, **overrides})
    stance = load_model(scenario.robot).key_qpos[0]
    way = np.linspace(0, 1, scenario.steps)[:, None] * np.asarray(shift)
    return still(
        scenario, base_position=stance[:3] + way, base_orientation=stance[3:7], joint_angles=stance[7:].reshape(4, 3),
        foot_position=FEET + way[:, None], foot_force=force, grip_point=FEET, base_reference=[0, 0, 0.11],
        push=[*push, 0, 0, 0],
    )  # fmt: skip


@pytest.fixture(scope="session")
def gl():
    try:
        backend.find()
    except rendering.RenderingError as error:
        pytest.skip(str(error))


def picture(*walks, size=SMALL, time=0.2):
    return next(rendering.pictures(walks, [time], size=size))


def amount(image, rgb):
    """Return how many pixels have a colour (in [0, 1]), whatever their brightness: arrows are shaded."""
    pixels, target = image.reshape(-1, 3).astype(float), 255 * np.asarray(rgb)
    length = np.linalg.norm(pixels, axis=1)
    alike = pixels @ target > 0.992 * length * np.linalg.norm(target)
    return int((alike & (length > 0.6 * np.linalg.norm(target))).sum())


# ------------------------------------------------------------------------------------------------------------
# What is on the pictures


@pytest.mark.slow
def test_frames_and_snapshots_cover_the_walks_in_their_order(gl, monkeypatch):
    """A row of snapshots per walk and a column per instant."""
    asked, pictures = [], rendering.pictures
    monkeypatch.setattr(film, "pictures", lambda walks, at, **how: asked.append(at) or pictures(walks, at, **how))
    still, pushed = walk_of(), walk_of(push=(0, 0, 8.0))
    frames = list(rendering.frames(still, fps=10, size=SMALL))
    assert [(frame.shape, frame.dtype) for frame in frames] == [((240, 320, 3), np.uint8)] * 4
    assert rendering.snapshots(still, count=2, size=SMALL).shape == (240, 2 * 320, 3)
    both = rendering.snapshots(still, pushed, times=[0.2], size=SMALL)
    assert both.shape == (2 * 240, 320, 3)
    assert amount(both[240:], marks.PUSH) > amount(both[:240], marks.PUSH) + 50
    for times, expected in zip(asked, ([0, 0.1, 0.2, 0.3], [0.1, 0.3], [0.2]), strict=True):
        np.testing.assert_allclose(times, expected)


@pytest.mark.parametrize("size", [(321, 240), (10, 240), (8192, 240)])
def test_impossible_sizes_are_refused(size):
    with pytest.raises(ValueError, match="even numbers from 64 to 4096"):
        list(rendering.frames(walk_of(), size=size))


@pytest.mark.slow
def test_the_robot_moves(gl):
    for height, least, most in ((0.08, 0.05, 1.0), (0.0, 0.0, 0.0)):
        walk = walk_of(shift=(0, 0, height))
        early, late = (picture(walk, time=t)[60:180, 80:240].astype(int) for t in (0.0, 0.39))
        assert least <= (np.abs(early - late).max(-1) > 30).mean() <= most


@pytest.mark.parametrize(
    ("force", "rgb"), [(PRESSED, marks.PRESSED), (PULLED, marks.pulled(1.0))], ids=["pressed", "pulled to the limit"]
)
def test_forces_appear_in_their_colour(force, rgb, gl):
    without, loaded = (picture(walk_of(f), size=(640, 480)) for f in (UNLOADED, force))
    assert amount(loaded, rgb) > amount(without, rgb) + 200


def test_a_pull_reddens_towards_the_holding_limit_and_a_press_does_not():
    for limit, share in ((15.0, 0.5), (None, 0.0)):
        np.testing.assert_array_equal(marks.color(np.array([0, 0, -7.5]), limit), marks.pulled(share))
    np.testing.assert_array_equal(marks.color(np.array([0, 0, 30.0]), 15.0), marks.PRESSED)
    lightness = [np.dot(marks.pulled(share), [0.2126, 0.7152, 0.0722]) for share in np.linspace(0, 1, 9)]
    assert (np.diff(lightness) < 0).all()  # reads without colours


def test_an_arrow_is_as_long_as_its_force(gl):
    model = surroundings.model([walk_of(gravity=[0, 0, 0])])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = canvas.View(np.zeros(3), 4.0, canvas.AZIMUTH, np.zeros(3))
    start, end = np.array([0, 0, -0.3]), np.array([0, 0, 0.4])
    with canvas.Canvas(model, 480, 480) as made:
        bare = made.draw(data, view, lambda scene: None).astype(int)
        shown = made.draw(data, view, lambda scene: marks.arrow(scene, start, end, marks.PUSH))
    rows = np.flatnonzero((np.abs(shown - bare).max(-1) > 40).any(1))
    _, up, forward = view.axes()
    focal = 240 / np.tan(np.deg2rad(model.vis.global_.fovy) / 2)
    heights = [focal * (point @ up) / (4.0 + point @ forward) for point in (start, end)]
    assert (240 - rows[-1], 240 - rows[0]) == (pytest.approx(heights[0], abs=5), pytest.approx(heights[1], abs=5))


def test_the_ground_has_no_specks_of_its_own_shadow(gl):
    model = surroundings.model([walk_of(gravity=[0, 0, -1.6])])
    data = mujoco.MjData(model)
    view = canvas.View(np.zeros(3), 1.6, canvas.AZIMUTH, np.zeros(3))
    pictures = []
    with canvas.Canvas(model, 480, 360) as made:
        for height, shadow in ((0.11, 1), (0.11, 0), (9.0, 1), (9.0, 0)):  # at 9 m the robot is above the sun
            data.qpos[2] = height
            mujoco.mj_forward(model, data)
            made.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadow
            pictures.append(made.draw(data, view, lambda scene: None).astype(int))
    with_robot, alone = ((unshaded - shaded).min(-1) > 5 for shaded, unshaded in (pictures[:2], pictures[2:]))
    assert with_robot.sum() > 500
    assert alone.sum() == 0


def test_words_for_forces_and_walks():
    assert captions.newtons(4.0e144) == "over 10 kN"  # no number tells more
    assert (captions.newtons(2345.0), captions.newtons(3.14159)) == ("2.3 kN", "3.1 N")
    names, values = film.viewer_words(walk_of(PRESSED), 0)
    assert dict(zip(names.splitlines(), values.splitlines(), strict=True))["controller"] == "base admittance"


def test_walks_shown_together_share_the_scale_of_their_arrows():
    weak, strong = walk_of((0, 0, 2.0)), walk_of((0, 0, 8.0))
    assert marks.scale([weak, strong]) == marks.scale([strong]) < marks.scale([weak])


@pytest.mark.slow
def test_a_torn_limb_and_a_walk_that_diverged_are_shown(gl):
    walk = walk_of(PRESSED)
    walk.torn_off[10, 1], walk.detached[11:, 1] = True, True
    walk.base_position[30:] = np.nan
    assert whole(walk) == 30
    before, after = picture(walk, time=0.05), picture(walk, time=0.2)
    assert amount(after, np.array([0.82, 0, 0])) > amount(before, np.array([0.82, 0, 0]))
    np.testing.assert_array_equal(picture(walk, time=0.29), picture(walk, time=0.39))


def test_the_trace_of_forces_peaks_where_the_walk_does_and_a_line_runs_with_the_film():
    walk = walk_of()
    forces = np.zeros_like(walk.foot_force)
    forces[30, 2, 0], forces[:, 0, 2] = 8.0, 1.0
    trace = captions.ForceTrace([dataclasses.replace(walk, foot_force=forces)], 0, (320, 60))
    line = np.all(trace.at(0.0) == 255, axis=2).sum(0).argmax()
    for time in (0.1, 0.15):
        now = np.all(trace.at(time) == 255, axis=2).sum(0).argmax()
        assert now == pytest.approx(line + (320 - 1.3 * line) * time / walk.time[-1], abs=1.5)
    blue = (trace.at(0.0).astype(int)[..., 2] - trace.at(0.0)[..., 0])[:, line + 5 :]
    peak = np.flatnonzero(blue.max(1) > 60).min()
    at = (blue[peak] > 60).nonzero()[0].mean() + line + 5
    assert at == pytest.approx(line + (320 - 1.3 * line) * walk.time[30] / walk.time[-1], abs=3)


# ------------------------------------------------------------------------------------------------------------
# Scene and camera


def test_decoration_leaves_the_robot_as_it_was():
    robot = load_model("hubrobo_v3_2")
    for gravity in (0.0, 1.6, 3.7, 9.8):
        scene = surroundings.model([walk_of(gravity=[0, 0, -gravity])])
        for name in ("body_mass", "body_inertia", "body_ipos", "jnt_range"):
            np.testing.assert_array_equal(getattr(scene, name), getattr(robot, name))
        assert not scene.geom_contype.any()


def test_the_ground_passes_just_below_every_grip():
    grips = np.concatenate([FEET[:, :2], [[0.0], [0.03], [-0.02], [0.01]]], axis=1)
    relief = surroundings.relief_of(np.random.default_rng(0), 0.16, grips)
    axis = np.linspace(-surroundings.REACH, surroundings.REACH, surroundings.CELLS)
    for grip in grips:
        row, column = np.abs(axis - grip[1]).argmin(), np.abs(axis - grip[0]).argmin()
        assert grip[2] - 0.012 < relief[row, column] <= grip[2]


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (-4.9, 0.0, -8.5), (-9.81, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_down_is_down_in_the_picture(gravity):
    view = canvas.View(np.zeros(3), 1.0, canvas.AZIMUTH, np.array(gravity))
    right, up, forward = view.axes()
    np.testing.assert_allclose(view.axes() @ view.axes().T, np.eye(3), atol=1e-12)
    assert np.cross(right, up) @ forward == pytest.approx(-1)
    assert not any(gravity) or (gravity @ up < 0 and abs(gravity @ right) < 1e-9)


MAGENTA = (1.0, 0.0, 1.0)
EARTH = (0.0, 0.0, -9.81)


def standing(robot, gravity=EARTH, at=0.0, falls=0.0):
    """Return a robot that stands on ground at a height, m, and falls by so many metres away from it."""
    scenario = mc.Scenario.model_validate({**robot, "duration": 0.4, "time_step": 0.01, "gravity": gravity})
    model = load_model(scenario.robot)
    data, stance = mujoco.MjData(model), model.key_qpos[0].copy()
    stance[2] += at
    data.qpos[:] = stance
    mujoco.mj_kinematics(model, data)
    way = np.linspace(0, 1, scenario.steps)[:, None] ** 2 * np.array([0, 0, falls])
    feet, joints = data.site_xpos.copy(), stance[7:].reshape(model.nsite, -1)
    return still(
        scenario, base_position=stance[:3] + way, base_orientation=stance[3:7], joint_angles=joints,
        foot_position=feet + way[:, None], grip_point=feet, base_reference=stance[:3], foot_force=UNLOADED,
        push=np.zeros(6),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("size", "how"),
    [
        (1.0, {}),
        (1.0, {"gravity": (0.0, 0.0, 9.81)}),
        pytest.param(1.0, {"gravity": (-1.62, 0.0, 0.0)}, marks=pytest.mark.slow),
        pytest.param(10.0, {"gravity": (0.0, 0.0, 0.0)}, marks=pytest.mark.slow),
        pytest.param(0.1, {}, marks=pytest.mark.slow),
        (1.0, {"at": 3.0}),
        (1.0, {"gravity": (0.0, 0.0, 9.81), "falls": 12.0}),
        pytest.param(1.0, {"falls": -1e9}, marks=pytest.mark.slow),
    ],
    ids=["on the ground", "ceiling", "cliff", "large", "small", "high up", "falls off", "diverges"],
)
def test_the_camera_finds_the_robot(gl, monkeypatch, tmp_path, size, how):
    """It is whole, in the middle, and as large wherever it is: counted by pixels of a robot that is painted."""
    file = tmp_path / "climber.xml"
    scaled = lambda pos: f'pos="{" ".join(str(size * float(number)) for number in pos[1].split())}"'  # noqa: E731
    file.write_text(re.sub('pos="([^"]*)"', scaled, climbers.mjcf(4, 3)))
    sections = climbers.config(file, 4, 3, foothold=0.24 * size, height=0.12 * size)
    painted, made = surroundings.model, []

    def painting(walks):
        model = painted(walks)
        own = model.geom_bodyid > 0
        model.geom_matid[own], model.geom_rgba[own] = -1, [*MAGENTA, 1]
        made.append(model)
        return model

    monkeypatch.setattr(surroundings, "model", painting)
    shown = picture(standing(sections, **how), time=0.3)
    assert amount(shown, MAGENTA) > 300
    rows, columns = np.nonzero((shown[..., 0] > 90) & (shown[..., 2] > 90) & (shown[..., 1] < 60))
    assert 5 < rows.min() < 90 and 150 < rows.max() < 235
    assert 5 < columns.min() and columns.max() < 315


# ------------------------------------------------------------------------------------------------------------
# Files


@pytest.mark.slow
def test_a_video_decodes_with_the_right_frames_and_duration(gl, tmp_path):
    import av

    walk, told = walk_of(PRESSED), []
    path = rendering.save_video(
        tmp_path / "walk.mp4", walk, walk, fps=10, size=SMALL, progress=lambda *a: told.append(a)
    )
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
        assert (stream.codec_context.name, stream.pix_fmt, float(stream.average_rate)) == ("h264", "yuv420p", 10)
        assert float(stream.duration * stream.time_base) == pytest.approx(0.4)
    assert [frame.shape for frame in frames] == [(240, 640, 3)] * 4
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    shown = next(rendering.frames(walk, walk, fps=10, size=SMALL))
    assert np.abs(frames[0].astype(int) - shown).mean() < 6
    assert [p.name for p in tmp_path.iterdir()] == ["walk.mp4"]


def test_an_interrupted_video_leaves_nothing(tmp_path):
    def pictures():
        yield np.zeros((64, 64, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rendering.encode(tmp_path / "walk.mp4", pictures(), 25, (64, 64))
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------------------
# Machines that cannot render


def test_a_robot_from_a_file_is_shown_with_its_feet(gl, tmp_path):
    """Each limb in its own colour, as far as the place that is taken for its foot; a white trunk stands out."""
    file = tmp_path / "climber.xml"
    file.write_text(climbers.mjcf(4, 3, on_base='<geom type="box" size="0.05 0.05 0.02" rgba="1 1 1 1"/>'))
    robot = mc.Scenario.model_validate(climbers.config(file, 4, 3)).robot
    long_limbs = rendering.stance(robot)
    limbs = {name: limb.model_dump() for name, limb in robot.limbs.items()}
    limbs["limb0"]["at"] = (-0.08, 0, 0)
    shorter = rendering.stance(robot.model_validate(robot.model_dump() | {"limbs": limbs}))
    assert (long_limbs.min(-1) > 200).sum() > 2000 and (shorter[:50, :50].max(-1) < 180).all()
    colored = np.ptp(long_limbs.astype(int), axis=-1) > 60
    assert colored.any(1).sum() > 250 and colored.any(0).sum() > 400
    for number, color in enumerate(marks.PATHS[:4]):
        long, short = (amount(picture, to_rgb(color)) for picture in (long_limbs, shorter))
        assert long > 150
        assert (short < 0.9 * long) == (number == 0)


NO_DISPLAY = {"DISPLAY": None, "WAYLAND_DISPLAY": None}
INSTALL = "tried egl, osmesa); on Debian and Ubuntu install libegl1 and libgl1, or libosmesa6"


@pytest.mark.parametrize(
    ("options", "environment", "works", "expected"),
    [
        ("--video", NO_DISPLAY | {"MUJOCO_GL": None}, False, INSTALL),
        ("--snapshots", NO_DISPLAY | {"MUJOCO_GL": None}, False, INSTALL),
        ("--video", {"MUJOCO_GL": "off"}, None, "MUJOCO_GL=off"),
        ("--video", {"MUJOCO_GL": "opengl"}, None, "MUJOCO_GL: expected egl, osmesa, glfw or off, got 'opengl'"),
        ("--video", {"MUJOCO_GL": "egl"}, False, "(tried egl); on Debian and Ubuntu install libegl1 and libgl1"),
        # tried for real: GLFW without a display, which would end the process
        ("--video", NO_DISPLAY | {"MUJOCO_GL": "glfw"}, None, "(tried glfw); MUJOCO_GL=egl needs no display"),
        ("--view", NO_DISPLAY, None, "neither DISPLAY nor WAYLAND_DISPLAY"),
        ("--view", {"WAYLAND_DISPLAY": None, "DISPLAY": ":nowhere"}, None, "got :nowhere, which does not"),
        ("--view", {"WAYLAND_DISPLAY": "nowhere", "DISPLAY": None}, None, "got nowhere, which does not"),
        ("--video", {"MUJOCO_GL": "on", "WAYLAND_DISPLAY": "x"}, False, "tried egl, osmesa, glfw); on Debian"),
        ("--video", {"MUJOCO_GL": "GLX", "DISPLAY": None}, False, "tried egl, osmesa); on Debian"),
        ("--video", {"MUJOCO_GL": "OSMesa"}, False, "(tried osmesa); on Debian and Ubuntu install libosmesa6"),
        *(
            (f"--snapshots --at={at}", {}, True, "--at: expected up to 12 times from 0 to 8 s")
            for at in ("-1", "0.1,9", "nan")
        ),
        ("--snapshots --at=soon", {}, True, "--at: expected a number, got 'soon'"),
        ("--snapshots --at=", {}, True, "--at: expected a number, got ''"),
    ],
)
def test_what_cannot_be_shown_is_refused_before_the_walk(
    options, environment, works, expected, capsys, monkeypatch, tmp_path
):
    """In one line, with code 2, and nothing is written."""
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.setattr(mc, "rollout", lambda *_, **__: pytest.fail("walked"))
    monkeypatch.setattr(backend, "find", backend.find.__wrapped__)  # nothing remembered
    for name, value in environment.items():
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    if works is not None:
        monkeypatch.setattr(backend, "works", lambda name: works)
    with pytest.raises(SystemExit) as ended:
        main(["run", str(CONFIG), "--out", str(tmp_path / "out"), *options.split()])
    out, err = capsys.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert expected in err and not (tmp_path / "out").exists()


def beside(*command, **environment):
    """Run a command in a process of its own, in which this file is a module."""
    folders = os.pathsep.join([str(Path(__file__).parent), str(CONFIG.parents[1])])
    inherited = {key: value for key, value in os.environ.items() if key != "PYOPENGL_PLATFORM"}  # this process's own
    environment = {**inherited, "PYTHONPATH": folders, **environment}
    return subprocess.run(command, env=environment, cwd=CONFIG.parents[1], capture_output=True, text=True, timeout=120)


WITHOUT = """
import ctypes.util, sys
found = ctypes.util.find_library
ctypes.util.find_library = lambda name: None if name in ("EGL", "OSMesa") else found(name)
from mjx_climb.viz.rendering import backend
from tuning.command_line import main
backend.works = lambda name: False
main(sys.argv[1:])
"""


@pytest.mark.nightly
def test_a_library_that_is_not_installed_is_named(tmp_path):
    """In a process of its own, because MuJoCo's import fails where the OpenGL of MUJOCO_GL is missing."""
    arguments = ["run", str(CONFIG), "--video", "--out", str(tmp_path / "out")]
    run = beside(sys.executable, "-c", WITHOUT, *arguments, MUJOCO_GL="osmesa")
    assert (run.returncode, run.stdout, len(run.stderr.splitlines())) == (2, "", 1)
    assert "(tried osmesa); on Debian and Ubuntu install libosmesa6" in run.stderr and not (tmp_path / "out").exists()


DRAW = """
import sys
import types
import test_rendering as tests
from mjx_climb.viz.rendering import backend, save_image
save_image(sys.argv[1], tests.picture(tests.walk_of(tests.PRESSED)))
assert backend.find() == sys.argv[2]
"""


@pytest.mark.nightly
@pytest.mark.parametrize(("name", "library"), [("egl", "EGL"), ("osmesa", "OSMesa")])
def test_every_way_to_opengl_draws_the_same_picture(name, library, tmp_path):
    from PIL import Image

    if platform.system() != "Linux" or ctypes.util.find_library(library) is None:
        pytest.skip(f"lib{library} is not installed")
    drawn = tmp_path / "drawn.png"
    run = beside(sys.executable, "-c", DRAW, drawn, name, MUJOCO_GL=name)
    assert run.returncode == 0, run.stderr
    here = picture(walk_of(PRESSED)).astype(int)
    with Image.open(drawn) as there:
        assert np.abs(np.asarray(there) - here).mean() < 2


WATCH = """
import time
import test_rendering as tests
from scipy.stats import theilslopes
from mjx_climb.viz import rendering
from mjx_climb.viz.rendering import marks

shown, forces = [], marks.forces

def watched(scene, trajectory, row, scale):
    before = scene.ngeom
    forces(scene, trajectory, row, scale)
    shown.append((time.perf_counter(), trajectory.time[row], scene.ngeom - before))

marks.forces = watched
pressed, unloaded = (tests.walk_of(force, duration=2.0) for force in (tests.PRESSED, tests.UNLOADED))
rendering.view(pressed, unloaded, rounds=1)
second = next(i for i, now in enumerate(shown) if i and now[1] < shown[i - 1][1])
for walk in (shown[:second], shown[second:]):
    real, walked, arrows = zip(*(now for now in walk if 0.2 < now[1] < 1.8))
    speed = theilslopes(walked, real).slope  # whatever the system does for a while at one of the pictures
    print(len(walked), speed, *sorted(set(arrows)))
"""


@pytest.mark.slow
@pytest.mark.timing
def test_the_viewer_plays_walks_in_turn_in_real_time_shows_their_forces_and_ends():
    """On a display of its own, without a graphics card; a process that ends before the viewer's thread would crash."""
    if shutil.which("xvfb-run") is None:
        pytest.skip("xvfb is not installed")
    run = beside("xvfb-run", "-a", "-s", "-screen 0 640x480x24", sys.executable, "-c", WATCH)
    assert run.returncode == 0, run.stderr
    for line, expected in zip(run.stdout.splitlines(), (4, 0), strict=True):
        pictures, speed, arrows = map(float, line.split())
        assert pictures > 5
        assert speed == pytest.approx(1, abs=0.1)
        assert arrows == expected


def test_a_context_that_does_not_exist_or_hangs_does_not_work(monkeypatch):
    assert not backend.works("no_such_context")
    monkeypatch.setattr(backend, "TRIAL", "while True: pass")
    monkeypatch.setattr(backend, "TRIAL_SECONDS", 0.1)
    assert not backend.works("egl")


@pytest.mark.slow
def test_run_shows_two_controllers_in_a_video_snapshots_and_the_viewer(gl, monkeypatch, tmp_path, capsys):
    import av
    from PIL import Image

    viewed = []
    monkeypatch.setattr(backend, "require_display", lambda: None)
    monkeypatch.setattr(rendering, "view", lambda *walks, **_: viewed.extend(walks))
    short = "--set duration=0.2 --compare pd --view --video --snapshots --at 0.1 --size 320x240"
    with pytest.raises(SystemExit) as ended:
        main(["run", str(CONFIG), "--out", str(tmp_path), *short.split()])
    assert ended.value.code == 0
    assert [walk.scenario.control.controller for walk in viewed] == ["pd", "base_admittance"]
    err = capsys.readouterr().err
    assert all(name in err for name in ("walk.mp4", "snapshots.png", "comparison.png", "5 of 5 frames"))
    with Image.open(tmp_path / "snapshots.png") as strip:
        assert strip.size == (320, 480)
    assert (tmp_path / "comparison.png").stat().st_size > 0
    with av.open(str(tmp_path / "walk.mp4")) as video:
        assert [(f.width, f.height) for f in video.decode(video=0)] == [(640, 240)] * 5


def test_marks_stop_where_the_scene_is_full():
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    scene = mujoco.MjvScene(model, maxgeom=3)
    marks.around(scene, walk_of(), 5)
    assert scene.ngeom == 3


def test_films_and_strips_show_the_instants_that_are_asked_for(monkeypatch, tmp_path):
    """With plain pictures in place of rendered ones: 10 for each instant, 1 for each walk."""
    import av
    from PIL import Image

    asked = []

    def pictures(walks, times, *, labels=None, size, trace=0.0):
        asked.append((len(walks), np.round([*times], 9).tolist(), labels, size, trace))
        for number, _ in enumerate(asked[-1][1]):
            yield (
                np.repeat([[[20 * number + 100 * n] * 3 for n in range(len(walks))]], size[1], 0)
                .repeat(size[0], 1)
                .astype(np.uint8)
            )

    monkeypatch.setattr(film, "pictures", pictures)
    both, names, size = (walk_of(duration=0.2), walk_of()), ["a", "b"], (64, 80)
    strip = rendering.snapshots(*both, count=2, labels=names, size=size)
    assert strip.shape == (160, 128, 3) and strip[::80, ::64, 0].tolist() == [[0, 20], [100, 120]]
    assert rendering.snapshots(both[0], times=[0.05], size=size).shape == (80, 64, 3)
    assert len([*rendering.frames(*both, labels=names, fps=10, size=size)]) == 4
    done = []
    path = rendering.save_video(
        tmp_path / "a.mp4", *both, labels=names, fps=10, size=size, progress=lambda *now: done.append(now)
    )
    assert done == [(n, 4) for n in range(1, 5)] and path == tmp_path / "a.mp4"
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [frame.shape for frame in frames] == [(80, 128, 3)] * 4
    np.testing.assert_allclose(
        [frame[40, [32, 96], 0] for frame in frames], [[20 * n, 20 * n + 100] for n in range(4)], atol=6
    )
    assert asked == [
        (2, [0.1, 0.3], names, size, 0.0), (1, [0.05], None, size, 0.0),
        *[(2, [0.0, 0.1, 0.2, 0.3], names, size, 0.16)] * 2,
    ]  # fmt: skip
    assert rendering.save_image(tmp_path / "a.png", strip) == tmp_path / "a.png"
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(image, strip)


def test_the_viewer_shows_walk_after_walk_with_a_pause(monkeypatch):
    """By a stand-in for its window, and a clock that is a tenth of a second later for each picture."""
    shown, clock, scene = [], itertools.count(), mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), 200)
    walks = walk_of(PRESSED, duration=0.2), walk_of(PULLED, shift=(0, 0, 0.1), **{"contact.holding_limit": 20.0})
    window = types.SimpleNamespace(lock=contextlib.nullcontext, user_scn=scene, is_running=lambda: True)
    window.cam = types.SimpleNamespace(lookat=np.zeros(3))
    window.set_texts = lambda texts: setattr(window, "texts", texts)

    @contextlib.contextmanager
    def launch_passive(model, data, show_left_ui, show_right_ui):
        assert not show_left_ui and not show_right_ui
        window.model = model
        window.sync = lambda: shown.append((data.qpos.copy(), window.texts, scene.ngeom))
        yield window

    monkeypatch.setitem(sys.modules, "mujoco.viewer", types.SimpleNamespace(launch_passive=launch_passive))
    monkeypatch.setattr(film, "require_display", lambda: None)
    still = types.SimpleNamespace(perf_counter=lambda: next(clock) / 10, sleep=lambda seconds: None)
    monkeypatch.setattr(film, "time", still)
    rendering.view(*walks, until=lambda: True)
    assert next(clock) == 1 and not shown  # asked before the first picture
    window.is_running = lambda: len(shown) < 3
    rendering.view(*walks, rounds=1)
    assert len(shown) == 3  # closed by its user
    window.is_running, clock = lambda: True, itertools.count()
    shown.clear()
    rendering.view(*walks, rounds=1)
    start = canvas.follower(walks, surroundings.model(walks), 1.5)(walks[0], 0.0)
    assert (window.cam.distance, window.cam.azimuth, window.cam.elevation) == (start.distance, 98, -38)
    np.testing.assert_allclose(window.cam.lookat, start.target)
    assert window.model.geom("relief").rgba[3] == window.model.mat("paint").rgba[3] == pytest.approx(0.6)
    assert not window.model.light("sun").castshadow[0]
    instants = np.arange(1, 28) / 10  # both, each as long as the longer one and a pause
    assert len(shown) == len(instants)
    for instant, (pose, texts, marked) in zip(instants, shown, strict=True):
        turn, now = divmod(round(instant, 9), 1.4)
        walk = walks[int(turn) % 2]
        row = min(round(now / 0.01), len(walk.time) - 1)
        np.testing.assert_allclose(pose[:3], walk.base_position[row])
        other = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), 200)
        marks.around(other, walk, row)
        marks.forces(other, walk, row, marks.scale(walks))
        assert texts == (None, None, *film.viewer_words(walk, row)) and marked == other.ngeom
