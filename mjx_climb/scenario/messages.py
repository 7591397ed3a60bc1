"""Bad scenarios in words: one line with the file, the dotted key, expected and got."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, get_args, get_type_hints

from pydantic import BaseModel, ValidationError, model_validator
from pydantic_core import PydanticCustomError

# of the two models that a section may have: in pydantic's places of errors, which no key of a config can be
PLAIN_TAG, OTHER_TAG = "(plain)", "(other)"


class ConfigError(ValueError):
    """A scenario, a setting or a file that cannot be used; its text is one line.

    `source` is the file or the object, `key` the dotted key there, `expected` and `got` are in words; `reason` is all
    of it that follows the key. Those that a message lacks are empty.
    """

    def __init__(
        self, source: object = "", key: str = "", expected: str = "", got: object = "", more: int = 0, reason: str = ""
    ) -> None:
        self.source, self.key, self.expected, self.got = str(source), key, expected, str(got)
        said = f"expected {expected}" + (f", got {got}" if self.got else "") if expected else ""
        self.more, self.reason = more, reason or said
        text = ": ".join(filter(None, (self.source, key, self.reason)))
        super().__init__(printable(text + (f" (and {more} more)" if more else "")))

    def moved(self, **place: str) -> Self:
        """The same with another `source`, or another `key`."""
        own = {name: getattr(self, name) for name in ("source", "key", "expected", "got", "more", "reason")}
        return type(self)(**{**own, **place})

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.source, self.key, self.expected, self.got, self.more, self.reason)


class Checked(BaseModel):
    """A model whose values are checked against each other once each of them is right by itself."""

    if TYPE_CHECKING:  # the metaclass of sections hides their fields

        def __init__(self, **values: Any) -> None: ...

    def faults(self) -> Iterator[ValueError]:
        """Yield the faults; the first one is raised."""
        yield from ()

    @model_validator(mode="after")
    def _is_sound(self) -> Self:
        for fault in self.faults():
            raise fault
        return self


def failure(expected: str, **context: object) -> PydanticCustomError:
    """Return the one kind of error that models raise; context: a `key` below the model and the value `got`."""
    return PydanticCustomError("expected", "expected {expected}", {"expected": expected, **context})


def refusal(invalid: ValidationError, root: type[BaseModel], source: str) -> ConfigError:
    """Return the first error in the data of a model as one line."""
    error, *others = invalid.errors(include_url=False)
    where, context, got = error["loc"], error.get("ctx", {}), show(error["input"])
    where = tuple(part for part in where if part not in (PLAIN_TAG, OTHER_TAG))
    match error["type"]:
        case "expected":
            where += tuple(context["key"].split(".")) if "key" in context else ()
            expected = context["expected"]
            got = show(context["got"]) if "got" in context else got
        case "extra_forbidden":
            near, known = _suggestion(root, where), ", ".join(section(root, where[:-1]).model_fields)
            expected, got = "a known key" if near or not known else f"one of {known}", f"an unknown one{near}"
        case "missing":
            expected, got = "a value", "none"
        case "literal_error":
            expected = context["expected"]
        case "tuple_type":
            expected = "a list"
        case _:
            keys = ", ".join(section(root, where).model_fields)
            expected = f"a mapping with keys {keys}" if keys else "a mapping from names"
    return ConfigError(source, ".".join(map(str, where)), expected, got, len(others))


def section(root: type[BaseModel], where: Sequence[str | int]) -> type[BaseModel]:
    """The model at a place in another."""
    model = root
    for part in where:
        if isinstance(part, str):
            field = model.model_fields.get(part)
            # a name of the user's: the kind that the section holds for each
            hint: object = field.annotation if field else get_type_hints(model)["__pydantic_extra__"]
            model = _model_in(hint) or BaseModel
    return model


def _model_in(annotation: object) -> type[BaseModel] | None:
    """The model in an annotation: itself, an item of a list, or one of several kinds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_model_in(part) for part in get_args(annotation))
    return next((model for model in found if model is not None), None)


def _suggestion(root: type[BaseModel], where: Sequence[str | int]) -> str:
    """The nearest key of the same section or, failing that, of another one."""
    name, beside = str(where[-1]), list(section(root, where[:-1]).model_fields)
    meant: dict[str, list[str]] = {}
    for place in keys(root):
        meant.setdefault(place.split(".")[-1], []).append(place)
    return did_you_mean(name, beside) or did_you_mean(name, meant, meant=meant)


def did_you_mean(
    name: str,
    known: Iterable[str],
    most: int = 1,
    alike: float = 0.6,
    meant: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> str:
    """A suggestion of the known names nearest to one, or of their meanings; nothing where none is so far alike."""
    near = [each for key in difflib.get_close_matches(name, list(known), most, alike) for each in meant.get(key, [key])]
    return f" (did you mean {' or '.join(dict.fromkeys(near))}?)" if near else ""


def keys(root: type[BaseModel]) -> Iterator[str]:
    """Yield the dotted keys that hold a value in a model and its sections."""
    for name, field in root.model_fields.items():
        if isinstance(field.default, BaseModel):
            yield from (f"{name}.{inner}" for inner in keys(type(field.default)))
        else:
            yield name


def show(value: object) -> str:
    """A value as it would stand in YAML, cut to a readable length."""
    try:
        text = json.dumps(value, default=repr, ensure_ascii=False)
    except (TypeError, ValueError):  # odd keys, cycles
        text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def printable(text: str, keep: str = "") -> str:
    """A text with control characters spelt out, but for those in `keep`: it can be encoded and shown."""
    return "".join(c if c.isprintable() or c in keep else ascii(c)[1:-1] for c in text)
