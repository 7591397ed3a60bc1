"""Executables on disk: found by the next process, the same bits; never a wrong one, never a broken one."""

import collections
import contextlib
import os
import runpy
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from mjx_climb import execution
from mjx_climb.control import PD
from mjx_climb.execution import batches, cache, paths
from mjx_climb.execution.elements import Unsupported
from mjx_climb.physics.contact.polyhedron import PolyhedralGripper, magnet
from tuning.command_line import machine

ROOT = Path(__file__).parents[2]
AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="gives a file to another user")
# small enough to be compiled often; `identity` and `answer` differ from process to process
PROGRAM = """
import sys
import jax
import numpy as np
from mjx_climb.execution.cache import cached_jit, enable_cache

identity, answer, shape, double = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "double"
options = {"xla_backend_optimization_level": int(sys.argv[5])}
traced = []

def function(structure, values):
    traced.append(structure)
    with jax.ensure_compile_time_eval():  # a small program that runs while this one is traced
        answered = jax.numpy.cos(jax.numpy.zeros(3)).max() * answer
    by_library = jax.numpy.linalg.cholesky(jax.numpy.diag(values**2 + 1))  # a stored executable has to find it
    return {"sum": jax.numpy.sin(values).sum() * answered, "all": values + structure, "by library": by_library}

enable_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # as if the machine were slow
program = cached_jit(function, lambda structure, *trees: identity or None, options)
with jax.enable_x64(double):
    made = program(3.0, np.arange(shape, dtype=float if double else np.float32))
    print(len(traced), *(np.asarray(value).tobytes().hex() for value in made.values()))
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Give what a process of its own returns: how often it traced, and the bits of the results."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))

    def process(identity="a", answer="1.0", shape="4", double="single", level="1", umask=0o022):
        command = [sys.executable, "-c", PROGRAM, identity, answer, shape, double, level]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, umask=umask)
        assert done.returncode == 0, done.stderr
        traced, *values = done.stdout.split()
        return int(traced), values

    return process


@pytest.mark.nightly
def test_the_next_process_neither_traces_nor_gets_another_executable(run):
    """The same bits; another identity, shape, precision or option: another one; none stored without an identity."""
    first = run()
    assert first[0] == 1
    assert run(answer="9.0") == (0, first[1])  # the stored one, by its identity
    for change in ({"identity": "b"}, {"shape": "5"}, {"double": "double"}, {"level": "0"}, {"identity": ""}):
        traced, values = run(**change)
        assert traced == 1
        assert (values == first[1]) == (change.keys() <= {"identity", "level"})
    assert run(identity="")[0] == 1


@pytest.mark.slow
def test_what_is_stored_here_is_not_stored_by_xla_as_well(run, tmp_path):
    """There it has a name that nothing asks for again: a copy that stays for nothing."""
    run()
    assert len([*(tmp_path / "programs").iterdir()]) == 1
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith("jit_function_")]


def test_files_of_writers_that_were_killed_are_removed_once_nobody_can_write_them(tmp_path):
    for name, age in ((".one.abcdefgh", 1e5), (".two.abcdefgh", 0.0), ("three", 1e5)):
        (tmp_path / name).write_text("half")
        os.utime(tmp_path / name, 2 * (time.time() - age,))
    cache.write_whole(tmp_path / "one", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {"one", ".two.abcdefgh", "three"}


@pytest.mark.nightly
def test_what_xlas_cache_holds_is_made_and_stored_again(run, tmp_path):
    """After an update, or where a file was lost: what XLA's cache returns could not be stored."""
    _, values = run()
    for identity in ("a", "after an update"):
        for file in (tmp_path / "programs").iterdir():
            file.unlink()
        assert run(identity=identity) == (1, values)
        assert run(identity=identity) == (0, values)


def moved_from_another(file, run):
    run(shape="5")
    [other] = set(file.parent.iterdir()) - {file}
    file.write_bytes(other.read_bytes())


