"""Tests that run once a night still call the packages as they are: names and arguments, without running them."""

import ast
import importlib
import inspect
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
OURS = ("mjx_climb", "tuning", "tests")
FILES = [
    str(file.relative_to(ROOT))
    for file in sorted((ROOT / "tests").rglob("test_*.py"))
    if "mark.nightly" in file.read_text() and file != Path(__file__)
]


class Unknown(Exception):
    """A name of something that is known only as the test runs."""


def bound(function: ast.AST) -> set[str]:
    """Return the names that a function, a comprehension or a class binds itself."""
    return {
        node.id if isinstance(node, ast.Name) else node.arg if isinstance(node, ast.arg) else node.name
        for node in ast.walk(function)
        if (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
        or isinstance(node, ast.arg | ast.FunctionDef | ast.ClassDef)
    }


def object_of(node: ast.AST, known: dict[str, Any]) -> Any:
    """Return the object of a dotted name.

    Raises:
        AttributeError: one of our modules has no such name.
    """
    if isinstance(node, ast.Name) and node.id in known:
        return known[node.id]
    if isinstance(node, ast.Attribute):
        owner = object_of(node.value, known)
        if isinstance(owner, ModuleType) and owner.__name__.split(".")[0] in OURS:
            return getattr(owner, node.attr)
    raise Unknown


def faults(node: ast.AST, known: dict[str, Any]) -> list[str]:
    """Return the lines of names that are gone, and of calls whose arguments do not fit."""
    if isinstance(node, ast.FunctionDef | ast.Lambda | ast.ClassDef | ast.GeneratorExp | ast.ListComp | ast.DictComp):
        own = bound(node)
        known = {name: value for name, value in known.items() if name not in own}
    found = []
    try:
        if isinstance(node, ast.Attribute):
            object_of(node, known)
        plain = isinstance(node, ast.Call) and not any(isinstance(each, ast.Starred) for each in node.args)
        if plain and all(each.arg for each in node.keywords):
            called = object_of(node.func, known)
            if str(getattr(called, "__module__", "")).split(".")[0] in OURS:
                inspect.signature(called).bind(*node.args, **{each.arg: None for each in node.keywords})
    except (Unknown, ValueError):  # of exceptions Python knows no signature
        pass
    except (AttributeError, TypeError) as error:
        found.append(f"line {node.lineno}: {ast.unparse(node)[:60]}: {error}")
    return found + [line for child in ast.iter_child_nodes(node) for line in faults(child, known)]


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES)
def test_what_runs_at_night_calls_what_is_there(file):
    module = importlib.import_module(file.removesuffix(".py").replace("/", "."))
    assert not faults(ast.parse((ROOT / file).read_text()), dict(vars(module)))


def test_a_name_that_is_gone_and_an_argument_too_many_are_found():
    known = {"mc": importlib.import_module("mjx_climb")}
    text = "mc.rollout(scenario)\nmc.rolout(scenario)\nmc.metrics(walk, metrics=(), mode=1)\nmc.load_scenario()\n"
    assert [line.split(":")[0] for line in faults(ast.parse(text), known)] == ["line 2", "line 2", "line 3", "line 4"]
    assert not faults(ast.parse("def test(mc):\n    mc.rolout()\n"), known)
