"""Operations that move elements without a look at them: slices, reshapes, concatenations and the like."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_climb.execution.elements import Elements, along, objects


def _broadcast(array: Elements, shape: tuple[int, ...], axes: Sequence[int]) -> Elements:
    sizes = dict(zip(axes, array.shape, strict=True))
    return np.broadcast_to(array.reshape([sizes.get(axis, 1) for axis in range(len(shape))]), shape)


def _slice(array: Elements, starts: Sequence[int], limits: Sequence[int], strides: Sequence[int] | None) -> Elements:
    return array[tuple(map(slice, starts, limits, strides or itertools.repeat(1)))]


def _padded(array: Elements, value: Elements, config: Sequence[tuple[int, int, int]]) -> Elements:
    """Return an array with (before, after, between) elements more along each axis; negative ones are taken away."""
    inner = [size + max(size - 1, 0) * between for size, (_, _, between) in zip(array.shape, config, strict=True)]
    wide = np.empty([max(b, 0) + n + max(a, 0) for n, (b, a, _) in zip(inner, config, strict=True)], object)
    wide[...] = objects(value)[()]
    at = tuple(slice(max(b, 0), max(b, 0) + n, g + 1) for n, (b, _, g) in zip(inner, config, strict=True))
    wide[at] = objects(array)
    kept = (slice(max(-b, 0), n - max(-a, 0)) for n, (b, a, _) in zip(wide.shape, config, strict=True))
    return wide[tuple(kept)]


def _split(array: Elements, sizes: Sequence[int], axis: int) -> list[Elements]:
    return np.split(array, np.cumsum(sizes)[:-1], axis)


# from the operands and the parameters of the operation, and the parameters that are looked at
MOVES: dict[str, tuple[Callable[[list[Elements], Mapping[str, Any]], list[Elements]], frozenset[str]]] = {
    "broadcast_in_dim": (
        lambda x, p: [_broadcast(x[0], p["shape"], p["broadcast_dimensions"])],
        frozenset({"shape", "broadcast_dimensions"}),
    ),
    "concatenate": (lambda x, p: [np.concatenate([*map(objects, x)], p["dimension"])], frozenset({"dimension"})),
    "copy": (lambda x, p: x, frozenset()),
    "copy_p": (lambda x, p: x, frozenset()),
    "expand_dims": (lambda x, p: [np.expand_dims(x[0], tuple(p["dimensions"]))], frozenset({"dimensions"})),
    "name": (lambda x, p: x, frozenset({"name"})),
    "optimization_barrier": (lambda x, p: x, frozenset()),
    "pad": (lambda x, p: [_padded(x[0], x[1], p["padding_config"])], frozenset({"padding_config"})),
    "reshape": (
        lambda x, p: [(x[0] if p["dimensions"] is None else x[0].transpose(p["dimensions"])).reshape(p["new_sizes"])],
        frozenset({"new_sizes", "dimensions"}),
    ),
    "rev": (lambda x, p: [np.flip(x[0], p["dimensions"])], frozenset({"dimensions"})),
    "slice": (
        lambda x, p: [_slice(x[0], p["start_indices"], p["limit_indices"], p["strides"])],
        frozenset({"start_indices", "limit_indices", "strides"}),
    ),
    "split": (lambda x, p: _split(x[0], p["sizes"], p["axis"]), frozenset({"sizes", "axis"})),
    "stop_gradient": (lambda x, p: x, frozenset()),
    "squeeze": (lambda x, p: [np.squeeze(x[0], tuple(p["dimensions"]))], frozenset({"dimensions"})),
    "stack": (lambda x, p: [np.stack([*map(objects, x)], p["axis"])], frozenset({"axis"})),
    "transpose": (lambda x, p: [x[0].transpose(p["permutation"])], frozenset({"permutation"})),
    "unstack": (lambda x, p: along(x[0], p["axis"]), frozenset({"axis"})),
}
