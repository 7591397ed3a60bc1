"""A component, a law, a command, a method are one file each, a kind of result two: nothing else names them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mjx_climb.inputs.own_objects import SEAMS, class_of
from mjx_climb.scenario.kinds import ROOMS, shipped_kinds
from mjx_climb.scenario.model import Kind

ROOT = Path(__file__).parents[2]
FILES = {
    "mjx_climb/disturbances/gust.py": '''"""A gust."""

from jax import Array

from mjx_climb.component import parameter
from mjx_climb.disturbances.disturbance import Body, Disturbance, External


class Gust(Disturbance):
    """Nothing yet."""

    KIND = "gust"

    strength: Array = parameter("N", bounds=(0.0, 10.0), default=1.0)

    def act(self, time: Array, body: Body) -> External:
        return body.untouched()
''',
    "mjx_climb/control/still.py": '''"""A law."""

from mjx_climb.control.law import PD


class Still(PD):
    """Nothing yet."""
''',
    "tuning/command_line/greet.py": '''"""A command."""

import typer

from tuning.command_line.from_models import command
from tuning.problem.settings import Options, setting


class Whom(Options):
    """Whom it greets."""

    name: str = setting("you", "name", metavar="NAME")


@command("Is anybody there?")
def greet(asked: Whom) -> None:
    """Greet."""
    typer.echo(f"hello {asked.name}")
''',
    "tuning/results/told.py": '''"""A kind of result."""

from tuning.results.result import Result


class Told(Result):
    """Nothing yet."""

    FILE = "told.nc"
    KIND = "tell"
''',
    "tuning/pages/told.py": '''"""Its folder."""

from tuning.pages.contents import Contents, Written, files_of
from tuning.results.told import Told


def compare(found: Told, *_: object) -> str:
    return "of it"


def contents(found: Told, compared: str, name: str) -> Contents:
    return Contents(Written(), found.problem, files_of(found, name) | {"told.txt": compared})
''',
    "tuning/methods/lucky.py": '''"""A method."""

from tuning.methods.method import Method


class Lucky(Method):
    def run(self, task):
        yield


METHOD = Lucky()
''',
}
SEEN = """
import runpy
import xarray as xr
import tuning
from mjx_climb import load_scenario, paths
from mjx_climb.control import shipped
from mjx_climb.scenario.model import Scenario
from tuning.command_line.program import COMMANDS, run
from tuning.gains.own_section import taken
from tuning.methods import method_of
from tuning.problem.evaluation import Problem
from tuning.results.result import RESULTS
from tuning.results.told import Told
scenario = load_scenario("case_1_1", {"disturbance.others": [{"kind": "gust", "strength": 3.0}]})
assert paths(scenario)["disturbance.others.0.strength"]["value"] == 3.0
assert "gust" in Scenario.model_json_schema()["$defs"]["Disturbance"]["properties"]["others"]["description"]
assert "disturbances.gust.Gust" in runpy.run_path("keys.py")["on_page_markdown"](
    "<!-- the shipped kinds of disturbance.others -->"
)
named = load_scenario("case_1_1", {"own.law": {"name": "Still"}})
assert type(taken(named)[1]).__name__ == "Still" and type(shipped("Still+Recovering")).__name__ == "Still+Recovering"
assert type(method_of("lucky")).__name__ == "Lucky"
written = tuning.write(Told(xr.Dataset(), Problem(scenario)), "out").files.split(", ")
assert {"told.txt", "told.nc"} <= set(written) and "told.nc" in RESULTS
assert COMMANDS["greet"] == "Is anybody there?" and run(["greet", "--name", "me"]) == 0
"""


@pytest.mark.slow
def test_what_is_added_is_named_in_its_own_file_alone(tmp_path):
    for package in ("mjx_climb", "tuning", "configs"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "docs" / "hooks" / "keys.py", tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", SEEN], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", "hello me\n")


@pytest.mark.parametrize("place", ROOMS)
def test_each_shipped_kind_is_of_its_seam(place):
    kinds = {kind: class_of(Kind(kind=kind), place) for kind in shipped_kinds(place)}
    assert kinds and all(issubclass(made, SEAMS[place][0]) and made.KIND == kind for kind, made in kinds.items())
