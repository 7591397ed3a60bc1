"""Programs kept on disk: found by the next process, the same bits; never a wrong one, never a broken one."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mjx_climb.compilation import cache, kept_programs, probe
from tuning.command_line import diagnosis

ROOT = Path(__file__).parents[2]
AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="gives a file to another user")
# a program small enough to be compiled often; `identity` and `answer` differ from process to process
WALK = """
import sys
import jax
import numpy as np
from mjx_climb.compilation.kept_programs import kept
from mjx_climb.compilation.cache import enable_cache

identity, answer, shape, double = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "double"
options = {"xla_backend_optimization_level": int(sys.argv[5])}
traced = []

def function(structure, values):
    traced.append(structure)
    with jax.ensure_compile_time_eval():  # a small program that runs while this one is traced
        answered = jax.numpy.cos(jax.numpy.zeros(3)).max() * answer
    return {"sum": jax.numpy.sin(values).sum() * answered, "all": values + structure}

enable_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # as if the machine were slow
program = kept(function, lambda structure, *trees: identity or None, options)
with jax.enable_x64(double):
    made = program(3.0, np.arange(shape, dtype=float if double else np.float32))
    print(len(traced), *(np.asarray(value).tobytes().hex() for value in made.values()))
"""


@pytest.fixture
def walk(tmp_path, monkeypatch):
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))

    def run(identity="a", answer="1.0", shape="4", double="single", level="1", umask=0o022):
        command = [sys.executable, "-c", WALK, identity, answer, shape, double, level]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, umask=umask)
        assert done.returncode == 0, done.stderr
        traced, *values = done.stdout.split()
        return int(traced), values

    return run


def test_the_next_process_neither_traces_nor_gets_another_program(walk):
    """The same bits; another identity, shape, precision or option: another program; none kept without an identity."""
    first = walk()
    assert first[0] == 1
    assert walk(answer="9.0") == (0, first[1])  # the kept one, by its identity
    for change in ({"identity": "b"}, {"shape": "5"}, {"double": "double"}, {"level": "0"}, {"identity": ""}):
        traced, values = walk(**change)
        assert traced == 1
        assert (values == first[1]) == (change.keys() <= {"identity", "level"})
    assert walk(identity="")[0] == 1


def test_a_program_is_kept_though_small_ones_in_it_come_from_xlas_cache(walk):
    """As after an update: XLA's cache is full, and no program is kept yet."""
    walk()
    first = walk(identity="after an update")
    assert first[0] == 1
    assert walk(identity="after an update") == (0, first[1])


@pytest.mark.parametrize(
    "damage", [lambda content: content[:-20], lambda content: content[:200] + b"x" + content[201:]]
)
def test_a_damaged_file_is_made_anew(walk, tmp_path, damage):
    _, values = walk()
    [file] = (tmp_path / "programs").iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert walk() == (1, values)


def test_a_program_from_xlas_cache_is_not_written_down(walk, tmp_path):
    """It would lack parts: a lost file is made again without it, and the results stay."""
    _, values = walk()
    [file] = (tmp_path / "programs").iterdir()
    file.unlink()
    assert walk()[1] == values
    assert walk()[1] == values


def test_a_program_that_does_not_run_is_made_anew(walk, tmp_path):
    """A whole file that holds another function's program, of other arguments."""
    _, values = walk()
    [right] = (tmp_path / "programs").iterdir()
    walk(shape="5")
    [wrong] = set((tmp_path / "programs").iterdir()) - {right}
    right.write_bytes(wrong.read_bytes())
    assert walk() == (1, values)


def test_a_cache_that_the_user_chose_in_jax_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path / "ours"))
    with cache.cache_in(str(tmp_path / "own")):
        cache.enable_cache()
        assert cache.cache_in_use() == str(tmp_path / "own")


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """A cache with an entry of XLA's and a folder of programs, as others may look into it but not write."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    cache.forget()
    (tmp_path / "programs").mkdir(mode=0o755)
    (tmp_path / "xla-cache").touch(mode=0o644)
    tmp_path.chmod(0o755)
    yield tmp_path
    cache.forget()


CHANGES = [
    lambda place: place.chmod(0o777),
    lambda place: place.chmod(0o775),
    pytest.param(lambda place: os.chown(place, 65534, 65534), marks=AS_ROOT),
]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("what", [".", "programs", "xla-cache"])
def test_a_folder_in_which_another_user_may_have_put_a_program_is_not_used(folder, what, change, monkeypatch):
    """What lies there is executed, XLA's own entries too; it is said once."""
    assert cache.cache_folder() == folder and cache.doubt() is None
    cache.forget()
    change(folder / what)
    with pytest.warns(UserWarning, match=f"cache is off: {folder / what} is not this user's own, or others") as said:
        assert (cache.cache_folder(), cache.cache_folder()) == (None, None)
    assert len(said) == 1
    monkeypatch.setattr(cache, "cache_in_use", lambda: None)  # the tests' own is
    assert diagnosis.cache().findings == (cache.doubt(),)


def test_a_program_that_another_user_may_have_written_is_not_executed(walk, tmp_path):
    _, values = walk()
    [file] = (tmp_path / "programs").iterdir()
    file.chmod(0o666)
    assert walk() == (1, values)


def test_a_folder_that_is_made_here_lets_nobody_else_in(walk, tmp_path, monkeypatch):
    """Whatever the user's umask."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path / "cache"))
    _, values = walk(umask=0)
    assert (tmp_path / "cache").stat().st_mode & 0o777 == 0o700
    assert walk(umask=0) == (0, values)


def test_a_full_disk_leaves_no_litter(tmp_path, monkeypatch):
    """Neither of a program nor of a verdict on a fast path."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_programs, "_file", lambda *_: tmp_path / "programs" / "program")
    monkeypatch.setattr(os, "replace", full)
    program = kept_programs.kept(lambda structure, values: values + structure, lambda *_: "a", {})
    assert program(1.0, np.zeros(2)).tolist() == [1.0, 1.0]
    probe._keep(probe.Verdict(True, "tried"), tmp_path / "probes" / "verdict")
    assert [path.name for path in tmp_path.rglob("*")] == ["programs", "probes"]
