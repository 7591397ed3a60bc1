"""What a compiled program depends on beside what it is made of: versions, processor, devices, XLA's flags."""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path

import jax

_VERSIONED = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx")


@functools.cache
def machine() -> str:
    """Return what is the same for all programs of this process, as text."""
    versions = [importlib.metadata.version(name) for name in _VERSIONED]
    devices = [f"{device.platform} {device.device_kind} {device.id}" for device in jax.devices()]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    return repr([*versions, platform.python_version(), platform.machine(), _processor(), *devices, *flags])


@functools.cache
def source_digest(folder: Path) -> str:
    """Return a digest of all code and models below a folder."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".py", ".xml"):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.hexdigest()


def _processor() -> str:
    """Return the processor's instruction sets, where the system tells: a program made for others cannot run."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as lines:
        told = (line for line in lines if line.startswith(("model name", "flags", "Features")))
        return " ".join(sorted(set(told)))
    return platform.processor()
