"""A Pareto front, and what it leaves in a folder: the front with its gains, a picture, the knee, and the report."""

import dataclasses
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.rollouts.given import AnyGains
from tuning.gains import gains_file
from tuning.output.folder import complete, made_from
from tuning.output.found import draw, write_asked
from tuning.output.stages import Stage, silent
from tuning.problem.evaluation import under_pd
from tuning.report import ensemble_pictures, page
from tuning.report import pareto as pages
from tuning.report.numbers import to_json
from tuning.searches import finished_parts, pareto, retuned_pd
from tuning.searches.pareto import Trade

FILES = "report.html, front.nc, front.png, gains.yaml, summary.json, config.yaml, search.yaml"


@dataclasses.dataclass(frozen=True)
class Front:
    """A Pareto front of two metrics, and what was searched for it."""

    data: xr.Dataset  # see `tuning.searches.pareto.front`
    trade: Trade

    @property
    def knee(self) -> int:
        """The index of the point where the front bends, the furthest from the line between its ends."""
        return pareto.knee(self.data[self.trade.against].values, self.data[self.trade.better].values)

    @property
    def gains(self) -> AnyGains:
        """The gains at the knee."""
        return pareto.gains_of(self.data, self.knee)

    @property
    def without(self) -> xr.Dataset | None:
        """Of the front of pd over kp and kd the point that costs no more than the knee, None where all cost more."""
        return pareto.without_sensor(self.data, self.knee, self.trade.problem.metrics)

    @property
    def worth(self) -> str:
        """What the force sensor is worth at the knee, in words."""
        better, against = (self.trade.problem.metrics.in_words(n) for n in (self.trade.better, self.trade.against))
        if self.without is None:
            return f"pd has more {against} than the knee with any kp and kd of its grid"
        found = {better: self.data[self.trade.better].values[self.knee].item()}
        theirs = {better: self.without[f"without_{self.trade.better}"].item()}
        joint = {name: self.without[f"without_{name}"].item() for name in ("kp", "kd")}
        larger = self.trade.problem.metrics[self.trade.better].larger_is_better
        worth = retuned_pd.worth(found, theirs, joint, larger=larger, lacks=retuned_pd.ON_A_GRID)
        return f"{worth.in_words}, at no more {against}"

    @property
    def summary(self) -> str:
        """The front, its knee, the metrics of the config's gains and of pd, and pd's front over kp and kd, as JSON."""
        metrics = self.trade.against, self.trade.better
        names = (*metrics, *self.data.attrs["gains"].split())
        rows = [{n: self.data[n].values[i] for n in names} for i in range(self.data.sizes["front"])]
        references = {
            name: {n: self.data[f"reference_{n}"].sel(reference=name).item() for n in metrics}
            for name in ("config", "pd")
        }
        columns = ("kp", "kd", *metrics)
        points = range(self.data.sizes["without"])
        without = [{n: self.data[f"without_{n}"].values[i] for n in columns} for i in points]
        sensor = {"in_words": self.worth}
        return to_json(
            {"front": rows, "knee": self.knee, **references, "pd_over_kp_and_kd": without, "force_sensor": sensor}
        )

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: page.Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
    ) -> None:
        """Draw the front, walk what the report shows, and write what `mjx-climb pareto` writes.

        The arguments are those of `tuning.output.swept.Swept.write`.

        Raises:
            OutputError: a file cannot be written.
        """
        folder, (problem, search, better, against) = Path(folder), self.trade
        scenario = write_asked(problem, search, folder, "front.nc")
        dataset.save(made_from(self.data, scenario), folder / "front.nc")
        dataset.write_text_atomically(folder / "summary.json", self.summary + "\n")
        again = f"mjx-climb pareto config.yaml --search search.yaml --better {better} --against {against} --out again"
        origin = complete(origin, "tuning.pareto(...)", again, folder)
        comment = f"mjx-climb pareto {origin.name}: {better} against {against}, the knee of the front"
        gains_file.save(self.gains, folder / "gains.yaml", comment, problem.law)
        draw({"front": lambda: ensemble_pictures.plot_front(self.data)}, folder, {"png", *figures}, stage)
        with stage("report"):
            page.write(self._page(scenario, origin, folder), folder)
        finished_parts.clear(folder)

    def _page(self, scenario: mc.Scenario, origin: page.Origin, folder: Path) -> page.Page:
        problem, data = self.trade.problem, self.data
        how: dict[str, Any] = {"law": problem.law, "engine": problem.engine}
        names = data.attrs["gains"].split()
        on_front = {name: data[name].values for name in names}
        walks = {"pd": mc.rollout(under_pd(scenario), engine=problem.engine), "config": mc.rollout(scenario, **how)}
        return pages.page(
            data, self.knee, mc.rollout_histories(scenario, on_front, metrics=problem.metrics, **how), walks, scenario,
            origin=origin,
            seed=self.trade.search.seed,
            worth=self.worth,
            pictures={"The front, and all that was walked on the way.": folder / "front.png"},
            about=problem.metrics,
        )  # fmt: skip
