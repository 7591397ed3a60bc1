"""Numbers in words and in JSON, the same in a terminal and on a page."""

import json
import math
from collections.abc import Mapping

import numpy as np


def plain(value):
    """Return a value as JSON has it: numbers of numpy's as Python's, None for what is not finite."""
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(value) -> str:
    """Return JSON text, strictly so: no NaN."""
    return json.dumps(plain(value), indent=2, allow_nan=False)


def number(value) -> str:
    """Return a value of a metric for a table."""
    if value is None:
        return "-"
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return value if isinstance(value, str) else f"{value:.4g}"


def gain(gains: Mapping | None, key: str) -> str:
    """Return a gain, one or six of them, for a table."""
    if gains is None:
        return "-"
    values = np.unique(np.asarray(gains[key], float))
    return f"{values[0]:.4g}" if values.size == 1 else "six values"


def unit(name: str) -> str:
    """Return the unit of a metric, empty where it has none."""
    from mjx_climb import METRICS

    return "" if METRICS[name] == "1" else METRICS[name]


def change(value, base) -> str:
    """Return the change against a baseline, in per cent without the sign."""
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in (value, base)) or not base:
        return ""
    percent = 100 * (value / base - 1)
    return f"{percent:+.1f}" if abs(percent) < 100 else f"{percent:+.0f}"
