"""Numbers behind pictures of random walks: events, scales of colours, marks in the scene, the camera and the ground."""

import dataclasses
import itertools
import math

import av
import mujoco
import numpy as np
import pytest
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure

import mjx_climb as mc
from mjx_climb.robot_import.description import compiled
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from mjx_climb.viz import plots
from mjx_climb.viz.plots import events, maps
from mjx_climb.viz.plots.styling import CARGO, LIMB_COLORS, PUSH
from mjx_climb.viz.rendering import canvas, captions, film, marks, surroundings
from tests.robot import climbers
from tests.trajectories import still

PUSHES = [
    {"force": [-5.0, 0.0, 0.0], "start": 0.02, "stop": 0.05},
    {"force": [3.0, 4.0, 0.0], "moment": [0.0, 0.0, 0.25], "start": 0.03},
    {"force": [0.0, 0.0, 0.0], "start": 0.01, "stop": 0.02},
    {"force": [1.0, 0.0, 0.0], "start": 0.2, "stop": 0.3},
]
HOLDS = {"points": [
    {"at": [0.2, 0.1, 0.01], "normal": [0, 0.6, 0.8], "limit": 3.0}, {"at": [0.1, 0.1, 0], "limit": 1.5},
                    {"at": [0.15, -0.1, 0.0]}]}  # fmt: skip
SCENARIO = mc.Scenario().with_overrides({
    "duration": 0.06, "gait.cycle": 0.06, "disturbance.pushes": PUSHES,
    "disturbance.cargo": {"mass": 0.5, "start": 0.01, "stop": 0.04}, "ground.holds": HOLDS,
})  # fmt: skip
ROWS = 60


def drawn(seed=0, scenario=SCENARIO, **more):
    """A walk of random numbers near a stance."""
    draw, walk = np.random.default_rng(seed), still(scenario)
    rows, feet = len(walk.time), 0.2 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0.1]])
    base = np.column_stack([np.linspace(0, 0.02, rows), np.zeros(rows), np.full(rows, 0.1)])
    series = {
        "base_position": base + 0.002 * draw.normal(size=base.shape), "base_reference": base,
        "base_orientation": np.tile([1.0, 0, 0, 0], (rows, 1)),
        "foot_position": feet + 0.004 * draw.normal(size=(rows, 4, 3)),
        "foot_force": 3 * draw.normal(size=(rows, 4, 3)),
        "joint_angles": np.tile(walk.robot.stance_joints, (rows, 1, 1)),
        "grip_point": np.tile(feet, (rows, 1, 1)), "support": draw.random((rows, 4)) < 0.9,
    }  # fmt: skip
    return dataclasses.replace(walk, **(series | more))


# ----------------------------------------------------------------------------------------------------------- events


def test_disturbances_are_named_by_their_axis_or_size():
    found = events.disturbances(drawn())
    minus = "\N{MINUS SIGN}"
    assert found == [
        (0.01, 0.04, "cargo 0.5 kg", CARGO), (0.02, 0.05, f"{minus}5 N x", PUSH),
        (0.03, pytest.approx(0.06), "5 N, +0.25 N m z", PUSH), (0.01, 0.02, "push", PUSH),
    ]  # fmt: skip
    assert events.disturbances(drawn(scenario=mc.Scenario().with_overrides({"duration": 0.06}))) == []


@pytest.mark.parametrize("series", ["base_position", "joint_angles", "joint_rates", "foot_position", "foot_force"])
@pytest.mark.parametrize("at", [None, 0, 1, 30, 59])
def test_a_walk_can_be_shown_up_to_its_first_number_that_is_none(series, at):
    walk = drawn()
    if at is not None:
        values = getattr(walk, series).copy()
        values.reshape(ROWS, -1)[at, -1] = np.nan
        values.reshape(ROWS, -1)[min(at + 2, ROWS - 1), 0] = np.inf
        walk = dataclasses.replace(walk, **{series: values})
    rows = ROWS if at is None else at
    assert (events.finite_rows(walk), events.whole(walk)) == (rows, max(rows, 1))
    for time in (-1.0, 0.0, 0.0104, 0.0106, 0.03, 1.0):
        assert events.row_at(walk, time) == min(max(round(time / 0.001), 0), max(rows, 1) - 1)
    end = 0.06 if at in (None, 0) else min(0.06, 1.1 * 0.001 * at)  # one that diverged at once has no time to show
    assert events.end_of(walk) == pytest.approx(end)
    assert events.failure_time(walk) == (math.inf if at is None else pytest.approx(0.5 * 0.001 * at))


def test_grippers_are_torn_once_and_change_where_nobody_tore_them():
    draw = np.random.default_rng(1)
    torn, detached, support = (draw.random((ROWS, 4)) < share for share in (0.05, 0.05, 0.7))
    walk = drawn(torn_off=torn, detached=detached, support=support)
    expected = [
        (0.001 * row, walk.limbs[n]) for row in range(ROWS) for n in range(4) if torn[row, n] and not detached[row, n]
    ]
    assert events.detachments(walk) == pytest.approx(expected) if not expected else True
    assert [limb for _, limb in events.detachments(walk)] == [limb for _, limb in expected]
    np.testing.assert_allclose([time for time, _ in events.detachments(walk)], [time for time, _ in expected])
    assert events.failure_time(walk) == pytest.approx(expected[0][0])
    holds = support | torn | detached
    changes = [0.001 * row for row in range(1, ROWS) if any(holds[row, n] != holds[row - 1, n] for n in range(4))]
    np.testing.assert_allclose(events.grip_changes(walk), changes)


def test_sizes_are_those_of_vectors():
    walk = drawn()
    forces = [max(math.hypot(*force) for force in row) for row in walk.foot_force]
    np.testing.assert_allclose(events.largest_foot_force(walk), forces)
    apart = [math.dist(foot, walk.base_position[0]) for foot in walk.foot_position[0]]
    assert events.size_of(walk) == pytest.approx(sum(apart) / 4 / 0.23)


@pytest.mark.parametrize("count", [10, 1500, 1501, 4003])
def test_a_thinned_line_has_both_extremes_of_every_stretch(count):
    draw = np.random.default_rng(count)
    time, values = np.arange(count) / 7.0, draw.normal(size=count)
    values[draw.integers(count, size=3)] = np.nan
    thin, kept = events.thin(time, values)
    if count <= 1500:
        assert thin is time and kept is values
        return
    rows, size = np.round(thin * 7).astype(int), math.ceil(2 * count / 1500)
    np.testing.assert_array_equal(kept, values[rows])
    expected = {0, count - 1}
    for start in range(0, count, size):
        part = [n for n in range(start, min(start + size, count)) if np.isfinite(values[n])]
        expected |= {min(part, key=lambda n: values[n]), max(part, key=lambda n: values[n])} if part else set()
    assert expected <= {*rows.tolist()} and len(rows) <= 1510 and (np.diff(rows) > 0).all()


# ------------------------------------------------------------------------------------------------------------- maps