DAMAGE = {
    "cut off": lambda file, _: file.write_bytes(file.read_bytes()[:-20]),
    "changed": lambda file, _: file.write_bytes((content := file.read_bytes())[:200] + b"x" + content[201:]),
    "another function's": moved_from_another,
    "written by others": lambda file, _: file.chmod(0o666),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage", [pytest.param(d, id=n, marks=[pytest.mark.nightly] * (n != "cut off")) for n, d in DAMAGE.items()]
)
def test_a_file_that_is_not_what_was_written_is_not_executed(run, tmp_path, damage):
    _, values = run()
    [file] = (tmp_path / "programs").iterdir()
    damage(file, run)
    assert run() == (1, values)


FILES = {
    "as written": (lambda file: None, b"content"),
    "moved": (lambda file: file.with_name("another").rename(file), None),
    "cut off": (lambda file: file.write_bytes(file.read_bytes()[:-1]), None),
    "longer": (lambda file: file.write_bytes(file.read_bytes() + b"\n"), None),
    "one line": (lambda file: file.write_bytes(b"content"), None),
    "not there": (lambda file: file.unlink(), None),
    "a folder": (lambda file: file.unlink() or file.mkdir(), None),
    "written by its group": (lambda file: file.chmod(0o620), None),
    "written by others": (lambda file: file.chmod(0o602), None),
    "read by others": (lambda file: file.chmod(0o644), b"content"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_read_whole_under_its_own_name_or_not_at_all(tmp_path, name):
    change, expected = FILES[name]
    for file in ("file", "another"):
        cache.store_whole(tmp_path / "folder" / file, b"content" if file == "file" else b"others")
    change(tmp_path / "folder" / "file")
    assert cache.read_whole(tmp_path / "folder" / "file") == expected


class Placed:
    """An array that lies on a device."""

    def __init__(self, device):
        self.device = device

    def devices(self):
        return {self.device}


@pytest.mark.parametrize(
    ("arrays", "default", "expected"),
    [([], None, 0), ([], "cpu", 0), ([2], None, 2), ([2, 2], "cpu", 2), ([], "given", 1), ([2], "given", 2)],
)
def test_an_executable_is_loaded_where_its_arguments_are(tmp_path, monkeypatch, arrays, default, expected):
    """Or else on the device that JAX takes where none is said; what is loaded ahead is taken there alone."""
    [device], others = jax.devices(), {2: object()}
    monkeypatch.setattr(jax, "Array", Placed)
    monkeypatch.setattr(cache, "executable_of", lambda *given: given)
    monkeypatch.setattr(cache, "settings", lambda: {"jax_default_device": device if default == "given" else default})
    cache.store_whole(tmp_path / "one", b"content")
    trees = {"placed": [Placed(others[place]) for place in arrays]}, np.zeros(2)
    there = others.get(expected, device)
    assert cache.loaded(tmp_path / "one", trees) == (b"content", there)
    ahead = {place: cache.Future() for place in (there, object())}
    for future in ahead.values():
        future.set_result("ahead")
    monkeypatch.setattr(cache, "ahead_of_use", {(tmp_path / "one", place): each for place, each in ahead.items()})
    assert [cache.loaded(tmp_path / "one", trees) for _ in range(2)] == ["ahead", (b"content", there)]
    assert len(cache.ahead_of_use) == 1
    assert cache.loaded(tmp_path / "none", trees) is None


def test_an_executable_counts_as_found_once_it_is_loaded(tmp_path, monkeypatch):
    """Who compiles it after all must not be told that nothing was compiled."""
    found = []
    monkeypatch.setattr(cache.monitoring, "record_event", found.append)
    monkeypatch.setattr(cache, "executable_of", lambda content, _: {b"whole": "executable"}[content])
    for name in ("whole", "torn"):
        cache.store_whole(tmp_path / name, name.encode())
    with pytest.warns(UserWarning, match="cannot be loaded"):
        assert cache.loaded(tmp_path / "torn", ()) is None
    assert not found
    assert cache.loaded(tmp_path / "whole", ()) == "executable" and found == ["/jax/compilation_cache/cache_hits"]


def test_another_function_identity_argument_or_option_has_another_file(tmp_path, monkeypatch):
    """Whatever the order of the options; none where there is no folder, or several processes compute together."""
    real = runpy.run_path(cache.__file__)["executable_file"]  # the tests' own stores none
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    given = _repeated, "known", ("tree", (3,)), {"level": 1, "width": 2}
    others = [(_summed, *given[1:]), (given[0], "other", *given[2:]), (*given[:2], ("tree", (4,)), given[3]),
              (*given[:3], {"level": 2, "width": 2}), (*given[:3], {"level": 1})]  # fmt: skip
    files = [real(*each) for each in (given, (*given[:3], {"width": 2, "level": 1}), *others)]
    assert files[0] == files[1] and len({*files}) == 1 + len(others)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert real(*given) is None
    monkeypatch.setattr(jax, "process_count", lambda: 1)
    monkeypatch.setenv("MJX_CLIMB_CACHE", "off")
    assert real(*given) is None


def test_a_digest_of_sources_is_of_code_and_models_under_their_names(tmp_path):
    def digest():
        cache.source_digest.cache_clear()
        return cache.source_digest(tmp_path)

    (tmp_path / "inner").mkdir()
    found = [digest()]
    for name, text in (("a.py", "1"), ("inner/b.xml", "1"), ("inner/b.xml", "2"), ("a.py", "2")):
        (tmp_path / name).write_text(text)
        found.append(digest())
    (tmp_path / "a.py").rename(tmp_path / "c.py")
    found.append(digest())
    assert len({*found}) == len(found)
    (tmp_path / "notes.txt").write_text("of no effect")
    assert digest() == found[-1]


@pytest.mark.parametrize("name", ["jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "python", "machine", "processor"])
def test_a_machine_is_known_by_its_versions(monkeypatch, name):
    before, version = cache.machine.__wrapped__(), cache.version
    platform = {"python": "python_version", "machine": "machine", "processor": "processor"}
    if name in platform:
        monkeypatch.setattr(cache.platform, platform[name], lambda: "another")
    else:
        monkeypatch.setattr(cache, "version", lambda of: "0" if of == name else version(of))
    assert cache.machine.__wrapped__() != before


def test_executables_of_the_last_occasion_are_loaded_before_they_are_asked_for(tmp_path, monkeypatch):
    """By another thread; what another occasion asked for is not."""
    loaders, executable = [], cache.executable_of
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))

    def loaded(*given):
        loaders.append(threading.current_thread().name)
        return executable(*given)

    monkeypatch.setattr(cache, "executable_of", loaded)
    monkeypatch.setattr(cache, "executable_file", batches.executable_file)  # which no other test has

    def asked(occasion):
        program = cache.cached_jit(_repeated, lambda *_: "a", {})
        with cache.loading_ahead(occasion):
            while occasion == "first" and (tmp_path / "occasions").exists() and not cache.ahead_of_use:
                time.sleep(0.01)
            return np.asarray(program(2, np.arange(3.0))["all"])

    made = [asked("first") for _ in range(2)] + [asked("second")]
    assert [name.startswith("loader") for name in loaders] == [True, False]
    for each in made:
        np.testing.assert_array_equal(each, [[0.0, 1.0, 2.0]] * 2)


def test_shapes_are_traced_once_for_all_processes(tmp_path, monkeypatch):
    """And again where the file that holds them is damaged, or the structure is another."""
    traced, eval_shape = [], jax.eval_shape
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    monkeypatch.setattr(jax, "eval_shape", lambda *trees: traced.append(trees) or eval_shape(*trees))

    def shapes(times=2):
        batches._shapes_of.cache_clear()  # as in the next process
        return execution.shapes_of(_repeated, times, jax.ShapeDtypeStruct((3,), np.dtype(float)))

    with cache.cache_in(str(tmp_path)):
        assert [shapes(), shapes()] == 2 * [{"all": (2, 3), "sum": ()}] and len(traced) == 1
        [file] = (tmp_path / "programs").iterdir()
        file.write_bytes(file.read_bytes().replace(b"[2, 3]", b"[2, 4]"))
        assert shapes()["all"] == (2, 3) and len(traced) == 2
        assert shapes(times=5)["all"] == (5, 3) and len(traced) == 3


def _repeated(times, values):
    return {"all": jax.numpy.stack(times * [values]), "sum": values.sum()}


def test_a_cache_that_the_user_chose_in_jax_stays_and_executables_are_kept_beside_it(tmp_path, monkeypatch):
    """As with JAX_COMPILATION_CACHE_DIR in the environment: in a folder that lets nobody else in."""
    real = runpy.run_path(cache.__file__)["executable_file"]  # the tests' own stores none
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path / "ours"))
    with cache.cache_in(str(tmp_path / "own")):
        cache.enable_cache()
        assert cache.cache_in_use() == str(tmp_path / "own")
        assert (tmp_path / "ours").stat().st_mode & 0o777 == 0o700
        assert real(_repeated, "known", (), {}).parent == tmp_path / "ours" / "programs"


