"""A function of one robot, carried out for a batch in regions: as XLA does it whole."""

import dataclasses
import functools
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jax.extend import core
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.execution import of_limbs, over_robots
from mjx_climb.execution.flat import flat

HERE = Path(__file__).parent
CHECK = """
import sys
sys.path.insert(0, sys.argv[1])
import jax
import jax.numpy as jnp
import numpy as np
import primitives
from mjx_climb.execution import over_robots

ROBOTS = 5
# by JAX's forward derivatives, of one robot; the largest of nothing has 0 / 0 there
NO_TANGENTS = ["custom_vjp_call", "nextafter", "callback", "clamp", "reductions of nothing"]
NEVER = np.zeros(3, bool)
jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(3)
vectors, matrix = rng.uniform(-2, 2, (ROBOTS, 3)), rng.uniform(-2, 2, (4, 3))
numbers = np.arange(-1, ROBOTS - 1, dtype=np.int32)

def walk_of(names):
    operations = [primitives.EVERY[name] for name in names]

    def walk(vector, number):
        def step(vector, _):
            made = [operation(vector, matrix * vector[0], number) for operation in operations]
            unread = jnp.where(NEVER, vector * 7, 1.0) * (number * 0) + ((number + 1 > 0) & False)
            same = jnp.where(number > 2, vector, jax.lax.stop_gradient(vector)) * jnp.clip(number - 1, 1, 1)
            return vector * 1.01 + unread + same, (made, vector.sum(0))

        return jax.lax.scan(step, vector, length=2)

    return walk

def carried_out(walk, tangents):
    batch = jax.vmap(walk)
    if tangents:
        return jax.jit(lambda v, n: jax.jvp(lambda v: batch(v, n), (v,), (v[::-1],)))(vectors, numbers)
    return jax.jit(batch)(vectors, numbers)

def agree(names, tangents):
    for start in range(0, len(names), 8):  # few programs, which compile sooner than many
        some = names[start : start + 8]
        print(some, tangents, flush=True)
        walk = walk_of(some)
        expected, found = (carried_out(each, tangents) for each in (walk, over_robots(walk)))
        for mine, xla in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert mine.dtype == xla.dtype
            if xla.dtype != jax.dtypes.float0:
                np.testing.assert_allclose(mine, xla, rtol=1e-12, atol=1e-12)

tangents = sys.argv[2] == "tangents"
without = ["other random bits", *(NO_TANGENTS if tangents else [])]  # bits have no vmap
agree([name for name in primitives.EVERY if name not in without], tangents)
print("all")
"""


