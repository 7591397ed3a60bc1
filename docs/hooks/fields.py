"""Docstrings in the reference of the API: fields of classes with their comments or help, and stars that mean a star."""

import importlib
import re

import griffe

PRIVATE = re.compile(r"\b_[A-Z]\w*")  # the name of a module's own type
NUMBER = re.compile(r"\b_(Positive|NonNegative|Finite|Share)\b")
COMMENT = re.compile(r"  # (?!fmt:|type:|noqa)(.*)")  # no word to a tool
STAR = re.compile(r"(?<=[( ])\*(?=\w)")  # of (*batch, 3)


class Fields(griffe.Extension):
    """Adds the fields of a class to its docstring: the comment beside each, or the words of its declaration."""

    def on_class(self, *, cls: griffe.Class, **_) -> None:
        """Add a section of them, where any has words."""
        declared = _declared(cls)
        rows, described = [], False
        for name, field in cls.attributes.items():
            if not name.islower() or name.startswith("_") or name == "model_config":  # AXES and the like are no fields
                continue
            lines = cls.lines_collection[field.filepath][field.lineno - 1 : field.endlineno]  # it may be inherited
            comment = " ".join(found[1] for line in lines if (found := COMMENT.search(line)))
            words = comment or declared.get(name, "")
            rows.append(f"    {name} ({_kind(str(field.annotation))}): {words}")
            described |= bool(words)
        if described and cls.docstring:
            cls.docstring.value = "\n".join([cls.docstring.value, "", "Attributes:", *rows])

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Escape stars outside of code, two of which would be an emphasis."""
        if obj.docstring:
            parts = obj.docstring.value.split("`")
            parts[::2] = [STAR.sub(r"\\*", part) for part in parts[::2]]
            obj.docstring.value = "`".join(parts)


def _kind(annotation: str) -> str:
    """Return the type of a field without a module's own names and without what a validator reads."""
    annotation = re.sub(r"^Annotated\[(.*), \w+(\(.*\))?\]$", r"\1", annotation)
    return PRIVATE.sub("Array", NUMBER.sub("float", annotation)).replace("Array | Array", "Array")


def _declared(cls: griffe.Class) -> dict[str, str]:
    """Return meaning, unit and default of each field that a function declares, as the class itself has them."""
    if not any(isinstance(field.value, griffe.ExprCall) for field in cls.attributes.values()):
        return {}
    kind = getattr(importlib.import_module(cls.module.path), cls.name)
    words = {name: (each.description, each.default) for name, each in getattr(kind, "model_fields", {}).items()}
    for name, field in getattr(kind, "__dataclass_fields__", {}).items():
        value = field.metadata["value"]._asdict() if "value" in field.metadata else field.metadata
        said, unit = value.get("meaning") or value.get("long_name"), value.get("unit")
        meaning = ", ".join(filter(None, (said, unit))) if said or not unit else f"in {unit}"
        array = "value" in field.metadata and callable(field.default_factory)
        default = field.default_factory().tolist() if array else field.default
        words[name] = "; ".join(filter(None, (meaning, value.get("note")))), default
    return {name: _sentence(text, default) for name, (text, default) in words.items() if text}


def _sentence(text: str, default: object) -> str:
    plain = isinstance(default, bool | int | float | str | tuple | list | dict)
    return f"{text[:1].upper()}{text[1:]}.{f' Default: `{default!r}`.' if plain else ''}"
