"""SIGKILL at any moment of a comparison of laws: the same command goes on to the result of an undisturbed one."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tests.shell import ROOT

SEED, KILLS = 35, 6
SEARCH = ["--starts", "4", "--iterations", "2", "--seeds", "2", "--ensemble", "ensemble", "--members", "2"]
LAWS = ["--law", "base_admittance", "--law", "end_effector_admittance", "--test-members", "4"]


def listed(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.nightly
def test_a_comparison_that_is_killed_again_and_again_ends_as_an_undisturbed_one(tmp_path):
    """While it searches, walks the unseen members, compares and writes: at seeded moments of its time."""
    config = tmp_path / "short.yaml"
    config.write_text(mc.load_scenario("case_1_2", {"duration": 0.3}).to_yaml())
    environment = dict(os.environ, PYTHONPATH=str(ROOT), MJX_CLIMB_CACHE=str(tmp_path / "cache"))

    def begun(folder):
        command = [sys.executable, "-m", "tuning.command_line", "tune", config, *LAWS, *SEARCH, "--out", folder]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment, text=True)

    def ended(folder):
        since, process = time.monotonic(), begun(folder)
        _, errors = process.communicate(timeout=900)
        assert process.returncode == 0, errors
        return time.monotonic() - since

    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    ended(tmp_path / "warm")  # which compiles
    seconds = ended(undisturbed)
    whole = listed(undisturbed)
    for share in np.random.default_rng(SEED).uniform(0.1, 1.0, KILLS):
        with begun(killed) as process:
            time.sleep(share * seconds)
            process.kill()
            process.stderr.read()
        record = killed / "settings.json"
        there = listed(killed) if killed.exists() else set()
        if record.exists() and json.loads(record.read_text())["whole"]:
            assert {name for name in there if not name.startswith((".", "parts/"))} == whole
        else:  # no half of a result
            assert {name for name in there if "part" not in name} <= {"settings.json"}
    ended(killed)
    assert listed(killed) == whole and not list(tmp_path.glob("**/.*.part"))
    first, second = (xr.load_dataset(folder / "compared.nc") for folder in (undisturbed, killed))
    xr.testing.assert_equal(first, second)
    for name in whole:
        if name.endswith((".csv", "summary.json")) or name.startswith("gains-"):
            assert (undisturbed / name).read_bytes() == (killed / name).read_bytes(), name
