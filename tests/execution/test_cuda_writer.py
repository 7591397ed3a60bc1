"""Kernels in CUDA C, built by the machine's C++ compiler and run on the CPU, a thread for each lane, against XLA."""

import ctypes
import dataclasses
import functools
import itertools
import math
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float

from mjx_climb.control import law_of
from mjx_climb.execution import of_limbs
from mjx_climb.execution.cuda_writer import CudaWriter
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.flat import tangents_of
from mjx_climb.execution.gpu_kernel import body_of, written
from mjx_climb.rollouts.resolve import resolve_in
from mjx_climb.rollouts.walks import metrics_of
from mjx_climb.walk.structure import structure
from tests.execution import primitives

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")
STEPS = 120


def words(values):
    return np.concatenate([np.zeros(0, np.int32), *(np.asarray(v).reshape(-1).view(np.int32) for v in values)])


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Build kernels, by name, into one library; return a function of (name, own, common, rows) that runs one."""

    def build(kernels):
        folder = tmp_path_factory.mktemp("kernels")
        parts = [f'#include "{HERE / "on_cpu.hpp"}"']
        for number, (text, threads) in enumerate(kernels.values()):
            inside = text.replace('extern "C" ', "")
            parts.append(f"namespace k{number} {{\n{inside}}}")
            parts.append(
                f'extern "C" void run{number}(const int *own, const int *common, int *made) '
                f"{{ run(k{number}::walk, {threads}, own, common, made); }}"
            )
        (folder / "kernels.cpp").write_text("\n".join(parts))
        command = ["c++", "-std=c++20", "-O1", "-w", "-shared", "-fPIC", "-pthread", "-o", "kernels.so", "kernels.cpp"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        library = ctypes.CDLL(str(folder / "kernels.so"))

        def run(name, own, common, rows):
            made = np.zeros(rows, np.int32)
            given = [np.ascontiguousarray(array).ctypes.data_as(ctypes.c_void_p) for array in (own, common, made)]
            getattr(library, f"run{list(kernels).index(name)}")(*given)
            return made

        return run

    return build


def of_words(made, avals):
    ends = list(itertools.accumulate(math.prod(aval.shape) for aval in avals))
    for part, aval in zip(np.split(made, ends[:-1]), avals, strict=True):
        yield (part != 0 if aval.dtype == bool else part.view(aval.dtype)).reshape(aval.shape)


def arguments():
    rng = np.random.default_rng(5)
    return rng.uniform(-2.5, 2.5, 3).astype("f4"), rng.uniform(-2.5, 2.5, (4, 3)).astype("f4"), np.int32(-2)


def test_every_operation_in_cuda_c(built):
    """All that kernels know, in single precision, but for what is of other types: to 1e-5, whole numbers the same."""
    programs, kernels = {}, {}
    with jax.enable_x64(False):
        for name, operation in primitives.KNOWN.items():
            program = jax.make_jaxpr(lambda v, m, n, f=operation: f(v, m * v[1], n))(*arguments())
            try:
                kernels[name] = written(body_of(program), [True, False, True]), 1
            except Unsupported as error:
                assert "int8" in str(error)
                continue
            programs[name] = program
        assert len(kernels) >= len(primitives.KNOWN) - 1
        run = built(kernels)
        vector, matrix, number = arguments()
        for name, program in programs.items():
            rows = sum(math.prod(aval.shape) for aval in program.out_avals)
            made = run(name, words([vector, number]), words([np.int32(1), matrix]), rows)
            expected = jax.jit(jax.extend.core.jaxpr_as_fun(program))(vector, matrix, number)
            for mine, xla in zip(of_words(made, program.out_avals), expected, strict=True):
                if np.issubdtype(mine.dtype, np.floating):
                    np.testing.assert_allclose(mine, xla, rtol=1e-5, atol=1e-6, err_msg=name)
                else:
                    np.testing.assert_array_equal(mine, xla, err_msg=name)


def short_walk(case, steps):
    """Return a robot's walk that lifts, lands and is pushed, as a function of its arguments, and these."""
    push = {"start": 0.01, "stop": 0.05, "force": [3.0, 0.0, 1.0], "moment": [0.0, 0.5, 0.0]}
    gait = {"gait.cycle": 0.4, "gait.stride": 0.005, "gait.step_height": 0.002}
    scenario = case("case_1_2", "virtual_model", {**gait, "disturbance.pushes": [push]}.items())
    found = resolve_in(scenario, law_of(scenario), None, None, np.float32)
    shape = structure(scenario, "limb", found.parameters, law=found.law)._replace(steps=steps)
    return functools.partial(metrics_of, shape), (found.law, found.parameters)


def doubled(value):
    return np.asarray(value, np.float64) if np.asarray(value).dtype.kind == "f" else value


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Limbs:
    """Values of four limbs."""

    values: Float[jax.Array, "limb n"]


