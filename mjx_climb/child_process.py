"""Files read in a process of their own, where a library may hang or crash on a damaged one."""

import os
import subprocess
import sys

# to read a file: s, and the bytes of it that add one
PATIENCE, BYTES_A_SECOND = 20.0, 20e6


def read_apart(code: str, path: str | os.PathLike[str]) -> subprocess.CompletedProcess[bytes]:
    """Carry out code of Python that reads a file, its first argument, in another process.

    Raises:
        ValueError: the process crashed, or took longer than `PATIENCE`.
    """
    command = [sys.executable, "-c", code, os.fspath(path)]
    limit = PATIENCE + os.path.getsize(path) / BYTES_A_SECOND
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=limit)
    except subprocess.TimeoutExpired:
        raise ValueError("a damaged one") from None
    if done.returncode < 0:
        raise ValueError("a damaged one")
    return done
