"""What gains on the walks of an ensemble leave in a folder: every walk, means and worst, the picture, the page."""

from tuning.output.folder import Folder
from tuning.report import ensemble_pictures, page, pages
from tuning.report.numbers import to_json
from tuning.searches import judge
from tuning.searches.judge import Judged
from tuning.searches.result import Written

CAPTION = "Share of the walks below a value."


def write(found: Judged, folder: Folder, begun: None = None) -> Written:
    """Write what `mjx-climb judge` writes."""
    ensemble = found.ensemble
    assert ensemble is not None
    summed = judge.summary(found.data)
    sentence = f"{ensemble.members} walks each; {judge.failed_in_words(summed)}"
    found = folder.found(found)
    summary = to_json(judge.plain(summed, pages.shown(found.problem.metrics)))
    folder.text("summary.json", summary + "\n")
    folder.draw({"judged": (CAPTION, lambda: ensemble_pictures.plot_judged(found.data))})
    with folder.report() as write_page:
        origin = folder.origin("tuning.judge(...)")
        made = page.Page(
            title=f"Gains on the walks of {origin.name}", origin=origin, verdict=f"{sentence}.", notes=[],
            scenario=found.scenario, explorers=[], tables=[pages.judged_table(summed, found.problem.metrics)],
            pictures=folder.pictures, facts={"seed": ensemble.seed},
        )  # fmt: skip
        write_page(made)
    return Written(data=found.data, summed=summed, outcome=[sentence], summary=summary)
