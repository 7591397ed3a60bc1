"""Do the fast paths work on this machine? A small function goes by each of them in a process of its own.

The fast paths lean on parts of JAX and XLA that promise nothing, and where these fail they stop the process. So before
a path is first taken a process of its own takes it, and compares with XLA's plain one. The verdict is kept in the
cache's folder until anything changes that it rests on. Where it is bad, all goes by the plain path, and a warning says
so.
"""

import functools
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax

from mjx_climb.compilation import trial
from mjx_climb.compilation.cache import cache_folder
from mjx_climb.compilation.machine import machine, source_digest

PATHS = {"pieces": "the CPU's pieces", "kernel": "the GPU kernel"}
_WAITING = {path: threading.Lock() for path in PATHS}
_TRIAL = "from mjx_climb.compilation import trial; trial.take({!r})"
_PATIENCE = 300.0  # s, for a process that starts, imports JAX and compiles some hundred operations on a busy machine
_CRASHES = (signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV)  # not somebody's wish


class Verdict(NamedTuple):
    """Whether a path works on this machine, and what was seen."""

    works: bool
    seen: str  # in a few words


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
    folder = cache_folder()
    kept = None if folder is None else folder / "probes" / _key(path)
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


def _key(path: str) -> str:
    return hashlib.sha256(repr([path, source_digest(Path(__file__).parent), machine()]).encode()).hexdigest() + ".json"


def _keep(found: Verdict, file: Path) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=file.parent, delete=False) as whole:
            json.dump(found._asdict(), whole)
        os.replace(whole.name, file)
    except OSError:
        pass  # no room, no rights: tried again in the next process


def _tried(path: str) -> tuple[Verdict, bool]:
    """Return the verdict of a process of its own, and whether the next one would come to the same."""
    packages = str(Path(__file__).parents[2])
    found = os.environ.get("PYTHONPATH")
    environment = os.environ | {
        "PYTHONPATH": packages if not found else os.pathsep.join([packages, found]),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # this process may have the GPU's memory
        "JAX_ENABLE_COMPILATION_CACHE": "false",  # what is tried is the compiler
        "JAX_TRACEBACK_FILTERING": "off",  # its last line is what went wrong
    }
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRIAL.format(path)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            start_new_session=True,  # Ctrl-C is for this process
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Verdict(False, f"no trial: {type(error).__name__}"), False
    said = (done.stdout.strip() or done.stderr.strip()).splitlines()[-1:] or [""]
    if done.returncode == 0 and said == [trial.SAME]:
        return Verdict(True, "tried, and compared with XLA's own"), True
    if done.returncode < 0:
        stopped_by = signal.Signals(-done.returncode)
        return Verdict(False, f"a trial was stopped by {stopped_by.name}"), stopped_by in _CRASHES
    return Verdict(False, f"a trial failed: {said[0][:200]}"), True
