"""Operations on the lanes' parts of values, by a writer whose lanes are the rows of arrays of NumPy."""

import itertools

import numpy as np
import pytest
from jax import lax

from mjx_climb.execution.element_operations import Operations
from mjx_climb.execution.elements import OfLane, Value, as_array
from tests.execution.rows import Rows

COMBINE = {"add": np.add, "max": np.maximum, "min": np.minimum, "mul": np.multiply}
ELEMENTWISE = COMBINE | {
    "sub": np.subtract,
    "neg": np.negative,
    "lt": np.less,
    "select_n": lambda w, a, b: np.where(w, b, a),
}


def number(element):
    """The number that lane 0 sees; an element of a lane is that lane's."""
    if isinstance(element, OfLane):
        return element.value.content[element.lane]
    return element.content[0] if isinstance(element, Value) else element


def numbers(array):
    return np.vectorize(number, otypes=[float])(array)


@pytest.mark.parametrize("lanes", [1, 2, 3, 4, 5, 6, 8])
@pytest.mark.parametrize("reduces", [False, True])
@pytest.mark.parametrize("name", COMBINE)
def test_arrays_of_the_lanes_together_are_the_loop_over_them(lanes, reduces, name):
    """The lanes' own parts in their order, in another one, mixed with numbers, and fewer parts than lanes."""
    rng, combine = np.random.default_rng(lanes), getattr(lax, f"{name}_p")
    writer = Rows(lanes, reduces)
    do = Operations(writer, None)
    content = rng.normal(size=(2, lanes))
    values = [writer.value(row) for row in content]
    in_order = [as_array([do.of_lane(value, lane) for value in values], (2,)) for lane in range(lanes)]
    turned = in_order[1:] + in_order[:1]
    mixed = [*in_order[:-1], as_array([np.float64(2.0), do.of_lane(values[1], 0)], (2,))]
    for parts in (in_order, turned, mixed, in_order[:1], in_order + in_order):
        expected = COMBINE[name].reduce([numbers(part) for part in parts])
        found = do.together(combine, parts)
        assert found.shape == (2,)
        np.testing.assert_allclose(numbers(found), expected, rtol=1e-12)


@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_lanes_come_together_in_as_many_steps_as_they_double(lanes):
    """All of them have the result then, and asked for again it is there."""
    writer = Rows(lanes, False)
    do = Operations(writer, None)
    value = writer.value(np.arange(1.0, lanes + 1))
    parts = [as_array([do.of_lane(value, lane)], (1,)) for lane in range(lanes)]
    for _ in range(2):
        [total] = do.together(lax.add_p, parts)
        np.testing.assert_array_equal(total.content, lanes * (lanes + 1) / 2)
        assert writer.written == ["exchange", "add"] * (lanes.bit_length() - 1)
    # a product has no partners
    writer.written.clear()
    [product] = do.together(lax.mul_p, parts)
    assert writer.written.count("mul") == lanes - 1 and number(product) == np.prod(value.content)


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_elementwise_operations_on_any_mixture_are_numpys(name):
    """Of the lanes' parts in order and out of it, numbers of all lanes, and known ones, which broadcast."""
    rng, lanes = np.random.default_rng(0), 4
    count = {"neg": 1, "select_n": 3}.get(name, 2)
    writer = Rows(lanes, False)
    do = Operations(writer, None)
    values = [writer.value(row) for row in rng.normal(size=(3, lanes))]
    flags = [writer.value(row > 0) for row in rng.normal(size=(3, lanes))]
    common = [writer.value(np.full(lanes, number)) for number in rng.normal(size=3)]

    def kinds(of):
        own = [do.of_lane(of[0], lane) for lane in range(lanes)]
        return {
            "in order": own,
            "turned": own[1:] + own[:1],
            "of one lane": [own[1]] * lanes,
            "of two": [own[0], do.of_lane(of[1], 1), do.of_lane(of[1], 2), own[3]],
            "the same": [of[2] if of is flags else common[0]] * lanes,
            "known": [*(rng.normal(size=lanes) > 0)] if of is flags else [*rng.normal(size=lanes)],
            "ones and zeros": [*map(np.bool_, [1, 0, 1, 0])] if of is flags else [*map(np.float64, [1, 0, 1, 0])],
        }

    flags[2] = writer.value(np.full(lanes, True))
    first = kinds(flags if name == "select_n" else values)
    others = [kinds([values[1], values[2], common[1]]) for _ in range(count - 1)]
    for chosen in itertools.product(first, *others):
        given = [each[kind] for each, kind in zip([first, *others], chosen, strict=True)]
        arrays = [as_array(each, (1, lanes)) for each in given]
        expected = ELEMENTWISE[name](*(np.vectorize(number)(each) for each in given))
        found = do.each(getattr(lax, f"{name}_p"), {}, *arrays)
        assert found.shape == (1, lanes)
        np.testing.assert_allclose(numbers(found)[0], expected, rtol=1e-12, err_msg=str(chosen))
