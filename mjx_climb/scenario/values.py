"""The sections of a scenario and the types of their values; each type has its expectation in words."""

import dataclasses
import math
import types
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError, WrapValidator

from mjx_climb.scenario.messages import Checked, failure, refusal
from mjx_climb.value_field import ValueField, one_in_words

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _ModelMetaclass
else:
    _ModelMetaclass = type(BaseModel)


class _OneLine(_ModelMetaclass):
    """Makes a section that is built in Python refuse bad values as one from YAML does, and its keys from a component's.

    The values that its `COMPONENT` declares become keys after those in front of them, but for keys of its own.
    """

    def __new__(mcs, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any) -> type:
        if (component := namespace.get("COMPONENT")) is not None:
            own, required = dict(namespace.get("__annotations__", {})), namespace.get("REQUIRED", ())
            made = {"kind": own.pop("kind")} if "kind" in own else {}
            for field in dataclasses.fields(component):
                if field.name not in own and (kind := _kind_of(field)) is not None:
                    value: ValueField | None = field.metadata.get("value")
                    default = ... if field.name in required else _default(value, field.default)
                    meaning = field.metadata.get("meaning", field.name)
                    description = meaning if value is None else value.description
                    namespace[field.name], made[field.name] = Field(default=default, description=description), kind
            namespace["__annotations__"] = made | own
        return super().__new__(mcs, name, bases, namespace, **options)

    def __call__(cls, *args: Any, **values: Any) -> Any:
        try:
            return super().__call__(*args, **values)
        except ValidationError as invalid:
            raise refusal(invalid, cast(type[BaseModel], cls), cls.__name__) from None


