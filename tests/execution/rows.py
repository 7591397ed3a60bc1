"""A writer whose lanes are the rows of NumPy's arrays: programs are carried out and not compiled."""

import functools

import numpy as np

from mjx_climb.execution.element_operations import Operations, computed_now
from mjx_climb.execution.element_rules import results
from mjx_climb.execution.elements import Value, Writer, as_array
from mjx_climb.execution.limbs import LimbAxes


class Rows(Writer):
    """Numbers are arrays (lanes,); whether lanes are reduced at once, or exchange with partners."""

    sums = True

    def __init__(self, lanes, reduces=False):
        self.lanes, self.reduces, self.written = lanes, reduces, []
        self.totals, self.asked = [], 0  # of the loop that is carried out, and how many of them its step has had

    def row(self, number):
        return number.content if isinstance(number, Value) else np.full(self.lanes, number)

    def value(self, numbers):
        row = np.broadcast_to(numbers, self.lanes)
        return Value(row, row.dtype)

    def operation(self, primitive, parameters, operands):
        self.written.append(primitive.name)
        return self.value(computed_now(primitive, parameters, [*map(self.row, operands)])[0])

    def each_its_own(self, numbers):
        return self.value(np.array([self.row(number)[lane] for lane, number in enumerate(numbers)]))

    def packs(self, numbers):
        return True

    def of_lanes(self, value, lanes):
        assert len(lanes) == self.lanes
        self.written.append("exchange")
        return self.value(value.content[list(lanes)])

    def over_lanes(self, combine, value):
        if not self.reduces:
            return None
        return self.value(functools.reduce(lambda a, b: computed_now(combine, {}, [a, b])[0], value.content))

    def loop(self, steps, start, read, step):
        carry, written, self.totals = [self.value(self.row(number)) for number in start], [], []
        for time in range(steps):
            self.asked = 0
            made = step(carry, [self.value(self.row(column[time])) for column in read])
            made = [self.value(self.row(number)) for number in made]
            carry = made[: len(start)]
            written.append(made[len(start) :])
        return carry, [list(column) for column in zip(*written, strict=True)]

    def summed(self, make):
        made, first = [*map(self.row, make())], self.asked
        self.asked += len(made)
        self.totals += [Value(np.zeros_like(row), row.dtype) for row in made[len(self.totals) - first :]]
        mine = self.totals[first : self.asked]
        for total, row in zip(mine, made, strict=True):
            np.add(total.content, row, out=total.content)
        return mine

    def branch(self, taken, before, make):
        assert len(set(self.row(taken))) == 1
        return make() if self.row(taken)[0] else before


def carried_out(program, given, lanes=1):
    """Return the results of a flat program for elements of which none is known, as arrays of numbers."""
    writer = Rows(lanes)
    do = Operations(writer, LimbAxes(program))
    values = [as_array((writer.value(number) for number in array.reshape(-1)), array.shape) for array in given]

    def numbers(array):
        return np.array([writer.row(do.same_for_all(each))[0] for each in array.reshape(-1)]).reshape(array.shape)

    return [*map(numbers, results(do, program, values))]
