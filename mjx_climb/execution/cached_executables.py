"""Executables on disk, beside XLA's cache: a warm start neither traces nor compiles.

An executable is found by a key: a digest of this package's files, of the versions of what compiles and computes, the
machine, JAX's settings, the shapes of the arguments, and all that the caller says it depends on. A file that cannot be
read, or is not what was written under its key, is made again.
"""

import contextlib
import hashlib
import pickle
import threading
import time
import uuid
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, TypeVar

import jax
from jax import monitoring
from jax.experimental import serialize_executable

from mjx_climb.execution.cache import cache_folder, cache_in_use, machine, may_be_anothers, source_digest
from mjx_climb.files.writing import whole

_Result = TypeVar("_Result")
Identity = Callable[..., str | None]

_PACKAGE = Path(__file__).parents[1]
_OF_NO_EFFECT = ("cache", "log", "traceback", "profiler")  # in names of JAX's settings that change no executable
# events that JAX records where XLA's cache gave a program, for whoever shows how long compilation took
_HIT, _SECONDS = "/jax/compilation_cache/cache_hits", "/jax/core/compile/backend_compile_duration"


def cached_jit(
    function: Callable[..., _Result], identity: Identity, options: dict[str, str | int]
) -> Callable[..., _Result]:
    """Return `jax.jit` of a function, with executables on disk.

    Arguments:
        function: of a hashable structure, which is static, and trees of arrays; a function of this package.
        identity: of the same arguments: all that the function depends on beside the arrays' values, as text that is the
            same in another process; None where that cannot be told: then the executable is not stored.
        options: for XLA.
    """
    jitted = jax.jit(function, static_argnums=0, compiler_options=options)
    executables: dict[Hashable, Callable[..., _Result]] = {}
    locks: dict[Hashable, threading.Lock] = {}  # shares of a batch come from several threads

    def call(structure: Hashable, *trees: Any) -> _Result:
        leaves, tree = jax.tree.flatten(trees)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            traced: _Result = jitted(structure, *trees)
            return traced
        key = structure, tree, tuple(map(_kind, leaves)), _settings()
        if key not in executables:
            with locks.setdefault(key, threading.Lock()):
                if key not in executables:
                    known = identity(structure, *trees)
                    file = None if known is None else _file(function, known, key[1:], options)
                    executables[key] = (
                        jitted.lower(structure, *trees).compile()
                        if file is None
                        else _loaded(file, leaves) or _stored(file, function, options, structure, trees)
                    )
        return executables[key](*trees)

    return call


def _kind(leaf: Any) -> Hashable:
    sharding = getattr(leaf, "sharding", None)
    devices = () if sharding is None else tuple(sorted(f"{d.platform}:{d.id}" for d in sharding.device_set))
    return leaf.shape, str(leaf.dtype), devices


def _settings() -> Hashable:
    """Return the settings that JAX's traces and compilations depend on, as they hold in this thread."""
    names = (name for name in sorted(jax.config.values) if not any(word in name for word in _OF_NO_EFFECT))
    return tuple((name, str(getattr(jax.config, name, None))) for name in names)


def _file(function: Callable[..., Any], known: str, key: Hashable, options: dict[str, str | int]) -> Path | None:
    """Return where an executable is stored, None where none are."""
    folder = cache_folder()
    if folder is None or cache_in_use() != str(folder) or jax.process_count() > 1:
        return None
    named = function.__module__, function.__qualname__
    made_of = (*named, known, str(key), sorted(options.items()), source_digest(_PACKAGE), machine())
    return folder / "programs" / hashlib.sha256(repr(made_of).encode()).hexdigest()


def _digest(file: Path, content: bytes) -> bytes:
    """Return a digest of a file's content under its name: a file that was moved is another."""
    return hashlib.sha256(file.name.encode() + content).hexdigest().encode()


def _loaded(file: Path, leaves: list[Any]) -> Callable[..., Any] | None:
    """Return a stored executable, None where there is none."""
    begin = time.perf_counter()
    try:
        if may_be_anothers(file):
            return None
        digest, content = file.read_bytes().split(b"\n", 1)
        if _digest(file, content) != digest:
            return None
        device = _device(leaves)
        serialized, inputs, outputs = pickle.loads(content)
        executable: Callable[..., Any] = serialize_executable.deserialize_and_load(
            serialized, inputs, outputs, device.client, [device]
        )
    except Exception:  # whatever is wrong with a file, the executable can be made
        return None
    monitoring.record_event(_HIT)
    monitoring.record_event_duration_secs(_SECONDS, time.perf_counter() - begin)
    return executable


def _device(leaves: list[Any]) -> jax.Device:
    """Return the one device on which an executable of these arrays runs."""
    for leaf in leaves:
        if isinstance(leaf, jax.Array):
            [device] = leaf.devices()
            return device
    default: Any = jax.config.values["jax_default_device"]
    return default if isinstance(default, jax.Device) else jax.devices(default)[0]


def _stored(
    file: Path, function: Callable[..., Any], options: dict[str, str | int], structure: Hashable, trees: tuple[Any, ...]
) -> Callable[..., Any]:
    """Return an executable that is compiled now and stored."""

    def named(structure: Hashable, *trees: Any) -> Any:
        return function(structure, *trees)

    # What XLA's cache returns cannot be serialized, as it lacks parts (jaxlib 0.10). Under a name that nothing else has
    # the program is not found there.
    named.__name__ = f"{function.__name__}_{uuid.uuid4().hex}"
    executable = jax.jit(named, static_argnums=0, compiler_options=options).lower(structure, *trees).compile()
    with contextlib.suppress(Exception):  # no room, no rights, or not to be serialized: it is made again next time
        content = pickle.dumps(serialize_executable.serialize(executable))
        with whole(file) as path:
            path.touch(mode=0o600)  # read again by its owner alone
            path.write_bytes(_digest(file, content) + b"\n" + content)
    return executable
