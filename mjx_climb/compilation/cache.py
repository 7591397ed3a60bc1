"""XLA's persistent cache of compiled programs.

It is on by default in the user's cache folder, so that a second start does not wait for the compiler.
`MJX_CLIMB_CACHE` moves it (a folder) or switches it off (`off`); a folder that the user has set in JAX itself is left.
What lies there is executed, so a folder in which another user may have put something is not used.
"""

import contextlib
import functools
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

VARIABLE = "MJX_CLIMB_CACHE"
_OFF = {"off", "0", "no", "none", "false"}


def cache_folder() -> Path | None:
    """Return the cache folder that the environment asks for, None where it is switched off or not to be trusted."""
    folder = _asked_folder()
    if folder is not None and (why := _doubt(folder)):
        _say_once(why)
        return None
    return folder


def doubt() -> str | None:
    """Return why the folder that the environment asks for is not used, None where it is or where there is none."""
    folder = _asked_folder()
    return None if folder is None else _doubt(folder)


def may_be_anothers(path: str | os.PathLike[str], *, in_private: bool = False) -> bool:
    """Return whether another user owns a file or folder, or may write to it, unless its folder lets nobody in."""
    about = os.stat(path)
    return about.st_uid != os.geteuid() or bool(about.st_mode & 0o022 and not in_private)


def _asked_folder() -> Path | None:
    wish = os.environ.get(VARIABLE, "")
    if wish.lower() in _OFF:
        return None
    return Path(wish) if wish else Path(platformdirs.user_cache_dir("mjx_climb", appauthor=False)) / "xla"


@functools.cache
def _doubt(folder: Path) -> str | None:
    if not hasattr(os, "geteuid"):  # a system without such owners
        return None
    place: str | os.PathLike[str] = folder
    with contextlib.suppress(OSError):  # not there yet, or who uses it hears of it
        private = not os.stat(folder).st_mode & 0o077
        with os.scandir(folder) as entries:
            for place in (folder, *entries):
                if may_be_anothers(place, in_private=private):
                    return (
                        f"the compilation cache is off: {os.fspath(place)} is not this user's own, or others may write "
                        f"to it, and what lies there would be executed (remove it, chmod -R go-rwx {folder}, or set "
                        f"{VARIABLE})"
                    )
    return None


def forget() -> None:
    """Have the folder looked at again."""
    _doubt.cache_clear()
    _say_once.cache_clear()


@functools.cache
def _say_once(why: str) -> None:
    warnings.warn(why, stacklevel=4)


def cache_in_use() -> str | None:
    """Return the folder that rollouts use: JAX's where the user has set one there, else ours; None where it is off."""
    chosen: str | None = jax.config.values["jax_compilation_cache_dir"]
    return chosen if chosen is not None else (None if (own := cache_folder()) is None else str(own))


def enable_cache() -> None:
    """Switch the cache on, unless the user has chosen one in JAX or switched ours off."""
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
