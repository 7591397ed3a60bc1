"""A program of one robot for a batch, cut into regions that XLA:CPU compiles as one kernel each.

A function call with the attribute `xla_cpu_small_call` becomes a single kernel. In it there are no matrices, as XLA
fuses and computes again what is broadcast: each component is a row of robots, or of the limbs of robots, as
`element_operations` writes it (`array_writer`). Other operations, and loops, stand between the regions.
"""

import functools
import itertools
import math
from collections.abc import Callable, Container, Hashable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from mjx_climb.execution.array_writer import ArrayWriter
from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.element_rules import can_write, results
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.flat import (
    Has,
    by_axis,
    carried_on,
    chained,
    depend,
    flat,
    mapped,
    needed,
    reached,
    region,
    runs,
    variables_of,
    with_axes,
)
from mjx_climb.execution.jax_internals import as_one_kernel, carried_out, line_of, new_program, scan_sizes
from mjx_climb.execution.jax_types import aval_of
from mjx_climb.execution.limbs import LimbAxes

EQUATIONS = 250  # in a region: with fewer the calls cost more, with more compiling takes longer
EQUATIONS_OF_ONE = 1000  # the same of a single robot, whose arithmetic takes no longer than the calls
A_CALL = 5  # of a region costs about as much as so many values that are stored and read again
STORED_FROM = 3  # operations
# put together by an equation within a region: XLA fuses them, and asks of each element which row it is in
MOST_ROWS = 16
# bytes that a region of its own puts together: XLA:CPU splits larger ones over threads, in a call into invalid code
MOST_OF_A_CALL = 2**18
# equations between the regions of a step: XLA:CPU works their arrays out by several threads, and two shares that do so
# for many at once wait for each other for ever (jaxlib 0.10, MJX's 50)
MOST_BETWEEN = 40


def in_regions(
    program: core.ClosedJaxpr, arguments: Sequence[Array], varies: Sequence[Has], batch: tuple[int, ...]
) -> list[Array]:
    """Return the results of a program of one robot for a batch, whose axes are behind the arguments' own."""
    whole = flat(program)
    given = zip(_unseen(arguments), varies, strict=True)
    return [value for value, _ in _Program(LimbAxes(whole), batch, set()).results(whole, list(given))]


def _unseen(values: Sequence[Array]) -> list[Array]:
    """Return values, constants among them hidden from XLA.

    It would put the constant in the place of a kernel's parameter, and stop the process at a parameter that nothing
    reads (jaxlib 0.10: "All or none of the slices should have an explicit index").
    """
    return list(lax.optimization_barrier(tuple(values)))


Item = TypeVar("Item")


class _Stacks(NamedTuple):
    """Which of some values, each of one shape and type, are one array: places in a sequence, in groups."""

    groups: tuple[tuple[int, ...], ...]

    def stacked(self, values: Sequence[Item], stack: Callable[[list[Item]], Item]) -> list[Item]:
        """Return each group stacked by `stack`, and then the values of no group."""
        within = set(itertools.chain.from_iterable(self.groups))
        made = [stack([values[place] for place in group]) for group in self.groups]
        return made + [value for place, value in enumerate(values) if place not in within]

    def apart(self, arrays: Sequence[Array]) -> list[Array]:
        """Return the values that `stacked` made into arrays by `_rows_of`."""
        rest = iter(arrays[len(self.groups) :])
        rows: dict[int, Array] = {}
        for array, group in zip(arrays, self.groups, strict=False):
            rows |= {place: lax.index_in_dim(array, row, keepdims=False) for row, place in enumerate(group)}
        count = len(rows) + len(arrays) - len(self.groups)
        return [rows[place] if place in rows else next(rest) for place in range(count)]


def _rows_of(values: Sequence[Array]) -> Array:
    """Return values of one shape and type as one array, along a first axis."""
    return lax.concatenate([lax.expand_dims(jnp.asarray(value), (0,)) for value in values], 0)


def _carrying(stacks: _Stacks, body: core.ClosedJaxpr, constants: int, carry: int) -> core.ClosedJaxpr:
    """Return a loop's body that carries stacks and the numbers behind them in place of `carry` values."""

    def apart(common: list[Array], carried: list[Array], read: list[Array]) -> list[Array]:
        return [*common, *stacks.apart(carried), *read]

    def together(made: list[Array]) -> list[Array]:
        return [*stacks.stacked(made[:carry], _rows_of), *made[carry:]]

    avals = body.in_avals
    carried = stacks.stacked(avals[constants : constants + carry], lambda some: jax.eval_shape(_rows_of, some))
    before = jax.make_jaxpr(apart)(avals[:constants], carried, avals[constants + carry :])
    return chained(before, body, jax.make_jaxpr(together)(body.out_avals))


