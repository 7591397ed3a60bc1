"""Kernels in CUDA C, built by the machine's C++ compiler and run on the CPU, a thread for each lane, against XLA."""

import ctypes
import dataclasses
import functools
import itertools
import math
import re
import shutil
import subprocess
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jaxtyping import Float

from mjx_climb.control import law_of
from mjx_climb.execution import of_limbs
from mjx_climb.execution.adjoint import with_gradients
from mjx_climb.execution.cuda_writer import FUNCTIONS, READ, expression, literal, typed
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.flat import tangents_of
from mjx_climb.execution.gpu_kernel import body_of, side_by_side, written
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.walk.structure import structure
from mjx_climb.walks import metrics_of
from tests.execution import primitives
from tests.execution.test_adjoint import motion

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
STEPS = 120
ONE_WALK = np.ones(2, np.int32)  # of a robot in a direction


@pytest.fixture
def carried_out(tmp_path):
    """Give a function that builds kernels into a library, runs each, and returns its results by name.

    A kernel is what `written` returns, the values that its arguments are made of, rows of each first, the batch axes,
    and the results' shapes and types of one robot.
    """

    def carry_out(kernels):
        parts = [f'#include "{HERE / "on_cpu.hpp"}"']
        for name, ((text, _, threads), given, batch, _) in kernels.items():
            threads *= math.prod(batch)
            names = [f"argument_{place}" for place in range(len(given))]
            parameters = ", ".join(f"const int *{each}" for each in names)
            parts += [f"namespace in_{name} {{", text.replace('extern "C" ', ""), "}"]
            parts += [f'extern "C" void run_{name}({parameters}, int *made)']
            parts += [f"{{ run(in_{name}::walk, {threads}, {', '.join(names)}, made); }}"]
        (tmp_path / "kernels.cpp").write_text("\n".join(parts))
        command = ["c++", "-std=c++20", "-O1", "-w", "-shared", "-fPIC", "-pthread", "-o", "kernels.so", "kernels.cpp"]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
        library, results = ctypes.CDLL(str(tmp_path / "kernels.so")), {}
        for name, (kernel, arguments, batch, avals) in kernels.items():
            ends = np.cumsum([aval.size for aval in avals])
            made = np.zeros(kernel.words(ends[-1], math.prod(batch)), np.int32)
            read = [name for name in READ if f"int *__restrict__ {name}" in kernel.text]
            words = ([np.ascontiguousarray(value).reshape(-1).view(np.int32) for value in each] for each in arguments)
            columns = {"common": 1, "own": batch[0] if batch else 1, "along": math.prod(batch)}
            rows = [np.concatenate(each).reshape(-1, columns[name]) for name, each in zip(read, words, strict=True)]
            given = [
                *(r if of == "common" else np.array(side_by_side(r.T)) for of, r in zip(read, rows, strict=True)),
                made,
            ]
            getattr(library, f"run_{name}")(*(array.ctypes.data_as(ctypes.c_void_p) for array in given))
            found = made[: ends[-1] * math.prod(batch)].reshape(ends[-1], -1)
            results[name] = [
                (part != 0 if aval.dtype == bool else part.view(aval.dtype)).T.reshape((*batch, *aval.shape))
                for part, aval in zip(np.split(found, ends[:-1]), avals, strict=True)
            ]
        return results

    return carry_out


@pytest.mark.slow
def test_every_operation_in_cuda_c(carried_out):
    """All that kernels know, in single precision, but for what is of other types: to 1e-5, whole numbers the same."""
    rng, programs, kernels = np.random.default_rng(5), {}, {}
    vector, matrix = rng.uniform(-2.5, 2.5, 3).astype("f4"), rng.uniform(-2.5, 2.5, (4, 3)).astype("f4")
    number = np.int32(-2)
    with jax.enable_x64(False):
        for name, operation in primitives.KNOWN.items():
            program = jax.make_jaxpr(lambda v, m, n, f=operation: f(v, m * v[1], n))(vector, matrix, number)
            try:
                kernel = written(body_of(program), (True, False, True))
            except Unsupported as error:
                assert "int8" in str(error)
                continue
            name = name.replace(" ", "_")
            programs[name] = program
            given = [ONE_WALK, matrix], [vector, number]
            kernels[name] = kernel, given, (), program.out_avals
        assert len(kernels) >= len(primitives.KNOWN) - 1
        for name, found in carried_out(kernels).items():
            expected = jax.jit(jax.extend.core.jaxpr_as_fun(programs[name]))(vector, matrix, number)
            for mine, xla in zip(found, expected, strict=True):
                relative, absolute = (1e-5, 1e-6) if np.issubdtype(mine.dtype, np.floating) else (0, 0)
                np.testing.assert_allclose(mine, xla, rtol=relative, atol=absolute, err_msg=name)


