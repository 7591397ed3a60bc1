"""What a gain schedule leaves in a folder: the table, all metrics, and a picture."""

from tuning.output.folder import Folder
from tuning.report import ensemble_pictures
from tuning.searches import schedule
from tuning.searches.result import Written
from tuning.searches.schedule import Scheduled


def write(found: Scheduled, folder: Folder, begun: None = None) -> Written:
    """Draw the schedule, and write what `mjx-climb schedule` writes; there is no report."""
    found = folder.found(found)
    folder.text("schedule.csv", schedule.to_csv(found.data))
    folder.text("schedule.yaml", schedule.to_yaml(found.data))
    folder.draw({"schedule": ("Gains by gravity and cargo.", lambda: ensemble_pictures.plot_schedule(found.data))})
    return Written(data=found.data, outcome=[schedule.worth(found.data)])