Varying = tuple[Array, Has]  # and which batch axes it has


class _Program(NamedTuple):
    """State shared by all parts of a program."""

    limbs: LimbAxes
    batch: tuple[int, ...]
    refused: set[int]  # ids of equations that turned out to be none for a region

    def results(self, program: core.ClosedJaxpr, arguments: Sequence[Varying]) -> list[Varying]:
        """Return the results of a flat program."""
        same = (False,) * len(self.batch)
        known = dict(zip(program.jaxpr.constvars, ((value, same) for value in program.consts), strict=True))
        known |= zip(program.jaxpr.invars, arguments, strict=True)

        def read(atom: core.Var | core.Literal) -> Varying:
            return (atom.val, same) if isinstance(atom, core.Literal) else known[atom]

        def fits(equation: core.JaxprEqn) -> bool:
            return id(equation) not in self.refused and can_write(equation)

        parts = runs(program.jaxpr, fits)
        ways = {"scan": self._scan, "cond": self._condition}
        between = [
            e for part, straight in parts if not straight for e in part.jaxpr.eqns if e.primitive.name not in ways
        ]
        if len(between) > MOST_BETWEEN:
            line = line_of(between[0])
            raise Unsupported(
                f"{len(between)} operations as {between[0].primitive.name} in one step, the first: {line}"
            )
        for part, straight in parts:
            if straight:
                given = [known[variable] for variable in part.jaxpr.invars]
                try:
                    found = self._straight(part, given)
                except Unsupported as error:
                    if error.equation is None:
                        raise
                    self.refused.add(id(error.equation))
                    found = self.results(part, given)
                known |= zip(part.jaxpr.outvars, found, strict=True)
                continue
            for equation in part.jaxpr.eqns:
                carry_out = ways.get(equation.primitive.name, self._as_it_is)
                known |= zip(equation.outvars, carry_out(equation, [*map(read, equation.invars)]), strict=True)
        return [read(atom) for atom in program.jaxpr.outvars]

    def _straight(self, part: core.ClosedJaxpr, given: Sequence[Varying]) -> list[Varying]:
        """Return the results of equations that are all written as elements."""
        jaxpr, writer = part.jaxpr, ArrayWriter(self.limbs.count, self.batch)
        traced = [isinstance(value, jax.core.Tracer) for value, _ in given]
        depends = functools.partial(reached, jaxpr)
        varies = by_axis(depends, [has for _, has in given], len(self.batch), len(jaxpr.outvars))

        def written(*arguments: Array) -> list[Array]:
            do, some = Operations(writer, self.limbs), iter(arguments)
            elements = [
                writer.elements(do, next(some) if t else value, aval_of(v).shape, self.limbs.of(v), has)
                for v, (value, has), t in zip(jaxpr.invars, given, traced, strict=True)
            ]
            return [
                writer.array(do, found, aval_of(v), self.limbs.of(v), has)
                for v, found, has in zip(jaxpr.outvars, results(do, part, elements), varies, strict=True)
            ]

        most = EQUATIONS if math.prod(self.batch) > 1 else EQUATIONS_OF_ONE
        made = _in_kernels(written, [value for value, _ in itertools.compress(given, traced)], most)
        return list(zip(made, varies, strict=True))

    def _scan(self, equation: core.JaxprEqn, given: Sequence[Varying]) -> list[Varying]:
        """Return the results of a loop, its steps in regions."""
        parameters, has = equation.params, [has for _, has in given]
        written_has: list[Has] = []
        constants, carry = scan_sizes(parameters)
        read = given[constants + carry :]
        moving = by_axis(functools.partial(carried_on, parameters), has, len(self.batch), carry)[:carry]
        begun = [*map(self._wide, given[constants : constants + carry], moving)]
        stacks, body = self._stacked(parameters["jaxpr"], constants, moving)
        carried_has = stacks.stacked(moving, lambda some: some[0])

        def step(carried: list[Array], now: list[Array]) -> tuple[list[Array], list[Array]]:
            values = zip([*carried, *now], [*carried_has, *has[constants + carry :]], strict=True)
            made = self.results(body, [*given[:constants], *values])
            written_has[:] = [has for _, has in made[len(carried) :]]
            return [*map(self._wide, made, carried_has)], [value for value, _ in made[len(carried) :]]

        start, how = _unseen(stacks.stacked(begun, _rows_of)), ("length", "reverse", "unroll")
        after, written = lax.scan(step, start, [value for value, _ in read], **{name: parameters[name] for name in how})
        return [*zip(stacks.apart(after), moving, strict=True), *zip(written, written_has, strict=True)]

    def _condition(self, equation: core.JaxprEqn, given: Sequence[Varying]) -> list[Varying]:
        """Return the results of the branches that robots take: a branch that loops is carried out for all or none."""
        (which, own), *operands = given
        varies = self._vary(equation, given)

        def taken(branch: int) -> list[Array]:
            return [*map(self._wide, self.results(equation.params["branches"][branch], operands), varies)]

        def chosen(branch: int, before: list[Array]) -> list[Array]:
            takes = [self._wide((which == branch, own), has) for has in varies]
            return [*map(jnp.where, takes, taken(branch), before)]

        found = taken(0)
        for branch in range(1, len(equation.params["branches"])):
            found = lax.cond(jnp.any(which == branch), functools.partial(chosen, branch), lambda before: before, found)
        return list(zip(found, varies, strict=True))

    def _vary(self, equation: core.JaxprEqn, given: Sequence[Varying]) -> list[Has]:
        """Return which batch axes the results of an equation have."""
        has = [has for _, has in given]
        return by_axis(functools.partial(depend, equation), has, len(self.batch), len(equation.outvars))

    def _stacked(
        self, body: core.ClosedJaxpr, constants: int, moving: Sequence[Has]
    ) -> tuple[_Stacks, core.ClosedJaxpr]:
        """Return which values a loop carries as one array, those that are one row of robots, and its body with these.

        XLA:CPU copies each such value in each step, as the first region hands it on under another shape. Where more
        than eight operations could be next, it hands some to other threads, for longer than a step takes (jaxlib 0.10).
        """
        carried = slice(constants, constants + len(moving))
        groups: dict[Hashable, list[int]] = {}
        for place, (variable, has) in enumerate(zip(body.jaxpr.invars[carried], moving, strict=True)):
            aval, axis = aval_of(variable), self.limbs.of(variable)
            if aval.size == (1 if axis is None else self.limbs.count):
                groups.setdefault((aval.shape, aval.dtype, axis, has), []).append(place)
        split = [g[n : n + MOST_ROWS] for g in groups.values() for n in range(0, len(g), MOST_ROWS)]
        stacks = _Stacks(tuple(tuple(group) for group in split if len(group) > 1))
        stacked = _carrying(stacks, body, constants, len(moving))
        axes = [self.limbs.of(variable) for variable in body.jaxpr.invars]
        axes[carried] = stacks.stacked(axes[carried], lambda same: None if same[0] is None else same[0] + 1)
        self.limbs.follow(stacked.jaxpr, axes)
        return stacks, stacked

    def _wide(self, array: Varying, wanted: Has) -> Array:
        """Return an array with more of the batch axes."""
        value, has = array
        return value if has == wanted else with_axes(jnp.asarray(value), has, wanted, self.batch)

    def _as_it_is(self, equation: core.JaxprEqn, given: Sequence[Varying]) -> list[Varying]:
        """Return the results of an equation that stands between the regions."""
        has, varies = [has for _, has in given], self._vary(equation, given)
        one = mapped(lambda *operands: carried_out(equation.primitive, equation.params, operands), has, varies)
        return list(zip(one(*(value for value, _ in given)), varies, strict=True))


