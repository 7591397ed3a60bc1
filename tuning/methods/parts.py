"""Finished parts of a long computation, kept in a folder: an interrupted one goes on where it stopped."""

import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np

import mjx_climb as mc
from mjx_climb.execution.cache import version
from mjx_climb.execution.contents import identity
from mjx_climb.files.dataset import PACKAGES
from mjx_climb.files.locks import alone, refused
from mjx_climb.files.writing import OutputError, write_in_place
from mjx_climb.reading import read_found
from mjx_climb.robot_import.load import model_path
from tuning import scenario_files
from tuning.problem.evaluation import Problem

FOLDER = "parts"
IDENTITY = "identity.json"
_DIGEST = 64  # characters


class Parts:
    """The parts of one computation in `out`/parts; in a `with` block they are saved in the background.

    Where `out` is None nothing is kept.
    """

    def __init__(
        self, out: str | os.PathLike[str] | None, identity: Mapping[str, Any] | Callable[[], Mapping[str, Any]]
    ):
        """Claim the folder for the computation that `identity` (plain JSON values) determines bit by bit.

        Raises:
            OutputError: the folder cannot be written, or holds parts of another computation.
        """
        self.out = None if out is None else Path(out)
        self._disk: ThreadPoolExecutor | None = None
        self._saving: Future[None] | None = None
        if self.out is None:
            return
        self.folder = self.out / FOLDER
        self._identity = json.dumps(identity() if callable(identity) else identity)
        wanted = json.loads(self._identity)
        with refused(self.out):
            self.folder.mkdir(parents=True, exist_ok=True)
            with alone(self.folder):
                stored = identity_in(self.folder)
                if stored is None:
                    sealed = {"sha256": _digest(self._identity), "of": wanted}
                    write_in_place(self.folder / IDENTITY, json.dumps(sealed, indent=1).encode())
        if stored not in (None, wanted):
            differs = ", ".join(differences(stored, wanted)) or "its keys"
            raise OutputError(
                f"{out}: expected no unfinished computation but this one, got another that differs in {differs} "
                f"(repeat its command to finish it, remove {self.folder}, or choose another --out)"
            )

    def __enter__(self) -> Self:
        self._disk = ThreadPoolExecutor(1)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait until all is saved, however the block ended; an error of that is raised where no other is."""
        assert self._disk is not None
        self._disk.shutdown()
        saving, self._disk, self._saving = self._saving, None, None
        if saving is not None and kind is None:
            saving.result()

    def load(self, number: int) -> dict[str, np.ndarray] | None:
        """Return a part, None where it is not there, is damaged, or is another part or one of something else."""
        if self.out is None:
            return None
        try:
            content = self._file(number).read_bytes()
        except OSError:
            return None
        if content != self._sealed(number, content[: -_DIGEST - 2] + b"\0\0"):
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return dict(arrays)

    def save(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a part: it is there as a whole or not at all. In a `with` block this returns before it is there.

        Raises:
            OutputError: this part, or in a `with` block the one before it, cannot be written.
        """
        if self.out is None:
            return
        if self._disk is None:
            self._write(number, arrays)
            return
        saving, self._saving = self._saving, None
        if saving is not None:
            saving.result()
        self._saving = self._disk.submit(self._write, number, arrays)

    def _write(self, number: int, arrays: Mapping[str, np.ndarray]) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, **dict[str, Any](arrays))
        write_in_place(self._file(number), self._sealed(number, buffer.getvalue()))

    def _file(self, number: int) -> Path:
        return self.folder / f"part-{number:06d}.npz"

    def _sealed(self, number: int, archive: bytes) -> bytes:
        """Return an archive without a comment with the digest of it, its number and its computation as its comment."""
        return archive[:-2] + _DIGEST.to_bytes(2, "little") + _digest(self._identity, str(number), archive).encode()


def clear(out: Path) -> None:
    """Remove the parts of a computation whose result has been written."""
    shutil.rmtree(Path(out) / FOLDER, ignore_errors=True)


def identity_of(problem: Problem, packages: Mapping[str, str] = PACKAGES) -> dict[str, Any]:
    """Return all that determines the walks of a problem, bit by bit, as plain JSON values.

    Shipped metrics go by their names, as they change with the version; parameters that were drawn, by their ensemble.
    `packages` are names of distributions by their names here.

    Raises:
        Unidentifiable: something of the user's own that cannot be told from another.
    """
    versions = {name: version(distribution) for name, distribution in packages.items()}
    drawn = problem.ensemble
    parameters = problem.parameters if drawn is None else None
    own = {
        "law": problem.law, "objective": problem.own_objective, "method": problem.own_method, "parameters": parameters,
    }  # fmt: skip
    return {
        "scenario": scenario_files.identity(problem.scenario),
        **{name: None if value is None else identity(value, name) for name, value in own.items()},
        "ensemble": None if drawn is None else drawn.model_dump(mode="json"),
        "metrics": [
            m.name if m in mc.METRICS else f"{m.name} {identity(m, f'metric {m.name}')}" for m in problem.metrics
        ],
        "engine": problem.engine,
        "platform": jax.default_backend(),
        "robot_model": hashlib.sha256(model_path(problem.scenario.robot).read_bytes()).hexdigest(),
        "versions": versions,
    }


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
        stored = json.loads(read_found(folder / IDENTITY))
        found: dict[str, Any] = stored["of"]
        return found if isinstance(found, dict) and stored["sha256"] == _digest(json.dumps(found)) else {}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}


def _digest(*contents: str | bytes) -> str:
    return hashlib.sha256(b"".join((c.encode() if isinstance(c, str) else c) + b"\n" for c in contents)).hexdigest()
