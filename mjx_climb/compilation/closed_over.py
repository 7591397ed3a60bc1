"""What a function closes over, taken out of it: worked out once, it can be kept between calls."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax.extend import core


class Closed(NamedTuple):
    """A function and the arrays that it closes over, in the order in which it uses them."""

    constants: list[Any]
    call: Callable[..., Any]  # of the constants, as these or others like them, and the arguments


def closed_over(function: Callable[..., Any], *arguments: Any) -> Closed:
    """Return a function of some arguments, arrays or shapes, apart from what it closes over."""
    program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    tree = jax.tree.structure(shape)

    def call(constants: Sequence[Any], *arguments: Any) -> Any:
        whole = core.ClosedJaxpr(program.jaxpr, list(constants))
        return jax.tree.unflatten(tree, core.jaxpr_as_fun(whole)(*jax.tree.leaves(arguments)))

    return Closed(list(program.consts), call)
