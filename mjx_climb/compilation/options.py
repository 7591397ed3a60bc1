"""How XLA compiles a rollout: by which path, and what it fuses."""

import os

import jax
import numpy as np
from numpy.typing import DTypeLike

from mjx_climb.compilation import probe
from mjx_climb.dynamics import ELEMENTWISE
from mjx_climb.scenario.messages import ConfigError

ON_CPU = "MJX_CLIMB_ON_CPU"  # the variable that says up to how many robots walk there although there is a GPU
_FUSION_PAYS_BELOW = 48  # robots
# robots, times one and the slopes of each, that a few CPU cores walk as soon as an H200: 8 s of any few take it 0.04 s
# by the kernel, and 1.4 s by XLA's own
_AS_THE_KERNEL, _AS_LAUNCHES = 8, 64


def fast_path(backend: str | None = None) -> str | None:
    """Return which of `mjx_climb.compilation.probe.PATHS` is made for a device: JAX's default, or another's.

    The kernel is for NVIDIA's GPUs from compute capability 8.0 on.
    """
    backend = backend or jax.default_backend()
    if backend == "gpu":
        capability = str(getattr(jax.devices()[0], "compute_capability", "0")).split(".")[0]
        return "kernel" if capability.isdigit() and int(capability) >= 8 else None
    return "pieces" if backend == "cpu" else None


def pieces_pay(engine: str, backend: str | None = None) -> bool:
    """Return whether walks with this engine are compiled in pieces, see `mjx_climb.compilation.cpu_pieces`.

    `backend` is where they are compiled for, where that is not JAX's default. Where a trial of them failed they do not.
    """
    return engine in ELEMENTWISE and fast_path(backend) == "pieces" and probe.works("pieces")


def kernel_pays(engine: str, dtype: DTypeLike) -> bool:
    """Return whether walks with this engine are compiled as one GPU kernel, see `mjx_climb.compilation.gpu_kernel`.

    In float64 its values do not find room in the registers. Where a trial of it failed they are not.
    """
    fits = engine in ELEMENTWISE and np.dtype(dtype) == np.float32
    return fits and fast_path() == "kernel" and probe.works("kernel")


def walks_on_host(robots: int, engine: str, dtype: DTypeLike, slopes: int = 0) -> bool:
    """Return whether so many robots, each with so many slopes, walk on the CPU's cores although there is a GPU.

    There they are sooner at the end, if they are few: a step of any few takes a GPU as long as one of thousands. The
    environment variable `ON_CPU` sets another limit.

    Raises:
        ConfigError: another limit that is no whole number.
    """
    if jax.default_backend() == "cpu" or jax.process_count() > 1:
        return False
    limit = os.environ.get(ON_CPU, "").strip()
    if limit and not limit.isdecimal():
        raise ConfigError(f"{ON_CPU}: expected a number of robots, got {limit!r}")
    if limit:
        return robots <= int(limit)
    if robots * (1 + slopes) > _AS_LAUNCHES:
        return False
    return bool(slopes) or robots <= _AS_THE_KERNEL or not kernel_pays(engine, dtype)


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
