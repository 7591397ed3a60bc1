"""The common base of laws, contacts, actuators and disturbances: classes whose fields are their values.

```python
class Magnet(mjx_climb.Contact):
    pull: Array = mjx_climb.parameter("N", bounds=(0.0, 1e3), default=40.0)
```
"""

import dataclasses
import math
import numbers
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import ClassVar, Self, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mjx_climb.arrays import AnyArray
from mjx_climb.value_field import OPEN, ValueField, in_words
from mjx_climb.value_field import option as option
from mjx_climb.value_field import parameter as parameter

_NUMBERS = {3: "three", 6: "six"}


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(parameter, option, dataclasses.field))
class Component:
    """Base of laws, contacts, actuators and disturbances: a subclass becomes a frozen dataclass and a pytree.

    Fields made by `gain` or `parameter` are its values: batched, differentiated, stored. A field whose metadata say
    `tree` is a pytree that the program makes of other values. Any other field is part of the program: it must be
    hashable, and another value is compiled anew. Methods are written for one robot.
    """

    KIND: ClassVar[str] = ""  # of a shipped one: its name in configs and options
    VALUES: ClassVar[Mapping[str, ValueField]] = MappingProxyType({})  # by name, in the order of the fields
    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({})  # number of axes of one robot's value

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        dataclasses.dataclass(frozen=True, eq=False)(cls)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]  # a dataclass from here on
        values = {field.name: field.metadata["value"] for field in fields if "value" in field.metadata}
        cls.VALUES = MappingProxyType(values)
        cls.AXES = MappingProxyType({name: len(field.shape) for name, field in values.items()})
        trees = [field.name for field in fields if "tree" in field.metadata]
        others = [field.name for field in fields if field.name not in (*values, *trees)]
        jax.tree_util.register_dataclass(cls, data_fields=[*values, *trees], meta_fields=others)

    def compiled_for(self, moving: Collection[str] = ()) -> Self:
        """This component with the options that its values ask of a compiled walk; of a batch, those of any robot.

        Derivatives run along the values that `moving` names: these have the options of any value.
        """
        return self


AnyComponent = TypeVar("AnyComponent", bound=Component)


def given(value: ArrayLike) -> bool:
    """Return whether any number of an array is not zero."""
    return bool(np.any(np.asarray(value) != 0))


def with_values(
    component: AnyComponent,
    values: Mapping[str, ArrayLike],
    array: Callable[[AnyArray], AnyArray] = np.asarray,
    name: str = "gains",
) -> AnyComponent:
    """Return a component with some values replaced, all of them as arrays of their full shape.

    Arguments:
        array: makes an array of JAX or of NumPy, in the precision of the walk.
        name: of the component in messages, as "gains".

    Raises:
        ValueError: in one line, a wrong shape, a value that is no number or not positive, or one outside of its limits.
    """
    whole = {}
    for key, field in component.VALUES.items():
        given = values.get(key, getattr(component, key))
        value = checked_value(f"{name}.{key}", given, field.shape, *field.bounds, limits=field.limits)
        whole[key] = in_precision(f"{name}.{key}", _in_full(value, field), array)
    within = {key: each for key, each in vars(component).items() if isinstance(each, Component)}
    whole |= {key: with_values(each, {}, array, f"{name}.{key}") for key, each in within.items()}
    return dataclasses.replace(component, **whole)  # type: ignore[type-var]


def in_full(component: AnyComponent) -> AnyComponent:
    """The component with its values, which are checked already, as arrays of their full shape."""
    own = vars(component)
    whole = {key: _in_full(own[key], field) for key, field in component.VALUES.items()}
    changed = {key: value for key, value in whole.items() if value is not own[key]}
    return dataclasses.replace(component, **changed) if changed else component  # type: ignore[type-var]


