"""What a user waits for: whole commands in processes of their own, with an empty cache and with a full one."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

PROGRAM = ("-m", "tuning.command_line")
IMPORT, HELP, RUN, SWEEP, TUNE = "import mjx_climb", "--help", "run", "sweep of the README", "tune, twelve gains"
COMMANDS: Mapping[str, Sequence[str]] = {
    IMPORT: ("-c", "import mjx_climb"),
    HELP: (*PROGRAM, "--help"),
    RUN: (*PROGRAM, "run", "case_2", "--out", "run"),
    SWEEP: (*PROGRAM, "sweep", "case_1_2", "--stiffness", "1e2:1e6:12", "--damping", "1e0:1e5:12", "--out", "sweep"),
    TUNE: (*PROGRAM, "tune", "case_1_2", "--space", "diagonal", "--out", "tune"),
}


class Waited(NamedTuple):
    """Seconds of one command."""

    cold: float  # on the clock, with an empty cache
    warm: float  # the same again
    cold_cpu: float  # of processors, which other programs on the machine hardly change
    warm_cpu: float


def measure(names: Sequence[str], say: Callable[[str], object]) -> dict[str, Waited]:
    """Return how long commands of `COMMANDS` take, each with a cache of its own; `say` is told what goes on.

    Raises:
        subprocess.CalledProcessError: a command fails.
    """
    found = {}
    for name in names:
        with tempfile.TemporaryDirectory(prefix="mjx-climb-bench-", ignore_cleanup_errors=True) as folder:
            say(f"{name}, cold")
            cold, cold_cpu = _run(COMMANDS[name], Path(folder))
            say(f"{name}, warm")
            warm, warm_cpu = _run(COMMANDS[name], Path(folder))
        found[name] = Waited(cold, warm, cold_cpu, warm_cpu)
    return found


def _run(arguments: Sequence[str], folder: Path) -> tuple[float, float]:
    """Return the seconds of a run of Python in a folder, on the clock and of processors."""
    environment = {name: v for name, v in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    # for a package that is not installed, as a checkout
    paths = os.pathsep.join(os.path.abspath(path) for path in sys.path if path)
    environment |= {"MJX_CLIMB_CACHE": str(folder / "cache"), "PYTHONPATH": paths}
    before, begin = os.times(), time.perf_counter()
    command = [sys.executable, *arguments]
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    seconds, after = time.perf_counter() - begin, os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return seconds, used
