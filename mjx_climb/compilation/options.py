"""How XLA compiles a rollout: its persistent cache, and what it fuses.

The cache is on by default in the user's cache folder, so that a second start does not wait for the compiler.
`MJX_CLIMB_CACHE` moves it (a folder) or switches it off (`off`); a folder that the user has set in JAX itself is left.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import platformdirs
from jax.experimental.compilation_cache import compilation_cache
from numpy.typing import DTypeLike

from mjx_climb.dynamics import ELEMENTWISE

VARIABLE = "MJX_CLIMB_CACHE"
_OFF = {"off", "0", "no", "none", "false"}
_FUSION_PAYS_BELOW = 48  # robots


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


def pieces_pay(engine: str, backend: str | None = None) -> bool:
    """Return whether walks with this engine are compiled in pieces, see `mjx_climb.compilation.cpu_pieces`.

    `backend` is where they are compiled for, where that is not JAX's default.
    """
    return (backend or jax.default_backend()) == "cpu" and engine in ELEMENTWISE


def kernel_pays(engine: str, dtype: DTypeLike) -> bool:
    """Return whether walks with this engine are compiled as one GPU kernel, see `mjx_climb.compilation.gpu_kernel`.

    It is for NVIDIA's GPUs from compute capability 8.0 on; in float64 its values do not find room in the registers.
    """
    capability = str(getattr(jax.devices()[0], "compute_capability", "0")).split(".")[0]
    new_enough = jax.default_backend() == "gpu" and capability.isdigit() and int(capability) >= 8
    return new_enough and engine in ELEMENTWISE and np.dtype(dtype) == np.float32


def compiler_options(batch: int, *, in_pieces: bool = False, backend: str | None = None) -> dict[str, str | int]:
    """Return the options with which XLA makes the fastest rollout of so many robots, for `jax.jit`.

    Wide vectors for steps in pieces. Where they are whole, XLA:CPU fuses elementwise operations by computing shared
    ones again wherever they are used: six times the arithmetic of the equations. Each operation on its own is faster by
    far once its arrays fill the vector units, and compiles sooner; with a few robots the calls would cost more than the
    arithmetic. Other backends are left alone. `backend` is where it is compiled for, where that is not JAX's default.
    """
    if (backend or jax.default_backend()) != "cpu":
        return {}
    if in_pieces:
        return {"xla_cpu_prefer_vector_width": 512}
    return {} if batch < _FUSION_PAYS_BELOW else {"xla_disable_hlo_passes": "fusion"}
