"""How pictures look, and how they are written: colours, letters, lines, legends, files."""

import contextlib
import io
import os
import weakref
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text

from mjx_climb.files.dataset import write_bytes_atomically

COLUMN = 3.5  # inch, width of a column of a paper

# Colours that the colour-blind can tell apart: Okabe & Ito, "Color Universal Design", 2008
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
LIMB_COLORS = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY, "#8C6D31", "#4D4D4D")
AXIS_COLORS = (VERMILLION, SKY, BLACK)
# colour and width: the baseline is a broad band, so that lines on top of it do not hide it
SERIES = (("0.65", 1.8), (VERMILLION, 0.8), (BLUE, 0.8), (GREEN, 0.8), (ORANGE, 0.8), (PURPLE, 0.8))
RED = "#D00000"  # a limit that must not be passed: a torn gripper; on maps the baseline and the limit of stability
CARGO, PUSH = "#F6F0E1", "#DCE9F4"
GREY = "#BDBDBD"
SAME = "#EDEDED"  # a map on which all walks are equal
HELD = "#DDEFD9"  # on a map of detachments, the walks without any

_STYLE: dict[Any, Any] = dict(
    mpl.rc_params_from_file(Path(__file__).with_name("column.mplstyle"), use_default_template=False)
)
_METADATA: dict[str, dict[str, None] | None] = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
FORMATS = tuple(_METADATA)


@contextlib.contextmanager
def style() -> Iterator[None]:
    """Draw in the style of this package, `with plots.style(): ...`; matplotlib's own settings come back afterwards."""
    with mpl.rc_context(_STYLE):
        yield


@contextlib.contextmanager
def over_style(settings: Mapping[str, object]) -> Iterator[None]:
    """Put settings of matplotlib's over the style of this package for all that is drawn and saved in the context."""
    before = _STYLE.copy()
    _STYLE.update(settings)
    try:
        yield
    finally:
        _STYLE.clear()
        _STYLE.update(before)


def key(label: str, **look: Any) -> Line2D:
    """A line of a legend with the look of its series."""
    return Line2D([], [], label=label, **look)


def legend(figure: Figure, handles: Sequence[Artist], title: str | None = None) -> None:
    """Put a legend, and a title over it, above the panels, with as many columns as fit."""
    width = 0.055 * max(len(str(handle.get_label())) for handle in handles) + 0.35  # inch
    figure.legend(
        handles=handles, title=title, title_fontsize=8.5, loc="outside upper center",
        ncols=min(len(handles), max(1, int(COLUMN / width))), handlelength=1.4, columnspacing=1.0, handletextpad=0.4,
        borderaxespad=0.2,
    )  # fmt: skip


def legend_below(figure: Figure, handles: Sequence[Artist], columns: int) -> None:
    """Put a legend below the panels, in so many columns or in as many as the figure is wide enough for."""
    for count in range(min(columns, len(handles)), 0, -1):
        legend = figure.legend(
            handles=handles, loc="outside lower center", ncols=count, columnspacing=1.2, handletextpad=0.5,
            borderaxespad=0.3,
        )  # fmt: skip
        if count == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


@style()
def save_figure(
    figure: Figure, path_stem: str | os.PathLike[str], formats: Collection[str] = ("png",), *, dpi: int = 300
) -> tuple[Path, ...]:
    """Write a figure to `path_stem`.png, or in other formats of `FORMATS`, and return the paths in their order.

    Each file is either whole or not there.

    Raises:
        OutputError: a file cannot be written.
        ValueError: a format that is none.
    """
    if unknown := [kind for kind in formats if kind not in FORMATS]:
        raise ValueError(f"formats: expected some of {', '.join(FORMATS)}, got {unknown[0]!r}")
    ahead, paths = _AHEAD.pop(figure, {}), []
    for kind in formats:
        content = ahead.get((kind, dpi)) or _rendered(figure, kind, dpi)
        paths.append(write_bytes_atomically(f"{os.fspath(path_stem)}.{kind}", content))
    return tuple(paths)


# files of figures that nothing changes until they are saved, by format and resolution
_AHEAD: weakref.WeakKeyDictionary[Figure, dict[tuple[str, int], bytes]] = weakref.WeakKeyDictionary()


@style()
def render_ahead(figure: Figure, kind: str, *, dpi: int = 300) -> None:
    """Make the file of a figure that the next `save_figure` writes."""
    _AHEAD.setdefault(figure, {})[kind, dpi] = _rendered(figure, kind, dpi)


def _rendered(figure: Figure, kind: str, dpi: int) -> bytes:
    """Return the file of a figure."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        try:
            for line in text.get_text().split("\n"):
                if line.count("$") > 1:
                    MathTextParser("path").parse(line)
        except ValueError:  # text between dollars, as in a limb's name, need not be mathematics
            text.set_parse_math(False)
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # it is laid out now; each format would do it again
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi, metadata=_METADATA[kind])
    return buffer.getvalue()
