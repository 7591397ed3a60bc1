"""Do the fast paths work on this machine? A small function goes by each of them in a process of its own.

The fast paths lean on parts of JAX and XLA that promise nothing, and where these fail they stop the process. So before
a path is first taken a process of its own takes it, and compares with XLA's plain one. The verdict is kept in the
cache's folder until anything changes that it rests on. Where it is bad, all goes by the plain path, and a warning says
so.
"""

import contextlib
import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax

from mjx_climb.execution import trial
from mjx_climb.execution.cache import cache_folder, machine, source_digest
from mjx_climb.files.writing import OutputError, write_text_atomically

PATHS = {"regions": "the CPU's regions", "kernel": "the GPU kernel"}
_WAITING = {path: threading.Lock() for path in PATHS}
_TRIAL = "from mjx_climb.execution import trial; trial.take({!r})"
_PATIENCE = 300.0  # s, for a process that starts, imports JAX and compiles some hundred operations on a busy machine
_CRASHES = (signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV)  # not somebody's wish


class Verdict(NamedTuple):
    """Whether a path works on this machine, and what was seen."""

    works: bool
    seen: str  # in a few words


def begin() -> None:
    """Begin the trials that this machine's walks will ask for and that nothing is known of: other things go on beside.

    Where nobody asks, a trial comes to its end by itself and leaves no verdict.
    """
    needed = {"cpu": ("regions",), "gpu": tuple(PATHS)}.get(jax.default_backend(), ())
    for path in needed:
        file = _file(path)
        if file is None or not file.exists():
            with contextlib.suppress(OSError):  # who asks is told
                _trial(path)


@functools.cache
def works(path: str) -> bool:
    """Return whether one of `PATHS` works on this machine, and warn once where it does not; see `verdict`.

    Where there is a GPU, all paths are needed: they are tried side by side.
    """
    if jax.default_backend() == "gpu":
        with ThreadPoolExecutor(len(PATHS)) as threads:
            list(threads.map(_alone, PATHS))
    found = _alone(path)
    if not found.works:
        warnings.warn(f"{PATHS[path]} cannot be used here ({found.seen}): walking by XLA's own, slower", stacklevel=3)
    return found.works


def _alone(path: str) -> Verdict:
    """Return the verdict of a path, which one thread at a time asks for."""
    with _WAITING[path]:
        return verdict(path)


@functools.cache
def verdict(path: str) -> Verdict:
    """Return whether a path works on this machine: from the cache's folder where it is known there, else by a trial."""
    kept = _file(path)
    if kept is not None:
        try:
            told = json.loads(kept.read_text())
            return Verdict(bool(told["works"]), str(told["seen"]))
        except (OSError, ValueError, KeyError, TypeError):
            pass  # not there, or not what was written: tried again
    found, lasting = _tried(path)
    if kept is not None and lasting:
        _keep(found, kept)
    return found


def _file(path: str) -> Path | None:
    """Return where the verdict of a path is kept, None where there is no cache."""
    folder = cache_folder()
    if folder is None:
        return None
    made_of = repr([path, source_digest(Path(__file__).parent), machine()])
    return folder / "probes" / (hashlib.sha256(made_of.encode()).hexdigest() + ".json")


def _keep(found: Verdict, file: Path) -> None:
    with contextlib.suppress(OutputError):  # no room, no rights: tried again in the next process
        write_text_atomically(file, json.dumps(found._asdict()))


@functools.cache
def _trial(path: str) -> subprocess.Popen[str]:
    """Start the process that tries a path.

    Raises:
        OSError: it does not start.
    """
    packages = str(Path(__file__).parents[2])
    found = os.environ.get("PYTHONPATH")
    environment = os.environ | {
        "PYTHONPATH": packages if not found else os.pathsep.join([packages, found]),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # this process may have the GPU's memory
        "JAX_ENABLE_COMPILATION_CACHE": "false",  # what is tried is the compiler
        "JAX_TRACEBACK_FILTERING": "off",  # its last line is what went wrong
    }
    return subprocess.Popen(
        [sys.executable, "-c", _TRIAL.format(path)],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for this process
    )


def _tried(path: str) -> tuple[Verdict, bool]:
    """Return the verdict of a process of its own, and whether the next one would come to the same."""
    try:
        process = _trial(path)
        with process:
            try:
                out, errors = process.communicate(timeout=_PATIENCE)
            except BaseException:
                process.kill()
                raise
    except (OSError, subprocess.TimeoutExpired) as error:
        return Verdict(False, f"no trial: {type(error).__name__}"), False
    said = (out.strip() or errors.strip()).splitlines()[-1:] or [""]
    code = process.returncode
    if code == 0 and said == [trial.SAME]:
        return Verdict(True, "tried, and compared with XLA's own"), True
    if code < 0:
        stopped_by = signal.Signals(-code)
        return Verdict(False, f"a trial was stopped by {stopped_by.name}"), stopped_by in _CRASHES
    return Verdict(False, f"a trial failed: {said[0][:200]}"), True
