"""Which path carries a batch out, and where, and the plain one where a fast one cannot: said once, and remembered."""

import os
import threading
import warnings
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.errors import JaxRuntimeError
from numpy.typing import DTypeLike

from mjx_climb.execution import probe
from mjx_climb.execution.elements import Unsupported
from mjx_climb.scenario.messages import ConfigError

ON_CPU = "MJX_CLIMB_ON_CPU"  # the variable that says up to how many robots go to the CPU although there is a GPU
_FUSION_PAYS_BELOW = 48  # robots
# Robots, times one and the tangents of each, that a few CPU cores simulate as soon as an H200: 8 s of any few take it
# 0.04 s by the kernel, and 1.4 s by XLA's own.
_AS_THE_KERNEL, _AS_LAUNCHES = 8, 64


def fast_path(device: str | None = None) -> str | None:
    """Return the fast path that is made for a device, JAX's default where None; None where there is none.

    The kernel is for NVIDIA's GPUs from compute capability 8.0 on.
    """
    backend = device or jax.default_backend()
    if backend == "gpu":
        capability = str(getattr(jax.devices()[0], "compute_capability", "0")).split(".")[0]
        return "kernel" if capability.isdigit() and int(capability) >= 8 else None
    return "regions" if backend == "cpu" else None


def path_for(device: str | None, *, double: bool) -> str:
    """Return "regions", "kernel", or "plain".

    In double precision the values of a kernel do not find room in the registers.
    """
    path = fast_path(device)
    if path is None or (path == "kernel" and double) or not probe.works(path):
        return "plain"
    return path


def many_at_once(dtype: DTypeLike) -> bool:
    """Return whether thousands of robots take no longer here than a few: by the kernel of a GPU."""
    return np.dtype(dtype) == np.float32 and fast_path() == "kernel"


def device_for(robots: int, tangents: int, *, double: bool) -> str | None:
    """Return "cpu" where so many robots, each with so many tangents, are done sooner there although there is a GPU.

    A step of any few takes a GPU as long as one of thousands. The environment variable `ON_CPU` sets another limit.

    Raises:
        ConfigError: another limit that is no whole number.
    """
    if jax.default_backend() == "cpu" or jax.process_count() > 1:
        return None
    limit = os.environ.get(ON_CPU, "").strip()
    if limit and not limit.isdecimal():
        raise ConfigError(f"{ON_CPU}: expected a number of robots, got {limit!r}")
    if limit:
        few = robots <= int(limit)
    elif robots * (1 + tangents) > _AS_LAUNCHES:
        few = False
    else:
        few = bool(tangents) or robots <= _AS_THE_KERNEL or path_for(None, double=double) != "kernel"
    return "cpu" if few else None


def compiler_options(robots: int, path: str, device: str | None, *, briefly: bool = False) -> dict[str, str | int]:
    """Return the options with which XLA compiles so many robots.

    Wide vectors for regions. Where a step is whole, XLA:CPU fuses elementwise operations by computing shared ones again
    wherever they are used: six times the arithmetic of the equations. Each operation on its own is faster by far once
    its arrays fill the vector units, and compiles sooner; with a few robots the calls would cost more than the
    arithmetic. Other devices are left alone.
    """
    if (device or jax.default_backend()) != "cpu":
        return {}
    options: dict[str, str | int] = {}
    if path == "regions":
        options["xla_cpu_prefer_vector_width"] = 512
    elif robots >= _FUSION_PAYS_BELOW:
        options["xla_disable_hlo_passes"] = "fusion"
    if briefly:
        options["xla_backend_optimization_level"] = 0
    return options


# --- where a fast path cannot

_Result = TypeVar("_Result")
# XLA:CPU works out large arrays by several threads of one pool, in which two programs may wait for each other for ever
_one_at_a_time = threading.Lock()


def one_at_a_time(program: Callable[..., _Result]) -> Callable[..., _Result]:
    """Return a plain program on CPUs, which waits for other such programs."""

    def alone(structure: Hashable, *arrays: Any) -> _Result:
        with _one_at_a_time:
            result: _Result = jax.block_until_ready(program(structure, *arrays))
            return result

    return alone


def first_possible(
    fast: Callable[..., _Result], plain: Callable[[], Callable[..., _Result]], what: str
) -> Callable[..., _Result]:
    """Return a program of a structure and trees of arrays that goes by `fast`, or by `plain` where that cannot be."""
    refused: set[Hashable] = set()
    alone = threading.Lock()  # shares of a batch come from several threads

    def program(structure: Hashable, *arrays: Any) -> _Result:
        kind = structure, jax.tree.structure(arrays)
        if kind not in refused:
            try:
                return fast(structure, *arrays)
            except (NotImplementedError, JaxRuntimeError) as error:
                if "RESOURCE_EXHAUSTED" in str(error) and not isinstance(error, Unsupported):
                    raise
                with alone:
                    if kind not in refused:
                        refused.add(kind)
                        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                        warnings.warn(f"{what} cannot do {reason}: by XLA's own way, slower", stacklevel=2)
        return plain()(structure, *arrays)

    return program
