"""mjx_climb: a differentiable, batched simulator of a limbed climbing robot under admittance control."""

from mjx_climb import mujoco_import  # noqa: F401  (first: it imports MuJoCo)
from mjx_climb.compilation import compiler_options, pieces_pay
from mjx_climb.config import ConfigError, Scenario, load_scenario
from mjx_climb.dynamics import ENGINES, forward_dynamics
from mjx_climb.histories import rollout_histories
from mjx_climb.metrics import METRICS
from mjx_climb.parameters import Gains, Parameters, parameters
from mjx_climb.robot import RobotError
from mjx_climb.rollout import metrics, rollout, rollout_metrics, simulator
from mjx_climb.slopes import rollout_slopes
from mjx_climb.state import Acceleration, State
from mjx_climb.trajectory import Trajectory

__all__ = [
    "ENGINES",
    "METRICS",
    "Acceleration",
    "ConfigError",
    "Gains",
    "Parameters",
    "RobotError",
    "Scenario",
    "State",
    "Trajectory",
    "compiler_options",
    "forward_dynamics",
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