@pytest.mark.nightly
@pytest.mark.parametrize("what", ["values", "tangents"])
def test_every_operation_in_regions(what):
    """In a process of its own, in float64 to 1e-12, with operations that call libraries and values nothing reads."""
    on_cpu = os.environ | {"JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CHECK, str(HERE), what]
    done = subprocess.run(command, env=on_cpu, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-3000:]
    assert done.stdout.splitlines()[-1] == "all"


def test_the_largest_of_nothing_is_a_constant():
    def walk(row: Array) -> Array:
        return jnp.maximum(row[:0].max(initial=0.5), 2 * row[0])

    values, tangents = jax.jvp(jax.vmap(over_robots(walk)), (np.eye(2),), (np.ones((2, 2)),))
    np.testing.assert_array_equal(values, [2.0, 0.5])
    np.testing.assert_array_equal(tangents, [2.0, 0.0])


def test_tangents_by_a_rule_of_ones_own():
    @jax.custom_jvp
    def waves(angle: Array) -> Array:
        return jnp.sin(angle) + jnp.cos(angle**2) * jnp.exp(angle)

    waves.defjvp(lambda given, tangents: (waves(*given), 3 * tangents[0]))  # no derivative: so it is seen
    angle = np.linspace(0, 1, 5)

    def function(angle: Array) -> Array:
        return waves(2 * angle) ** 2

    batch = jax.vmap(over_robots(function))
    value, tangent = jax.jit(lambda angle, along: jax.jvp(batch, (angle,), (along,)))(angle, angle)
    np.testing.assert_allclose(value, function(angle), rtol=1e-12)
    np.testing.assert_allclose(tangent, 2 * waves(2 * angle) * 3 * 2 * angle, rtol=1e-12)


@pytest.mark.parametrize("moving", [(0, 1), *(pytest.param(m, marks=pytest.mark.slow) for m in ((0,), (1,)))])
def test_a_loop_has_lax_scans_derivatives(moving):
    """By what it starts with and what it reads, forward and in reverse, of a batch and of one robot."""
    given = np.linspace(0.1, 1, 5), np.linspace(2, 3, 5)

    def walk(start: Array, stiffness: Array) -> Array:
        def step(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], Array]:
            angle, rate, pulled, count = carry
            pull = jnp.sin(angle) * stiffness
            return (angle + 0.1 * rate, rate - 0.1 * pull, pulled + rate**2, count + 1), jnp.maximum(angle, 0.3)

        zero = jnp.zeros_like(start)
        (*after, count), seen = jax.lax.scan(step, (start, zero, zero, 0), length=4)
        return jnp.stack([*after, *(seen * count)])

    def derivatives(walk):
        def ends(*moved):
            every = dict(enumerate(given)) | dict(zip(moving, moved, strict=True))
            return jax.vmap(walk)(every[0], every[1])

        some = tuple(given[place] for place in moving)
        return jax.jit(lambda *v: (jax.jvp(ends, v, v), jax.grad(lambda *v: ends(*v)[-1].sum())(*v)))(*some)

    for mine, theirs in zip(*(jax.tree.leaves(derivatives(each)) for each in (over_robots(walk), walk)), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12)


def test_a_loop_in_reverse_reads_and_writes_from_the_end():
    def walk(start: Array, read: Array) -> tuple[Array, Array]:
        return jax.lax.scan(lambda carry, now: (jnp.sin(carry) + now, carry * now), start, read, reverse=True)

    robots = np.linspace(0, 1, 5), np.linspace(1, 2, 15).reshape(5, 3)
    found, expected = jax.jit(jax.vmap(over_robots(walk, regions=True)))(*robots), jax.vmap(walk)(*robots)
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-12)


@pytest.mark.parametrize("outside", [0, 2])
def test_a_loop_carries_values_that_have_some_of_the_batch_axes(outside):
    """It begins with one axis of three, and each step adds another; the third, first or last, is none of the loop's."""

    def walk(*values: Array) -> Array:
        start, added = (value for place, value in enumerate(values) if place != outside)
        return values[outside] * jax.lax.fori_loop(0, 3, lambda _, carry: jnp.sin(carry) + added, start)

    def batch(walk):
        return jax.vmap(jax.vmap(jax.vmap(walk, (None, None, 0)), (None, 0, None)), (0, None, None))

    given = np.linspace(1, 2, 2), np.linspace(0, 1, 3), np.linspace(2, 3, 3)
    found = jax.jit(batch(over_robots(walk, regions=True)))(*given)
    np.testing.assert_allclose(found, batch(walk)(*given), rtol=1e-12)


