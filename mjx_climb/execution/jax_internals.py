"""What compiled walks need of JAX that JAX does not promise, and what differs between 0.10 and 0.11."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax._src.interpreters import ad, partial_eval
from jax._src.interpreters.ad import jvp_jaxpr as jvp_jaxpr  # forward derivatives of a jaxpr, by some of its arguments
from jax.extend import core


def inner_program(equation: core.JaxprEqn) -> core.ClosedJaxpr | None:
    """Return what an equation calls once with its operands, None where it calls nothing.

    The jaxpr of a call with a derivative of its own (`custom_jvp_call`, `custom_vjp_call`) is its values.
    """
    if equation.primitive.name not in CALLS:
        return None
    inner = equation.params[CALLS[equation.primitive.name]]
    return inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ())  # checkpoint has an open one


OVER_ROBOTS = "over_robots"  # the name of this package's own operation
CALLS = {
    OVER_ROBOTS: "program",
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    **dict.fromkeys(("checkpoint", "remat2"), "jaxpr"),  # one operation, whose name changes with JAX
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def carried_out(primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Any]) -> list[Any]:
    """Return the results of an operation, one or several."""
    made = primitive.bind(*operands, **primitive.get_bind_params(dict(parameters)))
    return list(made) if primitive.multiple_results else [made]


def prepare_for(executable: bytes) -> None:
    """Have a stored executable find LAPACK where it calls it: JAX looks it up when it lowers, else all stops."""
    if b"lapack_" in executable:
        from jaxlib import lapack  # imports SciPy

        find: Any = lapack.prepare_lapack_call
        find("potrf_ffi", np.float32)  # any of its functions


def scan_sizes(parameters: dict[str, Any]) -> tuple[int, int]:
    """Return how many constants a scan has and how many values it carries.

    JAX 0.10 has two numbers among the equation's parameters; 0.11 has flat trees of the operands in their place.
    """
    if "ft_in" not in parameters:
        return parameters["num_consts"], parameters["num_carry"]
    constants, carry, _ = map(len, parameters["ft_in"].unpack())
    return constants, carry


def register_reverse_mode(
    primitive: core.Primitive,
    linearized: Callable[..., Any],
    plain: Callable[..., list[Any]],
    as_call: Callable[..., dict[str, Any]],
) -> None:
    """Give an operation its reverse mode, under `jax.checkpoint` too.

    Checkpoints split a program by what is known without the tangents: the operation is split like a call, and done by
    JAX's own operations where the tangents are on their way back.
    """

    def known_in_part(trace: Any, *values: Any, **parameters: Any) -> list[Any]:
        with core.set_current_trace(trace):
            return plain(*values, **parameters)

    def split(saveable: Any, unknown: Any, instantiate: Any, equation: core.JaxprEqn) -> Any:
        call = equation.replace(params=as_call(**equation.params))
        return partial_eval.closed_call_partial_eval_custom_rule(
            "program", lambda *of: tuple(as_call(**part) for part in of[-2:]), saveable, unknown, instantiate, call
        )

    def rule(_: bool, moving: Sequence[bool], *values: Any, **parameters: Any) -> Any:
        results, moved, tangents = linearized(moving, *values, **parameters)
        if jax.__version_info__ < (0, 11):
            return results, moved, None, lambda _, *along: tangents(*along)
        return results, moved, None, None, lambda _, __, *along: tangents(*along)  # structured residuals, of arrays

    ad.primitive_linearizations[primitive] = rule
    partial_eval.custom_partial_eval_rules[primitive] = known_in_part
    partial_eval.partial_eval_jaxpr_custom_rules[primitive] = split


def new_program(
    like: core.Jaxpr,
    equations: Sequence[core.JaxprEqn],
    inputs: Sequence[core.Var],
    outputs: Sequence[core.Var | core.Literal],
    constants: Sequence[tuple[core.Var, Any]] = (),
) -> core.ClosedJaxpr:
    """Return equations as a program, whose `constants` are variables and their values; `like` says where it is from."""
    known = [variable for variable, _ in constants]
    about = like.debug_info.with_unknown_names()  # JAX warns of programs without
    jaxpr = core.Jaxpr(known, list(inputs), list(outputs), list(equations), debug_info=about)
    return core.ClosedJaxpr(jaxpr, [value for _, value in constants])
