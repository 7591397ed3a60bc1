"""Commands interrupted at random instants: `python -m tests.interrupts [COMMAND ...] [--count N] [--seed N]`.

Each command runs twice undisturbed, then again and again, and gets SIGINT or SIGTERM at an instant drawn evenly from
that time (or from `--length S`). It must end with code 130 and one last line that says what was kept, or have come to
its end before. Prints how the tries ended and how long the commands took to obey.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
CASE = str(ROOT / "configs" / "case_1_2.yaml")
SHORT = [CASE, "--set", "duration=0.1"]
COMMANDS = {  # {gains} stands for a gains file
    "run": ["run", *SHORT, "--compare", "pd"],
    "sweep": ["sweep", *SHORT, "--stiffness", "1e3:1e5:2", "--damping", "1e2:1e3:2", "--batch-size", "1"],
    "shard": ["sweep", *SHORT, "--stiffness", "1e3:1e5:2", "--damping", "1e2:1e3:2", "--shard", "1/2"],
    "tune": ["tune", *SHORT, "--starts", "2", "--iterations", "3"],
    "ensemble": ["tune", *SHORT, "--ensemble", "ensemble", "--members", "2", "--starts", "2", "--iterations", "2"],
    "pareto": ["pareto", *SHORT, "--points", "2"],
    "schedule": ["schedule", *SHORT, "--gravity", "0.1,1", "--cargo", "0.5"],
    "reproduce": ["reproduce"],
    "margins": ["margins", *SHORT, "--gains", "{gains}"],
    "judge": ["judge", *SHORT, "--gains", "{gains}", "--members", "4"],
    "export": ["export", "{gains}", "--update-rate", "500"],
    "schema": ["schema"],
    "doctor": ["doctor"],
    "bench": ["bench", "--quick", "--batch", "64"],
}
IN_A_FOLDER = ("run", "sweep", "shard", "tune", "ensemble", "pareto", "schedule", "margins", "judge", "reproduce")
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
    said: str  # last line on standard error


def start(command: str, folder: Path) -> subprocess.Popen[str]:
    """Start a command that writes below a folder."""
    gains = folder / "gains.yaml"
    gains.write_text(GAINS)
    arguments = [argument.format(gains=gains) for argument in COMMANDS[command]]
    arguments += ["--out", str(folder / "out")] if command in IN_A_FOLDER else []
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "off"}
    return subprocess.Popen(
        [sys.executable, "-m", "tuning.command_line", *arguments], cwd=folder, env=environment, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip


def undisturbed(command: str, folder: Path) -> float:
    """Return how long a command takes, in s, once its programs are compiled."""
    for _ in range(2):
        begin = time.monotonic()
        process = start(command, folder)
        _, errors = process.communicate()
        length = time.monotonic() - begin
        if process.returncode != 0:
            raise RuntimeError(f"{command} undisturbed: {errors}")
    return length


def attempts(command: str, count: int, length: float, rng: np.random.Generator, folder: Path) -> list[Attempt]:
    """Return how a command ends at so many instants of its length in s."""
    return [_attempt(command, rng.uniform(0, length), rng.choice(["SIGINT", "SIGTERM"]), folder) for _ in range(count)]


def _attempt(command: str, after: float, name: str, folder: Path) -> Attempt:
    process = start(command, _folder(folder))
    time.sleep(after)
    begin = time.monotonic()
    before = process.poll() is not None
    process.send_signal(getattr(signal, name))
    _, errors = process.communicate()
    took = time.monotonic() - begin
    lines = errors.splitlines()
    last = lines[-1] if lines else ""
    kind = _kind(process.returncode, errors, last, before)
    return Attempt(command, name, after, took, process.returncode, kind, last)


def _kind(code: int, errors: str, last: str, before: bool) -> str:
    if before:
        return "ended before" if code == 0 else f"code {code} undisturbed"
    if "mjx-climb" not in errors and "mjx_climb" not in errors and str(ROOT / "tuning") not in errors:
        if code == 0:
            return "ended before"
        if code in (-signal.SIGTERM, -signal.SIGINT, 1, 130):  # Python itself starts, its import of `site` among others
            return "before the program's first line"
    if "Traceback" in errors:
        return "traceback"
    if code == 0:  # came to its end as the signal came
        return "ended before"
    if code != 130:
        return f"code {code}"
    return "interrupted" if last.startswith("mjx-climb: interrupted") else "no last line"


def _folder(parent: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=parent))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[*COMMANDS, []], default=list(COMMANDS))
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--length", type=float, default=None, help="of each command, s")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    wrong = 0
    for command in chosen.commands:
        with tempfile.TemporaryDirectory() as folder:
            length = chosen.length or undisturbed(command, _folder(Path(folder)))
            tries = attempts(command, chosen.count, length, rng, Path(folder))
        took = [attempt.took for attempt in tries if attempt.kind == "interrupted"] or [0.0]
        kinds = ", ".join(f"{count} {kind}" for kind, count in Counter(attempt.kind for attempt in tries).items())
        obeyed = f"to the end {np.median(took):.2f} s in the median, {max(took):.2f} s at most"
        print(f"{command}, {length:.1f} s: {kinds}; {obeyed}")
        for attempt in tries:
            if attempt.kind not in FINE:
                wrong += 1
                print(f"  {attempt}")
        sys.stdout.flush()
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
