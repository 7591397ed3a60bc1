"""The folder of compiled programs: XLA's persistent cache, executables, shapes, verdicts on the fast paths.

It is in the user's cache folder, so that a second start does not wait for the compiler. `MJX_CLIMB_CACHE` moves it (a
folder) or switches it off (`off`); a folder that the user has set in JAX itself is left. Its files are executed,
so a folder in which another user may have put something is not used.

With a cached executable a warm start neither traces nor compiles. Its name is a digest of the files that the traced
function imports, the versions of compiler and libraries, the machine, JAX's settings, the shapes of the arguments, and
the caller's identity of its inputs. A file that cannot be read, or was not written under its name, is made again.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import pickle
import platform
import re
import sys
import tempfile
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import jax
import numpy as np
import platformdirs
from jax import Array, monitoring
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from mjx_climb.execution.jax_internals import outside_of_xlas_cache, prepare_for, settings
from mjx_climb.execution.jax_types import Function, PyTree

VARIABLE = "MJX_CLIMB_CACHE"
_LONGEST = 3600  # s that a file is written
_OFF = {"off", "0", "no", "none", "false"}
_PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(r"^\s*(?:from\s+([\w.]+)\s+import\s+(\([^)]*\)|.*)|import\s+([\w.]+))", re.MULTILINE)


def asked_folder() -> Path | None:
    """Return the folder that the environment asks for, None where it switches the cache off."""
    wish = os.environ.get(VARIABLE, "")
    if wish.lower() in _OFF:
        return None
    return Path(wish) if wish else Path(platformdirs.user_cache_dir("mjx_climb", appauthor=False)) / "xla"


def cache_folder() -> Path | None:
    """Return the folder that the environment asks for, None where it is off, or not to be trusted."""
    folder = asked_folder()
    return None if folder is None or doubt(folder) else folder


@functools.cache
def doubt(folder: Path) -> str | None:
    """Return why a folder is not used, and warn so the first time; None where all in it is this user's own."""
    with contextlib.suppress(OSError):  # not there yet, or who uses it gets the error
        private = not folder.stat().st_mode & 0o077
        for path in (folder, *folder.iterdir()):
            if may_be_anothers(path.stat(), in_private=private):
                why = (
                    f"the compilation cache is off: {path} is not this user's own, or others may write to it, and what "
                    f"lies there would be executed (remove it, chmod -R go-rwx {folder}, or set {VARIABLE})"
                )
                warnings.warn(why, stacklevel=4)
                return why
    return None


def may_be_anothers(about: os.stat_result, *, in_private: bool = False) -> bool:
    """Return whether another user owns a file or folder, or may write to it, unless its folder lets nobody in."""
    if not hasattr(os, "geteuid"):  # a system without such owners
        return False
    return about.st_uid != os.geteuid() or bool(about.st_mode & 0o022 and not in_private)


def cache_in_use() -> str | None:
    """Return the folder that rollouts use: JAX's where the user has set one there, else ours; None where it is off."""
    of_jax = cast(str | None, settings()["jax_compilation_cache_dir"])
    own = cache_folder() if of_jax is None else None
    return of_jax if own is None else str(own)


def enable_cache() -> None:
    """Switch the cache on, unless the user has set one in JAX or switched ours off."""
    path = cache_folder()
    if path is None:
        return
    with contextlib.suppress(OSError):  # JAX reports its faults
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if settings()["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextlib.contextmanager
def cache_in(folder: str) -> Iterator[None]:
    """Have JAX's cache in a folder for a while."""
    before = settings()["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", folder)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        compilation_cache.reset_cache()


@functools.cache
def version(distribution: str) -> str | None:
    """Return the version of a distribution, None of one that is not installed; all of its metadata is read for it."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


@functools.cache
def machine() -> str:
    """Return the key of all entries of this process, as text: versions, processor, devices, flags of XLA."""
    known = [str(version(name)) for name in ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")]
    known += [platform.python_version(), platform.machine(), platform.processor()]
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as lines:  # instruction sets, where the system tells
        known += sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    known += [f"{device.platform} {device.device_kind} {device.id}" for device in jax.devices()]
    return repr([*known, *(os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS"))])


@functools.cache
def source_digest(folder: Path) -> str:
    """Return a digest of all code and models below a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".py", ".xml"):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def code_digest(modules: Iterable[str]) -> str:
    """Digest of modules of this package, or of a part of it, and of the modules of both that they import."""
    tops = {_PACKAGE.name, *(name.partition(".")[0] for name in modules)}
    parts = [top for top in tops if _PACKAGE.name in (top, getattr(sys.modules.get(top), "__part_of__", ""))]
    return digest_of_imports(frozenset(modules), tuple(Path(str(sys.modules[top].__file__)).parent for top in parts))


