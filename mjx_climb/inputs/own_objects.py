"""Objects of the user's: FILE.py:NAME, and the components that the section `own` names."""

import contextlib
import dataclasses
import importlib.machinery
import importlib.util
import os
import sys
import types
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb import disturbances, hardware
from mjx_climb.component import Component, with_values
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.gait import footholds
from mjx_climb.gait.footholds.footholds import Footholds
from mjx_climb.hardware.actuator import Actuator
from mjx_climb.inputs.file_contents import digest
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics import contact
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import OwnComponent, OwnObject, Scenario

# the modules run last, as `sys.modules` without their names, and the digests of their files: gains files say from which
# file an object came, and a copy of a file gives the same class, which is compiled once
RUN: deque[tuple[types.ModuleType, str]] = deque(maxlen=64)
# by the place in the section
KINDS: dict[str, tuple[type[Component], Mapping[str, type[Component]]]] = {
    "contact": (Contact, contact.SHIPPED),
    "drive": (Actuator, hardware.SHIPPED),
    "disturbances": (Disturbance, disturbances.SHIPPED),
    "footholds": (Footholds, footholds.SHIPPED),
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
        raise ConfigError(f"{what}: {type(error).__name__}: {reason}") from error


def load(text: str, what: str) -> tuple[Any, str, str]:
    """Return the object that FILE.py:NAME names, and both names; the file is run.

    Raises:
        ConfigError: in one line, no such file or name, or a file that fails; `what` was wanted, as "law".
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name):
        raise ConfigError(f"{what}: expected FILE.py:NAME, got {text!r}")
    path = Path(file)
    if not os.path.isfile(path):  # where it may not be read either
        raise ConfigError(f"{path}: expected a file of Python, got none")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or not isinstance(spec.loader, importlib.machinery.SourceFileLoader):
        raise ConfigError(f"{path}: expected a file of Python, whose name ends in .py")
    module, of_files = importlib.util.module_from_spec(spec), digest(path)
    sys.path.insert(0, str(path.absolute().parent))  # for what the file itself imports, as python FILE does
    try:
        # not `exec_module`, whose bytecode of a file that was changed within a second is the old one's
        with in_one_line(str(path)):
            exec(spec.loader.source_to_code(path.read_bytes(), path), module.__dict__)
    finally:
        sys.path.pop(0)
    RUN.append((module, of_files))
    if (found := getattr(module, name, None)) is None:
        raise ConfigError(f"{file}: expected a {what} named {name}, got none")
    return found, file, name


def reference_to(named: OwnObject, key: str, source: str) -> str:
    """Return FILE.py:NAME of an object whose file is as it was.

    Raises:
        ConfigError: in one line, it has no file, or another than when its digest was made.
    """
    if named.file is None:
        got = f"got none, as {named.name} was defined in a session"
        raise ConfigError(f"{source}: own.{key}.file: expected a file of Python, {got}")
    if named.digest not in (None, found := digest(Path(named.file))):
        expected = f"expected {named.file} as it was, {str(named.digest)[:12]}"
        raise ConfigError(f"{source}: own.{key}.digest: {expected}, got {found[:12]}")
    return f"{named.file}:{named.name}"


def key_of(scenario: Scenario, path: str) -> str:
    """Return the key of a config that has the value at a path of the parameters."""
    place, _, name = path.rpartition(".")
    places = {"contact": "contact", "hardware.servo": "drive", "gait.footholds": "footholds"}
    own = places.get(place, place.replace("disturbance.others", "disturbances"))
    there = scenario.own is not None and own in scenario.own.components
    return f"own.{own}.values.{name}" if there else path


def components_of(scenario: Scenario, numbers: Parameters, source: str = "scenario") -> dict[str, Any]:
    """Return contact, drive and disturbances that a scenario names, as fields of `Parameters`; files are run.

    Arguments:
        numbers: parameters of the scenario: a component takes the keys of its section that it has too.

    Raises:
        ConfigError: in one line, a file that is gone or has changed, no such thing in it, or values that it has not.
    """
    if scenario.own is None:
        return {}
    made = {place: _made(each, place, numbers, source) for place, each in scenario.own.components.items()}
    return {
        "contact": made.get("contact"),
        "drive": made.get("drive"),
        "disturbances": tuple(each for place, each in made.items() if place.startswith("disturbances")),
        "footholds": made.get("footholds"),
    }


def _made(named: OwnComponent, place: str, numbers: Parameters, source: str) -> Component:
    section = place.partition(".")[0]
    kind, known = KINDS[section]
    what = section if section == "footholds" else section.removesuffix("s")
    if named.file is None and named.name in known:
        found: Any = known[named.name]
    else:
        text = reference_to(named, place, source)
        of_files = digest(Path(str(named.file)))
        same = (vars(module) for module, of_run in RUN if of_run == of_files)
        found = next((names[named.name] for names in same if named.name in names), None)
        found = load(text, what)[0] if found is None else found
    values, options = (dict(part.items()) for part in (named.values, named.options))
    try:
        if not issubclass(found if isinstance(found, type) else type(found), kind):
            raise ValueError(f"expected a {what} that inherits from mjx_climb.{kind.__name__}, got {found!r}")
        return _with(found, values, options, getattr(numbers, section, None) if section != "disturbances" else None)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{source}: own.{place}: {str(error).splitlines()[0]}") from None


def _with(found: Any, values: dict[str, Any], options: dict[str, Any], instead: Component | None) -> Component:
    """Return an instance with some values and options; TypeError, ValueError: it has none of these names or shapes."""
    made: type[Component] = found if isinstance(found, type) else type(found)
    fields = {field.name: field for field in dataclasses.fields(made)}  # type: ignore[arg-type]  # of every component
    others = [name for name, field in fields.items() if name not in made.VALUES and "tree" not in field.metadata]
    for given, section, names in ((values, "values", list(made.VALUES)), (options, "options", others)):
        if unknown := [name for name in given if name not in names]:
            raise ValueError(f"{section}.{unknown[0]}: expected one of {', '.join(names) or 'none'}")
    for name, value in options.items():
        if (before := fields[name].default) is not dataclasses.MISSING and type(value) is not type(before):
            raise ValueError(f"options.{name}: expected one like {before!r}, got {value!r}")
    arrays = {name: np.asarray(value, float) for name, value in values.items()}
    if isinstance(found, type):
        # the keys of the section that the component has too
        there = [name for name in made.VALUES if instead is not None and name in instead.VALUES]
        arrays = {name: np.asarray(getattr(instead, name)) for name in there} | arrays
        if lacking := [
            name for name in made.VALUES if name not in arrays and fields[name].default is dataclasses.MISSING
        ]:
            raise ValueError(f"values.{lacking[0]}: expected a value, got none")
        component: Component = found(**arrays, **options)
    else:
        component = dataclasses.replace(found, **arrays, **options)
    component = with_values(component, {}, name="values")
    for name, field in made.VALUES.items():
        if np.ndim(getattr(component, name)) > len(field.shape):
            raise ValueError(
                f"values.{name}: expected that of one robot, got shape {np.shape(getattr(component, name))}"
            )
    return component