def exchanges(step, size=1):
    """Return how often in a loop's step the lanes of a robot, one for each limb, ask each other.

    The step carries values of the limbs (4, size), a quaternion and a number ().
    """

    def function(start, quaternion):
        limbs = of_limbs(Limbs(start)).values
        return jax.lax.scan(lambda carry, _: (step(*carry), None), (limbs, quaternion, jnp.zeros(())), length=3)[0][2]

    with jax.enable_x64(False):
        program = jax.make_jaxpr(function)(np.ones((4, size), "f4"), np.ones(4, "f4"))
    text = written(body_of(program), [False, False])
    return text.split("#pragma unroll 1")[1].count("__shfl_")


def test_a_sum_over_joints_and_limbs_is_first_of_each_limbs_own():
    """Two exchanges are a sum over four lanes."""
    assert exchanges(lambda limbs, q, total: (jnp.sin(limbs), q, total + limbs.sum((0, 1))), 3) == 2
    assert exchanges(lambda limbs, q, total: (jnp.sin(limbs), q, total + limbs.sum(0).sum(0)), 3) == 3 * 2


def test_limbs_in_two_other_orders_take_an_exchange_each():
    def step(limbs, quaternion, total):
        return limbs[::-1] * jnp.roll(jnp.sin(limbs), 1, axis=0), quaternion, total + limbs.sum()

    assert exchanges(step) == 2 + 2


def test_a_quaternion_is_no_four_limbs():
    """A loop leaves it in all lanes, where the step takes it apart."""

    def turned(limbs, quaternion, total):
        w, x, y, z = quaternion
        return jnp.sin(limbs), jnp.stack([w * 0.9, x + w, y - x, z * z]), total + w

    assert exchanges(turned) == 0


def test_what_nothing_is_made_of_is_not_written():
    """NVIDIA's compiler keeps exchanges that nothing reads."""

    def summed(limbs, quaternion, total):
        jnp.cos(limbs).sum()
        return jnp.sin(limbs), quaternion, total + limbs.sum()

    assert exchanges(summed) == 2


@pytest.mark.slow
def test_a_walk_in_cuda_c(built, case):
    """Metrics of a walk in single precision, by a thread for each limb, agree with XLA's in float64 to 1e-4."""
    with jax.enable_x64(False):
        walk, given = short_walk(case, STEPS)
        leaves = jax.tree.leaves(given)
        program = jax.make_jaxpr(walk)(*given)
        text = written(body_of(program), [False] * len(leaves))
        rows = sum(math.prod(aval.shape) for aval in program.out_avals)
        run = built({"walk": (text, CudaWriter(4).width)})
        made = run("walk", words([]), words([np.int32(1), *leaves]), rows)
    expected = jax.jit(walk)(*jax.tree.map(doubled, given))
    assert expected["force_variation"].dtype == np.float64
    names = sorted(expected)
    assert expected["force_variation"] > 0.1
    for name, mine in zip(names, of_words(made, program.out_avals), strict=True):
        # a pull is what is left of a foot's force along the normal, and has the rounding of that whole force
        rounding = 1e-4 * float(expected["peak_foot_force"]) if name == "peak_pull_force" else 1e-5
        np.testing.assert_allclose(mine, expected[name], rtol=1e-4, atol=rounding, err_msg=name)


@pytest.mark.nightly
def test_tangents_of_a_walk_in_cuda_c(built, case):
    """Single precision tangents by the logarithm of the damping agree with central differences in float64 to 1e-3."""
    with jax.enable_x64(False):
        # two steps later the largest torques of two instants are as one to single precision
        walk, (law, numbers) = short_walk(case, STEPS - 5)
        arguments = (law.damping, law, numbers)
        program = jax.make_jaxpr(lambda damping, law, numbers: walk(dataclasses.replace(law, damping=damping), numbers))
        both, moved = tangents_of(program(*arguments), [n == 0 for n in range(len(jax.tree.leaves(arguments)))])
        body, leaves = body_of(both), jax.tree.leaves((*arguments, law.damping))
        text = written(body, [False] * len(leaves))
        rows = sum(math.prod(aval.shape) for aval in body.program.out_avals)
        made = built({"walk": (text, CudaWriter(4).width)})("walk", words([]), words([np.int32(1), *leaves]), rows)
    found = list(of_words(made, body.program.out_avals))

    step = 1e-4
    law, numbers = jax.tree.map(np.float64, (law, numbers))
    sides = law.damping * np.array([[1 + step], [1 - step]])
    both = jax.vmap(lambda damping: walk(dataclasses.replace(law, damping=damping), numbers))
    expected = jax.jit(both, compiler_options={"xla_disable_hlo_passes": "fusion"})(sides)
    tangents = iter(found[len(expected) :])
    for name, moves in zip(sorted(expected), moved, strict=True):
        more, less = expected[name]
        tangent = next(tangents) if moves else np.zeros(more.shape)
        if np.issubdtype(more.dtype, np.floating):
            difference = np.nan_to_num((more - less) / (2 * step))  # nobody is torn off: not a number
            np.testing.assert_allclose(tangent, difference, rtol=1e-3, atol=1e-7, err_msg=name)
    assert next(tangents, None) is None
