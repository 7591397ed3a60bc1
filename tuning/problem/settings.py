"""The base of all settings: read from YAML, written to it, refused in one line, and typed in a shell."""

import os
from numbers import Number
from typing import Annotated, Any, NamedTuple, Self

from pydantic import ConfigDict, Field, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic_core import CoreSchema

from mjx_climb.scenario.messages import Checked, ConfigError, show

Finite = Annotated[float, Field(allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Shell(NamedTuple):
    """How the command line writes a setting, where that does not follow from its name and type."""

    flag: str | None = None
    metavar: str | None = None
    complete: str | None = None  # config, ensemble, hardware, method, metric or key
    default_in_words: str | None = None
    argument: bool = False  # by its place, not by its name


def setting(default: Any, text: str, **how: Any) -> Any:
    """Return a field of a model with its default (`...` for none) and its help with the unit.

    "; null: ..." at the end of the text tells the meaning of None; `how`: fields of `Shell`, or of `pydantic.Field`.
    """
    shell = Shell(**{name: how.pop(name) for name in Shell._fields if name in how})
    field = Field(default=default, description=text, validate_default=isinstance(default, str), **how)
    field.metadata.append(shell)
    return field


_EXPECTED = {  # by pydantic's type of an error
    "greater_than": "a number above {gt:g}", "greater_than_equal": "{ge:g} or more",
    "less_than": "a number below {lt:g}", "less_than_equal": "{le:g} at most",
    "finite_number": "a finite number", "float_parsing": "a number", "float_type": "a number",
    "bool_type": "true or false", "string_type": "a word", "tuple_type": "a list", "dict_type": "a mapping",
    "model_type": "a mapping", "extra_forbidden": "a known key",
    "int_parsing": "a whole number", "int_type": "a whole number", "int_from_float": "a whole number",
    "literal_error": "{expected}", "expected": "{expected}",
    "missing": "a value here", "too_long": "{max_length} values",
}  # fmt: skip


def explained(invalid: ValidationError) -> tuple[str, str]:
    """Return the dotted key of the first error of a model, empty for none, and its fault."""
    error = invalid.errors(include_url=False)[0]
    parts = [str(part) for part in error["loc"]]
    key = ".".join(part for part in parts if not part.startswith("literal["))  # pydantic's names of a union's kinds
    context = error.get("ctx", {})
    if isinstance(cause := context.get("error"), ConfigError):  # of a validator
        return ".".join(filter(None, (key, cause.key))), cause.reason
    if error["type"] in _EXPECTED:
        expected = _EXPECTED[error["type"]].format(**context)
        value = context.get("got", error["input"])
        got = repr(value) if isinstance(value, str) else show(value)
        got = "an unknown one" if error["type"] == "extra_forbidden" else got
        return key, f"expected {expected}, got {got}"
    message = error["msg"].removeprefix("Value error, ")
    return key, f"{message[:1].lower()}{message[1:]}"


def _strict(schema: Any) -> Any:
    """Return a schema whose numbers, truth values and texts are strict."""
    if isinstance(schema, list | tuple):
        return type(schema)(map(_strict, schema))
    if not isinstance(schema, dict):
        return schema
    made = {key: _strict(value) for key, value in schema.items()}
    return made | {"strict": True} if schema.get("type") in ("float", "int", "bool", "str") else made


class Options(Checked):
    """Options of a command. Immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Settings(Options):
    """Settings that are read from YAML and written to it: strict, but for options, see `from_models.made`."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """The schema: truth values and texts are no numbers, and numbers neither."""
        schema: CoreSchema = _strict(handler(source))
        return schema

    @model_validator(mode="before")
    @classmethod
    def _of_python(cls, values: Any) -> Any:
        """NumPy's numbers as Python's own."""
        if not isinstance(values, dict):
            return values
        return {
            name: value.item() if isinstance(value, Number) and hasattr(value, "item") else value
            for name, value in values.items()
        }

    @classmethod
    def make(cls, values: dict[str, Any], source: str | None = None) -> Self:
        """Return validated settings.

        Raises:
            ConfigError: in one line: source, key and fault.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            key, reason = explained(error)
            place = cls.__name__.lower() if source is None else source
            raise ConfigError(place, key, reason=reason) from None

    @classmethod
    def parse(cls, text: str, source: str | None = None, **changes: Any) -> Self:
        """Return the settings of a YAML text; keys that it leaves out take their defaults; errors as of `make`."""
        from mjx_climb.scenario import yaml_text

        source = cls.__name__.lower() if source is None else source
        data = yaml_text.parse(text, source)
        if not isinstance(data, dict | None):
            raise ConfigError(source, "", "a mapping")
        return cls.make({**(data or {}), **changes}, source)

    @classmethod
    def load(cls, path: str | os.PathLike[str], **changes: Any) -> Self:
        """Read settings from a YAML file, with some of its top keys changed; errors as of `make`."""
        from mjx_climb.scenario import yaml_text

        return cls.parse(yaml_text.read(os.fsdecode(path)), os.fsdecode(path), **changes)

    def changed(self, changes: dict[str, Any], source: str | None = None) -> Self:
        """Return the settings with some keys replaced, validated as by `make`."""
        return self.make({**self.model_dump(), **changes}, source) if changes else self

    def to_yaml(self) -> str:
        """Return the settings as YAML; loading it gives equal ones."""
        import yaml

        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=110)
