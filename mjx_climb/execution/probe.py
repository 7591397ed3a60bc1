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
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.execution import devices, gpu_kernel, one_robot
from mjx_climb.execution.cache import cache_folder, machine, source_digest
from mjx_climb.execution.gpu_kernel import tangents_over_robots
from mjx_climb.files.writing import OutputError, write_text_atomically

PATHS = {"regions": "the CPU's regions", "kernel": "the GPU kernel"}
_WAITING = threading.Lock()
_TRIAL = "from mjx_climb.execution import probe; probe.take({!r})"
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
    with _WAITING:  # shares of a batch come from several threads
        if jax.default_backend() == "gpu":
            begin()
            for each in PATHS:
                verdict(each)
        found = verdict(path)
    if not found.works:
        warnings.warn(f"{PATHS[path]} cannot be used here ({found.seen}): walking by XLA's own, slower", stacklevel=3)
    return found.works


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
        with contextlib.suppress(OutputError):  # no room, no rights: tried again in the next process
            write_text_atomically(kept, json.dumps(found._asdict()))
    return found


def _file(path: str) -> Path | None:
    """Return where the verdict of a path is kept, None where there is no cache."""
    folder = cache_folder()
    if folder is None:
        return None
    made_of = repr([path, source_digest(Path(__file__).parent), machine()])
    return folder / "probes" / (hashlib.sha256(made_of.encode()).hexdigest() + ".json")


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
    if code == 0 and said == [SAME]:
        return Verdict(True, "tried, and compared with XLA's own"), True
    if code < 0:
        stopped_by = signal.Signals(-code)
        return Verdict(False, f"a trial was stopped by {stopped_by.name}"), stopped_by in _CRASHES
    return Verdict(False, f"a trial failed: {said[0][:200]}"), True


# --- what the process does: a small motion by a fast path and by the plain one, compared

SAME = "the same"
_ROBOTS, _STEPS = 5, 3
_TOLERANCE = {np.float32: 1e-4, np.float64: 1e-12}  # relative to the largest value


def take(path: str) -> None:
    """Take a path, "regions" or "kernel", and print `SAME`, or how far it was off.

    In each of its precisions it is compared with the plain one in the first of them.
    """
    jax.config.update("jax_enable_x64", True)
    fast, plain, precisions = _MOTIONS[path]
    states = [np.linspace(0.1, 0.9, 6 * _ROBOTS).reshape(_ROBOTS, 6).astype(dtype) for dtype in precisions]
    with ThreadPoolExecutor(1 + len(states)) as threads:  # the first walk on a machine waits for this
        exact = threads.submit(plain, states[0])
        moved = list(threads.map(fast, states))
    for dtype, found in zip(precisions, moved, strict=True):
        for mine, expected in zip(jax.tree.leaves(found), jax.tree.leaves(exact.result()), strict=True):
            off = float(np.abs(np.asarray(mine) - np.asarray(expected)).max() / np.abs(expected).max())
            if not off <= _TOLERANCE[dtype]:
                print(f"{off:.1g} off in {dtype.__name__}")
                return
    print(SAME)


def _in_regions(state: np.ndarray) -> Any:
    """Return the motion of a batch and its forward derivative, in regions."""
    return _moved(one_robot.over_robots(_motion), state)


def _whole(state: np.ndarray) -> Any:
    """Return the same as XLA does it."""
    return _moved(_motion, state)


def _moved(motion: Callable[[Array], Any], state: np.ndarray) -> Any:
    batch = jax.vmap(motion)
    with devices.on_host():  # regions are a CPU's
        return jax.jit(lambda first: jax.jvp(batch, (first,), (jnp.ones_like(first),)))(state)


def _motion(first: Array) -> Any:
    return jax.lax.scan(_step, first, length=_STEPS)


def _kernels(state: np.ndarray) -> Any:
    """Return the motion of two limbs that pull at each other, and its tangents, by kernels."""
    directions, limbs = _two_limbs(state)
    sloped = jax.jit(tangents_over_robots(_pulled, [True]))(directions, limbs)
    return jax.jit(gpu_kernel.over_robots(_pulled, [True]))(limbs), *sloped


def _mapped(state: np.ndarray) -> Any:
    """Return the same as XLA does it."""

    def tangents(first: Array, along: Array) -> Any:
        return jax.vmap(lambda rate: jax.jvp(_pulled, (first,), (rate,))[1])(along)

    directions, limbs = _two_limbs(state)
    motion = jax.jit(jax.vmap(_pulled))(limbs)
    return motion, motion, jax.jit(jax.vmap(tangents))(limbs, directions)


def _two_limbs(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions of two limbs' states, and the states: (robots, 2, 6, 2, 1) and (robots, 6, 2, 1)."""
    limbs = np.stack([state, state[:, ::-1]], 2)[..., None]
    return np.stack([np.cos(limbs), np.sin(limbs)], 1), limbs


def _pulled(first: Array) -> Any:
    def moved(now: Array, _: None) -> tuple[Array, None]:
        after = _step(now, None)[0]
        return after - 0.01 * after.sum(1, keepdims=True), None

    return jax.lax.scan(moved, first, length=_STEPS)[0]


_MOTIONS = {"regions": (_in_regions, _whole, (np.float64, np.float32)), "kernel": (_kernels, _mapped, (np.float32,))}


def _step(state: Array, _: None) -> tuple[Array, Array]:
    """Return three angles and rates (6, ...) a moment later, and their sum: a sample of what a walk is made of."""
    angle, rate = state[:3], state[3:]
    held = jnp.where(angle > 0.5, 0.1 * rate, jnp.minimum(rate, 0.3))
    mass = 2 + jnp.cos(angle)
    load = jnp.concatenate([angle[1:], angle[:1]]) * jnp.sin(angle)
    lever = jnp.stack([mass[0] * load[1], mass[1] * load[2], mass[2] * load[0]])
    rate = held - 0.01 * (lever / jnp.sqrt(mass**2 + 0.1) + jnp.exp(-rate) * jnp.arctan2(angle, mass))
    after = jnp.concatenate([angle + 0.01 * rate, rate])
    return after, after.sum(0)
