"""Pictures on disk, whole or not at all."""

import io
import os
from pathlib import Path

from matplotlib.figure import Figure

from mjx_climb.files.dataset import write_bytes_atomically
from mjx_climb.plots.styling import styled


@styled
def save_figure(figure: Figure, path_stem: str | os.PathLike[str], *, dpi: int = 300) -> tuple[Path, Path, Path]:
    """Write a figure to `path_stem`.png, .svg and .pdf and return the paths.

    Raises:
        OutputError: a file cannot be written.
    """
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # it is laid out now; each format would do it again, and draw twice
    paths = []
    for kind, metadata in (("png", None), ("svg", {"Date": None}), ("pdf", {"CreationDate": None})):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
        paths.append(write_bytes_atomically(f"{os.fspath(path_stem)}.{kind}", buffer.getvalue()))
    return paths[0], paths[1], paths[2]