@functools.cache
def digest_of_imports(modules: frozenset[str], folders: tuple[Path, ...]) -> str:
    """Digest of the files of modules, and of the modules in some packages' folders that they import, and so on.

    Imports inside functions, and those that type checkers alone read, count too.
    """
    known = {name: source for folder in folders for name, source in sources(folder).items()}
    found, waiting = set[str](), [name for name in modules if name in known]
    while waiting:
        if (name := waiting.pop()) not in found:
            found.add(name)
            waiting += [each for each in known[name].imported if each in known]
    return hashlib.sha256(repr([(name, known[name].text) for name in sorted(found)]).encode()).hexdigest()


class Source(NamedTuple):
    """A module's file."""

    text: str
    imported: list[str]  # names of modules, and of others that may be in them


@functools.cache
def sources(folder: Path) -> dict[str, Source]:
    """The modules of the package in a folder, by their names."""
    found = {}
    for path in folder.rglob("*.py"):
        text = path.read_text()
        names = [(home, re.findall(r"\w+", names), alone) for home, names, alone in _IMPORT.findall(text)]
        imported = [name for home, each, alone in names for name in (home, alone, *(f"{home}.{n}" for n in each))]
        module = ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__")
        if "iter_modules(__path__)" in text:  # all files of its folder are imported
            imported += [f"{module}.{other.stem}" for other in path.parent.glob("*.py")]
        found[module] = Source(text, imported)
    return found


# --- executables

_Result = TypeVar("_Result")
Options = dict[str, str | int]  # of the compiler

_REFUSED = b"refused: "  # before the words of an error, in place of an executable
_OF_NO_EFFECT = ("cache", "log", "traceback", "profiler")  # in names of JAX's settings that change no executable
# events that JAX records where XLA's cache gave a program, for reports of compilation times
_HIT, _SECONDS = "/jax/compilation_cache/cache_hits", "/jax/core/compile/backend_compile_duration"


def cached_jit(
    function: Callable[..., _Result], identity: Callable[..., str | None], options: Options
) -> Callable[..., _Result]:
    """Return `jax.jit` of a function, with executables on disk, found by `identity`; None: none is kept."""
    jitted = jax.jit(function, static_argnums=0, compiler_options=options)
    executables: dict[Hashable, Callable[..., _Result]] = {}
    locks: dict[Hashable, threading.Lock] = {}  # shares of a batch come from several threads

    def call(structure: Hashable, *trees: PyTree) -> _Result:
        leaves, tree = jax.tree.flatten(trees)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            traced: _Result = jitted(structure, *trees)
            return traced
        key = structure, tree, tuple(map(_kind, leaves)), _settings()
        if key not in executables:
            with locks.setdefault(key, threading.Lock()):
                if key not in executables:
                    known = identity(structure, *trees)
                    file = None if known is None else executable_file(function, known, key[1:], options)
                    executables[key] = (
                        jitted.lower(structure, *trees).compile()
                        if file is None
                        else loaded(file, trees) or _stored(file, function, options, structure, trees)
                    )
        return executables[key](*trees)

    return call


def _kind(leaf: Array | np.ndarray) -> tuple[Hashable, ...]:
    """Return an argument's part of the key of an executable: shape, type and devices."""
    return leaf.shape, leaf.dtype, getattr(leaf, "sharding", None)


def _settings() -> Hashable:
    """Return the settings that JAX's traces and compilations depend on, as they hold in this thread."""
    return tuple((name, getattr(jax.config, name, None)) for name in _setting_names())


@functools.cache
def _setting_names() -> list[str]:
    return [name for name in sorted(settings()) if not any(word in name for word in _OF_NO_EFFECT)]


def executable_file(function: Function, known: str, key: Hashable, options: Options) -> Path | None:
    """Return where an executable is stored, None where none are; beside a folder that the user has set in JAX too."""
    folder = cache_folder()
    if folder is None or jax.process_count() > 1:
        return None
    made_of = (
        function.__module__, function.__qualname__, known, str(key), sorted(options.items()),
        code_digest([function.__module__]), machine(),
    )  # fmt: skip
    return folder / "programs" / hashlib.sha256(repr(made_of).encode()).hexdigest()


def _digest(file: Path, content: bytes) -> bytes:
    """Return a digest of a file's content under its name: a file that was moved is another."""
    return hashlib.sha256(file.name.encode() + content).hexdigest().encode()


def loaded(file: Path, trees: tuple[PyTree, ...]) -> Function | None:
    """Return a stored executable for arguments of a tree, None where there is none.

    Raises:
        NotImplementedError: what kept an earlier process from making one.
    """
    begin = time.perf_counter()
    if (content := read_whole(file)) is None:
        return None
    if content.startswith(_REFUSED):
        raise NotImplementedError(content.removeprefix(_REFUSED).decode())
    try:
        default: object = settings()["jax_default_device"]
        device = default if isinstance(default, jax.Device) else jax.devices(cast(str | None, default))[0]
        if placed := [leaf for leaf in jax.tree.leaves(trees) if isinstance(leaf, jax.Array)]:
            [device] = placed[0].devices()
        ahead = ahead_of_use.pop((file, device), None)
        executable = executable_of(content, device) if ahead is None or ahead.cancel() else ahead.result()
    except Exception as error:
        _tell("loaded", error)
        return None
    _asked[file.name] = None
    monitoring.record_event(_HIT)
    monitoring.record_event_duration_secs(_SECONDS, time.perf_counter() - begin)
    return executable


