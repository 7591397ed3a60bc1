"""Every operation in a step that is cut into pieces: as XLA does it whole; XLA stops the process where it cannot."""

import functools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jax._src.interpreters.ad import jvp_jaxpr

import mjx_climb as mc
from mjx_climb.compilation import cpu_pieces
from mjx_climb.compilation.cpu_pieces import in_kernels, scan_in_kernels

HERE = Path(__file__).parent
CHECK = """
import functools
import sys
sys.path.insert(0, sys.argv[1])
import jax
import jax.numpy as jnp
import numpy as np
import primitives
from mjx_climb.compilation.cpu_pieces import in_kernels, scan_in_kernels

ROBOTS = 5
NO_SLOPES = ["custom_vjp_call", "nextafter", "callback"]  # by JAX's forward derivatives
NEVER = np.zeros((3, 1), bool)
jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(3)
vector, matrix = rng.uniform(-2, 2, (3, ROBOTS)), rng.uniform(-2, 2, (4, 3, ROBOTS))
number = np.arange(-1, ROBOTS - 1, dtype=np.int32)

def step_of(names):
    operations = [jax.vmap(primitives.EVERY[name], in_axes=-1, out_axes=-1) for name in names]

    def step(vector, _):
        made = [operation(vector, matrix * vector[0], number) for operation in operations]
        unread = jnp.where(NEVER, vector * 7, 1.0) * (number * 0) + ((number + 1 > 0) & False)
        same = jnp.where(number > 2, vector, jax.lax.stop_gradient(vector)) * jnp.clip(number - 1, 1, 1)
        return vector * 1.01 + unread + same, (made, vector.sum(0))

    return step

def walk(scan, step, slopes):
    def function(vector):
        return scan(step, vector, length=2)

    if slopes:
        return jax.jit(lambda vector: jax.jvp(function, (vector,), (vector[::-1],)))(vector)
    return jax.jit(function)(vector)

def agree(names, slopes):
    for start in range(0, len(names), 12):  # few programs, which compile sooner than many
        some = names[start : start + 12]
        print(some, slopes, flush=True)
        step = step_of(some)
        expected = walk(jax.lax.scan, step, slopes)
        others = [walk(functools.partial(scan_in_kernels, equations=6), step, slopes)]
        if not slopes:
            others.append(walk(jax.lax.scan, in_kernels(step, 6), slopes))
        for found in others:
            for mine, xla in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
                assert mine.dtype == xla.dtype
                if xla.dtype != jax.dtypes.float0:
                    np.testing.assert_allclose(mine, xla, rtol=1e-12, atol=1e-12)

names = [name for name in primitives.EVERY if name != "other random bits"]  # which have no vmap
agree(names, slopes=False)
agree([name for name in names if name not in NO_SLOPES], slopes=True)
print("all")
"""


