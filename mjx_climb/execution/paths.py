"""Which path carries a batch out, and where; whether the fast ones work on this machine; the plain one where not.

The fast paths lean on parts of JAX and XLA that promise nothing, and where these fail they stop the process. So before
a path is first taken a process of its own takes it, and compares with XLA's plain one. The verdict is kept in the
cache's folder until anything changes that it rests on. Where it is bad, all goes by the plain path, and a warning says
so, as where a fast path has no rule for an operation.
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
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.errors import JaxRuntimeError
from numpy.typing import DTypeLike

from mjx_climb.execution import gpu_kernel
from mjx_climb.execution.cache import cache_folder, machine, source_digest, write_whole
from mjx_climb.execution.devices import on_host
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.jax_internals import LEVEL, WIDTH
from mjx_climb.execution.one_robot import over_robots
from mjx_climb.execution.refused import Refused

PATHS = {"regions": "the CPU's regions", "kernel": "the GPU kernel"}
ON_CPU = "MJX_CLIMB_ON_CPU"  # the variable that says up to how many robots go to the CPU although there is a GPU
# Robots, times one and the tangents of each, that a few CPU cores simulate as soon as an H200: 8 s of any few take it
# 0.04 s by the kernel, and 1.4 s by XLA's own.
_AS_THE_KERNEL, _AS_LAUNCHES = 8, 64
AN_ADJOINT = 10  # tangents that take as long as the gradient of one sum


def fast_path(device: str | None = None) -> str | None:
    """Return the fast path that is made for a device, JAX's default where None; None where there is none.

    The kernel is for NVIDIA's GPUs from compute capability 8.0 on.
    """
    backend = device or jax.default_backend()
    if backend == "gpu":
        capability = str(getattr(jax.devices()[0], "compute_capability", "0")).split(".")[0]
        return "kernel" if capability.isdigit() and int(capability) >= 8 else None
    return "regions" if backend == "cpu" else None


def path_for(device: str | None, *, kernel: bool) -> str:
    """Return "regions", "kernel", or "plain"; `kernel` says whether a GPU's kernel can do it."""
    path = fast_path(device)
    if path is None or (path == "kernel" and not kernel) or not works(path):
        return "plain"
    return path


def many_at_once(dtype: DTypeLike) -> bool:
    """Return whether thousands of robots take no longer here than a few: by the kernel of a GPU."""
    return np.dtype(dtype) == np.float32 and fast_path() == "kernel"


def device_for(robots: int, tangents: int, *, kernel: bool) -> str | None:
    """Return "cpu" where so many robots, each with so many tangents, are done sooner there although there is a GPU.

    A step of any few takes a GPU as long as one of thousands. The environment variable `ON_CPU` sets another limit.

    Raises:
        Refused: another limit that is no whole number.
    """
    if jax.default_backend() == "cpu" or jax.process_count() > 1:
        return None
    if limit := os.environ.get(ON_CPU, "").strip():
        if not limit.isdecimal():
            raise Refused(f"{ON_CPU}: expected a number of robots, got {limit!r}")
        few = robots <= int(limit)
    elif robots * (1 + tangents) > _AS_LAUNCHES:
        few = False
    else:
        few = bool(tangents) or robots <= _AS_THE_KERNEL or path_for(None, kernel=kernel) != "kernel"
    return "cpu" if few else None


def compiler_options(path: str, device: str | None, *, briefly: bool = False) -> dict[str, str | int]:
    """Return the options with which XLA compiles a path: wide vectors for regions; other devices are left alone."""
    if (device or jax.default_backend()) != "cpu":
        return {}
    options: dict[str, str | int] = {LEVEL: 0} if briefly else {}
    if path != "regions":
        return options
    if LEVEL not in os.environ.get("XLA_FLAGS", ""):
        options.setdefault(LEVEL, 1)  # above: half as long again, and no faster
    return options | {WIDTH: 512}


# --- where a fast path cannot

_Result = TypeVar("_Result")
# in errors that no path avoids: too little memory, or a function of the user's that JAX calls back and that fails
_OF_ANY_PATH = ("RESOURCE_EXHAUSTED", "Traceback (most recent call last)")


@functools.cache
def _refused() -> set[Hashable]:
    """Return the programs that fast paths refused in this process, a set to add to."""
    return set()


def first_possible(by: Callable[[str], _Result], path: str, call: Hashable) -> _Result:
    """Return `by(path)`, or `by("plain")` where the path refuses `call`, which it is not asked again."""
    if path != "plain" and (path, call) not in _refused():
        try:
            return by(path)
        except (NotImplementedError, JaxRuntimeError) as error:
            if not isinstance(error, Unsupported) and any(reason in str(error) for reason in _OF_ANY_PATH):
                raise
            _refused().add((path, call))
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            warnings.warn(f"{PATHS[path]} cannot do {reason}: by XLA's own way, slower", stacklevel=3)
    return by("plain")


# --- does a fast path work on this machine?

_WAITING = threading.Lock()
TRIAL = "from mjx_climb.execution import paths; paths.take({!r})"
_PATIENCE = 300.0  # s, for a process that starts, imports JAX and compiles some hundred operations on a busy machine
_CRASHES = (signal.SIGILL, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV)  # not somebody's wish


class Verdict(NamedTuple):
    """Whether a path works on this machine, and the trial's result."""

    works: bool
    seen: str  # in a few words


def begin() -> None:
    """Begin the trials that this machine's walks will ask for and that nothing is known of: other things go on beside.

    Where nobody asks, a trial comes to its end by itself and leaves no verdict.
    """
    for path in {"cpu": ("regions",), "gpu": tuple(PATHS)}.get(jax.default_backend(), ()):
        if (file := _file(path)) is None or not file.exists():
            with contextlib.suppress(OSError):  # who asks is told
                trial(path)


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
            pass  # not there, or damaged: tried again
    found, lasting = tried(path)
    if kept is not None and lasting:
        with contextlib.suppress(OSError):  # no room, no rights: tried again in the next process
            write_whole(kept, json.dumps(found._asdict()).encode())
    return found


