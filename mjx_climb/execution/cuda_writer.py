"""A kernel as text in CUDA C, in single precision: a robot for each thread, or a limb of a robot.

Divisions and square roots are good to two units in the last place, as `gpu_kernel.OPTIONS` ask for. Sine, cosine and
arctangent are written out here: CUDA's own carry code for arguments beyond 1e5, longer than all the rest of a walk.
"""

import collections
import functools
import itertools
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jax import lax
from jax.extend import core
from numpy.typing import DTypeLike

from mjx_climb.execution.elements import Number, OfLane, Shared, Unsupported, Value, Writer
from mjx_climb.execution.jax_types import Parameters

TYPES = {
    "bool": "bool", "int32": "int", "uint32": "unsigned", "int64": "long long", "uint64": "unsigned long long",
    "float32": "float",
}  # fmt: skip

# Sine and cosine: the nearest quarter turn, pi/2, is taken away in two parts; then come the polynomials of the
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
__device__ __forceinline__ int ordered(float x) {
  int word = __float_as_int(x);
  return word ^ ((word >> 31) & 0x7fffffff);
}
__device__ __forceinline__ float larger(float a, float b) { return (a >= b || a != a) ? a : b; }
__device__ __forceinline__ float smaller(float a, float b) { return (a <= b || a != a) ? a : b; }
__device__ __forceinline__ int again(const int *word) {
#ifdef __CUDACC__
  int read;
  asm volatile("ld.global.nc.b32 %0, [%1];" : "=r"(read) : "l"(word));
  return read;
#else
  return *word;
#endif
}
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
    "floor": "floorf({0})", "le_to": "ordered({0}) <= ordered({1})", "lt_to": "ordered({0}) < ordered({1})",
    "is_finite": "fabsf({0}) <= 3.40282347e38f", "log": "logf({0})", "log1p": "log1pf({0})",
    "log2": "log2f({0})", "one_minus_square": "(1.0f - {0}) * (1.0f + {0})",
    "logistic": "1.0f / (1.0f + expf(-{0}))", "max": "larger({0}, {1})", "min": "smaller({0}, {1})",
    "nextafter": "nextafterf({0}, {1})", "pow": "powf({0}, {1})", "rem": "fmodf({0}, {1})",
    "rsqrt": "rsqrtf({0})", "sign": "({0} > 0.0f) ? 1.0f : ({0} < 0.0f) ? -1.0f : {0}",
    "sin": "sine({0})", "sinh": "sinhf({0})", "sqrt": "sqrtf({0})", "tan": "sine({0}) / cosine({0})",
    "tanh": "tanhf({0})",
}  # fmt: skip
_WHOLE = {
    "abs": "({0} < 0) ? -{0} : {0}", "clamp": "({1} < {0}) ? {0} : (({1} > {2}) ? {2} : {1})",
    "div": "({1} == 0) ? -1 : {0} / {1}", "le_to": "{0} <= {1}", "lt_to": "{0} < {1}",
    "max": "({0} >= {1}) ? {0} : {1}",
    "min": "({0} <= {1}) ? {0} : {1}", "not": "~{0}",
    "rem": "({1} == 0) ? {0} : {0} % {1}", "sign": "({0} > 0) - ({0} < 0)",
    "shift_left": "((unsigned){1} < 32u) ? {0} << {1} : 0",
    "shift_right_arithmetic": "(int){0} >> (((unsigned){1} < 32u) ? (int){1} : 31)",
    "shift_right_logical": "((unsigned){1} < 32u) ? (unsigned){0} >> {1} : 0u",
}  # fmt: skip
_ONE_WORD = frozenset({"shift_left", "shift_right_arithmetic", "shift_right_logical"})
_COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge", "le_to", "lt_to", "is_finite"})


@functools.cache
def typed(dtype: DTypeLike) -> str:
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


