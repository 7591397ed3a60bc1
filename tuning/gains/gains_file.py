"""Gains files: the gains that a search found, as YAML with keys inertia, damping, stiffness and perhaps kp and kd."""

import os
from pathlib import Path

import numpy as np
import yaml

import mjx_climb as mc
from mjx_climb.files.dataset import write_text_atomically
from mjx_climb.scenario.messages import ConfigError, config_error
from mjx_climb.scenario.model import overridden
from mjx_climb.scenario.yaml_text import parse, read

REQUIRED = ("inertia", "damping", "stiffness")  # scalar or six values: translations x, y, z, then rotations
OPTIONAL = ("kp", "kd")


def load(path: str | os.PathLike[str]) -> mc.Gains:
    """Read a gains file.

    Raises:
        ConfigError: in one line, what is wrong with the file or a value.
    """
    source = os.fsdecode(path)
    data = parse(read(source), source)
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: expected a mapping with keys {', '.join(REQUIRED + OPTIONAL)}")
    for key in data:
        if key not in REQUIRED + OPTIONAL:
            raise config_error(source, key, f"only the keys {', '.join(REQUIRED + OPTIONAL)}", "another")
    for key in REQUIRED:
        if key not in data:
            raise config_error(source, key, "a value", "none")
    try:
        control = overridden(mc.Scenario(), {f"control.{key}": value for key, value in data.items()}, source)
    except ConfigError as error:
        raise ConfigError(str(error).replace(f"{source}: control.", f"{source}: ", 1)) from None
    return mc.Gains(**{key: np.asarray(getattr(control.control, key), float) for key in data})


def save(gains: mc.Gains, path: str | os.PathLike[str], comment: str = "") -> Path:
    """Write a gains file, with `comment` on top, and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    values = {key: getattr(gains, key) for key in REQUIRED + OPTIONAL}
    plain = {key: np.asarray(value, float).tolist() for key, value in values.items() if value is not None}
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    return write_text_atomically(path, lines + yaml.safe_dump(plain, sort_keys=False, default_flow_style=None))


def applied(scenario: mc.Scenario, gains: mc.Gains) -> mc.Scenario:
    """Return the scenario with these gains in its control section."""
    values = {key: getattr(gains, key) for key in REQUIRED + OPTIONAL}
    return scenario.with_overrides({f"control.{key}": value for key, value in values.items() if value is not None})
