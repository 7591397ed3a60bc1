"""Every operation in a step that is cut into pieces: as XLA does it whole; XLA stops the process where it cannot."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import mjx_climb as mc
from mjx_climb.compilation.cpu_pieces import in_kernels

HERE = Path(__file__).parent
CHECK = """
import sys
sys.path.insert(0, sys.argv[1])
import jax
import jax.numpy as jnp
import numpy as np
import primitives
from mjx_climb.compilation.cpu_pieces import in_kernels

ROBOTS = 5
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

def walk(step):
    return jax.jit(lambda vector: jax.lax.scan(step, vector, length=2))(vector)

names = [name for name in primitives.EVERY if name != "other random bits"]  # which have no vmap
for start in range(0, len(names), 12):  # few programs, which compile sooner than many
    some = names[start : start + 12]
    print(some, flush=True)
    expected, found = walk(step_of(some)), walk(in_kernels(step_of(some), 6))
    for mine, xla in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, xla, rtol=1e-12, atol=1e-12)
print("all")
"""


@pytest.mark.slow
def test_every_operation_in_pieces():
    """In a process of its own, in float64 to 1e-12, with operations that call libraries and values nothing reads."""
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
