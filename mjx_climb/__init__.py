"""mjx_climb: a differentiable, batched simulator of a limbed climbing robot under admittance control."""

from mjx_climb import mujoco_import  # noqa: F401  (first: it imports MuJoCo)
from mjx_climb.compilation.options import compiler_options, pieces_pay
from mjx_climb.dynamics import ENGINES, forward_dynamics
from mjx_climb.dynamics.state import Acceleration, State
from mjx_climb.quantities.parameters import Gains, Parameters, parameters
from mjx_climb.robot.constants import RobotError
from mjx_climb.rollouts.histories import rollout_histories
from mjx_climb.rollouts.rollout import metrics, rollout, rollout_metrics, simulator
from mjx_climb.rollouts.slopes import rollout_slopes
from mjx_climb.rollouts.trajectory import Trajectory
from mjx_climb.scenario.model import ConfigError, Scenario, load_scenario
from mjx_climb.walk.metrics import METRICS

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
