"""Gains that a search over an ensemble found: page with the walks that test them."""

from typing import Any

import mjx_climb as mc
from tuning.comparisons import judge as judging
from tuning.comparisons.of_ensemble import RobustComparison
from tuning.comparisons.of_ensemble import compare as compare
from tuning.comparisons.side_by_side import Values
from tuning.gains.gains_file import by_name
from tuning.pages import comparison
from tuning.pages.contents import Contents, Picture, contents_of
from tuning.pages.judge import SHARES, judged_table, plot_judged
from tuning.pages.page import Findings, Page
from tuning.pages.tune import CONVERGENCE, plot_convergence
from tuning.results.tuned import AGREEMENT, Robust
from tuning.searches.retuned_pd import NAME


def contents(found: Robust, compared: RobustComparison, name: str) -> Contents:
    """Return gains, all points, a fresh draw that tests them, pictures and page."""
    walks, summed, worth = compared.walks, compared.summed, compared.worth
    plain: dict[str, Any] = {}
    for walk, own in compared.plain.items():
        broken = summed["broken"].sel(gains=walk).to_series().to_dict()
        plain[walk] = {**own, "objective": float(summed["objective"].sel(gains=walk)), "broken_limits": broken}
    plain["search"] = {
        "objective": found.value, "feasible": found.feasible, "env_steps": found.env_steps,
        "gains": by_name(found.gains),
    }  # fmt: skip
    pictures = {
        "judged": Picture(SHARES, lambda: plot_judged(walks)),
        "convergence": Picture(CONVERGENCE, lambda: plot_convergence(found)),
    }
    page, summary = page_of(found, compared), plain if worth is None else plain | worth.summary
    again = "mjx-climb tune config.yaml --search search.yaml --ensemble ensemble.yaml --out again"
    files = {"judged.nc": walks} | pictures
    return contents_of(found, name, page, summary, files, again=again, data=walks, summed=summed)


def findings(found: Robust, compared: RobustComparison) -> Findings:
    """Return the findings on the walks that the search never saw."""
    broken = compared.summed["broken"].sel(gains="robust").to_series()
    lines = [] if found.feasible else ["warning: no gains kept every limit in every member of the search"]
    lines += [f"warning: {share:.1%} of the fresh walks break {limit}" for limit, share in broken.items() if share]
    failed = judging.failed_in_words(compared.summed)
    lines += [f"{found.judges} walks each that the search never saw; {failed}"]
    lines += judging.lost_in_words(compared.walks)
    lines += [found.data.attrs[AGREEMENT]] if AGREEMENT in found.data.attrs else []
    lines += [f"held by its limits: {'; '.join(compared.binding)}"] if compared.binding else []
    return Findings.of(compared.verdict, lines, "" if compared.worth is None else compared.worth.in_words)


def page_of(found: Robust, compared: RobustComparison) -> Page:
    """Return the page of a search over an ensemble."""
    control = found.scenario.control
    joint = {"kp": control.kp, "kd": control.kd}
    rivals: dict[str, tuple[Values | None, Values]] = {"robust": (joint | by_name(found.gains), {})}
    rivals |= {NAME: (compared.joint, {})} if compared.joint else {}
    if not found.law:
        rivals |= {"config": (joint | {key: getattr(control, key) for key in mc.Gains.AXES}, {})}
    return Page(
        f"Robust gains for {{}}: {found.method}, {found.search.space}", findings(found, compared), found.scenario,
        facts={"seed": found.search.seed, "env-steps": f"{found.env_steps:,} (best after {found.best_at:,})"},
        tables=[judged_table(compared.summed, found.problem.metrics)],
        opened=[comparison.gains_table(rivals, found.law)],
    )  # fmt: skip