@pytest.mark.parametrize("seed", range(30))
def test_a_scale_of_colours_is_of_the_walks_that_held(seed):
    draw = np.random.default_rng(seed)
    values = 10.0 ** (draw.choice([0.02, 0.5, 2.0]) * draw.normal(size=(3, 4))) * draw.choice([1.0, -1.0, 1e-3])
    values[draw.random((3, 4)) < 0.1] = np.nan
    failed = draw.random((3, 4)) < draw.choice([0.2, 0.9])
    baseline = draw.choice(
        [None, float(np.nanmedian(values)), float(np.nanmax(values) * 1.2), float(np.nanmin(values)) - 9, math.nan]
    )
    larger = bool(draw.random() < 0.5)
    norm, extend = plots.color_scale(values, failed, baseline, larger)
    finite = [v for v in values.ravel() if math.isfinite(v)]
    held = [v for v, f in zip(values.ravel(), failed.ravel(), strict=True) if math.isfinite(v) and not f]
    low, high = np.percentile(held if len(held) > 3 else finite, [2, 98])
    if baseline is not None and math.isfinite(baseline):
        half = (high - low) / 2
        if baseline > low - half:
            low = min(low, baseline)
        if baseline < high + half:
            high = max(high, baseline)
        if low < baseline < high:
            low, high = (
                (max(low, baseline - 3 * (high - baseline)), high)
                if larger
                else (low, min(high, baseline + 3 * (baseline - low)))
            )
    span = 0.05 * max(abs(low), abs(high))
    if high - low < span:
        low, high = (low + high) / 2 - span / 2, (low + high) / 2 + span / 2
    assert (norm.vmin, norm.vmax) == pytest.approx((low, high))
    passed = min(finite) < low - 1e-9 * abs(low), max(finite) > high + 1e-9 * abs(high)
    assert (
        extend == {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[passed]
    )
    assert isinstance(norm, LogNorm) == (low > 0 and high > 30 * low)


def test_a_scale_of_no_values_is_from_0_to_1():
    norm, extend = plots.color_scale(np.full((2, 2), np.nan), np.ones((2, 2), bool), 3.0)
    assert (norm.vmin, norm.vmax, extend) == (0, 1, "neither")
    norm, _ = plots.color_scale(np.zeros((2, 2)), np.zeros((2, 2), bool), None)
    assert (norm.vmin, norm.vmax) == pytest.approx((-0.025, 0.025))


def test_which_walks_failed_and_which_compare():
    draw = np.random.default_rng(0)
    dims, shape = ("stiffness", "damping"), (3, 4)
    at = np.where(draw.random(shape) < 0.3, 1.5, np.nan)
    limb, diverged = np.where(draw.random(shape) < 0.3, 2, -1), draw.random(shape) < 0.3
    own = {"larger_is_better": 0}
    data = xr.Dataset({
        "peak_foot_force": (dims, draw.random(shape), own), "detached_at": (dims, at, own),
        "diverged": (dims, diverged, own),
        "detached_limb": (dims, limb), "other": (dims, draw.random(shape)),
    }, {"stiffness": [1.0, 2.0, 3.0], "damping": [1.0, 2.0, 3.0, 4.0]})  # fmt: skip
    torn = np.isfinite(at) | (limb >= 0)
    np.testing.assert_array_equal(plots.failed_walks(data, "stiffness", "damping"), (torn | diverged).T)
    np.testing.assert_array_equal(plots.failed_walks(data, "damping", "stiffness"), torn | diverged)
    for left, expected in (
        (["detached_limb", "diverged"], np.isfinite(at)), (["detached_at", "diverged"], limb >= 0),
        (["detached_at", "detached_limb"], diverged),
        (["detached_at", "detached_limb", "diverged"], np.zeros(shape, bool)),
    ):  # fmt: skip
        np.testing.assert_array_equal(plots.failed_walks(data.drop_vars(left), "damping", "stiffness"), expected)
    force = data["peak_foot_force"].values
    np.testing.assert_array_equal(plots.comparable(data, "peak_foot_force"), np.where(diverged, np.nan, force))
    for name in ("detached_at", "diverged", "other"):  # failures themselves, and what is no metric
        np.testing.assert_array_equal(plots.comparable(data, name), data[name])
    without = data.drop_vars("diverged")
    np.testing.assert_array_equal(plots.comparable(without, "peak_foot_force"), force)


@pytest.mark.parametrize(("attributes", "label"), [
    ({"units": "N", "long_name": "a force"}, "a force [N]"), ({"units": "1"}, "some name"), ({}, "some name"),
    ({"units": ""}, "some name"), ({"units": "m/s^2"}, "some name [m/s$^2$]"),
])  # fmt: skip
def test_a_quantity_has_its_unit_behind_it(attributes, label):
    values = xr.DataArray(np.ones((2, 2)), {"x": [1.0, 2.0], "y": [1.0, 2.0]}, attrs=attributes)
    figure = plots.plot_map(xr.Dataset({"some_name": values}), "some_name")
    assert figure.axes[1].get_ylabel() == label and maps.larger_is_better(values) is False


# ------------------------------------------------------------------------------------------------ marks in a scene


def scene():
    return mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), maxgeom=2000)


def shapes(made):
    return [
        (g.type, np.array(g.pos), np.array(g.size), np.array(g.mat), np.array(g.rgba)) for g in made.geoms[: made.ngeom]
    ]


ARROW, CAPSULE, CYLINDER, BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{n}")) for n in ("ARROW", "CAPSULE", "CYLINDER", "BOX")
)


def test_an_arrow_of_one_newton_is_as_long_as_the_largest_force_allows():
    walk, size = drawn(), events.size_of(drawn())
    forces = [max(math.hypot(*f) for f in row) for row in walk.foot_force]
    assert marks.scale([walk]) == pytest.approx(0.24 * size / np.quantile(forces, 0.999))
    push = np.zeros((ROWS, 6))
    push[3, :3] = [0.0, 60.0, 80.0]
    assert marks.scale([walk, drawn(push=push)]) == pytest.approx(0.24 * size / 100.0)
    torn = np.zeros((ROWS, 4), bool)
    torn[20:, 2] = True
    early = np.quantile(forces[:21], 0.999)
    push[40] = 1e3  # later than the picture ends
    push[3] = 0.0
    assert marks.scale([drawn(detached=torn, push=push)]) == pytest.approx(0.24 * size / early)


@pytest.mark.parametrize(("force", "limit", "expected"), [
    ([0, 0, 1.0], 3.0, "press"), ([0, 5.0, 0.0], 3.0, "press"), ([0, 0, -1.5], 3.0, 0.5), ([3.0, 0, -4.0], 5.0, 1.0),
    ([0, 0, -9.0], 3.0, 1.0), ([0, 0, -9.0], None, 0.0), ([0, 0, -0.75], 3.0, 0.25), ([0, 0, -0.375], 3.0, 0.125),
])  # fmt: skip
def test_a_pull_has_the_colour_of_its_share_of_the_limit(force, limit, expected):
    tones = [to_rgb(tone) for tone in ("#FFF3A0", "#F0C020", plots.ORANGE, plots.VERMILLION, "#B00020")]
    found = marks.color(np.array(force), limit)
    if expected == "press":
        assert found == to_rgb(plots.SKY)
        return
    below = min(int(expected * 4), 3)
    share = expected * 4 - below
    np.testing.assert_allclose(
        found, [(1 - share) * a + share * b for a, b in zip(tones[below], tones[below + 1], strict=True)]
    )


def test_arrows_end_where_forces_act_and_crosses_are_on_torn_feet():
    torn, detached, push = np.zeros((ROWS, 4), bool), np.zeros((ROWS, 4), bool), np.zeros((ROWS, 6))
    torn[5, 1], detached[5, 2], push[5, :3] = True, True, [0.0, 3.0, 4.0]
    force = np.zeros((ROWS, 4, 3))
    force[5] = [[0, 0, 6.0], [0, 3.0, -4.0], [0, 0, 1e-9], [0, 0, 1e6]]  # one too small to be seen, one too large
    walk, made = drawn(torn_off=torn, detached=detached, push=push, foot_force=force), scene()
    size, scale, limit = events.size_of(walk), 0.01, SCENARIO.contact.holding_limit
    marks.forces(made, walk, 5, scale)
    found, feet = shapes(made), walk.foot_position[5]
    assert [kind for kind, *_ in found] == [ARROW, ARROW, CAPSULE, CAPSULE, CAPSULE, CAPSULE, ARROW]
    hit = walk.base_position[5] - 0.055 * size * np.array([0, 0.6, 0.8])
    for (_, pos, sizes, mat, rgba), start, vector, rgb, width in (
        (found[0], feet[0], scale * force[5, 0], to_rgb(plots.SKY), 1.0),
        (found[1], feet[1], scale * force[5, 1], marks.color(force[5, 1], limit), 1.0),
        (found[6], hit - scale * push[5, :3], scale * push[5, :3], to_rgb("#E24FB0"), 1.5),
    ):
        np.testing.assert_allclose(pos, start, atol=1e-6)
        np.testing.assert_allclose(mat.reshape(3, 3)[:, 2], vector / np.linalg.norm(vector), atol=1e-5)
        np.testing.assert_allclose(sizes, [width * 0.0045 * size] * 2 + [2 * np.linalg.norm(vector)], rtol=1e-4)
        np.testing.assert_allclose(rgba[:3], np.array(rgb) / 2, atol=1e-6)
    for number, foot in ((2, feet[1]), (4, feet[2])):
        for across, (_, pos, sizes, mat, rgba) in zip(([1, 1, 0], [1, -1, 0]), found[number : number + 2], strict=True):
            np.testing.assert_allclose(pos, foot, atol=1e-6)
            np.testing.assert_allclose(np.abs(mat.reshape(3, 3)[:, 2] @ across), math.sqrt(2), rtol=1e-5)
            np.testing.assert_allclose(sizes[[0, 2]], [0.004 * size, 0.028 * size * math.sqrt(2)], rtol=1e-4)
            np.testing.assert_allclose(rgba[:3], to_rgb(plots.RED), atol=1e-6)
    quiet = scene()
    marks.forces(quiet, drawn(foot_force=0 * force), 5, scale)
    assert quiet.ngeom == 0


