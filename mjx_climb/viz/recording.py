"""A walk as a recording of ROS 2 in one MCAP file, which Foxglove, Rerun and PlotJuggler open."""

import itertools
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.files.writing import write_bytes_atomically
from mjx_climb.ground import Holds, holds_of
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.bodies import quaternion
from mjx_climb.robot_import.robot_file import root_link
from mjx_climb.scenario.model import RobotFile
from mjx_climb.trajectory import Trajectory

WORLD = "world"
FRAMES_PER_SECOND = 100  # of transforms, which are there to be looked at
_JOINTS, _WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
_Types = Mapping[str, Callable[..., object]]  # the class of the messages of a type, by its name


class _Topic(NamedTuple):
    name: str
    kind: str  # type of its messages
    message: Callable[[int, object], object]  # of a row, with the header that it is given
    every: int = 1  # rows between two messages


def save_mcap(trajectory: Trajectory, path: str | os.PathLike[str]) -> Path:
    """Write a walk as MCAP and return its path; time begins at 0, and the same walk gives the same file.

    Topics: `/joint_states` and `/joint_commands` (by the names in the robot's file), `/LIMB/force` (of the ground on
    the foot) and `/LIMB/support`, `/base_pose` and `/base_twist` of the base's centre of mass, `/push` (from outside),
    `/tf` of the file's root link and of the feet, `/holds`, once, of the points that can be held, with normals and the
    largest pull along them. Frame `world`, SI units.

    Raises:
        OutputError: the file cannot be written.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    stamps = np.round(1e9 * trajectory.time).astype(np.int64).tolist()
    with tempfile.TemporaryDirectory() as folder:
        writer = Writer(Path(folder) / "walk", version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            topics = [*_topics(trajectory, store.types)]
            to = [writer.add_connection(topic.name, topic.kind, typestore=store) for topic in topics]
            for row, stamp in enumerate(stamps):
                header = _header(store.types, stamp)
                for topic, connection in zip(topics, to, strict=True):
                    if row % topic.every == 0:
                        message = topic.message(row, header)
                        writer.write(connection, stamp, store.serialize_cdr(message, topic.kind))
        return write_bytes_atomically(path, (Path(folder) / "walk" / "walk.mcap").read_bytes())


def rows_of_a_frame(trajectory: Trajectory) -> int:
    """Return after how many rows of a walk a viewer is told anew where the robot is."""
    return max(round(1 / (FRAMES_PER_SECOND * trajectory.scenario.time_step)), 1)


def _header(types: _Types, stamp: int) -> object:
    seconds, nanoseconds = divmod(stamp, 10**9)
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=WORLD)


def _topics(walk: Trajectory, types: _Types) -> Iterator[_Topic]:
    """Yield the topics of a walk."""
    vector, point = (_vector(types[f"geometry_msgs/msg/{kind}"]) for kind in ("Vector3", "Point"))
    pose, turn = types["geometry_msgs/msg/Pose"], _quaternion(types)
    flag, none = types["std_msgs/msg/Bool"], np.array([])

    def stamped(name: str, kind: str, *fields: Callable[[int], object]) -> _Topic:
        return _Topic(name, kind, lambda row, header: types[kind](header, *(field(row) for field in fields)))

    def pair(kind: str, first: np.ndarray, second: np.ndarray) -> Callable[[int], object]:
        return lambda row: types[kind](vector(first[row]), vector(second[row]))

    def support(place: int) -> Callable[[int, object], object]:
        return lambda row, _: flag(bool(walk.support[row, place]))

    robot = walk.robot
    joints, held = _joints(walk, robot)
    resting: dict[str, Any] = {"joint_angles": [*held.values()], "joint_rates": 0.0, "joint_torque": 0.0}
    fixed = {name: np.broadcast_to(value, (len(walk.time), len(held))) for name, value in resting.items()}
    states = [np.hstack([joints[name], values]).__getitem__ for name, values in fixed.items()]
    names, targets = [*robot.places_in_file()], joints["joint_targets"].__getitem__
    yield stamped("/joint_states", _JOINTS, lambda _: [*names, *held], *states)
    yield stamped("/joint_commands", _JOINTS, lambda _: names, targets, lambda _: none, lambda _: none)
    for place, limb in enumerate(walk.limbs):
        force = pair("geometry_msgs/msg/Wrench", walk.foot_force[:, place], walk.foot_moment[:, place])
        yield stamped(f"/{_word(limb)}/force", _WRENCH, force)
        yield _Topic(f"/{_word(limb)}/support", "std_msgs/msg/Bool", support(place))
    position, orientation = walk.base_position, walk.base_orientation
    placed = "geometry_msgs/msg/PoseStamped"
    yield stamped("/base_pose", placed, lambda row: pose(point(position[row]), turn(orientation[row])))
    moving = pair("geometry_msgs/msg/Twist", walk.base_linear_velocity, walk.base_angular_velocity)
    yield stamped("/base_twist", "geometry_msgs/msg/TwistStamped", moving)
    yield stamped("/push", _WRENCH, pair("geometry_msgs/msg/Wrench", walk.push[:, :3], walk.push[:, 3:]))
    yield _Topic("/tf", "tf2_msgs/msg/TFMessage", _transforms(walk, robot, types), rows_of_a_frame(walk))
    if (holds := holds_of(walk.scenario.ground)) is not None:
        yield _Topic("/holds", "sensor_msgs/msg/PointCloud2", _cloud(holds, types), len(walk.time))


def _joints(walk: Trajectory, robot: Robot) -> tuple[dict[str, np.ndarray], Mapping[str, float]]:
    """Return histories (time, joint) in the order of the robot's file, and the joints that are held, with their angles.

    A viewer would put joints that it hears nothing of at zero.
    """
    limb, joint = np.transpose([*robot.places_in_file().values()])
    fields = ("joint_angles", "joint_rates", "joint_torque", "joint_targets")
    values = {name: np.asarray(getattr(walk, name), np.float64)[:, limb, joint].copy("C") for name in fields}
    source = walk.scenario.robot
    return values, dict(source.locked.items()) if isinstance(source, RobotFile) else {}


def _transforms(walk: Trajectory, robot: Robot, types: _Types) -> Callable[[int, object], object]:
    """Return the maker of messages with the poses of root link and feet; a foot has the world's axes.

    No foot's frame has the name of a link: viewers place the links by the robot's file and `/joint_states`.
    """
    source = walk.scenario.robot
    root = root_link(source, robot) if isinstance(source, RobotFile) else None
    feet = [_word(f"{limb}_foot") for limb in walk.limbs]
    while root is not None and {*feet} & {*root.links}:
        feet = [f"{name}_contact" for name in feet]
    stamped, transform = types["geometry_msgs/msg/TransformStamped"], types["geometry_msgs/msg/Transform"]
    vector, turn = _vector(types["geometry_msgs/msg/Vector3"]), _quaternion(types)
    upright = np.array([1.0, 0.0, 0.0, 0.0])

    def message(row: int, header: object) -> object:
        at, turned = walk.base_position[row], walk.base_orientation[row]
        if root is not None:
            offset, axes = root.pose(walk.joint_angles[row])
            own = quaternion_to_matrix(turned)
            at, turned = at + own @ offset, quaternion(own @ axes)
        places = [(root.name if root else "base", at, turned)]
        places += zip(feet, walk.foot_position[row], itertools.repeat(upright), strict=False)
        made = [stamped(header, child, transform(vector(at), turn(turned))) for child, at, turned in places]
        return types["tf2_msgs/msg/TFMessage"](made)

    return message


def _cloud(holds: Holds, types: _Types) -> Callable[[int, object], object]:
    """Return the maker of messages with the points that can be held, as `ground.holds.cloud` reads them."""
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "limit")
    table = np.column_stack(holds.shown()).astype("<f4")
    float32, width = 7, table.itemsize
    field, cloud = types["sensor_msgs/msg/PointField"], types["sensor_msgs/msg/PointCloud2"]
    fields = [field(name, width * place, float32, 1) for place, name in enumerate(names)]
    row, data = width * len(names), np.frombuffer(table.tobytes(), np.uint8)
    return lambda _, header: cloud(header, 1, len(table), fields, False, row, row * len(table), data, True)


def _vector(kind: Callable[..., object]) -> Callable[[np.ndarray], object]:
    return lambda values: kind(*map(float, values))


def _quaternion(types: _Types) -> Callable[[np.ndarray], object]:
    """Return the maker of messages with a quaternion wxyz; ROS writes w last."""
    kind = types["geometry_msgs/msg/Quaternion"]
    return lambda wxyz: kind(*map(float, (*wxyz[1:], wxyz[0])))


def _word(name: str) -> str:
    """Return a name as ROS takes it."""
    return re.sub(r"\W", "_", name)
