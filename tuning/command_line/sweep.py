"""`mjx-climb sweep`: a grid of stiffness and damping."""

import importlib
import math
import shlex
import time
from collections.abc import Iterable, Mapping
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.command_line import launcher, options, processes
from tuning.command_line.ending import InputError, kept_in

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    import mjx_climb as mc
    from tuning.output.swept import Judged, Swept

LARGEST_AXIS = 100_000
SMALLEST, LARGEST = 1e-30, 1e30  # what single precision holds, with room for squares of moderate gains
WORTH_A_WORD = 600.0  # s; of shorter sweeps progress says enough
RANGE = "LOW:HIGH:COUNT"


def sweep(
    config: options.Config,
    stiffness: Annotated[
        str | None,
        typer.Option(
            metavar=RANGE,
            help="Virtual stiffness K, N/m and N m/rad: evenly spaced on a logarithmic scale.",
            show_default=False,
        ),
    ] = None,
    damping: Annotated[
        str | None,
        typer.Option(
            metavar=RANGE, help="Virtual damping D, N s/m and N m s/rad, spaced likewise.", show_default=False
        ),
    ] = None,
    axis: Annotated[
        list[str] | None,
        typer.Option(
            metavar=f"NAME={RANGE}",
            help="Gain of the law, SI units, spaced likewise; in place of either of these, or twice for both.",
            show_default=False,
        ),
    ] = None,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    gains: options.GainsFile = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-sweep"),
    ] = None,
    batch_size: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Robots that walk at a time.", show_default="parts of a few seconds"),
    ] = None,
    shard: options.Shard = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Walk a grid of stiffness and damping, or of two other gains, the same on all axes, in single precision.

    Prints the best gains (least force variation among the walks in which all grippers hold), the config's own and pd
    side by side, walked again in double precision. Writes to DIR the grid (sweep.nc, opens with xarray), a sheet with a
    map of each metric and the law's limit of stability (maps.png), the table (comparison.json), the resolved scenario
    (config.yaml), and all of it with the walks over time as a page for a browser (report.html). `mjx-climb plot DIR`
    draws each of them by itself.

    Finished parts are kept in DIR: after Ctrl-C, or worse, the same command goes on where it stopped. A gains file
    gives the inertia and the joint gains of the grid, and a further walk to compare with.

    With --shard, or as a task of a Slurm array, a sweep is spread over machines: each walks its part of the grid into
    a folder below DIR, and `mjx-climb merge DIR` writes what one machine would have written.

    \b
    Examples:
      mjx-climb sweep case_1_2 --stiffness 1e2:1e6:16 --damping 1e0:1e5:16
      mjx-climb sweep case_2 --stiffness 1e3:1e5:8 --damping 1e1:1e4:8 --gains best.yaml
      mjx-climb sweep case_2 --stiffness 1e2:1e6:128 --damping 1e0:1e5:128 --shard 3/16
      mjx-climb sweep case_2 --law my_law.py:Filtered --axis cutoff=1:100:8 --damping 1e1:1e4:8
    """
    with processes.joined(apart=shard is not None) as team, options.reserved_stdout() as stdout:
        axes = axes_from(stiffness, damping, axis)
        part, which = launcher.shard_from(shard)
        from tuning.command_line import progress, report
        from tuning.gains.gains_file import replaced
        from tuning.output.ahead import ahead
        from tuning.output.beside import beside
        from tuning.output.folder import check_own
        from tuning.searches import grid, shards

        begin = time.perf_counter()
        scenario, user_law, table = options.asked(config, controller, changes, hardware, law, metric)
        values = options.gains_from(gains, user_law)
        engine = options.engine_from(engine)
        formats = options.figures_from(figures)
        if user_law is None and scenario.control.controller == "pd":
            raise InputError("--controller: expected a law with gains to sweep, got pd")
        try:
            grid.checked_axes(scenario, user_law, None, None, axes)
        except ValueError as error:
            raise InputError(str(error).replace("axes", "--axis", 1).replace("--axis.", "--axis ", 1)) from None
        out = team.folder(out or Path("results") / f"{config.stem}-sweep")
        check_own(out, "sweep.nc")
        walked, walking = (scenario, user_law) if values is None else replaced(scenario, user_law, values)
        how: dict[str, Any] = {"batch_size": batch_size, "engine": engine, "metrics": table}
        again = _again(stiffness, damping, axis, batch_size)
        again += f"{options.engine_option(engine)} --out again"
        one = None if part is None else shards.made(*part)
        there = grid.claim(walked, axes=axes, law=walking, out=out, shard=one, **how)
        console = report.console(stderr=True)
        said = [text for text in (which, team.said) if text]
        walks = math.prod(map(len, axes.values()))
        here = walks if one is None else len(one.rows(walks))
        console.print(_announcement(walked, axes, engine, said, there, here), soft_wrap=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)

        team.begin(out if one is None else one.folder(out), walked)
        if one is not None:
            told = {"again": options.typed_but("--shard", shards.SHARD), "name": config.stem, "repeat": again}
            from tuning.output import swept

            swept.keep_beside(one, out, scenario, user_law, values, table, told)
            with kept_in(one.folder(out), f"of {here} walks", there) as kept, meter.stage("grid") as show:
                grid.sweep_shard(walked, one, out=out, axes=axes, law=walking, progress=kept.told(show), **how)
            text = f"{one.folder(out)} is whole; once all {one.count} are: mjx-climb merge {shlex.quote(str(out))}"
            console.print(text, soft_wrap=True)
            if json:
                print(dumps({"shard": one.number, "of": one.count, "walks": here}), file=stdout)
            return

        with kept_in(out, f"of {walks} walks", there) as kept, ahead() as begin_work:
            begin_work(lambda _: importlib.import_module("tuning.output.swept"))  # 0.4 s, matplotlib's most of all
            compared = beside(scenario, user_law, values, axes, engine, begin_work)
            with meter.stage("grid") as show:
                data = grid.sweep(walked, axes=axes, law=walking, out=out, progress=kept.told(show), **how)
            from tuning.output import swept

            found = swept.Swept(data, scenario, user_law, values, table, engine)
            origin = options.origin(config.stem, again)
            judged = found.write(out, origin=origin, figures=formats, stage=meter.stage, compared=compared)

        print_result(found, judged, console if json else report.console(file=stdout))
        seconds = progress.duration(time.perf_counter() - begin)
        console.print(f"written to {out} in {seconds}: {swept.FILES}", soft_wrap=True)
        if json:
            print(judged.summary, file=stdout)


def print_result(found: "Swept", judged: "Judged", console: "Console") -> None:
    """Print the table and the outcome of a sweep."""
    from tuning.command_line import report

    console.print(report.comparison_table(judged.compared, "pd", console.width, found.metrics, found.law))
    for line in _outcome(judged, found.axes):
        console.print(line)


def _outcome(judged: "Judged", axes: Iterable[str]) -> list[str]:
    """Return in lines what is best."""
    from tuning.report.remarks import remarks

    walks = judged.data["diverged"].size
    lines = [] if judged.worth is None else [judged.worth.in_words]
    lines += remarks({name: metrics for name, (_, metrics) in judged.compared.items()})
    if judged.best is None:
        return [f"no walk of the grid held: all {walks} detached or diverged", *lines]
    best = ", ".join(f"{name} {judged.best[name].item():.4g}" for name in axes)
    edges = [f"the best lies on the edge of the grid: widen {_option(name)}" for name in judged.at_edge]
    return [f"best: {best} ({judged.failed} of {walks} walks detached or diverged)", *edges, *lines]


def axes_from(stiffness: str | None, damping: str | None, axis: list[str] | None) -> "dict[str, np.ndarray]":
    """Return the values along both axes by the name of the gain, the horizontal one first.

    Raises:
        InputError: not two gains, or ranges that are none.
    """
    texts = {name: (f"--{name}", text) for name, text in (("stiffness", stiffness), ("damping", damping)) if text}
    for pair in axis or ():
        name, equals, text = pair.partition("=")
        if not equals or name in texts:
            raise InputError(f"--axis: expected NAME={RANGE}, each gain once, got {pair!r}")
        texts[name] = f"--axis {name}", text
    if len(texts) != 2:
        raise InputError(
            f"--stiffness, --damping, --axis: expected two gains to sweep, got {', '.join(texts) or 'none'}"
        )
    return {name: log_range(*text) for name, text in texts.items()}


def _option(name: str) -> str:
    return f"--{name}" if name in ("stiffness", "damping") else f"--axis {name}"


def log_range(option: str, text: str) -> "np.ndarray":
    """Return the values of low:high:count, evenly spaced on a logarithmic scale.

    Raises:
        InputError: anything but 0 < low < high and a count of 2 or more.
    """

    def refuse(why: str) -> InputError:
        return InputError(f"{option}: expected {RANGE} with 0 < LOW < HIGH and COUNT 2 or more, got {text!r}: {why}")

    fields = text.split(":")
    if len(fields) != 3:
        raise refuse(f"{len(fields)} part{'s' if len(fields) != 1 else ''} instead of 3")
    ends = []
    for name, field in zip(("LOW", "HIGH"), fields[:2], strict=True):
        try:
            ends.append(float(field))
        except ValueError:
            raise refuse(f"{name} is not a number") from None
        if not SMALLEST <= ends[-1] <= LARGEST:
            raise refuse(f"{name} is not between {SMALLEST:g} and {LARGEST:g}")
    low, high = ends
    if not low < high:
        raise refuse("LOW is not below HIGH")
    try:
        count = int(fields[2])
    except ValueError:
        raise refuse("COUNT is not a whole number") from None
    if not 2 <= count <= LARGEST_AXIS:
        raise refuse(f"COUNT is not between 2 and {LARGEST_AXIS}")
    import numpy as np

    values = np.geomspace(low, high, count)
    if not (np.diff(values.astype(np.float32)) > 0).all():
        raise refuse("the values are too close to tell apart in single precision")
    return values


def _announcement(
    scenario: "mc.Scenario", axes: "Mapping[str, np.ndarray]", engine: str, said: list[str], kept: int, here: int
) -> str:
    import jax

    from mjx_climb.compilation.options import walks_on_host
    from tuning.command_line import progress
    from tuning.searches import grid

    walks = math.prod(map(len, axes.values()))
    sizes = " x ".join(f"{len(values)} {name}" for name, values in axes.items())
    text = f"{walks} walks ({sizes}) of {scenario.steps} steps"
    where = "cpu" if walks_on_host(walks, engine, "float32") else None  # too few for a GPU
    device = jax.devices(where)[0]
    text += f" on {device.device_kind}"
    seconds = grid.expected_duration(here - kept, scenario.steps, device.platform)
    if seconds > WORTH_A_WORD:
        said = [*said, f"expect some {progress.duration(seconds)}, or spread them over machines with --shard"]
    return "; ".join([text, *said, *([f"{kept} are there already"] if kept else [])])


def _again(stiffness: str | None, damping: str | None, axis: list[str] | None, batch_size: int | None) -> str:
    """Return the command that repeats a sweep from the resolved config in its folder."""
    chosen = "".join(f" --{name} {text}" for name, text in (("stiffness", stiffness), ("damping", damping)) if text)
    chosen += "".join(f" --axis {pair}" for pair in axis or ())
    return f"mjx-climb sweep config.yaml{chosen}" + ("" if batch_size is None else f" --batch-size {batch_size}")
