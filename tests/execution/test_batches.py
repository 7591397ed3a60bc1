"""Batches of a small function: values, tangents and gradients as a loop over the robots has them."""

import itertools
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.control import PD
from mjx_climb.execution import batches, paths
from mjx_climb.execution.batches import Robots, flattened, run, run_one, shapes_of

K = 2


def small(factor, own, shared):
    """Results that are real numbers, whole numbers and truth values."""
    gain, steps = own["gain"], shared["steps"]
    return {
        "real": factor * jnp.sin(gain) * shared["weight"],
        "sum": (gain**2).sum() * steps,
        "whole": steps + 1,
        "true": gain[0] > shared["weight"],
    }


def by_hand(factor, gain, weight, steps):
    return {
        "real": factor * np.sin(gain) * weight,
        "sum": (gain**2).sum() * steps,
        "whole": steps + 1,
        "true": gain[0] > weight,
    }


def drawn(shape, own, shared, dtype, seed=0):
    """The arguments of a batch: gains and weights with leading axes of their own."""
    rng = np.random.default_rng(seed)
    gain, weight = rng.normal(size=(*own, 3)).astype(dtype), rng.normal(size=shared).astype(dtype)
    steps = np.asarray(rng.integers(1, 5, own), np.int32)
    arguments = {"gain": gain}, {"weight": weight, "steps": steps}
    each = np.broadcast_to(gain, (*shape, 3)), np.broadcast_to(weight, shape), np.broadcast_to(steps, shape)
    return Robots(arguments, ({"gain": 1}, {"weight": 0, "steps": 0}), shape), each


SHAPES = [((), (), ()), ((1,), (1,), ()), ((3,), (3,), (1,)), ((3,), (), ()), ((2, 3), (2, 1), (3,)),
          ((2, 2), (2, 2), (2, 2))]  # fmt: skip


@pytest.mark.parametrize(("shape", "own", "shared"), SHAPES)
@pytest.mark.parametrize("derivatives", ["", "tangents", "gradients"])
def test_a_batch_is_a_loop_over_its_robots(shape, own, shared, derivatives):
    robots, each = drawn(shape, own, shared, np.float64)
    rng = np.random.default_rng(1)
    along = {"gain": rng.normal(size=(*shape, K, 3))}
    weights = {"real": rng.normal(size=(*shape, K, 3)), "sum": rng.normal(size=(*shape, K))}
    asked = {"": {}, "tangents": {"directions": along}, "gradients": {"weights": weights}}[derivatives]
    found = run(small, 2.0, robots._replace(**asked), batch_size=2)
    values, derived = found if derivatives else (found, {})
    assert set(values) == {"real", "sum", "whole", "true"}
    assert set(derived) == {"": set(), "tangents": {"real", "sum"}, "gradients": {"gain"}}[derivatives]
    for place in itertools.product(*map(range, shape)):
        gain, weight, steps = (value[place] for value in each)
        for name, expected in by_hand(2.0, gain, weight, steps).items():
            assert values[name].shape[: len(shape)] == shape
            np.testing.assert_allclose(values[name][place], expected, rtol=1e-12, err_msg=name)
        slopes = 2.0 * np.cos(gain) * weight, 2 * gain * steps
        if derivatives == "tangents":
            rate = along["gain"][place]
            np.testing.assert_allclose(derived["real"][place], rate * slopes[0], rtol=1e-12)
            np.testing.assert_allclose(derived["sum"][place], rate @ slopes[1], rtol=1e-12)
        if derivatives == "gradients":
            expected = weights["real"][place] * slopes[0] + np.multiply.outer(weights["sum"][place], slopes[1])
            np.testing.assert_allclose(derived["gain"][place], expected, rtol=1e-12)
    assert values["whole"].dtype == np.int32 and values["true"].dtype == bool


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_batch_keeps_the_precision_of_its_arrays_and_tells_of_its_shares(dtype):
    robots, each = drawn((5,), (5,), (), dtype)
    seen = []
    found = run(small, 0.5, robots, batch_size=2, progress=lambda *so_far: seen.append(so_far))
    assert found["real"].dtype == dtype and found["real"].shape == (5, 3)
    assert seen[-1] == (5, 5) and [done for done, _ in seen] == sorted({done for done, _ in seen}) and len(seen) == 3
    of_one = run_one(small, 0.5, *jax.tree.map(lambda value: value[0] if value.ndim else value, robots.arguments))
    assert all(isinstance(value, np.ndarray) for value in of_one.values()) and of_one["real"].dtype == dtype
    tolerance = 1e-6 if dtype == np.float32 else 1e-12
    for name, expected in by_hand(0.5, *(value[0] for value in each)).items():
        np.testing.assert_allclose(of_one[name], expected, rtol=tolerance, err_msg=name)
        np.testing.assert_allclose(found[name][0], expected, rtol=tolerance, err_msg=name)
    with pytest.raises(ValueError, match=r"^batch_size: expected 1 or more, got 0$"):
        run(small, 0.5, robots, batch_size=0)


@pytest.mark.parametrize("filled", [3, 1])
def test_a_robot_that_fills_up_a_batch_walks_once(filled):
    """The calls are of two robots each, of a batch of seven; of robots that are all equal each walks."""
    robots, _ = drawn((7,), (7,), (), np.float64)
    rows, seen = np.minimum(np.arange(7), filled - 1), []
    alike = jax.tree.map(lambda value: value[rows] if value.ndim else value, robots.arguments)
    found = run(small, 0.5, robots._replace(arguments=alike), batch_size=2, progress=lambda *now: seen.append(now))
    assert seen == ([(2, 3), (3, 3)] if filled == 3 else [(2, 7), (4, 7), (6, 7), (7, 7)])
    each = run(small, 0.5, robots)
    for name, values in found.items():
        np.testing.assert_array_equal(values, each[name][rows], err_msg=name)


