"""A guard for programs that have forward derivatives alone: the reverse mode is refused when it is asked for.

Without it XLA would stop the process, see `mjx_climb.compilation.cpu_pieces`.
"""

from typing import Any, TypeVar

import jax
from jax._src.interpreters.ad import primitive_linearizations  # not public; jax is pinned to one minor version
from jax.extend import core
from jax.interpreters import ad, batching, mlir

Tree = TypeVar("Tree")

_identity = core.Primitive("forward_only")


def forward_only(tree: Tree, instead: str) -> Tree:
    """Return the arrays of a tree as they are: values and forward derivatives pass.

    Raises:
        NotImplementedError: under `grad`, `vjp`, `jacrev` or `linearize`, when these are traced; it ends in `instead`.
    """
    guarded: Tree = jax.tree.map(lambda value: _identity.bind(value, instead=instead), tree)
    return guarded


def _refuse(*_: Any, instead: str, **__: Any) -> Any:
    raise NotImplementedError(f"this function has values and forward derivatives (jvp, jacfwd) alone: {instead}")


_identity.def_impl(lambda value, instead: value)
_identity.def_abstract_eval(lambda value, instead: value)
ad.primitive_jvps[_identity] = lambda values, tangents, instead: (
    _identity.bind(*values, instead=instead),
    tangents[0] if type(tangents[0]) is ad.Zero else _identity.bind(tangents[0], instead=instead),
)
ad.primitive_transposes[_identity] = _refuse
primitive_linearizations[_identity] = _refuse
batching.primitive_batchers[_identity] = lambda values, axes, instead: (
    _identity.bind(*values, instead=instead),
    axes[0],
)
mlir.register_lowering(_identity, lambda context, value, instead: [value])
