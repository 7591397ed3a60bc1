"""One command's tables and JSON, and its stages on standard error: a live bar on a terminal, plain lines in a file."""

import contextlib
import dataclasses
import math
import re
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.segment import Segment, Segments
from rich.table import Table

import mjx_climb as mc
from mjx_climb.files.writing import check_folder
from mjx_climb.scenario.messages import printable
from tuning.command_line import interruption
from tuning.command_line.interruption import Interrupted
from tuning.command_line.program import origin

if TYPE_CHECKING:
    from tuning.command_line.processes import Team
    from tuning.comparisons.side_by_side import Compared
    from tuning.identification.fit.result import Identified
    from tuning.identification.plan.excitation import Excited
    from tuning.kinds import Begun
    from tuning.methods.rounds import Progress as Rounds
    from tuning.pages import page
    from tuning.pages.contents import Contents, Files, Written
    from tuning.pages.page import Origin, Page
    from tuning.pages.section import SectionOf
    from tuning.results.result import Result

WIDTH = 100  # of tables in a file, unless their words or numbers need more
_WIDEST = 100_000  # columns
LONGEST_WORD = 40  # characters of names that are not broken on a terminal
TRACED = "/jax/core/compile/jaxpr_trace_duration"
LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILED = "/jax/core/compile/backend_compile_duration"  # or loaded, which an event before it says
FROM_CACHE = "/jax/compilation_cache/cache_hits"
LOADING = "loading compiled programs from the cache"
WORTH_A_WORD = 0.1  # s; shorter compilations are of small helpers


