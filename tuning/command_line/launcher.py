"""What a launcher of many processes says of this one in the environment."""

import os
import re
from collections.abc import Mapping

from tuning.command_line.ending import InputError

SHARD = "I/N"
_ARRAY = "SLURM_ARRAY_TASK_"


def shard_from(text: str | None) -> tuple[tuple[int, int] | None, str]:
    """Return which shard a command walks and how many there are, None for all, and where that comes from in words.

    Without `--shard`, a Slurm array's tasks are the shards.

    Raises:
        InputError: no shard, or an array whose tasks are not numbered one by one.
    """
    if text is not None:
        return _only_of_several(_typed(text)), f"shard {text}"
    if f"{_ARRAY}ID" not in os.environ:
        return None, ""
    number, count = _of_array(os.environ)
    return _only_of_several((number, count)), f"shard {number}/{count}, this task of a Slurm array"


def _only_of_several(shard: tuple[int, int]) -> tuple[int, int] | None:
    return None if shard == (1, 1) else shard


def _typed(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard: expected {SHARD} with I from 1 to N, as 3/16, got {text!r}")
    return int(found[1]), int(found[2])


def _of_array(environment: Mapping[str, str]) -> tuple[int, int]:
    """Return number and count of this task among those of its array."""
    values = {}
    for name in ("ID", "MIN", "MAX", "COUNT", "STEP"):
        text = environment.get(_ARRAY + name, "1" if name == "STEP" else "")
        if not re.fullmatch("[0-9]{1,9}", text):
            raise InputError(f"{_ARRAY}{name}: expected a whole number beside {_ARRAY}ID, got {text!r}")
        values[name] = int(text)
    steps, rest = divmod(values["ID"] - values["MIN"], max(values["STEP"], 1))
    last = values["MIN"] + (values["COUNT"] - 1) * values["STEP"]
    if rest or last != values["MAX"] or not 0 <= steps < values["COUNT"]:
        raise InputError(
            f"{_ARRAY}ID: expected an array of tasks without gaps, got {values['COUNT']} tasks from {values['MIN']} to "
            f"{values['MAX']}: which shard each one walks, as 3/16, is for --shard to say"
        )
    return steps + 1, values["COUNT"]
