"""What tells users' functions and objects apart: contents, not names."""

import collections
import dataclasses
import functools
import importlib
import json
import subprocess
import sys
import threading
import types
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.execution.contents import Unidentifiable, identity, in_library
from mjx_climb.execution.refused import Refused

SCALE = 2.0


def closed_over(weight):
    return lambda metrics: weight * metrics["travel"]


def weighted(metrics, weight=1.0):
    return weight * metrics["travel"]


def helper(value):
    return value * SCALE


def through_a_helper(metrics):
    return helper(metrics["travel"])


def through_a_comprehension(metrics):
    return sum(SCALE * metrics[name] for name in ("travel",))


def calls_itself(depth):
    return 0 if depth == 0 else calls_itself(depth - 1) + SCALE


@dataclasses.dataclass(frozen=True)
class Weighted:
    weight: float = 1.0

    def __call__(self, metrics):
        return self.weight * helper(metrics["travel"])


class Slotted:
    __slots__ = ("weight",)

    def __init__(self, weight):
        self.weight = weight

    def score(self, metrics):
        return self.weight * metrics["travel"]


class Pair(NamedTuple):
    first: float
    second: object


class OwnList(list):
    """A list by another name."""


class Marked(dict):
    """A mapping by another name."""


def marked(weight):
    def function(metrics):
        return metrics["travel"]

    function.weight = weight
    return function


def guarded(*caught):
    """Return two functions that differ in what their `try` holds alone."""

    def inside(metrics):
        try:
            metrics = metrics["travel"]
        except caught:
            pass
        return metrics

    table = inside.__code__.co_exceptiontable
    other = inside.__code__.replace(co_exceptiontable=bytes([*table[:1], table[1] ^ 1, *table[2:]]))
    return inside, types.FunctionType(other, globals(), closure=inside.__closure__)


def posing(module, name):
    """Return a function that says it is a library's."""

    def function(metrics):
        return metrics["travel"]

    function.__module__, function.__qualname__ = module, name
    return function


def classes(**bodies):
    """Return two classes of one name, each with one member."""
    return tuple(type("Law", (), {name: member}) for name, members in bodies.items() for member in members)


STEPS = (lambda self, x: x, lambda self, x: 2 * x)
DIFFER = {
    "closure": (closed_over(1.0), closed_over(100.0)),
    "closure over arrays": (closed_over(np.ones(3)), closed_over(np.array([1.0, 1.0, 1.0 + 1e-15]))),
    "closure over arrays of jax": (closed_over(jnp.ones(3)), closed_over(jnp.zeros(3))),
    "closure over functions": (closed_over(closed_over(1.0)), closed_over(closed_over(2.0))),
    "partial": (functools.partial(weighted, weight=1.0), functools.partial(weighted, weight=100.0)),
    "partial of another": (functools.partial(weighted, weight=1.0), functools.partial(helper, weight=1.0)),
    "default": (weighted, types.FunctionType(weighted.__code__, globals(), argdefs=(3.0,))),
    "default of a keyword": (lambda m, *, weight=1: weight * m, lambda m, *, weight=2: weight * m),
    "constants": (lambda m: 1.0 * m["travel"], lambda m: 2.0 * m["travel"]),
    "type of a constant": (lambda m: m["travel"] ** 2, lambda m: m["travel"] ** 2.0),
    "operations": (lambda m: m["travel"] + 1.0, lambda m: m["travel"] - 1.0),
    "names": (lambda m: jnp.sin(m["travel"]), lambda m: jnp.cos(m["travel"])),
    "inner functions": (lambda m: lambda: 1.0, lambda m: lambda: 2.0),
    "fields": (Weighted(1.0), Weighted(2.0)),
    "slots": (Slotted(1.0), Slotted(2.0)),
    "method of another instance": (Slotted(1.0).score, Slotted(2.0).score),
    "named tuple": (Pair(1.0, 2), Pair(1.0, 3)),
    "methods": classes(step=STEPS),
    "special methods": classes(__call__=STEPS),
    "compiled special methods": classes(__call__=map(jax.jit, STEPS)),
    "static methods": classes(step=map(staticmethod, STEPS)),
    "class methods": classes(step=map(classmethod, STEPS)),
    "properties": classes(step=map(property, STEPS)),
    "attributes of classes": classes(weight=(1.0, 2.0)),
    "instances of classes": [kind() for kind in classes(step=STEPS)],
    "jit": (jax.jit(closed_over(1.0)), jax.jit(closed_over(2.0))),
    "vmap": (jax.vmap(closed_over(1.0)), jax.vmap(closed_over(2.0))),
    "axes of vmap": (jax.vmap(weighted, in_axes=0), jax.vmap(weighted, in_axes=1)),
    "cache": (functools.cache(closed_over(1.0)), functools.cache(closed_over(2.0))),
    "keys": ({"a": 1.0}, {"b": 1.0}),
    "sets": ({1.0, 2.0}, {1.0, 3.0}),
    "kinds of sets": ({1.0}, frozenset({1.0})),
    "kinds of lists": ([1.0], (1.0,)),
    "lists of one's own": (OwnList([1.0]), [1.0]),
    "named tuple and tuple": (Pair(1.0, 2), (1.0, 2)),
    "sign of zero": (0.0, -0.0),
    "counters": (collections.Counter(a=1), collections.Counter(a=2)),
    "mappings of one's own": (Marked(a=1), Marked(a=2)),
    "items of a queue": (collections.deque([1.0]), collections.deque([2.0])),
    "attributes of functions": (marked(1.0), marked(2.0)),
    "what a function tries": guarded(KeyError),
    "setters": classes(weight=[property(len, setter) for setter in STEPS]),
    "deleters": classes(weight=[property(len, None, deleter) for deleter in STEPS]),
    "bases": (type("Law", (Weighted,), {}), type("Law", (Slotted,), {})),
    "names of classes": (type("Law", (), {}), type("Rule", (), {})),
    "a library's name": (posing("json", "loads"), json.loads),
    "text and bytes": ("a", b"a"),
    "order of a list": ([1.0, 2.0], [2.0, 1.0]),
    "values of a read-only mapping": (types.MappingProxyType({"a": 1}), types.MappingProxyType({"a": 2})),
    "dtype": (np.zeros(2, np.float32), np.zeros(2, np.int32)),
    "shape": (np.zeros((2, 3)), np.zeros((3, 2))),
}