class Compilation:
    """Watches JAX from `with` on: how long it traced, compiled and loaded programs.

    Programs of several threads, and traces within traces, overlap: no second is counted twice.
    """

    def __init__(self, finished: Callable[[], None] = lambda: None, traced: Callable[[], None] = lambda: None):
        self.seconds: dict[str, float] = {}  # by activity
        self.since = time.perf_counter()  # when anything was last done
        self._thread = threading.local()  # whose next program comes from the cache
        self._lock = threading.Lock()
        self._finished, self._traced = finished, traced

    def __enter__(self) -> "Compilation":
        from jax import monitoring

        monitoring.register_event_listener(self._event)
        monitoring.register_event_duration_secs_listener(self._duration)
        return self

    def __exit__(self, *_: object) -> None:
        from jax import monitoring

        monitoring.unregister_event_listener(self._event)
        monitoring.unregister_event_duration_listener(self._duration)

    def __str__(self) -> str:
        """Return the times of JAX's stages in words, nothing where all were short."""
        long = {what: seconds for what, seconds in self.seconds.items() if seconds > WORTH_A_WORD}
        return " and ".join(f"{duration(seconds)} {what}" for what, seconds in long.items())

    def _event(self, event: str, **_: str | int) -> None:
        if event == FROM_CACHE:
            self._thread.hit = True

    def _duration(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event not in (TRACED, LOWERED, COMPILED):
            return
        what = "tracing"
        if event == COMPILED:
            what = LOADING if getattr(self._thread, "hit", False) else "compiling"
            self._thread.hit = False
        with self._lock:
            now = time.perf_counter()
            self.seconds[what] = self.seconds.get(what, 0.0) + min(duration_secs, now - self.since)
            self.since = now
        if duration_secs > WORTH_A_WORD and (event == LOWERED or what == LOADING):
            self._traced()
        if duration_secs > WORTH_A_WORD and event == COMPILED:
            self._finished()


@dataclasses.dataclass
class Estimate:
    """How long the rest takes, from the work done since the compiler finished; None before that is known."""

    since: float  # s
    base: int | None = None  # done by then
    done: int | None = None

    def update(self, done: int, total: int, now: float) -> float | None:
        """Return the seconds left once `done` of `total` are done."""
        self.base = done if self.base is None else self.base
        self.done = done
        if done == total:
            return 0.0
        return None if done <= self.base else (now - self.since) / (done - self.base) * (total - done)

    def compiled(self, now: float) -> None:
        """Count from `now` on: the time before went to the compiler."""
        self.since, self.base = now, self.done


class Session:
    """One command: its folder, where its tables and its JSON go, and its stages, one after the other."""

    def __init__(
        self, stdout: TextIO, asked: Path | None = None, json_only: bool = False, figures: Collection[str] = ("png",),
        sections: "Sequence[SectionOf]" = (),
    ):  # fmt: skip
        """Begin a command that was asked to write to a folder (None: its own), or JSON alone to standard output."""
        self.begin = time.perf_counter()
        self.console = console(stderr=True)
        self.tables = self.console if json_only else console(file=stdout)
        self.asked, self.figures, self.name, self.out = asked, figures, "", Path()
        self.done = self._before = 0  # kept where the command is stopped; of these, in stages that are over
        self.sections = sections  # of the user's own, for the report
        self.lacks = ""  # of a result that is in the folder before the command ends
        self.settings: Mapping[str, Any] | None = None  # of the command
        self._held = contextlib.ExitStack()  # its folder
        self._json = stdout if json_only else None

    def claim(
        self,
        file: str,
        name: str,
        *kind: str,
        settings: Mapping[str, Any] | None,
        varied: bool = False,
        team: "Team | None" = None,
        at: Path | None = None,
        shard: bool = False,
    ) -> Path:
        """Take the folder of a result, which is known by a file in it: `at`, or that of --out, or one by its settings.

        No other command has it until this one ends; shards of the same settings have it together.

        By default it is results/NAME-KIND, with a digest of the settings behind it where they are `varied`, not plain
        to see in the name, or where that folder is another run's, or is becoming one's.

        Raises:
            OutputError: it cannot be written, holds another run's result, or another command uses it.
        """
        from tuning.writing import record

        out, base = at or self.asked, Path("results") / "-".join((name, *kind))
        if out is None:
            out = record.own_folder(base, settings or {}, varied=varied)
            if not varied and out != base and not out.exists():
                self.say(f"{base} holds {record.another(base, settings)}: this one goes to {out}")
        self.name, self.settings, self.out = name, settings, out if team is None else team.folder(out)
        check_folder(self.out)
        try:
            self._held.enter_context(record.held(self.out, settings, shard=shard))
        except record.InUse:
            if out != base:
                raise
            self.out = record.own_folder(base, settings or {}, varied=True)
            self._held.enter_context(record.held(self.out, settings, shard=shard))
            self.say(f"another command uses {base}: this one goes to {self.out}")
        record.check_own(self.out, file)
        record.check(self.out, settings)
        return self.out

    def close(self) -> None:
        """Let other commands have the folder."""
        self._held.close()

    def whole(self) -> "contextlib.AbstractContextManager[Path]":
        """Give an empty folder, whose files become those of the result once the block ends well."""
        from tuning.writing import record

        return record.whole(self.out, self.settings)

    def fill(self, out: Path, files: "Files", report: "Callable[[Origin], Page] | None" = None, again: str = "") -> str:
        """Write the files of a result that has a config.yaml, and its page, which `again` repeats; return the names."""
        from tuning.writing import folder

        return folder.fill(out, files, report, origin(self.name, again), self.figures, self.stage)

    def say(self, *lines: str) -> None:
        """Print lines beside the results."""
        for line in lines:
            self.console.print(line, soft_wrap=True)

    def show(self, *results: "str | page.Table") -> None:
        """Print tables and lines of the result."""
        print_on(self.tables, *results)

    def print_json(self, text: str) -> None:
        """Print JSON where it was asked for."""
        if self._json is not None:
            print(text.rstrip("\n"), file=self._json)

    def opening(self, scenario: "mc.Scenario | None" = None, *lacks: str) -> None:
        """Say where compiled programs are kept, and warn of a scenario or a result before anything walks."""
        from tuning import numbers
        from tuning.command_line import cache

        (state,) = cache.cache()
        warnings = [*(numbers.ahead_of(scenario) if scenario else ()), *lacks]
        kinds = scenario.kinds if scenario is not None else {}
        self.say(*(f"{place}: {Path(each.kind).name}" for place, each in kinds.items()))
        self.say(f"compilation cache: {state.text}", *(f"warning: {line}" for line in warnings))

    def written(self, files: str, json: str, before: str = "") -> None:
        """Name the files that were written and the time, and print the JSON where it was asked for."""
        self.say(f"{before}written to {self.out} in {duration(time.perf_counter() - self.begin)}: {files}")
        self.print_json(json)

    def write(
        self, found: "Result | Identified | Excited", again: str, begun: "Begun | None" = None,
        answer: "Callable[[Written], None]" = lambda _: None,
    ) -> "Written":  # fmt: skip
        """Write a result with its report, where `again` repeats it; `answer` prints what it holds before that."""
        from tuning import kinds

        return kinds.write(
            found, self.out, begun=begun, origin=origin(self.name, again), figures=self.figures,
            sections=self.sections, stage=self.stage, settings=self.settings, answer=answer,
        )  # fmt: skip

    def result(self, found: "Result", again: str, begun: "Begun | None" = None, *, before: str = "") -> None:
        """Print the tables of a result, or that of its walks, and write it, with a report where `again` repeats it."""
        written = self.write(found, again, begun, lambda told: self._answer(found, told))
        self.written(written.files, written.summary, before)

    def _answer(self, found: "Result", told: "Written") -> None:
        from tuning.pages import comparison

        problem = found.problem
        if told.tables:
            self.show(*told.tables)
        else:
            self.show(comparison_table(told.compared, "pd", self.tables.width, problem.metrics, problem.law))
            if found.search is not None:
                self.show(comparison.gains_table(told.compared, problem.law))
        self.show(*told.outcome)

    def first_result(self, found: "Result", made: "Contents", again: str, lacks: str) -> None:
        """Print the first table of a result, and write it so far, unless the folder holds the whole one."""
        from tuning.writing import folder, record

        self._answer(found, made.written)
        if (before := record.read(self.out)) is not None and before.whole:
            return
        how: dict[str, Any] = {"origin": origin(self.name, again), "settings": self.settings, "finished": False}
        written = folder.write(made, self.out, "", **how)
        self.lacks = lacks
        self.say(f"in {self.out} after {duration(time.perf_counter() - self.begin)}: {written.files}; {lacks} follow")

    @contextlib.contextmanager
    def keeping(self, what: str, folder: Path | None = None, done: int = 0) -> Iterator[None]:
        """Name the work that is kept where the user stops a command, as "3 rounds"; `done` of them were there before.

        Interrupted is raised in place of KeyboardInterrupt, and of errors after the user asked to stop: a
        process that walked beside this one, for example, was stopped as well and may be gone first.
        """
        self.done = done
        from tuning.writing import record

        there = None if self.settings is None else record.begin(self.out, self.settings)
        try:
            yield
        except Interrupted:  # it says more
            raise
        except (KeyboardInterrupt, Exception) as error:
            if not (isinstance(error, KeyboardInterrupt) or interruption.requested()):
                if there is not None:
                    record.give_up(self.out, there)
                raise
            which = f"{what.removesuffix('s')} is" if self.done == 1 and " " not in what else f"{what} are"
            kept = f"{self.done} {which} kept in {folder or self.out}"
            kept = f"{self.out} holds a result without {self.lacks}" if self.lacks else kept
            raise Interrupted(f"{kept}; the same command goes on from there") from None

    @contextlib.contextmanager
    def rounds(self, name: str) -> Iterator["Callable[[Rounds], None]"]:
        """Show the stage of a search whose rounds are kept, with the best so far."""

        def shown(now: "Rounds") -> None:
            slope = f", gradient {now.gradient_norm:.2g}" if math.isfinite(now.gradient_norm) else ""
            best = f"{now.best:.4f}" if math.isfinite(now.best) else "none feasible yet"
            text = f"{now.phase} {now.rounds}/{now.rounds_in_all}: best {best}{slope}, {now.alive} of {now.batch} alive"
            show(now.rounds, now.rounds_in_all, f"{text}, {now.env_steps / 1e6:.2f} M env-steps")

        with self.stage(name, unit="rounds", keeps=True) as show:
            yield shown

    @contextlib.contextmanager
    def stage(
        self,
        name: str,
        *,
        compiles: bool = True,
        unit: str = "walks",
        keeps: bool = False,
        traced: Callable[[], None] = lambda: None,
    ) -> Iterator[Callable[..., None]]:
        """Show one stage; the function that it gives takes how many walks are done, how many there are, and a text.

        `keeps`: the work of this stage is kept where the command is stopped. `traced` is called when a large program
        has been traced, and XLA compiles it, or one has been loaded.

        Raises:
            KeyboardInterrupt: at its beginning and whenever it is told, where the user wants the command to end.
        """
        interruption.check()
        begin = time.perf_counter()
        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
        bar = Progress(*columns, console=self.console, transient=True, disable=not self.console.is_terminal)
        task = bar.add_task(f"{name}: compiling" if compiles else name, total=None)
        estimate = Estimate(begin)

        def compiled() -> None:
            estimate.compiled(time.perf_counter())
            bar.update(task, description=f"{name}: walking")

        def advanced(done: int, total: int, text: str | None = None) -> None:
            if keeps:
                self.done = self._before + done
            compilation.since = now = time.perf_counter()
            left = estimate.update(done, total, now)
            text = text or f"{name}: {done} of {total} {unit}"
            text += f", about {duration(left)} left" if left else ""
            if done or left is not None:
                bar.update(task, description=text, completed=done, total=total)
            if done and not self.console.is_terminal:
                self.say(text)
            interruption.check()

        with Compilation(compiled, traced) as compilation, bar:
            yield advanced
        self._before = self.done if keeps else self._before
        text = f"{name}: {duration(time.perf_counter() - begin)}"
        spent = str(compilation)
        self.console.print(text + (f", of which {spent}" if spent else ""))


class Screen(Console):
    """A console on which names, settings and verdicts of files cannot control the terminal."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the segments of a text, a table or a bar, with all control characters but Rich's own spelt out."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text, "\n"))


def console(file: TextIO | None = None, *, stderr: bool = False) -> Console:
    """Return where people read: plain text of a fixed width unless it is a terminal."""
    made = Screen(file=file, stderr=stderr, highlight=False, markup=False, emoji=False)
    if not made.is_terminal:
        made.width = WIDTH
    return made


def print_on(console: Console, *results: "str | page.Table") -> None:
    """Print tables and lines; a table that is wider than the terminal goes on below, with the names of its rows.

    In a file one whose names have no room there is wider.
    """
    longest, most = (LONGEST_WORD, console.width) if console.is_terminal else (_WIDEST, _WIDEST)
    for result in results:
        if isinstance(result, str):
            console.print(result, soft_wrap=True)
            continue
        for table in drawn(result, console.width, longest):
            console.print(Segments(console.render(table, console.options.update_width(most))), crop=False)


def drawn(made: "page.Table", width: int, longest_word: int = LONGEST_WORD) -> list[Table]:
    """Return a table for the terminal in parts, each with the names of rows, their unit, and as many others as fit.

    Where a column is too wide its lines break, between words; names longer than `longest_word` characters break too.
    """
    every = [row for _, rows in made.sections for row in rows]
    headings = [heading.partition(":")[0] for heading, _ in made.sections]
    heads, spans = [broken(name) for name in made.columns], list[tuple[int, int]]()  # least and most characters
    for place, head in enumerate(heads):
        cells = [row[place] for row in every] + headings * (place == 0)
        words = [part for cell in cells for part in (cell.split() if place < made.words else [cell])]
        least = min(max(map(len, words), default=1), longest_word if place < made.words else _WIDEST)
        spans.append((max([least, *map(len, head.split())]), max(map(len, [*cells, *head.split("\n")]))))
    names = [place for place, name in enumerate(made.columns) if place < made.words or name == "unit"]
    parts = [list[int]()]
    for place in (place for place in range(len(heads)) if place not in names):
        if parts[-1] and _width(spans[each][0] for each in (*names, *parts[-1], place)) > width:
            parts.append([])
        parts[-1].append(place)
    tables = []
    for places in (sorted([*names, *part]) for part in parts):
        widths = [spans[place][1] for place in places]
        slack = [most - least for least, most in (spans[place] for place in places)]
        while _width(widths) > width and any(slack):
            widest = slack.index(max(slack))
            slack[widest], widths[widest] = slack[widest] - 1, widths[widest] - 1
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True, padding=(0, 1))
        for place, own in zip(places, widths, strict=True):
            justify: Any = "left" if place < made.words or made.columns[place] == "unit" else "right"
            table.add_column(heads[place], justify=justify, overflow="fold", width=own)
        for heading, (_, rows) in zip(headings, made.sections, strict=True):
            if heading:
                table.add_row(heading, style="bold")
            for row in rows:
                table.add_row(*(row[place] for place in places), end_section=row is rows[-1])
        tables.append(table)
    return tables


def _width(widths: Iterable[int]) -> int:
    """Return the characters of a line of columns, with a space on both sides of each."""
    return sum(each + 2 for each in widths)


def broken(name: str, width: int = 12) -> str:
    """Return a name of several lines where it is longer than a column is wide, broken behind underscores."""
    lines = [""]
    for part in re.findall("[^_]*_*", name) if len(name) > width and " " not in name else [name]:
        lines += [part] if lines[-1] and len(lines[-1] + part) > width else [lines.pop() + part]
    return "\n".join(lines)


def comparison_table(
    walks: "Compared", baseline: str, width: int, about: "mc.MetricTable", law: "mc.Law | None" = None
) -> "page.Table":
    """Return walks side by side, each with its change against the baseline where `width` characters have room."""
    from tuning.pages import comparison

    others = (None, baseline) if baseline in walks and width >= 38 + 19 * (len(walks) - 1) else (None,)
    columns = [(name, other) for name in walks for other in others if other != name]
    return comparison.table(walks, "", about, law, columns)


def duration(seconds: float) -> str:
    """Return a length of time as a person would say it."""
    if seconds < 120:
        return f"{seconds:.{1 if seconds < 10 else 0}f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
