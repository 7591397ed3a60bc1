"""The shipped kinds of components, by the names that their classes give themselves as `KIND`, and the engines.

The files of their rooms are read as text, since a config is checked before JAX is imported.
"""

import functools
import re
from pathlib import Path
from typing import Any, Literal

Controller = Literal["pd", "base_admittance", "end_effector_admittance"]  # the paper's laws
_PACKAGE = Path(__file__).parents[1]
ENGINE_FILE = "_engine"  # the end of the name of an engine's file
# engines of the equations of motion
ENGINES = tuple(sorted(f.stem.removesuffix(ENGINE_FILE) for f in (_PACKAGE / "physics").glob(f"*{ENGINE_FILE}.py")))
DEFAULT_ENGINE = "limb"
ROOMS = {  # of the package, by the sections of a scenario
    "contact": "physics.contact",
    "hardware.servo": "hardware",
    "disturbance.others": "disturbances",
    "gait.footholds": "gait.footholds",
}


def named_in(folder: Path, pattern: str) -> dict[Any, str]:
    """Return the files of a folder by the names in them, the group (groups: a tuple) of a pattern of whole lines."""
    files = {file.stem: file.read_text("utf-8") for file in sorted(folder.glob("*.py"))}
    return {name: stem for stem, text in files.items() for name in re.findall(pattern, text, re.MULTILINE)}


@functools.cache
def shipped_kinds(place: str) -> dict[str, str]:
    """Return the modules of the shipped kinds that a section may name, by their names."""
    found = named_in(_PACKAGE / ROOMS[place].replace(".", "/"), r'^    KIND = "(\w+)"$')
    return {name: f"{_PACKAGE.name}.{ROOMS[place]}.{stem}" for name, stem in found.items()}