def _file(path: str) -> Path | None:
    """Return where the verdict of a path is kept, None where there is no cache."""
    if (folder := cache_folder()) is None:
        return None
    made_of = repr([path, source_digest(Path(__file__).parent), machine()])
    return folder / "probes" / (hashlib.sha256(made_of.encode()).hexdigest() + ".json")


@functools.cache
def trial(path: str) -> subprocess.Popen[str]:
    """Start the process that tries a path.

    Raises:
        OSError: it does not start.
    """
    packages = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, packages)),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # this process may have the GPU's memory
        "JAX_ENABLE_COMPILATION_CACHE": "false",  # the compiler is tried
        "JAX_TRACEBACK_FILTERING": "off",  # its last line is the error
    }
    command, pipe = [sys.executable, "-c", TRIAL.format(path)], subprocess.PIPE
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True,
        start_new_session=True,  # Ctrl-C is for this process
    )  # fmt: skip


def tried(path: str) -> tuple[Verdict, bool]:
    """Return the verdict of a process of its own, and whether the next one would come to the same."""
    try:
        with trial(path) as process:
            try:
                out, errors = process.communicate(timeout=_PATIENCE)
            except BaseException:
                process.kill()
                raise
    except (OSError, subprocess.TimeoutExpired) as error:
        return Verdict(False, f"no trial: {type(error).__name__}"), False
    said, code = (out.strip() or errors.strip()).splitlines()[-1:] or [""], process.returncode
    if code == 0 and said == [SAME]:
        return Verdict(True, "tried, and compared with XLA's own"), True
    if code < 0:
        stopped_by = signal.Signals(-code)
        return Verdict(False, f"a trial was stopped by {stopped_by.name}"), stopped_by in _CRASHES
    return Verdict(False, f"a trial failed: {said[0][:200]}"), True


# --- the trial: a small motion and its tangents by a fast path and by the plain one, compared

SAME = "the same"
_ROBOTS, _STEPS = 5, 3
_TOLERANCE = {"float32": 1e-4, "float64": 1e-12}  # relative to the largest value


def take(path: str) -> None:
    """Take a path, "regions" or "kernel", and print `SAME`, or how far it was off.

    In each of its precisions it is compared with the plain one in the first of them.
    """
    jax.config.update("jax_enable_x64", True)
    count, precisions = (1, ["float64", "float32"]) if path == "regions" else (2, ["float32"])
    states = np.linspace(0.1, 0.9, 6 * _ROBOTS).reshape(_ROBOTS, 6)
    start = np.stack([states, states[:, ::-1]][:count], -1)  # of limbs
    every = start, np.stack([np.cos(start), np.sin(start)][:count], 1)  # and directions
    given = [[array.astype(dtype) for array in every] for dtype in precisions]
    with ThreadPoolExecutor(1 + len(given)) as threads:  # the first walk on a machine waits for this
        exact = threads.submit(_by_vmap, _motion, *given[0])
        fast = _by_kernel if path == "kernel" else functools.partial(_by_vmap, over_robots(_motion))
        moved = list(threads.map(fast, *zip(*given, strict=True)))
    for dtype, found in zip(precisions, moved, strict=True):
        for mine, expected in zip(jax.tree.leaves(found), jax.tree.leaves(exact.result()), strict=True):
            off = float(np.abs(np.asarray(mine) - np.asarray(expected)).max() / np.abs(expected).max())
            if not off <= _TOLERANCE[dtype]:
                print(f"{off:.1g} off in {dtype}")
                return
    print(SAME)


def _by_vmap(motion: Callable[[Array], Array], start: np.ndarray, directions: np.ndarray) -> tuple[Array, ...]:
    """Return the ends of a batch's motions, with their tangents and without; on a CPU, as regions are."""

    def along(start: Array, directions: Array) -> list[tuple[Array, Array]]:
        return [jax.jvp(jax.vmap(motion), (start,), (along,)) for along in jnp.moveaxis(directions, 1, 0)]

    with on_host():
        (ends, *_), tangents = zip(*jax.jit(along)(start, directions), strict=True)
        return ends, jnp.stack(tangents, 1), ends


def _by_kernel(start: np.ndarray, directions: np.ndarray) -> tuple[Array, ...]:
    with_tangents = jax.jit(gpu_kernel.tangents_over_robots(_motion, [True]))(directions, start)
    return *with_tangents, jax.jit(gpu_kernel.over_robots(_motion, [True]))(start)


def _motion(start: Array) -> Array:
    """Return three angles and rates (6, limbs) after some steps: a sample of a walk's operations."""

    def step(state: Array, _: None) -> tuple[Array, None]:
        angle, rate = state[:3], state[3:]
        held = jnp.where(angle > 0.5, 0.1 * rate, jnp.minimum(rate, 0.3))
        mass = 2 + jnp.cos(angle)
        load = jnp.concatenate([angle[1:], angle[:1]]) * jnp.sin(angle)
        lever = jnp.stack([mass[0] * load[1], mass[1] * load[2], mass[2] * load[0]])
        rate = held - 0.01 * (lever / jnp.sqrt(mass**2 + 0.1) + jnp.exp(-rate) * jnp.arctan2(angle, mass))
        after = jnp.concatenate([angle + 0.01 * rate, rate])
        return after - 0.01 * after.sum(1, keepdims=True), None  # limbs pull at each other

    return jax.lax.scan(step, start, length=_STEPS)[0]
