"""YAML, and single keys in its data replaced by dotted name.

It is the core schema of YAML 1.2, where 2e3 is a number, without tags, anchors, aliases or duplicate keys. PyYAML
reads YAML 1.1; ruamel.yaml reads 1.2, but would need the same checks on top of it.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import yaml

from mjx_climb.scenario.messages import ConfigError, show

MAX_FILE_BYTES = 1_000_000
MAX_NESTING = 20


class Loader(yaml.SafeLoader):
    """Reads the core schema of YAML 1.2."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (PyYAML's own protocol)
    depth = 0

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self.keys: dict[int, set[str]] = {}  # of each mapping, by its id

    def problem(self, text: str, at: Any) -> yaml.MarkedYAMLError:
        return yaml.MarkedYAMLError(problem=text, problem_mark=at.start_mark)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = yaml.SafeLoader.peek_event(self)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) or getattr(event, "tag", None):
            raise self.problem("tags, anchors and aliases are not used here", event)
        if self.depth == MAX_NESTING:
            raise self.problem(f"nested deeper than {MAX_NESTING}", event)
        if isinstance(index, yaml.Node):  # of a value: its key
            self.taken(index, self.keys.setdefault(id(parent), set()))
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def taken(self, key: yaml.Node, seen: set[str]) -> None:
        """Refuse a key as soon as it is read: the rest of a long file would take seconds."""
        if key.tag != "tag:yaml.org,2002:str":
            raise self.problem("a key is not a word", key)
        if key.value in seen:
            raise self.problem(f"key {key.value!r} comes twice", key)
        seen.add(key.value)

    def construct_integer(self, node: yaml.ScalarNode) -> int | float:
        # Decimal even with leading zeros. A huge one, too long for int(), becomes a float, perhaps inf.
        return int(node.value) if len(node.value) < 18 else float(node.value)


Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_integer)
for _tag, _pattern in {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+",
    "float": r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}.items():
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), None)


class Dumper(yaml.SafeDumper):
    """Writes text that `Loader` reads back as the same."""

    yaml_implicit_resolvers = Loader.yaml_implicit_resolvers  # quotes words that would load as numbers


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
        raise ConfigError(source, "", "a readable file", reason) from None
    if len(content) > MAX_FILE_BYTES:
        raise ConfigError(source, "", f"at most {MAX_FILE_BYTES} bytes", "more")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        where = f"byte 0x{content[error.start]:02x} at offset {error.start}"
        raise ConfigError(source, "", "UTF-8 text", where) from None


def parse(text: str, source: str, key: str = "") -> object:
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
        raise ConfigError(source, key, "valid YAML", f"{line}{reason}") from None


def pairs(overrides: Sequence[str] | Mapping[str, object], source: str) -> list[tuple[str, object]]:
    """Return dotted keys and values of overrides, a mapping's keys one by one.

    Overrides are strings "dotted.key=value" with the value in YAML, or a mapping from dotted keys to values.

    Raises:
        ConfigError: an override of another form.
    """
    if isinstance(overrides, Mapping):
        return [pair for key, value in overrides.items() for pair in _single(key, value, source)]
    found = []
    for text in [overrides] if isinstance(overrides, str) else overrides:
        key, _, value = map(str.strip, text.partition("=")) if isinstance(text, str) else ("", "", "")
        if not key or not value:  # an empty value would be a silent null
            raise ConfigError(source, "", "an override of the form dotted.key=value", show(text))
        found += _single(key, parse(value, source, key), source)
    return found


def _single(key: str, value: object, source: str) -> list[tuple[str, object]]:
    if not isinstance(value, Mapping):
        return [(key, value)]
    if not value:
        raise ConfigError(source, key, "a mapping with at least one key", "{}")
    return [pair for name, inner in value.items() for pair in _single(f"{key}.{name}", inner, source)]


def assign(data: dict[str, object], key: str, value: object, source: str) -> None:
    """Set `key` (dotted) of the nested mapping `data` to `value`.

    Raises:
        ConfigError: a place that is not there.
    """
    if not isinstance(key, str) or not all(parts := key.split(".")):
        raise ConfigError(source, "", "an override of the form dotted.key=value", show(key))
    target: Any = data
    for level, part in enumerate(parts):
        place, index = ".".join(parts[:level]), cast(Any, part)
        if isinstance(target, list):
            if not (part.isascii() and part.isdecimal() and len(part) < 9 and int(part) < len(target)):
                raise ConfigError(source, place, f"an index below {len(target)}", show(part))
            index = int(part)
        elif not isinstance(target, dict):
            raise ConfigError(source, place, "no further keys below this one", show(part))
        if level == len(parts) - 1:
            target[index] = _plain(value)
        elif isinstance(target, dict):
            named = key.startswith(("robot.", "gait.footholds.")) and isinstance(target.get(part), str)
            if named or target.get(part) is None:
                target[part] = {}  # a section takes the place of none, or of a name
        target = target[index]


def _plain(value: object) -> object:
    """Numpy and JAX numbers and arrays as Python's own."""
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value
