"""What every section of a scenario is: immutable, without unknown keys, refusing bad values in one line."""

from typing import TYPE_CHECKING, Any, cast

from pydantic import BaseModel, ConfigDict, ValidationError

from mjx_climb.scenario.messages import refusal

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
