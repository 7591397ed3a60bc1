"""What tells one user's function, class or object from another: a digest of all that can change what it gives.

A function is its bytecode with its constants, defaults, closure and the globals that it names; a class its bases and
what its body holds; any other object what it is rebuilt from when it is copied or pickled: the fields of an instance,
the function and arguments of a `functools.partial`. Arrays are known by dtype, shape and contents. What belongs to an
installed package is known by its name and the package's version.
"""

import dataclasses
import dis
import functools
import hashlib
import importlib
import sys
import types
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_climb.scenario.messages import ConfigError

_OWN = ("mjx_climb", "tuning")
_BLIND = ("eval", "exec", "compile", "globals", "locals", "open", "input", "__import__")  # they read what none can see
_PLAIN = (type(None), bool, int, complex, str, bytes, type(...), type(NotImplemented))
_NOT_BODY = {
    "__abstractmethods__", "__annotate__", "__annotate_func__", "__annotations__", "__annotations_cache__",
    "__dataclass_params__", "__dict__", "__doc__", "__firstlineno__", "__module__", "__qualname__",
    "__static_attributes__", "__weakref__", "_abc_impl",
}  # fmt: skip


class Unidentifiable(ConfigError):
    """A value that cannot be told from another; in one line: where it was found, and what it is."""


def identity(value: Any, name: str = "value") -> str:
    """Return a digest that differs wherever two values may give different numbers; the same in another process.

    Arguments:
        value: a function, a callable, a class, an instance, an array, or plain values in lists, tuples and mappings.
        name: of the value in messages, as "objective".

    Raises:
        Unidentifiable: it holds or calls what contents do not tell: a lock, a generator, an open file, `eval`.
    """
    return _Digests(name).of(value)


class _Digests:
    """The digests of one value and of all that it refers to."""

    def __init__(self, name: str):
        self._path = [name]
        self._begun: dict[int, int] = {}  # objects on the way from the value to here, and their depth
        self._known: dict[int, tuple[str, Any]] = {}  # finished ones; the object is held so that its id stays its own

    def of(self, value: Any) -> str:
        """Return the digest of a value."""
        if isinstance(value, _PLAIN) and type(value) in _PLAIN:
            return _hash(type(value).__name__, repr(value))
        if type(value) is float:
            return _hash("float", value.hex())
        if id(value) in self._known:
            return self._known[id(value)][0]
        if id(value) in self._begun:
            return _hash("itself", len(self._begun) - self._begun[id(value)])
        self._begun[id(value)] = len(self._begun)
        digest = self._of_object(value)
        del self._begun[id(value)]
        self._known[id(value)] = digest, value
        return digest

    def _of_object(self, value: Any) -> str:
        if isinstance(value, types.ModuleType):
            return _hash("module", value.__name__, _version(value.__name__))
        if name := _namein_library(value):
            return _hash("library", name, _version(name))
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self._array(value)
        if type(value) in (list, tuple):
            return _hash(type(value).__name__, *(self._at(f"[{i}]", item) for i, item in enumerate(value)))
        if type(value) in (set, frozenset):
            return _hash(type(value).__name__, *sorted(map(self.of, value)))
        if type(value) in (dict, types.MappingProxyType):
            return self._mapping(value)
        if isinstance(value, types.CodeType):
            return self._code(value)
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, property):
            return _hash("property", *map(self.of, (value.fget, value.fset, value.fdel)))
        if isinstance(value, staticmethod | classmethod):
            return _hash(type(value).__name__, self.of(value.__func__))
        if isinstance(value, types.MemberDescriptorType | types.GetSetDescriptorType):
            return _hash("slot", value.__name__)
        wrapped = getattr(value, "__wrapped__", None)
        if wrapped is not None and not isinstance(value, types.MethodType):  # jax.jit, functools.cache
            rest = {key: held for key, held in getattr(value, "__dict__", {}).items() if key != "__wrapped__"}
            return _hash("wrapped", type(value).__qualname__, self.of(wrapped), self._mapping(rest))
        return self._instance(value)

    def _at(self, step: str, value: Any) -> str:
        """Return the digest of what stands at a step further on the way, for messages."""
        self._path.append(step)
        digest = self.of(value)
        self._path.pop()
        return digest

    def _mapping(self, values: Mapping[Any, Any]) -> str:
        return _hash("mapping", *(part for k, v in values.items() for part in (self.of(k), self._at(f".{k}", v))))

    def _array(self, value: Any) -> str:
        if isinstance(value, jax.core.Tracer):
            raise self._refused("an array that is being traced")
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return _hash("key", str(value.dtype), self._array(jax.random.key_data(value)))
        array = np.asarray(value)
        if array.dtype.hasobject:
            return _hash("objects", array.shape, *map(self.of, array.ravel().tolist()))
        return _hash("array", array.dtype.str, array.shape, hashlib.sha256(array.tobytes()).hexdigest())

    def _code(self, code: types.CodeType) -> str:
        return _hash(
            "code", sys.version_info[:2], code.co_code.hex(), code.co_exceptiontable.hex(), code.co_argcount,
            code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags, code.co_names, code.co_varnames,
            code.co_freevars, code.co_cellvars, *map(self.of, code.co_consts),
        )  # fmt: skip

    def _function(self, function: types.FunctionType) -> str:
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        held = [
            *(self._at(f" ({name})", contents) for name, cell in cells for contents in _contents(cell)),
            self.of(function.__defaults__),
            self.of(function.__kwdefaults__),
            self._mapping({key: value for key, value in function.__dict__.items() if key != "__wrapped__"}),
        ]
        home = function.__globals__.get("__name__", "")
        if in_library(home):  # one that a library has made, as jax.vmap does: what it closes over is the user's
            return _hash("made", home, function.__code__.co_qualname, _version(home), *held)
        named = []
        for name, value in self._globals(function):
            named += [name, self._at(f" ({name})", value)]
        return _hash("function", self.of(function.__code__), *held, *named)

    def _globals(self, function: types.FunctionType) -> Iterable[tuple[str, Any]]:
        """Return names and values that a function takes from its module, and from modules of the user's own."""
        space = function.__globals__
        for code in _codes(function.__code__):
            for step in dis.get_instructions(code):
                name = step.argval
                if step.opname == "IMPORT_NAME" and not in_library(name):
                    try:
                        yield from _members(importlib.import_module(name), code.co_names)
                    except ImportError:
                        raise self._refused(f"an import of {name} inside {code.co_name}") from None
                if step.opname not in ("LOAD_GLOBAL", "LOAD_NAME"):
                    continue
                if name in space:
                    yield name, space[name]
                    if isinstance(space[name], types.ModuleType):
                        yield from _members(space[name], code.co_names)
                elif name in _BLIND:
                    raise self._refused(f"a call of {name} in {code.co_name}")

    def _class(self, kind: type) -> str:
        body = {name: value for name, value in vars(kind).items() if name not in _NOT_BODY}
        if dataclasses.is_dataclass(kind):
            body = {name: value for name, value in body.items() if not _generated(value)}
            body["__dataclass_fields__"] = [
                (field.name, field.init, field.kw_only, *(
                    None if part is dataclasses.MISSING else part for part in (field.default, field.default_factory)
                ), dict(field.metadata))
                for field in dataclasses.fields(kind)
            ]  # fmt: skip
        if issubclass(kind, tuple) and hasattr(kind, "_fields"):  # a named tuple: its methods follow from these
            made = {"__new__", "__slots__", "_make", "_replace", "__repr__", "_asdict", "__getnewargs__", "__replace__"}
            body = {name: value for name, value in body.items() if name not in made and name not in kind._fields}
        return _hash("class", kind.__qualname__, *map(self.of, kind.__bases__), self._mapping(body))

    def _instance(self, value: Any) -> str:
        try:
            parts = value.__reduce_ex__(4)
        except Exception:
            raise self._refused(f"a {type(value).__module__}.{type(value).__qualname__}") from None
        if isinstance(parts, str):  # one object of its module, by its name there
            return _hash("named", type(value).__module__, type(value).__qualname__, parts)
        listed = [list(part) if number in (3, 4) and part is not None else part for number, part in enumerate(parts)]
        return _hash("instance", self.of(type(value)), *map(self.of, listed))

    def _refused(self, what: str) -> Unidentifiable:
        return Unidentifiable(
            f"{''.join(self._path)}: expected what can be told from others by its contents, got {what} "
            "(needed with out= alone, to know an interrupted search again)"
        )