# --- cutting


def _in_kernels(function: Callable[..., list[Array]], arguments: Sequence[Array], most: int) -> list[Array]:
    """Return the results of a function with its equations in regions of at most so many, each a kernel of its own."""
    closed = jax.make_jaxpr(function)(*arguments)
    constants = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    values = constants | dict(zip(closed.jaxpr.invars, arguments, strict=True))
    for part in _regions(closed, most):
        inputs = [variable for variable in part.jaxpr.invars if variable not in constants]
        own = [(variable, constants[variable]) for variable in part.jaxpr.invars if variable in constants]
        whole = new_program(part.jaxpr, part.jaxpr.eqns, inputs, part.jaxpr.outvars, own)
        results = _one_kernel(whole, [values[variable] for variable in inputs])
        values |= zip(part.jaxpr.outvars, results if inputs else _unseen(results), strict=True)
    return [atom.val if isinstance(atom, core.Literal) else values[atom] for atom in closed.jaxpr.outvars]


def _regions(closed: core.ClosedJaxpr, most: int) -> list[core.ClosedJaxpr]:
    """Return regions of at most so many equations, in order of execution, without unused ones.

    Those of constants alone are in each region that reads them, see `_unseen`. So are those that take arguments apart:
    an array is read in place at no cost. But where a region reads carried values of a loop and makes the next ones,
    XLA would copy the whole: before such regions the first one takes their operands apart.
    """
    jaxpr, results = closed.jaxpr, variables_of(closed.jaxpr.outvars)
    of_constants, moves, others, known, moved = [], [], [], set(jaxpr.constvars), set(jaxpr.invars)
    for equation in needed(jaxpr.eqns, jaxpr.outvars):
        read = set(variables_of(equation.invars))
        if read <= known:
            known.update(equation.outvars)
            of_constants.append(equation)
        elif read <= moved and equation.primitive.name in ("slice", "reshape"):
            moved.update(equation.outvars)
            moves.append(equation)
        else:
            others.append(equation)

    groups = _groups(others, most, results) or [[]]
    last = [group for group in groups if any(made in results for equation in group for made in equation.outvars)]
    read_there = [atom for group in last for equation in group for atom in equation.invars]
    early = needed(moves, [*read_there, *jaxpr.outvars])
    moves = [equation for equation in moves if equation not in early]
    later, found = dict(results), []
    for number, group in reversed([*enumerate(groups)]):
        again = needed([*of_constants, *moves], [atom for equation in group for atom in equation.invars])
        repeated = variables_of([variable for equation in again for variable in equation.outvars])
        wanted = {variable: None for variable in later if variable not in repeated}
        if whole := [*([] if number else early), *again, *group]:
            found.append(region(jaxpr, whole, wanted | dict.fromkeys(_stored(group))))
            later |= variables_of(found[-1].jaxpr.invars)
    if known_results := needed(of_constants, jaxpr.outvars):
        found.append(region(jaxpr, known_results, results))
    return found[::-1]


