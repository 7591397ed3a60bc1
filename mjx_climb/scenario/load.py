"""Reading a scenario from its file."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_climb.scenario import shipped
from mjx_climb.scenario.model import Scenario, at, overridden, paths, validated
from mjx_climb.scenario.yaml_text import parse, read


def load_scenario(path: str | os.PathLike[str], overrides: Sequence[str] | Mapping[str, Any] = ()) -> Scenario:
    """Read a scenario from a YAML file, then change some keys.

    **Arguments:**

    - `path`: the file, or the bare name of a config that comes with the program, as in "case_2". Keys that the
        file leaves out take their defaults.
    - `overrides`: strings "dotted.key=value" with the value in YAML, or a mapping from dotted keys to values.
        Lists are indexed by number, as in `disturbance.pushes.0.start`. A mapping as a value changes only the
        keys that it names.

    **Returns:** the `Scenario`.

    **Raises:** `ConfigError`, also for overrides. The file must be valid before the overrides apply.
    """
    source = os.fsdecode(path if "\0" in os.fsdecode(path) else shipped.found(Path(path)))
    return overridden(validated(Scenario, _beside(parse(read(source), source), source), source), overrides, source)


def _beside(data: Any, source: str) -> Any:
    """The data of a file with the relative paths in it as seen from here: they start at the file's folder."""
    for *sections, key in paths(data):
        values = at(data, sections)
        if isinstance(values, dict) and isinstance(values.get(key), str) and "\0" not in values[key]:
            values[key] = str(Path(source).parent.absolute() / values[key])
    return data
