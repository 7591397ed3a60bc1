"""All undocumented parts of JAX and XLA that this package needs, and differences between JAX 0.10 and 0.11.

That is: names of JAX's modules that begin with an underscore, the parameters of equations, settings that are found by
their name, and names that XLA understands. Elsewhere in this package `jax.extend` and `jax.interpreters` are
used, which are documented, for packages as this one. `tests/execution/test_jax_internals.py` has a test of the name of
each function here, which fails first when JAX changes; CI runs it with the oldest JAX and with the newest one that
`pyproject.toml` lets in.
"""

import weakref
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from contextlib import AbstractContextManager

import jax
import numpy as np
from jax import Array
from jax._src import config, dtypes, literals, source_info_util, xla_bridge
from jax._src.interpreters import ad, partial_eval
from jax._src.interpreters.ad import jvp_jaxpr as jvp_jaxpr  # forward derivatives of a jaxpr, by some of its arguments
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

from mjx_climb.execution.jax_types import Function, Parameters, PyTree

# XLA's options, see `paths.compiler_options`
LEVEL, WIDTH = "xla_backend_optimization_level", "xla_cpu_prefer_vector_width"
LAUNCH = "__gpu$xla.gpu.ptx"  # the custom call by which XLA launches a kernel in PTX


def inner_program(equation: core.JaxprEqn) -> core.ClosedJaxpr | None:
    """Return the program that an equation calls once with its operands, None where it calls none.

    The jaxpr of a call with a derivative of its own (`custom_jvp_call`, `custom_vjp_call`) is its values.
    """
    if equation.primitive.name not in CALLS:
        return None
    inner = equation.params[CALLS[equation.primitive.name]]
    return inner if isinstance(inner, core.ClosedJaxpr) else core.ClosedJaxpr(inner, ())  # checkpoint has an open one


def with_inner(change: Callable[[core.ClosedJaxpr], core.ClosedJaxpr], equation: core.JaxprEqn) -> Parameters:
    """Return the parameters of an equation, with the body of a loop and the branches of a condition changed."""
    parameters, name = equation.params, equation.primitive.name
    if name == "scan":
        return parameters | {"jaxpr": change(parameters["jaxpr"])}
    return parameters | {"branches": tuple(map(change, parameters["branches"]))} if name == "cond" else parameters


def line_of(equation: core.JaxprEqn) -> str:
    """Return where an equation comes from, file and line outside of JAX; empty where that is not known."""
    return source_info_util.summarize(equation.source_info)


def from_line_of(equation: core.JaxprEqn) -> AbstractContextManager[None]:
    """Have the equations that are made now come from where another one does."""
    return source_info_util.user_context(equation.source_info.traceback)


