"""A batch on several devices and several processes: the same bits as on one, and no hanging."""

import os
import socket
import subprocess
import sys
import threading

import jax
import numpy as np
import pytest

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


def _walk(tmp_path, devices, processes=1, robots=101):
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


def _assert_same_bits(one, other):
    for name, value in one.items():
        assert value.tobytes() == other[name].tobytes(), name


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the metrics of the batch on one device."""
    return _walk(tmp_path_factory.mktemp("one"), 1)[0]


@pytest.mark.nightly
@pytest.mark.parametrize("devices", [2, 3])
def test_more_devices_give_the_same_bits(tmp_path, alone, devices):
    """A robot's walk does not depend on how many devices share the batch, ragged shares included."""
    (metrics,) = _walk(tmp_path, devices)
    _assert_same_bits(alone, metrics)


@pytest.mark.slow
def test_two_processes_give_the_same_bits(tmp_path, alone):
    """Under jax.distributed every process gets the whole result, with the bits of a single device."""
    for metrics in _walk(tmp_path, 1, processes=2):
        _assert_same_bits(alone, metrics)


@pytest.mark.slow
@pytest.mark.nightly
def test_fewer_robots_than_processes_need(tmp_path):
    """A process without robots of its own neither fails nor keeps the others waiting."""
    (alone,) = _walk(tmp_path, 1, robots=12)
    for metrics in _walk(tmp_path, 1, processes=2, robots=12):
        _assert_same_bits(alone, metrics)


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
