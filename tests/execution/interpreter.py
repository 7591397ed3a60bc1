"""Kernels carried out by XLA's own operations, on any device and in any precision, in place of CUDA C."""

import math

import jax.numpy as jnp
from jax import lax

from mjx_climb.execution.array_writer import ArrayWriter
from mjx_climb.execution.elements import Value, as_array


class Interpreter(ArrayWriter):
    """Writes loops and long branches, which a CPU's regions do not hold."""

    def loop(self, steps, start, read, step):
        shape = (self.lanes, *self.batch)
        tables = [jnp.stack([self.rows(number, shape) for number in numbers]) for numbers in read]

        def whole(numbers):
            return tuple(self.rows(number, shape).astype(of.dtype) for number, of in zip(numbers, start, strict=True))

        def stepped(before, time):
            widened, now = dict(self._widened), [self.value(table[time]) for table in tables]
            made = step([*map(self.value, before)], now)
            found = whole(made[: len(start)]), [self.rows(number, shape) for number in made[len(start) :]]
            self._widened = widened  # what is made in a loop stays there
            return found

        after, written = lax.scan(stepped, whole(start), jnp.arange(steps))
        return [*map(self.value, after)], [[self.value(row) for row in table] for table in written]

    def branch(self, taken, before, make):
        shape = (self.lanes, *self.batch)

        def whole(numbers):
            return (self.rows(number, shape).astype(of.dtype) for number, of in zip(numbers, before, strict=True))

        where = jnp.broadcast_to(self.rows(taken, shape), shape)
        each = zip(whole(make()), whole(before), strict=True)
        return [self.value(jnp.where(where, new, old)) for new, old in each]

    def column(self, number):
        """Return a number that all lanes have, (robots,); the lanes may have rows of their own, all alike."""
        mine = self.value(number.content[:1]) if isinstance(number, Value) else number
        return self.rows(mine, (1, *self.batch))[0]


def launched(body, arrays, axes):
    """Return the results of a body for a batch, as `gpu_kernel` does on a GPU."""
    arrays = [*map(jnp.asarray, arrays)]
    batch = next(array.shape[:count] for array, count in zip(arrays, axes, strict=True) if count == max(axes))
    walks = math.prod(batch)
    writer = Interpreter(body.limbs.count, (walks,))
    given = []
    for array, leaf, count in zip(arrays, body.program.in_avals, axes, strict=True):
        rows = array.reshape(math.prod(batch[:count]), -1).T
        rows = jnp.repeat(rows, walks // rows.shape[1], 1) if count else rows
        given.append(as_array((writer.value(row[None]) for row in rows), leaf.shape))
    made = []
    for numbers, leaf in zip(body.results(writer, given), body.program.out_avals, strict=True):
        columns = [writer.column(number) for number in numbers]
        whole = jnp.stack(columns, 1) if columns else jnp.zeros(walks)
        made.append(whole.reshape(*batch, *leaf.shape))
    return made
