"""One command in several processes of `jax.distributed`: all of them walk, process 0 alone reads, writes and prints.

Every process runs the same program on the same input, so that all come to the same calls in the same order: what a
batch gives is the same in each. The others write to a folder that is removed at the end, and to no terminal.
"""

import contextlib
import hashlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tuning.command_line import interruption, launcher
from tuning.command_line.ending import InputError, user_error
from tuning.command_line.typed import ARGUMENTS

if TYPE_CHECKING:
    import mjx_climb as mc

_LONGEST = 1000  # bytes of a message from one process to the others
PATIENCE = 300  # s, until all processes must have met


class Team:
    """The processes that walk together, as one of them sees it; `process` None is the only one."""

    def __init__(self, process: launcher.Process | None, temporary: Path):
        self.said = "" if process is None else f"{process.of} processes, {process.said}"  # for the announcement
        self.heard = process is None  # what the others had to say before they walk
        self._process, self._temporary = process, temporary

    def folder(self, out: Path) -> Path:
        """Return the folder to write to in place of `out`."""
        return self._temporary / "out" if self._process and self._process.number else out

    def begin(self, kept: Path, scenario: "mc.Scenario") -> None:
        """Begin to walk, all together: with the same input, and with the parts that process 0 has in `kept`.

        Raises:
            InputError: something is wrong in another process.
        """
        if self._process is None:
            return
        self.heard = True
        asked = repr((ARGUMENTS.get(), scenario.to_yaml()))
        self.agree(hashlib.sha256(asked.encode()).digest())
        import tarfile

        archive = _from_first(b"" if self._process.number else _packed(kept / "parts"))
        if self._process.number and archive:
            with tarfile.open(fileobj=io.BytesIO(archive)) as files:
                files.extractall(kept / "parts", filter="data")

    def agree(self, digest: bytes, problem: str = "") -> None:
        """Hear from all processes what they were asked, and what went wrong there.

        Raises:
            InputError: of another process, that something went wrong or that it was asked for something else.
        """
        import numpy as np
        from jax.experimental import multihost_utils

        assert self._process is not None
        told = np.zeros(len(digest) + _LONGEST, np.uint8)
        text = digest + problem.encode()[:_LONGEST]
        told[: len(text)] = np.frombuffer(text, np.uint8)
        for number, row in enumerate(np.asarray(multihost_utils.process_allgather(told))):
            message = row[len(digest) :].tobytes().rstrip(b"\0").decode(errors="replace")
            if message and number != self._process.number:
                raise InputError(message if problem else f"process {number}: {message}")
            if not problem and row[: len(digest)].tobytes() != digest:
                raise InputError(f"process {number}: expected the same command and config in all processes")


@contextlib.contextmanager
def joined(apart: bool = False) -> Iterator[Team]:
    """Join the other processes, where a launcher started several and they are not to walk apart.

    Raises:
        InputError: they do not meet.
    """
    process = None if apart else launcher.process()
    with contextlib.ExitStack() as stack:
        if process is None:
            start_devices()
            yield Team(None, Path())
            return
        import tempfile

        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mjx_climb-")))
        stack.enter_context(_own_output())
        _meet(process)
        team = Team(process, temporary)
        if process.number:
            _be_silent()
        try:
            yield team
        except Exception as error:
            if not team.heard and not interruption.requested():  # the others wait to hear
                with contextlib.suppress(InputError):
                    team.agree(bytes(32), user_error(error) or f"{type(error).__name__}: {error}")
            raise


def start_devices() -> None:
    """Begin to start what the command will walk on, before the rest is imported."""
    from mjx_climb.execution import devices

    devices.begin()


def several() -> bool:
    """Return whether this process walks beside others."""
    if "jax" not in sys.modules:
        return False
    import jax

    return jax.distributed.is_initialized()


def leave(code: int) -> None:
    """End this process at once where others would wait for it, or it for them, as something went wrong."""
    if code and several():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _meet(process: launcher.Process) -> None:
    import jax

    jax.config.update("jax_enable_preemption_service", False)  # it would take SIGTERM for itself
    try:
        jax.distributed.initialize(process.address, process.of, process.number, initialization_timeout=PATIENCE)
        jax.devices()
    except (RuntimeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"'{process.said}': expected {process.of} processes that meet, got {reason} "
            f"(JAX_NUM_PROCESSES=1 lets each walk alone)"
        ) from None


@contextlib.contextmanager
def _own_output() -> Iterator[None]:
    """Keep standard output for this program: libraries that connect processes greet each other there."""
    sys.stdout.flush()
    with open(os.dup(1), "w") as own, contextlib.redirect_stdout(own):
        _to_nowhere(1)
        yield


def _be_silent() -> None:
    sys.stderr.flush()
    _to_nowhere(sys.stdout.fileno())
    _to_nowhere(2)


def _to_nowhere(stream: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream)
    os.close(nowhere)


def _packed(folder: Path) -> bytes:
    """Return a folder with all below it as an archive, nothing where there is none."""
    if not folder.is_dir():
        return b""
    import tarfile

    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as files:
        for file in sorted(folder.iterdir()):
            files.add(file, file.name)
    return buffer.getvalue()


def _from_first(content: bytes) -> bytes:
    """Return what process 0 gives."""
    import numpy as np
    from jax.experimental import multihost_utils

    size = int(multihost_utils.broadcast_one_to_all(np.array(len(content), np.int32)))
    if not size:
        return b""
    whole: np.ndarray = np.zeros(size, np.uint8)
    whole[: len(content)] = np.frombuffer(content, np.uint8)
    return bytes(np.asarray(multihost_utils.broadcast_one_to_all(whole)).tobytes())