@pytest.mark.slow
def test_every_operation_in_pieces():
    """In a process of its own, in float64 to 1e-12, with operations that call libraries and values nothing reads.

    And their slopes.
    """
    on_cpu = os.environ | {"JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CHECK, str(HERE)]
    done = subprocess.run(command, env=on_cpu, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-3000:]
    assert done.stdout.splitlines()[-1] == "all"


def test_what_a_function_says_twice_is_worked_out_once():
    """Also where pieces lie between, and where it went through a stack; what differs in one number stays apart."""

    def twice(angle: Array) -> Array:
        first = jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        between = first[0] * first[1] + jnp.exp(angle)
        again = jnp.stack([jnp.sin(angle), between], axis=1)
        return again[:, 0] * jnp.sin(angle + 1) - jnp.sin(angle + 2) * again[:, 1]

    angle = np.linspace(0, 1, 5)
    program = str(jax.make_jaxpr(in_kernels(twice, 3))(angle))
    assert {name: program.count(f" {name} ") for name in ("sin", "cos", "exp")} == {"sin": 3, "cos": 1, "exp": 1}
    assert "[5,1]" not in program
    np.testing.assert_allclose(jax.jit(in_kernels(twice, 3))(angle), twice(angle), rtol=1e-6)


def test_slopes_by_a_rule_of_ones_own():
    """Also where a piece ends within what has the rule: slopes are taken of the whole, and then cut."""

    @jax.custom_jvp
    def waves(angle: Array) -> Array:
        return jnp.sin(angle) + jnp.cos(angle**2) * jnp.exp(angle)

    waves.defjvp(lambda given, rates: (waves(*given), 3 * rates[0]))  # no derivative: so it is seen
    angle = np.linspace(0, 1, 5)

    def function(angle: Array) -> Array:
        return waves(2 * angle) ** 2

    value, slope = jax.jit(lambda angle, rate: jax.jvp(in_kernels(function, 2), (angle,), (rate,)))(angle, angle)
    np.testing.assert_allclose(value, function(angle), rtol=1e-12)
    np.testing.assert_allclose(slope, 2 * waves(2 * angle) * 3 * 2 * angle, rtol=1e-12)


@pytest.mark.parametrize("moving", [(0, 1), (0,), (1,)])
def test_a_loop_in_pieces_has_lax_scans_slopes(moving):
    """By what it starts with and what it reads, forward and in reverse, where one step's rates begin in another."""
    given = np.linspace(0.1, 1, 5), np.linspace(2, 3, 5)

    def walked(scan: Callable[..., Any], *values: Array) -> tuple[Array, ...]:
        every = dict(enumerate(given)) | dict(zip(moving, values, strict=True))
        start, stiffness = every[0], every[1]

        def step(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], Array]:
            angle, rate, pulled, count = carry
            pull = jnp.sin(angle) * stiffness
            return (angle + 0.1 * rate, rate - 0.1 * pull, pulled + rate**2, count + 1), jnp.maximum(angle, 0.3)

        zero = jnp.zeros_like(start)
        (*after, count), seen = scan(step, (start, zero, zero, 0), length=4)
        return *after, seen * count

    def slopes(scan: Callable[..., Any]) -> Any:
        of_it = functools.partial(walked, scan)
        some = tuple(given[place] for place in moving)
        return jax.jit(lambda *v: (jax.jvp(of_it, v, v), jax.grad(lambda *v: of_it(*v)[-1].sum())(*v)))(*some)

    same = functools.partial(np.testing.assert_allclose, rtol=1e-12)
    jax.tree.map(same, slopes(functools.partial(scan_in_kernels, equations=2)), slopes(jax.lax.scan))


def test_rates_of_a_step_in_pieces_are_traced_once(monkeypatch):
    """`jax.lax.scan` does it again for every number that rates reach one step later."""
    traced = []

    def tracing(program: Any, moving: list[bool], **options: Any) -> Any:
        traced.append(moving)
        return jvp_jaxpr(program, moving, **options)

    def step(carry: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], None]:
        first, second, third, still = carry
        return (jnp.sin(first), jnp.sin(first + second), jnp.sin(second + third), jnp.sin(still)), None

    def ends(scan: Callable[..., Any], start: Array) -> Array:
        zero = jnp.zeros_like(start)
        return scan(step, (start, zero, zero, zero), length=3)[0]

    monkeypatch.setattr(cpu_pieces, "jvp_jaxpr", tracing)
    jax.jvp(functools.partial(ends, scan_in_kernels), (np.ones(3),), (np.ones(3),))
    assert traced == [[True, True, True, False]]


@pytest.mark.slow
def test_a_step_with_large_arrays_is_compiled_whole():
    """XLA works them out by several threads, and refuses the piece that they are in."""
    rng = np.random.default_rng(1)
    first, second = (rng.normal(size=shape).astype(np.float32) for shape in ((512, 3), (4, 512)))

    def value(force, array):
        return abs(array.dot(second, array.tanh(array.dot(first, force)))).sum(0)

    net = mc.Metric(
        "net", "1", "a net of one's own", larger_is_better=False,
        init=lambda zero: zero,
        update=lambda running, sample, _: jnp.maximum(running, value(sample.foot_force[:, 0], jnp)),
        finish=lambda running, _: running,
    )  # fmt: skip
    scenario = mc.load_scenario("case_1_2", ["duration=0.01"])
    with pytest.warns(UserWarning, match="a step in pieces cannot do"):
        found = mc.rollout_metrics(scenario, {"stiffness": np.full((193, 6), 3e3)}, metrics=(*mc.METRICS, net))
    forces = mc.rollout(scenario, {"stiffness": np.full(6, 3e3)}).foot_force[:, 0]
    np.testing.assert_allclose(found["net"], value(forces.T, np).max(), rtol=1e-4)
