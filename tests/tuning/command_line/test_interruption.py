"""Ctrl-C and SIGTERM: heard at every instant, obeyed at the next occasion, and at once the second time."""

import gc
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.execution.devices import LostProcess
from mjx_climb.files import dataset
from mjx_climb.viz import plots
from tests import interrupts
from tests.shell import ROOT, environment
from tuning.command_line import interruption
from tuning.command_line.session import Session

RUN = ["run", str(ROOT / "configs" / "case_1_2.yaml"), "--set", "duration=0.3"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_where_exceptions_are_lost_is_heard(number, monkeypatch, call, tmp_path):
    """As in a callback of JAX's: Python drops what is raised while it collects garbage."""
    walk, drawn = mc.rollout, []

    def collected(phase, _):
        if phase == "start":
            signal.raise_signal(number)

    def walked(*arguments, **options):
        gc.callbacks.append(collected)
        gc.collect()
        gc.callbacks.remove(collected)
        return walk(*arguments, **options)

    monkeypatch.setattr(mc, "rollout", walked)
    monkeypatch.setattr(plots, "save_figure", lambda *_: drawn.append(1) or [])
    code, out, err = call(*RUN, "--out", tmp_path)
    assert (code, drawn) == (130, []) and "force variation" in out  # the answer comes before the pictures
    assert err.splitlines()[-1] == "mjx-climb: interrupted: nothing was kept; the same command starts again"


_WHILE_IMPORTING = """
import signal, sys, time
class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            signal.raise_signal(signal.SIGINT)
            {then}
sys.meta_path.insert(0, Finder())
from tuning.command_line import main
main(sys.argv[2:])
"""


def interrupted_in(module, folder, command=RUN, then="pass"):
    """Run the program in a process of its own that gets a signal as it imports a module, and `then` does something."""
    out = ["--out", str(folder)] if command is RUN else []
    command = [sys.executable, "-c", _WHILE_IMPORTING.format(then=then), module, *command, *out]
    return subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "tuning.command_line.program",
        *(pytest.param(n, marks=pytest.mark.nightly) for n in ("typer", "jax", "mjx_climb.simulation")),
    ],
)
def test_a_signal_while_modules_are_imported(module, tmp_path):
    """It ends the program in one line, not in an ImportError of whatever was under way."""
    done = interrupted_in(module, tmp_path)
    assert (done.returncode, done.stdout) == (130, ""), done.stderr
    assert done.stderr.splitlines()[-1].startswith("mjx-climb: interrupted: nothing was kept")
    assert "Traceback" not in done.stderr


def test_a_signal_before_the_program_watches(tmp_path):
    """It ends the process at once, as any program that has not begun, without a traceback."""
    done = interrupted_in("socket", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


_WATCHING = """
from tuning.command_line import interruption
interruption.watch()
print("busy", flush=True)
"""


def busy(work, **streams):
    """Start a process that watches signals and then works in one call for minutes."""
    command = [sys.executable, "-c", _WATCHING + work]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, **streams)
    assert process.stdout.readline() == "busy\n"
    return process


def test_the_second_signal_ends_what_never_looks():
    """As in a compiler: no Python runs in the main thread."""
    process = busy("import hashlib; hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)", stderr=subprocess.PIPE)
    process.send_signal(signal.SIGINT)
    assert "a second signal ends it at once" in process.stderr.readline()
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "mjx-climb: interrupted at once: what was finished is kept; the same command goes on from there\n"


def test_the_first_signal_ends_what_would_keep_nothing():
    """As a log of many columns that is read, or a compiled walk: Python may run, and looks for no signal."""
    work = "with interruption.at_once():\n    import time\n    print(end='in it\\n', flush=True)\n    time.sleep(60)"
    process = busy(work, stderr=subprocess.PIPE)
    assert process.stdout.readline() == "in it\n"
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (
        130,
        "mjx-climb: interrupted: nothing was kept; the same command starts again\n",
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("tuning.proposal.propose", ["robot", interrupts.ROBOT]),
        ("rosbags.highlevel", ["identify", interrupts.CASE, "--log", "{log}", "--fit", "control.kp"]),
    ],
)
def test_the_first_signal_ends_a_robot_s_first_walks_and_the_reading_of_a_log(module, command, tmp_path):
    """As a file of 100 limbs, or a log of 100,000 columns, takes minutes: here an import takes 5 s."""
    (log := tmp_path / "log.mcap").write_text("no bag")
    done = interrupted_in(module, tmp_path, [part.format(log=log) for part in command], then="time.sleep(5)")
    assert (done.returncode, done.stdout) == (130, ""), done.stderr
    assert done.stderr == "mjx-climb: interrupted: nothing was kept; the same command starts again\n"


