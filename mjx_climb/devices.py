"""A batch spread over whatever devices there are: CPU cores, the GPUs of one host, or of several hosts.

Robots do not talk to each other, so each device walks its share by the program that a single device would run. One
program partitioned over the devices would exchange nothing either, but XLA simplifies a partitioned program in another
order, and the last bits of a robot's walk would then depend on the number of devices.
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import SingleDeviceSharding


def spread(walk: Callable, rows: np.ndarray, robots_per_device: int) -> dict[str, np.ndarray]:
    """Return `walk` of the rows, up to `robots_per_device` of them on each device of each process.

    `walk(rows, sharding)` gives a dict of arrays for some rows, on the device of the sharding, without waiting.
    Every device walks as many robots: the last one again where there are fewer. With `jax.distributed` every process
    makes the same call and gets the whole result.
    """
    devices = jax.devices()
    filled = np.minimum(np.arange(robots_per_device * len(devices)), len(rows) - 1)
    shares = rows[filled].reshape(len(devices), robots_per_device)
    pending = [
        walk(share, SingleDeviceSharding(device))
        for device, share in zip(devices, shares, strict=True)
        if device.process_index == jax.process_index()
    ]
    result = {name: np.concatenate([np.asarray(part[name]) for part in pending]) for name in pending[0]}
    if jax.process_count() > 1:
        result = multihost_utils.process_allgather(result, tiled=True)
    return {name: np.asarray(value)[: len(rows)] for name, value in result.items()}
