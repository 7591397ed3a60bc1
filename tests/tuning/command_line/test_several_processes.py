"""Several processes for one command: how they are recognised, what they write together, and how they end."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tuning.command_line import launcher
from tuning.command_line.ending import InputError

ROOT = Path(__file__).parents[3]
SHORT = ["case_1_2", "--set", "duration=0.2"]
SWEEP = ["sweep", *SHORT, "--stiffness", "1e3:1e5:3", "--damping", "1e2:1e3:2", "--batch-size", "4"]
TUNE = ["tune", *SHORT, "--starts", "2", "--iterations", "2"]

JAX = {"JAX_COORDINATOR_ADDRESS": "node1:99", "JAX_NUM_PROCESSES": "4", "JAX_PROCESS_ID": "3"}
SLURM = {
    "SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "node[1-2]", "SLURM_NTASKS": "8", "SLURM_STEP_NUM_TASKS": "8",
    "SLURM_PROCID": "5", "SLURM_LOCALID": "1",
}  # fmt: skip
MPI = {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1"}
URI = {"OMPI_MCA_orte_hnp_uri": "1531576320.0;tcp://10.96.0.1:34911"}


@pytest.fixture
def launched(monkeypatch):
    """Return what is recognised where the environment has these variables of launchers and no others."""

    def recognise(variables):
        for name in [name for name in os.environ if name.startswith(("JAX_", "SLURM_", "OMPI_"))]:
            monkeypatch.delenv(name)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        return launcher.process()

    return recognise


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, None),
        (JAX, (3, 4, "node1:99")),
        (SLURM, (5, 8, None)),
        (MPI | URI, (1, 2, None)),
        (MPI | {"JAX_COORDINATOR_ADDRESS": "node1:99"}, (1, 2, "node1:99")),
        # one process, whatever else there is: a batch script, an interactive step, tasks that shall walk apart
        ({name: value for name, value in SLURM.items() if "STEP" not in name}, None),
        (SLURM | {"SLURM_STEP_NUM_TASKS": "1"}, None),
        (SLURM | {"JAX_NUM_PROCESSES": "1"}, None),
        ({"OMPI_COMM_WORLD_SIZE": "1", "OMPI_COMM_WORLD_RANK": "0"}, None),
        ({"JAX_COORDINATOR_ADDRESS": "node1:99"}, None),
    ],
)
def test_a_launcher_is_recognised(variables, expected, launched):
    found = launched(variables)
    assert (None if found is None else found[:3]) == expected


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        (MPI, "JAX_COORDINATOR_ADDRESS: expected host:port of process 0"),
        (JAX | {"JAX_PROCESS_ID": "4"}, "JAX_PROCESS_ID: expected a number below the 4 of JAX_NUM_PROCESSES, got 4"),
        (JAX | {"JAX_PROCESS_ID": ""}, "JAX_PROCESS_ID: expected a whole number, got ''"),
        (JAX | {"JAX_NUM_PROCESSES": "two"}, "JAX_NUM_PROCESSES: expected a whole number, got 'two'"),
    ],
)
def test_a_launcher_that_makes_no_sense(variables, expected, launched):
    with pytest.raises(InputError, match=expected):
        launched(variables)


def start(*arguments, **variables):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", **variables}
    command = [sys.executable, "-m", "tuning.command_line", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def together(*commands):
    """Start a process for each list of arguments, joined as JAX's variables say."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    how = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(len(commands))}
    return [start(*command, JAX_PROCESS_ID=str(number), **how) for number, command in enumerate(commands)]


def ends(processes):
    """Return the exit code, standard output and standard error of each."""
    said = [process.communicate(timeout=600) for process in processes]
    return [(process.returncode, *texts) for process, texts in zip(processes, said, strict=True)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Return the folder that one process wrote, and what it printed."""
    folder = tmp_path_factory.mktemp("alone")
    ((code, out, errors),) = ends([start(*SWEEP, "--out", folder, "--json")])
    assert code == 0, errors
    return folder, out


@pytest.mark.slow
@pytest.mark.nightly
def test_two_processes_write_what_one_writes(alone, tmp_path):
    """A sweep that was killed goes on in two processes: they have the parts of the first one."""
    folder, printed = alone
    killed = start(*SWEEP, "--out", tmp_path)
    while not list(tmp_path.glob("parts/part-*.npz")) and killed.poll() is None:
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    (first, second) = ends(together(*[[*SWEEP, "--out", tmp_path, "--json"]] * 2))
    assert first[:2] == (0, printed), first
    assert second == (0, "", "")
    assert "2 processes" in first[2] and "; 4 are there already" in first[2]
    for name in ("sweep.nc", "maps.png", "comparison.json", "config.yaml"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


@pytest.mark.slow
@pytest.mark.nightly
def test_two_processes_find_the_same_gains(tmp_path):
    results = [tmp_path / "one", tmp_path / "two"]
    (one,) = ends([start(*TUNE, "--out", results[0], "--json")])
    first, second = ends(together(*[[*TUNE, "--out", results[1], "--json"]] * 2))
    assert (one[0], first[0], second) == (0, 0, (0, "", "")), (one[2], first[2])
    assert first[1] == one[1]
    for name in ("gains.yaml", "search.nc", "map.nc"):
        assert (results[1] / name).read_bytes() == (results[0] / name).read_bytes(), name


@pytest.mark.slow
def test_what_is_wrong_in_one_process_ends_all_and_is_said_once(tmp_path):
    bad = [word.replace("duration=0.2", "durations=0.2") for word in SWEEP]
    other = [word.replace("1e5:3", "1e6:3") for word in SWEEP]
    for commands, expected in (
        ((bad, bad), "mjx-climb: error: .*durations"),
        ((SWEEP, bad), "mjx-climb: error: process 1: .*durations"),
        ((SWEEP, other), "mjx-climb: error: process 1: expected the same command and config in all processes"),
    ):
        first, second = ends(together(*([*command, "--out", tmp_path / "out"] for command in commands)))
        lines = [line for line in first[2].splitlines() if line.startswith("mjx-climb")]
        assert (first[:2], len(lines)) == ((2, ""), 1), first
        assert re.match(expected, lines[0])
        assert second == (2, "", "")


@pytest.mark.slow
def test_interrupted_processes_end_and_say_what_is_kept(tmp_path):
    long = [*SWEEP[:-1], "1", "--set", "duration=8", "--out", tmp_path]
    running = together(long, long)
    while not list(tmp_path.glob("parts/part-*.npz")) and running[0].poll() is None:
        time.sleep(0.01)
    for process in running:
        process.send_signal(signal.SIGTERM)
    first, second = ends(running)
    assert first[0] == 130, first
    assert "of 6 walks are kept" in first[2].splitlines()[-1]
    assert second[0] != 0 and not second[1] + second[2]


@pytest.mark.slow
def test_a_process_that_dies_ends_the_other_with_a_line(tmp_path):
    long = [*SWEEP[:-1], "1", "--set", "duration=8", "--out", tmp_path]
    running = together(long, long)
    while not list(tmp_path.glob("parts/part-*.npz")) and running[0].poll() is None:
        time.sleep(0.01)
    running[1].kill()
    first, _ = ends(running)
    assert first[:2] == (2, ""), first
    assert first[2].splitlines()[-1].startswith("mjx-climb: error: another process of this computation has ended: ")
