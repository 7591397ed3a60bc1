"""What margins leave in a folder: the numbers, all walks and a picture; the same from Python and at the shell."""

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mjx_climb import plots
from mjx_climb.files import dataset
from tuning.evaluation import linear_margins, margins
from tuning.evaluation.linear_margins import Stable
from tuning.report.margin_pictures import plot_margins
from tuning.report.numbers import to_json

FILES = "margins.json, margins.nc"  # and the picture


def summary(found: margins.Found, stable: Mapping[str, Stable]) -> dict[str, Any]:
    """Return margins and warnings as plain data, SI units; `needed` is the hardware with a factor of two."""
    each = {
        name: {
            **dataclasses.asdict(margin),
            "needed": margins.needed(name, margin.own),
            "stable": stable[name]._asdict(),
        }
        for name, margin in found.margins.items()
    }
    own = {"holds": found.holds, "better": found.better}
    return {"own_hardware": own, "margins": each, "warnings": warnings(found, stable)}


def warnings(found: margins.Found, stable: Mapping[str, Stable]) -> list[str]:
    """Return in words what speaks against gains: by walks, and by the linearised loop where walks say nothing."""
    return margins.warnings(found) + linear_margins.warnings(found.margins, stable)


def write(
    found: margins.Found,
    stable: Mapping[str, Stable],
    folder: Path,
    given: str = "given gains",
    figures: Collection[str] = ("png",),
) -> str:
    """Write margins into a folder, and return their JSON.

    Arguments:
        found: by walks.
        stable: of the linearised loop.
        folder: where to.
        given: what the gains are called in the picture.
        figures: formats of the picture, of `mjx_climb.plots.FORMATS`.

    Raises:
        OutputError: a file cannot be written.
    """
    text = to_json(summary(found, stable))
    dataset.write_text_atomically(folder / "margins.json", text + "\n")
    dataset.save(found.walks, folder / "margins.nc")
    plots.save_figure(plot_margins(found, given), folder / "margins", figures)
    return text
