"""XLA's persistent cache of compiled programs.

It is on by default in the user's cache folder, so that a second start does not wait for the compiler.
`MJX_CLIMB_CACHE` moves it (a folder) or switches it off (`off`); a folder that the user has set in JAX itself is left.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

VARIABLE = "MJX_CLIMB_CACHE"
_OFF = {"off", "0", "no", "none", "false"}


def cache_folder() -> Path | None:
    """Return the cache folder that the environment asks for, None where it is switched off."""
    wish = os.environ.get(VARIABLE, "")
    if wish.lower() in _OFF:
        return None
    return Path(wish) if wish else Path(platformdirs.user_cache_dir("mjx_climb", appauthor=False)) / "xla"


def cache_in_use() -> str | None:
    """Return the folder that rollouts use: JAX's where the user has set one there, else ours; None where it is off."""
    chosen: str | None = jax.config.values["jax_compilation_cache_dir"]
    return chosen if chosen is not None else (None if (own := cache_folder()) is None else str(own))


def enable_cache() -> None:
    """Switch the cache on, unless the user has chosen one in JAX or switched ours off."""
    path = cache_folder()
    if path is None or jax.config.values["jax_compilation_cache_dir"] is not None:
        return
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
