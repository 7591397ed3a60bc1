"""One command in several processes: of `jax.distributed` all walk together, of a Slurm array each has its shard.

Together every process runs the same program on the same input, so that all come to the same calls in the same order:
the results of a batch are the same in each. Process 0 alone reads, writes and prints. The others write to a folder that
is removed at the end, and to no terminal.
"""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tuning.command_line import interruption
from tuning.command_line.program import ARGUMENTS, InputError, user_error

SHARD = "I/N"
_ARRAY = "SLURM_ARRAY_TASK_"
# with these JAX finds out by itself where process 0 is
_OF_SLURM = ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID")
_LONGEST = 1000  # bytes of a message from one process to the others
PATIENCE = 300  # s, until all processes must have met


class Process(NamedTuple):
    """One of several processes that a launcher started for one command."""

    number: int  # from 0
    of: int  # how many
    address: str | None  # host:port of process 0, None where JAX finds it
    said: str  # who says so


def process() -> Process | None:
    """Return which process this is where a launcher started several, None for a lone one.

    JAX's variables come first: a count of 1 there keeps processes apart that another launcher started.
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
        found_by_jax = "OMPI_MCA_orte_hnp_uri" in os.environ or all(name in os.environ for name in _OF_SLURM)
        if address is None and not found_by_jax:
            expected = f"expected host:port of process 0 beside {size}={count}"
            raise InputError(f"JAX_COORDINATOR_ADDRESS: {expected}, got none")
        return Process(number, count, address, said)
    return None


def _number(name: str, default: str = "") -> int:
    text = os.environ.get(name, default)
    if not re.fullmatch("[0-9]{1,9}", text):
        raise InputError(f"{name}: expected a whole number, got {text!r}")
    return int(text)


def shard_from(text: str | None) -> tuple[tuple[int, int] | None, str]:
    """Return which shard a command walks and how many there are, None for all, and where that comes from in words.

    Without `--shard`, a Slurm array's tasks are the shards.
    """
    if text is not None:
        found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise InputError(f"--shard: expected {SHARD} with I from 1 to N, as 3/16, got {text!r}")
        shard = int(found[1]), int(found[2])
        return (None, "all shards") if shard == (1, 1) else (shard, f"shard {text}")
    if f"{_ARRAY}ID" not in os.environ:
        return None, ""
    task, first, last, count = (_number(f"{_ARRAY}{name}") for name in ("ID", "MIN", "MAX", "COUNT"))
    step = _number(f"{_ARRAY}STEP", "1")
    steps, rest = divmod(task - first, max(step, 1))
    if rest or first + (count - 1) * step != last or not 0 <= steps < count or count == 1:
        raise InputError(
            f"{_ARRAY}ID: expected several tasks without gaps, got {count} from {first} to {last}: which shard this "
            "one walks, as 3/16, or 1/1 for all, is for --shard to say"
        )
    return (steps + 1, count), f"shard {steps + 1}/{count}, this task of a Slurm array"


class Team:
    """The processes that walk together, as one of them sees it; `process` None is the only one."""

    def __init__(self, process: Process | None, temporary: Path):
        self.said = "" if process is None else f"{process.of} processes, {process.said}"  # for the announcement
        self.heard = process is None  # whether the others have reported before they walk
        self._process, self._temporary = process, temporary

    def folder(self, out: Path) -> Path:
        """Return the folder to write to in place of `out`."""
        return self._temporary / "out" if self._process and self._process.number else out

    def begin(self, kept: Path, asked: object) -> None:
        """Begin to walk, all together: asked for the same, and with the parts that process 0 has in `kept`."""
        if self._process is None:
            return
        import hashlib
        import tarfile

        import numpy as np
        from jax.experimental import multihost_utils

        self.heard = True
        self.agree(hashlib.sha256(repr((ARGUMENTS.get(), asked)).encode()).digest())
        buffer, folder = io.BytesIO(), kept / "parts"
        if self._process.number == 0 and folder.is_dir():
            with tarfile.open(fileobj=buffer, mode="w") as files:
                files.add(folder, "parts")
        content = buffer.getvalue()  # which process 0 sends, first its length
        size = int(multihost_utils.broadcast_one_to_all(np.array(len(content), np.int32)))
        if not size:
            return
        whole = np.frombuffer(content.ljust(size, b"\0"), np.uint8)
        archive = np.asarray(multihost_utils.broadcast_one_to_all(whole)).tobytes()
        if self._process.number:
            with tarfile.open(fileobj=io.BytesIO(archive)) as files:
                files.extractall(kept, filter="data")

    def agree(self, digest: bytes, problem: str = "") -> None:
        """Hear from all processes their command and their errors: InputError where there is one."""
        import numpy as np
        from jax.experimental import multihost_utils

        assert self._process is not None
        told = np.frombuffer((digest + problem.encode()[:_LONGEST]).ljust(len(digest) + _LONGEST, b"\0"), np.uint8)
        for number, row in enumerate(np.asarray(multihost_utils.process_allgather(told))):
            message = row[len(digest) :].tobytes().rstrip(b"\0").decode(errors="replace")
            if message and number != self._process.number:
                raise InputError(message if problem else f"process {number}: {message}")
            if not problem and row[: len(digest)].tobytes() != digest:
                raise InputError(f"process {number}: expected the same command and config in all processes")


@contextlib.contextmanager
def devices_begun() -> Iterator[None]:
    """Begin to start JAX's devices, and to load what this command needed the last time, for the same config."""
    from mjx_climb.execution import cache, devices

    devices.begin()
    with cache.loading_ahead(" ".join(ARGUMENTS.get()[:2])):
        yield


@contextlib.contextmanager
def joined(apart: bool = False) -> Iterator[Team]:
    """Join the other processes, where a launcher started several and they are not to walk apart."""
    own = None if apart else process()
    with contextlib.ExitStack() as stack:
        if own is None:
            stack.enter_context(devices_begun())  # before the rest is imported
            yield Team(None, Path())
            return
        import tempfile

        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mjx_climb-")))
        # libraries that connect processes greet each other on standard output: it is kept for this program
        sys.stdout.flush()
        stdout = stack.enter_context(open(os.dup(1), "w"))
        stack.enter_context(contextlib.redirect_stdout(stdout))
        _to_nowhere(1)
        import jax

        jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM for itself
        try:
            jax.distributed.initialize(own.address, own.of, own.number, initialization_timeout=PATIENCE)
            jax.devices()
        except (RuntimeError, ValueError) as error:
            reason, expected = str(error).partition("\n")[0], f"'{own.said}': expected {own.of} processes that meet"
            raise InputError(f"{expected}, got {reason} (JAX_NUM_PROCESSES=1 lets each walk alone)") from None
        team = Team(own, temporary)
        if own.number:
            sys.stderr.flush()
            _to_nowhere(sys.stdout.fileno())
            _to_nowhere(2)
        try:
            yield team
        except Exception as error:
            if not team.heard and not interruption.requested():  # the others wait to hear
                with contextlib.suppress(InputError):
                    team.agree(bytes(32), user_error(error) or f"{type(error).__name__}: {error}")
            raise


def several() -> bool:
    """Return whether this process walks beside others."""
    return "jax" in sys.modules and sys.modules["jax"].distributed.is_initialized()


def _to_nowhere(stream: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream)
    os.close(nowhere)
