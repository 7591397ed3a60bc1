"""Swings of RAMP and ReSTO, from files as they write them, become swings of a gait."""

import itertools

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.published_swing import published_path
from mjx_climb.gait.swing import heights
from mjx_climb.inputs.from_scenario import own_parameters

# RAMP's: the first and the last three control points are the ends, and z is up
START, END = np.array([0.3, -0.1, 0.2]), np.array([0.3, 0.1, 0.2])
CONTROL = np.column_stack([START] * 3 + [[0.32, -0.06, 0.27], [0.32, 0.04, 0.29]] + [END] * 3)
FRAME = "planned/limb_2_palm_link"


def curve(phase):
    """Return the curve (S, 3) by de Casteljau's construction."""
    points = [np.tile(point, (len(phase), 1)) for point in CONTROL.T]
    while len(points) > 1:
        points = [a + phase[:, None] * (b - a) for a, b in itertools.pairwise(points)]
    return points[0]


def bezier(path):
    """As Eigen prints a matrix."""
    np.savetxt(path, CONTROL, fmt="%12.8g", delimiter=" ")


def samples():
    """Return times, s, and places, with a rest before and after a swing of 4 s."""
    time = np.arange(0, 6, 0.05)
    return time, curve(np.clip((time - 1) / 4, 0, 1))


def export(path):
    """As PlotJuggler writes it: a row for each message, the cells of other topics empty."""
    head = ["__time", "/joint_states/a/position"]
    head += [f"/tf/world/{frame}/translation/{axis}" for frame in (FRAME, "base_link") for axis in "xyz"]
    lines = [",".join(head)]
    for time, at in zip(*samples(), strict=True):
        stamp = f"{1776707294 + time:.6f}"
        lines += [f"{stamp},,{at[0]:.9f},{at[1]:.9f},{at[2]:.9f},,,", f"{stamp},0.1,,,,0,0,0"]
    path.write_text("\n".join(lines) + "\n")


def record(path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, kind = store.types, "tf2_msgs/msg/TFMessage"
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "world")
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    folder = path.with_suffix(".folder")
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        to = writer.add_connection("/tf", kind, typestore=store)
        for time, at in zip(*samples(), strict=True):
            place = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](*map(float, at)), turn)
            each = [types["geometry_msgs/msg/TransformStamped"](header, name, place) for name in ("base_link", FRAME)]
            writer.write(to, round(1e9 * time), store.serialize_cdr(types[kind](each), kind))
    next(folder.glob("*.mcap")).rename(path)


def scenario(path, **gait):
    return mc.Scenario.model_validate({"gait": {"swing_file": {"file": str(path)}, **gait}})


@pytest.mark.parametrize(("name", "write"), [("a.txt", bezier), ("a.csv", export), ("a.mcap", record)])
def test_a_foot_follows_the_published_curve_scaled_to_the_gait(name, write, tmp_path):
    """Ahead as a share of the stride, up as a share of the height in the middle, to 1 % of either."""
    write(tmp_path / name)
    gait = scenario(tmp_path / name, stride=0.06, step_height=0.02).gait
    path = published_path(gait.swing_file, gait, 4)
    assert path.shape == (4, 3, 6) and (path == path[0]).all()
    phase = np.linspace(0, 1, 101)
    shape = (curve(phase) - START) / [1, 0.2, curve(np.array([0.5]))[0, 2] - START[2]]
    across = 2 * phase - 1
    shapes = np.array([(1 - across**2) ** 3 * across**k for k in range(6)])
    ahead = 0.06 * (3 * phase**2 - 2 * phase**3) + 0.02 * path[0, 0] @ shapes
    np.testing.assert_allclose(ahead, 0.06 * shape[:, 1], atol=0.006 * 0.06)
    # the file's y is ahead, so that its x is to the right
    np.testing.assert_allclose(0.02 * path[0, 1] @ shapes, -0.3 * shape[:, 0], atol=0.006 * 0.06)
    np.testing.assert_allclose(heights(phase, path)[:, 0], shape[:, 2], atol=0.015)


# of the way: where a foot is at rest, and where it has begun to move
REST, SLOW = 4e-7, 5e-6
SHARES = [0.0, 0.0, REST, SLOW, 0.05, 0.2, 0.45, 0.6, 0.85, 0.97, 1 - SLOW, 1 - REST, 1.0, 1.0]
TIMES = [7.0, 7.3, 7.4, 7.5, 7.7, 7.8, 8.0, 8.1, 8.3, 8.4, 8.6, 8.7, 9.5, 9.6]