def test_grips_paths_cargo_and_holds_are_where_they_were():
    grip, mass = drawn().grip_point.copy(), np.where(np.arange(ROWS) >= 10, 0.5, 0.0)
    grip[:30, 0] += [0.05, 0.0, 0.0]
    support = np.ones((ROWS, 4), bool)
    support[:, 1], support[45:, 3] = False, False
    feet = drawn().foot_position.copy()
    feet[:, 0, 0] += 0.02 * (np.arange(ROWS) > 39)
    walk, made = drawn(grip_point=grip, support=support, cargo_mass=mass, foot_position=feet), scene()
    size, row = events.size_of(walk), 50
    marks.around(made, walk, row)
    found = shapes(made)
    holds, rest = found[:3], found[3:]
    away = sorted(HOLDS["points"], key=lambda each: math.dist(each["at"], walk.base_position[row]))
    for (kind, pos, sizes, mat, rgba), point in zip(holds, away, strict=True):
        assert kind == CYLINDER
        np.testing.assert_allclose(pos, point["at"], atol=1e-6)
        np.testing.assert_allclose(mat.reshape(3, 3)[:, 2], point.get("normal", [0, 0, 1]), atol=1e-6)
        np.testing.assert_allclose(sizes[[0, 2]], [0.01 * size, 0.0008 * size], rtol=1e-5)
        limit = point.get("limit")
        rgb = [0.74] * 3 if limit is None else colormaps["viridis"](limit / 3.0)[:3]
        np.testing.assert_allclose(rgba[:3], rgb, atol=1e-6)
    discs = [shape for shape in rest if shape[0] == CYLINDER and shape[2][2] < 0.0021 * size]
    expected = []
    rows = sorted({*range(0, row + 1, 40), row})
    for n in (0, 2, 3):
        points = sorted({tuple(np.round(grip[r, n], 3)) for r in rows if support[r, n]})
        for point in points:
            now = support[row, n] and max(abs(np.array(point) - grip[row, n])) < 1e-3
            expected += [
                (point, 0.031 if now else 0.026, 0.0012, to_rgb(LIMB_COLORS[n])),
                (point, 0.025 if now else 0.022, 0.0016, (0.95,) * 3),
            ]
    assert len(discs) == len(expected)
    for (_, pos, sizes, _, rgba), (point, wide, high, rgb) in zip(discs, expected, strict=True):
        np.testing.assert_allclose(pos, point, atol=1e-6)
        np.testing.assert_allclose(sizes[[0, 2]], [wide * size, high * size], rtol=1e-5)
        np.testing.assert_allclose(rgba[:3], rgb, atol=1e-6)
    pieces = [shape for shape in rest if shape[0] == CYLINDER and shape[2][2] >= 0.0021 * size]
    ways = []
    for n in range(4):
        start = feet[0, n]
        for r in rows[1:]:
            if math.dist(feet[r, n], start) > 0.004 * size:
                ways.append((n, start, feet[r, n]))
                start = feet[r, n]
    assert len(pieces) == len(ways) > 3
    for (_, pos, sizes, _, rgba), (n, start, end) in zip(pieces, ways, strict=True):
        np.testing.assert_allclose(pos, (start + end) / 2, atol=1e-6)
        np.testing.assert_allclose(sizes[[0, 2]], [0.0022 * size, math.dist(start, end) / 2], rtol=1e-4)
        np.testing.assert_allclose(rgba[:3], to_rgb(LIMB_COLORS[n]), atol=1e-6)
    half = (0.5 / 2600) ** (1 / 3) / 2
    boxes = [shape for shape in rest if shape[0] == BOX]
    assert len(boxes) == 3
    for (_, pos, sizes, _, _), sides in zip(boxes, ([1, 1, 1], [1.03, 0.2, 1.03], [0.2, 1.03, 1.03]), strict=True):
        np.testing.assert_allclose(pos, walk.base_position[row] + [0, 0, 0.036 * size + half], atol=1e-6)
        np.testing.assert_allclose(sizes, half * np.array(sides), rtol=1e-5)


# ---------------------------------------------------------------------------------------------- camera, ground, words


@pytest.mark.parametrize("gravity", [[0, 0, -9.81], [1.0, 0.5, -1.4], [0, 0, 0]])
def test_a_view_has_down_below(gravity):
    view = canvas.View(np.zeros(3), 1.0, 30.0, np.array(gravity, float))
    right, up, forward = axes = view.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, up), -forward, atol=1e-12)
    tilt, turn = math.radians(-38), math.radians(30)
    np.testing.assert_allclose(
        forward, [math.cos(tilt) * math.cos(turn), math.cos(tilt) * math.sin(turn), math.sin(tilt)]
    )
    down = np.array(gravity if any(gravity) else [0, 0, -1.0])
    assert right @ down == pytest.approx(0, abs=1e-12) and up @ down < 0


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_the_camera_glides_with_the_reference_and_has_all_in_its_picture(aspect):
    scenario = SCENARIO.with_overrides({"gait.heading": 0.5})
    walk = drawn(
        scenario=scenario,
        base_reference=np.column_stack([np.sin(np.arange(ROWS) / 9), np.arange(ROWS) / 99, np.ones(ROWS)]),
    )
    walk = dataclasses.replace(
        walk,
        base_position=walk.base_reference + 0.01,
        foot_position=np.repeat(walk.base_reference[:, None] + 0.1, 4, 1),
    )
    model = surroundings.model([walk])
    view = canvas.follower([walk], model, aspect)
    one, other = (view(walk, time) for time in (0.01, 0.04))
    assert one.azimuth == pytest.approx(98 + math.degrees(0.5)) and one.distance == other.distance
    # the mean over a cycle, whose ends hold
    path = np.pad(walk.base_reference, ((30, 30), (0, 0)), mode="edge")
    mean = lambda row: path[row + 1 : row + 61].mean(0)  # noqa: E731
    np.testing.assert_allclose(other.target - one.target, mean(40) - mean(10), atol=1e-9)
    data, half = mujoco.MjData(model), math.radians(float(model.vis.global_.fovy)) / 2
    for row in range(0, ROWS, 7):
        canvas.pose(model, data, walk, row)
        now = view(walk, float(walk.time[row]))
        right, up, forward = now.axes()
        eye = now.target - now.distance * forward
        for point in (*data.xpos[1:], *walk.foot_position[row]):
            away = point - eye
            assert abs(away @ up) < math.tan(half) * (away @ forward)
            assert abs(away @ right) < math.tan(half) * aspect * (away @ forward)
    strayed = dataclasses.replace(walk, base_position=np.add(walk.base_reference, [0.0, 0.0, 0.9]))
    beyond = 1 - 0.15 * events.size_of(walk) / 0.9
    lifted = view(strayed, 0.01).target - one.target
    np.testing.assert_allclose(lifted, [0, 0, 0.9 * beyond], atol=1e-6)


