"""A thousand malformed inputs: never a traceback, never a hang, never half a result; one line says what is wrong."""

import contextlib
import re
import signal
import time
from pathlib import Path

import pytest

from mjx_climb.viz.rendering import backend
from tests.fuzz import COMMANDS, case
from tuning.command_line import main, program

CASES, CHUNK, QUICK = 1000, 50, 50
PATIENCE = 1000  # times the processor's time for a call that is valid; the longest takes a hundred


class Started(Exception):
    """The input is valid: the computation would begin."""


@pytest.fixture
def valid_input_stops_here(monkeypatch):
    def start(*_, **__):
        raise Started

    for name in (
        "mjx_climb.rollout", "mjx_climb.rollout_metrics", "mjx_climb.rollout_histories",
        "tuning.comparisons.of_sweep.begin", "tuning.problem.evaluation.baseline", "tuning.problem.evaluation.pd_of",
        "tuning.searches.schedule.pd_of", "tuning.comparisons.deployment.check", "tuning.benchmarks.measure.measure",
        "tuning.command_line.machine.examine", "tuning.identification.plan.excitation.chosen",
        "tuning.identification.model.replay.simulate", "tuning.identification.fit.identify.model_of",
        "tuning.identification.fit.identify.gripped_model",
    ):  # fmt: skip
        monkeypatch.setattr(name, start)
    monkeypatch.setattr(backend, "find", lambda: "egl")


def test_every_command_is_tried():
    assert {command.partition(",")[0] for command in COMMANDS} == set(program.COMMANDS)


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return all that lies in a folder."""
    found = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in found}


@pytest.fixture
def patience(valid_input_stops_here, tmp_path, capsys):
    """Return a context that a call must leave in so many times the processor's time of a valid one: load is no hang."""
    for _ in range(2):  # the first one imports
        begin = time.process_time()
        with pytest.raises(Started):
            main(["run", "case_1_2", "--out", str(tmp_path / "valid")])
        longest = PATIENCE * (time.process_time() - begin)
    capsys.readouterr()

    def late(*_):
        raise TimeoutError("hangs")

    @contextlib.contextmanager
    def wait():
        before = signal.signal(signal.SIGPROF, late)
        signal.setitimer(signal.ITIMER_PROF, longest)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, before)

    return wait


def check_refusal(code, out: str, err: str, arguments: list[str]) -> None:
    """A refusal is exit code 2, nothing on standard output, and one line that names a place in the input.

    What is suspected of a log is said before it: a fit may be refused later.
    """
    *before, last = err.splitlines(keepends=True)
    assert all(line.startswith("warning: ") and ".csv: " in line for line in before), err
    err = last
    assert (code, out) == (2, "")
    assert err.startswith("mjx-climb: error: ") and err.endswith("\n")
    assert len(err.splitlines()) == 1, err
    assert len(err) < 1500
    named = ["error: results: "]  # forms in which a message may name an argument, or a default of one
    for argument in arguments:
        path = Path("".join(c if c.isprintable() else ascii(c)[1:-1] for c in argument))
        named += [f"error: {path}: ", f"error: {path}/", path.name[:40]]
    assert re.search(r"--[a-z]|'", err) or any(words in err for words in named if len(words) > 1)


STARTS = [
    pytest.param(start, marks=() if start < QUICK else pytest.mark.slow if start < CASES / 5 else pytest.mark.nightly)
    for start in range(0, CASES, CHUNK)
]


@pytest.mark.parametrize("start", STARTS)
def test_malformed_input_is_refused(start, patience, tmp_path, capsys, call, monkeypatch):
    refused = 0
    for number in range(start, start + CHUNK):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        malformed = case(number)
        for name, content in malformed.files.items():
            (folder / name).mkdir() if content is None else (folder / name).write_bytes(content)
        arguments = [argument.replace("{folder}", str(folder)) for argument in malformed.arguments]
        before = tree(folder)
        try:
            with patience():
                code, out, err = call(*arguments)
            if code != 0:
                check_refusal(code, out, err, arguments)
                assert tree(folder) == before
                refused += 1
        except Started:
            capsys.readouterr()
        except BaseException as error:
            error.add_note(f"case {number}: {malformed}")
            raise
    assert refused > CHUNK // 2
