"""Gains judged on an ensemble, and what they leave in a folder: every walk, means and worst, the picture, the page."""

import dataclasses
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.quantities.parameters import gains as gains_of
from mjx_climb.rollouts.given import AnyGains
from tuning.gains import gains_file
from tuning.gains.own_section import taken
from tuning.output.folder import check_own, complete, made_from, write_config
from tuning.output.found import draw
from tuning.output.stages import Stage, silent
from tuning.problem import ensemble as ensembles
from tuning.problem.ensemble import Ensemble
from tuning.report import ensemble_pictures, page
from tuning.report import robust as pages
from tuning.report.numbers import to_json
from tuning.searches import finished_parts, robust, shards
from tuning.searches.draw import Draw
from tuning.searches.shards import Shard

FILES = "report.html, judged.nc, summary.json, judged.png, config.yaml, ensemble.yaml"
CAPTION = "Share of the walks below a value."


class Verdict(NamedTuple):
    """What the walks say."""

    summed: xr.Dataset  # mean and worst, see `tuning.searches.robust.summary`
    sentence: str
    summary: str  # all of it, JSON


@dataclasses.dataclass(frozen=True)
class Judged:
    """The walks of several gains, and of pd, through the members of an ensemble that no search of it has seen."""

    walks: xr.Dataset  # see `tuning.searches.robust.judge`
    scenario: mc.Scenario
    ensemble: Ensemble  # as its user gave it, with so many members
    metrics: mc.MetricTable = mc.METRICS
    law: mc.Law | None = None  # whose gains they are, where it is not the scenario's

    def write(
        self,
        folder: str | os.PathLike[str],
        *,
        origin: page.Origin | None = None,
        figures: Collection[str] = ("png",),
        stage: Stage = silent,
    ) -> Verdict:
        """Write what `mjx-climb judge` writes; the arguments are those of `tuning.output.swept.Swept.write`.

        Raises:
            ConfigError: some gains diverge in each member.
            OutputError: a file cannot be written.
        """
        folder = Path(folder)
        check_own(folder, "judged.nc")
        summed = robust.summary(self.walks)
        lost = zip(summed["gains"].values.tolist(), summed["failed"].values, strict=True)
        failed = ", ".join(f"{name} {share:.0%}" for name, share in lost)
        sentence = f"{self.ensemble.members} walks each; would lose a gripper, or diverge: {failed}"
        verdict = Verdict(summed, sentence, to_json(_plain(summed, self.metrics)))
        scenario = write_config(self.scenario, folder, self.law, self.metrics)
        dataset.write_text_atomically(folder / "ensemble.yaml", self.ensemble.to_yaml())
        dataset.save(made_from(self.walks, scenario), folder / "judged.nc")
        dataset.write_text_atomically(folder / "summary.json", verdict.summary + "\n")
        draw({"judged": lambda: ensemble_pictures.plot_judged(self.walks)}, folder, {"png", *figures}, stage)
        with stage("report", compiles=False):
            origin = complete(origin, "tuning.judge(...)", "tuning.judge(...)", folder)
            shown = page.Page(
                title=f"Gains judged on walks of {origin.name}", origin=origin, verdict=f"{sentence}.", notes=[],
                scenario=scenario, explorers=[], tables=[pages.judged_table(summed, self.metrics)],
                pictures={CAPTION: folder / "judged.png"}, facts={"seed": self.ensemble.seed},
            )  # fmt: skip
            page.write(shown, folder)
        finished_parts.clear(folder)
        return verdict


def rivals(scenario: mc.Scenario, gains: Mapping[str, AnyGains], law: mc.Law | None) -> dict[str, AnyGains]:
    """Return gains by name with the scenario's own, or those of a law, behind them."""
    return {**gains, "config": law or gains_of(scenario)}


def draw_of(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains],
    ensemble: Ensemble,
    law: mc.Law | None,
    metrics: mc.MetricTable,
    engine: str,
) -> Draw:
    """Return the walks that judge gains: through members that no search over the ensemble has seen.

    Raises:
        ConfigError: an ensemble that the scenario does not allow.
    """
    fresh = robust.fresh(ensemble, ensemble.members)
    return Draw(scenario, gains, fresh, ensembles.draw(scenario, fresh), law, metrics, engine)


def keep_beside(
    shard: Shard,
    out: Path,
    draw: Draw,
    ensemble: Ensemble,
    about: Mapping[str, str],
) -> None:
    """Leave in the folder of a shard what `merged` needs beside its walks; see `tuning.output.swept.keep_beside`."""
    folder = shard.folder(out)
    write_config(draw.scenario, folder, draw.law, draw.metrics)
    dataset.write_text_atomically(folder / "ensemble.yaml", ensemble.to_yaml())
    for number, own in enumerate(draw.gains.values()):
        gains_file.save(own, folder / f"gains-{number}.yaml", "judged in this folder", draw.law)
    shards.tell(out, shard, {**about})


def merged(found: Sequence[shards.Kept], law: mc.Law | None, metrics: mc.MetricTable) -> Judged:
    """Return what was judged in these shards.

    Raises:
        ConfigError: shards of another law, other metrics or versions, or not all of them.
    """
    folder, told = found[0].folder, found[0].identity
    scenario, law, metrics = taken(mc.load_scenario(folder / "config.yaml"), law, metrics, f"{folder}/config.yaml")
    files = [folder / f"gains-{number}.yaml" for number in range(len(told["gains"]))]
    gains: dict[str, Any] = dict(zip(told["gains"], (gains_file.load(file, law) for file in files), strict=True))
    ensemble = ensembles.load(folder / "ensemble.yaml")
    draw = draw_of(scenario, gains, ensemble, law, metrics, told["engine"])
    return Judged(draw.dataset(shards.joined(draw, found)), scenario, ensemble, metrics, law)


def _plain(summed: xr.Dataset, metrics: mc.MetricTable) -> dict[str, Any]:
    shown = pages.shown(metrics)
    return {
        name: {
            "failed": float(summed["failed"].sel(gains=name)),
            **{s: {m: float(summed[m].sel(gains=name, statistic=s)) for m in shown} for s in ("mean", "worst")},
        }
        for name in summed["gains"].values.tolist()
    }