class Section(Checked, metaclass=_OneLine):
    """A section of a scenario."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ComponentSection(Section):
    """A section with a key for each value that `COMPONENT` declares; those of `REQUIRED` have no default."""

    COMPONENT: ClassVar[Any] = None
    REQUIRED: ClassVar[tuple[str, ...]] = ()

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


def section_of(component: type, required: Sequence[str] = ()) -> type[ComponentSection]:
    """Return the section of a component: a key for each of its values and options."""
    body = {"COMPONENT": component, "REQUIRED": tuple(required), "__module__": component.__module__}
    return types.new_class(component.__name__, (ComponentSection,), exec_body=lambda namespace: namespace.update(body))


def _default(value: ValueField | None, default: Any) -> Any:
    """The default of a key: null of an infinite value or none, a list of a value with axes, whole of a whole one."""
    if default is dataclasses.MISSING or default == math.inf:
        return None
    if value is not None and value.shape:
        return tuple(float(default) for _ in range(value.size))
    return int(default) if value is not None and value.whole else default


def _kind_of(field: dataclasses.Field[Any]) -> Any:
    """The type of a key that a field of a component has; None of a field that the program sets."""
    if "value" in field.metadata:
        return type_of(field.metadata["value"])
    if "compiled" in field.metadata:
        return None
    for kind, text in ((bool, "true or false"), (str, "a word"), (float, "a finite number"), (int, "a whole number")):
        if type(field.default) is kind:
            return Annotated[kind, Strict(), _expects(text)]
    return None


def type_of(value: ValueField) -> Any:
    """The type of a key that holds a declared value: strict, within its bounds; null where it may be infinite."""
    kind, null = int if value.whole else float, value.bounds[1] == math.inf
    within: dict[str, Any] = {} if value.whole else {"allow_inf_nan": False}
    ends = zip(("ge", "le"), value.bounds, strict=True)
    within |= {name: kind(end) for name, end in ends if math.isfinite(end)}
    number: Any = Annotated[kind, Strict(), Field(**within)]
    held = number | None if null else number
    for length in reversed(value.shape):
        axis: Any = (held, ...) if length is None else (held,) * length
        held = tuple[axis]
    text = one_in_words(value.bounds, value.whole)
    if value.shape == (3,):
        text = "a list of three finite numbers"
    elif value.shape:
        text = f"{'lists' if len(value.shape) > 1 else 'a list'}, each number {text}"
    return Annotated[held, _expects(text + (", or null" if null else ""))]


def setting(default: object, description: str) -> Any:
    """Return the field of a key of a scenario, with its default and its meaning, unit included."""
    return Field(default=default, description=description)


def _expects(text: str) -> WrapValidator:
    def validate(value: object, handler: Callable[[object], object]) -> object:
        try:
            return handler(value)
        except ValidationError:
            raise failure(text) from None

    return WrapValidator(validate)


def _is_name(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError("empty or unprintable")
    return text


MAX_GRAVITY = 1e4  # m/s^2, a thousand G
G = 9.81  # m/s^2
MAX_LENGTH = 100.0  # m, of a step
MAX_COUNT = 20_000  # of points that can be held
Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]  # strict: no booleans, no strings

_Length = Annotated[Finite, Field(gt=0, le=MAX_LENGTH)]
_Gravity = Annotated[Finite, Field(ge=-MAX_GRAVITY, le=MAX_GRAVITY)]
Number = Annotated[Finite, _expects("a finite number")]
Positive = Annotated[Finite, Field(gt=0), _expects("a finite number above 0")]
NonNegative = Annotated[Finite, Field(ge=0), _expects("a finite number, 0 or above")]
Share = Annotated[Finite, Field(ge=0, lt=1), _expects("a number from 0 to below 1")]
Part = Annotated[Finite, Field(gt=0, le=1), _expects("a number above 0, 1 at most")]
Limit = Annotated[NonNegative | None, _expects("a finite number, 0 or above, or null")]
PositiveOrNull = Annotated[Positive | None, _expects("a finite number above 0, or null")]
Register = Annotated[
    int, Strict(), Field(ge=0, le=16383), _expects("a whole number from 0 to 16383, as the servo's register holds")
]
Seed = Annotated[int, Strict(), Field(ge=0, lt=2**24), _expects("a whole number from 0 to below 2^24")]
Count = Annotated[int, Strict(), Field(ge=1, le=MAX_COUNT), _expects(f"a whole number from 1 to {MAX_COUNT}")]
Threshold = Annotated[
    NonNegative | tuple[NonNegative, NonNegative],
    _expects("a finite number, 0 or above, or two: of translations, of rotations"),
]
Bound = Annotated[
    Positive | tuple[Positive, Positive] | None,
    _expects("a finite number above 0, two of them (of translations, of rotations), or null"),
]
Vector = Annotated[tuple[Finite, Finite, Finite], _expects("a list of three finite numbers")]
Gain = Annotated[
    Positive | tuple[Positive, Positive, Positive, Positive, Positive, Positive],
    _expects("a finite number above 0, or a list of six"),
]
Gravity = Annotated[
    tuple[_Gravity, _Gravity, _Gravity], _expects(f"a list of three numbers from {-MAX_GRAVITY:g} to {MAX_GRAVITY:g}")
]
Pair = Annotated[tuple[Finite, Finite], _expects("a list of two finite numbers")]
Pairs = Annotated[tuple[tuple[Finite, Finite], ...], _expects("a list of lists of two finite numbers")]
Sides = Annotated[tuple[_Length, _Length], _expects(f"a list of two numbers above 0, {MAX_LENGTH:g} at most")]
Rows = Annotated[
    tuple[tuple[Finite, Finite, Finite], ...], Field(min_length=1), _expects("a list of rows of three finite numbers")
]
Bounds = Annotated[
    tuple[NonNegative, ...], Field(min_length=1), _expects("a list of one finite number or more, 0 or above")
]
Name = Annotated[str, Strict(), AfterValidator(_is_name), _expects("the name of a robot")]
Word = Annotated[str, Strict(), AfterValidator(_is_name), _expects("a name in the robot's file")]
OwnName = Annotated[str, Strict(), AfterValidator(_is_name), _expects("a name of Python's")]
_Row = tuple[Finite, ...]
_Table = tuple[_Row, ...]
Values = Annotated[
    Finite | _Row | _Table | tuple[_Table, ...], _expects("a finite number, or a list of them or of such lists")
]
_Plain = Annotated[bool, Strict()] | Annotated[str, Strict()] | Annotated[int, Strict()] | Finite
Given = Annotated[
    _Plain | _Row | _Table | tuple[_Table, ...] | None,
    _expects("a finite number, a list of them or of such lists, null, a word, true or false"),
]
FileName = Annotated[str, Strict(), AfterValidator(_is_name), _expects("the path of a file")]
Heights = Annotated[
    tuple[Finite, ...], Field(min_length=1), _expects("a list of one finite number or more, foothold after foothold")
]
JointNames = Annotated[
    tuple[Word, ...],
    Field(min_length=1, max_length=7),
    _expects("a list of one to seven joint names, from the base outwards"),
]
_LimbName = Annotated[str, Strict(), AfterValidator(_is_name)]
Swings = Annotated[
    tuple[_LimbName | Annotated[tuple[_LimbName, ...], Field(min_length=1)], ...],
    Field(min_length=2),
    _expects("a list of two limbs or more; limbs that swing together are a list in it"),
]