@pytest.mark.parametrize("one, other", DIFFER.values(), ids=DIFFER.keys())
def test_other_contents_are_told_apart(one, other):
    assert identity(one) != identity(other)
    assert identity(one) == identity(one) and identity(other) == identity(other)


EQUAL = {
    "closure": lambda: closed_over(7.0),
    "partial": lambda: functools.partial(weighted, weight=np.arange(4)),
    "instance": lambda: Weighted(3.0),
    "jit": lambda: jax.jit(closed_over({"a": [1, 2]})),
    "recursion": lambda: calls_itself,
}


@pytest.mark.parametrize("make", EQUAL.values(), ids=EQUAL.keys())
def test_equal_contents_are_the_same(make):
    one = make()
    assert identity([one, one]) == identity([make(), make()])


@pytest.mark.parametrize("function", [through_a_helper, through_a_comprehension, calls_itself, Weighted(), Weighted])
def test_globals_that_are_named_count_those_of_helpers_too(function, monkeypatch):
    before, of_another = identity(function), identity(weighted)
    monkeypatch.setattr(sys.modules[__name__], "SCALE", 3.0)
    assert identity(function) != before and identity(weighted) == of_another


def test_members_of_the_users_own_modules_count(monkeypatch):
    module = types.ModuleType("settings_of_the_user")
    module.weight, module.other = 1.0, 1.0
    monkeypatch.setitem(sys.modules, module.__name__, module)
    made = {"settings": module}
    exec("def score(m): return settings.weight * m\n", made)
    exec("def late(m):\n    import settings_of_the_user as s\n    return s.weight * m\n", made)
    before = identity(made["score"]), identity(made["late"])
    module.other = 2.0
    assert (identity(made["score"]), identity(made["late"])) == before
    module.weight = 2.0
    assert identity(made["score"]) != before[0] and identity(made["late"]) != before[1]


def test_what_an_installed_package_closes_over_is_known_by_its_version(monkeypatch):
    """And by nothing that its names stand for."""
    module = types.ModuleType("of_t_versions")
    module.__file__, module.__version__ = "/site-packages/of_t_versions.py", "1.0"
    monkeypatch.setitem(sys.modules, module.__name__, module)
    space = {"__name__": module.__name__, "SCALE": 1.0}
    function = types.FunctionType(compile("lambda m: SCALE * m", "", "eval").co_consts[0], space)
    function.__module__ = module.__name__
    in_library.cache_clear()
    before = identity(function)
    space["SCALE"] = 2.0
    assert identity(function) == before
    module.__version__ = "1.1"
    assert identity(function) != before
    in_library.cache_clear()


def imports_a_neighbour(metrics):
    from .neighbour import weight

    return weight * metrics["travel"]


def imports_its_package(metrics):
    from . import neighbour

    return neighbour.weight * metrics["travel"]


