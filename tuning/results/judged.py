"""The walks of gains, or of laws, through members of an ensemble that no search has seen."""

import dataclasses
from collections.abc import Mapping

from tuning.results.result import Result
from tuning.results.tuned import Tuned


@dataclasses.dataclass(frozen=True)
class Judged(Result):
    """The walks of several gains, and of pd, through members of an ensemble that no search of it has seen.

    `data` holds every metric of every walk over `gains` (the names, `pd` last) and `member`; with what was drawn.
    """

    FILE = "judged.nc"
    KIND = "judge"


@dataclasses.dataclass(frozen=True)
class Comparison(Result):
    """Laws that were tuned alike, and their walks through members of an ensemble that no search has seen.

    `data` holds every metric of every walk over `gains` (the laws, pd retuned, that on better hardware, and the
    scenario's pd) and `member`, as of `tuning.judge`. `write` adds which differences from retuned pd are real.
    """

    FILE = "compared.nc"
    KIND = "compare"

    tuned: Mapping[str, Tuned] = dataclasses.field(default_factory=dict)  # by law, `retuned_pd` the last

    @property
    def laws(self) -> list[str]:
        """The names of the laws, without pd's."""
        return [*self.tuned][:-1]

    @property
    def hardware(self) -> list[str]:
        """The names of the walks of retuned pd with better hardware."""
        return [name for name in self.data["gains"].values.tolist() if name not in {*self.tuned, "pd"}]
