"""Finished parts of a long computation, kept in a folder: what is interrupted goes on where it stopped."""

import contextlib
import hashlib
import io
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.files.writing import OutputError, write_bytes_atomically, write_text_atomically

Save = Callable[[int, Mapping[str, np.ndarray]], None]

FOLDER = "parts"
IDENTITY = "identity.json"
_SEAL = 64  # characters of a digest


class Parts:
    """The parts that belong to one computation; another one finds the folder taken."""

    def __init__(self, out: Path, identity: Mapping[str, Any]):
        """Claim `out`/parts for the computation that `identity` (plain JSON values) determines bit by bit.

        Raises:
            OutputError: the folder cannot be written, or holds parts of another computation.
        """
        self.folder = Path(out) / FOLDER
        self._identity = json.dumps(identity)
        wanted = json.loads(self._identity)
        stored = identity_in(self.folder)
        if stored is not None and stored != wanted:
            differs = ", ".join(differences(stored, wanted)) or "its keys"
            raise OutputError(
                f"{out}: expected no unfinished sweep but this one, got another that differs in {differs} "
                f"(repeat its command to finish it, remove {self.folder}, or choose another --out)"
            )
        if stored is None:
            sealed = {"sha256": _digest(self._identity), "of": wanted}
            write_text_atomically(self.folder / IDENTITY, json.dumps(sealed, indent=1))

    def _file(self, number: int) -> Path:
        return self.folder / f"part-{number:06d}.npz"

    def load(self, number: int) -> dict[str, np.ndarray] | None:
        """Return a part, None where it is not there, is damaged, or is another part or one of something else."""
        try:
            content = self._file(number).read_bytes()
        except OSError:
            return None
        if content != self._sealed(number, content[: -_SEAL - 2] + b"\0\0"):
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return dict(arrays)

    def save(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a part: it is there as a whole or not at all."""
        buffer = io.BytesIO()
        contents: dict[str, Any] = dict(arrays)
        np.savez(buffer, **contents)
        write_bytes_atomically(self._file(number), self._sealed(number, buffer.getvalue()))

    def _sealed(self, number: int, archive: bytes) -> bytes:
        """Return an archive without a comment with the digest of it, its number and its computation as its comment."""
        seal = _digest(self._identity, str(number), archive)
        return archive[:-2] + _SEAL.to_bytes(2, "little") + seal.encode()


@contextlib.contextmanager
def saved_beside(parts: Parts | None) -> Iterator[Save]:
    """Give what saves a part while the next one is worked out, or nothing where there are no parts.

    At the end all are saved, whatever ended it. What goes wrong is raised when the next part is to be saved, or at the
    end.
    """
    last: list[Future[None]] = []

    def save(number: int, arrays: Mapping[str, np.ndarray]) -> None:
        if parts is not None:
            while last:
                last.pop().result()
            last.append(disk.submit(parts.save, number, arrays))

    with ThreadPoolExecutor(1) as disk:
        yield save
    while last:
        last.pop().result()


def clear(out: Path) -> None:
    """Remove the parts of a computation whose result has been written."""
    shutil.rmtree(Path(out) / FOLDER, ignore_errors=True)


def differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Return the keys that differ, and where they hold mappings of the same keys which of these, as axes.damping."""
    found = []
    for key, value in wanted.items():
        other = stored.get(key)
        if isinstance(value, Mapping) and isinstance(other, Mapping) and set(value) == set(other):
            found += [f"{key}.{inner}" for inner in differences(other, value)]
        elif other != value:
            found.append(key)
    return found


def identity_in(folder: Path) -> dict[str, Any] | None:
    """Return the identity that the parts in a folder have: None where there is none, empty where it is damaged."""
    try:
        stored = json.loads((folder / IDENTITY).read_text())
        found = stored["of"]
        whole = isinstance(found, dict) and stored["sha256"] == _digest(json.dumps(found))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    return found if whole else {}


def _digest(*contents: str | bytes) -> str:
    """Return a digest of some contents, of length `_SEAL`."""
    digest = hashlib.sha256()
    for content in contents:
        digest.update((content.encode() if isinstance(content, str) else content) + b"\n")
    return digest.hexdigest()