REFUSED = {
    "lock": (closed_over(threading.Lock()), r" \(weight\).* got a _thread"),
    "generator": (closed_over(number for number in range(3)), r" \(weight\).* got a builtins.generator "),
    "eval": (lambda m: eval("m"), ".* a call of eval in <lambda> "),
    "import": (imports_a_neighbour, ".* an import of neighbour inside imports_a_neighbour "),
    "import of the package": (imports_its_package, ".* an import of a neighbour inside imports_its_package "),
    **{name: (types.FunctionType(compile(f"{name}(m)", "", "eval"), globals()), f".* a call of {name} in <module> ")
       for name in ("exec", "compile", "globals", "locals", "open", "input", "__import__")},
}  # fmt: skip


@pytest.mark.parametrize("value, seen", REFUSED.values(), ids=REFUSED.keys())
def test_what_cannot_be_told_apart_is_refused_in_one_line(value, seen):
    with pytest.raises(Unidentifiable, match="^objective" + seen) as error:
        identity(value, "objective")
    assert isinstance(error.value, Refused) and "\n" not in str(error.value)


_ELSEWHERE = """
import numpy as np, functools
from mjx_climb.execution.contents import identity
TABLE = {"a": np.arange(5.0), "b": frozenset({"x", "y", "z"})}
def judge(m, scale=2.0, names=frozenset({"p", "q", "r"})):
    return TABLE["a"] * scale if m in {"one", "two", "three"} else 0
print(identity(functools.partial(judge, scale=3.0)))
"""


@pytest.mark.slow
def test_a_package_that_is_installed_into_a_folder_of_its_own_is_a_library_and_a_file_beside_it_is_not(
    monkeypatch, tmp_path
):
    """As by `pip install --target`; what is edited where it lies changes without a version."""
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("installed_of_test", "beside_of_test"):
        (tmp_path / f"{name}.py").write_text("def scale(x):\n    return 2 * x\n")
    (tmp_path / "installed-1.0.dist-info").mkdir()
    (tmp_path / "installed-1.0.dist-info" / "RECORD").write_text("installed_of_test.py,,\n")
    assert (in_library("installed_of_test"), in_library("beside_of_test")) == (False, False)  # not imported yet
    in_library.cache_clear()
    for name in ("installed_of_test", "beside_of_test"):
        monkeypatch.setitem(sys.modules, name, importlib.import_module(name))
    assert (in_library("installed_of_test"), in_library("beside_of_test")) == (True, False)
    in_library.cache_clear()


def test_another_process_gives_the_same():
    """With other seeds of Python's hashes, which order sets."""
    digests = [
        subprocess.run(
            [sys.executable, "-c", _ELSEWHERE], env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert digests[0] == digests[1] and len(digests[0].strip()) == 64


def test_a_module_is_a_librarys_by_where_its_file_or_its_packages_lies(monkeypatch, tmp_path):
    def imported(name, file=None, **more):
        module = types.ModuleType(name)
        vars(module).update(more | ({"__file__": str(tmp_path / file)} if file else {}))
        monkeypatch.setitem(sys.modules, name, module)

    imported("of_t_plain", "plain.py")
    imported("of_t_site", "site-packages/of_t_site.py")
    imported("of_t_dist", "dist-packages/of_t_dist/__init__.py")
    imported("of_t_space")  # a package in several folders has no file
    imported("of_t_space.installed", "site-packages/of_t_space/installed.py")
    imported("of_t_space.own", "of_t_space/own.py")
    imported("of_t_part", "part.py", __part_of__="mjx_climb")
    for name, line in (("of_t_target", "of_t_target.py,sha256=,1"), ("of_t_edited", "not_of_t_edited/a.py,sha256=,1")):
        (tmp_path / name / "x.dist-info").mkdir(parents=True)
        (tmp_path / name / "x.dist-info" / "RECORD").write_text(f"x.py,,\n{line}\n")
        imported(name, f"{name}/{name}.py")
    expected = {
        "json": True, "json.anything": True, "mjx_climb.anything": True, "of_t_part.inner": True,
        "of_t_plain": False, "of_t_plain.inner": False, "of_t_site": True, "of_t_site.inner": True,
        "of_t_dist.inner": True, "of_t_space": False, "of_t_space.installed": True, "of_t_space.own": False,
        "of_t_space.installed.inner": False, "of_t_target": True, "of_t_edited": False, "of_t_nowhere": False,
    }  # fmt: skip
    in_library.cache_clear()
    assert {name: in_library(name) for name in expected} == expected
    in_library.cache_clear()
