"""The walks of several gains, and of pd, through an ensemble: row by row, so that they can be kept and shared out."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr
import yaml

import mjx_climb as mc
from mjx_climb.files import scenario_files
from mjx_climb.quantities.batches import own_axes
from mjx_climb.rollouts.given import AnyGains
from mjx_climb.rollouts.rollout import walks_in_pieces
from tuning.gains.gains_file import by_name
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import under_pd
from tuning.searches import grid, identity, robust

KIND = "judge"  # of shards
PD = "pd"


@dataclasses.dataclass(frozen=True)
class Draw:
    """What is judged on an ensemble. A row is one member, with all gains."""

    scenario: mc.Scenario
    gains: Mapping[str, AnyGains]  # by name; pd walks beside them
    ensemble: Ensemble  # that walks, see `tuning.searches.robust.fresh`
    numbers: mc.Parameters  # of its members, with axes (members, 1)
    law: mc.Law | None  # whose gains they are, where it is not the scenario's
    metrics: mc.MetricTable
    engine: str

    @property
    def rows(self) -> int:
        """How many members."""
        return self.ensemble.members

    @property
    def size(self) -> int:
        """How many members walk at a time."""
        return grid.default_batch_size(self.rows, self.scenario.steps)

    @property
    def in_pieces(self) -> bool:
        """Whether their steps are compiled in pieces."""
        return walks_in_pieces(self.scenario, self.numbers, self.engine)

    def walk(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the metrics of some members, (rows, gains)."""
        drawn = self.numbers
        numbers = jax.tree.map(lambda value, own: value[rows] if value.ndim > own else value, drawn, own_axes(drawn))
        own = {"kp": self.scenario.control.kp, "kd": self.scenario.control.kd}
        walkers = [(self.scenario, self.law, each) for each in self.gains.values()]
        found = []
        for place, law, gains in [*walkers, (under_pd(self.scenario), None, own)]:
            how: dict[str, Any] = {"law": law, "metrics": self.metrics, "engine": self.engine, "smooth": True}
            one = robust.stacked(place, law, [gains])
            found.append(mc.rollout_metrics(place, one, numbers, dtype=np.float32, **how))
        return {name: np.concatenate([each[name] for each in found], axis=1) for name in self.metrics.names}

    def name(self, row: int) -> str:
        """Return a member in words."""
        return f"member {row}"

    def dataset(self, arrays: Mapping[str, np.ndarray]) -> xr.Dataset:
        """Return what all rows gave, as `tuning.searches.robust.judge` does."""
        return robust.labelled(self.scenario, [*self.gains, PD], self.ensemble, self.numbers, arrays, self.metrics)

    def identity(self) -> dict[str, Any]:
        """Return all that determines the numbers of a row, bit by bit."""
        values = {
            name: {key: np.asarray(value, float).tolist() for key, value in by_name(gains).items()}
            for name, gains in self.gains.items()
        }
        return {
            "kind": KIND,
            "scenario": yaml.safe_load(scenario_files.identity(self.scenario)),
            "law": None if self.law is None else identity.identity(self.law, "law"),
            "gains": {
                name: {key: np.asarray(v, float).tolist() for key, v in own.items()} for name, own in values.items()
            },
            "ensemble": self.ensemble.model_dump(mode="json"),
            "metrics": identity.of_metrics(self.metrics),
            "engine": self.engine,
            "batch_size": self.size,
            **identity.of_surroundings(self.scenario),
        }
