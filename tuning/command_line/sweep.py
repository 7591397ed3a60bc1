"""`mjx-climb sweep`: a grid of stiffness and damping."""

import importlib
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import BeforeValidator, Field, model_validator

from tuning.command_line import launcher, processes
from tuning.command_line.ending import InputError, kept_in
from tuning.command_line.from_models import command
from tuning.command_line.options import SHARD, Output, Walk
from tuning.command_line.rows import Rows
from tuning.command_line.typed import origin, repeated
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.searches.sweep import Grid as Work

LARGEST_AXIS = 100_000
SMALLEST, LARGEST = 1e-30, 1e30  # what single precision holds, with room for squares of moderate gains
WORTH_A_WORD = 600.0  # s; of shorter sweeps progress says enough
RANGE = "LOW:HIGH:COUNT"

_End = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Range = tuple[_End, _End, Annotated[int, Field(ge=2, le=LARGEST_AXIS)]]
_Typed = Annotated[Range | None, BeforeValidator(lambda text: text.split(":"))]


class Grid(Options):
    """What is swept."""

    stiffness: _Typed = setting(
        None, "virtual stiffness K, N/m and N m/rad: evenly spaced on a logarithmic scale", metavar=RANGE
    )
    damping: _Typed = setting(None, "virtual damping D, N s/m and N m s/rad, spaced likewise", metavar=RANGE)
    axis: dict[str, Range] = setting(
        {},
        "gain of the law, SI units, spaced likewise; in place of either of these, or twice for both",
        metavar=f"NAME={RANGE}",
    )
    batch_size: int | None = setting(None, "robots that walk at a time; null: parts of a few seconds", ge=1)
    shard: str | None = SHARD

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges by the name of the gain, the horizontal one first."""
        own = {"stiffness": self.stiffness, "damping": self.damping}
        return {name: span for name, span in own.items() if span is not None} | self.axis

    @model_validator(mode="after")
    def _two_in_order(self) -> Self:
        both = [name for name in self.axis if getattr(self, name, None) is not None]
        if both or len(self.ranges) != 2:
            got = ", ".join([*self.ranges, *both]) or "none"
            raise ValueError(f"--stiffness, --damping, --axis: expected two gains to sweep, got {got}")
        for name, (low, high, _) in self.ranges.items():
            if not low < high:
                option = f"--axis {name}" if name in self.axis else f"--{name}"
                raise ValueError(f"{option}: expected {RANGE} with LOW below HIGH, got {low:g} and {high:g}")
        return self

    def work(self, walk: Walk) -> "Work":
        """Return the walks of the grid.

        Raises:
            ConfigError, InputError: options that cannot be used, or values that single precision does not tell apart.
        """
        import numpy as np

        from tuning.problem.evaluation import Problem
        from tuning.searches.sweep import grid_of

        axes = {name: np.geomspace(*span) for name, span in self.ranges.items()}
        for name, values in axes.items():
            if not (np.diff(values.astype(np.float32)) > 0).all():
                expected = f"{RANGE} whose values single precision tells apart"
                raise InputError(f"--axis {name}: expected {expected}, got {len(values)} too close together")
        loaded = walk.load()
        if loaded.law is None and loaded.scenario.control.controller == "pd":
            raise InputError("--controller: expected a law with gains to sweep, got pd")
        try:
            return grid_of(Problem(loaded.scenario, **loaded.how), axes, walk.values(loaded.law), self.batch_size)
        except ValueError as error:
            raise InputError(str(error).replace("axes", "--axis", 1).replace("--axis.", "--axis ", 1)) from None


def sweep(grid: Grid, walk: Walk, output: Output) -> None:
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
    with processes.joined(apart=grid.shard is not None) as team, output.session() as shell:
        part, which = launcher.shard_from(grid.shard)
        from tuning.background import background
        from tuning.output import comparisons
        from tuning.output.folder import check_own

        work = grid.work(walk)
        problem = work.problem
        out = team.folder(output.folder(walk.config.stem, "sweep"))
        check_own(out, "sweep.nc")
        again = repeated(["sweep"], "--stiffness", "--damping", "--axis", "--batch-size", "--engine")
        rows = Rows(work, out, part, walk.config.stem, again)
        shell.say("; ".join(filter(None, [*_announcement(work, rows), which, team.said, rows.kept_already])))
        shell.opening(problem.scenario)
        team.begin(rows.folder, work.walked.scenario)
        with kept_in(rows.folder, f"of {rows.here} walks", rows.there) as kept, background() as begin:
            compared = None
            if rows.shard is None:
                begin(lambda _: importlib.import_module("tuning.output.sweep"))  # 0.4 s, matplotlib's most of all
                compared = comparisons.of_grid(
                    problem.scenario, problem.law, work.gains, work.axes, problem.engine, begin
                )
            arrays = rows.walk(shell, kept, "grid", "walks")
            if arrays is None:
                return
            written = work.result(arrays).write(
                out,
                origin=origin(walk.config.stem, again),
                figures=output.figures,
                stage=shell.stage,
                compared=compared,
            )
        shell.result(out, problem, written)


def _announcement(work: "Work", rows: Rows) -> list[str]:
    """Return how many walks there are, on what, and how long they take where that is long."""
    import jax

    from mjx_climb.execution.paths import device_for
    from tuning.command_line.progress import duration
    from tuning.searches.sweep import expected_duration

    scenario = work.walked.scenario
    sizes = " x ".join(f"{len(values)} {name}" for name, values in work.axes.items())
    where = device_for(work.rows, 0, double=False)  # too few for a GPU
    device = jax.devices(where)[0]
    said = [f"{work.rows} walks ({sizes}) of {scenario.steps} steps on {device.device_kind}"]
    seconds = expected_duration(rows.here - rows.there, scenario.steps, device.platform)
    if seconds > WORTH_A_WORD:
        said.append(f"expect some {duration(seconds)}, or spread them over machines with --shard")
    return said


COMMAND = command(sweep, "results/<config>-sweep")
