"""A gain schedule, and what it leaves in a folder: the table, all metrics, and a picture."""

import dataclasses
import os
from collections.abc import Collection
from pathlib import Path

import xarray as xr

from mjx_climb.files import dataset
from mjx_climb.rollouts.given import AnyGains
from tuning.output.folder import made_from
from tuning.output.found import draw, write_asked
from tuning.output.stages import Stage, silent
from tuning.report import ensemble_pictures
from tuning.searches import finished_parts, schedule
from tuning.searches.schedule import OperatingPoints

FILES = "schedule.csv, schedule.yaml, schedule.nc, schedule.png, config.yaml, search.yaml"


@dataclasses.dataclass(frozen=True)
class Scheduled:
    """Gains for pairs of gravity and cargo, and what was tuned."""

    data: xr.Dataset  # see `tuning.searches.schedule.schedule`
    points: OperatingPoints

    def lookup(self, gravity: float, cargo: float) -> AnyGains:
        """Return the gains for a gravity in G and a cargo in kg, between the operating points too."""
        return schedule.lookup(self.data, gravity, cargo)

    def write(
        self, folder: str | os.PathLike[str], *, figures: Collection[str] = ("png",), stage: Stage = silent
    ) -> None:
        """Draw the schedule, and write what `mjx-climb schedule` writes.

        The arguments are those of `tuning.output.swept.Swept.write`; there is no report.

        Raises:
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        scenario = write_asked(self.points.problem, self.points.search, folder, "schedule.nc")
        dataset.save(made_from(self.data, scenario), folder / "schedule.nc")
        dataset.write_text_atomically(folder / "schedule.csv", schedule.to_csv(self.data))
        dataset.write_text_atomically(folder / "schedule.yaml", schedule.to_yaml(self.data))
        draw({"schedule": lambda: ensemble_pictures.plot_schedule(self.data)}, folder, figures, stage)
        finished_parts.clear(folder)
