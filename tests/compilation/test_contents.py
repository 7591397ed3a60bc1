"""What tells users' functions and objects apart: contents, not names."""

import dataclasses
import functools
import subprocess
import sys
import threading
import types
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.compilation.contents import Unidentifiable, identity
from mjx_climb.scenario.messages import ConfigError

SCALE = 2.0
TABLE = np.arange(3.0)


def closed_over(weight):
    return lambda metrics: weight * metrics["travel"]


def weighted(metrics, weight=1.0):
    return weight * metrics["travel"]


def named_global(metrics):
    return SCALE * metrics["travel"] + TABLE[0]


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


class Plain:
    def __init__(self, weight):
        self.weight = weight

    def score(self, metrics):
        return self.weight * metrics["travel"]


class Slotted:
    __slots__ = ("weight",)

    def __init__(self, weight):
        self.weight = weight


class Pair(NamedTuple):
    first: float
    second: object


DIFFER = {
    "closure": (closed_over(1.0), closed_over(100.0)),
    "closure over arrays": (closed_over(np.ones(3)), closed_over(np.array([1.0, 1.0, 1.0 + 1e-15]))),
    "closure over arrays of jax": (closed_over(jnp.ones(3)), closed_over(jnp.zeros(3))),
    "closure over functions": (closed_over(closed_over(1.0)), closed_over(closed_over(2.0))),
    "partial": (functools.partial(weighted, weight=1.0), functools.partial(weighted, weight=100.0)),
    "partial of another": (functools.partial(weighted, weight=1.0), functools.partial(helper, weight=1.0)),
    "default": (closed_over(1.0), types.FunctionType(weighted.__code__, globals(), argdefs=(3.0,))),
    "default of a keyword": (lambda m, *, weight=1.0: weight * m, lambda m, *, weight=2.0: weight * m),
    "constants": (lambda m: 1.0 * m["travel"], lambda m: 2.0 * m["travel"]),
    "type of a constant": (lambda m: m["travel"] ** 2, lambda m: m["travel"] ** 2.0),
    "operations": (lambda m: m["travel"] + 1.0, lambda m: m["travel"] - 1.0),
    "names": (lambda m: jnp.sin(m["travel"]), lambda m: jnp.cos(m["travel"])),
    "fields": (Weighted(1.0), Weighted(2.0)),
    "attributes": (Plain(1.0), Plain(2.0)),
    "slots": (Slotted(1.0), Slotted(2.0)),
    "method of another instance": (Plain(1.0).score, Plain(2.0).score),
    "named tuple": (Pair(1.0, 2), Pair(1.0, 3)),
    "jit": (jax.jit(closed_over(1.0)), jax.jit(closed_over(2.0))),
    "vmap": (jax.vmap(closed_over(1.0)), jax.vmap(closed_over(2.0))),
    "cache": (functools.cache(closed_over(1.0)), functools.cache(closed_over(2.0))),
    "keys": ({"a": 1.0}, {"b": 1.0}),
    "sign of zero": (0.0, -0.0),
    "dtype": (np.zeros(2, np.float32), np.zeros(2, np.int32)),
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
    assert identity(make()) == identity(make())


@pytest.mark.parametrize(
    "function", [named_global, through_a_helper, through_a_comprehension, calls_itself, Weighted(), Weighted]
)
def test_globals_that_are_named_count_those_of_helpers_too(function, monkeypatch):
    before = identity(function)
    monkeypatch.setattr(sys.modules[__name__], "SCALE", 3.0)
    assert identity(function) != before


def test_globals_that_are_not_named_do_not_count(monkeypatch):
    before = identity(weighted)
    monkeypatch.setattr(sys.modules[__name__], "SCALE", 3.0)
    assert identity(weighted) == before


def test_members_of_the_users_own_modules_count(monkeypatch):
    module = types.ModuleType("settings_of_the_user")
    module.weight, module.other = 1.0, 1.0
    monkeypatch.setitem(sys.modules, module.__name__, module)
    made = {"settings": module}
    exec("def judge(m): return settings.weight * m\n", made)
    exec("def late(m):\n    import settings_of_the_user as s\n    return s.weight * m\n", made)
    before = identity(made["judge"]), identity(made["late"])
    module.other = 2.0
    assert (identity(made["judge"]), identity(made["late"])) == before
    module.weight = 2.0
    assert identity(made["judge"]) != before[0] and identity(made["late"]) != before[1]


def test_a_class_of_the_same_name_with_another_method_is_another():
    one = type("Law", (), {"step": lambda self, x: x})
    other = type("Law", (), {"step": lambda self, x: 2 * x})
    assert identity(one) != identity(other)
    assert identity(one()) != identity(other())


def a_generator():
    yield 1.0


@pytest.mark.parametrize("held", [threading.Lock(), a_generator()], ids=["lock", "generator"])
def test_what_cannot_be_told_apart_is_refused_in_one_line(held):
    with pytest.raises(Unidentifiable, match=r"^objective \(weight\): expected .* got a ") as error:
        identity(closed_over(held), "objective")
    assert isinstance(error.value, ConfigError) and "\n" not in str(error.value)


def test_a_function_that_reads_what_none_can_see_is_refused():
    with pytest.raises(Unidentifiable, match="a call of eval in <lambda>"):
        identity(lambda m: eval("m"), "objective")


_ELSEWHERE = """
import numpy as np, functools
from mjx_climb.compilation.contents import identity
TABLE = {"a": np.arange(5.0), "b": frozenset({"x", "y", "z"})}
def judge(m, scale=2.0, names=frozenset({"p", "q", "r"})):
    return TABLE["a"] * scale if m in {"one", "two", "three"} else 0
print(identity(functools.partial(judge, scale=3.0)))
"""


@pytest.mark.slow
def test_another_process_gives_the_same():
    """With other seeds of Python's hashes, which order sets."""
    said = [
        subprocess.run(
            [sys.executable, "-c", _ELSEWHERE], env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert said[0] == said[1] and len(said[0].strip()) == 64
