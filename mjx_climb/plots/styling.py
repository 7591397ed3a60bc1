"""How pictures look: the width of a column, letters and lines, legends."""

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

COLUMN = 3.5  # inch, width of a column

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 7.5,
    "axes.labelsize": 7.5,
    "axes.titlesize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "lines.linewidth": 0.8,
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.6,
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": False,
    "svg.hashsalt": "mjx_climb",
    "pdf.fonttype": 42,  # TrueType: publishers refuse Type 3
}


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


_OVER: ContextVar[Mapping[str, Any]] = ContextVar("_OVER", default=MappingProxyType({}))


def style() -> AbstractContextManager[None]:
    """Return a context in which matplotlib draws in this module's style: `with plots.style(): ...`."""
    settings: dict[Any, Any] = dict(_OVER.get())
    return mpl.rc_context(_STYLE | settings)


@contextlib.contextmanager
def over_style(settings: Mapping[str, Any]) -> Iterator[None]:
    """Put settings of matplotlib's over this module's style for all that is drawn and saved in the context."""
    before = _OVER.set(settings)
    try:
        yield
    finally:
        _OVER.reset(before)


def styled(draw: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Run a drawing function in this module's style and leave matplotlib's own as it was."""

    @functools.wraps(draw)
    def styled(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with style():
            return draw(*args, **kwargs)

    return styled


def legend(figure: Figure, handles: Sequence[Artist], title: str | None = None) -> None:
    """Put a legend, and a title over it, above the panels, with as many columns as fit."""
    width = 0.055 * max(len(str(handle.get_label())) for handle in handles) + 0.35  # inch
    figure.legend(
        handles=handles,
        title=title,
        title_fontsize=8.5,
        loc="outside upper center",
        ncols=min(len(handles), max(1, int(COLUMN / width))),
        handlelength=1.4,
        columnspacing=1.0,
        handletextpad=0.4,
        borderaxespad=0.2,
    )


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


def legend_inside(panel: Axes, names: Sequence[str], colors: Sequence[str], extra: Sequence[Line2D] = ()) -> None:
    """Put a legend of coloured lines into a panel, above what it shows."""
    handles = [Line2D([], [], color=color, label=name) for name, color in zip(names, colors, strict=True)]
    panel.legend(
        handles=[*handles, *extra],
        loc="upper left",
        ncols=4,
        handlelength=1.0,
        columnspacing=0.7,
        handletextpad=0.3,
        borderaxespad=0.1,
        fontsize=6.5,
    )


def leave_headroom(panel: Axes, share: float = 0.3) -> None:
    """Leave room above the lines for a legend."""
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + share * (high - low))
