"""Works that do not wait for each other, side by side where cores are idle."""

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from mjx_climb.compilation import devices

Result = TypeVar("Result")
_CORES = 4  # that a work keeps busy by itself


class Begin(Protocol):
    """Takes a work, and gives what waits for its result."""

    def __call__(self, work: Callable[[], Result], /) -> Callable[[], Result]: ...


@contextlib.contextmanager
def ahead() -> Iterator[Begin]:
    """Give a function that begins a work: at once where there are cores to spare, else when its result is asked for."""
    at_once = devices.usable_cores() // _CORES
    if at_once < 2:
        yield _when_asked
        return
    with ThreadPoolExecutor(at_once) as threads:
        yield lambda work: threads.submit(work).result


def _when_asked(work: Callable[[], Result]) -> Callable[[], Result]:
    return work
