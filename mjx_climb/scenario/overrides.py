"""Single keys of nested data replaced, by dotted name."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mjx_climb.scenario.messages import config_error, show
from mjx_climb.scenario.yaml_text import parse


def override(data: dict[str, Any], overrides: Sequence[str] | Mapping[str, Any], source: str) -> None:
    """Set keys of nested data, in place.

    Arguments:
        data: mappings and lists.
        overrides: strings "dotted.key=value" with the value in YAML, or a mapping from dotted keys to values.
        source: names the data in errors.

    Raises:
        ConfigError: an override of another form, or of a place that is not there.
    """
    with _of_few_levels(source):
        for key, value in pairs(overrides, source):
            _assign(data, key, value, source)


def pairs(overrides: Sequence[str] | Mapping[str, Any], source: str) -> list[tuple[Any, Any]]:
    """Return dotted keys and values of overrides, a mapping's keys one by one; arguments and errors as `override`."""
    with _of_few_levels(source):
        return [pair for key, value in _given(overrides, source) for pair in _single(key, value, source)]


@contextlib.contextmanager
def _of_few_levels(source: str) -> Iterator[None]:
    try:
        yield
    except RecursionError:
        raise config_error(source, "", "overrides of a few levels", "endless nesting") from None


def _given(overrides: Sequence[str] | Mapping[str, Any], source: str) -> list[tuple[Any, Any]]:
    if isinstance(overrides, Mapping):
        return list(overrides.items())
    found = []
    for text in [overrides] if isinstance(overrides, str) else overrides:
        key, equals, value = text.partition("=") if isinstance(text, str) else ("", "", "")
        if not (key.strip() and equals and value.strip()):  # an empty value would be a silent null
            raise config_error(source, "", "an override of the form dotted.key=value", show(text))
        found.append((key.strip(), parse(value, source, key.strip())))
    return found


def _single(key: Any, value: Any, source: str) -> list[tuple[Any, Any]]:
    if not isinstance(value, Mapping):
        return [(key, value)]
    if not value:
        raise config_error(source, key, "a mapping with at least one key", "{}")
    return [pair for name, inner in value.items() for pair in _single(f"{key}.{name}", inner, source)]


def _assign(data: dict[str, Any], key: Any, value: Any, source: str) -> None:
    """Set `key` (dotted) of the nested mapping `data` to `value`."""
    if not isinstance(key, str) or not all(key.split(".")):
        raise config_error(source, "", "an override of the form dotted.key=value", show(key))
    parts = key.split(".")
    target: Any = data
    for level, part in enumerate(parts):
        place = ".".join(parts[:level])
        last = level == len(parts) - 1
        if isinstance(target, list):
            if not (part.isascii() and part.isdecimal() and len(part) < 9 and int(part) < len(target)):
                raise config_error(source, place, f"an index below {len(target)}", show(part))
            index: Any = int(part)
        elif isinstance(target, dict):
            index = part
            if not last:
                target.setdefault(part, {})
                if target[part] is None or (place == "" and part == "robot" and isinstance(target[part], str)):
                    target[part] = {}  # a section takes the place of none, a robot's file that of a name
        else:
            raise config_error(source, place, "no further keys below this one", show(part))
        if last:
            target[index] = _plain(value)
        else:
            target = target[index]


def _plain(value: Any) -> Any:
    """Numpy and JAX numbers and arrays as Python's own."""
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value
