"""`mjx-climb sweep`: a grid of stiffness and damping."""

import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError, Interrupted

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    import mjx_climb as mc
    from tuning.report.comparison import Compared

LARGEST_AXIS = 100_000
SMALLEST, LARGEST = 1e-30, 1e30  # what single precision holds, with room for squares of moderate gains
# inertia, damping and stiffness of cases 1.1, 1.2 and 2
PAPER = {(1.0, 1e4, 4e5), (1.0, 5e3, 5e4), (1.0, 5e3, 2e4)}
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
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-sweep"),
    ] = None,
    batch_size: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Robots that walk at a time.", show_default="parts of a few seconds"),
    ] = None,
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Walk a grid of stiffness and damping, or of two other gains, the same on all axes, in single precision.

    Prints the best gains (least force variation among the walks in which all grippers hold), the config's own and pd
    side by side, walked again in double precision. Writes to DIR the grid (sweep.nc, opens with xarray), a map of
    each metric with the law's limit of stability (maps/, and maps.png, .svg, .pdf with the main ones), the three walks
    over time (walks.png, .svg, .pdf), the table (comparison.json), the resolved scenario (config.yaml), and all of it
    as a page for a browser (report.html).

    Finished parts are kept in DIR: after Ctrl-C, or worse, the same command goes on where it stopped. A gains file
    gives the inertia and the joint gains of the grid, and a further walk to compare with.

    \b
    Examples:
      mjx-climb sweep case_1_2 --stiffness 1e2:1e6:16 --damping 1e0:1e5:16
      mjx-climb sweep case_2 --stiffness 1e3:1e5:8 --damping 1e1:1e4:8 --gains best.yaml
      mjx-climb sweep case_2 --law my_law.py:Filtered --axis cutoff=1:100:8 --damping 1e1:1e4:8
    """
    axes = axes_from(stiffness, damping, axis)
    with options.reserved_stdout() as stdout:
        import mjx_climb as mc
        from mjx_climb.files import dataset, scenario_files
        from mjx_climb.rollouts.given import with_gains
        from tuning.command_line import progress, report
        from tuning.judged import stability_limit
        from tuning.report import page
        from tuning.report import sweep as pages
        from tuning.searches import finished_parts, grid

        begin = time.perf_counter()
        own = options.scenario_from(config, controller, changes, hardware)
        user_law, scenario = options.law_from(law, gains, own)
        start, _ = options.law_from(law, None, own)
        engine = options.engine_from(engine)
        if user_law is None and scenario.control.controller == "pd":
            raise InputError("--controller: expected a law with gains to sweep, got pd")
        try:
            grid.checked_axes(scenario, user_law, None, None, axes)
        except ValueError as error:
            raise InputError(str(error).replace("axes.", "--axis ", 1)) from None
        out = out or Path("results") / f"{config.stem}-sweep"
        how: dict[str, Any] = {
            "axes": axes, "law": user_law, "batch_size": batch_size, "engine": engine, "out": out,
        }  # fmt: skip
        kept, walks = grid.claim(scenario, **how), math.prod(map(len, axes.values()))
        own, scenario = scenario_files.copied(own, out), scenario_files.copied(scenario, out)
        dataset.write_text_atomically(out / "config.yaml", scenario_files.portable_yaml(scenario, out))

        console = report.console(stderr=True)
        console.print(_announcement(scenario, axes, kept), soft_wrap=True)
        console.print(progress.cache_state(), soft_wrap=True)
        meter = progress.Meter(console)

        def walked(done: int, total: int) -> None:
            nonlocal kept
            kept = done
            show(done, total)

        try:
            names = {"config": own if gains is None else scenario}
            if gains is not None:
                names = {"gains file": scenario, "config": own}
            names["pd"] = own.with_overrides({"control.controller": "pd", "control.reading": "virtual_model"})
            laws = {"config": start, "gains file": user_law, "pd": None}
            trajectories = {}
            for name in reversed(names):
                with meter.stage(_label(name, own)):
                    trajectories[name] = mc.rollout(names[name], law=laws[name], engine=engine)
            with meter.stage("grid") as show:
                result = grid.sweep(scenario, progress=walked, **how)
            with meter.stage("stability limit"):
                result["spectral_radius"] = stability_limit.over_map(scenario, result, law=user_law, engine=engine)
            best = grid.best_cell(result)
            if best is not None:
                found = {name: best[name].item() for name in axes}
                with meter.stage("best"):
                    joint = {f"control.{n}": v for n, v in found.items() if user_law is None or n not in user_law.GAINS}
                    own_gains = {n: v for n, v in found.items() if f"control.{n}" not in joint}
                    winner = None if user_law is None else with_gains(user_law, own_gains)
                    trajectories["best"] = mc.rollout(scenario.with_overrides(joint), law=winner, engine=engine)
            order = [name for name in ("best", *names) if name in trajectories]
            trajectories = {name: trajectories[name] for name in order}
            compared = {
                name: (report.gains_of(trajectory), mc.metrics(trajectory)) for name, trajectory in trajectories.items()
            }
            edges = [] if best is None else at_edge(result, best)
            summary: dict[str, dict[str, Any] | None] = {"best": None}
            summary |= {name: {"gains": values, "metrics": metrics} for name, (values, metrics) in compared.items()}
            failed = (result["detached_limb"] >= 0) | result["diverged"].astype(bool)
            summary["grid"] = {"walks": walks, "failed": int(failed.sum()), "best_at_edge_of": edges}
            text = report.to_json(summary)
            dataset.save(result, out / "sweep.nc")
            dataset.write_text_atomically(out / "comparison.json", text + "\n")
            marks = _marks(compared, own, axes)
            with meter.stage("drawing", compiles=False):
                _draw(result, trajectories, compared, own, marks, out)
            if walks > grid.HISTORIES:
                with meter.stage("histories"):
                    histories = pages.with_histories(result, scenario, best, law=user_law, engine=engine)
            else:
                histories = result
            with meter.stage("report", compiles=False):
                written = pages.page(
                    result,
                    histories,
                    {_label(name, own): walk for name, walk in trajectories.items()},
                    {_label(name, own): walk for name, walk in compared.items()},
                    marks,
                    scenario,
                    warnings=[f"The best lies on the edge of the grid: widen {_option(name)}." for name in edges],
                    origin=options.origin(
                        config.stem,
                        _again(stiffness, damping, axis, law, batch_size, engine),
                        scenario_files.portable_yaml(scenario, out),
                    ),
                    pictures={
                        "The walks over time: red crosses mark a torn gripper, shading a disturbance.": out
                        / "walks.svg",
                        "All metrics over stiffness and damping; brighter is better.": out / "maps.svg",
                    },
                )
                page.write(written, out)
            finished_parts.clear(out)
        except KeyboardInterrupt:
            raise Interrupted(
                f"{kept} of {walks} walks are kept in {out}; the same command goes on from there"
            ) from None

        tables = console if json else report.console(file=stdout)
        columns = {_label(name, own): walk for name, walk in compared.items()}
        tables.print(report.comparison_table(columns, "pd", tables.width))
        if best is None:
            tables.print(f"no walk of the grid held: all {walks} detached or diverged")
        else:
            tables.print(
                f"best: {', '.join(f'{name} {best[name].item():.4g}' for name in axes)} "
                f"({int(failed.sum())} of {walks} walks detached or diverged)"
            )
        for name in edges:
            tables.print(f"the best lies on the edge of the grid: widen {_option(name)}")
        console.print(
            f"written to {out} in {progress.duration(time.perf_counter() - begin)}: report.html, sweep.nc, "
            "maps.png, .svg, .pdf, maps/, walks.png, .svg, .pdf, comparison.json, config.yaml",
            soft_wrap=True,
        )
        if json:
            print(text, file=stdout)


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


def at_edge(result: "xr.Dataset", best: "xr.Dataset") -> list[str]:
    """Return the axes on whose end the best cell lies."""
    return [str(n) for n in result["diverged"].dims if best[n].item() in result[n].values[[0, -1]]]


def _announcement(scenario: "mc.Scenario", axes: "Mapping[str, np.ndarray]", kept: int) -> str:
    import jax

    walks = math.prod(map(len, axes.values()))
    sizes = " x ".join(f"{len(values)} {name}" for name, values in axes.items())
    text = f"{walks} walks ({sizes}) of {scenario.steps} steps"
    text += f" on {jax.devices()[0].device_kind}"
    return text + (f"; {kept} are there already" if kept else "")


def _label(name: str, own: "mc.Scenario") -> str:
    """Return the name of a walk for people: the config's own gains are the paper's, or not."""
    control = own.control
    paper = (control.inertia, control.damping, control.stiffness) in PAPER
    return "paper" if name == "config" and paper else name


def _marks(compared: "Compared", own: "mc.Scenario", axes: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Return the two gains of the walks that have one of each, by their name for people."""
    import numpy as np

    marks = {}
    for name, (gains, _) in compared.items():
        if gains is not None and all(key in gains and np.unique(gains[key]).size == 1 for key in axes):
            x, y = (float(np.ravel(gains[key])[0]) for key in axes)
            marks[_label(name, own)] = x, y
    return marks


