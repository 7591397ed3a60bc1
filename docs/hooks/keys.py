"""The keys of a scenario as tables, from the models that check them, and the shipped kinds of its components."""

import re
from collections.abc import Iterator
from typing import Any

from mjx_climb.inputs.own_objects import class_of
from mjx_climb.scenario.kinds import shipped_kinds
from mjx_climb.scenario.model import Kind, Scenario

MARK = "<!-- the keys of a scenario -->"
KINDS = re.compile(r"<!-- the shipped kinds of ([\w.]+) -->")


def on_page_markdown(markdown: str, **_) -> str:
    """Put the tables, and the classes of kinds, where a page has their marks."""
    markdown = KINDS.sub(lambda found: classes(found[1]), markdown)
    return markdown.replace(MARK, tables()) if MARK in markdown else markdown


def classes(place: str) -> str:
    """Return the directives that document the shipped classes of a section."""
    each = (class_of(Kind(kind=kind), place) for kind in shipped_kinds(place))
    return "\n\n".join(f"::: {kind.__module__}.{kind.__qualname__}" for kind in each)


def tables() -> str:
    """Return a table for each section of a scenario."""
    schema = Scenario.model_json_schema()
    parts = []
    for name, field in schema["properties"].items():
        rows = [f"| `{key}` | {default} | {meaning} |" for key, default, meaning in _rows(name, field, schema["$defs"])]
        parts.append("\n".join([f"## {name}", "", "| key | default | meaning |", "|---|---|---|", *rows, ""]))
    return "\n".join(parts)


def _rows(key: str, field: dict[str, Any], models: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Return key, default and meaning of a field, then those of the fields below it."""
    below = [models[found] for found in _models(field)]
    plain = not below or ("default" in field and not isinstance(field["default"], dict))
    default = f"`{_yaml(field['default'])}`" if plain and "default" in field else ""
    choices = ", ".join(f"`{choice}`" for choice in field.get("enum", ()))
    meaning = "; ".join(filter(None, (field.get("description", ""), choices))).replace("|", "\\|")
    yield key, default, meaning
    shown = set()  # a kind of a section repeats some
    for model in below:
        for name, inner in model.get("properties", {}).items():
            yield from _rows(f"{key}.{name}", inner, models) if name not in shown else ()
            shown.add(name)
        for name in _models(model.get("additionalProperties") or {}):  # keys are names of the user's
            for inner, value in models[name].get("properties", {}).items():
                yield from _rows(f"{key}.NAME.{inner}", value, models)


def _models(field: dict[str, Any]) -> list[str]:
    """Return the names of the models that a field may hold."""
    kinds = [field, *field.get("anyOf", ()), *field.get("oneOf", ())]
    kinds += [kind.get("items", {}) for kind in kinds]
    return [kind["$ref"].rpartition("/")[2] for kind in kinds if isinstance(kind, dict) and "$ref" in kind]


def _yaml(value: object) -> str:
    words = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value)
