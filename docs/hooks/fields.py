"""Docstrings in the reference of the API: fields of classes with their comments or help, and stars that mean a star."""

import ast
import re
import textwrap

import griffe

PRIVATE = re.compile(r"\b_[A-Z]\w*")  # the name of a module's own type
NUMBER = re.compile(r"\b_(Positive|NonNegative|Finite|Share)\b")
STAR = re.compile(r"(?<=[( ])\*(?=\w)")  # of (*batch, 3)


class Fields(griffe.Extension):
    """Adds the fields of a class to its docstring: the comment beside each, of a setting its help and default."""

    def on_class(self, *, cls: griffe.Class, **_) -> None:
        """Add a section of them, where they have comments."""
        rows, commented = [], False
        for name, field in cls.attributes.items():
            if not name.islower() or name.startswith("_") or name == "model_config":  # AXES and the like are no fields
                continue
            lines = cls.lines_collection[field.filepath][field.lineno - 1 : field.endlineno]  # it may be inherited
            comment = " ".join(found[1] for line in lines if (found := re.search(r"  # (.*)", line)))
            comment = comment or _help("\n".join(lines))
            rows.append(f"    {name} ({_kind(str(field.annotation))}): {comment}")
            commented |= bool(comment)
        if commented and cls.docstring:
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


def _help(code: str) -> str:
    """Return the help text in `setting(default, "help")`, `Field(..., description="help")`, `parameter` or `_of`."""
    call = getattr(ast.parse(textwrap.dedent(code)).body[0], "value", None)
    called = getattr(getattr(call, "func", None), "id", "")
    if isinstance(call, ast.Call) and called in ("_of", "quantity"):  # the first has a key before the unit
        values = [getattr(each, "value", None) for each in call.args[called == "_of" :]]
        unit, name = [*values, None, None][:2]
        return f"{name[:1].upper()}{name[1:]}, {unit}" if name and unit else name or ""
    if not isinstance(call, ast.Call) or called not in ("setting", "Field", "parameter"):
        return ""
    named = {keyword.arg: keyword.value for keyword in call.keywords}
    if called == "parameter":  # of a contact, an actuator or a disturbance
        unit, name = (getattr(each, "value", "") for each in (call.args[0], named.get("long_name")))
        text: ast.expr | None = ast.Constant(f"{name}, {unit}" if name else f"in {unit}")
        default = named.get("default")
    else:
        text = named.get("description", call.args[1] if len(call.args) > 1 else None)
        default = named.get("default", call.args[0] if call.args else None)
    if not isinstance(text, ast.Constant):
        return ""
    shown = "" if default is None or ast.unparse(default) in ("None", "...") else f" Default: `{ast.unparse(default)}`."
    return f"{text.value[:1].upper()}{text.value[1:]}.{shown}"