def test_what_flies_away_is_shown_as_long_as_it_is_near():
    far = drawn().base_position.copy()
    far[40:] += 31 * events.size_of(drawn())
    assert canvas.shown_rows(drawn(base_position=far)) == 40 and canvas.shown_rows(drawn()) == ROWS
    far[1:] += 100
    assert canvas.shown_rows(drawn(base_position=far)) == 1


def test_the_ground_passes_just_below_the_grips_and_rises_away_from_them():
    grips = np.array([[0.0, 0.0, 0.05], [0.6, 0.3, -0.1], [-0.5, 0.2, 0.0]])
    axis = np.linspace(-1.8, 1.8, 120)
    flat = surroundings.relief_of(np.random.default_rng(0), 0.0, grips)
    for at in ((10, 20), (60, 63), (100, 3)):
        x, y = axis[at[1]], axis[at[0]]
        weights = [1 / ((x - g[0]) ** 2 + (y - g[1]) ** 2 + 1e-3) ** 2 for g in grips]
        expected = sum(w * g[2] for w, g in zip(weights, grips, strict=True)) / sum(weights) - 0.003
        assert flat[at] == pytest.approx(expected)
    rough = surroundings.relief_of(np.random.default_rng(0), 0.16, grips)
    near = np.min([np.hypot(axis[None] - g[0], axis[:, None] - g[1]) for g in grips], axis=0)
    assert (rough <= flat + 1e-12)[near < 0.16].all() and (rough >= flat - 0.03).all()
    assert (rough - flat)[near > 1.0].mean() > 0.03 > np.abs(rough - flat)[near < 0.16].max()


@pytest.mark.parametrize(("gravity", "ambient", "sun", "rock"), [
    (0.0199, 0.30, 0.75, 0.0), (2.69, 0.24, 0.95, 0.16), (2.71, 0.36, 0.75, 0.16), (5.01, 0.40, 0.70, 0.16),
])  # fmt: skip
def test_the_scene_is_that_of_its_gravity_in_proportion_to_the_robot(gravity, ambient, sun, rock):
    """Light, view and ground; on the station two handrails of four bars on two posts each."""
    walk = drawn(scenario=SCENARIO.with_overrides({"gravity": [0, 0.6 * gravity, -0.8 * gravity]}))
    walk = dataclasses.replace(walk, base_reference=walk.base_reference + np.array([0.3, 0.2, 0.0]))
    walk.grip_point[...] += [0.3, 0.2, 0.02]
    walk.contact[:] = False
    walk.grip_point[10, 0] = [9.0, 9.0, 9.0]
    walk.support[10, 0] = False  # the feet that neither touch nor hold leave no trace
    found, size = surroundings.model([walk]), events.size_of(walk)
    middle = (walk.base_reference[0] + walk.base_reference[-1]) / 2
    assert found.vis.headlight.ambient == pytest.approx([ambient] * 3)
    assert found.vis.headlight.diffuse == pytest.approx([0.18] * 3)
    assert found.vis.headlight.specular == pytest.approx([0.05] * 3)
    assert (found.vis.global_.fovy, found.vis.map.znear, found.vis.map.zfar) == pytest.approx((30, 0.02, 14))
    assert found.stat.extent == pytest.approx(0.5 * size)
    assert found.stat.center == pytest.approx([*middle[:2], 0.05 * size])
    light, towards = found.light("sun"), np.array([0.28, 0.42, -1.0])
    assert found.nlight == 1 and light.castshadow[0] and light.type[0] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    assert light.dir == pytest.approx(towards / np.linalg.norm(towards))
    assert light.pos == pytest.approx([*middle[:2], 0] - 1.5 * size * towards)
    assert (*light.diffuse, *light.ambient, *light.specular) == pytest.approx((*[sun] * 3, *[0] * 3, *[0.25] * 3))
    ground = found.geom("relief")
    assert not (ground.contype or ground.conaffinity or ground.group)
    assert found.hfield_size[0, :2] == pytest.approx(1.8 * size) and found.hfield_size[0, 3] == pytest.approx(
        0.1 * size
    )
    assert ground.pos[:2] == pytest.approx(middle[:2])
    axis = np.linspace(-1.8, 1.8, 120) * size
    high = found.hfield_data.reshape(120, 120) * found.hfield_size[0, 2] + ground.pos[2]
    held = walk.grip_point[walk.support].round(3)
    grips = np.concatenate([np.unique(held, axis=0), [each["at"] for each in HOLDS["points"]]])
    bare = surroundings.relief_of(np.random.default_rng(0), 0.0, (grips - [*middle[:2], 0]) / size) * size
    away = np.min([np.hypot(axis - (g[0] - middle[0]), axis[:, None] - (g[1] - middle[1])) for g in grips], axis=0)
    near = away < 0.15 * size
    assert np.abs(high - bare)[near].max() < 0.03 * size
    assert (high - bare)[~near].max() / size == pytest.approx(rock * 1.4, abs=0.6 * rock + 1e-6)
    rails = np.flatnonzero((found.geom_bodyid == 0) & (found.geom_type == CAPSULE))
    assert found.material("paint").texrepeat == pytest.approx([3, 3] if rock else [3.6 / 0.7] * 2)
    if rock:
        assert not len(rails)
        return
    bars = sorted(
        (*np.round(found.geom_pos[n] / size - [*middle[:2] / size, 0], 6), *np.round(found.geom_size[n, :2] / size, 6))
        for n in rails
    )
    expected = []
    for side in (-0.45, 0.45):
        for left in (-1.3, -0.65, 0.0, 0.65):
            expected.append((left + 0.25, side, 0.05, 0.009, 0.25))
            expected += [(x, side, 0.02, 0.007, 0.03) for x in (left, left + 0.5)]
    np.testing.assert_allclose(bars, sorted(expected), atol=1e-5)


LEVEL = [[0, 0, 1.0], [0, 0.8, 0.6], [0.0, 0.954, 0.3]]


@pytest.mark.parametrize(("normals", "rows"), [(LEVEL[:2] * 2, [0, 1, 2, 3]), (LEVEL + LEVEL[:1], [2])])
def test_the_ground_lies_below_the_lowest_point_of_a_body_and_below_all_of_level_ground(normals, rows):
    position = np.array([[0, 0, 1.0], [1, 0, 0.5], [2, 0, -1.0], [3, 0, 0.7]])
    shown = surroundings.Shown(position, np.array(normals), np.ones(4))
    np.testing.assert_array_equal(surroundings.below(shown), position[rows])


@pytest.mark.parametrize(("value", "words"), [
    (0.04, "0.0 N"), (999.94, "999.9 N"), (1000.0, "1.0 kN"), (9960.0, "10.0 kN"),
    (10_000.0, "10.0 kN"), (10_001.0, "over 10 kN"),
])  # fmt: skip
def test_sizes_of_forces_in_words(value, words):
    assert captions.newtons(value) == words


@pytest.mark.parametrize(("keys", "words"), [
    ({}, "gravity 9.81 m/s²"), ({"gravity": [0, 0, -0.01]}, "microgravity"),
    ({"gravity": [0, 0, -0.02]}, "gravity 0.02 m/s²"),
    ({"gravity": [1.0, 0, -1.0]}, "gravity 1.41 m/s², slope 45°"), ({"gravity": [0.01, 0, -1.5]}, "gravity 1.5 m/s²"),
    ({"gravity": [0, 0, 1.62]}, "gravity 1.62 m/s², slope 180°"),
    ({"disturbance.cargo.mass": 0.5, "disturbance.cargo.start": 1.5}, "gravity 9.81 m/s², cargo 0.5 kg from 1.5 s"),
    ({"disturbance.cargo.mass": 0.5, "disturbance.cargo.start": 8.0}, "gravity 9.81 m/s²"),
    ({"disturbance.pushes": PUSHES[:1]}, "gravity 9.81 m/s², 1 push"),
    ({"disturbance.pushes": PUSHES}, "gravity 9.81 m/s², 4 pushes"),
])  # fmt: skip
def test_a_case_in_words(keys, words):
    assert captions.case(mc.Scenario().with_overrides(keys)) == words


