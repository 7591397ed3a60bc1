"""`mjx-climb sweep`, and rows of walks that are kept, shared out over machines as shards, and merged."""

import shlex
from collections.abc import Iterator
from json import dumps, loads
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field

import mjx_climb as mc
from tuning.command_line import processes
from tuning.command_line.from_models import command, parts_of
from tuning.command_line.options import LAW, METRICS, SHARD, Output, Walk, own_objects
from tuning.command_line.program import InputError, repeated, typed_but
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.comparisons.of_sweep import Begun
    from tuning.searches.sweep import Grid as Walks


RANGE = "LOW:HIGH:COUNT"
ROWS = {  # by kind of result: file, word in the name of its folder, stage and unit
    "sweep": ("sweep.nc", "sweep", "grid", "walks"),
    "degrade": ("degraded.nc", "worse", "worse hardware", "walks"),
    "evaluate": ("judged.nc", "evaluate", "fresh draw", "members"),
}

_End = Annotated[float, Field(ge=1e-30, le=1e30)]  # single precision, with room for squares of moderate gains
Range = tuple[_End, _End, Annotated[int, Field(ge=2, le=100_000)]]
_Typed = Annotated[Range | None, BeforeValidator(lambda text: parts_of(text, RANGE))]


class Grid(Options):
    """The grid."""

    stiffness: _Typed = setting(
        None, "virtual stiffness K, N/m and N m/rad: evenly spaced on a logarithmic scale", metavar=RANGE
    )
    damping: _Typed = setting(None, "virtual damping D, N s/m and N m s/rad, spaced likewise", metavar=RANGE)
    axis: dict[str, Range] = setting(
        {},
        "gain of the law, or path as contact.damping, SI units, spaced likewise; in place of either, or twice for both",
        metavar=f"NAME={RANGE}",
    )
    batch_size: int | None = setting(None, "robots that walk at a time; null: parts of a few seconds", ge=1)
    shard: str | None = SHARD

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges by the name of the gain, the horizontal one first."""
        own = {"stiffness": self.stiffness, "damping": self.damping}
        return {name: span for name, span in own.items() if span is not None} | self.axis

    def faults(self) -> Iterator[ValueError]:
        both = [name for name in self.axis if getattr(self, name, None) is not None]
        if both or len(self.ranges) != 2:
            got = ", ".join([*self.ranges, *both]) or "none"
            yield ValueError(f"--stiffness, --damping, --axis: expected two gains or paths to sweep, got {got}")
        for name, (low, high, _) in self.ranges.items():
            if not low < high:
                option = f"--axis {name}" if name in self.axis else f"--{name}"
                yield ValueError(f"{option}: expected {RANGE} with LOW below HIGH, got {low:g} and {high:g}")

    def work(self, walk: Walk) -> "Walks":
        """Return the walks of the grid."""
        import numpy as np

        from tuning.searches.sweep import grid_of

        axes = {name: np.geomspace(*span) for name, span in self.ranges.items()}
        for name, values in axes.items():
            if not (np.diff(values.astype(np.float32)) > 0).all():
                expected = f"{RANGE} whose values single precision tells apart"
                raise InputError(f"--axis {name}: expected {expected}, got {len(values)} too close together")
        loaded = walk.load()
        gains = [name for name in axes if "." not in name]
        if gains and loaded.law is None and loaded.scenario.control.controller == "pd":
            raise InputError("--controller: expected a law with gains to sweep, got pd")
        try:
            return grid_of(loaded, axes, walk.values(loaded.law), self.batch_size)
        except ValueError as error:
            raise InputError(str(error).replace("axes", "--axis", 1).replace("--axis.", "--axis ", 1)) from None

    def said(self, work: "Walks", here: int, there: int) -> list[str]:
        """Return the number of walks, the device, and the time where that is long."""
        import jax

        from mjx_climb.execution.paths import device_for
        from tuning.command_line.session import duration
        from tuning.results.swept import HISTORIES
        from tuning.searches.sweep import expected_duration

        steps, sizes = work.walked.scenario.steps, " x ".join(f"{len(each)} {name}" for name, each in work.axes.items())
        device = jax.devices(device_for(work.rows, 0, kernel=work.rows > HISTORIES))[0]  # too few for a GPU
        said = [f"{work.rows} walks ({sizes}) of {steps} steps on {device.device_kind}"]
        seconds = expected_duration(here - there, steps, device.platform)
        if seconds > 600:  # of shorter sweeps progress says enough
            said.append(f"expect some {duration(seconds)}, or spread them over machines with --shard")
        return said


class Merge(Options):
    """Which shards are merged."""

    merge: tuple[Path, ...] = setting(
        (), "write the result of shards in this folder, their own or one that holds them; nothing walks", metavar="DIR"
    )
    law: str | None = LAW
    metrics: tuple[str, ...] = METRICS


def merge(asked: Merge, output: Output) -> None:
    """Put the shards of a sweep or of an evaluation together, and write the result of all."""
    with output.session() as shell:
        from tuning.comparisons.merge import merged
        from tuning.searches import shards

        law, table = own_objects(asked.law, asked.metrics)
        kept = shards.find(asked.merge)
        target, about = output.out or shards.home(kept), kept[0].about
        if target is None:
            raise InputError("--out: expected a folder for the result, as the shards lie in several places")
        settings = loads(about["settings"]) if "settings" in about else None
        file, name = ROWS[kept[0].identity["kind"]][0], about.get("name", "the scenario")
        shell.claim(file, name, settings=settings, at=target, shard=True)
        found = merged(kept, law, table)
        shell.result(found, about.get("repeat") or "the same command", before=f"{len(kept)} shards, ")


def walk_rows(asked: Any, walk: Walk, output: Output, kind: str, again: str) -> None:
    """Walk the rows of a grid or a draw, all or a shard's, and write the result of all."""
    with processes.joined(apart=asked.shard is not None) as team, output.session() as shell:
        part, which = processes.shard_from(asked.shard)
        from tuning.background import Gate, background, ignore
        from tuning.searches import shards
        from tuning.writing import record

        work, (file, word, stage, unit) = asked.work(walk), ROWS[kind]
        asked_for = work.identity()
        out = walk.take(
            shell, file, work.problem, kind, word, team=team, shard=part is not None,
            rows=record.without_machine(asked_for),
        )  # fmt: skip
        about = {"again": typed_but("--shard", shards.SHARD), "name": walk.config.stem, "repeat": again}
        about["settings"] = dumps(shell.settings)  # for the folder of the merged result
        rows = shards.Rows(work, out, part, about)
        here, there, folder = len(rows.rows), rows.there, rows.folder or out
        said = [*asked.said(work, here, there), which, team.said, f"{there} are there already" if there else ""]
        shell.say("; ".join(filter(None, said)))
        lacks: list[str] = []
        if kind != "sweep":
            from tuning.comparisons import paired

            lacks = paired.without_interval(asked.members, None, tails=False)
        shell.opening(work.problem.scenario, *lacks)
        team.begin(folder, asked_for)
        beside = kind == "sweep" and rows.shard is None
        with (
            shell.keeping(f"of {here} {unit}", folder, there),
            background(busy=1) as begin,
            background() as apart,
            Gate() as gate,  # opened when the grid's program is traced: more traces at a time would wait for Python
        ):

            def rivals(_: Any) -> "Begun":
                from tuning import kinds  # noqa: F401  # which takes half a second with matplotlib
                from tuning.comparisons import of_sweep

                return of_sweep.begin(work.problem, work.walked, work.axes, begin)

            begun = begin(gate.behind(rivals)) if beside else None
            with shell.stage(stage, unit=unit, keeps=True, traced=gate.open) as show:
                arrays = rows.walk(show)
            gate.open()
            if rows.shard is not None:
                try:
                    arrays = shards.joined(work, shards.find([out]))
                except mc.ConfigError:  # others walk, or have not begun
                    last = f"the last of {rows.shard.count} shards writes the result, and so does"
                    shell.say(f"{folder} is whole; {last} mjx-climb sweep --merge {shlex.quote(str(out))}")
                    shell.print_json(dumps({"shard": rows.shard.number, "of": rows.shard.count, unit: here}))
                    return
            found, alone = work.result(arrays), None
            if beside:
                from mjx_climb.execution import devices
                from tuning.comparisons import of_sweep
                from tuning.pages import sweep as pages

                # on two cores the first map would wait while the programs of these walks are traced
                if devices.usable_cores() > 2:
                    alone = apart(lambda _: of_sweep.walk_alone(found))
                with shell.stage("first map"):
                    first = pages.first(found, work.named())
                if first is not None:
                    shell.first_result(found, first, again, pages.LACKS)
            shell.result(found, again, None if begun is None else begun(ignore)._replace(alone=alone))


