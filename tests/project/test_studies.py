"""The scripts of the studies: they have the options that pages name, and run, with the smallest walks and searches."""

import csv
import re
import subprocess
import sys

import pytest

from tests import shell

STUDIES = shell.ROOT / "docs" / "studies"
SCRIPTS = sorted(path for path in STUDIES.glob("*.py") if "ArgumentParser" in path.read_text("utf-8"))
TEXTS = [path.read_text("utf-8") for path in (*STUDIES.glob("*.md"), *STUDIES.glob("*.py"))]
SMALL = ["--seconds", 0.3, "--members", 4, "--unseen", 8]
SEARCH, LAWS = ["--points", 4, "--rounds", 1], ["pd", "PlannedTransfer"]
# by the script's name: its arguments behind the file or folder it writes, and what there has its rows
TINY = {
    "climb": (["--grounds", 2, "--way", 0.02, "--angles", 135, "--densities", 400, "--only", "hubrobo-rock-pd"],
              "climb.csv"),
    "identification": (["--workers", 1, "--inside", 1, "--outside", 0, "--short", 0], ""),
    "what_a_sensor_is_worth": (["--hardware", "dynamixel_x", "--case", "2", "--laws", "pd", "LoadTransfer", "--varied",
                                "--seeds", 2, *SMALL, *SEARCH], "dynamixel_x_2.json"),
}  # fmt: skip


def run(name, *arguments):
    """Run a script to its end; return what it printed."""
    command = [sys.executable, STUDIES / f"{name}.py", *map(str, arguments)]
    how = {"cwd": shell.ROOT, "env": shell.environment(), "timeout": 900}
    done = subprocess.run(command, capture_output=True, text=True, check=False, **how)
    assert done.returncode == 0, done.stderr
    return done.stdout


def options(name):
    """Options of the script in the commands of all pages and scripts."""
    calls = re.findall(rf"{name}\.py ((?:\\\n|\]\n|[^\n`])*)", "\n".join(TEXTS))
    return {option for call in calls for option in re.findall(r"--[a-z][a-z-]*", call)}


def test_pages_name_options_of_most_scripts():
    assert sum(map(bool, (options(path.stem) for path in SCRIPTS))) >= len(SCRIPTS) - 1
    assert {"--varied", "--own-gait", "--nominal", "--worse", "--table"} <= options("what_a_sensor_is_worth")


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in SCRIPTS])
def test_a_script_has_the_options_that_pages_name(name):
    arguments = ["-m", f"docs.studies.{name}"] if name == "climblab_planner" else [str(STUDIES / f"{name}.py")]
    how = {"cwd": shell.ROOT, "env": shell.environment()}
    said = subprocess.run([sys.executable, *arguments, "--help"], capture_output=True, text=True, check=True, **how)
    assert options(name) <= set(re.findall(r"--[a-z][a-z-]*", said.stdout.partition("options:")[2]))


def rows_of(file):
    return list(csv.DictReader(file.read_text("utf-8").splitlines()))


@pytest.mark.nightly
def test_tables_of_laws_are_made_from_searches(tmp_path):
    """Two laws, searched on the case's own walk and walked on worse hardware: all three tables have their rows."""
    laws = ["--hardware", "ideal", "--case", "1_2", "--laws", *LAWS, "--own-gait", "--seeds", 2, "--nominal"]
    run("what_a_sensor_is_worth", tmp_path, *laws, *SMALL, *SEARCH, "--worse", "control_period=0.01")
    for name, count in (("which_law", 1), ("worse_hardware", 1), ("robust_gains", 2)):
        run(name, *[tmp_path] * count, tmp_path / f"{name}.csv")
        made, kept = rows_of(tmp_path / f"{name}.csv"), rows_of(STUDIES / f"{name}.csv")
        assert {"pd, searched", "load transfer by plan"} <= {row["law"] for row in made}
        assert {row["metric"] for row in made} == {row["metric"] for row in kept}


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", TINY)
def test_a_study_runs(tmp_path, name):
    arguments, rows = TINY[name]
    out = tmp_path / ("out" if rows else "out.csv")
    run(name, out, *arguments)
    assert len((out / rows if rows else out).read_text("utf-8")) > 100
