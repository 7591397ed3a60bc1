"""Several processes for one command, together or each with its shard: how they are told apart, write and end."""

import json
import os
import re
import signal
import socket
import time
from functools import partial

import pytest

from tests.shell import ends, finish, killed, same_files, start, wait_for_parts
from tuning.command_line import processes
from tuning.command_line.processes import shard_from
from tuning.command_line.program import InputError

SHORT = ["case_1_2", "--set", "duration=0.3"]
SWEEP = ["sweep", *SHORT, "--stiffness", "1e3:1e5:3", "--damping", "1e2:1e3:2", "--batch-size", "4"]
LONG = [*SWEEP[:-1], "1", "--set", "duration=8"]
TUNE = ["tune", *SHORT, "--starts", "2", "--iterations", "2"]
GRID = ["sweep", *SHORT, "--stiffness", "1e2:1e6:12", "--damping", "1e1:1e5:6"]  # 72 robots: more than walk in one call
WRITTEN = ("sweep.nc", "maps.png", "comparison.json", "config.yaml")

JAX = {"JAX_COORDINATOR_ADDRESS": "node1:99", "JAX_NUM_PROCESSES": "4", "JAX_PROCESS_ID": "3"}
SLURM = {
    "SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "node[1-2]", "SLURM_NTASKS": "8", "SLURM_STEP_NUM_TASKS": "8",
    "SLURM_PROCID": "5", "SLURM_LOCALID": "1",
}  # fmt: skip
MPI = {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1"}
URI = {"OMPI_MCA_orte_hnp_uri": "1531576320.0;tcp://10.96.0.1:34911"}


def array(**changes):
    values = {"ID": "5", "MIN": "2", "MAX": "5", "COUNT": "4", **changes}
    return {f"SLURM_ARRAY_TASK_{name}": value for name, value in values.items()}


@pytest.fixture
def launched(monkeypatch):
    """Return a function that sets these variables of launchers and no others."""

    def launch(variables):
        for name in [name for name in os.environ if name.startswith(("JAX_", "SLURM_", "OMPI_"))]:
            monkeypatch.delenv(name)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return launch


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
    launched(variables)
    found = processes.process()
    assert (None if found is None else found[:3]) == expected


@pytest.mark.parametrize(
    ("text", "variables", "shard"),
    [
        (None, {}, None),
        ("3/16", {}, (3, 16)),
        ("1/1", {}, None),
        (None, array(), (4, 4)),
        (None, array(ID="2"), (1, 4)),
        (None, array(ID="8", MIN="0", MAX="12", COUNT="4", STEP="4"), (3, 4)),
        ("1/2", array(), (1, 2)),
        ("1/1", array(), None),
    ],
)
def test_which_shard_a_process_walks(text, variables, shard, launched):
    launched(variables)
    found, words = shard_from(text)
    assert found == shard
    assert bool(words) == (text is not None or bool(variables))
    assert ("Slurm" in words) == (text is None and bool(variables))


GAPS = "expected several tasks without gaps"


@pytest.mark.parametrize(
    ("asked", "variables", "expected"),
    [
        (processes.process, MPI, "JAX_COORDINATOR_ADDRESS: expected host:port of process 0"),
        (processes.process, JAX | {"JAX_PROCESS_ID": "4"}, "JAX_PROCESS_ID: expected a number below the 4 of JAX_NUM"),
        (processes.process, JAX | {"JAX_PROCESS_ID": ""}, "JAX_PROCESS_ID: expected a whole number, got ''"),
        (processes.process, JAX | {"JAX_NUM_PROCESSES": "two"}, "JAX_NUM_PROCESSES: expected a whole number, got 'tw"),
        *((partial(shard_from, text), {}, "--shard: expected I/N") for text in ("0/4", "5/4", "1", "1/4/2")),
        (partial(shard_from, None), array(MIN="1", MAX="9"), GAPS),
        (partial(shard_from, None), array(ID="9"), GAPS),
        (partial(shard_from, None), array(ID="3", MIN="3", MAX="3", COUNT="1"), f"{GAPS}, got 1 from 3 to 3"),
        (partial(shard_from, None), array(COUNT=""), "SLURM_ARRAY_TASK_COUNT: expected a whole number"),
    ],
)
def test_a_launcher_or_a_shard_that_makes_no_sense(asked, variables, expected, launched):
    launched(variables)
    with pytest.raises(InputError, match=expected):
        asked()


def together(*commands):
    """Start a process for each list of arguments, joined as JAX's variables say."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    how = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(len(commands)), "JAX_PLATFORMS": "cpu"}
    return [start(*command, JAX_PROCESS_ID=str(number), **how) for number, command in enumerate(commands)]


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("command", "files"), [(SWEEP, WRITTEN), (TUNE, ("gains.yaml", "search.nc", "map.nc"))], ids=["sweep", "tune"]
)
def test_two_processes_write_what_one_writes(command, files, tmp_path):
    """A sweep that was killed goes on in two processes: they have the parts of the first one."""
    alone, two = tmp_path / "alone", tmp_path / "two"
    printed, _ = finish(*command, "--out", alone, "--json", JAX_PLATFORMS="cpu")
    if command is SWEEP:
        killed(*command, "--out", two, once=two)
    first, second = ends(*together(*[[*command, "--out", two, "--json"]] * 2))
    assert (first[:2], second) == ((0, printed), (0, "", "")), first
    assert "2 processes" in first[2] and ("; 4 are there already" in first[2]) == (command is SWEEP)
    same_files(two, alone, *files)


BAD = [word.replace("duration=0.3", "durations=0.3") for word in SWEEP]
OTHER = [word.replace("1e5:3", "1e6:3") for word in SWEEP]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("commands", "expected"),
    [
        pytest.param((BAD, BAD), "mjx-climb: error: .*durations", marks=pytest.mark.nightly),
        pytest.param((SWEEP, BAD), "mjx-climb: error: process 1: .*durations", marks=pytest.mark.nightly),
        ((SWEEP, OTHER), "mjx-climb: error: process 1: expected the same command and config in all processes"),
    ],
    ids=["both", "one", "unlike"],
)
def test_what_is_wrong_in_one_process_ends_all_and_is_said_once(commands, expected, tmp_path):
    first, second = ends(*together(*([*command, "--out", tmp_path / "out"] for command in commands)))
    lines = [line for line in first[2].splitlines() if line.startswith("mjx-climb")]
    assert (first[:2], len(lines)) == ((2, ""), 1), first
    assert re.match(expected, lines[0])
    assert second == (2, "", "")


@pytest.mark.nightly
def test_interrupted_processes_end_and_say_what_is_kept(tmp_path):
    running = together(*[[*LONG, "--out", tmp_path]] * 2)
    wait_for_parts(running[0], tmp_path)
    for process in running:
        process.send_signal(signal.SIGTERM)
    first, second = ends(*running)
    assert first[0] == 130, first
    assert "of 6 walks are kept" in first[2].splitlines()[-1]
    assert second[0] != 0 and not second[1] + second[2]


@pytest.mark.nightly
def test_a_process_that_dies_ends_the_other_with_a_line(tmp_path):
    running = together(*[[*LONG, "--out", tmp_path]] * 2)
    wait_for_parts(running[0], tmp_path)
    running[1].kill()
    first, _ = ends(*running)
    assert first[:2] == (2, ""), first
    assert first[2].splitlines()[-1].startswith("mjx-climb: error: another process of this computation has ended: ")


@pytest.mark.nightly
def test_four_shards_merged_are_the_same_files(tmp_path):
    """One shard dies, is named, and goes on; all that is written is that of one machine, but for the typed command."""
    one, four = tmp_path / "one", tmp_path / "four"
    alone, _ = finish(*GRID, "--out", one, "--json")
    sweep = [*GRID, "--out", four]
    for number in (1, 2):
        finish(*sweep, "--shard", f"{number}/4")
    assert "shard 4/4, this task of a Slurm array" in finish(*sweep, **array())[1]
    died = start(*sweep, "--shard", "3/4")
    while not (four / "shard-3-of-4" / "shard.json").exists():
        time.sleep(0.01)
    died.kill()
    ends(died)
    _, said = finish("sweep", "--merge", four, code=2)
    assert said.startswith(f"mjx-climb: error: {four}: shard 3/4 lacks 18 of 18 walks (stiffness ")
    remedy = said.partition("to finish it: mjx-climb ")[2].split()
    assert json.loads(finish(*GRID, "--out", four, "--shard", "1/4", "--json")[0]) == {"shard": 1, "of": 4, "walks": 18}
    assert finish(*remedy, "--json")[0] == alone  # the last one merges all
    same_files(four, one, *WRITTEN)
    assert finish("sweep", "--merge", four, "--json")[0] == alone
    pages = [(folder / "report.html").read_text().splitlines() for folder in (one, four)]
    differ = [lines for lines in zip(*pages, strict=True) if lines[0] != lines[1]]
    assert [line.startswith("<pre>mjx-climb ") for line in sum(differ, ())] == [True, True]


@pytest.mark.slow
@pytest.mark.nightly
def test_judged_in_shards_is_the_same_file(tmp_path):
    """72 members, more than walk in one call; an interrupted shard keeps what it has."""
    gains, one, three = tmp_path / "mine.yaml", tmp_path / "one", tmp_path / "three"
    gains.write_text("inertia: 2.0\ndamping: 30.0\nstiffness: 500.0\n")
    judge = ["evaluate", *SHORT, "--gains", gains, "--members", "72"]
    alone = json.loads(finish(*judge, "--out", one, "--json")[0])
    judged = alone["gains"]
    assert list(judged) == ["mine", "config", "pd"] and 0 < judged["pd"]["mean"]["force_variation"]
    for number in (1, 2, 3):
        finish(*judge, "--out", three, "--shard", f"{number}/3")
    assert "; 24 are there already" in finish(*judge, "--out", three, "--shard", "2/3")[1]
    assert json.loads(finish("evaluate", "--merge", three, "--json")[0]) == alone
    same_files(three, one, "judged.nc", "judged.png", "summary.json", "ensemble.yaml")
    _, refused = finish("evaluate", "--merge", three / "shard-1-of-3", "--merge", three / "shard-3-of-3", code=2)
    assert "shard 2/3 is not there: it lacks 24 of 24 walks (member 24 to member 47)" in refused
