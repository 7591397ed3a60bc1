"""Numbers in words and in JSON, the same in a terminal and on a page, and remarks on them."""

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from mjx_climb.walk.metrics import FAILURES

if TYPE_CHECKING:
    from mjx_climb import MetricTable, Scenario

LONG = 10.0  # m; a TSM beyond it is no length of a robot, and a base so far off its reference flies
WEIGHT = 0.1  # m/s^2; gravity above it is felt


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers of numpy's as Python's, None for one that is not finite."""
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
    """Return a gain of one number or of axes on six axes: one of three on the translations, NaN where it has none."""
    values = np.atleast_1d(np.asarray(np.nan if value is None else value, float))
    return np.broadcast_to(values, 6) if values.size in (1, 6) else np.append(values, np.full(6 - values.size, np.nan))


def gain(gains: Mapping[str, ArrayLike] | None, key: str) -> str:
    """Return a gain for a table: its number where all its values are the same, of an array shape and norm."""
    if gains is None or key not in gains:
        return "-"
    values = np.asarray(gains[key], float)
    if np.ptp(values) == 0:
        return f"{values.flat[0]:.4g}"
    if has_axes(values):
        return "three values" if values.size == 3 else "six values"
    return f"{' x '.join(map(str, values.shape))}, norm {np.linalg.norm(values):.4g}"


def has_axes(value: ArrayLike | None) -> bool:
    """Return whether a gain has a number for each axis, or one for all, and is no array of another shape."""
    return np.shape(() if value is None else value) in ((), (1,), (3,), (6,))


def unit(name: str, about: "MetricTable") -> str:
    """Return the unit of a metric for people."""
    return plain_unit(about[name].unit)


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


def remarks(walks: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return all remarks on the metrics of walks, a line each."""
    lost = {name: failed(metrics) for name, metrics in walks.items()}
    failures = [f"{name} failed ({how}): its numbers compare with no other's" for name, how in lost.items() if how]
    return failures + weightless(walks)


def failed(metrics: Mapping[str, Any], lets_go: str = "lets go", diverges: str = "the simulation diverges") -> str:
    """Return in words how a walk failed, nothing where it did not."""
    found = []
    if metrics.get("detached_limb") is not None:
        found.append(f"{metrics['detached_limb']} {lets_go} at {metrics['detached_at']:.2f} s")
    if metrics.get("diverged"):
        found.append(diverges)
    if metrics.get("stands_at") is not None:
        found.append(f"stands from {metrics['stands_at']:.2f} s")
    return ", ".join(found)


def presentable(metrics: Mapping[str, Any], instead: str | None = "failed") -> dict[str, Any]:
    """Return the metrics of a walk as people are shown them.

    Of a walk that failed and then diverged, or left its path by more than `LONG`, numbers mean nothing: `instead`
    stands for all but those that say how it failed.
    """
    flown = not (metrics.get("base_deviation") or 0.0) <= LONG
    if not failed(metrics) or not (metrics.get("diverged") or flown):
        return dict(metrics)
    return {name: value if name in FAILURES else instead for name, value in metrics.items()}


def change_of(metrics: Mapping[str, Any], base: Mapping[str, Any], name: str) -> str:
    """Return the change of a metric against another walk's, nothing where either walk failed."""
    return "" if failed(metrics) or failed(base) else change(metrics[name], base[name])


def weightless(walks: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the meaning of a TSM where hardly anything has weight."""
    if all((metrics.get("min_tsm") or 0.0) <= LONG for metrics in walks.values()):
        return []
    return ["min TSM is a moment over the weight, with next to no weight it is no length: see min GIA margin"]


def ahead_of(scenario: "Scenario") -> list[str]:
    """Return the objections to a scenario before any walk."""
    control, step = scenario.control, scenario.time_step
    heavy = sum(value**2 for value in scenario.gravity) > WEIGHT**2
    low_reaction = scenario.gait.swing == "low_reaction" and scenario.value("contact.capture_distance") is None
    measured = control.controller == "base_admittance" and control.reading == "measured_pose"
    usual = scenario.hardware.control_period or step == type(scenario).model_fields["time_step"].default
    found = {
        "gait.swing: low_reaction under weight without contact.capture_distance: grippers that shut off the ground are "
        "pulled there, and forces may vary more than with cubic swings": low_reaction and heavy,
        f"control.reading: measured_pose looks one period ahead, which is the time step, {step:g} s, without a "
        "hardware.control_period: what its gains do depends on it": measured and not usual,
    }
    return [text for text, holds in found.items() if holds]
