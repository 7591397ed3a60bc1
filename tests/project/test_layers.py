"""The layers of both packages, as CONTRIBUTING.md draws them and as `make lint` checks them."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("mjx_climb", "tuning")  # in the order of the drawings
DRAWN = re.compile(r"(\w+)(/|\.py)")


def contract(package: str) -> list[list[str]]:
    """The rooms of each layer of the contract, from the top down."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each["name"] == f"rooms of {package}")
    return [[name.removeprefix(f"{package}.") for name in re.split(r" [|:] ", layer)] for layer in layers]


def drawing(package: str) -> list[list[tuple[str, str]]]:
    """The rooms on each line of the drawing, each with what follows its name: "/" or ".py"."""
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8").split("\n## The house\n")[1]
    drawn = re.findall(r"^```text\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)[PACKAGES.index(package)]
    # two blanks end the names
    return [DRAWN.findall(line.split("  ")[0]) for line in drawn.splitlines()]


@pytest.mark.parametrize("package", PACKAGES)
def test_the_drawing_has_the_layers_of_the_contract(package):
    assert [[name for name, _ in layer] for layer in drawing(package)] == contract(package)


@pytest.mark.parametrize("package", PACKAGES)
def test_each_file_and_folder_of_the_package_stands_in_the_drawing(package):
    drawn = {name + kind for layer in drawing(package) for name, kind in layer}
    folders = {f"{file.parent.name}/" for file in (ROOT / package).glob("*/__init__.py")}
    assert drawn == folders | {file.name for file in (ROOT / package).glob("*.py")} - {"__init__.py"}


WALKS = re.compile(r"(\bmc\.(rollout|rollout_metrics|rollout_histories|simulator|Simulation)|\.evaluate)\(")


@pytest.mark.parametrize("room", ["results", "pages", "writing"])
def test_what_tells_of_results_walks_nothing(room):
    """Comparisons are made before a result is written: the rooms that describe and write it get them as data."""
    walking = [file.name for file in (ROOT / "tuning" / room).glob("*.py") if WALKS.search(file.read_text("utf-8"))]
    assert not walking