def without_unread(program: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Return a program without the operations that no result needs, in its loops too; all arguments stay."""
    less, _ = partial_eval.dce_jaxpr(program.jaxpr, True, instantiate=True)
    return core.ClosedJaxpr(less, program.consts)


def arguments_of(program: core.ClosedJaxpr, read: Sequence[bool]) -> list[bool]:
    """Return which arguments the results that are read depend on."""
    return list(partial_eval.dce_jaxpr(program.jaxpr, list(read))[1])


OVER_ROBOTS = "over_robots"  # the name of this package's own operation
CALLS = {
    OVER_ROBOTS: "program",
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    **dict.fromkeys(("checkpoint", "remat2"), "jaxpr"),  # one operation, whose name changes with JAX
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def carried_out(primitive: core.Primitive, parameters: Parameters, operands: Sequence[object]) -> list[Array]:
    """Return the results of an operation, one or several."""
    made = primitive.bind(*operands, **primitive.get_bind_params(dict(parameters)))
    return list(made) if primitive.multiple_results else [made]


def prepare_for(executable: bytes) -> None:
    """Have a stored executable find LAPACK where it calls it: JAX looks it up when it lowers, else all stops."""
    if b"lapack_" in executable:
        from jaxlib import lapack  # imports SciPy

        find: Function = lapack.prepare_lapack_call
        find("potrf_ffi", np.float32)  # any of its functions


def scan_sizes(parameters: Parameters) -> tuple[int, int]:
    """Return how many constants a scan has and how many values it carries.

    JAX 0.10 has two numbers among the equation's parameters; 0.11 has flat trees of the operands in their place.
    """
    if "ft_in" not in parameters:
        return parameters["num_consts"], parameters["num_carry"]
    constants, carry, _ = map(len, parameters["ft_in"].unpack())
    return constants, carry


def take_tables_in_each_precision() -> None:
    """Have JAX read an array of NumPy in the precision that is allowed now, as often as that changes.

    JAX 0.10 and 0.11 keep the first reading while a program holds it: an array in float64 that a law reads in a walk in
    double precision would be float64 in the next walk in single precision, whose operations do not take it.
    """

    kept: dict[int, tuple[weakref.ref[np.ndarray], MutableMapping[np.dtype, literals.TypedNdArray]]] = {}  # by id

    def read(table: np.ndarray) -> literals.TypedNdArray:
        key, dtype = id(table), dtypes.canonicalize_dtype(table.dtype)
        if key not in kept:
            kept[key] = weakref.ref(table, lambda _: kept.pop(key, None)), weakref.WeakValueDictionary()
        _, readings = kept[key]
        if (reading := readings.get(dtype)) is None:
            # one reading for all uses: a program has each table once
            reading = readings[dtype] = literals.TypedNdArray(np.asarray(table, dtype))
        return reading

    dtypes.register_canonicalize_value_handler(np.ndarray, read)


def register_reverse_mode(
    primitive: core.Primitive,
    linearized: Function,
    plain: Function,
    as_call: Callable[..., Parameters],
) -> None:
    """Give an operation its reverse mode, under `jax.checkpoint` too.

    Checkpoints split a program into parts with and without tangents: the operation is split like a call, and done by
    JAX's own operations where the tangents are on their way back.
    """

    def known_in_part(trace: PyTree, *values: Array, **parameters: PyTree) -> PyTree:
        with core.set_current_trace(trace):
            return plain(*values, **parameters)

    def split(saveable: PyTree, unknown: PyTree, instantiate: PyTree, equation: core.JaxprEqn) -> PyTree:
        call = equation.replace(params=dict(as_call(**equation.params)))
        return partial_eval.closed_call_partial_eval_custom_rule(
            "program", lambda *of: tuple(as_call(**part) for part in of[-2:]), saveable, unknown, instantiate, call
        )

    def rule(_: bool, moving: Sequence[bool], *values: Array, **parameters: PyTree) -> PyTree:
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
    constants: Sequence[tuple[core.Var, Array]] = (),
) -> core.ClosedJaxpr:
    """Return equations as a program, whose `constants` are variables and their values; `like` says where it is from."""
    known = [variable for variable, _ in constants]
    about = like.debug_info.with_unknown_names()  # JAX warns of programs without
    jaxpr = core.Jaxpr(known, list(inputs), list(outputs), list(equations), debug_info=about)
    return core.ClosedJaxpr(jaxpr, [value for _, value in constants])


def devices_have_begun() -> bool:
    """Return whether JAX has started its devices in this process."""
    return xla_bridge.backends_are_initialized()


def settings() -> Mapping[str, object]:
    """Return all of JAX's settings by name, as they hold for the whole process."""
    values: Mapping[str, object] = jax.config.values
    return values


def outside_of_xlas_cache() -> AbstractContextManager[None]:
    """Have XLA's cache store none of the programs that this thread compiles: none takes long enough to be worth it."""
    within: Callable[[float], AbstractContextManager[None]] = config.persistent_cache_min_compile_time_secs
    return within(float("inf"))


def as_one_kernel(program: core.ClosedJaxpr) -> Callable[..., list[Array]]:
    """Return a program as a function that XLA:CPU compiles as a single kernel; it is not traced once more."""

    def kernel(value: Array) -> Array:
        return value

    def call(*arguments: Array) -> list[Array]:
        (like,) = jax.make_jaxpr(jax.jit(kernel))(0.0).eqns
        counts = {"in": len(program.in_avals), "out": len(program.out_avals)}
        each = {  # of an argument or a result
            name: value * counts["out" if name.startswith("out") else "in"]
            for name, value in like.params.items()
            if isinstance(value, tuple) and len(value) == 1
        }
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return carried_out(like.primitive, like.params | each | {"jaxpr": program}, arguments)

    return call


def launched(ptx: str, name: str, blocks: int, threads: int, made: jax.ShapeDtypeStruct, *arguments: Array) -> Array:
    """Return the results of a kernel in PTX, launched on a GPU with `blocks` of `threads`."""
    launch = {"grid_x": blocks, "block_x": threads, "shared_mem_bytes": 0}
    launch |= dict.fromkeys(("grid_y", "grid_z", "block_y", "block_z"), 1)
    numbers = {name: np.int32(number) for name, number in launch.items()}
    return jax.ffi.ffi_call(LAUNCH, made)(*arguments, name=name, kernel_type="ptx", kernel_data=ptx, **numbers)
