"""Files that a scenario's file includes or imports, and a digest of them all."""

import ast
import hashlib
import os
from pathlib import Path

from mjx_climb.robot_import.description import bare, files_of
from mjx_climb.scenario.messages import ConfigError


def digest(file: Path) -> str:
    """A digest of a file and of all that it includes or imports.

    Raises:
        ConfigError: a file cannot be read.
    """
    contents = sorted((other.name, content(other)) for other in needed(file))
    return hashlib.sha256(repr(contents).encode()).hexdigest()


def needed(file: Path) -> list[Path]:
    """A file and all that it includes or imports, as absolute paths, without visual parts."""
    file = Path(os.path.abspath(file))
    found = {file}
    if file.suffix.lower() == ".xml":
        taken = [other for other in files_of(file) if other.is_file()]
        try:
            shapes = {Path(mesh.file).name for mesh in bare(str(file)).meshes}
        except ValueError:  # an MJCF that is not read: all may be needed
            shapes = {other.name for other in taken}
        found |= {other for other in taken if other.suffix.lower() == ".xml" or other.name in shapes}
    if file.suffix.lower() == ".py":
        _add_imported(file, file.parent, found)
    return sorted(found)


def _add_imported(file: Path, folder: Path, seen: set[Path]) -> None:
    """Add the modules and packages in a folder that a file of Python imports, and those that they import."""
    try:
        tree = ast.parse(content(file))
    except (SyntaxError, ValueError):  # running it says more
        return
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    for top in sorted({name.partition(".")[0] for name in names} - {""}):
        for other in [folder / f"{top}.py", *sorted((folder / top).rglob("*.py"))]:
            if other.is_file() and other not in seen:
                seen.add(other)
                _add_imported(other, folder, seen)


def content(file: Path) -> bytes:
    """Return the bytes of a file; ConfigError where it cannot be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(file, "", "a readable file", (error.strerror or str(error)).lower()) from None
