"""Numbers in words and in JSON, the same in a terminal and on a page."""

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from mjx_climb import MetricTable


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers of numpy's as Python's, None for what is not finite."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value: Any) -> str:
    """Return JSON text, strictly so: no NaN."""
    return json.dumps(plain(value), indent=2, allow_nan=False)


def number(value: float | str | None) -> str:
    """Return a value of a metric for a table."""
    if value is None:
        return "-"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return value if isinstance(value, str) else f"{value:.4g}"


def axis_values(value: ArrayLike | None) -> np.ndarray:
    """Return a gain on six axes: one of three on the translations, NaN where it has none."""
    values = np.atleast_1d(np.asarray(np.nan if value is None else value, float))
    return np.broadcast_to(values, 6) if values.size in (1, 6) else np.append(values, np.full(6 - values.size, np.nan))


def gain(gains: Mapping[str, ArrayLike] | None, key: str) -> str:
    """Return a gain, one or six of them, for a table."""
    if gains is None or key not in gains:
        return "-"
    values = np.unique(np.asarray(gains[key], float))
    return f"{values[0]:.4g}" if values.size == 1 else "six values"


def unit(name: str, about: "MetricTable | None" = None) -> str:
    """Return the unit of a metric, one of `about` or of the shipped ones; empty where it has none."""
    from mjx_climb import METRICS

    return plain_unit((about or METRICS)[name].unit)


def words(name: str, about: "MetricTable | None" = None) -> str:
    """Return what a metric, one of `about` or of the shipped ones, is called for people."""
    from mjx_climb import METRICS

    return (about or METRICS).in_words(name)


def plain_unit(text: str) -> str:
    """Return a unit for people: nothing for a number without one."""
    return "" if text.strip() == "1" else text.strip()


def change(value: float | str | None, base: float | str | None) -> str:
    """Return the change against a baseline, in per cent without the sign."""
    if not (is_number(value) and is_number(base) and base):
        return ""
    percent = 100 * (value / base - 1)
    return f"{percent:+.1f}" if abs(percent) < 100 else f"{percent:+.0f}"


def is_number(value: float | str | None) -> TypeGuard[float]:
    """Return whether a value of a metric is a number, not a truth, a name or nothing."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