def expression(name: str, parameters: Parameters, operands: Sequence[Number], names: Sequence[str]) -> str:
    """Return an elementwise operation of JAX's on operands of these names as an expression in CUDA C.

    Raises:
        Unsupported: an operation, or a use of it, that has none here.
    """
    dtype = operands[0].dtype
    real, table = dtype.kind == "f", _PLAIN if name in _PLAIN else _REAL if dtype.kind == "f" else _WHOLE
    if name == "select_n":
        which, chosen, *others = names
        if dtype.kind == "b":
            return f"{which} ? {others[0]} : {chosen}"
        for number, case in enumerate(others, 1):
            chosen = f"({which} >= {number} ? {case} : {chosen})"
        return chosen
    if name == "round":
        even = parameters["rounding_method"] is lax.RoundingMethod.TO_NEAREST_EVEN
        return f"{'rintf' if even else 'roundf'}({names[0]})"
    if name == "integer_pow" and real:
        power = f"to_power<{abs(parameters['y'])}>({names[0]})"
        return power if parameters["y"] >= 0 else f"1.0f / {power}"
    if name == "convert_element_type":
        new = parameters["new_dtype"]
        return f"{names[0]} != 0" if np.dtype(new).kind == "b" else f"({typed(new)}){names[0]}"
    if name == "not" and dtype.kind == "b":
        return f"!{names[0]}"
    if name not in table or (name in _ONE_WORD and dtype.itemsize != 4):
        raise Unsupported(f"the operation {name} on {dtype}")
    return table[name].format(*names)


# --- the kernel

THREADS = 128  # in a block
BLOCKS = 2  # of a kernel with functions, at once: else NVIDIA's assembler gives one of many numbers few registers
REGISTERS = 255  # of a thread
PACE = 1500  # lines of a function after which the threads of a block wait for each other
SELDOM = 2  # lines of a step that read an argument: so many read it from memory
FEW_READS = 64  # arguments that a step reads so seldom; fewer are read before it
LONG_STEP = 150  # lines of a step, of a loop in a loop, from which it is a function of its own
NAME = "walk"
_WARP = "0xffffffffu"  # all threads of a warp
_NAMES = re.compile(r"\bv\d+\b")
_MADE = re.compile(r"const \S+ (v\d+)(?:\[\d+\])? = ")
_OF_ROBOT = re.compile(r"(?:\(&)?\b(?:own|along)\[.*?\](?:\)\[.*?\])?")  # words of a robot's or walk's own
_CHANGES = re.compile(r"\bc\d+\b|\bkept\b")  # names of what loops change

# Arguments are words of 32 bits: `common` to all, first the numbers of robots and of directions of each; `own` of each
# robot; `along` of each walk, one walk for each direction of a robot. Arguments that nothing reads are left out. `own`
# and `along` are of `SIDE_BY_SIDE` robots or walks each (groups, rows, `SIDE_BY_SIDE`): the address of a row is that of
# the first and a constant. `made` (rows, walks) is written; behind it are the words that loops write, see `_KEPT`.
READ = ("common", "own", "along")
SIDE_BY_SIDE = 32  # the threads of a warp
_HEAD = """
extern "C" __global__ void __launch_bounds__({threads}{blocks})
{name}({arguments}, int *__restrict__ made) {{
const int robots = common[0], directions = common[1], walks = robots * directions;
const int thread = blockIdx.x * {threads} + threadIdx.x, lane = thread % {width};
const bool there = thread / {width} < walks, mine = there && lane == 0;
const int walk = there ? thread / {width} : walks - 1, robot = walk / directions;
"""
_OF_ROW = "{of} += {each} / {side} * (size_t){words} + {each} % {side};\n"
_TABLE = """__shared__ int table[{size}];
for (int place = threadIdx.x; place < {size}; place += blockDim.x) table[place] = constants[place];
__syncthreads();
"""


# Behind the results: rows of words, each with one of each thread of a warp; threads beyond the last walk have theirs.
_KEPT = """int *__restrict__ kept = made + ({results} * (size_t)walks + {side} - 1) / {side} * {side};
"""


class _Rows(NamedTuple):
    """Rows of an argument that a loop reads one after the other."""

    of: str
    outer: str  # added by the loops around it
    first: int
    stride: int


