"""Reading scenarios, and profiles of hardware: the section `hardware` in a file of its own."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from mjx_climb.scenario import shipped
from mjx_climb.scenario.messages import ConfigError, show
from mjx_climb.scenario.model import Hardware, Scenario, overridden, validated
from mjx_climb.scenario.values import Section
from mjx_climb.scenario.yaml_text import parse, read


def load_scenario(path: str | os.PathLike[str], overrides: Sequence[str] | Mapping[str, object] = ()) -> Scenario:
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
    scenario = validated(Scenario, parse(read(source), source), source).beside(Path(source).parent)
    return overridden(scenario, overrides, source)


class _Profile(Section):
    hardware: Hardware


def load_hardware(path: str | os.PathLike[str]) -> Hardware:
    """Read a profile: a YAML file with the one section `hardware`, or the bare name of one that is shipped.

    Raises:
        ConfigError: no such file, another section, or a bad value; in one line with the key.
    """
    source = os.fsdecode(shipped.found_profile(Path(path)))
    data = parse(read(source), source)
    if not isinstance(data, Mapping) or list(data) != ["hardware"]:
        raise ConfigError(source, "", "the one section hardware", show(data))
    return validated(_Profile, data, source).hardware


def with_hardware(scenario: Scenario, hardware: Hardware, source: str = "hardware") -> Scenario:
    """Return the scenario on this hardware, with nothing left of its own.

    Raises:
        ConfigError: a control period that is no whole number of the scenario's time steps.
    """
    return overridden(scenario, {"hardware": hardware.model_dump(mode="json")}, source)
