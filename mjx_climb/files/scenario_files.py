"""The files that a scenario names, a user's robot, height map and code, kept beside its results.

A results folder holds copies in `inputs/`, and its config.yaml names them relative to itself: a repetition needs no
other place.
"""

import ast
import hashlib
import os
from pathlib import Path

from mjx_climb.files.dataset import write_bytes_atomically
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.description import bare
from mjx_climb.scenario.messages import ConfigError
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
        place = key.removeprefix("own.").removesuffix(".file").removesuffix(".map")
        target, needed = Path(folder).absolute() / FOLDER / place, _needed(Path(file))
        root = Path(os.path.commonpath([other.parent for other in needed]))
        for source in needed:
            if source != target / source.relative_to(root):  # the same where a results folder is repeated in place
                write_bytes_atomically(target / source.relative_to(root), _content(source))
        return str(target / Path(os.path.abspath(file)).relative_to(root))

    return scenario.with_files(copy)


def portable_yaml(scenario: Scenario, folder: str | os.PathLike[str]) -> str:
    """Return the scenario as YAML for a file in `folder`: what it names inside the folder is relative to it."""
    return scenario.relative_to(folder).to_yaml()


def identity(scenario: Scenario) -> str:
    """Return the scenario as YAML with the contents of its files, as a digest, in place of their paths.

    Raises:
        ConfigError: a file cannot be read.
    """
    return scenario.with_files(lambda _, file: digest(Path(file))).to_yaml()


def digest(file: Path) -> str:
    """Return a digest of a file and of what it takes in.

    Raises:
        ConfigError: a file cannot be read.
    """
    contents = sorted((other.name, _content(other)) for other in _needed(file))
    return hashlib.sha256(repr(contents).encode()).hexdigest()


def _needed(file: Path) -> list[Path]:
    """Return a file and what it takes in, as absolute paths, without what are only looks."""
    needed = {file}
    if file.suffix.lower() == ".xml":
        taken = [Path(other) for other in mujoco.mju_getXMLDependencies(str(file))]
        try:
            shapes = {Path(mesh.file).name for mesh in bare(str(file)).meshes}
        except ValueError:  # an MJCF that is not read: all may be needed
            shapes = {other.name for other in taken}
        needed |= {other for other in taken if other.suffix.lower() == ".xml" or other.name in shapes}
    if file.suffix.lower() == ".py":
        _add_imported(file, file.parent, needed)
    return sorted({Path(os.path.abspath(file.parent / other)) for other in needed})


def _add_imported(file: Path, folder: Path, seen: set[Path]) -> None:
    """Add the modules and packages in a folder that a file of Python imports, and those that they import."""
    try:
        tree = ast.parse(_content(file))
    except (SyntaxError, ValueError):  # running it says more
        return
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    for top in sorted({name.partition(".")[0] for name in names} - {""}):
        for other in [folder / f"{top}.py", *sorted((folder / top).rglob("*.py"))]:
            if other.is_file() and other not in seen:
                seen.add(other)
                _add_imported(other, folder, seen)


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: expected a readable file, got {(error.strerror or str(error)).lower()}") from None