def _in_full(value: ArrayLike, field: ValueField) -> AnyArray:
    if isinstance(value, jax.Array) or (isinstance(value, np.ndarray) and value.dtype == np.float64):
        array: AnyArray = value
    else:
        array = real_numbers("value", value)
    if not field.shape or None in field.shape or array.shape[-len(field.shape) :] == field.shape:
        return array
    xp = jnp if isinstance(array, jax.Array) else np
    return xp.broadcast_to(array, (*array.shape[: max(0, array.ndim - len(field.shape))], *field.shape))


def checked_value(
    name: str,
    given: ArrayLike,
    shape: tuple[int | None, ...],
    low: float = math.nan,
    high: float = math.nan,
    zero: bool = False,
    limits: tuple[float, float] | None = None,
) -> AnyArray:
    """A value as an array, in its own precision.

    A value of one axis may be a scalar, or have a last axis of one; of more axes a scalar or all of them.

    Raises:
        ValueError: no numbers, another shape, or values known now that are outside of the limits, or not finite or too
            small for a search's bounds.
    """
    value = real_numbers(name, given)
    own = value.shape[max(0, value.ndim - len(shape)) :] if shape and value.ndim else shape
    fits = len(own) == len(shape) and all(want in (None, got) for want, got in zip(shape, own, strict=True))
    if not fits and not (len(shape) == 1 and own == (1,)):
        last = f"a last axis of {_NUMBERS.get(shape[0] or 0, shape[0])}" if len(shape) == 1 else f"last axes {shape}"
        raise ValueError(f"{name}: expected a scalar or {last}, got shape {value.shape}")
    if isinstance(value, jax.core.Tracer):
        return value
    known = np.asarray(value)
    if limits is not None:
        exact, rounding = known.astype(float), np.finfo(np.result_type(known, np.float32)).eps
        # a limit is met as a value's precision holds it
        least, most = (
            end if abs(end) in OPEN else end + way * rounding * abs(end)
            for end, way in zip(limits, (-1, 1), strict=True)
        )
        if (outside := ~((exact >= least) & (exact <= most))).any():
            raise ValueError(f"{name}: expected {in_words(limits)}, got {np.extract(outside, known)[0]:g}")
        return value
    zero = zero or low == 0
    infinite = np.isnan(known) if high == math.inf else ~np.isfinite(known)
    # a low bound below 0 allows every finite number
    wrong = infinite | ((not low < 0) & ((known < 0) | ((known == 0) & (not zero))))
    if wrong.any():
        expected = "finite numbers" if low < 0 else f"finite numbers {'of 0 or more' if zero else 'above 0'}"
        raise ValueError(f"{name}: expected {expected}, got {np.extract(wrong, known)[0]:g}")
    return value


def real_numbers(name: str, value: ArrayLike) -> AnyArray:
    """Real numbers as an array, in their own precision; single ones of Python's in double precision.

    Raises:
        ValueError: complex numbers, truth values, text, dates, and arrays with masks.
    """
    if isinstance(value, numbers.Real) and not isinstance(value, bool | np.generic):
        value = float(value)
    array = value if isinstance(value, jax.Array) else np.asanyarray(value)
    masked, kinds = isinstance(array, np.ma.MaskedArray), (jnp.floating, jnp.integer)
    if masked or not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        got = "a masked array" if masked else array.dtype if array.ndim else repr(value)
        raise ValueError(f"{name}: expected real numbers, got {got}")
    return array if isinstance(array, jax.Array) else np.asarray(array, float if array.ndim == 0 else None)


def in_precision(name: str, value: AnyArray, array: Callable[[AnyArray], AnyArray]) -> AnyArray:
    """Return a value as `array` makes it in the precision of a walk.

    Raises:
        ValueError: a finite number known now that is infinite in this precision.
    """
    with np.errstate(over="ignore"):
        made = array(value)
        if not isinstance(value, jax.core.Tracer):
            known = np.asarray(value)
            if (lost := np.isinf(known.astype(made.dtype)) & np.isfinite(known)).any():
                got = f"{np.extract(lost, known)[0]:g}"
                raise ValueError(f"{name}: expected numbers that {made.dtype} holds, got {got}")
    return made
