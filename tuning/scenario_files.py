"""The files that a scenario names, a user's robot, height map and code, kept beside its results.

A results folder holds copies in `inputs/`, and its config.yaml names them relative to itself: a repetition needs no
other place.
"""

import os
from pathlib import Path
from typing import Any

from mjx_climb.files.dataset import write_bytes_atomically
from mjx_climb.inputs.file_contents import content, digest, needed
from mjx_climb.scenario.model import Scenario

FOLDER = "inputs"


def copied(scenario: Scenario, folder: str | os.PathLike[str]) -> Scenario:
    """Copy the files that a scenario names into `folder`/inputs and return the scenario that names the copies.

    An MJCF takes the files that it includes along, and the meshes that weigh something, in the same places beside it; a
    file of Python the modules beside it that it imports.

    Raises:
        ConfigError: a file cannot be read.
        OutputError: a copy cannot be written.
    """

    def copy(key: str, file: str) -> str:
        # a folder by the key: robot, ground, law, metrics.0
        place = key.removeprefix("own.").removesuffix(".file").removesuffix(".map").removesuffix(".kind")
        target, sources = Path(folder).absolute() / FOLDER / place, needed(Path(file))
        root = Path(os.path.commonpath([other.parent for other in sources]))
        for source in sources:
            if source != target / source.relative_to(root):  # the same where a results folder is repeated in place
                write_bytes_atomically(target / source.relative_to(root), content(source))
        return str(target / Path(os.path.abspath(file)).relative_to(root))

    return scenario.with_files(copy)


def portable_yaml(scenario: Scenario, folder: str | os.PathLike[str]) -> str:
    """Return the scenario as YAML for a file in `folder`: files inside the folder are relative to it."""
    return scenario.relative_to(folder).to_yaml()


def identity(scenario: Scenario) -> dict[str, Any]:
    """Return the scenario as plain values with the contents of its files, as a digest, in place of their paths.

    Raises:
        ConfigError: a file cannot be read.
    """
    return scenario.with_files(lambda _, file: digest(Path(file))).plain()