def test_a_loop_that_carries_many_rows_copies_few_arrays():
    """XLA gives more than eight operations that could be next to several threads, for longer than a step takes."""

    def walk(start: Array) -> list[Array]:
        def step(carry: list[Array], number: Array) -> tuple[list[Array], None]:
            return [0.5 * a + jnp.sin(b) + number for a, b in zip(carry, [*carry[1:], carry[0]], strict=True)], None

        return jax.lax.scan(step, [start + n for n in range(40)], jnp.arange(5.0))[0]

    robots = np.linspace(0, 1, 16)
    program = jax.jit(jax.vmap(over_robots(walk, regions=True))).lower(robots).compile()
    [body] = re.findall(r"while\(.*body=(%[\w.]+)", program.as_text())
    step = program.as_text().split(f"\n{body} ")[1].split("\n}")[0]
    assert "call(" in step and len(re.findall(r" copy\(", step)) <= 8
    for mine, theirs in zip(program(robots), jax.vmap(walk)(robots), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12)


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:the CPU's regions cannot do")
def test_a_batch_of_two_shares_ends_by_mjx():
    """Much stands between its regions: two shares that worked it out at once would wait for each other for ever."""
    scenario, gains = mc.load_scenario("case_1_2", ["duration=0.02"]), {"stiffness": np.geomspace(1e2, 1e4, 256)}
    gains["stiffness"] = gains["stiffness"][:, None] * np.ones(6)
    mjx, limb = (mc.rollout_metrics(scenario, gains, engine=engine, dtype=np.float64) for engine in ("mjx", "limb"))
    np.testing.assert_allclose(mjx["peak_foot_force"], limb["peak_foot_force"], rtol=1e-6)


def test_what_regions_cannot_do_goes_by_xlas_own_way():
    """A function of one's own under `vmap`: 41 operations of a step that no rule knows; 40 go between regions."""
    rows = np.linspace(3, 1, 6).reshape(2, 3)

    def often(row: Array, count: int = 41) -> Array:
        return jax.lax.fori_loop(
            0, 2, lambda _, row: functools.reduce(lambda r, _: jax.lax.erf(1 - r), range(count), row), row
        )

    allowed = functools.partial(often, count=40)
    np.testing.assert_allclose(jax.vmap(over_robots(allowed, regions=True))(rows), jax.vmap(allowed)(rows), rtol=1e-12)
    with pytest.warns(
        UserWarning, match=r"the CPU's regions cannot do 41 operations as erf in one step, .*test_cpu_regions\.py:\d+"
    ):
        found = jax.vmap(over_robots(often))(rows)
    np.testing.assert_array_equal(found, jax.vmap(often)(rows))
    with pytest.raises(NotImplementedError, match="41 operations"):
        jax.vmap(over_robots(often, regions=True))(rows)


def test_what_a_law_prints_is_kept():
    """Though no result needs it; what has no effect is left out."""
    shown = lambda x: (jax.debug.print("{}", x), jnp.sin(x), 2 * x)[2]  # noqa: E731
    for function in (shown, jax.jit(shown), lambda x: jax.lax.fori_loop(0, 2, lambda _, y: shown(y), x)):
        equations = flat(jax.make_jaxpr(function)(1.0)).jaxpr.eqns
        inner = [each for equation in equations for program in core.jaxprs_in_params(equation.params)
                 for each in program.eqns]  # fmt: skip
        names = {equation.primitive.name for equation in inner or equations}
        assert "debug_print" in names and "mul" in names and "sin" not in names


def test_what_a_region_turns_out_not_to_write_stands_beside_it():
    """An operation that it knows, with a parameter that it does not."""

    def often(row: Array) -> Array:
        return jnp.sin(jax.lax.exp(2 * row, accuracy=jax.lax.AccuracyMode.DEFAULT) + 1) * row

    rows = np.linspace(-1, 1, 6).reshape(2, 3)
    text = jax.jit(jax.vmap(over_robots(often, regions=True))).lower(rows).as_text()
    assert "stablehlo.exponential" in text and text.count("xla_cpu_small_call") == 2
    found = jax.vmap(over_robots(often, regions=True))(rows)
    np.testing.assert_allclose(found, np.sin(np.exp(2 * rows) + 1) * rows, rtol=1e-12)


