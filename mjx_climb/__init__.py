"""mjx_climb: a differentiable, batched simulator of a limbed climbing robot under admittance control.

Names are imported when they are first used, so that the command line and the reading of scenarios start at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

from mjx_climb.compilation import forked  # noqa: F401  # which must see forks from now on

if TYPE_CHECKING:
    from mjx_climb.compilation.options import compiler_options, pieces_pay
    from mjx_climb.control import Command, Law, Measurement, Reference, Start, gain
    from mjx_climb.dynamics import ENGINES, forward_dynamics
    from mjx_climb.dynamics.state import Acceleration, State
    from mjx_climb.quantities.parameters import Gains, Parameters, parameters
    from mjx_climb.robot.constants import RobotError
    from mjx_climb.rollouts.environment import BaseShift, Environment, EnvironmentState, JointTargets
    from mjx_climb.rollouts.histories import rollout_histories
    from mjx_climb.rollouts.judged import metrics
    from mjx_climb.rollouts.rollout import rollout, rollout_metrics, simulator
    from mjx_climb.rollouts.slopes import rollout_slopes
    from mjx_climb.rollouts.trajectory import Trajectory
    from mjx_climb.scenario.load import load_scenario
    from mjx_climb.scenario.messages import ConfigError
    from mjx_climb.scenario.model import Scenario
    from mjx_climb.walk.metrics import METRICS, Metric, MetricTable

_PUBLIC = {
    "compilation.options": ("compiler_options", "pieces_pay"),
    "control": ("Command", "Law", "Measurement", "Reference", "Start", "gain"),
    "dynamics": ("ENGINES", "forward_dynamics"),
    "dynamics.state": ("Acceleration", "State"),
    "quantities.parameters": ("Gains", "Parameters", "parameters"),
    "robot.constants": ("RobotError",),
    "rollouts.environment": ("BaseShift", "Environment", "EnvironmentState", "JointTargets"),
    "rollouts.histories": ("rollout_histories",),
    "rollouts.judged": ("metrics",),
    "rollouts.rollout": ("rollout", "rollout_metrics", "simulator"),
    "rollouts.slopes": ("rollout_slopes",),
    "rollouts.trajectory": ("Trajectory",),
    "scenario.load": ("load_scenario",),
    "scenario.messages": ("ConfigError",),
    "scenario.model": ("Scenario",),
    "walk.metrics": ("METRICS", "Metric", "MetricTable"),
}
_HOME = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "ENGINES",
    "METRICS",
    "Acceleration",
    "BaseShift",
    "Command",
    "ConfigError",
    "Environment",
    "EnvironmentState",
    "Gains",
    "JointTargets",
    "Law",
    "Measurement",
    "Metric",
    "MetricTable",
    "Parameters",
    "Reference",
    "RobotError",
    "Scenario",
    "Start",
    "State",
    "Trajectory",
    "compiler_options",
    "forward_dynamics",
    "gain",
    "load_scenario",
    "metrics",
    "parameters",
    "pieces_pay",
    "rollout",
    "rollout_histories",
    "rollout_metrics",
    "rollout_slopes",
    "simulator",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