def recording(times):
    """A swing on a slope, with steps aside; a row of another topic, and the last one cut off."""
    share = np.array(SHARES)
    places = np.outer(share, [0.1, 0.2, 0.05]) + np.outer(share * (1 - share), [0.0, 0.01, 0.2])
    places += np.outer(share**2 * (1 - share), [0.03, 0.0, 0.0])
    lines = [f"t,{','.join(f'/tf/{FRAME}/translation/{axis}' for axis in 'zxy')},other"]
    lines += [f"{at},{z!r},{x!r},{y!r},1" for at, (x, y, z) in zip(times, places.tolist(), strict=True)]
    return places, "\n".join([*lines[:6], "7.75,,,,3", *lines[6:], "9.7,0.3"])


def test_a_recorded_swing_is_from_the_last_sample_at_rest_to_the_first(tmp_path):
    """Fitted by normal equations; columns stand in any order."""
    places, text = recording(TIMES)
    (tmp_path / "a.csv").write_text(text)
    gait = scenario(tmp_path / "a.csv", stride=0.06, step_height=0.02).gait
    found = published_path(gait.swing_file, gait, 3)
    phase = (np.array(TIMES[2:12]) - TIMES[2]) / (TIMES[11] - TIMES[2])
    way = places[2:12] - places[2]
    ahead = way[-1] / np.linalg.norm(way[-1])
    left = np.cross([0, 0, 1.0], ahead) / np.linalg.norm(np.cross([0, 0, 1.0], ahead))
    up = np.cross(ahead, left)
    smooth, across = lambda p: p * p * (3 - 2 * p), 2 * phase - 1
    shapes = np.array([(1 - across**2) ** 3 * across**k for k in range(6)])
    height = np.interp(0.5, phase, way @ up)
    length = np.linalg.norm(way[-1])
    for row, shape, rest in (
        (found[0, 0] * 0.02 / 0.06, shapes, way @ ahead / length - smooth(phase)),
        (found[0, 2], shapes * across, way @ up / height - smooth(1 - abs(across))),
    ):
        np.testing.assert_allclose(shape @ shape.T @ row, shape @ rest, atol=1e-9)
    level = found[0, 1] * 0.02 / 0.06
    np.testing.assert_allclose(shapes @ shapes.T @ level, shapes @ (way @ left) / length, atol=1e-9)
    assert found.shape == (3, 3, 6) and (found == found[0]).all()


def test_samples_that_are_not_in_order_are_no_swing(tmp_path):
    times = [*TIMES]
    times[6], times[7] = times[7], times[6]
    (tmp_path / "a.csv").write_text(recording(times)[1])
    with pytest.raises(mc.ConfigError, match=r"a.csv: gait.swing_file: .*, got 10 samples in order of a swing of plan"):
        own_parameters(scenario(tmp_path / "a.csv"))


def test_the_swing_is_that_of_the_parameters_and_no_gain_of_the_gait_is_searched(tmp_path):
    bezier(tmp_path / "ramp.txt")
    walk = scenario(tmp_path / "ramp.txt")
    np.testing.assert_array_equal(
        own_parameters(walk).gait.swing_path, published_path(walk.gait.swing_file, walk.gait, 4)
    )
    with pytest.raises(ValueError, match=r"gait.stride: expected none, as gait.swing_file is computed"):
        mc.Simulation(walk).metrics(gains={"gait.stride": 0.03})


BAD = {
    "a.mat": (b"", "gait.swing_file: expected a swing as .txt, .csv, .db3, .mcap, got .mat"),
    "none.txt": (None, "expected a whole file with a swing, got"),
    "two.txt": (b"1 2 3\n4 5 6\n", "got a matrix of 2 rows and 3 columns in place of three rows"),
    "flat.txt": (b"0 1\n0 0\n0 0\n", "expected a swing that rises on its way, z up, got 1 m long and 0 m high"),
    "other.csv": (b"time,x\n0,1\n", "got 0 columns in place of three that end with /planned/"),
    "short.csv": ("t,{0}x,{0}y,{0}z\n0,0,0,0\n".format(f"/{FRAME}/translation/").encode(), "got 1 samples"),
    "noise.mcap": (b"noise", "expected a whole file with a swing"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_without_a_swing_is_refused_in_one_line(name, tmp_path):
    content, expected = BAD[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(mc.ConfigError) as refused:
        own_parameters(scenario(tmp_path / name))
    assert expected in str(refused.value) and name in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_there_is_one_kind_of_swing():
    with pytest.raises(mc.ConfigError, match=r"gait.swing_file: expected none with swing: low_reaction, got"):
        mc.Scenario.from_yaml("gait: {swing: low_reaction, swing_file: {file: a.txt}}")
