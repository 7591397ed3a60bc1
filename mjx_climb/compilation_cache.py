"""XLA's persistent compilation cache: a second start does not wait for the compiler.

On by default in the user's cache folder. `MJX_CLIMB_CACHE` moves it (a folder) or switches it off (`off`); a cache
folder that the user has set in JAX itself is left as it is.
"""

import os
from pathlib import Path

import jax
import platformdirs

VARIABLE = "MJX_CLIMB_CACHE"
_OFF = {"off", "0", "no", "none", "false"}


def folder() -> Path | None:
    """Return the cache folder that the environment asks for, None where it is switched off."""
    wish = os.environ.get(VARIABLE, "")
    if wish.lower() in _OFF:
        return None
    return Path(wish) if wish else Path(platformdirs.user_cache_dir("mjx_climb", appauthor=False)) / "xla"


def enable() -> None:
    """Switch the cache on, unless the user has chosen one in JAX or switched ours off."""
    path = folder()
    if path is None or jax.config.jax_compilation_cache_dir is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