@pytest.mark.skipif(sys.platform != "linux", reason="asks glibc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_second_signal_ends_what_lets_no_python_run(number):
    """As in a library that hangs: no Python runs in any thread."""
    process = busy("import itertools; sum(itertools.repeat(0))")
    time.sleep(0.5)  # until it is within the call that lets no Python run
    process.send_signal(number)
    status = Path(f"/proc/{process.pid}/status")
    while int(re.search(r"ShdPnd:\s*(\w+)", status.read_text())[1], 16):
        pass  # not delivered yet
    process.send_signal(number)
    try:
        assert process.wait(timeout=60) == -number
    finally:
        process.kill()
        process.stdout.close()


@pytest.mark.parametrize("asked", [True, False])
def test_what_is_kept_is_said_where_another_process_was_stopped_first(asked, monkeypatch, tmp_path):
    monkeypatch.setattr(interruption, "requested", lambda: asked)
    expected = (interruption.Interrupted, "4 walks are kept") if asked else (LostProcess, "gone")
    shell = Session(sys.stdout)
    with pytest.raises(expected[0], match=expected[1]), shell.keeping("walks", tmp_path, done=4):
        raise LostProcess("gone")


@pytest.mark.parametrize(("rounds", "said"), [((3, 1), "^4 rounds are kept in "), ((1,), "^1 round is kept in ")])
def test_the_rounds_of_all_searches_of_a_command_are_kept(rounds, said, tmp_path):
    shell = Session(sys.stdout)
    with pytest.raises(interruption.Interrupted, match=said), shell.keeping("rounds", tmp_path):
        for done in rounds:
            with shell.stage("search", unit="rounds", keeps=True) as show:
                show(done, 3)
        raise KeyboardInterrupt


def test_of_walks_that_are_one_of_many_the_count_is_said(tmp_path):
    shell = Session(sys.stdout)
    with pytest.raises(interruption.Interrupted, match=r"^1 of 6 walks are kept in "):
        with shell.keeping("of 6 walks", tmp_path, done=1):
            raise KeyboardInterrupt


def test_what_an_interrupted_command_kept_cannot_control_the_terminal(call, monkeypatch, tmp_path):
    def stop(*_, **__):
        raise interruption.Interrupted("3 rounds are kept in \x1b[31m")

    monkeypatch.setattr(mc, "rollout", stop)
    code, _, err = call(*RUN, "--out", tmp_path)
    assert code == 130 and err.splitlines()[-1] == r"mjx-climb: interrupted: 3 rounds are kept in \x1b[31m"


def test_a_command_that_came_to_its_end_says_so(monkeypatch, call, tmp_path):
    monkeypatch.setattr(dataset, "write_text_atomically", lambda *_: signal.raise_signal(signal.SIGINT))
    code, _, err = call("doctor", "--schema", "--out", tmp_path / "schema.json")
    assert code == 130 and "all that it writes is written" in err.splitlines()[-1]


@pytest.mark.nightly
@pytest.mark.parametrize(
    "command", ["schema", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("export", "run"))]
)  # the others take minutes: the script has them
def test_signals_at_random_instants(command, tmp_path):
    """Four of the two hundred that `python -m tests.interrupts` tries."""
    given, rng = {"gains": tmp_path / "gains.yaml"}, np.random.default_rng()
    given["gains"].write_text(interrupts.GAINS)
    length = interrupts.undisturbed(command, given, tmp_path)
    tries = interrupts.attempts(command, rng.uniform(0, length, 4), rng, given, tmp_path)
    assert not [attempt for attempt in tries if attempt.kind not in interrupts.FINE], tries


@pytest.mark.parametrize("terminal", [1, 2])
def test_the_cursor_comes_back_where_standard_error_is_a_terminal(terminal, monkeypatch):
    written = []
    monkeypatch.setattr("os.isatty", lambda stream: stream == terminal)
    monkeypatch.setattr("os.write", lambda stream, text: written.append((stream, text)))
    interruption._say(b"ends")
    assert written == [(2, (b"\x1b[?25h" if terminal == 2 else b"") + b"mjx-climb: ends\n")]
