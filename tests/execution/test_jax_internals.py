"""What JAX does not document, as this package needs it: the tests that fail first when JAX changes.

Quick, so that they run with every JAX that pyproject.toml lets in: see docs/explanation/execution.md.
"""

import inspect
import os
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend import core

from mjx_climb.execution import cache, jax_internals, one_robot
from mjx_climb.execution.flat import flat
from mjx_climb.execution.limbs import of_limbs
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot

HERE = os.path.basename(__file__)


def only(function, *arguments):
    """The one equation of a function."""
    [equation] = jax.make_jaxpr(function)(*arguments).jaxpr.eqns
    return equation


def test_every_name_has_a_test():
    functions = {n for n, f in inspect.getmembers(jax_internals, inspect.isfunction) if f.__module__.startswith("mjx")}
    assert {f"test_{name}" for name in functions} <= globals().keys()


def test_jvp_jaxpr():
    program = jax.make_jaxpr(lambda x, y: (x * y, jnp.cos(y)))(1.0, 2.0)
    both, moved = jax_internals.jvp_jaxpr(program, (True, False), instantiate=False)
    assert list(moved) == [True, False]
    np.testing.assert_allclose(core.jaxpr_as_fun(both)(1.0, 2.0, 3.0), [2.0, np.cos(2.0), 6.0])


@jax.custom_jvp
def own_jvp(x):
    return jnp.sin(x)


own_jvp.defjvp(lambda given, tangents: (own_jvp(*given), tangents[0]))


@jax.custom_vjp
def own_vjp(x):
    return jnp.sin(x)


own_vjp.defvjp(lambda x: (jnp.sin(x), None), lambda _, change: (change,))


@pytest.mark.parametrize("call", [jax.jit(jnp.sin), jax.checkpoint(jnp.sin), own_jvp, own_vjp])
def test_inner_program(call):
    inner = jax_internals.inner_program(only(call, 0.5))
    np.testing.assert_allclose(core.jaxpr_as_fun(inner)(0.5), [np.sin(0.5)])
    assert jax_internals.inner_program(only(lax.sin, 0.5)) is None


def test_scan_sizes():
    def loop(first, second, carry, read):
        return lax.scan(lambda c, r: ((c[0] + first, c[1] + r, c[2] * second), r), carry, read)

    equation = only(loop, 1.0, 2.0, (0.0, 0.0, 1.0), jnp.ones(4))
    assert jax_internals.scan_sizes(equation.params) == (2, 3)
    assert equation.params["length"] == 4 and equation.params["reverse"] is False


def test_without_unread():
    """A loop carries no more than its results that are read depend on; all arguments stay."""

    def loop(first, second):
        return lax.scan(
            lambda c, _: ((c[0] * 2, c[1] + jnp.sin(c[1]), c[2] + c[0]), None), (first, second, 0.0), length=3
        )

    program = jax.make_jaxpr(lambda *given: loop(*given)[0][2])(1.0, 2.0)
    less = jax_internals.without_unread(program)
    assert "sin" in str(program) and "sin" not in str(less)
    np.testing.assert_allclose(core.jaxpr_as_fun(less)(1.0, 2.0), [7.0])


def test_arguments_of():
    program = jax.make_jaxpr(lambda a, b, c: (a + b, jnp.sin(c)))(1.0, 2.0, 3.0)
    assert jax_internals.arguments_of(program, [True, False]) == [True, True, False]
    assert jax_internals.arguments_of(program, [False, True]) == [False, False, True]


def test_with_inner():
    """The body of a loop and the branches of a condition are where they are looked for."""
    for function in (
        lambda x: lax.scan(lambda c, _: (jnp.sin(c), None), x, length=2)[0],
        lambda x: lax.switch(jnp.int32(x), [jnp.sin, jnp.cos], x),
    ):
        equation = jax.make_jaxpr(function)(0.5).jaxpr.eqns[-1]
        assert equation.primitive.name in ("scan", "cond")
        inner = list(core.jaxprs_in_params(jax_internals.with_inner(flat, equation)))
        assert inner and not set(map(id, inner)) & set(map(id, core.jaxprs_in_params(equation.params)))


def test_carried_out():
    """Of an operation with functions among its parameters too."""
    for function, value in ((lax.sin, 0.5), (own_jvp, 0.5), (lambda x: lax.sort((x, x), num_keys=1), jnp.ones(3))):
        equation = only(function, value)
        found = jax_internals.carried_out(equation.primitive, equation.params, [value] * len(equation.invars))
        np.testing.assert_allclose(found[0], function(value)[0] if len(found) > 1 else function(value))


def test_outside_of_xlas_cache(tmp_path):
    """A program that is compiled so is not there, and the next one is."""
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        with cache.cache_in(str(tmp_path)):
            with jax_internals.outside_of_xlas_cache():
                jax.jit(lambda x: 3.0 * x).lower(1.0).compile()
            assert not [*tmp_path.iterdir()]
            jax.jit(lambda x: 5.0 * x).lower(1.0).compile()
            assert [*tmp_path.iterdir()]
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)


def test_line_of():
    assert HERE in jax_internals.line_of(only(lambda x: lax.sin(x), 0.5))


