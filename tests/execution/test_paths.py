"""What a trial of a fast path makes of this machine: a verdict that lasts, and the plain path where it is bad."""

import os
import re
import types
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.errors import JaxRuntimeError

from mjx_climb.execution import one_robot, paths
from mjx_climb.execution.elements import Unsupported


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
        ("print('the same'); raise SystemExit(3)", "a trial failed: the same", True),
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


ON = {  # the backend, the GPU's compute capability, the fast path and whether the kernel walks thousands as soon
    "cpu": ("cpu", None, "regions", False), "new": ("gpu", "9.0", "kernel", True),
    "oldest": ("gpu", "8.0", "kernel", True), "old": ("gpu", "7.5", None, False), "none": ("gpu", None, None, False),
    "AMD's": ("gpu", "gfx942", None, False), "another": ("tpu", None, None, False),
}  # fmt: skip


@pytest.mark.parametrize(("backend", "capability", "path", "many"), ON.values(), ids=ON)
def test_a_device_has_the_path_that_is_made_for_it(monkeypatch, backend, capability, path, many):
    device = types.SimpleNamespace(**({"compute_capability": capability} if capability else {}))
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "devices", lambda: [device])
    asked = []
    monkeypatch.setattr(paths, "works", lambda path: asked.append(path) or path == "kernel")
    assert (paths.fast_path(), paths.fast_path("cpu"), paths.fast_path("tpu")) == (path, "regions", None)
    assert (paths.many_at_once(np.float32), paths.many_at_once(np.float64)) == (many, False)
    assert paths.path_for(None, kernel=True) == ("kernel" if path == "kernel" else "plain")
    assert asked == [path] * (path is not None)
    assert paths.path_for(None, kernel=False) == "plain"
    assert asked == [path] * (path is not None) + ["regions"] * (path == "regions")


LEVEL, WIDTH = "xla_backend_optimization_level", "xla_cpu_prefer_vector_width"


@pytest.mark.parametrize(
    ("path", "device", "briefly", "flags", "expected"),
    [
        ("regions", None, False, "", {LEVEL: 1, WIDTH: 512}),
        ("regions", "cpu", True, "", {LEVEL: 0, WIDTH: 512}),
        ("regions", None, False, f"--{LEVEL}=3", {WIDTH: 512}),
        ("regions", None, True, f"--{LEVEL}=3", {LEVEL: 0, WIDTH: 512}),
        ("plain", None, False, "", {}),
        ("plain", None, True, "", {LEVEL: 0}),
        ("kernel", "gpu", True, "", {}),
        ("regions", "gpu", True, "", {}),
    ],
)
def test_a_cpu_alone_compiles_by_own_options(monkeypatch, cpu_alone, path, device, briefly, flags, expected):
    """A level that the user has set holds, but for what is compiled briefly."""
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert paths.compiler_options(path, device, briefly=briefly) == expected


@pytest.mark.parametrize(
    ("error", "tried"),
    [
        (JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory"), ["kernel"]),
        (NotImplementedError("RESOURCE_EXHAUSTED"), ["kernel"]),
        (Unsupported("the operation RESOURCE_EXHAUSTED"), ["kernel", "plain"]),
        (JaxRuntimeError("INTERNAL: no such instruction\nand more"), ["kernel", "plain"]),
        (ValueError("of the user's"), ["kernel"]),
    ],
)
def test_what_no_path_avoids_is_raised(error, tried):
    """As too little memory; what a path alone cannot do goes by the plain one."""
    taken = []

    def by(path):
        taken.append(path)
        if path != "plain":
            raise error

    if len(tried) == 1:
        with pytest.raises(type(error)) as raised:
            paths.first_possible(by, "kernel", str(error))
        assert raised.value is error
    else:
        said = re.escape(f"the GPU kernel cannot do {str(error).splitlines()[0]}: by XLA's own way, slower")
        with pytest.warns(UserWarning, match=f"^{said}$"):
            paths.first_possible(by, "kernel", str(error))
    assert taken == tried


@pytest.mark.parametrize(("robots", "limit", "processes", "device"), [
    (500, "500", 1, "cpu"), (501, "500", 1, None), (1, "0", 1, None), (1, "", 2, None), (1, "500", 2, None),
    (1, " 7 ", 1, "cpu"),
])  # fmt: skip
def test_the_user_says_how_many_robots_go_to_the_cpu(monkeypatch, robots, limit, processes, device):
    """But for a computation of several processes."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(jax, "process_count", lambda: processes)
    monkeypatch.setenv(paths.ON_CPU, limit)
    assert paths.device_for(robots, 0, kernel=True) == device


def test_a_verdict_lasts_until_the_code_or_the_machine_is_another(fresh, monkeypatch):
    tried = []
    monkeypatch.setattr(paths, "tried", lambda path: (tried.append(path) or paths.Verdict(True, "tried"), True))
    monkeypatch.setattr(paths, "machine", lambda: machine)
    monkeypatch.setattr(paths, "source_digest", lambda folder: f"{digest} of {folder.name}")
    for path, digest, machine, times in (  # noqa: B007
        ("regions", "a", "m", 1), ("regions", "a", "m", 1), ("kernel", "a", "m", 2), ("regions", "b", "m", 3),
        ("regions", "b", "n", 4), ("regions", "a", "m", 4),
    ):  # fmt: skip
        paths.verdict.cache_clear()
        assert paths.verdict(path).works and len(tried) == times


def test_a_trial_leaves_the_memory_and_the_keys_of_this_process_alone(fresh, monkeypatch):
    """It compiles all anew, and finds this package where this process has it from."""
    started = []
    monkeypatch.setattr(paths.subprocess, "Popen", lambda command, **how: started.append((command, how)))
    monkeypatch.setenv("PYTHONPATH", "of the user")
    paths.trial("regions")
    [(command, how)] = started
    assert command[1:] == ["-c", "from mjx_climb.execution import paths; paths.take('regions')"]
    assert how["start_new_session"] and how["text"] and how["stdin"] == paths.subprocess.DEVNULL
    said = {name: how["env"][name] for name in how["env"] if name.startswith(("XLA_PYTHON", "JAX_ENABLE", "JAX_TRACE"))}
    assert said == {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "JAX_ENABLE_COMPILATION_CACHE": "false",
                    "JAX_TRACEBACK_FILTERING": "off"}  # fmt: skip
    root = str(Path(paths.__file__).parents[2])
    assert how["env"]["PYTHONPATH"] == os.pathsep.join([root, "of the user"])


def test_where_there_is_a_gpu_all_paths_are_tried_side_by_side(fresh, monkeypatch):
    """Those that nothing is known of; on a device that no path is for, none, and one that cannot start is no error."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    begun, asked = [], []
    monkeypatch.setattr(paths.subprocess, "Popen", lambda command, **_: begun.append(command[-1].split("'")[1]))
    monkeypatch.setattr(paths, "tried", lambda path: (asked.append(path) or paths.Verdict(True, "tried"), True))
    forget()
    assert paths.works("kernel") and begun == asked == ["regions", "kernel"]
    forget()
    paths.begin()  # known from the folder
    assert len(begun) == 2
    for file in fresh.iterdir():
        file.unlink()
    for backend, expected in (("tpu", []), ("cpu", ["regions"])):
        forget()
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        paths.begin()
        assert begun[2:] == expected

    def missing(command, **_):
        raise FileNotFoundError(command[0])

    monkeypatch.setattr(paths.subprocess, "Popen", missing)
    forget()
    paths.begin()