def test_a_controller_in_words():
    for keys, words in (
        ({"control.controller": "pd"}, "pd"),
        ({"control.controller": "end_effector_admittance"}, "end-effector admittance"),
        ({"control.reading": "measured_pose"}, "base admittance, measured pose"), ({}, "base admittance"),
    ):  # fmt: skip
        assert captions.controller(drawn(scenario=mc.Scenario().with_overrides(keys | {"duration": 0.06}))) == words
    assert captions.controller(dataclasses.replace(drawn(), law="own")) == "own"


@pytest.mark.parametrize("fps", [7, 30])
def test_a_film_has_its_pictures_at_the_rate_that_is_asked_for(tmp_path, fps):
    draw, done = np.random.default_rng(0), []
    colors = draw.integers(40, 215, (9, 3)).astype(np.uint8)
    shown = (np.broadcast_to(color, (16, 32, 3)).copy() for color in colors)
    assert film.encode(tmp_path / "film.mp4", shown, fps, (32, 16), done.append) == tmp_path / "film.mp4"
    assert done == list(range(1, 10)) and [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    with av.open(str(tmp_path / "film.mp4")) as container:
        (stream,) = container.streams
        assert (stream.width, stream.height, stream.average_rate, stream.guessed_rate) == (32, 16, fps, fps)
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        found = list(container.decode(stream))
    np.testing.assert_allclose([frame.time for frame in found], np.arange(9) / fps, atol=1e-6)
    middles = [frame.to_ndarray(format="rgb24")[8, 16].astype(int) for frame in found]
    assert np.abs(np.array(middles) - colors).max() < 12
    content = (tmp_path / "film.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # a browser starts before all is there


def test_a_walk_has_its_gait_limb_by_limb_and_its_failure_on_the_side_with_room():
    torn = np.zeros((ROWS, 4), bool)
    torn[40:, 2] = True
    for row, side in ((40, "right"), (20, "left")):
        torn[row:, 2] = True
        figure = plots.plot_walk(drawn(torn_off=torn))
        bars = [artist for artist in figure.axes[-1].collections if artist.get_gid() == "support"]
        for n, bar in enumerate(bars):
            heights = np.concatenate([path.vertices[:, 1] for path in bar.get_paths()])
            assert (heights.min(), heights.max()) == pytest.approx((n - 0.35, n + 0.35))
            np.testing.assert_allclose(bar.get_facecolor()[0][:3], to_rgb(LIMB_COLORS[n]))
        assert [tick.get_text() for tick in figure.axes[-1].get_yticklabels()] == list(drawn().limbs)
        (legend,) = figure.legends
        assert [text.get_text() for text in legend.get_texts()] == list(drawn().limbs)
        (label,) = figure.findobj(lambda artist: artist.get_gid() == "failure")
        assert label.get_text() == f"RH torn off, {0.001 * row:.2f} s" and label.get_ha() == side
        assert label.xyann[0] == (-4 if side == "right" else 4) and label.xy == (0.001 * row, 1)
        assert [axes.get_xlabel() for axes in figure.axes] == [""] * (len(figure.axes) - 1) + ["time [s]"]
        assert figure.axes[0].get_xlim() == (0, pytest.approx(0.06))


def test_a_caption_knows_no_force_that_is_yet_to_come():
    """The largest so far, in a picture that comes before larger ones."""
    walk, view = drawn(), canvas.View(np.zeros(3), 1.0, canvas.AZIMUTH, np.zeros(3))
    later = dataclasses.replace(walk, foot_force=walk.foot_force.copy())
    later.foot_force[3:] *= 5
    pictures = [
        captions.Caption(each, "pd", (320, 180), 0.01).draw(np.zeros((180, 320, 3), np.uint8), 2, view, None)
        for each in (walk, later)
    ]
    np.testing.assert_array_equal(*pictures)


@pytest.fixture
def pencil(monkeypatch):
    """Everything that is drawn on a picture, in order: what, where, and in which colour or letters."""
    done, own = [], captions.ImageDraw.Draw

    def begin(*of):
        made = own(*of)

        def kept(kind, draw):
            def drawing(where, *how, **named):
                done.append((kind, where, how, named))
                return draw(where, *how, **named)

            return drawing

        for kind in ("text", "line", "polygon", "rounded_rectangle", "ellipse"):
            setattr(made, kind, kept(kind, getattr(made, kind)))
        return made

    monkeypatch.setattr(captions.ImageDraw, "Draw", begin)
    return done


@pytest.mark.parametrize(("size", "limit", "row"), [((640, 360), 3.0, 20), ((320, 640), None, 44), ((64, 64), 3.0, 59)])
def test_a_caption_says_what_the_walk_does_and_how_long_a_newton_is(size, limit, row, pencil):
    torn, push = np.zeros((ROWS, 4), bool), np.zeros((ROWS, 6))
    torn[20:, 1], torn[40:, 3], push[20, :3] = True, True, [0, 3.0, 4.0]
    before = np.vstack([np.zeros((1, 4), bool), torn[:-1]])
    walk = drawn(
        scenario=SCENARIO.with_overrides({"contact.holding_limit": limit}), torn_off=torn, detached=before, push=push
    )
    if row == 44:
        walk.foot_force[45:] = np.nan  # that is its last row
        walk.foot_force[44] = 0.0
    gravity, shown = np.array([0.5, 0.3, -1.6]), np.zeros((*size[::-1], 3), np.uint8)
    view = canvas.View(np.zeros(3), 1.0, 30.0, gravity)
    captions.Caption(walk, "a law", size, 0.01).draw(shown, row, view, 3000.0)
    unit = max(min(size[1] / 36, size[0] / 56), 7.0)
    forces = [[math.hypot(*f) for f in feet] for feet in walk.foot_force]
    now, peak = max(forces[row]), max(max(feet) for feet in forces[: row + 1])
    limb = walk.limbs[forces[row].index(now)]
    lines = [(f"t = {0.001 * row:.2f} s", "#FFFFFF", 1.25)]
    lines += [(f"largest force {now:.1f} N at {limb}" if row != 44 else "no force on any foot", "#FFFFFF", 1)]
    lines += [(f"largest so far {peak:.1f} N", "#CDD0D4", 1)] + [("push 5.0 N", "#e24fb0", 1)] * (row == 20)
    lines += [("LH torn off" if row == 20 else "LH, RF torn off", "#FF786E", 1)] + [("diverged", "#FF786E", 1)] * (
        row == 44
    )
    top = size[1] - (1.5 + 1.45 * len(lines)) * unit
    words = [
        ("a law", "#FFFFFF", 1.25, (1.3 * unit, unit)),
        (captions.case(walk.scenario), "#CDD0D4", 0.9, (1.3 * unit, 2.7 * unit)),
    ]
    words += [(*line, (1.3 * unit, top + (0.3 + 1.45 * n) * unit)) for n, line in enumerate(lines)]
    texts = [(where, *how) for kind, where, how, _ in pencil if kind == "text"]
    for (where, text, color, letters), (expected, tone, height, place) in zip(texts, words, strict=False):
        assert (text, color, letters.size) == (expected, tone, round(height * unit))
        assert where == pytest.approx(place)
    # the legend, of as many lines as it has entries, a scale of shares and one of lengths
    named = ["foot force, pressed", "pulled, share of 3 N" if limit else "foot force, pulled", "push on the base"]
    shares = ["0 %", "50 %", "100 %"] if limit else []
    most = 0.55 * 15.5 * unit / 30
    newton = max(step * 10.0**power for step in (1, 2, 5) for power in range(-3, 4) if step * 10.0**power <= most)
    rest = [text for _, text, *_ in texts[len(words) :]]
    assert sorted(rest) == sorted([*named, *shares, f"{newton:g} N", "g"])
    height = (1.5 * (4 + (1.1 if limit else 0)) + 0.8) * unit
    left, top = size[0] - 16.2 * unit, size[1] - height - 0.7 * unit
    boxes = [where for kind, where, _, _ in pencil if kind == "rounded_rectangle"]
    state = size[1] - (1.5 + 1.45 * len(lines)) * unit
    title = max(
        captions.font(1.25 * unit, bold=True).getlength("a law"), captions.font(0.9 * unit).getlength(words[1][0])
    )
    for box, (x, y, wide, tall) in zip(boxes, [
        (0.7, 0.7, title / unit + 1.2, 3.4), (0.7, state / unit, 16.5, 1.45 * len(lines) + 0.6),
        (left / unit, top / unit, 15.5, height / unit), (size[0] / unit - 3.7, 0.7, 3.0, 4.4),
    ], strict=True):  # fmt: skip
        assert box == [round(place * unit) for place in (x, y, x + wide, y + tall)]
    drawn_lines = [(where, how) for kind, where, how, _ in pencil if kind == "line"]
    arrows = [where for kind, where, _, _ in pencil if kind == "polygon"]
    y, tones = top + 0.55 * unit, [plots.SKY, marks.pulled(0.5), marks.PUSH]
    for n, (name, tone) in enumerate(zip(named, tones, strict=True)):
        tip, middle = left + 2.9 * unit, y + 0.6 * unit
        wings = [(tip - 0.88 * unit, middle + side * 0.45 * unit) for side in (-1, 1)]
        np.testing.assert_allclose(arrows[n], [(tip, middle), *wings])
        [(where, fill)] = [(w, h) for w, h in drawn_lines if w[1] == w[3] == middle]
        assert where == pytest.approx((left + 0.7 * unit, middle, left + 2.13 * unit, middle))
        assert to_rgb(fill[0]) == pytest.approx(to_rgb(tone), abs=0.002) and fill[1] == max(round(0.32 * unit), 2)
        assert [w for w, text, *_ in texts if text == name] == [pytest.approx((tip + 0.6 * unit, y))]
        y += 1.5 * unit
        if limit and n == 1:
            bar = round(14.1 * unit)
            ends = [where for where, text, *_ in texts if text in shares]
            assert ends == [pytest.approx((left + 0.7 * unit + s * bar, y + 0.7 * unit)) for s in (0, 0.5, 1)]
            shades = [(w, h) for w, h in drawn_lines if w[0] == w[2] and w[1] == y]
            assert [w[0] - left - 0.7 * unit for w, _ in shades] == pytest.approx([*range(bar)])
            assert all(w[3] - w[1] == pytest.approx(0.55 * unit) for w, _ in shades)
            assert [to_rgb(h[0]) for _, h in shades[:: bar // 3]] == [
                pytest.approx(marks.pulled(n / bar), abs=0.002) for n in range(0, bar, bar // 3)
            ]
            y += 1.65 * unit
    begin, end, middle = left + 0.7 * unit, left + 0.7 * unit + 30 * newton, y + 0.7 * unit
    scale = [w for w, _ in drawn_lines][-4:-1] if gravity.any() else []
    assert scale == [
        pytest.approx(w) for w in (
            (begin, middle, end, middle), (begin, middle - 4, begin, middle + 4), (end, middle - 4, end, middle + 4))
    ]  # fmt: skip
    assert [w for w, text, *_ in texts if text == f"{newton:g} N"] == [
        pytest.approx((end + 0.6 * unit, y + 0.1 * unit))
    ]
    right, up, _ = view.axes()
    way = np.array([gravity @ right, -gravity @ up]) / math.hypot(gravity @ right, gravity @ up)
    center, across = np.array([size[0] - 2.2 * unit, 2.9 * unit]), np.array([-way[1], way[0]])
    tip = center + 1.6 * unit * way
    np.testing.assert_allclose(drawn_lines[-1][0], [*(center - 1.6 * unit * way), *(center + unit * way)])
    wings = [tip - 0.9 * unit * way + side * 0.45 * unit * across for side in (1, -1)]
    np.testing.assert_allclose(arrows[-1], [tip, *wings])
    assert [w for w, text, *_ in texts if text == "g"] == [pytest.approx(tuple(center + 0.75 * unit * across))]


def test_a_holding_limit_is_drawn_where_forces_come_near_it():
    """As a line below 2.5 times the top of the panel, else in words; the axis begins at zero and takes both in."""
    force = np.zeros((ROWS, 4, 3))
    force[:, 2, 0] = np.linspace(0, 10.0, ROWS)
    for limit in (None, 14.0, 30.0):
        own = SCENARIO.with_overrides({"contact.holding_limit": limit})
        panel = plots.plot_walk(drawn(foot_force=force, scenario=own)).axes[0]
        words = [text for text in panel.texts if text.get_gid() == "holding limit"]
        lines = [line.get_ydata()[0] for line in panel.lines if line.get_linestyle() == ":"]
        low, high = panel.get_ylim()
        if limit is None:
            top = high
            assert not words and not lines and 10 < top < 12 and low == 0
            continue
        near = limit < 2.5 * top
        expected = max(top, 1.08 * limit) if near else 1.2 * top
        assert (low, high) == (0, pytest.approx(expected)) and lines == ([limit] if near else [])
        assert words[0].get_text() == ("holding limit" if near else f"holding limit {limit:g} N \N{UPWARDS ARROW}")
        assert words[0].xy == (1, pytest.approx(limit if near else expected)) and words[0].xyann == (-2, -2)


def test_panels_of_a_walk_have_the_heights_colours_and_names_of_their_lines():
    """Axes reach at most two spans beyond the values before a failure; a length and a margin begin at zero."""
    torn, draw = np.zeros((ROWS, 4), bool), np.random.default_rng(3)
    torn[30:, 0] = True
    torque = draw.uniform(1, 2, (ROWS, 4, 3))
    torque[31:, 3] = 90.0
    walk = drawn(
        torn_off=torn, joint_torque=torque, tsm=np.full(ROWS, 0.04), base_displacement=draw.normal(size=(ROWS, 6))
    )
    figure = plots.plot_walk(walk)
    assert figure.get_size_inches() == pytest.approx((3.5, 0.5 + 0.77 * 7))
    assert figure.axes[0].get_gridspec().get_height_ratios() == [1.4, 1, 1, 1, 1, 1, 0.9]
    widths, colors = (
        [0.8, 0.6, 0.8, 0.8, 0.8, 0.8],
        [["#000000"], LIMB_COLORS[:4], *[plots.styling.AXIS_COLORS] * 2, ["#000000"], ["#000000"]],
    )
    for panel, width, own in zip(figure.axes, widths, colors, strict=False):
        lines = [line for line in panel.lines if len(line.get_xdata()) > 2]
        assert [line.get_color() for line in lines] == [*own] and {line.get_linewidth() for line in lines} == {width}
        assert (panel.get_ylim()[0] == 0) == (panel in (figure.axes[0], *figure.axes[4:6]))
        assert panel.yaxis.get_label().get_position()[0] == pytest.approx(-0.16)
    largest = np.abs(torque).max(2)[:31]
    reach = max(3 * line.max() - 2 * line.min() for line in largest.T)
    assert reach < figure.axes[1].get_ylim()[1] < 1.2 * reach
    of_base = figure.axes[2]
    [names] = [child for child in of_base.get_children() if hasattr(child, "get_texts")]
    assert [text.get_text() for text in names.get_texts()] == ["x", "y", "z"]
    shown = 1e3 * (walk.base_position - walk.base_reference)
    low, high = of_base.get_ylim()
    margin = 0.05 * np.ptp(shown)
    assert (low, high) == pytest.approx(
        (shown.min() - margin, shown.max() + margin + 0.3 * (np.ptp(shown) + 2 * margin))
    )
    assert figure.axes[-1].get_ylim() == (3.5, -0.5)
    # names of disturbances stand in lines where no other is in the way
    letter, placed = 3.9 / (0.8 * 72 * 3.5) * 0.06, []
    for start, stop, label, _ in events.disturbances(walk):
        middle, half = (start + stop) / 2, letter * (len(label) + 1) / 2
        busy = {line for line, other, width in placed if abs(other - middle) < half + width}
        placed.append((min({*range(9)} - busy), middle, half))
    labels = [text for text in figure.axes[0].texts if text.get_gid() == "disturbance label"]
    assert [(text.xyann, text.xy) for text in labels] == [
        ((0, 2 + 8 * line), (pytest.approx(middle), 1)) for line, middle, _ in placed
    ]
    assert max(line for line, *_ in placed) > 0 and figure.axes[0].get_xlim()[1] == pytest.approx(0.06)
    gone = plots.plot_walk(drawn(tsm=np.full(ROWS, np.nan)))
    assert len(gone.axes) == 5 and gone.get_size_inches()[1] == pytest.approx(0.5 + 0.77 * 5)


@pytest.mark.parametrize("held", [False, True])
def test_the_way_of_the_feet_is_drawn_to_scale(held):
    """50 mm beyond the footholds that are planned, up to a step above the base; right limbs are dashed."""
    scenario = mc.Scenario().with_overrides(
        {"duration": 0.06, "gait.cycle": 0.06} | ({"ground.holds": HOLDS} if held else {})
    )
    walk = drawn(scenario=scenario)
    figure = plots.plot_feet(walk)
    side, above = figure.axes[:2]
    (left, right), (bottom, top), (low, high) = above.get_xlim(), side.get_ylim(), above.get_ylim()
    places = np.concatenate([
        np.transpose(line.get_data()) for line in above.lines if line.get_gid() == "foothold"
    ])  # fmt: skip
    assert (left, right) == pytest.approx((places[:, 0].min() - 50, places[:, 0].max() + 50))
    assert (low, high) == pytest.approx((places[:, 1].min() - 50, places[:, 1].max() + 50))
    reach = 1e3 * (walk.base_reference[:, 2].max() + scenario.gait.step_height)
    assert (bottom, top) == pytest.approx((-0.1 * reach, reach))
    width = 3.5 - (1.3 if held else 0.6)
    flat, tall = (width * size / (right - left) for size in (top - bottom, high - low))
    assert figure.get_size_inches() == pytest.approx((3.5, 0.9 + flat + tall))
    assert side.get_gridspec().get_height_ratios() == pytest.approx([flat, tall])
    paths = [line for line in side.lines if len(line.get_xdata()) == ROWS][:4]
    assert [line.is_dashed() for line in paths] == [limb.startswith("R") for limb in walk.limbs]
    assert [line.get_color() for line in paths] == [*LIMB_COLORS[:4]]
    bars = [line.get_xdata() for line in side.lines if line.get_gid() == "foothold"]
    assert {round(bar[1] - bar[0], 6) for bar in bars} == {24.0}
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [*walk.limbs, "base"]


# ------------------------------------------------------------------------------------------- pictures put together


class Sheet:
    """A stand-in for a canvas: pictures of one grey each; it keeps all that it was asked to draw."""

    def __init__(self, model, width, height):
        self.model, self.size, self.asked = model, (width, height), []
        Sheet.last = self

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def draw(self, data, view, on_top, inside=None):
        over, among = scene(), scene()
        on_top(over)
        if inside is not None:
            inside(among)
        self.asked.append((np.array(data.qpos), view, shapes(over), shapes(among)))
        return np.full((*self.size[::-1], 3), 20 * len(self.asked), np.uint8)


def test_walks_side_by_side_share_camera_and_scales_and_the_last_one_has_the_legend(monkeypatch):
    monkeypatch.setattr(film, "Canvas", Sheet)
    far = drawn(1).base_position.copy()
    far[40:] += 31 * events.size_of(drawn(1))
    walks = [drawn(), dataclasses.replace(drawn(1, SCENARIO.with_overrides({"control.controller": "pd"})),
                                          base_position=far, foot_force=4 * drawn(1).foot_force)]  # fmt: skip
    size, strip = (320, 120), 26  # of the height 0.21, in pairs of pixels
    instants = [0.0104, 0.05]
    pictures = [*film.pictures(walks, instants, size=size, trace=0.21)]
    sheet, model, scale = Sheet.last, Sheet.last.model, marks.scale(walks)
    assert sheet.size == (320, 94) and len(sheet.asked) == 4
    camera = canvas.follower(walks, model, 320 / 94)
    focal = 94 / (2 * math.tan(math.radians(float(model.vis.global_.fovy)) / 2))
    for n, (qpos, view, over, among) in enumerate(sheet.asked):
        walk, instant = walks[n % 2], instants[n // 2]
        row = round(instant / 0.001)
        posed = min(row, 39) if n % 2 else row  # what flies away is shown as long as it is near
        np.testing.assert_allclose(qpos[:3], walk.base_position[posed])
        expected = camera(walk, instant)
        np.testing.assert_allclose([*view.target, view.distance], [*expected.target, expected.distance])
        arrows, things = scene(), scene()
        marks.forces(arrows, walk, posed, scale)
        marks.around(things, walk, posed)
        for found, same in ((over, shapes(arrows)), (among, shapes(things))):
            assert len(found) == len(same)
            for one, other in zip(found, same, strict=True):
                for value, expected in zip(one, other, strict=True):
                    np.testing.assert_array_equal(value, expected)
        label = ("base admittance", "pd")[n % 2]
        panel = captions.Caption(walk, label, (320, 94), scale).draw(
            np.full((94, 320, 3), 20 * (n + 1), np.uint8), row, view, focal / view.distance if n % 2 else None
        )
        whole = np.concatenate([panel, captions.ForceTrace(walks, n % 2, (320, strip)).at(instant)])
        whole[:, : 2 * (n % 2)] = 255  # a line between walks
        np.testing.assert_array_equal(pictures[n // 2][:, 320 * (n % 2) :][:, :320], whole)


def test_a_stance_stands_on_the_mean_of_its_feet_and_fits_into_its_picture(monkeypatch, tmp_path):
    """The limbs are lines from the middle of the hips over the joints to the feet."""
    monkeypatch.setattr(film, "Canvas", Sheet)
    made = []
    monkeypatch.setattr(film, "compiled", lambda file, spec: made.append(compiled(file, spec)) or made[-1])
    text = climbers.mjcf(4, 3)
    (tmp_path / "own.xml").write_text(text)
    section = climbers.config(tmp_path / "own.xml", 4, 3)["robot"]
    section["limbs"]["limb1"]["at"] = [0.0, 0.0, 0.04]
    robot = RobotFile.model_validate(section)
    film.stance(robot)
    own, loaded = mujoco.MjModel.from_xml_string(text), load_robot(robot)
    data = mujoco.MjData(own)
    for limb, angles in zip(loaded.limbs, loaded.stance_joints, strict=True):
        for joint, angle in enumerate(angles):
            data.joint(f"L{limb[-1]}_{joint}").qpos[:] = angle
    mujoco.mj_kinematics(own, data)
    numbers = [int(limb[-1]) for limb in loaded.limbs]
    feet = [data.site(f"foot{n}").xpos + data.site(f"foot{n}").xmat.reshape(3, 3)[:, 2] * 0.04 * (n == 1)
            for n in numbers]  # fmt: skip
    joints = [[data.joint(f"L{n}_{joint}").xanchor for joint in range(3)] for n in numbers]
    (model,), ((_, view, over, _),) = made, Sheet.last.asked
    assert Sheet.last.size == (800, 600)
    assert model.geom("ground of the picture").pos[2] == pytest.approx(np.mean(feet, axis=0)[2])
    places = np.concatenate([feet, *joints])
    middle = (places.min(0) + places.max(0)) / 2
    half = max(math.dist(place, middle) for place in places)
    np.testing.assert_allclose(view.target, middle, atol=1e-9)
    assert view.distance == pytest.approx(1.12 * half / math.sin(math.radians(22.5)))
    hip = np.mean([points[0] for points in joints], axis=0)
    expected = []
    for n, (points, foot) in enumerate(zip(joints, feet, strict=True)):
        line = [hip, *points, foot]
        tone = to_rgb(LIMB_COLORS[n])
        expected += [((a + b) / 2, 0.015 * half, tone) for a, b in itertools.pairwise(line)]
        expected.append((foot, 0.03 * half, tone))
    assert len(over) == len(expected)
    for (kind, pos, sizes, _, rgba), (place, radius, tone) in zip(over, expected, strict=True):
        assert kind == CAPSULE and sizes[0] == pytest.approx(radius, rel=1e-5)
        np.testing.assert_allclose(pos, place, atol=2e-5)
        np.testing.assert_allclose(rgba[:3], tone, atol=1e-6)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_trace_has_the_walk_in_front_of_those_beside_it(number, monkeypatch):
    """Up to where the state stops being finite, and no higher than three times the largest force before a failure."""
    figures = []
    monkeypatch.setattr(captions, "Figure", lambda **how: figures.append(Figure(**how)) or figures[-1])
    torn, late = np.zeros((ROWS, 4), bool), drawn(2).foot_force.copy()
    torn[20, 1], late[21:] = True, 1e3 * late[21:]
    longer = SCENARIO.with_overrides({"duration": 0.08, "gait.cycle": 0.08})
    walks = [drawn(), dataclasses.replace(drawn(2), foot_force=late, torn_off=torn), drawn(3, longer)]
    walks[0].foot_force[50:] = np.nan
    trace = captions.ForceTrace(walks, number, (400, 60))
    forces = [np.array([max(math.hypot(*f) for f in row) for row in walk.foot_force]) for walk in walks]
    rows = [50, 60, 80]
    limits = [forces[0][:50].max(), 3 * forces[1][:21].max(), forces[2].max()]
    assert limits[1] < forces[1].max()
    # its state ends in the middle: at most three times the largest force of the first half of it
    limits[0] = min(limits[0], 3 * forces[0][:26].max())
    top = 1.08 * max(limits)
    [panel] = figures[0].axes
    assert panel.get_ylim() == pytest.approx((0, top)) and panel.get_xlim() == pytest.approx((0, 0.079))
    lines = [line for line in panel.lines if len(line.get_xdata()) > 2]
    order = sorted(range(3), key=lambda n: n == number)
    assert [line.get_color() for line in lines] == ["#767C84", "#767C84", "#78BEFF"]
    for line, n in zip(lines, order, strict=True):
        np.testing.assert_allclose(line.get_xdata(), 0.001 * np.arange(rows[n]), atol=1e-12)
        np.testing.assert_allclose(line.get_ydata(), np.minimum(forces[n][: rows[n]], top))
    assert [tick.get_text() for tick in panel.get_yticklabels()] == ["0", f"{max(limits):.2g} N"]
    assert [text.get_text() for text in figures[0].texts] == ["largest foot force, the other walk's in grey"]
    shaded = [(span.get_x(), span.get_x() + span.get_width()) for span in panel.patches]
    np.testing.assert_allclose(shaded, [(a, b) for a, b, *_ in events.disturbances(walks[number])])
    assert trace.at(0.02).shape == (60, 400, 3)
    captions.ForceTrace(walks[2:], 0, (400, 60))
    assert [text.get_text() for text in figures[1].texts] == ["largest foot force"]


def test_walks_over_one_another_have_the_longest_ones_axis_and_each_ones_failure():
    """The baseline's words are dark grey, as its line is light; those of others have their colour, a line below."""
    torn, longer = np.zeros((ROWS, 4), bool), SCENARIO.with_overrides({"duration": 0.08, "gait.cycle": 0.08})
    torn[20, 2] = True
    walks = {"a": drawn(torn_off=torn), "b": drawn(1, longer), "c": drawn(2, torn_off=torn)}
    figure = plots.plot_comparison(walks)
    assert figure.axes[0].get_xlim() == (0, pytest.approx(0.08))
    words = figure.findobj(lambda artist: artist.get_gid() == "failure")
    tones = ["0.3", plots.SERIES[2][0]]
    assert [(text.get_color(), text.xyann) for text in words] == [
        (tone, (4, -3 - 17 * level)) for level, tone in enumerate(tones)
    ]
    widths = [(line.get_color(), line.get_linewidth()) for line in figure.legends[0].get_lines()]
    assert widths == [("0.65", 1.8), (plots.VERMILLION, 1.2), (plots.BLUE, 1.2)]
    assert figure.get_size_inches() == pytest.approx((3.5, 0.7 + 0.95 * 5))


def test_the_way_of_the_feet_ends_a_tenth_of_a_second_after_a_failure(tmp_path):
    scenario = mc.Scenario().with_overrides({"duration": 0.4, "gait.cycle": 0.4})
    torn = np.zeros((400, 4), bool)
    torn[150, 0] = True
    walk = drawn(scenario=scenario, torn_off=torn, support=np.ones((400, 4), bool))
    side = plots.plot_feet(walk).axes[0]
    assert max(len(line.get_xdata()) for line in side.lines) == 250


def test_the_last_height_of_a_foothold_goes_on():
    """A ground of one height for each limb, on which feet step twice."""
    heights = {"LF": [0.01], "LH": [0.0], "RH": [-0.02], "RF": [0.005]}
    scenario = mc.Scenario().with_overrides({"duration": 0.06, "gait.cycle": 0.06, "ground.footholds": heights})
    side = plots.plot_feet(drawn(scenario=scenario)).axes[0]
    bars = [float(line.get_ydata()[0]) for line in side.lines if line.get_gid() == "foothold"]
    assert bars == pytest.approx(
        [height for own in heights.values() for height in own + own for height in [1e3 * height]]
    )


def test_a_map_reaches_to_marks_beside_it_and_says_where_a_baseline_beyond_its_colours_lies():
    dims, draw = ("stiffness", "damping"), np.random.default_rng(0)
    data = xr.Dataset({"peak_foot_force": (dims, 10 + draw.random((3, 4)))},
                      {"stiffness": [1.0, 10.0, 100.0], "damping": [1.0, 10.0, 100.0, 1000.0]})  # fmt: skip
    edges = (10**-0.5, 10**2.5), (10**-0.5, 10**3.5)
    marked = {"left": (0.03, 10.0), "below": (10.0, 0.06), "above": (10.0, 9e4)}
    for baseline, arrow in ((5.0, " \N{DOWNWARDS ARROW}"), (99.0, " \N{UPWARDS ARROW}"), (10.5, "")):
        figure = plots.plot_map(data, "peak_foot_force", marked, baseline=baseline)
        panel, bar = figure.axes
        assert panel.get_xlim() == pytest.approx((0.03 / 1.5, edges[0][1]))
        assert panel.get_ylim() == pytest.approx((0.06 / 1.5, 9e4 * 1.5))
        assert [text.get_text() for text in bar.texts] == [f"pd{arrow}"]
        low, high = panel.collections[0].get_clim()
        [line] = [line for line in bar.lines if line.get_gid() == "baseline"]
        assert line.get_ydata()[0] == pytest.approx(min(max(baseline, low), high))
    bare = plots.plot_map(data, "peak_foot_force").axes[0]
    assert (bare.get_xlim(), bare.get_ylim()) == (pytest.approx(edges[0]), pytest.approx(edges[1]))
    first = data.assign(detached_limb=(dims, np.where(np.arange(12).reshape(3, 4) == 5, 0, -1)))
    assert plots.failed_walks(first, *dims).T.ravel().nonzero()[0].tolist() == [5]


@pytest.mark.parametrize(
    ("names", "columns"), [(["a"], 1), (["a", "b"], 2), (["abcdefgh"] * 9, 4), (["a" * 99] * 3, 1)]
)
def test_a_legend_above_has_as_many_columns_as_fit(names, columns):
    figure = Figure(figsize=(3.5, 3), layout="constrained")
    plots.legend(figure, [plots.key(name, color="k") for name in names], "a title")
    [legend] = figure.legends
    assert legend._ncols == columns and legend.get_title().get_text() == "a title"
