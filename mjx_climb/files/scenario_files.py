"""The files that a scenario names, a user's robot, height map and code, kept beside its results.

A results folder holds copies in `inputs/`, and its config.yaml names them relative to itself: a repetition needs no
other place.
"""

import ast
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from mjx_climb.files.dataset import write_bytes_atomically
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import bare
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
    return scenario.with_files(lambda key, file: _copy(Path(file), Path(folder).absolute() / FOLDER / _place(key)))


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


def _place(key: str) -> str:
    """Return the folder of a copy by the key that names its file: robot, ground, law, metrics.0."""
    return key.removeprefix("own.").removesuffix(".file").removesuffix(".map")


def _needed(file: Path) -> list[Path]:
    """Return a file and what it takes in, as absolute paths, without what are only looks."""
    needed = [file]
    if file.suffix.lower() == ".xml":
        needed += filter(_weighs(file), map(Path, mujoco.mju_getXMLDependencies(str(file))))
    if file.suffix.lower() == ".py":
        needed += _imported(file, file.parent, set())
    return sorted({Path(os.path.abspath(file.parent / other)) for other in needed})


def _weighs(file: Path) -> Callable[[Path], bool]:
    """Return what tells whether the dynamics need a file that an MJCF takes in: all, of an MJCF that is not read."""
    try:
        shapes = {Path(mesh.file).name for mesh in bare(str(file)).meshes}
    except ValueError:
        return lambda other: True
    return lambda other: other.suffix.lower() == ".xml" or other.name in shapes


def _imported(file: Path, folder: Path, seen: set[Path]) -> set[Path]:
    """Return the modules and packages in a folder that a file of Python imports, and those that they import."""
    try:
        tree = ast.parse(_content(file))
    except (SyntaxError, ValueError):  # running it says more
        return seen
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    for top in sorted({name.partition(".")[0] for name in names} - {""}):
        for other in [folder / f"{top}.py", *sorted((folder / top).rglob("*.py"))]:
            if other.is_file() and other not in seen:
                seen.add(other)
                _imported(other, folder, seen)
    return seen


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: expected a readable file, got {(error.strerror or str(error)).lower()}") from None


def _copy(file: Path, target: Path) -> str:
    """Copy a file, and what it takes in, into a folder and return the path of its copy."""
    needed = _needed(file)
    root = Path(os.path.commonpath([other.parent for other in needed]))
    for source in needed:
        copy = target / source.relative_to(root)
        if copy != source:  # the same where a results folder is repeated in place
            write_bytes_atomically(copy, _content(source))
    return str(target / Path(os.path.abspath(file)).relative_to(root))
