"""Names of a package that are imported when they are first used, so that the command line starts at once."""

from __future__ import annotations

import ast
import importlib
import sys

TYPE_CHECKING = False  # `typing` takes longest of all that is imported before the command line watches signals
if TYPE_CHECKING:
    from collections.abc import Callable


def lazy_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose names stand below its `if TYPE_CHECKING:`.

    Type checkers and editors read the imports there as they are; at run time each is carried out on first use.
    """
    module = sys.modules[package]
    source = module.__spec__.loader.get_source(package)  # type: ignore[union-attr]
    [imports] = (node.body for node in ast.parse(source).body if isinstance(node, ast.If))
    homes = {alias.name: node.module for node in imports if isinstance(node, ast.ImportFrom) for alias in node.names}

    def get(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(str(homes[name])), name)
        return vars(module).setdefault(name, value)  # a module of this name has set itself there

    return get, lambda: sorted({*vars(module), *homes}), sorted(homes)