class CudaWriter(Writer):
    """Writes a function of one robot down, line by line; `source` is the whole kernel.

    Lanes beyond the limbs, where their number is no power of two, repeat the first one.
    """

    sums = True

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self.width = 1 << (lanes - 1).bit_length()  # threads of a robot
        self._lines: list[str] = []
        self._reads: list[str] = []  # before these: words of arguments, of which each lane has its own row
        self._count = 0
        self._inside, self._branches = 0, 0  # loops, and branches that a warp takes alone
        self._functions = False  # whether there are any
        self._arguments: dict[str, str] = {}  # lines that read an argument's word, by the name of its number
        self.kept = 0  # rows of words that loops write, each thread its own
        # of the loop that is being written: its first line, and the rows of sums over its steps
        self._begin, self._sums = 0, list[int]()
        self._table: list[int] = []  # words of constants that differ from lane to lane
        self._read = dict.fromkeys(READ, 0) | {"common": 2}
        # by the name of an argument's word: the argument, and its row as a sum of the loops' terms and a place
        self._rows: dict[str, tuple[str, str, int]] = {}

    def read(self, of: str, dtype: DTypeLike) -> Value:
        """Return the next number of one of `READ`."""
        row = self._read[of]
        self._read[of] += 1
        value = self._value(dtype, _from_word(_word(of, str(row)), dtype))
        self._rows[value.content] = of, "", row
        self._arguments[value.content] = self._lines[-1]
        return value

    def source(self, results: Sequence[Number]) -> str:
        """Return the kernel, which writes these numbers."""
        rows = []
        for row, number in enumerate(results):
            rows.append(f"if (mine) made[{row} * (size_t)walks + walk] = {_as_word(number)};")
        # without values that nothing is made of: NVIDIA's compiler would leave them out, but not exchanges of lanes
        read, lines = set(_NAMES.findall("".join(rows))), rows[::-1]
        for line in reversed(self._reads + self._lines):
            made = _MADE.match(line)
            if made is None or made[1] in read:
                lines.append(line)
                read.update(_NAMES.findall(line))
        size = len(self._table)
        constants = f"__constant__ int constants[{size}] = {{{', '.join(map(str, self._table))}}};\n" if size else ""
        arguments = ", ".join(f"const int *__restrict__ {of}" for of in READ if self._read[of])
        blocks = f", {BLOCKS}" * self._functions
        head = _HEAD.format(threads=THREADS, blocks=blocks, name=NAME, width=self.width, arguments=arguments)
        table = _TABLE.format(size=size) if size else ""
        of_rows = {"own": ("robot", self._read["own"]), "along": ("walk", self._read["along"])}
        if self.kept:
            head += _KEPT.format(results=len(results), side=SIDE_BY_SIDE)
            of_rows["kept"] = "thread", self.kept
        for of, (each, count) in of_rows.items():
            if count:
                head += _OF_ROW.format(of=of, each=each, side=SIDE_BY_SIDE, words=count * SIDE_BY_SIDE)
        return "\n".join([FUNCTIONS + constants + head + table, *lines[::-1], "}\n"])

    def operation(self, primitive: core.Primitive, parameters: Parameters, operands: Sequence[Number]) -> Value:
        name = primitive.name
        text = expression(name, parameters, operands, [_text(operand) for operand in operands])
        dtype = operands[int(name in ("select_n", "clamp"))].dtype
        dtype = np.dtype(bool) if name in _COMPARISONS else parameters.get("new_dtype", dtype)
        return self._value(dtype, text)

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        if (rows := self._rows_of(numbers)) is not None:
            return self._read_by_lane(rows, numbers[0].dtype)
        padded = [*numbers, *[numbers[0]] * (self.width - self.lanes)]
        distinct = {_text(number): number for number in padded}
        known = all(isinstance(number, np.generic) for number in distinct.values())
        dtype = numbers[0].dtype
        if known and len(distinct) > 2:
            place = len(self._table)
            values = np.array(padded)
            self._table += (values.view(np.int32) if dtype.kind == "f" else values.astype(np.int32)).tolist()
            return self._value(dtype, _from_word(f"table[{place} + lane]", dtype))
        texts = [_text(number) for number in padded]
        chosen, *others = distinct
        for other in others:
            lanes = [lane for lane, text in enumerate(texts) if text == other]
            where = f"lane == {lanes[0]}" if len(lanes) == 1 else f"({sum(1 << lane for lane in lanes)}u >> lane) & 1u"
            chosen = f"(({where}) ? {other} : {chosen})"
        return self._value(dtype, chosen)

    def packs(self, numbers: Sequence[Shared]) -> bool:
        return self._rows_of(numbers) is not None

    def _rows_of(self, numbers: Sequence[Number]) -> _Rows | None:
        """Return where each lane's number is, an argument's word outside of loops; None: not in such rows."""
        names = {number.content if isinstance(number, Value) else None for number in numbers}
        return self._in_rows(numbers) if len(names) > 1 and names <= self._arguments.keys() else None

    def _read_by_lane(self, rows: _Rows, dtype: np.dtype) -> Value:
        """Return the words of an argument that each lane reads in its own row."""
        self._count += 1
        lane = "lane" if self.lanes == self.width else f"(lane < {self.lanes} ? lane : 0)"
        # the address of a lane's first row, the same for many, and a constant
        word = f"(&{_word(rows.of, f'{rows.stride} * {lane}')})[{_words(rows.of) * rows.first}]"
        name = f"v{self._count}"
        self._reads.append(f"const {typed(dtype)} {name} = {_from_word(word, dtype)};")
        self._arguments[name] = self._reads[-1]
        return Value(name, np.dtype(dtype))

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        padded = [*lanes, *[lanes[0]] * (self.width - self.lanes)]
        word = f"(int){value.content}" if value.dtype == bool else value.content
        if len({lane ^ other for lane, other in enumerate(padded)}) == 1:
            text = f"__shfl_xor_sync({_WARP}, {word}, {padded[0]}, {self.width})"
        elif len(set(padded)) == 1:
            text = f"__shfl_sync({_WARP}, {word}, {padded[0]}, {self.width})"
        else:
            source = self.each_its_own([np.int32(lane) for lane in lanes])
            text = f"__shfl_sync({_WARP}, {word}, {source.content}, {self.width})"
        return self._value(value.dtype, f"{text} != 0" if value.dtype == bool else text)

    def loop(
        self,
        steps: int,
        start: Sequence[Shared],
        read: Sequence[Sequence[Shared]],
        step: Callable[[list[Value], list[Value]], Sequence[Shared]],
    ) -> tuple[list[Value], list[list[Value]]]:
        carried, tables = self._variables(start), [self._table_of(numbers) for numbers in read]
        self._count += 1
        time, begin = f"t{self._count}", len(self._lines)
        self._inside += 1
        around, self._begin, self._sums = (self._begin, self._sums), begin, []
        now = [self._read_at(time, table, row[0].dtype) for row, table in zip(read, tables, strict=True)]
        made = step(list(carried), now)
        written, first = made[len(carried) :], self.kept
        self.kept += steps * len(written)
        for row, number in enumerate(written, first):
            word = _word("kept", f"({row} + {len(written)} * {time})")
            self._lines.append(f"__stcg(&{word}, {_as_word(number)});")
        self._assign(carried, made[: len(carried)])
        self._inside -= 1
        if self._inside:
            self._lines[begin:] = self._read_where_used(self._lines[begin:])
        self._lines[begin:begin] = ["#pragma unroll 1", f"for (int {time} = 0; {time} < {steps}; ++{time}) {{"]
        if self._inside and len(self._lines) - begin > LONG_STEP:
            self._lines[begin:] = self._as_function(time, self._lines[begin:], carried)
        self._lines[begin:begin] = [f"{_word('kept', str(row))} = 0;" for row in self._sums]
        self._begin, self._sums = around
        rows = [range(row, self.kept, len(written)) for row in range(first, first + len(written))]
        return carried, [[self._kept(row, n.dtype) for row in each] for each, n in zip(rows, written, strict=True)]

    def summed(self, make: Callable[[], Sequence[Shared]]) -> list[Value]:
        # added in memory, by an operation that returns nothing: hundreds of sums take no registers
        first, totals = len(self._lines), []
        for number in make():
            word = _word("kept", str(self.kept))
            self._lines.append(f"atomicAdd((float *)&{word}, {_text(number)});")
            totals.append(Value(_from_word(_read_word("kept", str(self.kept)), np.float32), np.dtype(np.float32)))
            self._sums.append(self.kept)
            self.kept += 1
        self._move_up(first)
        return totals

    def _move_up(self, first: int) -> None:
        """Move the last lines of a loop, from `first` on, to where all that they read is known: it need not be kept."""
        begin, behind = self._begin, collections.defaultdict[int, list[str]](list)
        made_at = ((_MADE.match(self._lines[place]), place) for place in range(begin, first))
        known = {made[1]: place for made, place in made_at if made and made[1] not in self._arguments}
        for line in self._lines[first:]:
            made = _MADE.match(line)
            read = line[made.end() :] if made else line.partition("], ")[2]
            last = max((known.get(name, begin - 1) for name in _NAMES.findall(read)), default=first - 1)
            place = first - 1 if _CHANGES.search(read) else last
            behind[place].append(line)
            if made:
                known[made[1]] = place
        lines = list(behind[begin - 1])
        for place in range(begin, first):
            lines += [self._lines[place], *behind[place]]
        self._lines[begin:] = lines

    def _read_where_used(self, lines: list[str]) -> list[str]:
        """Return the lines of a step that reads `FEW_READS` arguments or more: each in the step, where it is used.

        NVIDIA's compiler would read all of them once, before the loop, and store them for each thread of a robot. A
        walk without an adjoint is faster that way.
        """
        read = collections.Counter(itertools.chain.from_iterable(set(_NAMES.findall(line)) for line in lines))
        seldom = {name for name in read if name in self._arguments and read[name] <= SELDOM}
        if len(seldom) < FEW_READS:
            return lines
        words = {name: _MADE.sub("", self._arguments[name]).removesuffix(";") for name in seldom}
        again = {name: _OF_ROBOT.sub(r"again(&\g<0>)", word) for name, word in words.items()}
        return [_NAMES.sub(lambda found: again.get(found[0], found[0]), line) for line in lines]

    def _as_function(self, time: str, lines: list[str], carried: Sequence[Value]) -> list[str]:
        """Return a loop in a loop as a function of its own, and its call.

        NVIDIA's assembler takes hours over registers for two loops. Values pass through arrays; more than there are
        registers stay there, and the function is one step.
        """
        self._functions, stay = True, len(carried) > REGISTERS or bool(self._sums)
        names = dict.fromkeys(_NAMES.findall("\n".join(lines)))
        read = [self._arguments[name] for name in names if name in self._arguments]  # once more: one word for all lanes
        before, begun, ended, after, arrays = [], [], [], [], ""
        for dtype in dict.fromkeys(value.dtype for value in carried):
            own, array = [value.content for value in carried if value.dtype == dtype], f"{dtype}_{time}"
            before.append(f"{typed(dtype)} {array}[{len(own)}] = {{{', '.join(own)}}};")
            for place, name in enumerate(own):
                begun.append(f"{typed(dtype)} {'&' * stay}{name} = {array}[{place}];")
                ended.append(f"{array}[{place}] = {name};")
                after.append(f"{name} = {array}[{place}];")
            arrays += f", &{array}"
        unrolled, loop, *step = lines
        together = list if self._branches else _together
        # As parameters, in global memory: captured ones would be read again behind each word that is written, and an
        # addition through a pointer to any memory waits for its result.
        pointers = [of for of, count in {**self._read, "kept": self.kept}.items() if count]
        types = [f"{'' if of == 'kept' else 'const '}int *__restrict__ {of}" for of in pointers]
        head, given = ", ".join(["int lane", *types]), ", ".join(["lane", *pointers])
        read = [*(f"__builtin_assume(__isGlobal({of}));" for of in pointers), *read]
        if stay:
            function = f"const auto step_{time} = [={arrays}](int {time}, {head}) __attribute__((noinline)) {{"
            call = [unrolled, f"{loop.removesuffix('{')}step_{time}({time}, {given});"]
            return [*before, function, *together([*read, *begun, *step[:-1]]), "};", *call, *after]
        function = f"const auto loop_{time} = [={arrays}]({head}) __attribute__((noinline)) {{"
        inside = together([*read, *step[:-1]])
        return [*before, function, *begun, unrolled, loop, *inside, "}", *ended, "};", f"loop_{time}({given});", *after]

    def _kept(self, row: int, dtype: np.dtype) -> Value:
        """Return a number that a loop has written: it is read where it is used."""
        value = Value(_from_word(_read_word("kept", str(row)), dtype), dtype)
        self._rows[value.content] = "kept", "", row
        return value

    def _in_rows(self, numbers: Sequence[Number]) -> _Rows | None:
        """Return the rows of an argument, at equal distances, that numbers are read from; None where they are not."""
        rows = [self._rows.get(number.content) if isinstance(number, Value) else None for number in numbers]
        known = [row for row in rows if row is not None]
        if len(known) == len(numbers) and len({row[:2] for row in known}) == 1:
            (of, outer, first), places = known[0], np.array([place for *_, place in known])
            stride = int(places[1] - first) if len(places) > 1 else 0
            if (np.diff(places) == stride).all():
                return _Rows(of, outer, first, stride)
        return None

    def _table_of(self, numbers: Sequence[Shared]) -> str | _Rows:
        """Return where a loop reads: in rows of an argument at equal distances, or else in an own array, by name."""
        if (rows := self._in_rows(numbers)) is not None:
            return rows
        self._count += 1
        name = f"v{self._count}"
        each = ", ".join(map(_text, numbers))
        self._lines.append(f"const {typed(numbers[0].dtype)} {name}[{len(numbers)}] = {{{each}}};")
        return name

    def _read_at(self, time: str, table: str | _Rows, dtype: np.dtype) -> Value:
        """Return a number that a loop reads in a step; a loop within it may read rows of the same argument."""
        if isinstance(table, str):
            return self._value(dtype, f"{table}[{time}]")
        of, outer, first, stride = table
        value = self._value(dtype, _from_word(_read_word(of, f"({outer}{first} + {stride} * {time})"), dtype))
        self._rows[value.content] = of, f"{outer}{stride} * {time} + ", first
        return value

    def branch(self, taken: Shared, before: Sequence[Shared], make: Callable[[], Sequence[Shared]]) -> list[Value]:
        carried = self._variables(before)
        # lanes exchange values inside: the threads of a warp go there together
        self._lines.append(f"if (__any_sync({_WARP}, {_text(taken)})) {{")
        self._branches += 1
        made = make()
        self._branches -= 1
        self._assign(carried, made, where=f"{_text(taken)} ? {{}} : {{}}")
        return carried

    def _variables(self, start: Sequence[Shared]) -> list[Value]:
        """Return variables that begin as numbers."""
        variables = []
        for number in start:
            self._count += 1
            variables.append(Value(f"c{self._count}", np.dtype(number.dtype)))
            self._lines.append(f"{typed(number.dtype)} c{self._count} = {_text(number)};")
        return variables

    def _assign(self, variables: Sequence[Value], numbers: Sequence[Shared], where: str = "{}") -> None:
        """End a block that gives variables new numbers; `where` makes each of the new one and of the one before."""
        # all are computed before the first is changed
        for value, number in zip(variables, numbers, strict=True):
            self._lines.append(f"const {typed(value.dtype)} next_{value.content} = {_text(number)};")
        new = (where.format(f"next_{value.content}", value.content) for value in variables)
        self._lines += [f"{value.content} = {each};" for value, each in zip(variables, new, strict=True)] + ["}"]

    def _value(self, dtype: DTypeLike, text: str) -> Value:
        self._count += 1
        self._lines.append(f"const {typed(np.dtype(dtype))} v{self._count} = {text};")
        return Value(f"v{self._count}", np.dtype(dtype))


