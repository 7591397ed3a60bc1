"""Shapes of the arrays that a caller passes, checked by the strings of annotations.

In `"... limbs 3 K"` the axes of one robot follow any batch axes; a name stands for a size, or a range of sizes.
"""

import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import get_args

import numpy as np

Sizes = Mapping[str, int | range]


def dims_of(annotation: object) -> str:
    """Return the shape in an annotation, or in the first member of a union of some, "" where there is none."""
    return _dims_of(annotation)


@functools.lru_cache(maxsize=1024)
def _dims_of(annotation: Hashable) -> str:
    members = (annotation, *get_args(annotation))
    return next((member.dim_str for member in members if hasattr(member, "dim_str")), "")


def check_shape(name: str, shape: Sequence[int], dims: str, sizes: Sizes, batch: tuple[int, ...] | None = None) -> None:
    """Refuse the shape of an array that is not `dims`, or whose batch axes do not broadcast to `batch`.

    Raises:
        ValueError: in one line, the name, the expected shape and the one that was got.
    """
    own = dims.removeprefix("...").split()
    lead, tail = tuple(shape[: max(0, len(shape) - len(own))]), shape[max(0, len(shape) - len(own)) :]
    allowed = [int(dim) if dim.isdecimal() else sizes.get(dim) for dim in own]
    fits = len(tail) == len(own) and all(
        want is None or size == want or (isinstance(want, range) and size in want)
        for size, want in zip(tail, allowed, strict=True)
    )
    if fits and (batch is None or broadcasts(lead, batch)):
        return
    each = [str(want) if isinstance(want, int) else dim for dim, want in zip(own, allowed, strict=True)]
    notes = [f", {dim} {w.start} to {w.stop - 1}" for dim, w in zip(own, allowed, strict=True) if isinstance(w, range)]
    before = ["..."] if batch is None else []
    expected = f"({', '.join([*before, *each])}{',' if len(before + each) == 1 else ''}){''.join(notes)}"
    if batch:
        expected += f", or with batch axes before it that broadcast to {batch}"
    raise ValueError(f"{name}: expected shape {expected}, got {tuple(shape)}")


def broadcasts(shape: Sequence[int], to: Sequence[int]) -> bool:
    """Return whether a shape broadcasts to another one."""
    pairs = zip(reversed(shape), reversed(to), strict=False)
    return len(shape) <= len(to) and all(size in (1, there) for size, there in pairs)


def summed_to(values: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return derivatives (k, ...) by a value that was broadcast from a shape: (k, *shape).

    Those by copies of one number add up. A last axis that was cut, of rotations that nothing depends on, has zeros.
    """
    if shape and values.ndim > 1 and 1 < values.shape[-1] < shape[-1]:
        missing = np.zeros((*values.shape[:-1], shape[-1] - values.shape[-1]), values.dtype)
        values = np.concatenate([values, missing], axis=-1)
    values = values.sum(axis=tuple(range(1, values.ndim - len(shape)))) if values.ndim > 1 + len(shape) else values
    added = [n for n, size in enumerate(shape, 1) if n < values.ndim and size == 1 != values.shape[n]]
    return np.asarray(np.broadcast_to(values.sum(axis=tuple(added), keepdims=True), (len(values), *shape)))
