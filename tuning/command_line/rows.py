"""The rows of a grid or of a draw that one process walks: all of them, or a shard's."""

import shlex
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING

from tuning.command_line.ending import Kept
from tuning.command_line.typed import typed_but

if TYPE_CHECKING:
    import numpy as np

    from tuning.command_line.progress import Session
    from tuning.searches.shards import Work


class Rows:
    """Rows of a work, and the folder that keeps those that are finished."""

    def __init__(self, work: "Work", out: Path, shard: tuple[int, int] | None, name: str, again: str = ""):
        """Claim the folder: `out`, or the shard's below it; name and `again` are for the report of a merge.

        Raises:
            ConfigError, OutputError: more shards than rows, or a folder that cannot be used.
        """
        from tuning.searches.shards import SHARD, Rows

        self._out = out
        self._rows = Rows(work, out, shard, {"again": typed_but("--shard", SHARD), "name": name, "repeat": again})
        self.shard, self.folder = self._rows.shard, self._rows.folder or out
        self.here, self.there = len(self._rows.rows), self._rows.there
        self.kept_already = f"{self.there} are there already" if self.there else ""

    def walk(self, shell: "Session", kept: Kept, stage: str, unit: str) -> "dict[str, np.ndarray] | None":
        """Walk what is not there yet and return the arrays of all rows; None of a shard, and say what comes next."""
        with shell.stage(stage, unit=unit) as show:
            arrays = self._rows.walk(kept.counting(show))
        if self.shard is None:
            return arrays
        merge = f"mjx-climb merge {shlex.quote(str(self._out))}"
        shell.say(f"{self.folder} is whole; once all {self.shard.count} are: {merge}")
        shell.print_json(dumps({"shard": self.shard.number, "of": self.shard.count, unit: self.here}))
        return None