def test_limbs_that_are_marked_on_the_way_are_worked_out_together():
    """One operation for all of them, where they were a row of numbers before."""

    @dataclasses.dataclass(frozen=True)
    class Limbs:
        OF_LIMBS = ("angle",)
        angle: Float[Array, "limb joint"]

    def motion(row: Array, marked: bool) -> Array:
        limbs = Limbs(row.reshape(4, 3))
        angle = (of_limbs(limbs) if marked else limbs).angle
        return jnp.cos(angle) * jnp.sin(angle[::-1]) / (2 + jnp.exp(angle)) + angle[1:2] + angle.sum(0)

    rows = np.linspace(-1, 1, 24).reshape(2, 12)
    written = []
    for marked in (True, False):
        batch = jax.jit(jax.vmap(over_robots(functools.partial(motion, marked=marked))))
        np.testing.assert_allclose(batch(rows), jax.vmap(functools.partial(motion, marked=False))(rows), rtol=1e-12)
        written.append(batch.lower(rows).as_text().count("stablehlo.exponential"))
    assert written == [3, 12]


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:the CPU's regions cannot do")
def test_a_metric_with_large_arrays_is_as_by_numpy():
    """XLA works them out by several threads, and refuses a region that they are in."""
    rng = np.random.default_rng(1)
    first, second = (rng.normal(size=shape).astype(np.float32) for shape in ((512, 3), (4, 512)))

    def value(force, array):
        return abs(array.dot(second, array.tanh(array.dot(first, force)))).sum(0)

    net = mc.Metric(
        "net", "1", "a net of one's own", larger_is_better=False,
        init=lambda zero: zero,
        update=lambda running, sample, _: jnp.maximum(running, value(sample.foot_force[0], jnp)),
        finish=lambda running, _: running,
    )  # fmt: skip
    scenario = mc.load_scenario("case_1_2", ["duration=0.01"])
    gains = {"stiffness": np.full((193, 6), 3e3)}
    found = mc.rollout_metrics(scenario, gains, metrics=(*mc.METRICS, net), dtype=np.float64)
    forces = mc.rollout(scenario, {"stiffness": np.full(6, 3e3)}).foot_force[:, 0]
    np.testing.assert_allclose(found["net"], value(forces.T, np).max(), rtol=1e-9)


def test_a_branch_with_a_loop_is_carried_out_where_a_robot_takes_it():
    """Values, derivatives, and bits that do not depend on the branch of a neighbour."""

    def choose(number, vector):
        def far(carry, add):
            return (jnp.maximum(carry[0] * 0.9, add), carry[1] + 1), None

        def loop():
            return jax.lax.scan(far, (vector, 0), jnp.arange(5.0))[0]

        one, count = jax.lax.cond(number > 0, loop, lambda: (vector, 7))
        return one.sum() + number, count

    numbers, vectors = jnp.array([1.0, -1.0, 2.0, -3.0]), jnp.arange(12.0).reshape(4, 3) / 3
    fast, plain = jax.jit(jax.vmap(over_robots(choose))), jax.vmap(choose)
    assert re.search(r"stablehlo\.(case|if)\b", fast.lower(numbers, vectors).as_text())
    for some in (numbers, -jnp.abs(numbers), jnp.abs(numbers)):
        found, expected = fast(some, vectors), plain(some, vectors)
        np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
        np.testing.assert_array_equal(found[1], expected[1])
    np.testing.assert_array_equal(fast(numbers, vectors)[0][1::2], fast(-jnp.abs(numbers), vectors)[0][1::2])
    tangents = jax.jvp(lambda v: fast(numbers, v)[0], (vectors,), (jnp.ones_like(vectors),))[1]
    np.testing.assert_allclose(
        tangents, jax.jvp(lambda v: plain(numbers, v)[0], (vectors,), (jnp.ones_like(vectors),))[1]
    )


def test_products_are_of_whole_single_precision_on_gpus_too():
    """There XLA's own are of ten bits."""
    product = over_robots(lambda matrix: matrix @ matrix, regions=False)
    text = jax.jit(product).lower(np.ones((3, 3), "f4")).as_text()
    assert text.count("dot_general") == text.count("precision = [HIGHEST, HIGHEST]") == 1
