"""The walks of gains on worse hardware, one thing at a time."""

import dataclasses

from tuning.results.result import Result


@dataclasses.dataclass(frozen=True)
class Degraded(Result):
    """The walks of several gains, and of pd, through the same unseen members as drawn and with worse hardware.

    `data` holds every metric over `setting` (the first one as drawn), `gains` (the names, `pd` last) and `member`.
    """

    FILE = "degraded.nc"
    KIND = "degrade"
