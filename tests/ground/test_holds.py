"""Points that can be held: from a list, from files as others write them, by rule; and what is refused."""

import json
import struct
import warnings

import numpy as np
import pytest
import scipy.io
import trimesh
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.ground import holds_of, holds_of_seeds, of
from mjx_climb.ground.readers import table_of
from mjx_climb.ground.readers.pcd_file import unpacked_lzf
from tests.gait.footholds_reference import largest_pull
from tuning.scenario_files import copied

POINTS = np.array([[0.1, 0.2, 0.0], [0.3, -0.2, 0.05], [-0.1, 0.0, 0.02]])
NORMALS = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -1.0, 0.0]])
LIMITS = np.array([15.0, 4.0, 30.0])
UP = [0.0, 0.0, 1.0]


def ground(**holds):
    return mc.Scenario.model_validate({"ground": {"holds": holds}}).ground


def found(**holds):
    return holds_of(ground(**holds))


def refusal(**holds):
    with pytest.raises(mc.ConfigError) as refused:
        found(**holds)
    assert len(str(refused.value).splitlines()) == 1
    return str(refused.value)


def test_the_points_of_a_list():
    """A hold has a normal of length one and bears a pull along it up to its limit; without any no row is there."""
    assert holds_of(mc.Scenario().ground) is None
    listed = [{"at": [1, 2, 3], "normal": [0, 3, 4], "limit": 5.0}, {"at": [0, 0, 0]}]
    made = found(points=listed, limit=15.0, count=3)
    np.testing.assert_array_equal(made.position, [[1, 2, 3], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(made.normal, [[0, 0.6, 0.8], UP, UP])
    np.testing.assert_array_equal(made.limit_matrix, [[[0, 0, -1]], [[0, 0, -1]], [[0, 0, 0]]])
    np.testing.assert_array_equal(made.limit_bound, [[5], [15], [1]])
    np.testing.assert_array_equal(made.valid, [1, 1, 0])
    assert found(points=listed[1:]).limit_bound.shape == (1, 0)
    np.testing.assert_array_equal(found(points=listed).limit_bound, [[5], [np.inf]])
    np.testing.assert_array_equal(
        found(points=[{"at": [0, 0, 0], "limit": 0.0}]).limit_bound, [[0]]
    )  # it bears nothing


def test_a_polyhedron_is_a_share_of_each_limit():
    pyramid = {"matrix": [[1, 0, -0.5], [0, 0, -1]], "bound": [0.0, 1.0]}
    made = found(points=[{"at": [0, 0, 0], "limit": 8.0}, {"at": [1, 0, 0]}], polyhedron=pyramid)
    np.testing.assert_array_equal(made.limit_matrix, [pyramid["matrix"]] * 2)
    np.testing.assert_array_equal(made.limit_bound, [[0, 8], [0, np.inf]])


def test_the_pull_that_a_hold_bears_is_the_answer_of_a_linear_program():
    """Of random polyhedra in the axes of holds of any normal; none of them bears any pull."""
    random = np.random.default_rng(0)
    for _ in range(30):
        matrix, bound = random.normal(size=(5, 3)), random.uniform(0, 1, 5)
        limits = random.uniform(0, 20, 2)
        made = of(POINTS[:2], random.normal(size=(2, 3)), limits, (matrix, bound))
        expected = [largest_pull(matrix, limit * bound) for limit in limits]
        np.testing.assert_allclose(made.pulls(), expected, rtol=1e-7, atol=1e-9)


def test_limits_spread_by_the_seed():
    many = [{"at": [n, 0, 0], "limit": 10.0} for n in range(400)]
    one, same, other = (found(points=many, spread=0.3, seed=seed).limit_bound[:, 0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).all()
    assert np.log(one / 10).std() == pytest.approx(0.3, rel=0.15) and abs(np.log(one / 10).mean()) < 0.05


def test_a_ground_is_moved_and_turned_as_a_whole():
    """A yaw of 90 degrees has what was ahead on the left; a pitch of -90 degrees makes a floor a wall ahead."""
    listed = [{"at": [1, 0, 0], "normal": [0, 0, 1]}]
    left = found(points=listed, turn=[0, 0, np.pi / 2], at=[0, 0, 0.5])
    np.testing.assert_allclose([left.position[0], left.normal[0]], [[0, 1, 0.5], UP], atol=1e-12)
    wall = found(points=listed, turn=[0, -np.pi / 2, 0])
    np.testing.assert_allclose([wall.position[0], wall.normal[0]], [UP, [-1, 0, 0]], atol=1e-12)


# --- files


def csv(path):
    table = np.column_stack([POINTS, NORMALS, LIMITS])
    np.savetxt(path, table, delimiter=", ", header="x, y, z, nx, ny, nz, limit", comments="", fmt="%.17g")


def ply(path):
    """As text, as PCL and CloudCompare write it, with a property of its own."""
    names = ("x", "y", "z", "nx", "ny", "nz", "limit")
    header = ["ply", "format ascii 1.0", "element vertex 3", *(f"property double {name}" for name in names)]
    rows = [" ".join(map(repr, row)) for row in np.column_stack([POINTS, NORMALS, LIMITS]).tolist()]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")


def pcd_header(kind, fields, sizes, types, counts, viewpoint="0 0 0", points=3):
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {fields}", f"SIZE {sizes}"]
    lines += [f"TYPE {types}", f"COUNT {counts}", "WIDTH 3", "HEIGHT 1"]
    lines += [f"VIEWPOINT {viewpoint} 1 0 0 0", f"POINTS {points}"]
    return ("\n".join([*lines, f"DATA {kind}"]) + "\n").encode()


def pcd(path):
    """Binary, as PCL writes points with normals: padding named `_`, and a curvature."""
    names = "x y z _ normal_x normal_y normal_z _ limit"
    header = pcd_header("binary", names, "4 4 4 1 4 4 4 1 8", "F F F U F F F U F", "1 1 1 4 1 1 1 4 1")
    rows = zip(POINTS, NORMALS, LIMITS, strict=True)
    path.write_bytes(header + b"".join(struct.pack("<3f4x3f4xd", *at, *up, limit) for at, up, limit in rows))


def lzf(content):
    """Content compressed by LZF: the longest copy of what came before, however near, or else a byte itself."""
    packed, at = b"", 0
    while at < len(content):
        length = min(264, len(content) - at)
        while length > 2 and content.rfind(content[at : at + length], 0, at + length - 1) < 0:
            length -= 1
        if length < 3:
            packed, at = packed + b"\0" + content[at : at + 1], at + 1
            continue
        back = at - content.rfind(content[at : at + length], 0, at + length - 1) - 1
        extra = [length - 9] if length > 8 else []
        packed += bytes([min(length - 2, 7) << 5 | back >> 8, *extra, back & 255])
        at += length
    return packed


def pcd_packed(path):
    """Compressed, field after field; and the rest of a page as PCL leaves it."""
    names = "x y z normal_x normal_y normal_z limit"
    content = np.column_stack([POINTS, NORMALS, LIMITS]).astype("<f4").T.tobytes()
    packed = lzf(content)
    sizes = struct.pack("<2I", len(packed), len(content))
    header = pcd_header("binary_compressed", names, "4 " * 7, "F " * 7, "1 " * 7)
    path.write_bytes(header + sizes + packed + bytes(100))


def pcd_ouster(path):
    """With padding that has no number in it, as PCL writes the points of a lidar."""
    names = "x y z _ _ normal_x normal_y normal_z _ limit"
    header = pcd_header("binary", names, "4 4 4 1 1 4 4 4 2 8", "F F F U U F F F U F", "1 1 1 4 0 1 1 1 0 1")
    rows = zip(POINTS, NORMALS, LIMITS, strict=True)
    path.write_bytes(header + b"".join(struct.pack("<3f4x3fd", *at, *up, limit) for at, up, limit in rows))


def ply_binary(path, order=">"):
    """As some programs write it, the largest byte first; after an element of another kind, and before faces."""
    head = ["ply", f"format binary_{'big' if order == '>' else 'little'}_endian 1.0", "comment by hand"]
    head += ["element sensor 1", "property short number", "element vertex 3"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "limit")]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = np.column_stack([POINTS, NORMALS, LIMITS]).astype(f"{order}f4").tobytes()
    face = struct.pack(f"{order}B3i", 3, 0, 1, 2)
    path.write_bytes("\n".join(head).encode() + b"\n" + struct.pack(f"{order}h", 7) + rows + face)


def ply_little(path):
    ply_binary(path, "<")


def pcd_text(path):
    names = "x y z histogram normal_x normal_y normal_z limit"
    header = pcd_header("ascii", names, "4 " * 8, "F " * 8, "1 1 1 2 1 1 1 1")
    rows = zip(POINTS, NORMALS, LIMITS, strict=True)
    text = "".join(" ".join(map(str, [*at, 7, 8, *up, limit])) + "\n" for at, up, limit in rows)
    path.write_bytes(header + text.encode())


def recorded(path, topics=("/holds",), row=168):
    """An MCAP file with PointCloud2 messages, the last of which counts."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "limit")
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "map")
    fields = [types["sensor_msgs/msg/PointField"](name, 8 * n, 8, 1) for n, name in enumerate(names)]
    table = np.column_stack([POINTS, NORMALS, LIMITS])
    kind = "sensor_msgs/msg/PointCloud2"
    folder = path.with_suffix(".folder")
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in topics:
            to = writer.add_connection(topic, kind, typestore=store)
            for stamp, shift in enumerate((9.0, 0.0)):
                data = np.frombuffer((table + shift).tobytes()[:row], np.uint8)
                cloud = types[kind](header, 1, 3, fields, False, 56, row, data, True)
                writer.write(to, stamp, store.serialize_cdr(cloud, kind))
    next(folder.glob("*.mcap")).rename(path)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.csv", csv),
        ("a.ply", ply),
        ("b.ply", ply_binary),
        ("c.ply", ply_little),
        ("a.pcd", pcd),
        ("b.pcd", pcd_text),
        ("c.pcd", pcd_packed),
        ("d.pcd", pcd_ouster),
        ("a.mcap", recorded),
    ],
)
def test_each_format_gives_positions_normals_and_limits(name, write, tmp_path):
    write(tmp_path / name)
    made = found(cloud={"file": str(tmp_path / name)})
    np.testing.assert_allclose(made.position, POINTS, atol=1e-8)
    np.testing.assert_allclose(made.normal, NORMALS, atol=1e-7)
    np.testing.assert_allclose(made.limit_bound[:, 0], LIMITS)
    scaled = found(cloud={"file": str(tmp_path / name), "limit": "z", "limit_unit": 100.0})
    np.testing.assert_allclose(scaled.limit_bound[:, 0], 100 * POINTS[:, 2], rtol=1e-6)


# values whose bytes tell the sign, the size and the order of a type, by its letter in Python's `struct`
TELLING = {"b": -2, "B": 254, "h": -515, "H": 65019, "i": -50462977, "I": 4244504319, "q": -(2**40) - 3}
TELLING |= {"Q": 2**63 + 2048, "f": -1.5, "d": 1 / 3}
OF_PLY = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
OF_PLY |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f"}
OF_PLY |= {"float64": "d"}


def columns_of(path):
    return {name: np.asarray(values).tolist() for name, values in table_of(str(path)).columns}


@pytest.mark.parametrize(("form", "order"), [("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_numbers_of_every_type_in_a_ply_come_back(form, order, tmp_path):
    """Behind an element of another kind, before faces, of which there are none."""
    head = ["ply", f"format {form} 1.0", "comment a b", "obj_info by hand", "", "element sensor 2", "property ushort n"]
    head += ["element vertex 2", *(f"property {kind} {kind}" for kind in OF_PLY)]
    head += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    letters = [*OF_PLY.values()]
    rows = [[TELLING[letter] for letter in letters], [1] * len(letters)]
    if order:
        body = struct.pack(f"{order}2H", 7, 8) + b"".join(struct.pack(order + "".join(letters), *row) for row in rows)
    else:
        body = ("7\n8\n" + "\n\n".join(" ".join(map(repr, row)) for row in rows) + "\n").encode()
    (tmp_path / "a.ply").write_bytes("\n".join(head).encode() + b"\n" + body)
    assert columns_of(tmp_path / "a.ply") == {kind: [TELLING[letter], 1] for kind, letter in OF_PLY.items()}


def test_numbers_of_every_type_in_a_pcd_come_back(tmp_path):
    """Of fields of several numbers the first ones, of one without any none; without the lines that have defaults."""
    kinds = {"I 1": "b", "U 1": "B", "I 2": "h", "U 2": "H", "I 4": "i", "U 4": "I", "I 8": "q", "U 8": "Q"}
    kinds |= {"F 4": "f", "F 8": "d"}
    letters, sizes = zip(*(kind.split() for kind in kinds), strict=True)
    names = [f"n{number}" for number in range(len(kinds))]
    head = [f"FIELDS {' '.join(names)} none", f"SIZE {' '.join(sizes)} 4  # in bytes", f"TYPE {' '.join(letters)} F"]
    head += [f"COUNT {'2 ' * len(kinds)}0", "WIDTH 2", "DATA binary", ""]
    telling = [TELLING[letter] for letter in kinds.values()]
    layout = "<" + "".join(2 * letter for letter in kinds.values())
    rows = [[each for value in row for each in (value, 9)] for row in (telling, [1] * len(kinds))]
    body = b"".join(struct.pack(layout, *row) for row in rows)
    (tmp_path / "a.pcd").write_bytes("\n".join(head).encode() + body)
    expected = {name: [value, 1] for name, value in zip(names, telling, strict=True)}
    assert columns_of(tmp_path / "a.pcd") == expected
    assert table_of(str(tmp_path / "a.pcd")).viewpoint is None
    lines = ["FIELDS x", "SIZE 4", "TYPE F", "POINTS 2", "VIEWPOINT 0 0 -2 1 0 0 0", "DATA ascii", "3", "4"]
    (tmp_path / "b.pcd").write_text("\n".join(lines))
    assert columns_of(tmp_path / "b.pcd") == {"x": [3, 4]}
    assert table_of(str(tmp_path / "b.pcd")).viewpoint.tolist() == [0, 0, -2]


@pytest.mark.parametrize("big", [False, True])
def test_numbers_of_every_type_in_a_recording_come_back(big, tmp_path):
    """In two rows with bytes behind their points, by the numbers of sensor_msgs/PointField."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types, letters = store.types, "bBhHiIfd"
    order, size = "<>"[big], struct.calcsize(f"={letters}")
    values = [[TELLING[letter] for letter in letters], [1] * 8, [2] * 8, [3] * 8]
    packed = [struct.pack(order + letters, *row) for row in values]
    data = np.frombuffer(packed[0] + packed[1] + b"ab" + packed[2] + packed[3] + b"cd", np.uint8)
    at = [struct.calcsize(f"={letters[:n]}") for n in range(8)]
    fields = [types["sensor_msgs/msg/PointField"](f"n{n}", at[n], n + 1, 1) for n in range(8)]

    def written(path, fields):
        from rosbags.rosbag2 import StoragePlugin, Writer

        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "map")
        kind, folder = "sensor_msgs/msg/PointCloud2", path.with_suffix(".folder")
        cloud = types[kind](header, 2, 2, fields, big, size, 2 * size + 2, data, True)
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            writer.write(writer.add_connection("/a", kind, typestore=store), 0, store.serialize_cdr(cloud, kind))
        return next(folder.glob("*.mcap")).rename(path)

    found = columns_of(written(tmp_path / "a.mcap", fields))
    assert found == {f"n{n}": [row[n] for row in values] for n in range(8)}
    other = [*fields[:7], types["sensor_msgs/msg/PointField"]("n7", at[7], 9, 1)]
    with pytest.raises(mc.ConfigError, match=r"b.mcap: /a: expected fields with datatype 1 to 8, got 9"):
        table_of(str(written(tmp_path / "b.mcap", other)))


def test_compressed_points_are_copied_from_as_far_as_8192_bytes():
    """Runs of 32 bytes, then copies from an odd way back: of 3 to 8 bytes, and of as many as 264."""
    content = np.random.default_rng(0).integers(0, 256, 8192).astype(np.uint8).tobytes()
    runs = b"".join(b"\x1f" + content[n : n + 32] for n in range(0, 8192, 32))
    for back in (1, 40, 4096, 5001, 8192):
        far, near = (back - 1) >> 8, (back - 1) & 255
        for length in (3, 8, 9, 264):
            code = [(length - 2) << 5 | far] if length < 9 else [7 << 5 | far, length - 9]
            copied = content[-back:][:length]
            expected = content + (copied * length)[:length]
            packed = runs + bytes([*code, near])
            assert unpacked_lzf(packed, len(expected)) == expected
            for size in (len(expected) - 1, len(expected) + 1):
                with pytest.raises(ValueError, match=f"^{len(expected)} bytes of compressed points for {size}$"):
                    unpacked_lzf(packed, size)


def test_a_mesh_has_the_normals_of_its_surface(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    sphere.export(tmp_path / "sphere.ply")
    made = found(cloud={"file": str(tmp_path / "sphere.ply")})
    np.testing.assert_allclose(made.normal, made.position / 0.5, atol=0.02)


def test_maps_of_climblab(tmp_path):
    """A grid whose z has a row for each y and NaN where nothing holds; or one matrix of three rows."""
    x, y = np.array([0.0, 0.1, 0.2]), np.array([-0.3, 0.3])
    z = np.array([[0.01, np.nan, 0.02], [np.nan, 0.03, 0.04]])
    scipy.io.savemat(tmp_path / "map_grid.mat", {"x": x, "y": y, "z": z})
    expected = [[0, -0.3, 0.01], [0.2, -0.3, 0.02], [0.1, 0.3, 0.03], [0.2, 0.3, 0.04]]
    made = found(cloud={"file": str(tmp_path / "map_grid.mat")})
    np.testing.assert_allclose(made.position, expected)
    np.testing.assert_array_equal(made.normal, np.tile(UP, (4, 1)))
    scipy.io.savemat(tmp_path / "list.mat", {"graspable_points_on_full_testfield": POINTS.T})
    np.testing.assert_allclose(found(cloud={"file": str(tmp_path / "list.mat")}).position, POINTS)


def test_normals_that_a_file_lacks_are_those_of_planes_through_neighbours(tmp_path):
    """A plane that rises by 1 in 2 along x; points on a line have no plane, and point up."""
    level = np.random.default_rng(0).random((60, 2))
    plane, line = np.column_stack([level, level[:, 0] / 2]), np.column_stack([level[:, :1], np.zeros((60, 2))])
    for name, points, normal in (("plane", plane, [-1, 0, 2]), ("line", line, UP)):
        np.savetxt(tmp_path / f"{name}.csv", points, delimiter=",", header="x,y,z", comments="")
        made = found(cloud={"file": str(tmp_path / f"{name}.csv"), "neighbours": 8})
        np.testing.assert_allclose(made.normal, np.tile(normal / np.linalg.norm(normal), (60, 1)), atol=1e-6)


def test_normals_that_are_zero_or_nan_are_those_that_a_file_lacks(tmp_path):
    """As PCL writes points whose normals nobody has computed."""
    (tmp_path / "a.csv").write_text("x,y,z,nx,ny,nz\n0,0,0,0,0,0\n0,1,0,nan,nan,nan\n1,0,0,0,3,4\n1,1,nan,0,0,1\n")
    made = found(cloud={"file": str(tmp_path / "a.csv")})
    np.testing.assert_allclose(made.normal, [UP, UP, [0, 0.6, 0.8]])


# rotations that turn the axes of a camera, z ahead, into those of the ground, and of a floor that becomes a wall
DOWN, SLANTING, LEVEL = ([np.pi, 0, 0], [-2.3, 0.1, 0.4], [-np.pi / 2, 0, -np.pi / 2])
WALL = [0, -np.pi / 2, 0]


def seen(path, turn, normal=None, **header):
    """The points of a floor 0.8 m below a camera in the camera's axes, rising by some mm, as a ground."""
    level = np.random.default_rng(1).random((200, 2))
    floor = np.column_stack([level, 0.01 * np.sin(6 * level[:, 0]) - 0.8])
    points = floor @ Rotation.from_euler("xyz", turn).as_matrix()
    names = "x y z" if normal is None else "x y z normal_x normal_y normal_z"
    table = points if normal is None else np.column_stack([points, np.broadcast_to(normal, points.shape)])
    number = table.shape[1]
    lines = "\n".join(" ".join(map(repr, row)) for row in table.tolist())
    text = pcd_header("ascii", names, "4 " * number, "F " * number, "1 " * number, points=200, **header)
    path.write_bytes(text.replace(b"WIDTH 3", b"WIDTH 200") + lines.encode())
    return {"cloud": {"file": str(path), "neighbours": 12}, "turn": turn, "at": [0, 0, 0.8]}


@pytest.mark.parametrize("turn", [DOWN, SLANTING, LEVEL, [0, 0, 0]])
@pytest.mark.parametrize("neighbours", [1, 12])
def test_fitted_normals_look_out_of_the_ground_however_a_scan_is_turned(turn, neighbours, tmp_path):
    source = seen(tmp_path / "scan.pcd", turn)
    made = found(**source | {"cloud": source["cloud"] | {"neighbours": neighbours}})
    assert (made.normal[:, 2] > 0.99).all() and np.abs(made.position[:, 2]).max() < 0.011


def test_a_floor_that_is_turned_into_a_wall_has_the_normals_of_its_upper_side(tmp_path):
    made = found(**seen(tmp_path / "floor.pcd", [0, 0, 0]) | {"turn": WALL})
    assert (made.normal[:, 0] < -0.99).all()


def test_fitted_normals_look_to_the_viewpoint_of_a_file(tmp_path):
    """From below the points are those of a ceiling; what looks down is counted."""
    source = seen(tmp_path / "scan.pcd", [0, 0, 0], viewpoint="0.5 0.5 -2")
    with pytest.warns(UserWarning, match="200 of 200 normals look down, into the ground"):
        assert (found(**source).normal[:, 2] < -0.99).all()


def test_normals_of_a_file_that_look_into_the_ground_are_counted(tmp_path):
    """After the turn; the lower side of a closed surface has the upper one above it, and counts as right."""
    with pytest.warns(UserWarning, match=r"up.pcd: ground.holds.cloud: 200 of 200 normals look down, into the ground"):
        found(**seen(tmp_path / "up.pcd", DOWN, UP))
    found(**seen(tmp_path / "down.pcd", DOWN, [0, 0, -1]))
    pipe = found(pipe={"size": [0.4, 1.0], "radius": 0.3, "around": 12, "pitch": 0.1})
    columns = np.column_stack([pipe.position, pipe.normal * np.where(np.arange(60) % 12 == 1, -1, 1)[:, None]])
    np.savetxt(tmp_path / "pipe.csv", columns, delimiter=",", header="x,y,z,nx,ny,nz", comments="")
    with pytest.warns(UserWarning, match="5 of 60 normals"):
        found(cloud={"file": str(tmp_path / "pipe.csv")})


def test_fitted_normals_of_a_wall_that_no_turn_tells_of_are_counted(tmp_path):
    """A scan in the camera's own axes, whose turn was forgotten: their sides come out by chance."""
    source = seen(tmp_path / "scan.pcd", LEVEL)
    with pytest.warns(UserWarning, match="200 of 200 fitted normals are level, so that their side is a guess .turn"):
        found(**source | {"turn": [0, 0, 0]})
    eye = " ".join(map(repr, (np.array([0.5, 0.5, 1.0]) @ Rotation.from_euler("xyz", LEVEL).as_matrix()).tolist()))
    made = found(**seen(tmp_path / "eye.pcd", LEVEL, viewpoint=eye) | {"turn": [0, 0, 0]})
    assert (made.normal @ Rotation.from_euler("xyz", LEVEL).as_matrix().T > 0.99)[:, 2].all()


def test_points_at_the_sensor_itself_are_no_ground(tmp_path):
    """As drivers write directions from which nothing came back; one such point may be one."""
    (tmp_path / "a.csv").write_text("x,y,z,limit\n0,0,0,0\n0,0,0,0\n1,0,0,3\n-0.0,0,0,0\n0,0,1,4\n")
    with pytest.warns(UserWarning, match="a.csv: ground.holds.cloud: 3 of 5 points are at 0, 0, 0, as of no echo"):
        made = found(cloud={"file": str(tmp_path / "a.csv")})
    np.testing.assert_array_equal(made.position, [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(made.limit_bound[:, 0], [3, 4])
    (tmp_path / "a.csv").write_text("x,y,z\n0,0,0\n0,0,0\n1,0,0\n")
    with pytest.warns(UserWarning, match="2 of 3 points are at 0, 0, 0"):
        assert len(found(cloud={"file": str(tmp_path / "a.csv")}).position) == 1
    (tmp_path / "a.csv").write_text("x,y,z\n0,0,0\n1,0,0\n")
    assert len(found(cloud={"file": str(tmp_path / "a.csv")}).position) == 2


@pytest.mark.parametrize(("names", "limit", "said"), [
    ("limt", None, "column limt is not read: expected limit"),
    ("Limit", None, "column Limit is not read: expected limit"),
    ("normals_x,normals_y,normals_z", None, "column normals_y is not read: expected normal_x, normal_y, normal_z"),
    ("nx,ny", None, "column ny is not read: expected nx, ny, nz"),
    ("limt", "limt", None),
    ("nx,ny,nz,normal_x", None, None),
    ("intensity,limit", None, None),
])  # fmt: skip
def test_columns_that_are_nearly_known_are_told(names, limit, said, tmp_path):
    (tmp_path / "a.csv").write_text(f"x,y,z,{names}\n" + "1,2,3" + ",1" * (names.count(",") + 1) + "\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found(cloud={"file": str(tmp_path / "a.csv"), "limit": limit})
    lines = [str(each.message).partition("cloud: ")[2] for each in caught]
    assert (said in lines) if said else (lines == [])


def test_a_column_of_limits_that_the_config_names_must_be_there(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,limit\n0,0,0,3\n")
    source = {"file": str(tmp_path / "a.csv")}
    assert "a.csv: limits: expected a column limits, got x, y, z, limit" in refusal(cloud=source | {"limit": "limits"})
    (tmp_path / "a.csv").write_text("x,y,z\n0,0,0\n")
    assert "a.csv: limit: expected a column limit, got x, y, z" in refusal(cloud=source | {"limit": "limit"}, limit=9.0)
    np.testing.assert_array_equal(found(cloud=source, limit=9.0).limit_bound, [[9.0]])


def test_limits_of_gaps_count_for_nothing(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,limit\nnan,nan,nan,nan\n0,0,0,3\n0,0,1,inf\n")
    np.testing.assert_array_equal(found(cloud={"file": str(tmp_path / "a.csv")}).limit_bound, [[3.0], [np.inf]])


def test_samples_of_a_height_map_but_for_gaps_and_the_mask(tmp_path):
    heights = np.add.outer(0.02 * np.arange(4.0), 0.01 * np.arange(5.0))
    heights[3, 4] = np.nan
    mask = np.ones((4, 5))
    mask[0] = 0
    np.save(tmp_path / "map.npy", heights)
    np.save(tmp_path / "mask.npy", mask)
    source = {"file": str(tmp_path / "map.npy"), "resolution": 0.1, "origin": [1, 2]}
    source |= {"mask": str(tmp_path / "mask.npy")}
    made = found(map=source)
    assert made.position.shape == (14, 3)
    np.testing.assert_allclose(made.position[0], [1, 2.1, 0.02])
    np.testing.assert_allclose(made.normal[0], np.array([-0.1, -0.2, 1]) / np.sqrt(1.05))
    np.save(tmp_path / "mask.npy", mask[1:])
    (tmp_path / "mask.npy").rename(tmp_path / "short.npy")
    words = refusal(map=source | {"mask": str(tmp_path / "short.npy")})
    assert "ground.holds.map.mask: expected the 4 rows and 5 columns of the map, got 3 and 5" in words


def test_the_strongest_point_of_each_cube_stays():
    listed = [{"at": [0.01 * n, 0, 0], "limit": float(n % 7)} for n in range(100)]
    made = found(points=listed, spacing=0.1)
    assert made.position.shape == (10, 3) and (made.limit_bound == 6).all()


# --- rules


def test_handrails_and_lattices():
    rails = found(handrails={"corner": [-0.2, -0.3], "size": [1.0, 0.6], "rails": 3, "pitch": 0.1})
    assert rails.position.shape == (33, 3)
    np.testing.assert_allclose(np.unique(rails.position[:, 1]), [-0.3, 0, 0.3], atol=1e-12)
    np.testing.assert_allclose(np.unique(rails.position[:, 0].round(9)), np.linspace(-0.2, 0.8, 11), atol=1e-9)
    box = found(truss={"corner": [0, 0], "size": [2.0, 0.5], "bay": 0.5, "depth": 0.5, "pitch": 0.1})
    for normal, axis, place in (([0, 0, 1], 2, 0), ([0, 0, -1], 2, -0.5), ([0, 1, 0], 1, 0.5), ([0, -1, 0], 1, 0)):
        face = box.position[(box.normal == normal).all(1)]
        np.testing.assert_allclose(face[:, axis], place, atol=1e-12)
        flat = face[:, [0, 3 - axis]]
        # each is on a chord, a batten or a diagonal
        bay = np.abs(flat / 0.5 - np.round(flat / 0.5)).min(1)
        across = np.abs((flat.sum(1) / 0.5) % 1), np.abs(((flat[:, 0] - flat[:, 1]) / 0.5) % 1)
        diagonal = np.min([np.minimum(each, 1 - each) for each in across], axis=0)
        assert (np.minimum(bay, diagonal) < 1e-9).all()
        assert len(np.unique(face.round(9), axis=0)) == len(face) > 50


def test_a_pipe_and_a_wall():
    pipe = found(pipe={"size": [0.4, 1.0], "radius": 0.3, "around": 12, "pitch": 0.1})
    assert pipe.position.shape == (60, 3) and pipe.position[:, 2].max() == 0
    center = np.array([0, 0, -0.3])
    np.testing.assert_allclose((pipe.position - center)[:, 1:], 0.3 * pipe.normal[:, 1:], atol=1e-12)
    rows = found(wall={"corner": [1, 2], "size": [0.2, 0.1], "filled": 1.0, "height": 0.0, "pitch": 0.1}).position
    # the second row is shifted by half a pitch, and ends where the wall does
    np.testing.assert_allclose(rows[:, :2] - [1, 2], [[0, 0], [0.1, 0], [0.2, 0], [0.05, 0.1], [0.15, 0.1]], atol=1e-9)
    wall = found(wall={"corner": [0, 0], "size": [3.0, 3.0], "filled": 0.4, "height": 0.05, "tilt": 0.2})
    assert 0.35 < len(wall.position) / (31 * 31) < 0.45 and 0.04 < wall.position[:, 2].max() <= 0.05
    np.testing.assert_allclose(np.arctan(wall.normal[:, :2] / wall.normal[:, 2:]).std(0), 0.2, rtol=0.15)


def test_rock_has_its_density_its_roughness_and_the_normals_of_its_surface():
    source = {"corner": [0, 0], "size": [3.0, 3.0], "density": 1000.0, "roughness": 0.02, "wavelength": 0.8}
    rock = found(rock=source, seed=4)
    assert rock.position.shape == (9000, 3)
    squares = [found(rock=source | {"density": 100.0}, seed=seed).position[:, 2].var() for seed in range(10)]
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.02, rel=0.1)
    assert (found(rock=source, seed=5).position != rock.position).all()
    np.testing.assert_array_equal(found(rock=source, seed=4).position, rock.position)
    # a neighbour lies in the plane of a point, but for the curvature over the way to it
    distance = np.linalg.norm(rock.position[:, None, :2] - rock.position[:200, :2], axis=-1)
    other, point = np.nonzero((distance > 0) & (distance < 0.01))
    away = rock.position[other] - rock.position[point]
    off = np.abs((away * rock.normal[point]).sum(1))
    assert len(off) > 30 and off.max() < 0.15 * np.abs(away[:, 2]).max()


def test_grounds_of_several_seeds_are_one_batch():
    """Each is what its seed gives alone, padded to the largest."""
    wall = {"filled": 0.5, "size": [1.0, 1.0]}
    batch = holds_of_seeds(ground(wall=wall, limit=5.0, spread=0.2), range(4))
    counts = batch.valid.sum(1).astype(int)
    assert len({*counts}) > 1 and batch.position.shape == (4, counts.max(), 3)
    for seed, count in enumerate(counts):
        alone = found(wall=wall, limit=5.0, spread=0.2, seed=seed)
        np.testing.assert_array_equal(batch.position[seed, :count], alone.position)
        np.testing.assert_array_equal(batch.limit_bound[seed, :count], alone.limit_bound)


# --- refused


XYZ = ("x y z", "4 4 4", "F F F", "1 1 1")
PLY = b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
PLY += b"property %s\nend_header\n0 1 2 3\n4 5 6 7\n"
BAD = {
    "none.csv": (None, "none.csv: expected a file of points, got none"),
    "a.xyz": (b"", "expected points as .csv, .db3, .mat, .mcap, .pcd, .ply, got .xyz"),
    "head.csv": (b"x,y\n1,2\n", "head.csv: z: expected columns x, y and z, got x, y"),
    "ragged.csv": (b"x,y,z\n1,2,3\n1,2\n", "row 3: expected 3 numbers, got 2"),
    "word.csv": (b"x,y,z\n1,two,3\n", "row 2: expected numbers, got 'two'"),
    "nothing.csv": (b"x,y,z\n", "nothing.csv: ground.holds.cloud: expected one point that can be held, got none"),
    "empty.csv": (b"", "empty.csv: x: expected columns x, y and z, got none"),
    "twice.csv": (b"x,y,z,x\n1,2,3,4\n", "twice.csv: x: expected one column of this name, got 2"),
    "thrice.csv": (b"x,x,z,x,y\n1,2,3,4,5\n", "thrice.csv: x: expected one column of this name, got 3"),
    "blank.csv": (b"x,y,z\n\n1,2,3\n\n1,2\n", "row 5: expected 3 numbers, got 2"),
    "alone.csv": (b"x\n", "alone.csv: y: expected columns x, y and z, got x"),
    "spaces.csv": (b"x y z\n1 2 3\n", "expected names with commas between them in the first line, got x y z"),
    "limits.csv": (b"x,y,z,limit,limit\n1,2,3,4,5\n", "limits.csv: limit: expected one column of this name, got 2"),
    "normals.csv": (b"x,y,z,nx,ny,nz,nx\n1,2,3,0,0,1,1\n", "normals.csv: nx: expected one column of this name, got 2"),
    "inf.csv": (b"x,y,z\n0,inf,0\n", "inf.csv: x, y, z: expected 1e+09 m at most, or nan for a gap, got inf"),
    "far.csv": (b"x,y,z\n0,0,-1e300\n", "far.csv: x, y, z: expected 1e+09 m at most, or nan for a gap, got -1e+300"),
    "nan.csv": (b"x,y,z,limit\n0,0,0,1\n0,0,1,nan\n", "nan.csv: limit: expected limits of 0 or above, got nan at 1"),
    "minus.csv": (b"x,y,z,limit\n0,0,0,-2\n", "minus.csv: limit: expected limits of 0 or above, got -2"),
    "cut.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "cut.ply: expected a whole file of points"),
    "cut.pcd": (b"VERSION 0.7\n", "cut.pcd: expected a header that ends with DATA, got none"),
    "head.pcd": (pcd_header("zip", *XYZ), "head.pcd: DATA: expected ascii, binary or binary_compressed, got zip"),
    "none.pcd": (b"WIDTH 3\nDATA ascii\n", "none.pcd: FIELDS: expected names, got none"),
    "zero.pcd": (pcd_header("ascii", *XYZ, points=0), "zero.pcd: POINTS: expected WIDTH x HEIGHT, 3, got 0"),
    "below.pcd": (pcd_header("ascii", *XYZ, points=-5), "POINTS: expected whole numbers, 0 or above, got -5"),
    "part.pcd": (
        pcd_header("binary", *XYZ) + bytes(range(48)),
        "part.pcd: expected a whole file of points, got 48 bytes",
    ),
    "more.pcd": (pcd_header("ascii", *XYZ) + b"1 2 3 " * 4, "POINTS: expected 3 points of 3 numbers, got 12 numbers"),
    "type.pcd": (pcd_header("binary", "x y z", "3 4 4", "F F F", "1 1 1"), "TYPE and SIZE: expected F of 4 or 8"),
    "view.pcd": (
        pcd_header("ascii", *XYZ, viewpoint="0 nan 0") + b"1 " * 9,
        "VIEWPOINT: expected finite numbers, got 0",
    ),
    "size.pcd": (pcd_header("binary", "x y z", "4 4", "F F F", "1 1 1"), "size.pcd: SIZE: expected 3 words, got 4 4"),
    "sign.pcd": (pcd_header("binary", "x y z", "4 -4 4", "F F F", "1 1 1"), "SIZE: expected whole numbers, 0 or above"),
    "gone.pcd": (pcd_header("binary_compressed", *XYZ), "gone.pcd: expected a whole file of points, got no points"),
    "back.pcd": (pcd_header("binary_compressed", *XYZ) + struct.pack("<2I", 3, 36) + b"\x20\7\7", "got damaged"),
    "less.pcd": (pcd_header("binary_compressed", *XYZ) + struct.pack("<2I", 2, 36) + b"\0a", "got 1 bytes of"),
    "many.ply": (PLY % (10**9, b"float w"), "many.ply: element: expected 1000000000 lines for 1000000000 vertices"),
    "few.ply": (
        PLY % (1, b"float x"),
        "few.ply: element: expected 1 lines for 1 vertices and the other elements, got 2",
    ),
    "more.ply": (
        (PLY % (1, b"float w")).replace(b"end_h", b"element face 0\nproperty list uchar int v\nend_h"),
        "more.ply: element: expected 1 lines for 1 vertices and the other elements, got 2",
    ),
    "twice.ply": (PLY % (2, b"float z"), "twice.ply: z: expected one column of this name, got 2"),
    "type.ply": (PLY % (2, b"half x"), "type.ply: header: expected format, element and property, got property half x"),
    "short.pcd": (pcd_header("binary", "x y z", "4 4 4", "F F F", "1 1 1") + b"12", "expected a whole file of points"),
    "noise.mat": (b"noise", "noise.mat: expected a whole file of points"),
    "noise.mcap": (b"noise", "noise.mcap: expected a whole file of points"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_file_that_cannot_be_used_is_refused_in_one_line(name, tmp_path):
    content, expected = BAD[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert expected in refusal(cloud={"file": str(tmp_path / name)})


def test_a_matrix_or_a_topic_that_is_none_of_those_expected(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"x": [0.0], "y": [0.0, 1.0], "z": [[1.0, 2.0]]})
    assert "a.mat: z: expected a matrix of 2 x 1, as y and x have it, got" in refusal(
        cloud={"file": str(tmp_path / "a.mat")}
    )
    scipy.io.savemat(tmp_path / "b.mat", {"a": POINTS.T, "b": POINTS.T})
    assert "b.mat: expected x, y and z, or one matrix with three rows, got a, b" in refusal(
        cloud={"file": str(tmp_path / "b.mat")}
    )
    recorded(tmp_path / "a.mcap", ("/holds", "/rock"))
    source = {"file": str(tmp_path / "a.mcap")}
    assert "topic: expected one topic with sensor_msgs/msg/PointCloud2, got /holds, /rock" in refusal(cloud=source)
    assert "topic: expected sensor_msgs/msg/PointCloud2 on /x, got none" in refusal(cloud=source | {"topic": "/x"})
    assert found(cloud=source | {"topic": "/rock"}).position.shape == (3, 3)
    recorded(tmp_path / "b.mcap", row=112)
    words = "b.mcap: /holds: expected 1 rows of 168 bytes or more, got row_step 112, 112 bytes"
    assert words in refusal(cloud={"file": str(tmp_path / "b.mcap")})


def test_a_damaged_matlab_file_on_which_scipy_crashes_gets_one_line(tmp_path):
    """The type of the numbers of `y` is one that is not in SciPy's table."""
    scipy.io.savemat(tmp_path / "a.mat", {"x": np.arange(3.0), "y": np.arange(2.0), "z": np.ones((2, 3))})
    content = bytearray((tmp_path / "a.mat").read_bytes())
    assert content[256] == 9
    content[256] = 86
    (tmp_path / "a.mat").write_bytes(content)
    assert "a.mat: expected a whole file of points, got a damaged one" in refusal(
        cloud={"file": str(tmp_path / "a.mat")}
    )
    scipy.io.savemat(tmp_path / "b.mat", {"list": 1j * POINTS.T})
    assert "b.mat: x: expected real numbers, got values of type complex128" in refusal(
        cloud={"file": str(tmp_path / "b.mat")}
    )


def test_a_mesh_whose_faces_are_cut_off(tmp_path):
    for encoding in ("ascii", "binary"):
        trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "a.ply", encoding=encoding)
        content = (tmp_path / "a.ply").read_bytes()
        (tmp_path / "a.ply").write_bytes(content[:-40])
        assert "a.ply: " in refusal(cloud={"file": str(tmp_path / "a.ply")})


RULES = [
    ("rock", {"density": 1e12}),
    ("rock", {"size": [100.0, 1.0], "density": 1.1e4}),
    ("rock", {"size": [1.0, 100.0], "density": 1.1e4}),
    ("wall", {"pitch": 1e-6}),
    ("wall", {"size": [50.0, 1.0], "pitch": 0.005}),
    ("pipe", {"pitch": 1e-308}),
    ("pipe", {"pitch": 0.04, "around": 20000}),
    ("handrails", {"pitch": 1e-9}),
    ("handrails", {"pitch": 0.04, "rails": 20000}),
    ("truss", {"bay": 1e-9}),
    ("truss", {"pitch": 1e-6}),
    ("truss", {"depth": 1e6}),
]


@pytest.mark.parametrize(("rule", "values"), RULES)
def test_points_that_are_far_too_many_are_refused_before_they_are_made(rule, values):
    words = refusal(**{rule: values})
    assert f"ground.holds.{rule}: expected 1000000 points at most, got some" in words


def test_rules_that_give_no_finite_points():
    words = "scenario: ground.holds.rock: expected finite positions"
    assert words in refusal(rock={"wavelength": 1e-320}) and words in refusal(rock={"roughness": 1e308})


def test_a_normal_may_be_of_any_length():
    made = found(points=[{"at": [0, 0, 0], "normal": [3e-200, 0, 4e-200]}, {"at": [0, 0, 0], "normal": [0, 1e300, 0]}])
    np.testing.assert_allclose(made.normal, [[0.6, 0, 0.8], [0, 1, 0]])


def test_too_many_points():
    rock = {"density": 100.0, "size": [1.0, 1.0]}
    words = "ground.holds.count: expected 50 points at most (ground.holds.spacing thins them out), got 100"
    assert words in refusal(rock=rock, count=50)
    assert "ground.holds.rock: expected 20000 points at most" in refusal(rock={"density": 1e4})
    with pytest.raises(ValueError, match="expected 2 points at most, got 3"):
        of(POINTS, count=2)


@pytest.mark.parametrize(
    ("holds", "expected"),
    [
        ({}, "ground.holds: expected one of points, cloud, map,"),
        ({"rock": {}, "pipe": {}}, "ground.holds.rock: expected one of points, cloud"),
        ({"rock": {"density": 0}}, "ground.holds.rock.density: expected a finite number above 0"),
        ({"rocks": {}}, "ground.holds.rocks: expected a known key, got an unknown one (did you mean rock?)"),
        ({"points": [{"at": [0, 0]}]}, "ground.holds.points.0.at: expected a list of three"),
        ({"points": [{"at": [0, 0, 0], "normal": [0, 0, 0]}]}, "points.0.normal: expected a direction, not zero"),
        ({"pipe": {"around": 0}}, "ground.holds.pipe.around: expected a whole number from 1 to 20000"),
        ({"rock": {}, "polyhedron": {"matrix": [[1, 0, 0]], "bound": [1, 2]}}, "polyhedron.bound: expected 1 numbers"),
    ],
)
def test_keys_are_checked(holds, expected):
    with pytest.raises(mc.ConfigError) as refused:
        mc.Scenario.from_yaml(json.dumps({"ground": {"holds": holds}}))
    assert expected in str(refused.value)


def test_files_of_holds_lie_beside_the_config(tmp_path, monkeypatch):
    csv(tmp_path / "rock.csv")
    (tmp_path / "walk.yaml").write_text("ground: {holds: {cloud: {file: rock.csv}}}")
    monkeypatch.chdir("/")
    loaded = mc.load_scenario(tmp_path / "walk.yaml")
    assert len(holds_of(loaded.ground).position) == 3
    assert loaded.relative_to(tmp_path).ground.holds.cloud.file == "rock.csv"


def test_files_of_holds_go_along_with_a_result(tmp_path):
    """Map and mask are copied, and the copies are found from another place."""
    for name, grid in (("map", np.zeros((3, 4))), ("mask", np.eye(3, 4))):
        np.save(tmp_path / f"{name}.npy", grid)
    source = {"file": str(tmp_path / "map.npy"), "resolution": 0.1, "mask": str(tmp_path / "mask.npy")}
    kept = copied(mc.Scenario.model_validate({"ground": {"holds": {"map": source}}}), tmp_path / "out")
    (tmp_path / "map.npy").unlink()
    (tmp_path / "mask.npy").unlink()
    moved = (tmp_path / "out").rename(tmp_path / "moved")
    again = mc.Scenario.from_yaml(kept.relative_to(tmp_path / "out").to_yaml()).beside(moved)
    assert len(holds_of(again.ground).position) == 3
