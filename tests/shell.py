"""The program in processes of its own, as a shell starts it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROGRAM = [sys.executable, "-m", "tuning.command_line"]


def environment(**variables: str) -> dict[str, str]:
    """Return the environment of a program that finds this checkout from any folder."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "off", **variables}


def start(*arguments: object, folder: Path = ROOT, **variables: str) -> subprocess.Popen[str]:
    """Start a command."""
    command, pipe = [*PROGRAM, *map(str, arguments)], subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=folder, env=environment(**variables))


def ends(*processes: subprocess.Popen[str]) -> list[tuple[int, str, str]]:
    """Return the exit code, standard output and standard error of each."""
    said = [process.communicate(timeout=900) for process in processes]
    return [(process.returncode, *texts) for process, texts in zip(processes, said, strict=True)]


def finish(*arguments: object, code: int = 0, **how: str) -> tuple[str, str]:
    """Run a command to its end, which must have this exit code; return standard output and standard error."""
    ((found, out, errors),) = ends(start(*arguments, **how))
    assert found == code, errors
    return out, errors


def killed(*arguments: object, once: Path, count: int = 1, after: float = 0.0) -> None:
    """Start a command and kill it once a folder holds so many finished parts, some seconds `after` that."""
    process = start(*arguments)
    wait_for_parts(process, once, count)
    time.sleep(after)
    process.kill()
    ((code, _, errors),) = ends(process)
    assert code == -signal.SIGKILL, errors


def wait_for_parts(process: subprocess.Popen[str], folder: Path, count: int = 1) -> None:
    """Wait until a folder holds so many finished parts, or the command has ended."""
    while len(list(folder.glob("parts/part-*.npz"))) < count and process.poll() is None:
        time.sleep(0.01)


def same_files(one: Path, other: Path, *names: str) -> None:
    """Check that files of two folders are the same, bit by bit."""
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
