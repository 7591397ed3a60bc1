"""Docstrings in the reference of the API: fields of classes with their comments, and stars that mean a star."""

import re

import griffe

PRIVATE = re.compile(r"\b_[A-Z]\w*")  # the name of a module's own type
STAR = re.compile(r"(?<=[( ])\*(?=\w)")  # of (*batch, 3)


class Fields(griffe.Extension):
    """Adds the fields of a class to its docstring, each with the comment that stands beside it in the code."""

    def on_class(self, *, cls: griffe.Class, **_) -> None:
        """Add a section of them, where they have comments."""
        rows, commented = [], False
        for name, field in cls.attributes.items():
            if not name.islower() or name.startswith("_"):  # AXES and the like are no fields
                continue
            lines = cls.lines_collection[field.filepath][field.lineno - 1 : field.endlineno]  # it may be inherited
            comment = " ".join(found[1] for line in lines if (found := re.search(r"  # (.*)", line)))
            kind = PRIVATE.sub("Array", str(field.annotation)).replace("Array | Array", "Array")
            rows.append(f"    {name} ({kind}): {comment}")
            commented |= bool(comment)
        if commented and cls.docstring:
            cls.docstring.value = "\n".join([cls.docstring.value, "", "Attributes:", *rows])

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Escape stars outside of code, two of which would be an emphasis."""
        if obj.docstring:
            parts = obj.docstring.value.split("`")
            parts[::2] = [STAR.sub(r"\\*", part) for part in parts[::2]]
            obj.docstring.value = "`".join(parts)
