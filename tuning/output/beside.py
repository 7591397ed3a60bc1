"""What a grid of walks is compared with, whatever these give: it may begin before them."""

from collections.abc import Mapping
from typing import NamedTuple

import xarray as xr

import mjx_climb as mc
from mjx_climb.rollouts.given import AnyGains
from tuning.gains.gains_file import replaced
from tuning.judged import stability_limit
from tuning.output.ahead import Asked, Begin
from tuning.problem.evaluation import under_pd
from tuning.searches import grid, retuned_pd

GIVEN = "gains file"  # the name of a walk with gains that are not the config's
# inertia, damping and stiffness of cases 1.1, 1.2 and 2
PAPER = {(1.0, 1e4, 4e5), (1.0, 5e3, 5e4), (1.0, 5e3, 2e4)}


class Beside(NamedTuple):
    """What a grid is compared with, whatever its walks give: works that wait to be asked for, or are under way."""

    walks: Mapping[str, Asked[mc.Trajectory]]  # pd, config (or paper), gains file: as far as there are such
    limits: Asked[tuple[retuned_pd.Rival | None, xr.DataArray]]  # pd retuned, and the limit of stability


def beside(
    scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains | None, axes: grid.Axes, engine: str, begin: Begin
) -> Beside:
    """Begin what a grid is compared with; the arguments are those of `tuning.sweep`."""
    config = "paper" if _is_the_papers(scenario, law) else "config"
    walkers = {"pd": (under_pd(scenario), None), config: (scenario, law)}
    walked, own = walkers[config] if gains is None else replaced(scenario, law, gains)
    if gains is not None:
        walkers[GIVEN] = walked, own
    # one after the other: each keeps all cores busy, and side by side they take more than twice as long
    limits = begin(
        lambda _: (
            retuned_pd.least(scenario, halvings=1, engine=engine),
            stability_limit.over_axes(walked, axes, law=own, engine=engine),
        )
    )
    return Beside({name: begin(one_walk(*walker, engine)) for name, walker in walkers.items()}, limits)


def one_walk(scenario: mc.Scenario, law: mc.Law | None, engine: str) -> Asked[mc.Trajectory]:
    """Return a work that walks one robot under the scenario's law, or another."""
    return lambda _: mc.rollout(scenario, law=law, engine=engine)


def _is_the_papers(scenario: mc.Scenario, law: mc.Law | None) -> bool:
    control = scenario.control
    return law is None and (control.inertia, control.damping, control.stiffness) in PAPER
