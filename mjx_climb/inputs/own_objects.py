"""Objects of the user's, FILE.py:NAME, and the components that sections of a scenario name by their kinds."""

import contextlib
import dataclasses
import importlib
import importlib.machinery
import importlib.util
import inspect
import os
import sys
import types
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.component import Component, with_values
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.gait.footholds.footholds import Footholds
from mjx_climb.hardware.actuator import Actuator
from mjx_climb.inputs.file_contents import digest
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.scenario.kinds import shipped_kinds
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Kind, OwnObject, validated
from mjx_climb.scenario.values import section_of

# the modules run last, as `sys.modules` without their names, and the digests of their files: gains files say from which
# file an object came, and a copy of a file gives the same class, which is compiled once
RUN: deque[tuple[types.ModuleType, str]] = deque(maxlen=64)
# by the section of a scenario: the base class, and its word
SEAMS: dict[str, tuple[type[Component], str]] = {
    "contact": (Contact, "contact"),
    "hardware.servo": (Actuator, "drive"),
    "disturbance.others": (Disturbance, "disturbance"),
    "gait.footholds": (Footholds, "footholds"),
}


@contextlib.contextmanager
def in_one_line(what: str) -> Iterator[None]:
    """Raise ConfigError in one line where code of the user's fails, or would end the program."""
    try:
        yield
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise ConfigError(what, reason=f"{type(error).__name__}: {reason}") from error


def load(text: str, what: str) -> tuple[Any, str, str]:
    """Return the object that FILE.py:NAME names, and both names; the file is run.

    Raises:
        ConfigError: in one line, no such file or name, or a file that fails; `what`: the wanted kind, as "law".
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name):
        raise ConfigError("", what, "FILE.py:NAME", f"{text!r}")
    path = Path(file)
    if not os.path.isfile(path):  # where it may not be read either
        raise ConfigError(path, "", "a file of Python", "none")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or not isinstance(spec.loader, importlib.machinery.SourceFileLoader):
        raise ConfigError(path, "", "a file of Python, whose name ends in .py")
    module, of_files = importlib.util.module_from_spec(spec), digest(path)
    sys.path.insert(0, str(path.absolute().parent))  # for the file's own imports, as python FILE does
    try:
        # not `exec_module`, whose bytecode of a file that was changed within a second is the old one's
        with in_one_line(str(path)):
            exec(spec.loader.source_to_code(path.read_bytes(), path), module.__dict__)
    finally:
        sys.path.pop(0)
    RUN.append((module, of_files))
    if (found := getattr(module, name, None)) is None:
        raise ConfigError(file, "", f"a {what} named {name}", "none")
    return found, file, name


def reference_to(named: OwnObject | Kind, key: str, source: str) -> str:
    """Return FILE.py:NAME of an object whose file is as it was.

    Raises:
        ConfigError: in one line, it has no file, or another than when its digest was made.
    """
    if named.file is None:
        got = f"got none, as {named.name} was defined in a session"
        raise ConfigError(source, f"{key}.file", f"a file of Python, {got}")
    if named.digest not in (None, found := digest(Path(named.file))):
        raise ConfigError(source, f"{key}.digest", f"{named.file} as it was, {str(named.digest)[:12]}", found[:12])
    return f"{named.file}:{named.name}"


def component_of(section: Kind, place: str, source: str = "scenario") -> Any:
    """Return the component that a section of a scenario names, with its values and options; its file is run.

    Raises:
        ConfigError: in one line, a file that is gone or has changed, no such thing in it, a class that lacks methods,
            or keys and values that it does not take.
    """
    base, word = SEAMS[_seam(place)]
    found = class_of(section, place, source)
    if not issubclass(found if isinstance(found, type) else type(found), base):
        expected = f"a {word} that inherits from mjx_climb.{base.__name__}"
        raise ConfigError(source, place, expected, f"{found!r}")
    if inspect.isabstract(found):
        lacking = ", ".join(sorted(found.__abstractmethods__))
        expected = f"{section.name} to have every method of mjx_climb.{base.__name__}"
        raise ConfigError(section.file or source, "", expected, f"none named {lacking}")
    return _with(found, dict(section.items()), place, source)


def class_of(section: Kind, place: str, source: str = "scenario") -> Any:
    """Return the class, or the instance, that a section of a scenario names; errors as of `component_of`."""
    if section.file is None:
        module = importlib.import_module(shipped_kinds(_seam(place))[section.name])
        return next(each for each in vars(module).values() if getattr(each, "__dict__", {}).get("KIND") == section.name)
    text = reference_to(section, place, source)
    of_files = digest(Path(section.file))
    same = (vars(module) for module, of_run in RUN if of_run == of_files)
    found = next((names[section.name] for names in same if section.name in names), None)
    return load(text, SEAMS[_seam(place)][1])[0] if found is None else found


def _seam(place: str) -> str:
    """Return the seam to which a section belongs."""
    return "disturbance.others" if place.startswith("disturbance.") else place


def _with(found: Any, given: Mapping[str, Any], place: str, source: str) -> Component:
    """Return an instance with some values and options; ConfigError: it has none of these names, types or shapes."""
    made: type[Component] = found if isinstance(found, type) else type(found)
    lacking = [name for name in made.VALUES if isinstance(found, type) and not _has_default(made, name)]
    try:
        section = validated(section_of(made, lacking), given, source)
    except ConfigError as error:
        raise error.moved(key=f"{place}.{error.key}") from None
    changed = section.model_dump(exclude_unset=True)
    try:
        changed |= {name: _array(changed[name]).astype(float) for name in made.VALUES if name in changed}
        component: Component = found(**changed) if isinstance(found, type) else dataclasses.replace(found, **changed)
    except (TypeError, ValueError) as error:  # of its own checks
        raise ConfigError(source, place, reason=str(error).partition("\n")[0] or type(error).__name__) from None
    try:
        component = with_values(component, {}, name=place)
    except ValueError as error:
        raise ConfigError(source, reason=str(error)) from None
    for name, field in made.VALUES.items():
        if np.ndim(getattr(component, name)) > len(field.shape):
            shape = np.shape(getattr(component, name))
            raise ConfigError(source, f"{place}.{name}", "the value of one robot", f"shape {shape}")
    return component


def _has_default(made: type[Component], name: str) -> bool:
    """Tell whether a field of a component has a default."""
    (field,) = (field for field in dataclasses.fields(made) if field.name == name)  # type: ignore[arg-type]
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _array(value: Any) -> np.ndarray:
    """Return the value of a key as an array; null is infinite."""
    return np.array(
        [_array(each) for each in value] if isinstance(value, tuple) else np.inf if value is None else value
    )
