"""config.yaml of a result's folder: the scenario, with the files and the user's own objects that it names."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.inputs.file_contents import digest
from tuning import scenario_files
from tuning.gains.own_section import section


def write_config(
    scenario: mc.Scenario,
    folder: Path,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = (),
    objective: Any = None,
    method: Any = None,
) -> mc.Scenario:
    """Write config.yaml, and return the scenario with the files that it names copied to the folder.

    `law`, `metrics`, `objective` and `method` are the user's own, where there are any: config.yaml names them.
    """
    own, scenario = section(law, metrics, objective, method), _with_digests(scenario)
    written = scenario_files.copied(scenario if own is None else scenario.with_own(**own), folder)
    dataset.write_text_atomically(folder / "config.yaml", scenario_files.portable_yaml(written, folder))
    return written if own is None else written.with_own(law=None, metrics=[], objective=None)


def _with_digests(scenario: mc.Scenario) -> mc.Scenario:
    """Return a scenario that says how the files of contact, drive and disturbances are now."""
    files = {place: each.file for place, each in scenario.kinds.items() if each.file is not None}
    return scenario.with_overrides({f"{place}.digest": digest(Path(file)) for place, file in files.items()})