def test_shapes_are_those_of_one_robot():
    leaf = lambda *shape, dtype=float: jax.ShapeDtypeStruct(shape, dtype)  # noqa: E731
    found = shapes_of(small, 1.0, {"gain": leaf(3)}, {"weight": leaf(), "steps": leaf(dtype=np.int32)})
    assert found == {"real": (3,), "sum": (), "whole": (), "true": ()}


@pytest.mark.parametrize("xp", [np, jnp])
def test_arrays_vary_that_have_batch_axes_of_more_than_one_robot_or_belong_to_one(xp):
    """By a table: own axes, shape of the array, of the batch, and the flattened shape."""
    for own, given, shape, expected in [
        (1, (3,), (), (3,)), (1, (3,), (1,), (3,)), (1, (3,), (5,), (3,)), (1, (1, 3), (1,), (1, 3)),
        (1, (1, 3), (5,), (3,)), (1, (1, 1, 3), (2, 2), (3,)), (0, (2, 1), (2, 3), (6,)), (0, (3,), (2, 3), (6,)),
        (2, (2, 3, 4, 5), (2, 3), (6, 4, 5)), (0, (), (), ()), (0, (1, 1), (1, 1), (1,)),
    ]:  # fmt: skip
        value = xp.arange(float(np.prod(given))).reshape(given)
        found = flattened(value, own, shape)
        assert found.shape == expected, (own, given, shape)
        assert isinstance(found, type(value))
        whole = np.broadcast_to(value, (*shape, *given[len(given) - own :])).reshape(-1, *given[len(given) - own :])
        np.testing.assert_array_equal(np.broadcast_to(found, whole.shape), whole)


def test_no_more_gradients_at_once_than_find_room(monkeypatch):
    """One walk in a call at the least, and tangents have no such bound."""
    robots, _ = drawn((4,), (4,), (4,), np.float64)

    def calls(most, **asked):
        monkeypatch.setattr(batches, "MOST_GRADIENTS", most)
        seen = []
        run(small, 2.0, robots._replace(**asked), batch_size=2, progress=lambda *so_far: seen.append(so_far))
        return len(seen)

    weights, along = {"sum": np.ones((4, K))}, {"gain": np.ones((4, K, 3))}
    assert [calls(most, weights=weights) for most in (K - 1, K, 2 * K, 100)] == [4, 4, 2, 2]
    assert calls(K, directions=along) == 2


@pytest.mark.parametrize(
    ("derivatives", "dtype", "over_time", "expected"),
    [("", np.float32, False, (0, True)), ("tangents", np.float32, False, (K, True)),
     ("gradients", np.float32, False, (K * paths.AN_ADJOINT, True)), ("", np.float64, False, (0, False)),
     ("", np.float32, True, (0, False))],
)  # fmt: skip
def test_where_a_batch_walks_depends_on_its_derivatives_and_precision(
    monkeypatch, derivatives, dtype, over_time, expected
):
    """A gradient counts as many tangents; no kernel works in double precision, or returns something of each step."""

    class AskedError(Exception):
        """What is asked for is known: nothing needs to be compiled."""

    def asked(robots, tangents, *, kernel):
        raise AskedError(robots, tangents, kernel)

    monkeypatch.setattr(paths, "device_for", asked)
    robots, _ = drawn((2, 3), (2, 1), (3,), dtype)
    weights, along = {"sum": np.ones((2, 3, K), dtype)}, {"gain": np.ones((2, 3, K, 3), dtype)}
    more = {"": {}, "tangents": {"directions": along}, "gradients": {"weights": weights}}[derivatives]
    with pytest.raises(AskedError) as found:
        run(small, 2.0, robots._replace(**more), over_time=over_time)
    assert found.value.args == (6, *expected)
    mixed = jax.tree.map(lambda value: value.astype(np.float64) if value.dtype == "f4" and not value.ndim else value,
                         drawn((), (), (), np.float32)[0].arguments)  # fmt: skip
    with pytest.raises(AskedError) as found:
        run(small, 2.0, Robots(mixed, ({"gain": 1}, {"weight": 0, "steps": 0}), ()))
    assert found.value.args == (1, 0, False)


def test_an_executable_is_found_by_all_that_its_program_depends_on():
    """Function, structure, which arguments are batched, path, derivatives, and the classes in any of the trees."""
    call = batches._Call(small, 2.0, (True, False), "regions", "tangent of ")
    changes = {"function": by_hand, "structure": 3.0, "batched": (True, True), "path": "plain", "derivatives": ""}
    others = [call._replace(**{name: value}) for name, value in changes.items()]
    found = [batches._identity(each, {"gain": 1.0}, {"weight": 2.0}) for each in (call, *others)]
    found += [
        batches._identity(call, {"gain": 1.0}, Robots((), (), ())),
        batches._identity(call, PD(), {"weight": 2.0}),
    ]
    assert None not in found and len({*found}) == len(found)
    assert batches._identity(call, {"gain": 7.0}, {"weight": 5.0}) == found[0]
    assert batches._identity(call._replace(structure=threading.Lock()), {}) is None
