"""What a launcher of many processes says of this one in the environment."""

import os
import re
from typing import NamedTuple

from tuning.command_line.ending import InputError

SHARD = "I/N"
_ARRAY = "SLURM_ARRAY_TASK_"


class Process(NamedTuple):
    """One of several processes that a launcher started for one command."""

    number: int  # from 0
    of: int  # how many
    address: str | None  # host:port of process 0, None where JAX finds it
    said: str  # who says so


def process() -> Process | None:
    """Return which process this is where a launcher started several, None for a lone one.

    JAX's variables come first: a count of 1 there keeps processes apart that another launcher started.

    Raises:
        InputError: variables that do not fit together.
    """
    for said, size, rank, there in (
        ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID", "JAX_NUM_PROCESSES"),
        ("Slurm step", "SLURM_STEP_NUM_TASKS", "SLURM_PROCID", "SLURM_STEP_NODELIST"),
        ("Open MPI", "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ):
        if there not in os.environ:
            continue
        count = _number(size)
        if count == 1:
            return None
        if (number := _number(rank)) >= count:
            raise InputError(f"{rank}: expected a number below the {count} of {size}, got {number}")
        address = os.environ.get("JAX_COORDINATOR_ADDRESS")
        if address is None and not _found_by_jax():
            raise InputError(
                f"JAX_COORDINATOR_ADDRESS: expected host:port of process 0 beside {size}={count}, got none"
            )
        return Process(number, count, address, said)
    return None


def _found_by_jax() -> bool:
    """Return whether JAX finds out by itself where process 0 is."""
    slurm = ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID")
    return "OMPI_MCA_orte_hnp_uri" in os.environ or all(name in os.environ for name in slurm)


def _number(name: str, default: str = "") -> int:
    text = os.environ.get(name, default)
    if not re.fullmatch("[0-9]{1,9}", text):
        raise InputError(f"{name}: expected a whole number, got {text!r}")
    return int(text)


def shard_from(text: str | None) -> tuple[tuple[int, int] | None, str]:
    """Return which shard a command walks and how many there are, None for all, and where that comes from in words.

    Without `--shard`, a Slurm array's tasks are the shards.

    Raises:
        InputError: no shard, or an array whose tasks are not numbered one by one.
    """
    if text is not None:
        shard = _typed(text)
        return (None, "all shards") if shard == (1, 1) else (shard, f"shard {text}")
    if f"{_ARRAY}ID" not in os.environ:
        return None, ""
    number, count = _of_array()
    return (number, count), f"shard {number}/{count}, this task of a Slurm array"


def _typed(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard: expected {SHARD} with I from 1 to N, as 3/16, got {text!r}")
    return int(found[1]), int(found[2])


def _of_array() -> tuple[int, int]:
    """Return number and count of this task among those of its array."""
    task, first, last, count = (_number(f"{_ARRAY}{name}") for name in ("ID", "MIN", "MAX", "COUNT"))
    step = _number(f"{_ARRAY}STEP", "1")
    steps, rest = divmod(task - first, max(step, 1))
    if rest or first + (count - 1) * step != last or not 0 <= steps < count or count == 1:
        raise InputError(
            f"{_ARRAY}ID: expected several tasks without gaps, got {count} from {first} to {last}: which shard this "
            "one walks, as 3/16, or 1/1 for all, is for --shard to say"
        )
    return steps + 1, count
