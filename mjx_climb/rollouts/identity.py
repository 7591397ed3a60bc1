"""What a program of a walk depends on beside numbers, as text that holds in other processes too."""

import hashlib
from typing import Any

import numpy as np

from mjx_climb.control import LAWS, Law
from mjx_climb.dynamics import ENGINES
from mjx_climb.robot.constants import load_robot
from mjx_climb.scenario.model import RobotFile
from mjx_climb.walk.metrics import METRICS, MetricTable
from mjx_climb.walk.step import Structure

_PACKAGE = __name__.split(".")[0] + "."


def identity(structure: Structure, law: Law, *trees: Any) -> str | None:
    """Return what a program depends on, None for a law, a metric or an engine of the user's own.

    Their code may change from one process to the next while their names stay; this package's own is known.
    """
    parts = structure._asdict()
    robot, metrics = parts.pop("robot"), parts.pop("metrics")
    if type(law) not in LAWS.values() or not all_shipped(metrics):
        return None
    if not ENGINES[structure.engine].__module__.startswith(_PACKAGE) or not all(map(_is_plain, parts.values())):
        return None
    if not isinstance(robot, str) and structure.engine != "limb":  # which knows the robot by its constants alone
        return None
    kind = f"{type(law).__module__}.{type(law).__qualname__}"
    return repr((of_robot(robot), metrics.names, sorted(parts.items()), kind))


def all_shipped(metrics: MetricTable) -> bool:
    """Return whether all metrics are this package's own."""
    shipped = {metric.name: metric for metric in METRICS.with_companions}
    return all(shipped.get(metric.name) is metric for metric in metrics)


def _is_plain(value: Any) -> bool:
    return all(map(_is_plain, value)) if isinstance(value, tuple) else isinstance(value, (str, int, float, type(None)))


def of_robot(robot: str | RobotFile) -> str:
    """Return a robot's name, or a digest of all that its file says but where it lies."""
    if isinstance(robot, str):
        return robot
    constants = vars(load_robot(robot))
    content = [repr((name, _content(constants[name]))) for name in sorted(constants) if name != "model"]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()


def _content(value: Any) -> Any:
    return (value.shape, value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value
