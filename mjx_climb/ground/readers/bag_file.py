"""Point clouds in recordings of ROS 2 (`sensor_msgs/PointCloud2`), by `rosbags`: the last one of a topic."""

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.ground.table import Table, packed
from mjx_climb.scenario.messages import ConfigError

SUFFIXES = (".mcap", ".db3")
_CLOUD = "sensor_msgs/msg/PointCloud2"
# by the numbers of sensor_msgs/PointField
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def read(path: Path, topic: str | None) -> Table:
    """The fields of the points by their names; of a field with several numbers the first one."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        found = [each for each in reader.connections if each.msgtype == _CLOUD and topic in (None, each.topic)]
        if len({each.topic for each in found}) != 1:
            expected = f"one topic with {_CLOUD}" if topic is None else f"{_CLOUD} on {topic}"
            raise ConfigError(str(path), "topic", expected, ", ".join(each.topic for each in found) or "none")
        last = deque(reader.messages(found), maxlen=1)
        if not last:
            raise ConfigError(str(path), found[0].topic, "a message", "none")
        cloud: Any = reader.deserialize(last[0][2], _CLOUD)
    if unknown := {field.datatype for field in cloud.fields} - _KINDS.keys():
        raise ConfigError(str(path), found[0].topic, "fields with datatype 1 to 8", str(min(unknown)))
    order = ">" if cloud.is_bigendian else "<"
    kinds: Any = {
        # unique: a name that stands twice is told of where it is used
        "names": [str(number) for number, _ in enumerate(cloud.fields)],
        "formats": [f"{order}{_KINDS[field.datatype]}" for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_step,
    }
    used = cloud.width * cloud.point_step
    if not (used <= cloud.row_step and cloud.height * cloud.row_step == cloud.data.size):
        expected = f"{cloud.height} rows of {used} bytes or more"
        raise ConfigError(str(path), found[0].topic, expected, f"row_step {cloud.row_step}, {cloud.data.size} bytes")
    rows = cloud.data.reshape(cloud.height, cloud.row_step)[:, :used]
    points = packed(rows.tobytes(), np.dtype(kinds), cloud.height * cloud.width)
    return Table(str(path), [(field.name, points[str(number)]) for number, field in enumerate(cloud.fields)])
