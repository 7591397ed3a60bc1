"""JAX's elementwise operations in CUDA C, in single precision.

Divisions and square roots are good to two units in the last place, as `nvrtc.OPTIONS` ask for. Sine, cosine and
arctangent are written out here: CUDA's own carry code for arguments beyond 1e5, longer than all the rest of a walk.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax import lax

from mjx_climb.execution.elements import Number, Unsupported

TYPES = {
    "bool": "bool",
    "int32": "int",
    "uint32": "unsigned",
    "int64": "long long",
    "uint64": "unsigned long long",
    "float32": "float",
}

# Sine and cosine by the nearest quarter turn, of which pi/2 is taken away in two parts, and the polynomials of the
# Cephes library; arctangent by a polynomial of odd powers, fitted on 0 to 1.
FUNCTIONS = """
__device__ __forceinline__ float to_quarter(float x, int &quarter) {
  float turns = rintf(x * 0.636619772367581f);
  quarter = (int)turns;
  float rest = fmaf(turns, 4.37113900018624283e-8f, fmaf(turns, -1.5707963705062866f, x));
  return fminf(fmaxf(rest, -0.8f), 0.8f) + (x - x);
}
__device__ __forceinline__ float sine_near(float r) {
  float z = r * r;
  return fmaf(fmaf(fmaf(-1.9515295891e-4f, z, 8.3321608736e-3f), z, -1.6666654611e-1f) * z, r, r);
}
__device__ __forceinline__ float cosine_near(float r) {
  float z = r * r;
  float p = fmaf(fmaf(2.443315711809948e-5f, z, -1.388731625493765e-3f), z, 4.166664568298827e-2f);
  return fmaf(p * z, z, fmaf(-0.5f, z, 1.0f));
}
__device__ __forceinline__ float sine(float x) {
  int quarter;
  float r = to_quarter(x, quarter), s = sine_near(r), c = cosine_near(r), v = (quarter & 1) ? c : s;
  return (quarter & 2) ? -v : v;
}
__device__ __forceinline__ float cosine(float x) {
  int quarter;
  float r = to_quarter(x, quarter), s = sine_near(r), c = cosine_near(r), v = (quarter & 1) ? s : c;
  return ((quarter + 1) & 2) ? -v : v;
}
__device__ __forceinline__ float arctangent(float y, float x) {
  float ax = fabsf(x), ay = fabsf(y), most = fmaxf(ax, ay), least = fminf(ax, ay);
  float t = most == 0.0f ? 0.0f : least == most ? 1.0f : least / most, z = t * t;
  float p = fmaf(2.78569828e-3f, z, -1.58660226e-2f);
  p = fmaf(p, z, 4.24722321e-2f);
  p = fmaf(p, z, -7.49753043e-2f);
  p = fmaf(p, z, 1.06448799e-1f);
  p = fmaf(p, z, -1.42070308e-1f);
  p = fmaf(p, z, 1.99934542e-1f);
  p = fmaf(p, z, -3.33331466e-1f);
  float r = fmaf(p * z, t, t);
  r = ay > ax ? 1.57079632679f - r : r;
  r = __float_as_int(x) < 0 ? 3.14159265359f - r : r;
  return (x != x || y != y) ? x + y : copysignf(r, y);
}
__device__ __forceinline__ float larger(float a, float b) { return (a >= b || a != a) ? a : b; }
__device__ __forceinline__ float smaller(float a, float b) { return (a <= b || a != a) ? a : b; }
template <int N> __device__ __forceinline__ float to_power(float x) {
  float half = to_power<N / 2>(x);
  return (N & 1) ? half * half * x : half * half;
}
template <> __device__ __forceinline__ float to_power<0>(float x) { return 1.0f; }
"""

_PLAIN = {
    "add": "{0} + {1}", "add_any": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "neg": "-{0}",
    "square": "{0} * {0}", "eq": "{0} == {1}", "ne": "{0} != {1}", "lt": "{0} < {1}", "le": "{0} <= {1}",
    "gt": "{0} > {1}", "ge": "{0} >= {1}", "and": "{0} & {1}", "or": "{0} | {1}", "xor": "{0} ^ {1}",
    "stop_gradient": "{0}",
}  # fmt: skip
_REAL = {
    "abs": "fabsf({0})", "acos": "acosf({0})", "acosh": "acoshf({0})", "asin": "asinf({0})", "asinh": "asinhf({0})",
    "atan": "arctangent({0}, 1.0f)", "atan2": "arctangent({0}, {1})", "atanh": "atanhf({0})", "cbrt": "cbrtf({0})",
    "ceil": "ceilf({0})", "clamp": "smaller(larger({0}, {1}), {2})", "cos": "cosine({0})", "cosh": "coshf({0})",
    "div": "{0} / {1}", "erf_inv": "erfinvf({0})", "exp": "expf({0})", "exp2": "exp2f({0})", "expm1": "expm1f({0})",
    "floor": "floorf({0})", "is_finite": "fabsf({0}) <= 3.40282347e38f", "log": "logf({0})", "log1p": "log1pf({0})",
    "log2": "log2f({0})", "one_minus_square": "(1.0f - {0}) * (1.0f + {0})",
    "logistic": "1.0f / (1.0f + expf(-{0}))", "max": "larger({0}, {1})", "min": "smaller({0}, {1})",
    "nextafter": "nextafterf({0}, {1})", "pow": "powf({0}, {1})", "rem": "fmodf({0}, {1})",
    "rsqrt": "rsqrtf({0})", "sign": "({0} > 0.0f) ? 1.0f : ({0} < 0.0f) ? -1.0f : {0}",
    "sin": "sine({0})", "sinh": "sinhf({0})", "sqrt": "sqrtf({0})", "tan": "sine({0}) / cosine({0})",
    "tanh": "tanhf({0})",
}  # fmt: skip
_WHOLE = {
    "abs": "({0} < 0) ? -{0} : {0}", "clamp": "({1} < {0}) ? {0} : (({1} > {2}) ? {2} : {1})",
    "div": "({1} == 0) ? -1 : {0} / {1}", "max": "({0} >= {1}) ? {0} : {1}",
    "min": "({0} <= {1}) ? {0} : {1}", "not": "~{0}",
    "rem": "({1} == 0) ? {0} : {0} % {1}", "sign": "({0} > 0) - ({0} < 0)",
    "shift_left": "((unsigned){1} < 32u) ? {0} << {1} : 0",
    "shift_right_arithmetic": "(int){0} >> (((unsigned){1} < 32u) ? (int){1} : 31)",
    "shift_right_logical": "((unsigned){1} < 32u) ? (unsigned){0} >> {1} : 0u",
}  # fmt: skip
_ONE_WORD = frozenset({"shift_left", "shift_right_arithmetic", "shift_right_logical"})
_COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "is_finite"})


def typed(dtype: Any) -> str:
    """Return the name of a type in CUDA C."""
    if (name := TYPES.get(np.dtype(dtype).name)) is None:
        raise Unsupported(f"numbers of type {dtype}")
    return name


def literal(number: np.generic) -> str:
    """Return a known number in CUDA C, exactly."""
    kind = typed(number.dtype)
    if number.dtype == bool:
        return "true" if number else "false"
    if number.dtype.kind in "iu":
        return f"(({kind}){int(number)}{'u' if number.dtype.kind == 'u' else ''}{'ll' if number.itemsize > 4 else ''})"
    value = float(number)
    if np.isnan(value):
        return "__int_as_float(0x7fffffff)"
    if np.isinf(value):
        return f"__int_as_float({'0x7f800000' if value > 0 else '0xff800000'})"
    return f"({value!r}f)"


def expression(name: str, parameters: Mapping[str, Any], operands: Sequence[Number], names: Sequence[str]) -> str:
    """Return an elementwise operation of JAX's on operands of these names as an expression in CUDA C.

    Raises:
        Unsupported: an operation, or a use of it, that has none here.
    """
    dtype = operands[-1].dtype if name == "select_n" else operands[0].dtype
    real, truth = dtype.kind == "f", dtype.kind == "b"
    if name in _SPECIAL:
        return _SPECIAL[name](parameters, operands, names)
    if name == "not" and truth:
        return f"!{names[0]}"
    if name in _ONE_WORD and dtype.itemsize != 4:
        raise Unsupported(f"the operation {name} on {dtype}")
    table = _PLAIN if name in _PLAIN else _REAL if real else _WHOLE
    if name not in table:
        raise Unsupported(f"the operation {name} on {dtype}")
    if name == "pow" and operands[1].dtype.kind != "f":
        names = [names[0], f"(float){names[1]}"]
    return table[name].format(*names)


def type_of(name: str, parameters: Mapping[str, Any], operands: Sequence[Number]) -> np.dtype:
    """Return the type of an operation's result."""
    if name in _COMPARISONS:
        return np.dtype(bool)
    converts, place = name == "convert_element_type", int(name in ("select_n", "clamp"))
    found: np.dtype = parameters["new_dtype"] if converts else operands[place].dtype
    return np.dtype(found)