@command("How does it depend on two gains?", "results/<config>-sweep", {"merge": merge})
def sweep(grid: Grid, walk: Walk, output: Output) -> None:
    """Walk a grid of stiffness and damping, or of two other gains, the same on all axes, in single precision.

    Prints the best gains (least force variation among the walks whose grippers all hold), the config's own and pd
    side by side, walked again in double precision. Writes to DIR the grid (sweep.nc, opens with xarray), a sheet with a
    map of each metric and the law's limit of stability (maps.png), the table (comparison.json), the resolved scenario
    (config.yaml), and all of it with the walks over time as a page for a browser (report.html). `mjx-climb plot DIR`
    draws each of them by itself.

    A first table, map and page, in single precision, are there as soon as the grid has walked; their
    rivals are added. Finished parts are kept in DIR: after Ctrl-C, or worse, the same command goes on where it stopped.
    A gains file gives the inertia and the joint gains of the grid, and a further walk to compare with.

    With --shard, or as a task of a Slurm array, a sweep is spread over machines: each walks its part of the grid into
    a folder below DIR, and the last one writes the result of all: on CPUs the same file, bit for bit.
    --merge does so by hand, of shards that lie in several places for example. Shards of different settings, files or
    versions are refused; one that died is named with its missing walks and the command that finishes it.

    \b
    Examples:
      mjx-climb sweep case_1_2 --stiffness 1e2:1e6:16 --damping 1e0:1e5:16
      mjx-climb sweep case_2 --stiffness 1e3:1e5:8 --damping 1e1:1e4:8 --gains best.yaml
      mjx-climb sweep case_2 --law my_law.py:Filtered --axis cutoff=1:100:8 --damping 1e1:1e4:8
      mjx-climb sweep case_2 --stiffness 1e2:1e6:128 --damping 1e0:1e5:128 --shard 3/16
      mjx-climb sweep --merge node1/shard-1-of-2 --merge node2/shard-2-of-2 --out results/both
    """
    again = repeated(["sweep"], "--stiffness", "--damping", "--axis", "--batch-size", "--engine")
    walk_rows(grid, walk, output, "sweep", again)
