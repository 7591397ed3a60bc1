"""What an installation is made of and whether it works, part by part: what `mjx-climb doctor` prints.

Nothing heavy is imported before a part needs it, and a part that cannot be examined is a finding like others.
"""

import dataclasses
import importlib.metadata
import math
import os
import platform
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.command_line import interruption

if TYPE_CHECKING:
    from mjx_climb.checks.self_check import Deviation

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
SIMULATION = ("walk", "gradient")
NVIDIA = Path("/proc/driver/nvidia/version")  # there where the driver is loaded


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of an installation."""

    name: str
    text: str  # one line for people
    facts: dict[str, Any]  # plain values
    findings: tuple[str, ...] = ()  # what is wrong and what to do, one line each


def examine() -> list[Part]:
    """Return all parts, in the order in which they depend on each other."""
    return [
        part for examination in (versions, devices, cache, path, renderer, simulation) for part in _guarded(examination)
    ]


def _guarded(examination: Callable[[], Part | list[Part]]) -> list[Part]:
    interruption.check()
    try:
        found = examination()
    except Exception as error:  # whatever it is, the other parts are still of interest
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return [Part(examination.__name__, "could not be examined", {}, (reason,))]
    return found if isinstance(found, list) else [found]


def versions() -> Part:
    """Return the versions of what computes."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    found |= {name: _version(name) for name in ("mjx-climb", *PACKAGES)}
    missing = [name for name in PACKAGES if found[name] is None]
    findings = [f"{name} is not installed: python -m pip install mjx-climb" for name in missing]
    engine, mjx = found["mujoco"], found["mujoco-mjx"]
    if not missing and engine != mjx:
        findings.append(f'mujoco {engine} with mujoco-mjx {mjx}: python -m pip install "mujoco=={mjx}"')
    text = ", ".join(f"{name} {version or '(not installed as a package)'}" for name, version in found.items())
    return Part("versions", text, found, tuple(findings))


def devices() -> Part:
    """Return what the simulations run on."""
    import jax

    from mjx_climb.execution.devices import usable_cores

    found = [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices()]
    facts = {"backend": jax.default_backend(), "devices": found, "cores": usable_cores()}
    text = f"{', '.join(found)}; {facts['cores']} CPU cores usable"
    return Part("devices", text, facts, _unused_gpu() if facts["backend"] == "cpu" else ())


def _unused_gpu() -> tuple[str, ...]:
    """Return what keeps JAX from an NVIDIA GPU of this machine, where it has one and nobody asked for the CPU."""
    if not NVIDIA.exists() or "cpu" in os.environ.get("JAX_PLATFORMS", "").lower():
        return ()
    plugins = [f"jax-cuda{major}-plugin" for major in (12, 13)]
    if not any(_version(plugin) for plugin in plugins):
        return ('an NVIDIA GPU is here and JAX has no plugin for it: python -m pip install "mjx-climb[cuda13]"',)
    return ("an NVIDIA GPU is here, but JAX's plugin does not start: is the driver new enough for it?",)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def cache() -> Part:
    """Return the state of XLA's compilation cache."""
    from mjx_climb.execution.cache import VARIABLE, asked_folder, cache_in_use, doubt

    folder = cache_in_use()
    if folder is None:
        text = f"off ({VARIABLE}): every start compiles again"
        asked = asked_folder()
        why = None if asked is None else doubt(asked)
        return Part("cache", text, {"on": False, "folder": None}, () if why is None else (why,))
    sizes = [file.stat().st_size for file in Path(folder).glob("*-cache")]
    facts = {"on": True, "folder": folder, "programs": len(sizes), "bytes": sum(sizes), "writable": True}
    text = f"{folder}, {len(sizes)} programs, {sum(sizes) / 1e6:.0f} MB"
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        remedy = f"set {VARIABLE} to a folder that can be, or to off"
        reason = (error.strerror or str(error)).lower()
        finding = f"{folder} cannot be written ({reason}), so every start compiles again: {remedy}"
        return Part("cache", text, {**facts, "writable": False}, (finding,))
    return Part("cache", text, facts)


def path() -> Part:
    """Return by which path robots walk: the fast one for this device, where a trial of it went well, or XLA's own."""
    from mjx_climb.execution import paths, probe

    fast = paths.fast_path()
    if fast is None:
        return Part("path", "XLA's own: none faster is made for this device", {"path": None})
    found = probe.verdict(fast)
    if not found.works:
        remedy = "walks are right, but slower; the versions of jax and jaxlib in pyproject.toml are known to work"
        finding = f"{probe.PATHS[fast]} cannot be used here ({found.seen}): {remedy}"
        return Part("path", "XLA's own", {"path": None}, (finding,))
    return Part("path", f"{probe.PATHS[fast]}, {found.seen}", {"path": fast})


def renderer() -> Part:
    """Return which OpenGL renders pictures and videos."""
    from mjx_climb.rendering import RenderingError, backend

    if os.environ.get("MUJOCO_GL", "").lower().strip() in backend.OFF:
        return Part("renderer", "off (MUJOCO_GL)", {"backend": None})
    try:
        found = backend.find()
    except RenderingError as error:
        return Part("renderer", "none: no videos, no snapshots", {"backend": None}, (str(error),))
    return Part("renderer", found, {"backend": found})


def simulation() -> list[Part]:
    """Return how far walk, gradient and dynamics on this machine are from the stored values."""
    from mjx_climb.checks import self_check

    with warnings.catch_warnings():
        # what `cache` has found already
        warnings.filterwarnings("ignore", ".*persistent compilation cache", UserWarning)
        measured = self_check.measure()
    found = self_check.deviations(measured, self_check.load())
    dynamics = {name: found[name] for name in found if name not in SIMULATION}
    groups = {"dynamics": dynamics, **{name: {name: found[name]} for name in SIMULATION}}
    return [_compared(name, group, self_check.TOLERANCE) for name, group in groups.items()]


def _compared(name: str, group: "Mapping[str, Deviation]", tolerance: float) -> Part:
    largest = max(deviation.size for deviation in group.values())
    findings = tuple(
        f"{source}: {found.name} is {found.value}, stored is {found.stored}"
        for source, found in group.items()
        if not found.size <= tolerance
    )
    what = f"{', '.join(group)} " if len(group) > 1 else ""
    text = f"{what}{'off' if findings else 'as stored'}, largest relative deviation {largest:.1g} (limit {tolerance:g})"
    sizes = {source: found.size if math.isfinite(found.size) else None for source, found in group.items()}
    return Part(name, text, {"deviation": sizes}, findings)


def verdict(parts: list[Part]) -> str:
    """Return the outcome in one sentence."""
    wrong = [part.name for part in parts if part.findings]
    if not wrong:
        return "All is well: physics and gradients on this machine are those stored with the package."
    return f"Something is wrong with {' and '.join([', '.join(wrong[:-1]), wrong[-1]] if len(wrong) > 1 else wrong)}."
