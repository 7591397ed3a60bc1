"""What a trial of a fast path makes of this machine: a verdict that lasts, and the plain path where it is bad."""

import pytest

import mjx_climb as mc
from mjx_climb.compilation import options, probe


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """Forget all verdicts, before and after, and keep those of the test in a folder of its own."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    probe.works.cache_clear()
    probe.verdict.cache_clear()
    yield tmp_path / "probes"
    probe.works.cache_clear()
    probe.verdict.cache_clear()


@pytest.fixture
def trial(monkeypatch):
    """Run another program in place of the trial."""

    def put(program):
        monkeypatch.setattr(probe, "_TRIAL", program)
        probe.works.cache_clear()
        probe.verdict.cache_clear()

    return put


def test_a_path_that_works_is_tried_once(fresh, trial):
    assert probe.verdict("pieces") == (True, "tried, and compared with XLA's own")
    trial("1 / 0")
    assert probe.works("pieces")  # known from the folder
    for file in fresh.iterdir():
        file.write_text("{")
    trial("1 / 0")
    with pytest.warns(UserWarning, match="ZeroDivisionError"):
        assert not probe.works("pieces")


@pytest.mark.parametrize(
    ("program", "seen", "lasts"),
    [
        ("import os; os.abort()", "stopped by SIGABRT", True),
        ("import os; os.kill(os.getpid(), 15)", "stopped by SIGTERM", False),
        ("print('0.1 off in float32')", "0.1 off in float32", True),
        ("1 / 0", "ZeroDivisionError", True),
    ],
)
def test_a_path_that_does_not_work_is_left_with_a_word(fresh, trial, program, seen, lasts):
    trial(program)
    with pytest.warns(UserWarning, match=f"the CPU's pieces cannot be used here .*{seen}") as said:
        assert not any(mc.pieces_pay("limb", "cpu") for _ in range(2))
    assert len(said) == 1
    assert fresh.exists() == lasts


def test_a_trial_that_cannot_start_is_no_verdict_for_ever(fresh, monkeypatch):
    monkeypatch.setattr(probe.sys, "executable", "/nowhere")
    with pytest.warns(UserWarning, match="no trial: FileNotFoundError"):
        assert not options.pieces_pay("limb", "cpu")
    assert not fresh.exists()
