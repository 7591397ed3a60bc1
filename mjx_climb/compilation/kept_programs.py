"""Compiled programs kept whole on disk, beside XLA's cache: a warm start neither traces nor compiles.

A program is loaded only where nothing differs that it was made of: this package's files, the versions of what compiles
and computes, the machine, JAX's settings, and all that the caller says it depends on. A file that cannot be read, or is
not what was written, is made anew.
"""

import contextlib
import functools
import hashlib
import pickle
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
from jax import monitoring
from jax.experimental import serialize_executable

from mjx_climb.compilation.cache import cache_folder, cache_in_use, may_be_anothers
from mjx_climb.compilation.machine import machine, source_digest
from mjx_climb.files.writing import whole

_Result = TypeVar("_Result")
Identity = Callable[..., str | None]

_PACKAGE = Path(__file__).parents[1]
_NO_MATTER = ("cache", "log", "traceback", "profiler")  # in the names of settings of JAX's that change no program
# as JAX reports its own
_HIT, _TOOK = "/jax/compilation_cache/cache_hits", "/jax/core/compile/backend_compile_duration"


def kept(function: Callable[..., _Result], identity: Identity, options: dict[str, str | int]) -> Callable[..., _Result]:
    """Return `jax.jit` of a function whose programs are kept on disk.

    Arguments:
        function: of a hashable structure, which is static, and trees of arrays; a function of this package.
        identity: of the same arguments: all that the function looks at beside the arrays' values, as text that another
            process would give too; None where that cannot be told, so that the program is not kept.
        options: for XLA.
    """
    plain = jax.jit(function, static_argnums=0, compiler_options=options)
    programs: dict[Hashable, Callable[..., _Result]] = {}
    alone: dict[Hashable, threading.Lock] = {}  # shares of a batch come from several threads

    def program(structure: Hashable, *trees: Any) -> _Result:
        leaves, tree = jax.tree.flatten(trees)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            traced: _Result = plain(structure, *trees)
            return traced
        key = structure, tree, tuple(_kind(leaf) for leaf in leaves), _settings()
        if key not in programs:
            with alone.setdefault(key, threading.Lock()):
                if key not in programs:
                    known = identity(structure, *trees)
                    file = None if known is None else _file(function, known, key[1:], options)
                    if file is None:
                        programs[key] = plain.lower(structure, *trees).compile()
                    else:
                        make = functools.partial(_made, function, options, structure, trees, file)
                        loaded = _loaded(file, trees)
                        programs[key] = make() if loaded is None else _or_else(loaded, make)
        return programs[key](*trees)

    return program


def _kind(leaf: Any) -> Hashable:
    sharding = getattr(leaf, "sharding", None)
    devices = () if sharding is None else tuple(sorted(f"{d.platform}:{d.id}" for d in sharding.device_set))
    return leaf.shape, str(leaf.dtype), devices


def _settings() -> Hashable:
    """Return what JAX's traces and compilations depend on, as it holds in this thread."""
    names = (name for name in sorted(jax.config.values) if not any(word in name for word in _NO_MATTER))
    return tuple((name, str(getattr(jax.config, name, None))) for name in names)


def _file(function: Callable[..., Any], known: str, key: Hashable, options: dict[str, str | int]) -> Path | None:
    """Return where a program is kept, None where programs are not."""
    folder = cache_folder()
    if folder is None or cache_in_use() != str(folder) or jax.process_count() > 1:
        return None
    named = function.__module__, function.__qualname__
    made_of = (*named, known, str(key), sorted(options.items()), source_digest(_PACKAGE), machine())
    return folder / "programs" / hashlib.sha256(repr(made_of).encode()).hexdigest()


def _loaded(file: Path, trees: tuple[Any, ...]) -> Callable[..., Any] | None:
    """Return a kept program, None where there is none."""
    begin = time.perf_counter()
    try:
        if may_be_anothers(file):
            return None
        digest, content = file.read_bytes().split(b"\n", 1)
        if hashlib.sha256(content).hexdigest().encode() != digest:
            return None
        serialized, inputs, outputs = pickle.loads(content)
        device = _device(jax.tree.leaves(trees))
        program: Callable[..., Any] = serialize_executable.deserialize_and_load(
            serialized, inputs, outputs, device.client, [device]
        )
        monitoring.record_event(_HIT)
        monitoring.record_event_duration_secs(_TOOK, time.perf_counter() - begin)
    except Exception:  # whatever is wrong with a file, the program can be made
        return None
    return program


def _or_else(loaded: Callable[..., Any], make: Callable[[], Callable[..., Any]]) -> Callable[..., Any]:
    """Return a loaded program that is made anew where it turns out not to run."""
    made = functools.cache(make)

    def run(*trees: Any) -> Any:
        try:
            return jax.block_until_ready(loaded(*trees))
        except Exception:  # of a file that is whole, and yet none of this process's programs
            return made()(*trees)

    return run


def _device(leaves: list[Any]) -> jax.Device:
    """Return the one device that a program of these arrays runs on."""
    for leaf in leaves:
        if isinstance(leaf, jax.Array):
            [device] = leaf.devices()
            return device
    chosen: Any = jax.config.values["jax_default_device"]
    return chosen if isinstance(chosen, jax.Device) else jax.devices(chosen)[0]


def _made(
    function: Callable[..., Any],
    options: dict[str, str | int],
    structure: Hashable,
    trees: tuple[Any, ...],
    file: Path,
) -> Callable[..., Any]:
    """Return a program compiled now, and keep it."""

    def named(structure: Hashable, *trees: Any) -> Any:
        return function(structure, *trees)

    # What XLA's cache gave cannot be written down again: it lacks parts (jaxlib 0.10). Under a name of its own a
    # program is not found there, but for a file that was lost.
    named.__name__ = f"{function.__name__}_{file.name[:12]}"
    jitted = jax.jit(named, static_argnums=0, compiler_options=options)
    lowered = jitted.lower(structure, *trees)  # which may well take small programs from XLA's cache
    with _hits() as hits:
        compiled: jax.stages.Compiled = lowered.compile()
    if hits:
        return compiled
    with contextlib.suppress(Exception):  # no room, no rights, or a program that cannot be written down: not kept
        content = pickle.dumps(serialize_executable.serialize(compiled))
        with whole(file) as place:
            place.touch(mode=0o600)  # read again by its owner alone
            place.write_bytes(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
    return compiled


@contextlib.contextmanager
def _hits() -> Iterator[list[str]]:
    """Give a list that grows with each program that this thread takes from XLA's cache."""
    hits: list[str] = []
    thread = threading.get_ident()

    def heard(event: str, **_: str | int) -> None:
        if event == _HIT and threading.get_ident() == thread:
            hits.append(event)

    monitoring.register_event_listener(heard)
    try:
        yield hits
    finally:
        monitoring.unregister_event_listener(heard)
