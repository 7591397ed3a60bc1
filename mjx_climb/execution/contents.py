"""A digest of all that can change what a user's function, class or object returns.

A function is its byte code, its constants, defaults and closure, and the globals that it names; a class its bases and
the members of its body; another object its parts for `copy` and `pickle`. A name of an installed package is
known by its name and the package's version. Byte code, not the text of the file: a file may have been edited since it
was imported, and names of a session, or two lambdas of one line, have no text of their own.
"""

import dis
import functools
import hashlib
import importlib
import itertools
import re
import sys
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from mjx_climb.execution.refused import Refused

_PACKAGE = __name__.partition(".")[0]
_UNSEEN = {
    "eval",
    "exec",
    "compile",
    "globals",
    "locals",
    "open",
    "input",
    "__import__",
}  # read beyond a digest
_PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented))  # exact by repr
_CODE = (
    "co_code", "co_exceptiontable", "co_argcount", "co_posonlyargcount", "co_kwonlyargcount", "co_flags", "co_names",
    "co_varnames", "co_freevars", "co_cellvars",
)  # fmt: skip


class Unidentifiable(Refused):
    """A value that has no digest; in one line: its place and its type."""


def identity(value: object, name: str = "value") -> str:
    """Return a digest that differs wherever two values may return different results; the same in another process.

    Arguments:
        value: a function, a callable, a class, an instance, an array, or plain values in lists, tuples and mappings.
        name: of the value in messages, as "objective".

    Raises:
        Unidentifiable: it holds or calls something without contents: a lock, a generator, an open file, `eval`.
    """
    return _Digests(name).of(value)


class _Digests:
    """The digests of one value and of all that it refers to."""

    def __init__(self, name: str) -> None:
        self._path = [name]  # from the value to the one at hand
        self._known: dict[int, tuple[str, object]] = {}  # by id, with the object, so that its id stays its own

    def of(self, value: object, step: str = "") -> str:
        """Return the digest of a value, which stands a step further on the path."""
        if type(value) in _PLAIN:
            return _hash(type(value).__name__, repr(value))
        if id(value) not in self._known:
            self._path.append(step)
            self._known[id(value)] = f"recursion to depth {len(self._path)}", value
            self._known[id(value)] = _hash(*self._parts(value)), value
            self._path.pop()
        return self._known[id(value)][0]

    def _parts(self, value: object) -> Iterable[object]:
        """Return the parts that identify a value."""
        if name := _name_in_library(value):
            return "library", name, _version(name)
        if isinstance(value, types.ModuleType):
            return "module", value.__name__, _version(value.__name__)
        if isinstance(value, np.ndarray | np.generic | jax.Array) and not isinstance(value, jax.core.Tracer):
            array = np.asarray(value)
            if not array.dtype.hasobject:
                return "array", array.dtype.str, array.shape, array.tobytes().hex()
        if isinstance(value, list | tuple) and type(value) in (list, tuple):
            return type(value).__name__, *(self.of(item, f"[{index}]") for index, item in enumerate(value))
        if isinstance(value, set | frozenset) and type(value) in (set, frozenset):
            return type(value).__name__, *sorted(map(self.of, value))
        if type(value) is dict or isinstance(value, types.MappingProxyType):
            pairs = ((self.of(key), self.of(held, f".{key}")) for key, held in value.items())
            return "mapping", *itertools.chain.from_iterable(pairs)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, type):
            # without the names that Python and dataclasses add, and that change no result
            body = {
                name: held
                for name, held in vars(value).items()
                if callable(held) or isinstance(held, classmethod) or not name.startswith(("__", "_abc_"))
            }
            return "class", value.__qualname__, *map(self.of, value.__bases__), self.of(body)
        if isinstance(value, property):
            return "property", *map(self.of, (value.fget, value.fset, value.fdel))
        if hasattr(value, "__wrapped__") and not isinstance(value, types.MethodType):  # jax.jit, functools.cache
            return "wrapped", type(value).__qualname__, self.of(value.__wrapped__)
        try:
            parts = value.__reduce_ex__(4)
        except Exception:  # a class of the user's may raise anything
            raise self._refused(f"a {type(value).__module__}.{type(value).__qualname__}") from None
        if isinstance(parts, str):  # an object that its module holds under this name
            return "named", type(value).__module__, type(value).__qualname__, parts
        constructor, arguments, state, *items = (*parts, None, None, None)[:5]
        items = [None if part is None else list(part) for part in items]  # iterators over a list or mapping
        return "instance", self.of(type(value)), *map(self.of, (constructor, arguments, state, *items))

    def _function(self, function: types.FunctionType) -> Iterator[object]:
        yield from ("function", self.of(function.__defaults__), self.of(function.__kwdefaults__))
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            try:
                held = cell.cell_contents
            except ValueError:  # not filled yet
                continue
            yield self.of(held, f" ({name})")
        yield self.of({name: held for name, held in vars(function).items() if name != "__wrapped__"})
        home = function.__globals__.get("__name__", "")
        yield _version(home)
        # a library's closure, such as jax.vmap's, is told by the version
        space = {} if in_library(home) else function.__globals__
        for said in _said(function.__code__):
            yield from self._taken(said, space) if isinstance(said, _Taken) else (said,)

    def _taken(self, taken: "_Taken", space: dict[str, object]) -> Iterator[object]:
        name, code = taken.name, taken.by
        if taken.loaded and name in space:
            used = space[name]
        elif taken.loaded and space and name in _UNSEEN:
            raise self._refused(f"a call of {name} in {code.co_name}")
        elif space and not taken.loaded:
            try:
                used = importlib.import_module(name)
            except (ImportError, ValueError):  # ValueError: a relative import
                raise self._refused(f"an import of {name or 'a neighbour'} inside {code.co_name}") from None
        else:
            return
        yield from (name, self.of(used, f" ({name})"))
        for path, member in _members(used, code.co_names):
            yield from (path, self.of(member, f" ({path})"))

    def _refused(self, what: str) -> Unidentifiable:
        return Unidentifiable(
            f"{''.join(self._path)}: expected what can be told from others by its contents, got {what} "
            "(needed with out= alone, to know an interrupted search again)"
        )


