"""What a trial of a fast path makes of this machine: a verdict that lasts, and the plain path where it is bad."""

import warnings

import pytest
from jax.errors import JaxRuntimeError

from mjx_climb.execution import one_robot, paths


def forget():
    with warnings.catch_warnings(action="ignore", category=ResourceWarning):  # a trial that nobody asked for goes on
        for known in (paths.works, paths.verdict, paths.trial):
            known.cache_clear()


@pytest.fixture
def fresh(monkeypatch, tmp_path, cpu_alone):
    """Forget all verdicts, before and after, and keep those of the test in a folder of its own."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    forget()
    yield tmp_path / "probes"
    forget()


@pytest.fixture
def trial(monkeypatch):
    """Run another program in place of the trial."""

    def put(program):
        monkeypatch.setattr(paths, "TRIAL", program)
        forget()

    return put


@pytest.mark.slow
def test_a_path_that_works_is_tried_once(fresh, trial):
    assert paths.verdict("regions") == (True, "tried, and compared with XLA's own")
    trial("1 / 0")
    assert paths.works("regions")  # known from the folder
    for file in fresh.iterdir():
        file.write_text("{")
    trial("1 / 0")
    with pytest.warns(UserWarning, match="ZeroDivisionError"):
        assert not paths.works("regions")


def test_a_trial_that_was_begun_is_the_one_asked_for(fresh, trial, monkeypatch):
    trial("print('the same')")
    paths.begin()
    monkeypatch.setattr(paths, "TRIAL", "1 / 0")  # what would be started now
    assert paths.works("regions")
    forget()
    paths.begin()  # known from the folder: starts nothing
    assert not paths.trial.cache_info().currsize


@pytest.mark.parametrize(
    ("program", "seen", "lasts"),
    [
        ("import os; os.abort()", "stopped by SIGABRT", True),
        # a command that ran in this process before ignores the signal, and children inherit that
        ("import os, signal; signal.signal(15, signal.SIG_DFL); os.kill(os.getpid(), 15)", "stopped by SIGTERM", False),
        ("print('0.1 off in float32')", "0.1 off in float32", True),
        ("1 / 0", "ZeroDivisionError", True),
    ],
)
def test_a_path_that_does_not_work_is_left_with_a_word(fresh, trial, program, seen, lasts):
    trial(program)
    with pytest.warns(UserWarning, match=f"the CPU's regions cannot be used here .*{seen}") as said:
        assert not any(paths.path_for("cpu", kernel=True) == "regions" for _ in range(2))
    assert len(said) == 1
    assert fresh.exists() == lasts


def test_a_trial_that_cannot_start_is_no_verdict_for_ever(fresh, monkeypatch):
    monkeypatch.setattr(paths.sys, "executable", "/nowhere")
    with pytest.warns(UserWarning, match="no trial: FileNotFoundError"):
        assert not paths.path_for("cpu", kernel=False) == "regions"
    assert not fresh.exists()


def test_what_a_path_cannot_do_is_tried_once_and_something_else_again():
    tried = []

    def by(path):
        tried.append(path)
        if path != "plain":
            raise NotImplementedError("this")
        return path

    with pytest.warns(UserWarning, match="the CPU's regions cannot do this: by XLA's own way, slower") as said:
        assert [paths.first_possible(by, "regions", what) for what in ("one of a test", "one of a test", "another")]
    assert tried == ["regions", "plain", "plain", "regions", "plain"] and len(said) == 2


def test_an_error_of_a_users_own_function_is_tried_on_no_other_path():
    tried = []

    def by(path):
        tried.append(path)
        raise JaxRuntimeError("INTERNAL: error calling callback: Traceback (most recent call last):")

    with pytest.raises(JaxRuntimeError, match="callback"):
        paths.first_possible(by, "regions", "a callback that fails")
    assert tried == ["regions"]


@pytest.mark.parametrize(
    ("robots", "tangents", "kernel", "device"),
    [
        (8, 0, True, "cpu"),
        (9, 0, True, None),
        (32, 1, True, "cpu"),
        (33, 1, True, None),
        (64, 0, False, "cpu"),
        (5, paths.AN_ADJOINT, True, "cpu"),
        (6, paths.AN_ADJOINT, True, None),
    ],
)
def test_few_robots_walk_on_the_cpu_where_there_is_a_gpu(robots, tangents, kernel, device, monkeypatch):
    """A robot counts once, and once for each of its tangents; the kernel walks a few as soon."""
    monkeypatch.setattr(paths.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(paths, "path_for", lambda _, *, kernel: "kernel" if kernel else "plain")
    monkeypatch.delenv(paths.ON_CPU, raising=False)
    assert paths.device_for(robots, tangents, kernel=kernel) == device


def test_the_trial_of_the_regions_sees_wrong_values(monkeypatch, capsys):
    in_regions = one_robot.in_regions

    def off(*given):
        return [1.01 * value for value in in_regions(*given)]

    monkeypatch.setattr(one_robot, "in_regions", off)
    paths.take("regions")
    assert "off in float64" in capsys.readouterr().out
