"""A gain schedule: gains by gravity and cargo."""

import dataclasses
import math

import numpy as np
import xarray as xr

from mjx_climb.inputs.resolve import AnyGains
from tuning.problem.spaces import as_gains
from tuning.results.result import Result


@dataclasses.dataclass(frozen=True)
class Scheduled(Result):
    """Gains for pairs of gravity and cargo.

    `data` holds over `gravity` and `cargo` the gains, `value` (1 for pd at that point), `feasible`; with `walk` (tuned,
    config, retuned_pd, planned_unsearched, pd) every metric, in float64 with grippers that tear off; `retuned_kp`,
    `retuned_kd` and `retuned_value` of pd with the best of a grid of joint gains at each point; with `gravity_of` and
    `cargo_of` the `value` (`transfer`) that the gains of another operating point have here, NaN where they break a
    constraint.
    """

    FILE = "schedule.nc"
    KIND = "schedule"

    def lookup(self, gravity: float, cargo: float) -> AnyGains:
        """Return the gains for a gravity in G and a cargo in kg, between the operating points too."""
        return lookup(self.data, gravity, cargo)


def lookup(table: xr.Dataset, gravity: float, cargo: float) -> AnyGains:
    """Return the gains between the operating points: linear in log gravity and in cargo, held at the ends.

    Logarithms are, of gains above 0 at all points; `table` is the data of `schedule`, gravity is in G, cargo in kg.
    """
    loads, levels, level = table["cargo"].values, np.log(table["gravity"].values), math.log(gravity)
    found = {}
    for name in table.attrs["gains"].split():
        values = table[name].values
        to, back = (np.log, np.exp) if (values > 0).all() else (np.asarray, np.asarray)
        at_cargo = np.apply_along_axis(lambda along: np.interp(cargo, loads, along), 1, to(values))
        found[name] = back(np.apply_along_axis(lambda along: np.interp(level, levels, along), 0, at_cargo))
    return as_gains(found)
