"""What a Pareto front leaves in a folder: the front with its gains, a picture, the knee, and the report."""

from typing import Any

import mjx_climb as mc
from tuning.output.folder import Folder
from tuning.problem.evaluation import under_pd
from tuning.report import ensemble_pictures, pages
from tuning.report.numbers import to_json
from tuning.searches.pareto import Front
from tuning.searches.result import Written

CAPTION = "The front, and all that was walked on the way."


def write(found: Front, folder: Folder, begun: None = None) -> Written:
    """Draw the front, walk what the report shows, and write what `mjx-climb pareto` writes."""
    found = folder.found(found)
    problem, data, asked, scenario = found.problem, found.data, found.asked, found.scenario
    summary = _summary(found)
    folder.text("summary.json", summary + "\n")
    folder.draw({"front": (CAPTION, lambda: ensemble_pictures.plot_front(data))})
    with folder.report(compiles=True) as write_page:
        again = "mjx-climb pareto config.yaml --search search.yaml "
        again += f"--better {asked.better} --against {asked.against} --points {asked.points} --out again"
        on_front = {name: data[name].values for name in data.attrs["gains"].split()}
        how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        histories = mc.rollout_histories(scenario, on_front, metrics=problem.metrics, **how)
        origin = folder.origin("tuning.pareto(...)", again)
        write_page(pages.pareto_page(found, histories, walks, origin=origin, pictures=folder.pictures))
    return Written(walks=walks, data=data, outcome=[found.worth], summary=summary)


def _summary(found: Front) -> str:
    """Return the front, its knee, the metrics of the config's gains and of pd, and pd's front over kp and kd."""
    data, metrics = found.data, (found.asked.against, found.asked.better)
    names = (*metrics, *data.attrs["gains"].split())
    rows = [{n: data[n].values[i] for n in names} for i in range(data.sizes["front"])]
    references = {
        name: {n: data[f"reference_{n}"].sel(reference=name).item() for n in metrics} for name in ("config", "pd")
    }
    columns = ("kp", "kd", *metrics)
    without = [{n: data[f"without_{n}"].values[i] for n in columns} for i in range(data.sizes["without"])]
    sensor = {"in_words": found.worth}
    return to_json(
        {"front": rows, "knee": found.knee, **references, "pd_over_kp_and_kd": without, "force_sensor": sensor}
    )
