"""What every result leaves in its folder: the scenario, with copies of the files that it names."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset, scenario_files
from tuning.gains.own_section import section
from tuning.report.page import Origin
from tuning.searches import finished_parts

# by which a result is known; tune --ensemble writes judged.nc too, so that this comes last
RESULTS = (
    "search.nc", "front.nc", "schedule.nc", "sweep.nc", "trajectory.nc", "margins.json", "reproduce.json", "judged.nc",
)  # fmt: skip


def check_own(folder: Path, result: str) -> None:
    """Check, before a long computation, that a folder can be written to and holds no other command's result.

    Commands write files of the same names: config.yaml would be another's than the report's beside it.

    Raises:
        OutputError: it cannot, or does.
    """
    dataset.check_folder(folder)
    kept = (finished_parts.FOLDER,) if result in ("trajectory.nc", "margins.json", "reproduce.json") else ()
    there = next((name for name in (*kept, *RESULTS) if (folder / name).exists()), result)
    if there != result:
        raise dataset.OutputError(
            f"{folder}: expected a folder without another command's result, got {there} in it (choose another folder)"
        )


def write_config(
    scenario: mc.Scenario,
    folder: Path,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = (),
    objective: Any = None,
) -> mc.Scenario:
    """Write config.yaml, and return the scenario with the files that it names copied to the folder.

    `law`, `metrics` and `objective` are the user's own, where there are any: config.yaml names them.

    Raises:
        OutputError: a file cannot be written.
    """
    own = section(law, metrics, objective)
    written = scenario_files.copied(scenario if own is None else scenario.with_overrides({"own": own}), folder)
    dataset.write_text_atomically(folder / "config.yaml", scenario_files.portable_yaml(written, folder))
    return written if own is None else written.with_overrides({"own": None})


def made_from(data: xr.Dataset, scenario: mc.Scenario) -> xr.Dataset:
    """Return a dataset that names as its own a scenario whose files were copied."""
    return data.assign_attrs(scenario=scenario.to_yaml())


def complete(origin: Origin | None, call: str, again: str, folder: Path) -> Origin:
    """Return where a report comes from, with the folder's config.yaml; where None, it was made in Python by `call`."""
    origin = origin or Origin("the scenario", call, again)
    return origin._replace(config=without_folders((folder / "config.yaml").read_text(encoding="utf-8")))


def without_folders(text: str) -> str:
    """Return a text in which absolute paths have lost their folders: these belong to one machine."""
    return re.sub(r"(?<![\w.:/-])(?:~|[A-Za-z]:)?[/\\](?:[^/\\\n'\"=]+[/\\])*(?=[^/\\\s])", "", text)
