"""The walks of gains, or of laws, through members of an ensemble that no search has seen; on worse hardware too."""

import dataclasses
from collections.abc import Mapping, Sequence

from tuning.results.result import Result
from tuning.results.tuned import Tuned


@dataclasses.dataclass(frozen=True)
class Judged(Result):
    """The walks of several gains, and of pd, through members of an ensemble that no search of it has seen.

    `data` holds every metric of every walk over `gains` (the names, `pd` last) and `member`; with the drawn values.
    """

    FILE = "judged.nc"
    KIND = "evaluate"


@dataclasses.dataclass(frozen=True)
class Degraded(Result):
    """The walks of several gains, and of pd, through the same unseen members as drawn and with worse hardware.

    `data` holds every metric over `setting` (the first one as drawn), `gains` (the names, `pd` last) and `member`.
    """

    FILE = "degraded.nc"
    KIND = "degrade"


@dataclasses.dataclass(frozen=True)
class Comparison(Result):
    """Laws that were tuned alike, and their walks through members of an ensemble that no search has seen.

    `data` holds every metric of every walk over `gains` (the laws, pd retuned, that on better hardware, and the
    scenario's pd), `seed` of their searches and `member`, as of `tuning.evaluate`; and the result of each search, where
    it was one. `write` adds which differences from retuned pd are real.
    """

    FILE = "compared.nc"
    KIND = "compare"

    searched: Mapping[str, Sequence[Tuned]] = dataclasses.field(default_factory=dict)  # by law, pd the last, and seed

    @property
    def tuned(self) -> dict[str, Tuned]:
        """The best search of each law, `retuned_pd` the last."""
        return {law: min(each, key=lambda own: (not own.feasible, own.value)) for law, each in self.searched.items()}

    @property
    def outside(self) -> list[str]:
        """The names of the laws with a search that found no gains within its limits, pd among them."""
        return [law for law, each in self.searched.items() if not all(own.feasible for own in each)]

    @property
    def unsettled(self) -> list[str]:
        """The names of the laws with a search that had not converged when it ended, pd among them."""
        return [law for law, each in self.searched.items() if not all(own.converged for own in each)]

    @property
    def laws(self) -> list[str]:
        """The names of the laws, without pd's."""
        return [*self.searched][:-1]

    @property
    def hardware(self) -> list[str]:
        """The names of the walks of retuned pd with better hardware."""
        return [name for name in self.data["gains"].values.tolist() if name not in {*self.searched, "pd"}]
