"""Pictures on disk, whole or not at all."""

import io
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mjx_climb.files.dataset import write_bytes_atomically
from mjx_climb.plots.styling import styled

_METADATA: dict[str, dict[str, Any] | None] = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
FORMATS = tuple(_METADATA)


@styled
def save_figure(
    figure: Figure, path_stem: str | os.PathLike[str], formats: Collection[str] = ("png",), *, dpi: int = 300
) -> tuple[Path, ...]:
    """Write a figure to `path_stem`.png, or in other formats of `FORMATS`, and return the paths in their order.

    Raises:
        OutputError: a file cannot be written.
        ValueError: a format that is none.
    """
    if unknown := [kind for kind in formats if kind not in FORMATS]:
        raise ValueError(f"formats: expected some of {', '.join(FORMATS)}, got {unknown[0]!r}")
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # it is laid out now; each format would do it again
    paths = []
    for kind in formats:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=_METADATA[kind])
        paths.append(write_bytes_atomically(f"{os.fspath(path_stem)}.{kind}", buffer.getvalue()))
    return tuple(paths)
