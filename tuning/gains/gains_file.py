"""Gains files: the gains that a search found, as YAML with keys inertia, damping, stiffness and perhaps kp and kd.

Those of a law of one's own are named as the law names them, and `law` says whose they are.
"""

import os
from pathlib import Path
from typing import Any, overload

import numpy as np

import mjx_climb as mc
from mjx_climb.control import is_shipped
from mjx_climb.files.dataset import write_text_atomically
from mjx_climb.rollouts.resolve import AnyGains, checked_gains, with_gains
from mjx_climb.rollouts.resolve import by_name as by_name
from mjx_climb.scenario.messages import ConfigError, config_error
from mjx_climb.scenario.model import overridden
from mjx_climb.scenario.yaml_text import parse, read
from tuning.gains import own_section
from tuning.gains.ros2_control import commented

REQUIRED = ("inertia", "damping", "stiffness")  # scalar or six values: translations x, y, z, then rotations
OPTIONAL = ("kp", "kd")
LAW = "law"  # FILE.py:NAME of the law whose gains they are, NAME of a shipped one, none where it is the config's


def shipped_law(path: str | os.PathLike[str]) -> str | None:
    """Return the name of the shipped law that a gains file is of, None where it says no such law."""
    source = os.fsdecode(path)
    data = parse(read(source), source)
    name = data.get(LAW) if isinstance(data, dict) else None
    return name if isinstance(name, str) and is_shipped(name) else None


@overload
def load(path: str | os.PathLike[str], law: None = None) -> mc.Gains: ...


@overload
def load(path: str | os.PathLike[str], law: mc.Law) -> dict[str, Any]: ...


@overload
def load(path: str | os.PathLike[str], law: mc.Law | None) -> mc.Gains | dict[str, Any]: ...


def load(path: str | os.PathLike[str], law: mc.Law | None = None) -> mc.Gains | dict[str, Any]:
    """Read a gains file; `law` is the one whose gains are wanted, where it is not one of the program's.

    Raises:
        ConfigError: in one line, what is wrong with the file or a value, or the gains are those of another law.
    """
    source = os.fsdecode(path)
    data = parse(read(source), source)
    required = REQUIRED if law is None else tuple(law.GAINS)
    keys = (*required, *OPTIONAL)
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: expected a mapping with keys {', '.join(keys)}")
    own_section.check_reference(law, data.pop(LAW, None), source)
    for key in (*data, *required):
        if key not in keys:
            raise config_error(source, key, f"only the keys {', '.join(keys)}", "another")
        if key not in data:
            raise config_error(source, key, "a value", "none")
    # what the scenario has too is checked as there
    joint = data if law is None else {key: value for key, value in data.items() if key in OPTIONAL}
    try:
        control = overridden(mc.Scenario(), {f"control.{key}": value for key, value in joint.items()}, source).control
    except ConfigError as error:
        raise ConfigError(str(error).replace(f"{source}: control.", f"{source}: ", 1)) from None
    values = {key: np.asarray(getattr(control, key), float) for key in joint}
    if law is None:
        return mc.Gains(**values)
    try:
        changed = checked_gains(law, {key: np.asarray(data[key], float) for key in law.GAINS})
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{source}: {str(error).removeprefix('gains.')}") from None
    return values | {key: getattr(changed, key) for key in law.GAINS}


def save(gains: AnyGains, path: str | os.PathLike[str], comment: str = "", law: mc.Law | None = None) -> Path:
    """Write a gains file, with `comment` on top, and return its path; `law` is the one that they belong to.

    Raises:
        OutputError: the file cannot be written.
    """
    return write_text_atomically(path, text(gains, comment, law))


def text(gains: AnyGains, comment: str = "", law: mc.Law | None = None) -> str:
    """Return what `save` writes."""
    plain: dict[str, Any] = {} if law is None else {LAW: own_section.reference(law)}
    plain |= {key: np.asarray(value, float).tolist() for key, value in by_name(gains).items()}
    return commented(comment, plain)


def applied(scenario: mc.Scenario, gains: AnyGains) -> mc.Scenario:
    """Return the scenario with these gains in its control section, as far as it has them."""
    values = {name: value for name, value in by_name(gains).items() if name in REQUIRED + OPTIONAL}
    return scenario.with_overrides({f"control.{key}": value for key, value in values.items()})


def replaced(scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains) -> tuple[mc.Scenario, mc.Law | None]:
    """Return a scenario and a law of one's own (None: the scenario's) with some gains in place of theirs."""
    values = by_name(gains)
    if law is None:
        return applied(scenario, values), None
    return applied(scenario, {n: v for n, v in values.items() if n not in law.GAINS}), with_gains(law, values)
