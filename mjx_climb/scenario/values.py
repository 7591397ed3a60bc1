"""The sections of a scenario and the types of their values, each of which says in words what it expects."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError, WrapValidator

from mjx_climb.scenario.messages import failure, refusal

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass as _ModelMetaclass
else:
    _ModelMetaclass = type(BaseModel)


class _OneLine(_ModelMetaclass):
    """Makes a section that is built in Python refuse bad values as one from YAML does."""

    def __call__(cls, *args: Any, **values: Any) -> Any:
        try:
            return super().__call__(*args, **values)
        except ValidationError as invalid:
            raise refusal(invalid, cast(type[BaseModel], cls), cls.__name__) from None


class Section(BaseModel, metaclass=_OneLine):
    """A section of a scenario."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def setting(default: object, description: str) -> Any:
    """Return the field of a key of a scenario, with its default, and what it is, unit included."""
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
Duty = Annotated[Finite, Field(gt=0, lt=1), _expects("a number above 0 and below 1")]
Angle = Annotated[Finite, Field(ge=-2 * math.pi, le=2 * math.pi), _expects("an angle in rad between -2 pi and 2 pi")]
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
Way = Annotated[Finite, Field(ge=0, le=MAX_LENGTH), _expects(f"a number from 0 to {MAX_LENGTH:g}")]
Height = Annotated[Finite, Field(gt=0, le=MAX_LENGTH), _expects(f"a number above 0, {MAX_LENGTH:g} at most")]
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
Option = Annotated[bool, Strict()] | Annotated[str, Strict()] | Finite
FileName = Annotated[str, Strict(), AfterValidator(_is_name), _expects("the path of a file")]
Heights = Annotated[
    tuple[Finite, ...], Field(min_length=1), _expects("a list of one finite number or more, foothold after foothold")
]
JointNames = Annotated[
    tuple[Word, ...],
    Field(min_length=2, max_length=7),
    _expects("a list of two to seven joint names, from the base outwards"),
]
_LimbName = Annotated[str, Strict(), AfterValidator(_is_name)]
Swings = Annotated[
    tuple[_LimbName | Annotated[tuple[_LimbName, ...], Field(min_length=1)], ...],
    Field(min_length=2),
    _expects("a list of two limbs or more; limbs that swing together are a list in it"),
]
