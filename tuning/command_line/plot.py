"""`mjx-climb plot`: the pictures of a result once more."""

from pathlib import Path
from typing import Annotated

import typer

from tuning.command_line import completion, options
from tuning.command_line.ending import InputError, user_error


def plot(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a result, as a command wrote it.")],
    metric: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Metric to draw by itself, of a map or an ensemble; may be given several times.",
            autocompletion=completion.metric,
        ),
    ] = None,
    figures: options.Figures = "png",
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the pictures.", show_default="FOLDER")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Width and height, mm.", show_default="a column of a paper")
    ] = None,
    dpi: Annotated[int, typer.Option(min=20, max=2400, metavar="N", help="Dots per inch of PNG.")] = 300,
    style: Annotated[
        str | None, typer.Option(metavar="FILE", help="Style sheet of matplotlib's, over this program's own.")
    ] = None,
) -> None:
    """Draw the pictures of a result again: any metric, format, size and style. Nothing is walked.

    For what run, sweep, tune, pareto and schedule wrote.

    \b
    Examples:
      mjx-climb plot results/case_1_2-sweep --metric peak_pull_force --metric min_tsm
      mjx-climb plot results/case_1_2-tune --figures svg,pdf --out paper
      mjx-climb plot results/case_2-pd --size 180x200 --style journal.mplstyle
    """
    formats = options.figures_from(figures)
    inches = None if size is None else _inches(size)
    from mjx_climb import ConfigError, plots
    from tuning.output import redrawn

    out = out or folder
    with plots.over_style(_style(style)):
        try:
            for name, figure in redrawn.figures(folder, metric or ()):
                if inches is not None:
                    figure.set_size_inches(*inches)
                for path in plots.save_figure(figure, out / name, formats, dpi=dpi):
                    typer.echo(path)
        except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
            if user_error(error):
                raise
            # a file of another program, or one with gaps
            got = f"one that cannot be drawn ({type(error).__name__}: {error})"
            raise ConfigError(
                f"{folder}: expected a result as a command wrote it, with all its files, got {got}"
            ) from None


def _inches(text: str) -> tuple[float, float]:
    try:
        width, height = (float(part) / 25.4 for part in text.lower().split("x"))
    except ValueError:
        raise InputError(f"--size: expected WxH in mm, as 180x120, got {text!r}") from None
    if not (0.4 <= width <= 100 and 0.4 <= height <= 100):
        raise InputError(f"--size: expected 10 to 2540 mm each way, got {text!r}")
    return width, height


def _style(sheet: str | None) -> dict[str, object]:
    """Return the settings of a style sheet, a file's or one of matplotlib's by name."""
    if sheet is None:
        return {}
    from matplotlib import style

    try:
        named = style.library.get(sheet)
        return _of_file(sheet) if named is None else {str(name): value for name, value in named.items()}
    except (OSError, ValueError) as error:
        raise InputError(f"--style: expected a style sheet of matplotlib's, got {sheet!r}: {error}") from None


def _of_file(sheet: str) -> dict[str, object]:
    from matplotlib import rc_params_from_file

    return {str(name): value for name, value in rc_params_from_file(sheet, use_default_template=False).items()}
