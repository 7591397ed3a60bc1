"""Profiles of hardware: the `hardware` section of a scenario in a file of its own, shipped ones by name."""

import os
from collections.abc import Mapping
from pathlib import Path

from mjx_climb.scenario import shipped
from mjx_climb.scenario.hardware import Hardware
from mjx_climb.scenario.messages import config_error, show
from mjx_climb.scenario.model import Scenario, validated
from mjx_climb.scenario.section import Section
from mjx_climb.scenario.yaml_text import parse, read


class _Profile(Section):
    hardware: Hardware


def load_hardware(path: str | os.PathLike[str]) -> Hardware:
    """Read a profile.

    Arguments:
        path: a YAML file with the one section `hardware`, or the bare name of a profile that comes with the program.

    Raises:
        ConfigError: no such file, another section, or a bad value; in one line with the key.
    """
    source = os.fsdecode(shipped.found_profile(Path(path)))
    data = parse(read(source), source)
    if not isinstance(data, Mapping) or list(data) != ["hardware"]:
        raise config_error(source, "", "the one section hardware", show(data))
    return validated(_Profile, data, source).hardware


def with_hardware(scenario: Scenario, hardware: Hardware, source: str = "hardware") -> Scenario:
    """Return the scenario on this hardware, with nothing left of its own.

    Raises:
        ConfigError: a control period that is no whole number of the scenario's time steps.
    """
    data = scenario.model_dump(mode="json") | {"hardware": hardware.model_dump(mode="json")}
    return validated(Scenario, data, source)
