"""The page of a reproduction of the paper."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tuning.judged import paper
from tuning.report.explorer import explorer
from tuning.report.page import Origin, Page, Table

SHOWN = ("pd", "virtual model", "measured pose")


def page(
    cases: Mapping[str, Mapping[str, paper.Walk]],
    metrics: Mapping[str, Mapping[str, Mapping[str, Any]]],
    verdicts: Mapping[str, Mapping[str, Mapping[str, paper.Verdict]]],
    tables: Sequence[Table],
    notes: Sequence[str],
    prose: Mapping[str, Sequence[str]],
    *,
    origin: Origin,
    pictures: Mapping[str, Path],
) -> Page:
    """Return the page of a reproduction.

    Arguments:
        cases: the walks, by case and method.
        metrics: of the walks with the holding limit, likewise.
        verdicts: by case, reading and claim.
        tables: metrics and claims.
        notes: what is said of the claims, a line each.
        prose: what is said of each claim, by case and reading.
        origin: of the page.
        pictures: PNG files by their captions.
    """
    explorers = []
    for name, walks in cases.items():
        titles = {method: paper.METHODS[method].title for method in walks}
        explorers.append(
            explorer(
                f"Case {name}: {paper.CASES[name].title}",
                {titles[method]: walk.trajectory for method, walk in walks.items()},
                {titles[method]: numbers for method, numbers in metrics[name].items()},
                shown=SHOWN,
            )
        )
    first = next(iter(cases.values()))[paper.BASELINE].trajectory.scenario
    return Page(
        title="The paper's three cases, walked again",
        origin=origin,
        verdict=verdict(verdicts),
        notes=notes,
        scenario=first,
        explorers=explorers,
        tables=tables,
        prose=prose,
        pictures=pictures,
        facts={"precision": "float64", "seed": "none: nothing is drawn at random"},
    )


def verdict(verdicts: Mapping[str, Mapping[str, Mapping[str, paper.Verdict]]]) -> str:
    """Return in one sentence how many claims hold in every case in which they can be judged, by reading of Eq. 3."""
    parts = []
    for reading in paper.READINGS:
        judged = {
            claim: [case[reading][claim].holds for case in verdicts.values() if case[reading][claim].holds is not None]
            for claim in paper.CLAIMS
        }
        everywhere = sum(bool(holds) and all(holds) for holds in judged.values())
        somewhere = sum(any(holds) and not all(holds) for holds in judged.values())
        parts.append(
            f"read as a {reading.replace('_', ' ')} {everywhere} hold wherever they can be judged and {somewhere} in "
            "some cases only"
        )
    return f"Of the paper's {len(paper.CLAIMS)} claims about Eq. 3, {', and '.join(parts)}."