def test_the_cache_of_jax_is_set_where_nobody_else_has_set_one(tmp_path, monkeypatch):
    """What compiles in less than half a second is not kept there."""
    done = []
    monkeypatch.setattr(jax.config, "update", lambda *given: done.append(given))
    for wish, there, expected in (
        ("off", None, []), (str(tmp_path), "/of/the/user", []),
        (str(tmp_path), None, [("jax_compilation_cache_dir", str(tmp_path)),
                               ("jax_persistent_cache_min_compile_time_secs", 0.5)]),
    ):  # fmt: skip
        done.clear()
        monkeypatch.setenv("MJX_CLIMB_CACHE", wish)
        monkeypatch.setattr(cache, "settings", lambda there=there: {"jax_compilation_cache_dir": there})
        cache.enable_cache()
        assert done == expected
        assert cache.cache_in_use() == (there if there or wish == "off" else str(tmp_path))


def test_without_a_cache_nothing_is_loaded_ahead(monkeypatch):
    monkeypatch.setenv("MJX_CLIMB_CACHE", "off")
    with cache.loading_ahead("an occasion"):
        assert not cache.ahead_of_use


def test_within_another_program_no_executable_is_asked_for(monkeypatch):
    """It is traced with the other one."""
    monkeypatch.setattr(cache, "executable_file", lambda *_: {}["nothing"])
    program = cache.cached_jit(lambda structure, values: values * structure, lambda *_: "a", {})
    assert jax.jit(lambda x: program(3.0, x) + 1)(2.0) == 7.0