def test_from_line_of():
    known = only(lambda x: lax.sin(x), 0.5)

    def again(x):
        with jax_internals.from_line_of(known):
            return lax.cos(x)

    assert jax_internals.line_of(only(again, 0.5)) == jax_internals.line_of(known) != ""


def test_prepare_for():
    """LAPACK is found without a lowering; a program without it asks for none."""
    jax_internals.prepare_for(b"an executable that calls lapack_dpotrf_ffi")
    jax_internals.prepare_for(b"another")


def test_register_reverse_mode():
    """Under a checkpoint, which saves nothing: the operation is split as a call is."""
    from mjx_climb.execution import over_robots

    square = over_robots(lambda x: jnp.sin(x) ** 2)
    for function in (square, jax.checkpoint(square)):
        np.testing.assert_allclose(jax.grad(function)(0.3), np.sin(0.6), rtol=1e-12)


def test_new_program():
    program = jax.make_jaxpr(lambda x: (jnp.sin(x), jnp.cos(x)))(0.5)
    jaxpr = program.jaxpr
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # JAX's of a program without its origin
        part = jax_internals.new_program(jaxpr, jaxpr.eqns[:1], jaxpr.invars, jaxpr.eqns[0].outvars)
    np.testing.assert_allclose(core.jaxpr_as_fun(part)(0.5), [np.sin(0.5)])


def test_devices_have_begun():
    jnp.zeros(1).block_until_ready()
    assert jax_internals.devices_have_begun() is True


def test_settings():
    assert {"jax_compilation_cache_dir", "jax_default_device", "jax_enable_x64"} <= jax_internals.settings().keys()


def test_as_one_kernel():
    """One call of a kernel, whatever is in it; the name is known to XLA, which does not read others."""
    x, y = jnp.ones(64), jnp.full(64, 2.0)
    program = jax.make_jaxpr(lambda x, y: [jnp.exp(jnp.sin(x) * jnp.cos(x)), x + y, x - y])(x, y)
    compiled = jax.jit(jax_internals.as_one_kernel(program)).lower(x, y).compile()
    text = compiled.as_text()
    assert 'xla_cpu_small_call="true"' in text and text.count(" call(") == 1
    for found, expected in zip(compiled(x, y), (np.exp(np.sin(1.0) * np.cos(1.0)), 3.0, -1.0), strict=True):
        np.testing.assert_allclose(found, np.full(64, expected), rtol=1e-6)


def test_launched():
    made = jax.ShapeDtypeStruct((3,), np.int32)
    call = jax.jit(lambda x: jax_internals.launched("PTX", "walk", 2, 128, made, x))
    text = call.trace(jnp.ones(3, jnp.int32)).lower(lowering_platforms=("cuda",)).as_text()
    assert jax_internals.LAUNCH in text and 'kernel_data = "PTX"' in text and 'name = "walk"' in text
    numbers = {"grid_x": 2, "grid_y": 1, "grid_z": 1, "block_x": 128, "block_y": 1, "block_z": 1, "shared_mem_bytes": 0}
    assert all(f"{name} = {number} : i32" in text for name, number in numbers.items())


@pytest.mark.parametrize(("option", "value"), [(jax_internals.LEVEL, 1), (jax_internals.WIDTH, 512)])
def test_options_of_the_compiler_are_known(option, value):
    """XLA refuses an option that it does not know."""
    jax.jit(lambda x: x + 1, compiler_options={option: value}).lower(1.0).compile()


@pytest.mark.parametrize("kind", [Robot, State])
def test_the_limbs_are_declared_where_shapes_begin_with_them(kind):
    declared = {
        name
        for name, hint in inspect.get_annotations(kind).items()
        for part in getattr(hint, "__args__", (hint,))
        if getattr(part, "dim_str", "").removeprefix("*batch ").split(" ")[0] == "limb"
    }
    assert declared == {*kind.OF_LIMBS}


def test_what_declares_no_limbs_is_refused():
    with pytest.raises(TypeError, match=r"^float: expected a class with OF_LIMBS, the fields whose first axis is the"):
        of_limbs(1.0)


def test_take_tables_in_each_precision():
    """A table of a program in double precision, which lives on, is single in the next one that is; once in each."""
    table = np.arange(1.0, 7.0).reshape(2, 3)

    def function(vector):
        return lax.fori_loop(0, 3, lambda _, turned: (table * turned).sum(0) + (table - turned).sum(0), vector)

    expected, programs = np.ones(3), []
    for _ in range(3):
        expected = (table * expected).sum(0) + (table - expected).sum(0)
    for double in (True, False, True):
        with jax.enable_x64(double):
            vector = np.ones(3, np.float64 if double else np.float32)
            programs.append(jax.make_jaxpr(function)(vector))
            found = one_robot.over_robots(function, regions=True)(vector)
            tangents = jax.jit(lambda x: jax.jvp(one_robot.over_robots(function), (x,), (x,))[1])(vector)
        assert [constant.dtype for constant in programs[-1].consts] == [vector.dtype]
        assert found.dtype == tangents.dtype == vector.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6)
