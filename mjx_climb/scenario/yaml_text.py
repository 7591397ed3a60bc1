"""YAML: the core schema of YAML 1.2, in which 2e3 is a number, and no tags, anchors, aliases or duplicate keys."""

import re
from pathlib import Path
from typing import Any

import yaml

from mjx_climb.scenario.messages import config_error

MAX_FILE_BYTES = 1_000_000
MAX_NESTING = 20


class Loader(yaml.SafeLoader):
    """Reads the core schema of YAML 1.2."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (PyYAML's own protocol)
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = yaml.SafeLoader.peek_event(self)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) or getattr(event, "tag", None):
            raise yaml.MarkedYAMLError(
                problem="tags, anchors and aliases are not used here", problem_mark=event.start_mark
            )
        if self.depth == MAX_NESTING:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_NESTING}", problem_mark=event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                raise yaml.MarkedYAMLError(problem="a key is not a word", problem_mark=key.start_mark)
            if key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key.value!r} comes twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_integer(self, node: Any) -> int | float:
        # Decimal even with leading zeros. A huge one, too long for int(), becomes a float, perhaps inf.
        return int(node.value) if len(node.value) < 18 else float(node.value)


Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_integer)
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), _first)


class Dumper(yaml.SafeDumper):
    """Writes what `Loader` reads as the same."""

    yaml_implicit_resolvers = Loader.yaml_implicit_resolvers  # quotes what would load as a number


def read(source: str) -> str:
    """Return the text of a file.

    Raises:
        ConfigError: no readable file of UTF-8 text, or too long a one.
    """
    try:
        with Path(source).open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        raise config_error(source, "", "a readable file", reason) from None
    if len(content) > MAX_FILE_BYTES:
        raise config_error(source, "", f"at most {MAX_FILE_BYTES} bytes", "more")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        where = f"byte 0x{content[error.start]:02x} at offset {error.start}"
        raise config_error(source, "", "UTF-8 text", where) from None


def parse(text: str, source: str, key: str = "") -> Any:
    """Return the data in a YAML text; `source` and `key` say where it stands.

    Raises:
        ConfigError: no such YAML.
    """
    try:
        return yaml.load(text, Loader=Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
        line = f"line {mark.line + 1}: " if mark is not None and not key else ""
        raise config_error(source, key, "valid YAML", f"{line}{reason}") from None


def dump(data: Any) -> str:
    """Return data as YAML that `parse` reads as the same."""
    return yaml.dump(data, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=110)
