"""`mjx-climb plot`: the pictures of a result once more."""

from pathlib import Path
from typing import Annotated

import typer
from pydantic import BeforeValidator

from tuning.command_line.from_models import command
from tuning.command_line.options import FIGURES, Figures
from tuning.command_line.program import user_error
from tuning.problem.settings import Options, setting


def _inches(text: str) -> tuple[float, float]:
    try:
        width, height = (float(part) / 25.4 for part in text.lower().split("x"))
    except ValueError:
        raise ValueError(f"expected WxH in mm, as 180x120, got {text!r}") from None
    if not (0.4 <= width <= 100 and 0.4 <= height <= 100):
        raise ValueError(f"expected 10 to 2540 mm each way, got {text!r}")
    return width, height


def _style(sheet: str) -> dict[str, object]:
    """Return the settings of a style sheet, a file's or one of matplotlib's by name."""
    from matplotlib import rc_params_from_file, style

    try:
        named = style.library.get(sheet)
        found = rc_params_from_file(sheet, use_default_template=False) if named is None else named
    except (OSError, ValueError) as error:
        raise ValueError(f"expected a style sheet of matplotlib's, got {sheet!r}: {error}") from None
    return {str(name): value for name, value in found.items()}


class Plot(Options):
    """What is drawn, and how."""

    folder: Path = setting(..., "folder of a result, as a command wrote it", metavar="FOLDER", argument=True)
    metric: tuple[str, ...] = setting(
        (), "metric to draw by itself, of a map or an ensemble", metavar="NAME", complete="metric"
    )
    figures: Figures = FIGURES
    out: Path | None = setting(None, "folder for the pictures; null: FOLDER", metavar="DIR")
    size: Annotated[tuple[float, float] | None, BeforeValidator(_inches)] = setting(
        None, "width and height, mm; null: a column of a paper", metavar="WxH"
    )
    dpi: int = setting(300, "dots per inch of PNG", ge=20, le=2400)
    style: Annotated[dict[str, object], BeforeValidator(_style)] = setting(
        {}, "style sheet of matplotlib's, over this program's own", metavar="FILE"
    )


@command()
def plot(asked: Plot) -> None:
    """Draw the pictures of a result again: any metric, format, size and style. Nothing is walked.

    For what run, sweep, tune, pareto and schedule wrote.

    \b
    Examples:
      mjx-climb plot results/case_1_2-sweep --metric peak_pull_force --metric min_tsm
      mjx-climb plot results/case_1_2-tune --figures svg,pdf --out paper
      mjx-climb plot results/case_2-pd --size 180x200 --style journal.mplstyle
    """
    from mjx_climb import ConfigError, plots
    from tuning.output import redrawn

    folder, out = asked.folder, asked.out or asked.folder
    with plots.over_style(asked.style):
        try:
            for name, figure in redrawn.figures(folder, asked.metric):
                if asked.size is not None:
                    figure.set_size_inches(*asked.size)
                for path in plots.save_figure(figure, out / name, asked.figures, dpi=asked.dpi):
                    typer.echo(path)
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
            if user_error(error):
                raise
            # a file of another program, or one with gaps
            got = f"one that cannot be drawn ({type(error).__name__}: {error})"
            raise ConfigError(
                f"{folder}: expected a result as a command wrote it, with all its files, got {got}"
            ) from None