def _choice(parameters: Mapping[str, Any], operands: Sequence[Number], names: Sequence[str]) -> str:
    which, *cases = names
    if operands[0].dtype == bool:
        return f"{which} ? {cases[1]} : {cases[0]}"
    chosen = cases[0]
    for number, case in enumerate(cases[1:], 1):
        chosen = f"({which} >= {number} ? {case} : {chosen})"
    return chosen


def _round(parameters: Mapping[str, Any], operands: Sequence[Number], names: Sequence[str]) -> str:
    even = parameters["rounding_method"] is lax.RoundingMethod.TO_NEAREST_EVEN
    return f"{'rintf' if even else 'roundf'}({names[0]})"


def _power(parameters: Mapping[str, Any], operands: Sequence[Number], names: Sequence[str]) -> str:
    if operands[0].dtype.kind != "f":
        raise Unsupported("the operation integer_pow on whole numbers")
    power = f"to_power<{abs(parameters['y'])}>({names[0]})"
    return power if parameters["y"] >= 0 else f"1.0f / {power}"


def _converted(parameters: Mapping[str, Any], operands: Sequence[Number], names: Sequence[str]) -> str:
    dtype = np.dtype(parameters["new_dtype"])
    return f"{names[0]} != 0" if dtype.kind == "b" else f"({typed(dtype)}){names[0]}"


_SPECIAL: dict[str, Callable[[Mapping[str, Any], Sequence[Number], Sequence[str]], str]] = {
    "select_n": _choice,
    "round": _round,
    "integer_pow": _power,
    "convert_element_type": _converted,
}
