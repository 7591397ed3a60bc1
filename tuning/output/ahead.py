"""Works that do not wait for each other, side by side where cores are idle."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, Protocol, TypeVar

import jax

from mjx_climb.compilation import devices
from tuning.output.stages import Told

Result = TypeVar("Result")
Asked = Callable[[Told], Result]  # gives a work's result; it tells how far it has come from there on
_CORES = 4  # that a work keeps busy by itself
_FEWEST = 2  # works at once: while one loads its program or walks its last robots, another has a core


class Begin(Protocol):
    """Takes a work, which is given whom to tell how far it has come, and gives what asks for its result."""

    def __call__(self, work: Asked[Result], /) -> Asked[Result]: ...


@contextlib.contextmanager
def ahead(busy: int = 0) -> Iterator[Begin]:
    """Give a function that begins a work: at once where there is more than one core, else when its result is asked for.

    So many cores as are `busy` with something else, a search that compiles for example, are left to it.
    At the end works that nobody has asked for are ended, the next time that they tell how far they have come.
    """
    cores = devices.usable_cores()
    at_once = min(max(_FEWEST, cores // _CORES), max(1, cores - busy))
    if cores == 1 or jax.process_count() > 1:  # several processes must do the same in the same order
        yield _when_asked
        return
    threads, ended = ThreadPoolExecutor(at_once), threading.Event()

    def begin(work: Asked[Result]) -> Asked[Result]:
        listening: list[Told] = []

        def told(*done: Any) -> None:
            if ended.is_set():
                raise KeyboardInterrupt
            for listener in listening:
                listener(*done)

        result = threads.submit(copy_context().run, work, told).result

        def asked(listener: Told) -> Result:
            listening.append(listener)
            return result()

        return asked

    try:
        yield begin
    finally:
        ended.set()
        threads.shutdown(cancel_futures=True)


def _when_asked(work: Asked[Result]) -> Asked[Result]:
    return work


def to_nobody(*_: Any) -> None:
    """Take no notice of how far a work has come."""