def _together(step: Sequence[str]) -> list[str]:
    """Return the lines of a step with places at which the threads of a block wait for each other.

    A step and its adjoint are more instructions than a multiprocessor caches: they are loaded once for all threads.
    """
    lines, depth, since = ["__syncthreads();"], 0, 0
    for line in step:
        lines.append(line)
        depth, since = depth + line.endswith("{") - line.startswith("}"), since + 1
        if not depth and since >= PACE:
            lines.append("__syncthreads();")
            since = 0
    return lines


def _text(number: Number) -> str:
    assert not isinstance(number, OfLane)  # text is the same for all lanes
    return str(number.content) if isinstance(number, Value) else literal(number)


def _word(of: str, row: str) -> str:
    """Return a word of the arguments."""
    return f"{of}[{_words(of)} * {row}]"


def _read_word(of: str, row: str) -> str:
    """Return a word to be read: those that loops write pass the first cache by, which is for the arguments."""
    return f"__ldcg(&{_word(of, row)})" if of == "kept" else _word(of, row)


def _words(of: str) -> int:
    """Return how many words there are from one row of an argument to the next."""
    return 1 if of == "common" else SIDE_BY_SIDE


def _as_word(number: Number) -> str:
    return f"__float_as_int({_text(number)})" if typed(number.dtype) == "float" else f"(int){_text(number)}"


def _from_word(word: str, dtype: DTypeLike) -> str:
    kind = typed(np.dtype(dtype))
    return f"__int_as_float({word})" if kind == "float" else f"{word} != 0" if kind == "bool" else f"({kind}){word}"