@pytest.fixture
def one(tmp_path, monkeypatch):
    """Give the file of every executable."""
    monkeypatch.setattr(cache, "executable_file", lambda *_: tmp_path / "one")
    return tmp_path / "one"


def test_a_program_that_a_fast_path_refused_is_not_traced_by_the_next_process(one):
    traced = []

    def refuses(structure, values):
        traced.append(structure)
        raise Unsupported("sorts by length")

    for _ in range(2):
        with pytest.raises(NotImplementedError, match=r"^sorts by length"):
            cache.cached_jit(refuses, lambda *_: "a", {})(1.0, np.zeros(2))
    assert len(traced) == 1


def test_a_program_of_a_class_of_a_users_file_is_kept(one):
    """As a law of `--law FILE.py:NAME`: no other process imports its module by a name."""
    traced, kind = [], collections.namedtuple("Mine", "gain", module="of_a_file")

    def scaled(structure, law):
        traced.append(structure)
        return {"twice": structure * law.gain}

    for _ in range(2):
        program = cache.cached_jit(scaled, lambda *_: "a", {})
        assert program(2.0, kind(np.ones(2)))["twice"].tolist() == [2.0, 2.0]
    assert len(traced) == 1


def test_a_program_that_each_process_makes_again_is_told(one, monkeypatch):
    """One that JAX cannot load, or cannot keep."""

    def walked():
        return cache.cached_jit(lambda structure, values: values + structure, lambda *_: "a", {})(1.0, np.zeros(2))

    cache.store_whole(one, b"of another format")
    with pytest.warns(UserWarning, match="a compiled program cannot be loaded .*: every start waits for it"):
        assert walked().tolist() == [1.0, 1.0]
    one.unlink()
    for error, said in ((KeyError("callbacks"), "KeyError: 'callbacks'"), (ValueError(), "ValueError: "),
                        (ValueError(300 * "x" + "\nand more"), "ValueError: " + 200 * "x")):  # fmt: skip

        def fails(_, error=error):
            raise error

        monkeypatch.setattr(cache.serialize_executable, "serialize", fails)
        with pytest.warns(UserWarning, match=rf"a compiled program cannot be kept \({said}\): every start waits"):
            assert walked().tolist() == [1.0, 1.0]


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """A cache with an entry of XLA's and a folder of executables, as others may look into it but not write."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    (tmp_path / "programs").mkdir(mode=0o755)
    (tmp_path / "xla-cache").touch(mode=0o644)
    tmp_path.chmod(0o755)
    yield tmp_path
    cache.doubt.cache_clear()


CHANGES = [
    lambda path: path.chmod(0o777),
    lambda path: path.chmod(0o775),
    pytest.param(lambda path: os.chown(path, 65534, 65534), marks=AS_ROOT),
]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("what", [".", "programs", "xla-cache"])
def test_a_folder_in_which_another_user_may_have_put_a_file_is_not_used(folder, what, change, monkeypatch):
    """What lies there is executed, XLA's own entries too; the warning comes once."""
    assert cache.cache_folder() == folder and cache.doubt(folder) is None
    cache.doubt.cache_clear()
    change(folder / what)
    with pytest.warns(UserWarning, match=f"cache is off: {folder / what} is not this user's own, or others") as warned:
        assert (cache.cache_folder(), cache.cache_folder()) == (None, None)
    assert len(warned) == 1
    monkeypatch.setattr(cache, "cache_in_use", lambda: None)  # the tests' own is
    assert next(machine.cache()).findings == [cache.doubt(folder)]