class _Taken(NamedTuple):
    """A name that code takes: a global, or a module by an import."""

    name: str
    loaded: bool  # a global
    by: types.CodeType


@functools.lru_cache(maxsize=4096)
def _said(code: types.CodeType) -> tuple[object, ...]:
    """Return byte code, the digests of its constants, the same of the functions in it, and the names that it takes.

    These never change. The values behind the names may, and are looked up each time.
    """
    said = [getattr(code, part) for part in _CODE]
    for constant in code.co_consts:
        said += _said(constant) if isinstance(constant, types.CodeType) else [identity(constant)]
    for step in dis.get_instructions(code):
        if (loaded := step.opname in ("LOAD_GLOBAL", "LOAD_NAME")) or step.opname == "IMPORT_NAME":
            said.append(_Taken(step.argval, loaded, code))
    return tuple(said)


def _hash(*parts: object) -> str:
    return hashlib.sha256("\0".join(map(str, parts)).encode("utf-8", "surrogatepass")).hexdigest()


def _members(module: object, names: tuple[str, ...]) -> Iterator[tuple[str, object]]:
    """Yield the members of a user's module by their names; none of any other value."""
    if isinstance(module, types.ModuleType) and not in_library(module.__name__):
        for name in names:
            if (value := vars(module).get(name, module)) is not module:
                yield f"{module.__name__}.{name}", value
                yield from _members(value, names)


@functools.cache
def in_library(module: str) -> bool:
    """Return whether a module comes with Python, with this package or a part of it, or from an installed one."""
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names or _PACKAGE in (top, getattr(sys.modules.get(top), "__part_of__", "")):
        return True
    file = getattr(sys.modules.get(module), "__file__", None) or getattr(sys.modules.get(top), "__file__", None)
    if file is None or any(folder in file for folder in ("site-packages", "dist-packages")):
        return file is not None
    # in a folder of `pip install --target`; a package that is edited where it lies has no RECORD beside it
    records = (path for folder in Path(file).parents for path in folder.glob("*.dist-info/RECORD"))
    return any(re.search(rf"^{re.escape(top)}[./]", path.read_text(), re.MULTILINE) for path in records)


def _version(name: str) -> str:
    return str(getattr(sys.modules.get(name.partition(".")[0]), "__version__", ""))


def _name_in_library(value: object) -> str:
    """Return the full name of a library's object under a name, empty for anything else."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or not in_library(module):
        return ""
    try:
        found = functools.reduce(getattr, name.split("."), sys.modules[module])
    except (AttributeError, KeyError):
        return ""
    return f"{module}.{name}" if found is value else ""
