"""The folder of compiled programs: XLA's persistent cache, and beside it cached executables and verdicts of trials.

It is in the user's cache folder, so that a second start does not wait for the compiler. `MJX_CLIMB_CACHE` moves it (a
folder) or switches it off (`off`); a folder that the user has set in JAX itself is left. What lies there is executed,
so a folder in which another user may have put something is not used.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import platform
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

VARIABLE = "MJX_CLIMB_CACHE"
_OFF = {"off", "0", "no", "none", "false"}
_VERSIONED = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")


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
    if not hasattr(os, "geteuid"):  # a system without such owners
        return None
    path: str | os.PathLike[str]
    with contextlib.suppress(OSError):  # not there yet, or who uses it gets the error
        private = not os.stat(folder).st_mode & 0o077
        with os.scandir(folder) as entries:
            for path in (folder, *entries):
                if may_be_anothers(path, in_private=private):
                    why = (
                        f"the compilation cache is off: {os.fspath(path)} is not this user's own, or others may write "
                        f"to it, and what lies there would be executed (remove it, chmod -R go-rwx {folder}, or set "
                        f"{VARIABLE})"
                    )
                    warnings.warn(why, stacklevel=4)
                    return why
    return None


def may_be_anothers(path: str | os.PathLike[str], *, in_private: bool = False) -> bool:
    """Return whether another user owns a file or folder, or may write to it, unless its folder lets nobody in."""
    about = os.stat(path)
    return about.st_uid != os.geteuid() or bool(about.st_mode & 0o022 and not in_private)


def cache_in_use() -> str | None:
    """Return the folder that rollouts use: JAX's where the user has set one there, else ours; None where it is off."""
    of_jax: str | None = jax.config.values["jax_compilation_cache_dir"]
    return of_jax if of_jax is not None else (None if (own := cache_folder()) is None else str(own))


def enable_cache() -> None:
    """Switch the cache on, unless the user has set one in JAX or switched ours off."""
    path = cache_folder()
    if path is None or jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    with contextlib.suppress(OSError):  # JAX says what is wrong with it
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@contextlib.contextmanager
def cache_in(folder: str) -> Iterator[None]:
    """Have JAX's cache in a folder for a while."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", folder)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        compilation_cache.reset_cache()


@functools.cache
def machine() -> str:
    """Return what all entries of this process depend on, as text: versions, processor, devices, flags of XLA."""
    versions = [importlib.metadata.version(name) for name in _VERSIONED]
    devices = [f"{device.platform} {device.device_kind} {device.id}" for device in jax.devices()]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    processor = [platform.machine(), platform.processor()]
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as lines:  # instruction sets, where the system tells
        processor += sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    return repr([*versions, platform.python_version(), *processor, *devices, *flags])


@functools.cache
def source_digest(folder: Path) -> str:
    """Return a digest of all code and models below a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".py", ".xml"):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()
