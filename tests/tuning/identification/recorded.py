"""Recordings as a robot's programs leave them, made here: columns by the names of signals, and bags of ROS 2."""

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mjx_climb.robot_import.load import load_robot

ROBOT = load_robot("hubrobo_v3_2")
JOINTS = [f"{limb}.{joint}" for limb in ROBOT.limbs for joint in ROBOT.joint_names]
TYPES = get_typestore(Stores.ROS2_HUMBLE)


def recorded(rate=100.0, duration=10.0, lag=0.03, noise=1e-3):
    """Return columns of a log in which each joint follows a chirp of its own, `lag` s late."""
    generator = np.random.default_rng(0)
    time = np.arange(round(rate * duration)) / rate
    columns = {"time": time}
    for number, joint in enumerate(JOINTS):
        limb, which = divmod(number, 3)
        middle = ROBOT.stance_joints[limb, which]

        def chirp(t, number=number, middle=middle):
            t = np.maximum(t, 0.0)
            return middle + 0.2 * np.sin(2 * np.pi * (0.3 + 0.07 * number + 0.04 * t) * t)

        columns[f"{joint}.command"] = chirp(time)
        columns[f"{joint}.position"] = chirp(time - lag) + noise * generator.standard_normal(len(time))
    return columns


def bag(path, topics, storage=StoragePlugin.MCAP):
    """Write a bag, topic: (type of message, [(log time ns, message)]), and return its folder."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for topic, (kind, messages) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=TYPES)
            for time, message in messages:
                writer.write(connection, time, TYPES.serialize_cdr(message, kind))
    return path


def header(time, frame=""):
    """Return a header of a time in ns."""
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def joint_state(time, names, position):
    """Return positions of joints, without rates and efforts."""
    none = np.array([])
    made = TYPES.types["sensor_msgs/msg/JointState"]
    return made(header=header(time), name=list(names), position=np.asarray(position), velocity=none, effort=none)


def wrench(time, force, frame=""):
    """Return a force, N, and no moment."""
    vector, pair = TYPES.types["geometry_msgs/msg/Vector3"], TYPES.types["geometry_msgs/msg/Wrench"]
    both = pair(force=vector(*map(float, force)), torque=vector(0.0, 0.0, 0.0))
    return TYPES.types["geometry_msgs/msg/WrenchStamped"](header=header(time, frame), wrench=both)


def number(value):
    """Return one number."""
    return TYPES.types["std_msgs/msg/Float64"](data=float(value))