def executable_of(content: bytes, device: jax.Device) -> Function:
    """Return the executable of a file's content on a device, a function of the same trees of arguments."""
    serialized, outputs, count = pickle.loads(content)
    prepare_for(content)
    # the arguments' tree may have classes of a user's file, which pickle cannot import: it is called with the leaves
    inputs = jax.tree.structure(((0,) * count, {}))
    found: Function = serialize_executable.deserialize_and_load(serialized, inputs, outputs, device.client, [device])
    return lambda *trees: found(*jax.tree.leaves(trees))


_asked: dict[str, None] = {}  # names of the files of executables that this process has asked for, in their order
# executables that are loaded before they are asked for
ahead_of_use: dict[tuple[Path, jax.Device], Future[Function]] = {}


@contextlib.contextmanager
def loading_ahead(occasion: str) -> Iterator[None]:
    """Load the executables that a process asked for on the last such occasion, on a CPU, while other things go on.

    XLA loads beside Python, which imports for a while. At the end the names of those asked for meanwhile are kept.
    """
    if (folder := cache_folder()) is None:
        yield
        return
    file = folder / "occasions" / hashlib.sha256(occasion.encode()).hexdigest()

    def begin() -> None:
        device, names = jax.devices()[0], json.loads(read_whole(file) or b"[]")
        for name in names if device.platform == "cpu" else ():
            program = folder / "programs" / name
            if (content := read_whole(program)) is not None:
                ahead_of_use[program, device] = loader.submit(executable_of, content, device)

    loader = ThreadPoolExecutor(1, "loader")
    loader.submit(begin)
    try:
        yield
    finally:
        loader.shutdown(wait=False, cancel_futures=True)
        ahead_of_use.clear()
        if _asked:
            store_whole(file, json.dumps([*_asked]).encode())


def _stored(
    file: Path, function: Function, options: Options, structure: Hashable, trees: tuple[PyTree, ...]
) -> Function:
    """Return an executable that is compiled now and stored."""

    def named(structure: Hashable, *trees: PyTree) -> PyTree:
        return function(structure, *trees)

    # Programs from XLA's cache cannot be serialized, as they lack parts (jaxlib 0.10). Under a unique name the
    # program is not found there, now or later.
    named.__name__ = f"{function.__name__}_{uuid.uuid4().hex}"
    try:
        lowered = jax.jit(named, static_argnums=0, compiler_options=options).lower(structure, *trees)
    except NotImplementedError as error:  # the next process need not trace for that
        store_whole(file, _REFUSED + str(error).encode())
        raise
    with outside_of_xlas_cache():
        executable = lowered.compile()
    _asked[file.name] = None
    try:
        serialized, _, outputs = serialize_executable.serialize(executable)
        store_whole(file, pickle.dumps((serialized, outputs, len(jax.tree.leaves(trees)))))
    except Exception as error:
        _tell("kept", error)
    return executable


def _tell(what: str, error: Exception) -> None:
    """Warn that each process will make an executable again."""
    reason = (str(error).strip().splitlines() or [""])[0]
    warnings.warn(
        f"a compiled program cannot be {what} ({type(error).__name__}: {reason[:200]}): every start waits for it",
        stacklevel=5,
    )


def read_whole(file: Path) -> bytes | None:
    """Return the bytes that `store_whole` wrote, None where nothing of this user's is there, or it is damaged."""
    try:
        if may_be_anothers(file.stat()):
            return None
        digest, content = file.read_bytes().split(b"\n", 1)
    except (OSError, ValueError):  # ValueError: one line
        return None
    return content if _digest(file, content) == digest else None


def store_whole(file: Path, content: bytes) -> None:
    """Keep a file under a digest of its content and name; where there is no room, or no rights, it is made again."""
    with contextlib.suppress(OSError):
        write_whole(file, _digest(file, content) + b"\n" + content)


def write_whole(file: Path, content: bytes) -> None:
    """Write a file that other processes find whole or not at all, and that its owner alone reads.

    Files of killed writers are removed.

    Raises:
        OSError: no room, or no rights.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    for left in file.parent.glob(".*"):
        with contextlib.suppress(OSError):  # another removes it, or it is written to its end
            if left.stat().st_mtime < time.time() - _LONGEST:
                left.unlink()
    handle, partial = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        os.replace(partial, file)
    except BaseException:
        os.unlink(partial)
        raise
