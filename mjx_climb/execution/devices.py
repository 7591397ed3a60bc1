"""A batch spread over all devices: CPU cores, the GPUs of one host, or of several hosts.

Robots do not interact, so a batch is cut into shares, each computed by an executable of a single device. One executable
partitioned over the devices would exchange nothing either, but XLA simplifies a partitioned program in another order,
and a robot's last bits would depend on the number of devices. On CPUs a share is small whatever the number of devices
or threads: it stays in a core's cache, one executable serves batches of any size, and every robot keeps its bits.
"""

import contextlib
import math
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

import jax
import numpy as np
from jax.errors import JaxRuntimeError
from jax.experimental import multihost_utils
from jax.sharding import SingleDeviceSharding

_Result = TypeVar("_Result")

# Up to so many robots: shares of so many, few enough to keep several cores busy. Two walk one by one: so the last two
# starts of a search need no program but that of the last one.
_CPU_SHARES = {2: 1, 8: 2, 64: 16, math.inf: 64}
# In regions a step of 128 takes 1.4 times that of 64. Whole steps have larger arrays, which XLA computes by several
# threads: two shares of 128 under engine mjx wait for each other for ever.
_CPU_SHARES_IN_REGIONS = {1: 1, 8: 2, 64: 16, 128: 64, 192: 96, math.inf: 128}


class LostProcess(RuntimeError):
    """Another process ended while this one waited for its share; in one line, JAX's message."""


def begin() -> None:
    """Begin to start JAX's devices, for which a GPU takes seconds: imports go on beside."""

    def start() -> None:
        with contextlib.suppress(RuntimeError):  # who asks for a device is told
            jax.device_put(np.zeros(())).block_until_ready()

    threading.Thread(target=start, name="devices").start()


def host() -> jax.Device:
    """Return the CPU, where small programs in double precision run: for a GPU they compile long, and libraries fail."""
    return jax.local_devices(backend="cpu")[0]


def on_host() -> contextlib.AbstractContextManager[object]:
    """Run on the CPU unless placed elsewhere: single walks, and small programs."""
    return contextlib.nullcontext() if jax.default_backend() == "cpu" else jax.default_device(host())


def share_size(robots: int, limit: int | None, backend: str | None = None, *, in_regions: bool) -> int:
    """Return how many robots walk in one call of a program, of so many in all and at most `limit` at a time.

    `backend` is where they walk, where that is not JAX's default; `in_regions` whether their steps are compiled so, for
    values alone.
    """
    check_batch_size(limit)
    if (backend or jax.default_backend()) == "cpu":
        shares = _CPU_SHARES_IN_REGIONS if in_regions else _CPU_SHARES
        share = next(share for most, share in shares.items() if robots <= most)
    else:
        share = -(-min(robots, limit or robots) // jax.device_count())
    return min(share, limit or share)


def check_batch_size(robots: int | None) -> None:
    """Refuse to walk fewer than one robot at a time.

    Raises:
        ValueError: in one line, how many.
    """
    if robots is not None and robots < 1:
        raise ValueError(f"batch_size: expected 1 or more, got {robots}")


def walking_with(robots: range, whole: int, *, in_regions: bool) -> range:
    """Return which robots of a batch of `whole` walk in a batch of their own, where `robots` shall keep their bits.

    A robot's last bits depend on its place in a share, as vector units finish a row of robots one by one. So whole
    shares walk, and enough of them for the same program; indices beyond the batch stand for its last robot. A GPU's
    program holds the whole batch: there robots walk alone, and are the same to rounding only.
    """
    if jax.default_backend() != "cpu":
        return robots
    share = share_size(whole, None, in_regions=in_regions)
    begin = robots.start // share * share
    count = -(-(robots.stop - begin) // share) * share
    while share_size(count, None, in_regions=in_regions) != share:
        count += 1
    return range(begin, begin + count)


def spread(
    walk: Callable[[np.ndarray, SingleDeviceSharding], Mapping[str, jax.Array | np.ndarray]],
    robots: int,
    share: int,
    progress: Callable[[int, int], None] | None,
    backend: str | None = None,
) -> dict[str, np.ndarray]:
    """Return `walk` of the rows 0 to `robots`, in shares of equal size: the last row again where there are too few.

    `walk(rows, sharding)` gives a dict of arrays for some rows, on the device of the sharding; `progress` is told the
    number of robots that have walked in this process and will in all. `backend` is where they walk, where that is not
    JAX's default. With `jax.distributed` every process makes the same call and gets the whole result.
    """
    devices, this = jax.devices(backend), jax.process_index()
    count = max(-(-robots // share), len(devices) if jax.process_count() > 1 else 1)  # no process goes without
    shares = np.minimum(np.arange(count * share), robots - 1).reshape(-1, share)
    places = [devices[number % len(devices)] for number in range(count)]
    own = [number for number, device in enumerate(places) if device.process_index == this]
    total = min(len(own) * share, robots)

    def walk_share(number: int) -> dict[str, np.ndarray]:
        walked = walk(shares[number], SingleDeviceSharding(places[number]))
        found: dict[str, np.ndarray] = jax.device_get(dict(walked))  # which begins to copy all before it waits for one
        return found

    # An executor for each device of this process: the host launches every step of a loop and would keep others waiting.
    # CPU devices share the cores among them.
    mine = [device for device in devices if device.process_index == this]
    each = max(1, usable_cores() // len(mine)) if devices[0].platform == "cpu" else 1
    with contextlib.ExitStack() as stack:
        threads = {device: ThreadPoolExecutor(each) for device in mine}
        for executor in threads.values():
            stack.callback(executor.shutdown, cancel_futures=True)
        walking = {threads[places[number]].submit(walk_share, number): number for number in own}
        for done, future in enumerate(as_completed(walking), 1):
            future.result()  # errors are raised at once
            if progress is not None:
                progress(min(done * share, total), total)
    parts = {number: future.result() for future, number in walking.items()}
    if jax.process_count() > 1:
        parts = _gathered(parts, [device.process_index for device in places])
    return {name: np.concatenate([parts[n][name] for n in range(count)])[:robots] for name in parts[0]}


def in_smaller_shares(walk: Callable[[int], _Result], share: int) -> _Result:
    """Return `walk` of a share that finds room in the memory: half as large where it did not.

    Raises:
        JaxRuntimeError: anything else, or no room for one robot.
    """
    while True:
        try:
            return walk(share)
        except JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or share == 1:
                raise
        share = -(-share // 2)


def usable_cores() -> int:
    """Return how many CPU cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _gathered(parts: dict[int, dict[str, np.ndarray]], owners: list[int]) -> dict[int, dict[str, np.ndarray]]:
    """Return the shares of all processes, from those of this one; each has at least one, and `owners` names it."""
    like = next(iter(parts.values()))
    table = np.zeros(len(owners), np.dtype([(name, value.dtype, value.shape) for name, value in like.items()]))
    for number, part in parts.items():
        for name, value in part.items():
            table[name][number] = value
    try:  # as bytes: JAX would round double precision
        everyone = np.asarray(multihost_utils.process_allgather(table.view(np.uint8).reshape(len(owners), -1)))
    except (RuntimeError, ValueError) as error:  # ValueError: Gloo's, between CPUs
        reason = str(error).partition("\n")[0]
        raise LostProcess(f"another process of this computation has ended: {reason}") from error
    for number, owner in enumerate(owners):
        table[number] = everyone[owner, number].view(table.dtype)[0]
    return {number: {name: table[name][number] for name in like} for number in range(len(owners))}
