"""A kernel as text in CUDA C: a robot for each thread, or a limb of a robot."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax.extend import core

from mjx_climb.execution.cuda_operations import FUNCTIONS, expression, literal, type_of, typed
from mjx_climb.execution.elements import Number, OfLane, Value, Writer

THREADS = 128  # in a block
NAME = "walk"
_WARP = "0xffffffffu"  # all threads of a warp
_NAMES = re.compile(r"\bv\d+\b")
_MADE = re.compile(r"const \S+ (v\d+) = ")

# Arguments are words of 32 bits: `own` (rows, robots) of each robot, `common` of all, the first of which is the number
# of robots, and what is written, `made` (rows, robots).
_HEAD = """
extern "C" __global__ void __launch_bounds__({threads})
{name}(const int *__restrict__ own, const int *__restrict__ common, int *__restrict__ made) {{
const int robots = common[0], thread = blockIdx.x * {threads} + threadIdx.x, lane = thread % {width};
const bool mine = thread / {width} < robots && lane == 0;
const int robot = mine || thread / {width} < robots ? thread / {width} : robots - 1;
"""
_TABLE = """__shared__ int table[{size}];
for (int place = threadIdx.x; place < {size}; place += blockDim.x) table[place] = constants[place];
__syncthreads();
"""


class CudaWriter(Writer):
    """Writes a function of one robot down, line by line; `source` is the whole kernel.

    Lanes beyond the limbs, where their number is no power of two, do what the first one does.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self.width = 1 << (lanes - 1).bit_length()  # threads of a robot
        self._lines: list[str] = []
        self._count = 0
        self._table: list[int] = []  # words of constants that differ from lane to lane
        self._read = {"own": 0, "common": 1}

    def read(self, of: str, dtype: Any) -> Value:
        """Return the next number of the robot's `own`, or of the `common` ones."""
        row = self._read[of]
        self._read[of] += 1
        word = f"own[{row} * (size_t)robots + robot]" if of == "own" else f"common[{row}]"
        return self._value(dtype, _from_word(word, dtype))

    def source(self, results: Sequence[Number]) -> str:
        """Return the kernel, which writes these numbers."""
        rows = [
            f"if (mine) made[{row} * (size_t)robots + robot] = {_to_word(_text(number), number.dtype)};"
            for row, number in enumerate(results)
        ]
        size = len(self._table)
        constants = f"__constant__ int constants[{size}] = {{{', '.join(map(str, self._table))}}};\n" if size else ""
        head = _HEAD.format(threads=THREADS, name=NAME, width=self.width)
        table = _TABLE.format(size=size) if size else ""
        return "\n".join([FUNCTIONS + constants + head + table, *_needed(self._lines, rows), *rows, "}\n"])

    def operation(self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Number]) -> Value:
        text = expression(primitive.name, parameters, operands, [_text(operand) for operand in operands])
        return self._value(type_of(primitive.name, parameters, operands), text)

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        padded = [*numbers, *[numbers[0]] * (self.width - self.lanes)]
        distinct = {_text(number): number for number in padded}
        known = all(isinstance(number, np.generic) for number in distinct.values())
        dtype = numbers[0].dtype
        if known and len(distinct) > 2:
            place = len(self._table)
            self._table += [_word(number) for number in padded]
            return self._value(dtype, _from_word(f"table[{place} + lane]", dtype))
        texts = [_text(number) for number in padded]
        chosen, *others = distinct
        for other in others:
            lanes = [lane for lane, text in enumerate(texts) if text == other]
            where = f"lane == {lanes[0]}" if len(lanes) == 1 else f"({sum(1 << lane for lane in lanes)}u >> lane) & 1u"
            chosen = f"(({where}) ? {other} : {chosen})"
        return self._value(dtype, chosen)

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

    def loop(self, steps: int, start: Sequence[Number], step: Callable[[list[Value]], Sequence[Number]]) -> list[Value]:
        carried = []
        for number in start:
            self._count += 1
            carried.append(Value(f"c{self._count}", np.dtype(number.dtype)))
            self._lines.append(f"{typed(number.dtype)} c{self._count} = {_text(number)};")
        self._count += 1
        time = f"t{self._count}"
        self._lines += ["#pragma unroll 1", f"for (int {time} = 0; {time} < {steps}; ++{time}) {{"]
        after = step(list(carried))
        # all are worked out before the first is changed
        for value, number in zip(carried, after, strict=True):
            self._lines.append(f"const {typed(value.dtype)} next_{value.content} = {_text(number)};")
        self._lines += [f"{value.content} = next_{value.content};" for value in carried] + ["}"]
        return carried

    def _value(self, dtype: Any, text: str) -> Value:
        self._count += 1
        self._lines.append(f"const {typed(dtype)} v{self._count} = {text};")
        return Value(f"v{self._count}", np.dtype(dtype))


def _needed(lines: Sequence[str], results: Sequence[str]) -> list[str]:
    """Return the lines without values that nothing is made of.

    NVIDIA's compiler would leave out the others itself, but not exchanges between lanes.
    """
    read = {name for line in results for name in _NAMES.findall(line)}
    kept = []
    for line in reversed(lines):
        made = _MADE.match(line)
        if made is None or made[1] in read:
            kept.append(line)
            read.update(_NAMES.findall(line))
    return kept[::-1]


def _text(number: Number) -> str:
    assert not isinstance(number, OfLane)  # what is written is of all lanes
    return str(number.content) if isinstance(number, Value) else literal(number)


def _word(number: Number) -> int:
    """Return the 32 bits of a known number as a whole one."""
    value = np.asarray(number)
    return int(value.view(np.int32)) if value.dtype.kind == "f" else int(value.astype(np.int64).astype(np.int32))


def _from_word(word: str, dtype: Any) -> str:
    kind = typed(dtype)
    return f"__int_as_float({word})" if kind == "float" else f"{word} != 0" if kind == "bool" else f"({kind}){word}"


def _to_word(text: str, dtype: Any) -> str:
    return f"__float_as_int({text})" if typed(dtype) == "float" else f"(int){text}"
