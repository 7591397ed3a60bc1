"""Pictures on disk, whole or not at all."""

import io
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text

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
    _take_names_as_they_stand(figure)
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # it is laid out now; each format would do it again
    paths = []
    for kind in formats:
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=_METADATA[kind])
        paths.append(write_bytes_atomically(f"{os.fspath(path_stem)}.{kind}", buffer.getvalue()))
    return tuple(paths)


def _take_names_as_they_stand(figure: Figure) -> None:
    """Have text that holds dollars and is no mathematics, a limb's name for example, drawn as it stands."""
    parser = MathTextParser("path")
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        try:
            for line in text.get_text().split("\n"):
                if line.count("$") > 1:
                    parser.parse(line)
        except ValueError:
            text.set_parse_math(False)