CLOSES = {"contact.closing_time": 0.02, "contact.closing_force": 5.0, "contact.capture_distance": 0.004}
# every grip fails its test once LH has landed, and LF waits
WAITS = CLOSES | {"contact.kind": "uncertain", "contact.tested_pull": 20.0, "contact.tries": 1}


def short_walk(case, steps, changes=None, engine="limb"):
    """Return a robot's walk that lifts, lands and is pushed, as a function of its arguments, and these."""
    push = {"start": 0.01, "stop": 0.05, "force": [3.0, 0.0, 1.0], "moment": [0.0, 0.5, 0.0]}
    gait = {"gait.cycle": 0.4, "gait.stride": 0.005, "gait.step_height": 0.002}
    scenario = case("case_1_2", "virtual_model", {**gait, "disturbance.pushes": [push], **(changes or {})}.items())
    found = resolve_in(scenario, law_of(scenario), None, None, np.float32)
    shape = structure(scenario, engine, found.parameters, law=found.law)._replace(steps=steps)
    return functools.partial(metrics_of, shape), (found.law, found.parameters)


def doubled(value):
    return np.asarray(value, np.float64) if np.asarray(value).dtype.kind == "f" else value


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Limbs:
    """Values of four limbs."""

    OF_LIMBS = ("values",)
    values: Float[jax.Array, "limb n"]


def exchanges(step, size=1):
    """Return how often in a loop's step the lanes of a robot, one for each limb, ask each other.

    The step carries values of the limbs (4, size), a quaternion and a number ().
    """

    def function(start, quaternion):
        limbs = of_limbs(Limbs(start)).values
        return jax.lax.scan(lambda carry, _: (step(*carry), None), (limbs, quaternion, jnp.zeros(())), length=3)[0][2]

    with jax.enable_x64(False):
        program = jax.make_jaxpr(function)(np.ones((4, size), "f4"), np.ones(4, "f4"))
    text = written(body_of(program), (False, False)).text
    return text.split("#pragma unroll 1")[1].count("__shfl_")


def test_a_number_is_written_with_all_its_bits():
    """Infinities and NaN by their bits in IEEE 754."""
    for value in (np.inf, -np.inf, np.nan):
        (bits,) = re.fullmatch(r"__int_as_float\(0x([0-9a-f]{8})\)", literal(np.float32(value))).groups()
        np.testing.assert_array_equal(np.array(int(bits, 16), np.uint32).view(np.float32), np.float32(value))
    for value in np.random.default_rng(0).normal(size=20).astype(np.float32):
        (text,) = re.fullmatch(r"\((\S+)f\)", literal(value)).groups()
        assert np.float32(text) == value
    whole = np.int32(-7), np.uint32(7), np.bool_(True), np.bool_(False), np.int64(-(2**40)), np.uint64(7)
    texts = ["((int)-7)", "((unsigned)7u)", "true", "false", f"((long long)-{2**40}ll)", "((unsigned long long)7ull)"]
    assert [*map(literal, whole)] == texts


# Functions of C and of the device that the texts of operations call, and the exchange of bits.
OF_C = (
    'extern "C" { float ' + ", ".join(f"{name}f(float)" for name in (
        "acos acosh asin asinh atanh cbrt ceil cosh exp exp2 expm1 fabs floor log log1p log2 rint round sinh sqrt tanh"
    ).split()) + ", nextafterf(float, float), powf(float, float), fmodf(float, float), fminf(float, float), "
    "fmaxf(float, float), copysignf(float, float), fmaf(float, float, float); }\n"
    "#define __device__\n#define __forceinline__ inline\n"
    "static int __float_as_int(float v) { int w; __builtin_memcpy(&w, &v, 4); return w; }\n"
    "static float rsqrtf(float v) { return 1.0f / sqrtf(v); }\n"
)  # fmt: skip
NEAR = [0.0, -0.0, 1.0, -1.0, 0.4, -0.6, 2.5, -2.5, 3.7, 13.3, 3e38, np.inf, -np.inf, np.nan]
REALS = np.array([*itertools.product(NEAR, NEAR)], np.float32).T
WHOLES = np.array([*itertools.product([0, 1, -1, 2, -2, 7, -9, 31, 32, 2**31 - 1], [0, 1, 2, -3, 5, 31, 32, 40])]).T
WHOLES = WHOLES.astype(np.int32)
TURNS = np.array([[0.3, 0.8, 1.5, 2.4, 3.1, -4.0, 7.0, -50.3, 900.1, np.inf, np.nan]], np.float32)


def cut(low, x, high):
    """Return numbers within bounds; one that is none stays so."""
    return np.minimum(np.maximum(x, low), high)


