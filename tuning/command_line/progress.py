"""What is going on, on standard error: a live bar on a terminal, plain lines in a file."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from tuning.command_line import interruption, report

if TYPE_CHECKING:
    from rich.table import Table

    import mjx_climb as mc
    from tuning.problem.evaluation import Problem
    from tuning.searches.result import Written

COMPILED = "/jax/core/compile/backend_compile_duration"
FROM_CACHE = "/jax/compilation_cache/cache_hits"
WORTH_A_WORD = 0.1  # s; shorter compilations are of small helpers


class Compilation:
    """Watches XLA's compiler from `with` on: how long each program took, tracing included, by where it came from."""

    def __init__(self, finished: Callable[[], None] = lambda: None):
        self.seconds: dict[str, float] = {}
        self.since = time.perf_counter()  # when anything else was last done
        self._from_cache = False
        self._finished = finished

    def __enter__(self) -> "Compilation":
        from jax import monitoring

        monitoring.register_event_listener(self._event)
        monitoring.register_event_duration_secs_listener(self._duration)
        return self

    def __exit__(self, *_: object) -> None:
        from jax import monitoring

        monitoring.unregister_event_listener(self._event)
        monitoring.unregister_event_duration_listener(self._duration)

    def _event(self, event: str, **_: str | int) -> None:
        self._from_cache |= event == FROM_CACHE

    def _duration(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event != COMPILED:
            return
        source = "loading compiled programs from the cache" if self._from_cache else "compiling"
        self._from_cache = False
        if duration_secs > WORTH_A_WORD:
            now = time.perf_counter()
            self.seconds[source] = self.seconds.get(source, 0.0) + now - self.since
            self.since = now
            self._finished()


class Estimate:
    """How long the rest takes, from the work done since the compiler finished; None before that is known."""

    def __init__(self, now: float):
        self.since = now  # s
        self.base: int | None = None  # what was there then
        self.done: int | None = None

    def update(self, done: int, total: int, now: float) -> float | None:
        """Return the seconds left once `done` of `total` are done."""
        if self.base is None:
            self.base = done
        self.done = done
        if done == total:
            return 0.0
        worked = done - self.base
        return None if worked <= 0 else (now - self.since) / worked * (total - done)

    def compiled(self, now: float) -> None:
        """Count from `now` on: the time before went to the compiler."""
        self.since, self.base = now, self.done


class Session:
    """One command: where its tables and its JSON go, and its stages, one after the other, on standard error."""

    def __init__(self, stdout: TextIO, json_only: bool = False):
        self.begin = time.perf_counter()
        self.console = report.console(stderr=True)
        self.tables = self.console if json_only else report.console(file=stdout)
        self._json = stdout if json_only else None

    def say(self, *lines: str) -> None:
        """Print lines beside the results."""
        for line in lines:
            self.console.print(line, soft_wrap=True)

    def show(self, *results: "str | Table") -> None:
        """Print tables and lines of the result."""
        for result in results:
            self.tables.print(result, soft_wrap=isinstance(result, str))

    def print_json(self, text: str) -> None:
        """Print JSON where it was asked for."""
        if self._json is not None:
            print(text, file=self._json)

    def opening(self, scenario: "mc.Scenario | None" = None) -> None:
        """Say where compiled programs are kept, and what to know of a scenario before it is walked."""
        from tuning.report import remarks

        self.say(_cache_state(), *(f"warning: {line}" for line in (remarks.ahead_of(scenario) if scenario else ())))

    def written(self, out: Path, files: str, json: str, before: str = "") -> None:
        """Say what was written in which time, and print the JSON where it was asked for."""
        self.say(f"{before}written to {out} in {duration(time.perf_counter() - self.begin)}: {files}")
        self.print_json(json)

    def result(
        self, out: Path, problem: "Problem", written: "Written", *, gains: bool = False, before: str = ""
    ) -> None:
        """Print what a result says, `gains` axis by axis with it, and what was written."""
        self.show(*report.tables_of(written, problem, self.tables.width, gains=gains))
        self.written(out, written.files, written.summary, before)

    @contextlib.contextmanager
    def stage(self, name: str, *, compiles: bool = True, unit: str = "walks") -> Iterator[Callable[..., None]]:
        """Show one stage; the function that it gives takes how many walks are done, how many there are, and a text.

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
            compilation.since = now = time.perf_counter()
            left = estimate.update(done, total, now)
            text = text or f"{name}: {done} of {total} {unit}"
            text += f", about {duration(left)} left" if left else ""
            if done or left is not None:
                bar.update(task, description=text, completed=done, total=total)
            if done and not self.console.is_terminal:
                self.console.print(text, soft_wrap=True)
            interruption.check()

        with Compilation(compiled) as compilation, bar:
            yield advanced
        text = f"{name}: {duration(time.perf_counter() - begin)}"
        spent = [f"{duration(seconds)} {source}" for source, seconds in compilation.seconds.items()]
        self.console.print(text + (f", of which {' and '.join(spent)}" if spent else ""))


def duration(seconds: float) -> str:
    """Return a length of time as a person would say it."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def _cache_state() -> str:
    """Return one line on XLA's compilation cache."""
    from mjx_climb.execution import cache

    folder = cache.cache_in_use()
    if folder is None:
        return f"compilation cache: off ({cache.VARIABLE})"
    with contextlib.suppress(OSError):
        count = len(list(Path(folder).glob("*-cache")))
        return f"compilation cache: {folder}, {count or 'no'} programs"
    return f"compilation cache: {folder}"