def test_where_nobody_else_comes_in_it_does_not_matter_who_may_write(folder):
    (folder / "programs").chmod(0o777)
    for mode, trusted in ((0o700, True), (0o710, False), (0o701, False), (0o500, True)):
        folder.chmod(mode)
        cache.doubt.cache_clear()
        with contextlib.nullcontext() if trusted else pytest.warns(UserWarning, match="cache is off"):
            assert (cache.doubt(folder) is None) == trusted
    folder.chmod(0o700)


@pytest.mark.nightly
def test_a_folder_that_is_made_here_lets_nobody_else_in(run, tmp_path, monkeypatch):
    """Whatever the user's umask."""
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path / "cache"))
    _, values = run(umask=0)
    assert (tmp_path / "cache").stat().st_mode & 0o777 == 0o700
    assert run(umask=0) == (0, values)


def test_an_executable_is_found_under_the_settings_of_jax_that_it_was_compiled_under_alone(monkeypatch):
    files, real = [], runpy.run_path(cache.__file__)["executable_file"]  # the tests' own stores none
    monkeypatch.setattr(cache, "executable_file", real)
    monkeypatch.setattr(cache, "loaded", lambda file, _: files.append(file) or (lambda *trees: trees))

    def call(precision):
        with jax.default_matmul_precision(precision):
            cache.cached_jit(lambda structure, values: values, lambda *_: "a", {})(1.0, np.zeros(2))

    for precision in ("highest", "highest", "bfloat16"):
        call(precision)
    assert files[0] == files[1] != files[2]


