"""A kernel carried out by XLA in place of being written, on any device and in any precision: for tests."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.compilation.elements import Number, Value
from mjx_climb.compilation.writer import Writer


class Interpreted(Writer):
    """Numbers are arrays (lanes, robots), with one row where all lanes have the same."""

    def __init__(self, lanes: int, robots: int) -> None:
        self.lanes, self.robots = lanes, robots

    def value(self, rows: Array) -> Value:
        """Return numbers (lanes or 1, robots) as a value."""
        return Value(rows, np.dtype(rows.dtype))

    def rows(self, number: Number) -> Array:
        """Return a number as (lanes or 1, robots)."""
        content = number.content if isinstance(number, Value) else jnp.asarray(number)[None, None]
        return jnp.broadcast_to(content, (len(content), self.robots))

    def operation(self, primitive: core.Primitive, parameters: Mapping[str, Any], operands: Sequence[Number]) -> Value:
        rows = [self.rows(operand) for operand in operands]
        wide = [jnp.broadcast_to(row, (max(map(len, rows)), self.robots)) for row in rows]
        made: Array = primitive.bind(*wide, **primitive.get_bind_params(dict(parameters)))
        return self.value(made)

    def each_its_own(self, numbers: Sequence[Number]) -> Value:
        rows = [self.rows(number) for number in numbers]
        return self.value(jnp.stack([row[min(lane, len(row) - 1)] for lane, row in enumerate(rows)]))

    def of_lanes(self, value: Value, lanes: Sequence[int]) -> Value:
        rows = self.rows(value)
        return self.value(rows if len(rows) == 1 else rows[np.asarray(lanes)])

    def loop(self, steps: int, start: Sequence[Number], step: Callable[[list[Value]], Sequence[Number]]) -> list[Value]:
        def wide(numbers: Sequence[Number], like: Sequence[Number]) -> tuple[Array, ...]:
            each = [self.rows(number).astype(other.dtype) for number, other in zip(numbers, like, strict=True)]
            return tuple(jnp.broadcast_to(rows, (self.lanes, self.robots)) for rows in each)

        def body(_: Array, before: tuple[Array, ...]) -> tuple[Array, ...]:
            return wide(step([self.value(rows) for rows in before]), start)

        return [self.value(rows) for rows in lax.fori_loop(0, steps, body, wide(start, start))]
