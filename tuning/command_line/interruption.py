"""Ctrl-C and SIGTERM while a command runs: the first is a wish that the command reads, the second ends it at once.

An exception out of a signal handler surfaces wherever the process happens to be, and is lost where that is a callback
of JAX's. So the handler only notes the signal; commands look between rounds, parts and stages. Python runs handlers
when the main thread next runs Python, which may be after minutes in XLA's compiler: a second thread, woken by the
signal itself, sees to it that a second signal ends the process even then, and a first one where nothing would be kept
(`at_once`). Where no Python runs at all any more, as in a library that hangs, the system does (glibc's): a handler is
good for one signal, until that thread puts it back.
"""

import contextlib
import ctypes
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import FrameType

CODE = 130  # exit code, as of shells
SIGNALS = (signal.SIGINT, signal.SIGTERM)
NOTHING_KEPT = "interrupted: nothing was kept; the same command starts again"


class Watch:
    """Watches both signals from its making on, in the main thread."""

    def __init__(self) -> None:
        self.requested = self.at_once = False
        self._woken, self.waker = socket.socketpair()
        self.waker.setblocking(False)
        signal.set_wakeup_fd(self.waker.fileno(), warn_on_full_buffer=False)
        for number in SIGNALS:
            signal.signal(number, self._note)
        self._put_back = _for_one_signal()
        threading.Thread(target=self._listen, daemon=True).start()

    def _note(self, _: int, __: FrameType | None) -> None:
        self.requested = True

    def _listen(self) -> None:
        count = 0
        while arrived := self._woken.recv(1):  # nothing once the other end is closed
            if arrived[0] not in SIGNALS:
                continue
            self._put_back(arrived[0])
            count, self.requested = count + 1, True
            if count > 1:
                _say(b"interrupted at once: what was finished is kept; the same command goes on from there")
                os._exit(CODE)
            if self.at_once:
                _say(NOTHING_KEPT.encode())
                os._exit(CODE)
            _say(b"interrupted: ends after what is under way; a second signal ends it at once")
        self._woken.close()


_WATCH: ContextVar[Watch | None] = ContextVar("watch", default=None)


def watch() -> None:
    """Watch the signals from here on, in the main thread; Python leaves them to no other."""
    if threading.current_thread() is threading.main_thread():
        _WATCH.set(Watch())


def finish() -> None:
    """Stop watching and ignore both signals: Python takes handlers away before it ends, and the default is death."""
    if (watching := _WATCH.get()) is not None:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)
        watching.waker.close()
        _WATCH.set(None)


def requested() -> bool:
    """Return whether the program was asked to end."""
    return (watching := _WATCH.get()) is not None and watching.requested


def check() -> None:
    """Raise KeyboardInterrupt where the program was asked to end."""
    if requested():
        raise KeyboardInterrupt


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Have the first signal end the process within a block that keeps nothing.

    Raises:
        KeyboardInterrupt: the program was asked to end before.
    """
    watching = _WATCH.get()
    if watching is None:
        yield
        return
    watching.at_once = True
    try:
        check()
        yield
    finally:
        watching.at_once = False


class Interrupted(Exception):
    """Ctrl-C, with a line on the work that was kept."""


def _for_one_signal() -> Callable[[int], None]:
    """Have both signals handled once, the next one ends the process; return a function that puts a handler back."""
    handlers: dict[int, ctypes.c_void_p] = {number: ctypes.c_void_p() for number in SIGNALS}

    def put(number: int) -> None:
        with contextlib.suppress(AttributeError):  # no such function here
            libc.sysv_signal(number, handlers[number])

    libc = ctypes.CDLL(None)
    for number in SIGNALS:
        action = ctypes.create_string_buffer(1024)  # more than a struct sigaction, which begins with the handler
        libc.sigaction(number, None, action)
        handlers[number] = ctypes.c_void_p.from_buffer_copy(action)
        put(number)
    return put


def _say(text: bytes) -> None:
    """Write a line to standard error past Python's buffers: the main thread may be about to write."""
    cursor = b"\x1b[?25h" if os.isatty(2) else b""  # progress bars hide it
    with contextlib.suppress(OSError):  # nobody reads it
        os.write(2, b"%smjx-climb: %s\n" % (cursor, text))