@pytest.mark.parametrize(
    ("file", "old", "new", "same"),
    [
        ("viz/__init__.py", "", "# a comment", True),
        ("files/dataset.py", "import", "# a comment\nimport", True),
        ("control/virtual_mass.py", "2e-3", "3e-3", False),
        ("control/__init__.py", "LAWS", "_LAWS", False),
        ("control/internal_force.py", "def step", "def _step", False),  # imported with all of its folder
        ("gait/swing.py", "(3 - 2 * phase)", "(3 - 2.1 * phase)", False),
    ],
)
def test_a_walks_program_is_found_by_the_files_that_take_part_in_it(tmp_path, file, old, new, same):
    """Those that the walk's module imports, and that these import."""
    package = tmp_path / "mjx_climb"
    shutil.copytree(ROOT / "mjx_climb", package, ignore=shutil.ignore_patterns("__pycache__"))

    def digest():
        cache.digest_of_imports.cache_clear()
        cache.sources.cache_clear()
        return cache.digest_of_imports(frozenset(["mjx_climb.walks"]), (package,))

    before, text = digest(), (package / file).read_text()
    assert old in text
    (package / file).write_text(text.replace(old, new, 1))
    assert (digest() == before) == same


def test_a_program_is_found_by_the_files_of_the_components_that_walk(monkeypatch):
    """A kind is imported by its name, so that no module of a walk imports it."""
    asked = set()
    monkeypatch.setattr(batches, "code_digest", lambda modules: asked.update(modules) or "")
    tree = {"contact": PolyhedralGripper(**magnet(20.0, 0.4)), "law": [PD()]}
    batches.run_one(_summed, "of components", jax.tree.map(np.asarray, tree))
    assert {"mjx_climb.physics.contact.polyhedron", "mjx_climb.control.law"} <= asked


def _summed(structure, tree):
    return {"sum": sum(leaf.sum() for leaf in jax.tree.leaves(tree))}


@pytest.mark.parametrize("variable", ["XLA_FLAGS", "LIBTPU_INIT_ARGS"])
def test_flags_of_xla_are_part_of_what_an_entry_depends_on(variable, monkeypatch):
    before = cache.machine.__wrapped__()
    monkeypatch.setenv(variable, "--xla_cpu_enable_fast_math=true")
    assert cache.machine.__wrapped__() != before


def test_a_full_disk_leaves_no_litter(tmp_path, monkeypatch):
    """Neither of an executable nor of a verdict on a fast path."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache, "executable_file", lambda *_: tmp_path / "programs" / "one")
    monkeypatch.setattr(os, "replace", full)
    program = cache.cached_jit(lambda structure, values: values + structure, lambda *_: "a", {})
    with cache.cache_in(str(tmp_path)):
        assert program(1.0, np.zeros(2)).tolist() == [1.0, 1.0]
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    monkeypatch.setattr(paths, "tried", lambda path: (paths.Verdict(True, "tried"), True))
    assert paths.verdict.__wrapped__("regions").works
    for folder in ("programs", "probes"):  # XLA writes its own beside
        assert list((tmp_path / folder).iterdir()) == []


def test_the_cache_is_in_the_users_folder_or_where_the_environment_says(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(cache.platformdirs, "user_cache_dir", lambda *of, **how: asked.append((of, how)) or "/of/user")
    for wish, expected in (("", Path("/of/user/xla")), (str(tmp_path), tmp_path)):
        monkeypatch.setenv(cache.VARIABLE, wish)
        assert cache.asked_folder() == expected
    monkeypatch.delenv(cache.VARIABLE)
    assert cache.asked_folder() == Path("/of/user/xla")
    assert asked == [(("mjx_climb",), {"appauthor": False})] * 2


@pytest.mark.parametrize("word", ["off", "OFF", "0", "No", "False", "none"])
def test_the_cache_is_switched_off_in_words(monkeypatch, word):
    monkeypatch.setenv(cache.VARIABLE, word)
    assert cache.asked_folder() is None
    monkeypatch.setenv(cache.VARIABLE, f"{word}/there")
    assert cache.asked_folder() == Path(f"{word}/there")
