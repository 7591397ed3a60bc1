"""The layers of mjx_climb, as CONTRIBUTING.md draws them and as `make lint` checks them."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "mjx_climb"
DRAWN = re.compile(r"(\w+)(/|\.py)")


def contract() -> list[list[str]]:
    """The rooms of each layer of the contract, from the top down."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each["type"] == "layers")
    return [[name.removeprefix("mjx_climb.") for name in re.split(r" [|:] ", layer)] for layer in layers]


def drawing() -> list[list[tuple[str, str]]]:
    """The rooms on each line of the drawing, each with what follows its name: "/" or ".py"."""
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8").split("\n## The house\n")[1]
    lines = re.search(r"^```text\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)[1].splitlines()
    # two blanks end the names
    return [DRAWN.findall(line.split("  ")[0]) for line in lines]


def test_the_drawing_has_the_layers_of_the_contract():
    assert [[name for name, _ in layer] for layer in drawing()] == contract()


def test_each_file_and_folder_of_the_package_stands_in_the_drawing():
    drawn = {name + kind for layer in drawing() for name, kind in layer}
    folders = {f"{file.parent.name}/" for file in PACKAGE.glob("*/__init__.py")}
    assert drawn == folders | {file.name for file in PACKAGE.glob("*.py")} - {"__init__.py"}
