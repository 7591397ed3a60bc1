"""Commands interrupted at random instants: `python -m tests.interrupts [COMMAND ...] [--count N] [--jobs N]`.

Each command runs twice undisturbed, then again and again, and gets SIGINT or SIGTERM at an instant drawn evenly from
that time. It must end with code 130 and one last line that says what was kept, or have come to its end before. Prints
how the tries ended and how long the commands took to obey.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.shell import ROOT, finish, start
from tests.tuning.identification.stand_in_mujoco import TRUTH, columns_of, log_of
from tuning.identification.readers import write_csv

CASE = str(ROOT / "configs" / "case_1_2.yaml")
ROBOT = str(ROOT / "mjx_climb" / "robot" / "models" / "hubrobo_v3_2.xml")
SHORT, OUT = [CASE, "--set", "duration=0.1"], ["--out", "out"]
GRID = ["sweep", *SHORT, "--stiffness", "1e3:1e5:2", "--damping", "1e2:1e3:2"]
FEW = ["--starts", "2", "--iterations", "2"]
COMMANDS = {  # {gains} stands for a gains file, {swept} for a result, {shards} for that of its shards, {log} for a log
    "run": ["run", *SHORT, "--compare", "pd", *OUT],
    "sweep": [*GRID, "--batch-size", "1", *OUT],
    "shard": [*GRID, "--shard", "1/2", *OUT],
    "tune": ["tune", *SHORT, "--starts", "2", "--iterations", "3", *OUT],
    "ensemble": ["tune", *SHORT, "--ensemble", "ensemble", *"--members 2 --starts 2 --iterations 2".split(), *OUT],
    "pareto": ["tune", *SHORT, "--against", "base_deviation", "--points", "2", *OUT],
    "schedule": ["tune", *SHORT, "--over", "gravity=0.1,1", "--over", "cargo=0.5", *OUT],
    "reproduce": ["reproduce", *OUT],
    "margins": ["evaluate", *SHORT, "--gains", "{gains}", "--margins", *OUT],
    "pushes": [
        *["evaluate", CASE, "--set", "duration=0.9", "--gains", "{gains}", "--pushes"],
        *"--push-length 0.1 --push-draws 8".split(),
        *OUT,
    ],
    "evaluate": ["evaluate", *SHORT, "--gains", "{gains}", "--members", "4", *OUT],
    "compare": [
        "tune",
        *SHORT,
        *"--law pd --law base_admittance --test-members 4 --starts 2 --iterations 2".split(),
        *OUT,
    ],
    "excite": ["excite", CASE, "--duration", "2", "--candidates", "1", *OUT],
    "identify": ["identify", CASE, "--log", "{log}", "--fit", "control.kp", "--starts", "1", *OUT],
    "export": ["export", "{gains}", "--update-rate", "500"],
    "merge": ["sweep", "--merge", "{shards}", *OUT],
    "plot": ["plot", "{swept}", *OUT],
    "runs": ["runs", "{swept}", *OUT],
    "robot": ["robot", ROBOT],
    "schema": ["doctor", "--schema"],
    "doctor": ["doctor"],
    "bench": ["doctor", "--bench", "--quick", "--batch", "64"],
}
GAINS = "inertia: 2.0\ndamping: 30.0\nstiffness: 500.0\n"

FINE = ("interrupted", "ended before", "before the program's first line")


class Attempt(NamedTuple):
    """How one try ended."""

    command: str
    signal: str
    after: float  # s from the process's start to the signal
    took: float  # s from the signal to the end
    code: int
    kind: str  # one of FINE, or what was wrong
    said: str = ""  # last line on standard error


def prepared(folder: Path) -> dict[str, Path]:
    """Return what commands are given, made here: a gains file, a log, the folder of a sweep, one of its shards."""
    places = {"gains": folder / "gains.yaml", "swept": folder / "swept", "shards": folder / "shards"}
    places["gains"].write_text(GAINS)
    places["log"] = write_csv(folder / "log.csv", columns_of(log_of(TRUTH, 2.0)))
    for name, options in (("swept", []), ("shards", ["--shard", "1/2"]), ("shards", ["--shard", "2/2"])):
        finish(*GRID, *options, "--out", places[name])
    return places


def begin(command: str, given: Mapping[str, Path], folder: Path) -> subprocess.Popen[str]:
    """Start a command that writes below a folder."""
    return start(*(argument.format(**given) for argument in COMMANDS[command]), folder=folder)


def undisturbed(command: str, given: Mapping[str, Path], folder: Path) -> float:
    """Return how long a command takes, in s, once its programs are compiled."""
    for _ in range(2):
        since = time.monotonic()
        process = begin(command, given, folder)
        _, errors = process.communicate()
        length = time.monotonic() - since
        if process.returncode != 0:
            raise RuntimeError(f"{command} undisturbed: {errors}")
    return length


def attempts(
    command: str, instants: np.ndarray, rng: np.random.Generator, given: Mapping[str, Path], folder: Path, jobs: int = 1
) -> list[Attempt]:
    """Return how a command ends at some instants in s after its start, so many tried at a time."""

    def attempt(after: float, name: str) -> Attempt:
        process = begin(command, given, Path(tempfile.mkdtemp(dir=folder)))
        time.sleep(after)
        since = time.monotonic()
        before = process.poll() is not None
        process.send_signal(getattr(signal, name))
        _, errors = process.communicate()
        took, last = time.monotonic() - since, errors.splitlines()[-1:]
        kind = _kind(process.returncode, errors, last, before)
        return Attempt(command, name, after, took, process.returncode, kind, *last)

    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(attempt, instants, rng.choice(["SIGINT", "SIGTERM"], len(instants))))


def _kind(code: int, errors: str, last: list[str], before: bool) -> str:
    if before and code:
        return f"code {code} undisturbed"
    begun = any(name in errors for name in ("mjx-climb", "mjx_climb", str(ROOT / "tuning")))
    # Python itself starts, its import of `site` among others
    if not begun and code in (-signal.SIGTERM, -signal.SIGINT, 1, 130):
        return "before the program's first line"
    if begun and "Traceback" in errors and not before:
        return "traceback"
    if code == 0:  # came to its end as the signal came
        return "ended before"
    if code != 130:
        return f"code {code}"
    return "interrupted" if "".join(last).startswith("mjx-climb: interrupted") else "no last line"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[*COMMANDS, []], default=list(COMMANDS))
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=1, help="tries at a time")
    chosen, rng, failed = parser.parse_args(), np.random.default_rng(), 0
    with tempfile.TemporaryDirectory() as name:
        given = prepared(Path(name))
        for command in chosen.commands:
            folder = Path(tempfile.mkdtemp(dir=name))
            length = undisturbed(command, given, folder)
            tries = attempts(command, rng.uniform(0, length, chosen.count), rng, given, folder, chosen.jobs)
            took = [attempt.took for attempt in tries if attempt.kind == "interrupted"] or [0.0]
            wrong = [attempt for attempt in tries if attempt.kind not in FINE]
            obeyed = f"to the end {np.median(took):.2f} s in the median, {max(took):.2f} s at most"
            kinds = dict(Counter(attempt.kind for attempt in tries))
            print(f"{command}, {length:.1f} s: {kinds}; {obeyed}", *wrong, sep="\n  ", flush=True)
            failed += len(wrong)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