def in_total_order(x, y):
    """Return the places of real numbers in IEEE 754's order of all, in which -0 is before 0 and a NaN at the end."""
    words = (each.view(np.int32).astype(np.int64) for each in (x, y))
    return [np.where(word < 0, -(word & 0x7FFFFFFF) - 1, word) for word in words]


def whole(function):
    """Return what a function of Python's whole numbers gives for each pair, in 32 bits."""

    def of(x, y):
        found = [function(int(a), int(b)) & 0xFFFFFFFF for a, b in zip(x, y, strict=True)]
        return np.array(found, np.uint32).view(np.int32)

    return of


def times(x, power):
    return functools.reduce(np.multiply, [x] * abs(power), np.ones_like(x))


# by the operation: the same in NumPy
OF_REALS = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "rem": np.fmod, "pow": np.power,
    "atan2": np.arctan2, "max": np.maximum, "min": np.minimum, "nextafter": np.nextafter,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "lt_to": lambda x, y: np.less(*in_total_order(x, y)), "le_to": lambda x, y: np.less_equal(*in_total_order(x, y)),
}  # fmt: skip
OF_A_REAL = {
    "abs": np.abs, "neg": np.negative, "square": np.square, "sign": np.sign, "sqrt": np.sqrt, "cbrt": np.cbrt,
    "rsqrt": lambda x: 1 / np.sqrt(x), "exp": np.exp, "exp2": np.exp2, "expm1": np.expm1, "log": np.log,
    "log1p": np.log1p, "log2": np.log2, "logistic": lambda x: 1 / (1 + np.exp(-x)), "ceil": np.ceil,
    "floor": np.floor, "acos": np.arccos, "acosh": np.arccosh, "asin": np.arcsin, "asinh": np.arcsinh,
    "atan": np.arctan, "atanh": np.arctanh, "cosh": np.cosh, "sinh": np.sinh, "tanh": np.tanh,
    "is_finite": np.isfinite, "one_minus_square": lambda x: 1 - x * x, "stop_gradient": np.positive,
}  # fmt: skip
OF_AN_ANGLE = {"sin": np.sin, "cos": np.cos, "tan": np.tan}
OF_WHOLES = {
    "add": whole(int.__add__), "sub": whole(int.__sub__), "mul": whole(int.__mul__),
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "max": np.maximum, "min": np.minimum,
    "div": whole(lambda a, b: abs(a) // abs(b) * (1 if a * b > 0 else -1) if b else -1),  # towards 0; XLA's of 0
    "rem": whole(lambda a, b: abs(a) % abs(b) * (1 if a > 0 else -1) if b else a),
    "shift_left": whole(lambda a, b: a << b if 0 <= b < 32 else 0),
    "shift_right_logical": whole(lambda a, b: (a & 0xFFFFFFFF) >> b if 0 <= b < 32 else 0),
    "shift_right_arithmetic": whole(lambda a, b: a >> (b if 0 <= b < 32 else 31)),
    "abs": lambda a, _: abs(a), "sign": lambda a, _: np.sign(a), "not": lambda a, _: ~a,
    "lt_to": lambda a, b: a < b, "le_to": lambda a, b: a <= b,
}  # fmt: skip


def test_each_operation_in_c_gives_what_it_gives_in_numpy(tmp_path):
    """At infinities, zeros of both signs, beyond the bits of a word; a NaN stays on either side of an extreme."""
    nearest, away = lax.RoundingMethod.TO_NEAREST_EVEN, lax.RoundingMethod.AWAY_FROM_ZERO
    third = REALS[0][::-1]
    cases = [(name, {}, each, REALS[: each.nin if hasattr(each, "nin") else 2]) for name, each in OF_REALS.items()]
    cases += [(name, {}, each, REALS[:1]) for name, each in OF_A_REAL.items()]
    cases += [(name, {}, each, TURNS) for name, each in OF_AN_ANGLE.items()]
    cases += [(name, {}, each, WHOLES) for name, each in OF_WHOLES.items()]
    cases += [("clamp", {}, cut, (*REALS, third)), ("clamp", {}, cut, (WHOLES[1], WHOLES[0], WHOLES[1] + 9))]
    cases += [("integer_pow", {"y": y}, lambda x, y=y: 1 / times(x, y) if y < 0 else times(x, y), REALS[:1])
              for y in (-3, -1, 0, 1, 2, 5)]  # fmt: skip
    cases += [("pow", {}, lambda x, y: x ** np.float32(y), (REALS[0][:8], np.arange(8, dtype=np.int32)))]
    cases += [("round", {"rounding_method": nearest}, np.round, REALS[:1])]
    cases += [("round", {"rounding_method": away}, lambda x: np.copysign(np.floor(abs(x) + 0.5), x), REALS[:1])]
    cases += [("convert_element_type", {"new_dtype": np.dtype(new)}, lambda x, new=new: x.astype(new), REALS[:1, :140])
              for new in (np.bool_, np.float32)]  # fmt: skip
    cases += [("convert_element_type", {"new_dtype": np.dtype(np.float32)}, np.float32, WHOLES[:1])]
    cases += [("select_n", {}, lambda w, x, y: np.where(w, y, x), (REALS[0] > 0, *REALS)),
              ("select_n", {}, lambda w, *of: np.choose(np.clip(w, 0, 2), of),
               (np.arange(196, dtype=np.int32) % 3, *REALS, third)),
              ("not", {}, np.logical_not, (REALS[0] > 0,))]  # fmt: skip
    parts, given = [OF_C, FUNCTIONS], []
    for place, (name, parameters, function, operands) in enumerate(cases):
        operands = [np.ascontiguousarray(each) for each in operands]
        with np.errstate(all="ignore"):
            expected = np.asarray(function(*operands))
        names = [f"a{n}[i]" for n in range(len(operands))]
        text = expression(name, parameters, [each[0] for each in operands], names)
        kinds = [typed(each.dtype) for each in operands]
        of = "".join(f"const {kind} *a{n}, " for n, kind in enumerate(kinds))
        result = np.empty(len(expected), bool if expected.dtype == bool else operands[-1].dtype)
        result = result.astype(parameters.get("new_dtype", result.dtype)) if name != "pow" else result.astype("f4")
        parts += [f'extern "C" void of_{place}({of}{typed(result.dtype)} *made) '
                  f"{{ for (int i = 0; i < {len(expected)}; ++i) made[i] = {text}; }}"]  # fmt: skip
        given.append((f"{name} {text}", [*operands, result], expected))
    (tmp_path / "all.cpp").write_text("\n".join(parts))
    command = ["c++", "-w", "-shared", "-fPIC", "-o", "all.so", "all.cpp"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    library = ctypes.CDLL(str(tmp_path / "all.so"))
    for place, (name, arrays, expected) in enumerate(given):
        getattr(library, f"of_{place}")(*(each.ctypes.data_as(ctypes.c_void_p) for each in arrays))
        np.testing.assert_allclose(arrays[-1], expected, rtol=2e-5, atol=2e-6, err_msg=name)


def test_a_sum_over_joints_and_limbs_is_first_of_each_limbs_own():
    """Two exchanges are a sum over four lanes."""
    assert exchanges(lambda limbs, q, total: (jnp.sin(limbs), q, total + limbs.sum((0, 1))), 3) == 2
    assert exchanges(lambda limbs, q, total: (jnp.sin(limbs), q, total + limbs.sum(0).sum(0)), 3) == 3 * 2


def test_limbs_in_two_other_orders_take_an_exchange_each():
    turned = lambda limbs: limbs[::-1] * jnp.roll(jnp.sin(limbs), 1, axis=0)  # noqa: E731
    assert exchanges(lambda limbs, q, total: (turned(limbs), q, total + limbs.sum())) == 2 + 2


def test_a_quaternion_is_no_four_limbs():
    """A loop leaves it in all lanes, where the step takes it apart."""

    def turned(limbs, quaternion, total):
        w, x, y, z = quaternion
        return jnp.sin(limbs), jnp.stack([w * 0.9, x + w, y - x, z * z]), total + w

    assert exchanges(turned) == 0


def test_lanes_share_a_matrix_times_a_vector_out():
    """Each reads and multiplies a quarter: columns of the limbs' own numbers, then rows of numbers that all have."""

    def function(start, inner, output):
        limbs = of_limbs(Limbs(start)).values
        step = lambda limbs, _: (jnp.sin(limbs + (output @ (inner @ limbs.ravel())).reshape(4, 3)), None)  # noqa: E731
        return jax.lax.scan(step, limbs, length=3)[0]

    with jax.enable_x64(False):
        given = [np.ones(shape, "f4") for shape in ((4, 3), (8, 12), (12, 8))]
        text = written(body_of(jax.make_jaxpr(function)(*given)), (0, 1, 1)).text
    step = text.split("#pragma unroll 1")[1].split("\n}\n")[0]
    assert text.count("(&own[") == step.count(" * ") == (8 * 12 + 12 * 8) / 4
    assert step.count("__shfl_") == 2 * 8


def test_words_of_robots_stand_side_by_side():
    """As a kernel finds them: a row of 32 robots, behind it their next row."""
    words = np.arange(40 * 3, dtype=np.int32).reshape(40, 3)
    found, side = np.asarray(side_by_side(words)).reshape(-1), 32
    for robot, row in ((0, 0), (31, 2), (32, 0), (39, 1)):
        assert found[robot // side * 3 * side + side * row + robot % side] == words[robot, row]


@pytest.mark.parametrize(("count", "row"), [(4, "lane"), (3, "(lane < 3 ? lane : 0)")])
def test_a_lane_reads_rows_of_its_own_and_one_beyond_the_limbs_the_firsts(count, row):
    def function(start, inner):
        limbs = of_limbs(Limbs(start)).values
        return jax.lax.scan(lambda x, _: (jnp.sin(x) + (inner @ x.ravel()).sum(), None), limbs, length=3)[0]

    with jax.enable_x64(False):
        program = jax.make_jaxpr(function)(np.ones((count, 3), "f4"), np.ones((count, 3 * count), "f4"))
        text = written(body_of(program), (0, 1)).text
    reads = re.findall(r"\(&own\[32 \* \d+ \* (.+?)\]\)", text)
    assert len(reads) == 3 * count and {*reads} == {row}


def test_what_nothing_is_made_of_is_not_written():
    """NVIDIA's compiler keeps exchanges that nothing reads."""

    def summed(limbs, quaternion, total):
        jnp.cos(limbs).sum()
        return jnp.sin(limbs), quaternion, total + limbs.sum()

    assert exchanges(summed) == 2


def test_a_long_branch_is_taken_by_the_threads_of_a_warp_together():
    """A robot that does not take it while another does keeps its own values."""

    def function(number):
        long = lambda a: jax.lax.fori_loop(0, 3, lambda _, b: jnp.sin(b), a)  # noqa: E731
        return jax.lax.cond(number > 0, long, jnp.cos, number), jax.lax.cond(number > 0, jnp.tanh, jnp.exp, number)

    with jax.enable_x64(False):
        text = written(body_of(jax.make_jaxpr(function)(np.float32(1))), (True,)).text
    before, inside = text[text.index("extern") :].split("if (__any_sync(")
    inside, after = inside.split("\n}\n")[0], inside.split("\n}\n")[1:]
    assert "sine(" in inside
    assert "cosine(" in before
    assert not any(other in inside for other in ("cosine(", "tanhf(", "expf("))
    assert "?" in after[0]


def test_a_loop_in_a_loop_reads_rows_of_an_argument_from_memory():
    """Rows of the outer loop's row: a thread would keep them all in an array of its own."""

    def function(table, number):
        inner = lambda carry, row: (sum(jnp.sin(carry * k) for k in range(200)) + row[1], None)  # noqa: E731
        return jax.lax.scan(lambda carry, rows: (jax.lax.scan(inner, carry, rows)[0], None), number, table)[0]

    with jax.enable_x64(False):
        text = written(body_of(jax.make_jaxpr(function)(np.ones((5, 7, 2), "f4"), np.float32(1))), (True, False)).text
    outer, inner = re.findall(r"for \(int (t\d+) = 0; \1 < [57];", text)
    assert f"own[32 * (14 * {outer} + 1 + 2 * {inner})]" in text
    assert not re.search(r"const \S+ v\d+\[", text)


@pytest.mark.slow
@pytest.mark.timing
def test_four_times_the_steps_are_written_in_a_few_times_the_time():
    """A loop that reads rows of an argument takes it apart once, not again in each step."""

    def seconds(steps):
        walk = lambda rows: jax.lax.scan(lambda total, row: (total + row.sum(), None), 0.0, rows)[0]  # noqa: E731
        program = jax.make_jaxpr(walk)(jax.ShapeDtypeStruct((steps, 12), np.float32))
        body, begin = body_of(program), time.process_time()
        written(body, (1,))
        return time.process_time() - begin

    seconds(500)
    assert seconds(4000) < 8 * seconds(1000)


def test_directions_share_what_is_of_their_robot(carried_out):
    """Values of all, of each robot and of each direction meet in the tangents, in two loops.

    In four lanes, and in three: the fourth does what the first does.
    """
    rng, robots, directions, scale = np.random.default_rng(2), 2, 3, np.float32(0.7)
    table, kernels, expected = rng.normal(size=(robots, 5, 1)).astype("f4"), {}, {}

    def function(limbs, table, scale):
        def step(limbs, row):
            return of_limbs(Limbs(jnp.sin(limbs * scale) + row * limbs[::-1] + limbs.sum())).values, None

        return jax.lax.scan(step, of_limbs(Limbs(limbs)).values, table)[0]

    def by_numpy(limbs, table, rate):
        for row in table:
            turned = np.cos(limbs * scale) * scale * rate
            limbs, rate = (np.sin(limbs * scale) + row * limbs[::-1] + limbs.sum(),
                           turned + row * rate[::-1] + rate.sum())  # fmt: skip
        return limbs, rate

    with jax.enable_x64(False):
        for count in (4, 3):
            limbs = rng.normal(size=(robots, count, 1)).astype("f4")
            along = rng.normal(size=(robots, directions, count, 1)).astype("f4")
            both, _ = tangents_of(jax.make_jaxpr(function)(limbs[0], table[0], scale), [True, False, False])
            kernel, batch = written(body_of(both), (1, 1, 0, 2)), (robots, directions)
            assert kernel.text.count("const int *__restrict__") == 3
            columns = [
                each.reshape(math.prod(each.shape[:of]), -1).T for each, of in ((limbs, 1), (table, 1), (along, 2))
            ]
            given = [np.array(batch, np.int32), scale], columns[:2], columns[2:]
            kernels[f"of_{count}"] = kernel, given, batch, both.out_avals
            expected[f"of_{count}"] = [
                [
                    by_numpy(*(each.astype(float) for each in (limbs[robot], table[robot], rate)))
                    for rate in along[robot]
                ]
                for robot in range(robots)
            ]
        found = carried_out(kernels)
    for name, exact in expected.items():
        for part, mine in enumerate(found[name]):
            theirs = np.array([[each[part] for each in row] for row in exact])
            np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4 * abs(theirs).max())


@pytest.mark.nightly
@pytest.mark.parametrize("changes", [{}, CLOSES, WAITS], ids=["at once", "closing", "waiting"])
def test_a_walk_in_cuda_c(carried_out, case, changes):
    """Metrics of a walk in single precision, by a thread for each limb, agree with XLA's in float64 to 1e-4.

    Grips that close and gaits that wait for them are carried out by the same kernel, with no other path.
    """
    with jax.enable_x64(False):
        walk, given = short_walk(case, STEPS, changes)
        found = of_one(carried_out, walk, given)
    expected = jax.jit(walk)(*jax.tree.map(doubled, given))
    assert expected["force_variation"].dtype == np.float64
    assert expected["force_variation"] > 0.1
    for name, mine in zip(sorted(expected), found, strict=True):
        # a pull is what is left of a foot's force along the normal, and has the rounding of that whole force
        rounding = 1e-4 * float(expected["peak_foot_force"]) if name == "peak_pull_force" else 1e-5
        np.testing.assert_allclose(mine, expected[name], rtol=1e-4, atol=rounding, err_msg=name)


@pytest.mark.nightly
def test_a_walk_by_mjx_in_cuda_c(carried_out, case):
    """It factors and solves its inertia in the kernel."""
    with jax.enable_x64(False):
        walk, given = short_walk(case, 40, engine="mjx")
        found = of_one(carried_out, walk, given)
    expected = jax.jit(walk)(*jax.tree.map(doubled, given))
    for name, mine in zip(sorted(expected), found, strict=True):
        rounding = 1e-3 * float(expected["peak_foot_force"]) if name == "peak_pull_force" else 1e-4
        np.testing.assert_allclose(mine, expected[name], rtol=1e-3, atol=rounding, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [30, 300])
def test_gradients_in_cuda_c(carried_out, steps):
    """Loops keep their carried values, each lane its own, and read them backwards: to 1e-4 of JAX's in float64.

    With two levels of checkpoints a long step is a function: NVIDIA's assembler does not end at one in two loops.
    """
    walk, (gains, starts, targets) = motion(steps)
    robots, sums, rng = len(gains), 2, np.random.default_rng(3)
    weights = {name: rng.normal(size=(robots, sums)) for name in ("end", "work")}
    single = [np.asarray(value, np.float32) for value in (gains, starts, targets, weights["end"], weights["work"])]
    with jax.enable_x64(False):
        program = jax.make_jaxpr(walk)(single[0][0], single[1][0], single[2])
        weighed = tuple(name in weights for name in ("count", "end", "largest", "work"))
        both = with_gradients(program, (True, True, False), weighed, values=True)
        kernel = written(body_of(both), (1, 1, 0, 2, 2))
        columns = [each.reshape(robots * (sums if place > 2 else 1), -1).T for place, each in enumerate(single)]
        given = [np.array([robots, sums], np.int32), single[2]], columns[:2], columns[3:]
        found = carried_out({"kernel": (kernel, given, (robots, sums), both.out_avals)})["kernel"]
    assert kernel.kept > steps
    assert kernel.text.count("noinline") == (steps == 300)

    def one(gain, start, weights):
        _, pull_back = jax.vjp(lambda *of: {n: walk(*of, targets)[n] for n in weights}, gain, start)
        return jax.vmap(pull_back)(weights)

    for mine, jaxs in zip(found[-2:], jax.jit(jax.vmap(one))(gains, starts, weights), strict=True):
        np.testing.assert_allclose(mine, jaxs, rtol=1e-3, atol=1e-4 * abs(jaxs).max())


@pytest.mark.slow
def test_gradients_of_more_numbers_than_registers_in_cuda_c(carried_out):
    """Their sums stand in memory and arguments are read where they are used: a quarter of each by each lane."""
    rng, steps = np.random.default_rng(4), 300
    inner, output = rng.normal(size=(22, 12)).astype("f4"), rng.normal(size=(4, 23)).astype("f4")
    start = rng.normal(size=(4, 3)).astype("f4")

    def walk(inner, output, start):
        def step(limbs, _):
            for _ in range(8):
                limbs = jnp.sin(1.2 * limbs + 0.1 * limbs.sum())
            seen = jnp.tanh(inner @ limbs.ravel())
            pull = output[:, :22] @ seen + output[:, 22]
            return 0.9 * limbs + 0.01 * pull[:, None], None

        return {"end": jax.lax.scan(step, of_limbs(Limbs(start)).values, length=steps)[0].sum()}

    with jax.enable_x64(False):
        program = jax.make_jaxpr(walk)(inner, output, start)
        both = with_gradients(program, (True, True, False), (True,), values=False)
        kernel = written(body_of(both), (1, 1, 0, 2))
        columns = [inner.reshape(-1, 1), output.reshape(-1, 1)]
        given = [np.array([1, 1], np.int32), start], columns, [np.ones((1, 1), "f4")]
        found = carried_out({"kernel": (kernel, given, (1, 1), both.out_avals)})["kernel"]
    assert kernel.text.count("atomicAdd((float *)&kept") == 2 * (22 * 12 + 4 * 23) // 4  # in two loops
    assert 3 * (22 * 12 + 4 * 22) // 4 < kernel.text.count("again(&") < 22 * 12 + 4 * 23
    assert "const auto step_" in kernel.text
    # to a compiler that knows no better an addition waits for its result
    writing = [part.split("\n};\n")[0] for part in kernel.text.split("noinline")[1:] if "atomicAdd" in part]
    assert writing and all("__isGlobal(kept)" in function for function in writing)
    doubles = [jnp.asarray(each, float) for each in (inner, output, start)]
    expected = jax.grad(lambda *given: walk(*given)["end"], (0, 1))(*doubles)
    for mine, jaxs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine[0, 0], jaxs, rtol=1e-3, atol=1e-4 * abs(jaxs).max())


def test_a_walk_alone_reads_its_arguments_once():
    """However many they are: before its loop, where a gradient reads them in each step."""

    def walk(weights, start):
        return jax.lax.scan(lambda v, _: (jnp.sin(weights * v).sum(), None), start, length=3)[0]

    with jax.enable_x64(False):
        program = jax.make_jaxpr(walk)(np.ones(300, "f4"), np.float32(1))
        text = written(body_of(program), (1, 1)).text
    assert "again(&" not in text
    assert text.rindex("own[") < text.index("#pragma unroll 1")


def test_threads_wait_for_each_other_where_all_of_a_block_are():
    """In the long step of a loop in a loop, not in one within a branch that a warp takes alone."""

    def walk(angle, *, alone):
        inner = lambda v, _: (functools.reduce(lambda v, _: jnp.sin(1.2 * v), range(200), v), None)  # noqa: E731
        turned = lambda v: jax.lax.scan(inner, v, length=100)[0]  # noqa: E731
        outer = lambda v, _: (jax.lax.cond(v > 0, turned, lambda v: v, v) if alone else turned(v), None)  # noqa: E731
        return jax.lax.scan(outer, angle, length=100)[0]

    with jax.enable_x64(False):
        texts = [
            written(body_of(jax.make_jaxpr(functools.partial(walk, alone=alone))(np.float32(1))), (1,)).text
            for alone in (False, True)
        ]
    assert all("noinline" in text for text in texts)
    assert [text.count("__syncthreads") for text in texts] == [1, 0]
    assert all("__launch_bounds__(128, 2)" in text for text in texts)


def test_each_number_that_a_loop_writes_has_a_row_of_its_own_at_each_step():
    """Where it is read behind the loop; a kernel without functions leaves registers to its threads."""
    step = lambda x, _: (jnp.sin(x), (2 * x, jnp.cos(x), 3 * x))  # noqa: E731
    with jax.enable_x64(False):
        program = jax.make_jaxpr(lambda x: jax.lax.scan(step, x, length=70)[1])(np.float32(1))
        kernel = written(body_of(program), (1,))
    places = re.findall(r"__stcg\(&kept\[32 \* \((\d+) \+ (\d+) \* t\d+\)\]", kernel.text)
    rows = [int(first) + int(each) * time for first, each in places for time in range(70)]
    assert len(places) == 3 and sorted(rows) == [*range(kernel.kept)] == [*range(210)]
    results = re.findall(r"__ldcg\(&kept\[32 \* (\d+)\]\)", kernel.text)
    assert [*map(int, results)] == rows
    assert "__launch_bounds__(128)" in kernel.text


def test_a_loop_of_loops_keeps_what_it_carries():
    """Not what each step of all inner ones computes: 20 values, and four in each step of one inner loop."""
    inner = lambda v, _: (jnp.sin(v) * jnp.cos(v), None)  # noqa: E731
    outer = lambda v, _: (jax.lax.scan(inner, v, length=100)[0], None)  # noqa: E731
    with jax.enable_x64(False):
        program = jax.make_jaxpr(lambda v: {"end": jax.lax.scan(outer, v, length=20)[0]})(np.float32(1))
        kernel = written(body_of(with_gradients(program, (True,), (True,), values=False)), (1, 1))
    assert kernel.kept <= 20 + 4 * 100


def test_derivatives_add_no_zeros():
    """The derivative of a slice is 0 elsewhere, and those of three slices are added."""
    with jax.enable_x64(False):
        gradient = jax.make_jaxpr(jax.grad(lambda v: jnp.sin(v[0]) * v[1] + v[2]))(np.ones(3, "f4"))
        text = written(body_of(gradient), (1,)).text
    assert "0.0f" not in text[text.index("extern") :]


def of_one(carried_out, function, given, moving=0):
    """Return the results of one robot's function, and their tangents along as many of its first leaves, themselves."""
    program, leaves = jax.make_jaxpr(function)(*given), jax.tree.leaves(given)
    if moving:
        program, moved = tangents_of(program, [place < moving for place in range(len(leaves))])
        leaves += leaves[:moving]
    body = body_of(program)
    kernel = written(body, (False,) * len(leaves))
    found = carried_out({"kernel": (kernel, [[ONE_WALK, *leaves]], (), program.out_avals)})["kernel"]
    return (found, moved) if moving else found


@pytest.mark.nightly
def test_tangents_of_a_walk_in_cuda_c(carried_out, case):
    """Single precision tangents by the logarithm of the damping agree with central differences in float64 to 1e-3."""
    with jax.enable_x64(False):
        # two steps later the largest torques of two instants are as one to single precision
        walk, (law, numbers) = short_walk(case, STEPS - 5)
        damped = lambda damping, law, numbers: walk(dataclasses.replace(law, damping=damping), numbers)  # noqa: E731
        found, moved = of_one(carried_out, damped, (law.damping, law, numbers), moving=1)
    step = 1e-4
    law, numbers = jax.tree.map(np.float64, (law, numbers))
    sides = law.damping * np.array([[1 + step], [1 - step]])
    both = jax.vmap(lambda damping: damped(damping, law, numbers))
    expected = jax.jit(both, compiler_options={"xla_disable_hlo_passes": "fusion"})(sides)
    tangents = iter(found[len(expected) :])
    for name, moves in zip(sorted(expected), moved, strict=True):
        more, less = expected[name]
        tangent = next(tangents) if moves else np.zeros(more.shape)
        if np.issubdtype(more.dtype, np.floating):
            difference = np.nan_to_num((more - less) / (2 * step))  # nobody is torn off: not a number
            np.testing.assert_allclose(tangent, difference, rtol=1e-3, atol=1e-7, err_msg=name)
    assert next(tangents, None) is None


@pytest.mark.nightly
def test_gradients_of_a_walk_in_cuda_c(carried_out, case):
    """Of two metrics, by damping and mass, in single precision, against forward mode in float64 to 1e-3."""
    names = ("base_deviation", "force_variation")
    with jax.enable_x64(False):
        walk, (law, numbers) = short_walk(case, STEPS - 5)
        moved = lambda moving, law, numbers: walk(  # noqa: E731
            dataclasses.replace(law, damping=moving["damping"]), numbers.replace({"mass_scale": moving["mass"]})
        )
        moving = {"damping": law.damping, "mass": np.float32(1.0)}
        program, shape = jax.make_jaxpr(moved, return_shape=True)(moving, law, numbers)
        leaves = jax.tree.leaves((moving, law, numbers))
        moves, weighed = (
            tuple(place < 2 for place in range(len(leaves))),
            tuple(name in names for name in sorted(shape)),
        )
        both = with_gradients(program, moves, weighed, values=True)
        kernel, batch = written(body_of(both), (*[0] * len(leaves), 2, 2)), (1, 2)
        given = [[np.array(batch, np.int32), *leaves], [*np.eye(2, dtype="f4")]]
        found = carried_out({"kernel": (kernel, given, batch, both.out_avals)})["kernel"]
    law, numbers, moving = jax.tree.map(np.float64, (law, numbers, moving))
    slopes = jax.jacfwd(lambda moving: {name: moved(moving, law, numbers)[name] for name in names})
    expected = jax.jit(slopes, compiler_options={"xla_disable_hlo_passes": "fusion"})(moving)
    for row, name in enumerate(names):
        for mine, place in zip(found[-2:], ("damping", "mass"), strict=True):
            exact = np.asarray(expected[name][place])
            np.testing.assert_allclose(mine[0, row], exact, rtol=2e-3, atol=2e-3 * abs(exact).max(), err_msg=name)
