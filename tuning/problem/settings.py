"""Settings in YAML: read, validated, and refused in one line."""

import os
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from mjx_climb.scenario import yaml_text
from mjx_climb.scenario.messages import ConfigError

Settings = TypeVar("Settings", bound=BaseModel)


def validated(kind: type[Settings], values: dict[str, Any], source: str) -> Settings:
    """Return settings of a kind.

    Raises:
        ConfigError: in one line, source, key and what is wrong.
    """
    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        reason = message[:1].lower() + message[1:]
        raise ConfigError(f"{source}: {key + ': ' if key else ''}{reason}") from None


def mapping(text: str, source: str) -> dict[str, Any]:
    """Return the mapping that a YAML text holds, empty where the text is.

    Raises:
        ConfigError: no YAML, or no mapping.
    """
    data = yaml_text.parse(text, source)
    if not isinstance(data, dict | None):
        raise ConfigError(f"{source}: expected a mapping")
    return data or {}


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], str]:
    """Return the mapping that a YAML file holds, and the file's name for messages.

    Raises:
        ConfigError: the file cannot be read, or as `mapping`.
    """
    source = os.fsdecode(path)
    return mapping(yaml_text.read(source), source), source
