"""A batch on several devices and several processes: the same bits as on one, and no hanging."""

import functools
import os
import socket
import subprocess
import sys
import threading
import warnings

import jax
import numpy as np
import pytest
from jax.errors import JaxRuntimeError

from mjx_climb import execution
from mjx_climb.execution import devices

# 101 robots: no multiple of any number of devices tried here
WALK = """
import sys
import jax
devices, process, processes, address, path, robots = sys.argv[1:]
jax.config.update("jax_num_cpu_devices", int(devices))
if int(processes) > 1:
    jax.distributed.initialize(address, int(processes), int(process))
import numpy as np
import mjx_climb as mc
assert jax.device_count() == int(devices) * int(processes)
scenario = mc.load_scenario("configs/case_1_2.yaml", ["duration=0.05"])
stiffness = np.geomspace(1e2, 1e6, 101)[:int(robots), None]
metrics = mc.rollout_metrics(scenario, mc.Gains(1.0, 1e2, stiffness), batch_size=151)
np.savez(path, **metrics)
"""


def _walk(tmp_path, devices, processes, robots):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    paths = [tmp_path / f"{devices}-{process}-{processes}.npz" for process in range(processes)]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", WALK, str(devices), str(process), str(processes), address, str(path), str(robots)],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            stderr=subprocess.PIPE,
            text=True,
        )
        for process, path in enumerate(paths)
    ]
    try:
        for process in running:
            _, errors = process.communicate(timeout=300)
            assert process.returncode == 0, errors
    finally:  # the others of one that failed would wait for it
        for process in running:
            process.kill()
            process.wait()
    return [dict(np.load(path)) for path in paths]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the metrics of a number of robots on one device."""
    return functools.cache(lambda robots: _walk(tmp_path_factory.mktemp("one"), 1, 1, robots)[0])


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("devices", "processes", "robots"),
    [(1, 2, 101), *(pytest.param(*how, marks=pytest.mark.nightly) for how in ((2, 1, 101), (3, 1, 101), (1, 2, 12)))],
)
def test_more_devices_or_processes_give_the_same_bits(tmp_path, alone, devices, processes, robots):
    """Ragged shares included. Under jax.distributed every process gets all, also one that has no robots of its own."""
    for metrics in _walk(tmp_path, devices, processes, robots):
        assert {name: value.tobytes() for name, value in metrics.items()} == {
            name: value.tobytes() for name, value in alone(robots).items()
        }


def test_a_device_that_does_not_start_is_said_by_who_asks_for_one(monkeypatch, capfd):
    """Not by the thread that began to start it."""

    def refuse(_):
        refused.set()
        raise RuntimeError("no device")

    refused = threading.Event()
    monkeypatch.setattr(jax, "device_put", refuse)
    devices.begin()
    assert refused.wait(20)
    for thread in threading.enumerate():
        if thread.name == "devices":
            thread.join()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("in_regions", [True, False])
def test_a_share_is_no_larger_than_asked_for_and_robots_walk_in_whole_shares_again(in_regions, cpu_alone):
    assert devices.share_size(1000, 5, in_regions=in_regions) == 5
    share = devices.share_size(1000, None, in_regions=in_regions)
    for robots in (range(0, 3), range(share + 3, share + 5), range(share - 1, 2 * share + 1)):
        walked = devices.walking_with(robots, 1000, in_regions=in_regions)
        assert walked.start == robots.start // share * share and walked.stop >= robots.stop
        assert devices.share_size(len(walked), None, in_regions=in_regions) == share


@pytest.mark.parametrize(
    ("robots", "whole", "in_regions"),
    [(1, 1, 1), (2, 1, 2), (3, 2, 2), (8, 2, 2), (9, 16, 16), (64, 16, 16), (65, 64, 64), (128, 64, 64), (129, 64, 96),
     (192, 64, 96), (193, 64, 128)],
)  # fmt: skip
def test_robots_share_a_program_by_their_number(robots, whole, in_regions):
    assert devices.share_size(robots, None, "cpu", in_regions=False) == whole
    assert devices.share_size(robots, None, "cpu", in_regions=True) == in_regions
    assert devices.share_size(robots, None, "gpu", in_regions=True) == -(-robots // len(jax.devices()))
    assert devices.share_size(robots, 50, "gpu", in_regions=True) == -(-min(robots, 50) // len(jax.devices()))


def test_a_batch_that_does_not_fit_is_split():
    """Until its shares find room; what else goes wrong is raised, and so is no room for one robot."""
    tried = []

    def walk(share, most=20, message="RESOURCE_EXHAUSTED: out of memory"):
        tried.append(share)
        if share > most:
            raise JaxRuntimeError(message)
        return f"{share} at once"

    assert devices.in_smaller_shares(walk, 100) == "13 at once"
    assert tried == [100, 50, 25, 13]
    for no_room in (functools.partial(walk, most=0), functools.partial(walk, message="INTERNAL")):
        with pytest.raises(JaxRuntimeError):
            devices.in_smaller_shares(no_room, 100)
    assert tried[4:] == [100, 50, 25, 13, 7, 4, 2, 1, 100]


class Device:
    """A CPU of some process."""

    platform = "cpu"

    def __init__(self, process):
        self.process_index = process


@pytest.mark.parametrize(
    ("robots", "share", "owners"), [(7, 2, [0, 1]), (3, 2, [0, 1]), (9, 2, [0, 0, 1]), (1, 4, [1, 0])]
)
def test_shares_of_all_processes_come_together_as_they_are(monkeypatch, robots, share, owners):
    """Each walks its own, at least one; the last robot again where there are too few, and double precision stays."""
    places = [Device(owner) for owner in owners]
    monkeypatch.setattr(jax, "devices", lambda backend=None: places)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(devices, "SingleDeviceSharding", lambda device: device)
    tables, told, walked = {}, [], []

    def walk(rows, place):
        walked.append((place.process_index, rows.tolist()))
        return {"third": rows / 3, "pairs": np.stack([rows, -rows], 1).astype(np.int16)}

    def gather(table):
        tables[process] = table
        if len(tables) < 2:
            raise RuntimeError("connection lost\nand more")
        return np.stack([tables[0], tables[1]])

    monkeypatch.setattr(devices.multihost_utils, "process_allgather", gather)
    for process in (1, 0):
        monkeypatch.setattr(jax, "process_index", lambda process=process: process)
        asked = functools.partial(devices.spread, walk, robots, share, lambda *far: told.append(far))
        if process:
            with pytest.raises(
                devices.LostProcess, match=r"^another process of this computation has ended: connection l"
            ):
                asked()
        else:
            found = asked()
    np.testing.assert_array_equal(found["third"], np.arange(robots) / 3)
    np.testing.assert_array_equal(found["pairs"], np.stack([np.arange(robots), -np.arange(robots)], 1))
    count = max(-(-robots // share), len(owners))
    expected = [(owners[n % len(owners)], [min(n * share + k, robots - 1) for k in range(share)]) for n in range(count)]
    assert sorted(walked) == sorted(expected)
    of_this = min(share * sum(owner == 0 for owner, _ in expected), robots)
    assert told[-1] == (of_this, of_this)


def test_robots_of_a_gpu_walk_alone(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert devices.walking_with(range(3, 5), 1000, in_regions=False) == range(3, 5)


def test_a_process_that_is_forked_after_jax_began_computes_nothing():
    """It would wait for ever for threads that it does not have."""
    jax.devices()
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX's own, of the fork
        child = os.fork()
    if child == 0:
        try:
            execution.check_process()
        except RuntimeError as error:
            os.write(write, str(error).encode())
        finally:
            os._exit(0)
    os.close(write)
    os.waitpid(child, 0)
    with os.fdopen(read) as said:
        assert said.read() == (
            "this process was forked from one in which JAX had begun, and JAX would hang here: start it by "
            "multiprocessing.get_context('spawn') or 'forkserver'"
        )
    execution.check_process()
