"""What a reader should know beside the numbers of walks: which failed, and which number is not what it seems."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import mjx_climb as mc

Walks = Mapping[str, Mapping[str, Any]]  # metrics by walk

LONG = 10.0  # m; a TSM beyond it is no length of a robot
WEIGHT = 0.1  # m/s^2; gravity above it is felt


def remarks(walks: Walks) -> list[str]:
    """Return all remarks on walks, a line each."""
    return failures(walks) + weightless(walks)


def failures(walks: Walks) -> list[str]:
    """Return which walks failed, and how."""
    lost = {name: failed(metrics) for name, metrics in walks.items()}
    return [f"{name} failed ({how}): its numbers compare with no other's" for name, how in lost.items() if how]


def weightless(walks: Walks) -> list[str]:
    """Return what a TSM stands for where hardly anything has weight."""
    if all((metrics.get("min_tsm") or 0.0) <= LONG for metrics in walks.values()):
        return []
    return ["min TSM is a moment over the weight, with next to no weight it is no length: see min GIA margin"]


def ahead_of(scenario: "mc.Scenario") -> list[str]:
    """Return what speaks against a scenario before any walk."""
    return _swings(scenario) + _horizon(scenario)


def _swings(scenario: "mc.Scenario") -> list[str]:
    heavy = sum(value**2 for value in scenario.gravity) > WEIGHT**2
    if scenario.gait.swing != "low_reaction" or scenario.contact.capture_distance is not None or not heavy:
        return []
    return [
        "gait.swing: low_reaction under weight without contact.capture_distance: grippers that shut off the ground are "
        "pulled there, and forces may vary more than with cubic swings"
    ]


def _horizon(scenario: "mc.Scenario") -> list[str]:
    control, step = scenario.control, scenario.time_step
    if control.controller != "base_admittance" or control.reading != "measured_pose":
        return []
    if scenario.hardware.control_period or step == type(scenario).model_fields["time_step"].default:
        return []
    return [
        f"control.reading: measured_pose looks one period ahead, which is the time step, {step:g} s, without a "
        "hardware.control_period: what its gains do depends on it"
    ]


def failed(metrics: Mapping[str, Any]) -> str:
    """Return in words how a walk failed, nothing where it did not."""
    found = []
    if metrics["detached_limb"] is not None:
        found.append(f"{metrics['detached_limb']} lets go at {metrics['detached_at']:.2f} s")
    if metrics["diverged"]:
        found.append("the simulation diverges")
    return ", ".join(found)
