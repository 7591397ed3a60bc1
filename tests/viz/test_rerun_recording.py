"""A walk for Rerun's viewer, where rerun-sdk is installed; refused in a line where it is not."""

import importlib
import subprocess
import sys

import pytest

import mjx_climb as mc
from mjx_climb.viz import rerun_recording
from tests.shell import ROOT
from tuning.command_line import main


def test_without_the_package_the_command_says_so_before_it_walks(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.setattr(mc, "rollout", None)
    with pytest.raises(SystemExit) as ended:
        main(["run", "case_1_2", "--rerun", "--out", str(tmp_path / "out")])
    out, err = capsys.readouterr()
    expected = "--rerun: expected rerun-sdk to be installed, as by pip install 'mjx-climb[view]'"
    assert (ended.value.code, out, err) == (2, "", f"mjx-climb: error: {expected}\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_robot_ground_and_forces_are_recorded_in_the_frames_of_the_mcap_file(tmp_path):
    rerun = pytest.importorskip("rerun")
    walk = mc.rollout(mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3"]))
    file = rerun_recording.save_rrd(walk, tmp_path / "walk.rrd")
    program = importlib.import_module("rerun_cli").__file__.replace("__init__.py", "rerun")
    done = subprocess.run([program, "rrd", "print", file], capture_output=True, text=True, check=True)
    chunks = [line for line in done.stdout.splitlines() if line.startswith("Chunk")]
    moving = {line.split(" - ")[1] for line in chunks if "with 30 rows" in line}
    assert rerun and {f"/world/force/{limb}" for limb in walk.limbs} | {"/world/push", "/support/LF"} <= moving
    assert sum(name.startswith("/world/robot/") for name in moving) >= 13  # a base and three links of four limbs
    assert any("/world/ground/" in line and "Mesh3D" in line for line in chunks)