def _again(
    stiffness: str | None,
    damping: str | None,
    axis: list[str] | None,
    law: str | None,
    batch_size: int | None,
    engine: str,
) -> str:
    """Return the command that repeats a sweep from the resolved config in its folder."""
    size = "" if batch_size is None else f" --batch-size {batch_size}"
    chosen = "".join(f" --{name} {text}" for name, text in (("stiffness", stiffness), ("damping", damping)) if text)
    chosen += "".join(f" --axis {pair}" for pair in axis or ()) + options.law_option(law)
    return f"mjx-climb sweep config.yaml{chosen}{size}{options.engine_option(engine)} --out again"


def _draw(
    result: "xr.Dataset",
    trajectories: "dict[str, mc.Trajectory]",
    compared: "Compared",
    own: "mc.Scenario",
    marks: Mapping[str, tuple[float, float]],
    out: Path,
) -> None:
    """Write the walks over time, and the maps on a sheet and one by one."""
    import numpy as np

    import mjx_climb as mc
    from mjx_climb import plots

    x, y = (str(name) for name in result["diverged"].dims)
    walks = {_label(name, own): trajectories[name] for name in reversed(trajectories)}
    metrics = [
        name for name in mc.METRICS.names if name not in ("detached_limb", "diverged")
    ]  # the hatching shows these
    pd = {name: value for name, value in compared["pd"][1].items() if name in metrics and value is not None}

    plots.save_figure(plots.plot_comparison(walks), out / "walks")
    if known := [name for name in metrics if np.isfinite(result[name]).any()]:
        plots.save_figure(plots.plot_maps(result, known, marks, baselines=pd, columns=3, x=x, y=y), out / "maps")
    for name in metrics:
        plots.save_figure(plots.plot_map(result, name, marks, baseline=pd.get(name), x=x, y=y), out / "maps" / name)
