"""The cache of compiled programs, as `doctor` and every command tell of it."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Part(NamedTuple):
    """One part of an installation."""

    name: str
    text: str  # one line for people
    facts: dict[str, Any]  # plain values
    findings: Sequence[str] = ()  # faults and their remedies, one line each


def cache() -> Iterator[Part]:
    """Yield the state of XLA's compilation cache."""
    from mjx_climb.execution.cache import VARIABLE, asked_folder, cache_in_use, doubt

    if (folder := cache_in_use()) is None:
        finding = None if (asked := asked_folder()) is None else doubt(asked)
        text, facts = f"off ({VARIABLE}): every start compiles again", {"on": False, "folder": None}
        yield Part("cache", text, facts, [finding] if finding else [])
        return
    # XLA's own, and executables beside them
    files = [*Path(folder).glob("*-cache"), *(file for file in Path(folder).glob("programs/*") if file.is_file())]
    sizes, findings = [file.stat().st_size for file in files], []
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        remedy = f"set {VARIABLE} to a folder that can be, or to off"
        reason = (error.strerror or str(error)).lower()
        findings.append(f"{folder} cannot be written ({reason}), so every start compiles again: {remedy}")
    text = f"{folder}, {len(sizes)} programs, {sum(sizes) / 1e6:.0f} MB"
    counts = {"programs": len(sizes), "bytes": sum(sizes), "writable": not findings}
    yield Part("cache", text, {"on": True, "folder": folder, **counts}, findings)
