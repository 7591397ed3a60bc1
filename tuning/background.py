"""Background work: independent works side by side where cores are idle, and their progress."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, Protocol, TypeVar

import jax

from mjx_climb.execution import devices

Result = TypeVar("Result")
Callback = Callable[..., None]  # called with walks done, walks in all, and perhaps a text
Work = Callable[[Callback], Result]  # returns its result; the callback hears of its progress
# opens a stage of a work: its name, whether programs may have to be compiled in it, and the unit of its progress
Stage = Callable[..., contextlib.AbstractContextManager[Callback]]
_CORES = 4  # that a work keeps busy by itself
_FEWEST = 2  # works at once: while one loads its executable or simulates its last robots, another has a core


class Begin(Protocol):
    """Begins a work, and returns one that waits for its result."""

    def __call__(self, work: Work[Result], /) -> Work[Result]: ...


@contextlib.contextmanager
def background(busy: int = 0) -> Iterator[Begin]:
    """Give a function that begins a work: at once where there is more than one core, else when its result is asked for.

    So many cores as are `busy` with something else, a search that compiles for example, are left to it.
    At the end works that nobody has asked for are stopped, the next time that they report progress.
    """
    cores = devices.usable_cores()
    if cores == 1 or jax.process_count() > 1:  # several processes must do the same in the same order
        yield lambda work: work
        return
    pool = ThreadPoolExecutor(min(max(_FEWEST, cores // _CORES), max(1, cores - busy)))
    ended = threading.Event()

    def begin(work: Work[Result]) -> Work[Result]:
        callbacks: list[Callback] = []

        def report(*progress: Any) -> None:
            if ended.is_set():
                raise KeyboardInterrupt
            for callback in callbacks:
                callback(*progress)

        future = pool.submit(copy_context().run, work, report)

        def result(callback: Callback) -> Result:
            callbacks.append(callback)
            return future.result()

        return result

    try:
        yield begin
    finally:
        ended.set()
        pool.shutdown(cancel_futures=True)


class Gate:
    """Holds works back until it is opened; those that still wait when its `with` block ends are not done."""

    def __init__(self) -> None:
        self._decided, self._open = threading.Event(), False

    def __enter__(self) -> "Gate":
        return self

    def __exit__(self, *_: object) -> None:
        self._decided.set()

    def open(self) -> None:
        """Let all works begin."""
        self._open = True
        self._decided.set()

    def behind(self, work: Work[Result]) -> Work[Result]:
        """Return a work that begins when the gate is open."""

        def waited(report: Callback) -> Result:
            self._decided.wait()
            if not self._open:
                raise KeyboardInterrupt
            return work(report)

        return waited


def ignore(*_: Any) -> None:
    """Take no notice of a work's progress."""


@contextlib.contextmanager
def silent(*_: Any, **__: Any) -> Iterator[Callback]:
    """Show no progress of a stage."""
    yield ignore