def _hash(*parts: Any) -> str:
    return hashlib.sha256("\0".join(map(str, parts)).encode("utf-8", "surrogatepass")).hexdigest()


def _contents(cell: types.CellType) -> tuple[Any, ...]:
    try:
        return (cell.cell_contents,)
    except ValueError:  # not filled yet
        return ()


def _codes(code: types.CodeType) -> Iterable[types.CodeType]:
    """Return a function's code and that of the functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _members(module: types.ModuleType, names: Iterable[str]) -> Iterable[tuple[str, Any]]:
    """Return what a user's own module holds under some names."""
    if in_library(module.__name__):
        return
    for name in names:
        if name in vars(module):
            value = vars(module)[name]
            yield f"{module.__name__}.{name}", value
            if isinstance(value, types.ModuleType) and value is not module:
                yield from _members(value, names)


def _generated(value: Any) -> bool:
    """Return whether `dataclasses` has written a method."""
    code = getattr(value, "__code__", None) or getattr(getattr(value, "__wrapped__", None), "__code__", None)
    return code is not None and code.co_filename == "<string>"


@functools.cache
def in_library(module: str) -> bool:
    """Return whether a module comes with Python, with this program, or from an installed package."""
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names or top in _OWN:
        return True
    file = getattr(sys.modules.get(module), "__file__", None) or getattr(sys.modules.get(top), "__file__", None)
    return file is not None and any(folder in file for folder in ("site-packages", "dist-packages"))


def _version(name: str) -> str:
    return str(getattr(sys.modules.get(name.partition(".")[0]), "__version__", ""))


def _namein_library(value: Any) -> str:
    """Return the full name of what a library gives under a name, empty for anything else."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or not in_library(module):
        return ""
    try:
        found = functools.reduce(getattr, name.split("."), sys.modules[module])
    except (AttributeError, KeyError):
        return ""
    return f"{module}.{name}" if found is value else ""
