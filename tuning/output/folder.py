"""What every result leaves in its folder: the scenario, with copies of the files that it names."""

import re
from pathlib import Path

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset, scenario_files
from tuning.report.page import Origin


def write_config(scenario: mc.Scenario, folder: Path) -> mc.Scenario:
    """Write config.yaml, and return the scenario with the files that it names copied to the folder.

    Raises:
        OutputError: a file cannot be written.
    """
    scenario = scenario_files.copied(scenario, folder)
    dataset.write_text_atomically(folder / "config.yaml", scenario_files.portable_yaml(scenario, folder))
    return scenario


def made_from(data: xr.Dataset, scenario: mc.Scenario) -> xr.Dataset:
    """Return a dataset that names as its own a scenario whose files were copied."""
    return data.assign_attrs(scenario=scenario.to_yaml())


def complete(origin: Origin | None, call: str, again: str, scenario: mc.Scenario, folder: Path) -> Origin:
    """Return where a report comes from, with the scenario in full; where None, it was made in Python by `call`."""
    origin = origin or Origin("the scenario", call, again)
    return origin._replace(config=without_folders(scenario_files.portable_yaml(scenario, folder)))


def without_folders(text: str) -> str:
    """Return a text in which absolute paths have lost their folders: these belong to one machine."""
    return re.sub(r"(?<![\w.:/-])(?:~|[A-Za-z]:)?[/\\](?:[^/\\\n'\"=]+[/\\])*(?=[^/\\\s])", "", text)
