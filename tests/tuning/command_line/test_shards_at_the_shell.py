"""`sweep --shard`, the tasks of a Slurm array, and `merge`, in processes of their own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tuning.command_line import launcher
from tuning.command_line.ending import InputError

ROOT = Path(__file__).parents[3]
SHORT = ["case_1_2", "--set", "duration=0.2"]
GRID = ["--stiffness", "1e2:1e6:12", "--damping", "1e1:1e5:6"]  # 72 robots: more than walk in one call
ARRAY = {"ID": "5", "MIN": "2", "MAX": "5", "COUNT": "4"}


def array(**changes):
    return {f"SLURM_ARRAY_TASK_{name}": value for name, value in {**ARRAY, **changes}.items()}


@pytest.mark.parametrize(
    ("text", "environment", "shard"),
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
def test_which_shard_a_process_walks(text, environment, shard, monkeypatch):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    found, words = launcher.shard_from(text)
    assert found == shard
    assert bool(words) == (text is not None or bool(environment))
    assert ("Slurm" in words) == (text is None and bool(environment))


@pytest.mark.parametrize(
    ("text", "environment", "expected"),
    [
        ("0/4", {}, "--shard: expected I/N"),
        ("5/4", {}, "--shard: expected I/N"),
        ("1", {}, "--shard: expected I/N"),
        ("1/4/2", {}, "--shard: expected I/N"),
        (None, array(MIN="1", MAX="9"), "expected several tasks without gaps"),
        (None, array(ID="9"), "expected several tasks without gaps"),
        (None, array(ID="3", MIN="3", MAX="3", COUNT="1"), "expected several tasks without gaps, got 1 from 3 to 3"),
        (None, array(COUNT=""), "SLURM_ARRAY_TASK_COUNT: expected a whole number"),
    ],
)
def test_no_shard(text, environment, expected, monkeypatch):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match=expected):
        launcher.shard_from(text)


def start(*arguments, **variables):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    command = [sys.executable, "-m", "tuning.command_line", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def finish(*arguments, code=0, **variables):
    process = start(*arguments, **variables)
    out, errors = process.communicate(timeout=600)
    assert process.returncode == code, errors
    return out, errors


@pytest.mark.slow
def test_four_shards_merged_are_the_same_files(tmp_path):
    """One shard dies, is named, and goes on; all that is written is that of one machine, but for the typed command."""
    one, four = tmp_path / "one", tmp_path / "four"
    alone = finish("sweep", *SHORT, *GRID, "--out", one, "--json")[0]
    sweep = ["sweep", *SHORT, *GRID, "--out", four]
    for number in (1, 2):
        finish(*sweep, "--shard", f"{number}/4")
    said = finish(*sweep, **array())[1]
    assert "shard 4/4, this task of a Slurm array" in said
    died = start(*sweep, "--shard", "3/4")
    while not (four / "shard-3-of-4" / "shard.json").exists():
        time.sleep(0.01)
    died.send_signal(signal.SIGKILL)
    died.communicate()
    said = finish("merge", four, code=2)[1]
    assert said.startswith(f"mjx-climb: error: {four}: shard 3/4 lacks 18 of 18 walks (stiffness ")
    remedy = said.partition("to finish it: mjx-climb ")[2].split()
    told = json.loads(finish(*remedy, "--json")[0])
    assert told == {"shard": 3, "of": 4, "walks": 18}
    assert finish("merge", four, "--json")[0] == alone
    for name in ("sweep.nc", "maps.png", "comparison.json", "config.yaml"):
        assert (four / name).read_bytes() == (one / name).read_bytes(), name
    pages = [(folder / "report.html").read_text().splitlines() for folder in (one, four)]
    differ = [lines for lines in zip(*pages, strict=True) if lines[0] != lines[1]]
    assert [line.startswith("<pre>mjx-climb ") for line in sum(differ, ())] == [True, True]


@pytest.mark.slow
@pytest.mark.nightly
def test_judged_in_shards_is_the_same_file(tmp_path):
    """72 members, more than walk in one call; an interrupted shard keeps what it has."""
    gains = tmp_path / "mine.yaml"
    gains.write_text("inertia: 2.0\ndamping: 30.0\nstiffness: 500.0\n")
    one, three = tmp_path / "one", tmp_path / "three"
    judge = ["judge", *SHORT, "--gains", gains, "--members", "72"]
    alone = json.loads(finish(*judge, "--out", one, "--json")[0])
    assert list(alone) == ["mine", "config", "pd"] and 0 < alone["pd"]["mean"]["force_variation"]
    for number in (1, 2, 3):
        finish(*judge, "--out", three, "--shard", f"{number}/3")
    said = finish(*judge, "--out", three, "--shard", "2/3")[1]
    assert "; 24 are there already" in said
    assert json.loads(finish("merge", three, "--json")[0]) == alone
    for name in ("judged.nc", "judged.png", "summary.json", "ensemble.yaml"):
        assert (three / name).read_bytes() == (one / name).read_bytes(), name
    refused = finish("merge", three / "shard-1-of-3", three / "shard-3-of-3", code=2)[1]
    assert "shard 2/3 is not there: it lacks 24 of 24 walks (member 24 to member 47)" in refused
