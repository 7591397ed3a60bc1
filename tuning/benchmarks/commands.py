"""Measurements in fresh processes: whole commands, cold and warm, and a walk's compile times.

`python -m tuning.benchmarks.commands value|gradient BATCH STEPS ENGINE` compiles and runs a walk of a batch, or its
gradient by two gains, twice, and prints as JSON how long each took and when the first was done.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

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
    """Return how long commands of `COMMANDS` take, each with a cache of its own; `say` is told of each step."""
    found = {}
    for name in names:
        clock, processors = [], []
        with tempfile.TemporaryDirectory(prefix="mjx-climb-bench-", ignore_cleanup_errors=True) as folder:
            for state in ("cold", "warm"):
                say(f"{name}, {state}")
                before, begin = os.times(), time.perf_counter()
                _python(COMMANDS[name], f"{folder}/cache", cwd=folder, stderr=subprocess.DEVNULL)
                clock.append(time.perf_counter() - begin)
                _, _, user, system, _ = (now - then for now, then in zip(os.times(), before, strict=True))
                processors.append(user + system)
        found[name] = Waited(*clock, *processors)
    return found


def compiled(what: str, batch: int, steps: int, engine: str, cache: str) -> dict[str, float]:
    """Return seconds from a process's start to its first result, of that result and of the same again.

    The "value" or the "gradient" of a walk is computed; `cache` is the folder of XLA's cache, "off" for none.
    """
    begin = time.time()
    output = _python(("-m", "tuning.benchmarks.commands", what, str(batch), str(steps), engine), cache)
    told = json.loads(output.splitlines()[-1])
    return {"from_start": told["done"] - begin, "first": told["first"], "again": told["again"]}


def _python(arguments: Sequence[str], cache: str, **how: Any) -> str:
    """Return the output of Python in a process of its own; `how` are further arguments of `subprocess.run`."""
    environment = {name: v for name, v in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    # for a package that is not installed, as a checkout
    paths = os.pathsep.join(os.path.abspath(path) for path in sys.path if path)
    environment |= {"MJX_CLIMB_CACHE": cache, "PYTHONPATH": paths}
    command = [sys.executable, *arguments]
    return str(subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True, **how).stdout)


def _time_a_walk(what: str, batch: int, steps: int, engine: str) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a terminal interrupts its whole family: the parent says it
    from tuning.benchmarks import walks

    begin = time.perf_counter()
    run = walks.walk(batch, steps, engine) if what == "value" else walks.gradient(2, batch, steps, engine)
    run()
    first, done = time.perf_counter() - begin, time.time()
    begin = time.perf_counter()
    run()
    print(json.dumps({"first": first, "again": time.perf_counter() - begin, "done": done}))


if __name__ == "__main__":
    _time_a_walk(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
