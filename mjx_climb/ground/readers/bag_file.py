"""Point clouds in recordings of ROS 2 (`sensor_msgs/PointCloud2`), by `rosbags`: the last one of a topic."""

from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.scenario.messages import config_error

SUFFIXES = (".mcap", ".db3")
_CLOUD = "sensor_msgs/msg/PointCloud2"
# by the numbers of sensor_msgs/PointField
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read(path: Path, topic: str | None) -> dict[str, np.ndarray]:
    """The fields of the points by their names; of a field with several numbers the first one."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        found = [each for each in reader.connections if each.msgtype == _CLOUD and topic in (None, each.topic)]
        if len({each.topic for each in found}) != 1:
            expected = f"one topic with {_CLOUD}" if topic is None else f"{_CLOUD} on {topic}"
            raise config_error(str(path), "topic", expected, ", ".join(each.topic for each in found) or "none")
        *_, (connection, _, raw) = reader.messages(found)
        cloud: Any = reader.deserialize(raw, connection.msgtype)
    order = ">" if cloud.is_bigendian else "<"
    kinds: Any = {
        "names": [field.name for field in cloud.fields],
        "formats": [f"{order}{_KINDS[field.datatype]}" for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_step,
    }
    layout = np.dtype(kinds)
    rows = cloud.data.reshape(cloud.height, cloud.row_step)[:, : cloud.width * cloud.point_step]
    table = np.frombuffer(rows.tobytes(), layout)
    return {field.name: table[field.name].astype(float) for field in cloud.fields}