def _groups(equations: list[core.JaxprEqn], most: int, results: Container[core.Var]) -> list[list[core.JaxprEqn]]:
    """Return equations in groups of at most so many, cut where few values go on: these are stored and read again.

    Equations that put many rows together are apart.
    """

    def puts_together(place: int) -> bool:
        return equations[place].primitive.name == "concatenate" and len(equations[place].invars) > MOST_ROWS

    count = len(equations)
    read_last = {v: n for n, equation in enumerate(equations) for v in variables_of(equation.invars)}
    going_on = np.zeros(count + 2, int)  # how many more values are read by an equation or behind it than one before
    for n, equation in enumerate(equations):
        for made in equation.outvars:
            going_on[n + 1] += 1
            going_on[count + 1 if made in results else read_last.get(made, n) + 1] -= 1
    cost = np.cumsum(going_on)[: count + 1] + A_CALL  # of a cut before each equation and, added below, those before it
    begins, alike = [0], 0  # where a group begins that ends at each place, and where equations of its kind do
    for end in range(1, count + 1):
        if end > 1 and puts_together(end - 1) != puts_together(end - 2):
            alike = end - 1
        begins.append(max(alike, end - most))
        begins[end] += int(np.argmin(cost[begins[end] : end]))
        cost[end] += cost[begins[end]]
    groups, end = [], count
    while end:
        groups.append(equations[begins[end] : end])
        end = begins[end]
    return groups[::-1]


def _stored(equations: Sequence[core.JaxprEqn]) -> list[core.Var]:
    """Return values that XLA would compute more than once within a kernel: as results of the kernel they are stored.

    It fuses a value into all that reads it, and computes it there again, where it can do so everywhere. A result of the
    kernel it cannot fuse away. Storing and reading costs about as much as `STORED_FROM` operations.
    """
    uses: dict[core.Var, int] = {}
    for equation in equations:
        for variable in variables_of(equation.invars):
            again = 2 if equation.primitive.name == "broadcast_in_dim" else 1
            uses[variable] = uses.get(variable, 0) + again
    cost: dict[core.Var, int] = {}
    stored = []
    for equation in equations:
        own = equation.primitive.name not in _FREE
        for made in equation.outvars:
            cost[made] = own + sum(cost.get(variable, 0) for variable in variables_of(equation.invars))
            if own and uses.get(made, 0) > 1 and cost[made] >= STORED_FROM:
                stored.append(made)
                cost[made] = 0
    return stored


_FREE = {"slice", "reshape", "broadcast_in_dim", "concatenate"}  # no arithmetic


def _one_kernel(region: core.ClosedJaxpr, arguments: Sequence[Array]) -> list[Array]:
    """Return the results of a region, by a call that XLA:CPU compiles as a kernel."""
    joined = [e.outvars[0].aval for e in region.jaxpr.eqns if e.primitive.name == "concatenate"]
    if any(made.size * made.dtype.itemsize >= MOST_OF_A_CALL for made in joined):
        whole: list[Array] = core.jaxpr_as_fun(region)(*arguments)
        return whole
    return as_one_kernel(region)(*arguments)
