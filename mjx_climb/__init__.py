"""mjx_climb: a differentiable, batched simulator of a limbed climbing robot under admittance control."""

from mjx_climb import execution  # noqa: F401  # which must see forks from now on
from mjx_climb.lazy import lazy_names

TYPE_CHECKING = False
if TYPE_CHECKING:
    from mjx_climb.component import parameter as parameter
    from mjx_climb.control import Command as Command
    from mjx_climb.control import Law as Law
    from mjx_climb.control import Measurement as Measurement
    from mjx_climb.control import Reference as Reference
    from mjx_climb.control import Start as Start
    from mjx_climb.control import gain as gain
    from mjx_climb.disturbances.disturbance import Body as Body
    from mjx_climb.disturbances.disturbance import Disturbance as Disturbance
    from mjx_climb.disturbances.disturbance import External as External
    from mjx_climb.functions import forward_dynamics as forward_dynamics
    from mjx_climb.functions import metrics as metrics
    from mjx_climb.functions import rollout as rollout
    from mjx_climb.functions import rollout_histories as rollout_histories
    from mjx_climb.functions import rollout_jvp as rollout_jvp
    from mjx_climb.functions import rollout_metrics as rollout_metrics
    from mjx_climb.functions import rollout_vjp as rollout_vjp
    from mjx_climb.functions import simulator as simulator
    from mjx_climb.gait.footholds.footholds import Footholds as Footholds
    from mjx_climb.gait.recovery import Recovery as Recovery
    from mjx_climb.ground.holds import Holds as Holds
    from mjx_climb.hardware.actuator import Actuator as Actuator
    from mjx_climb.hardware.actuator import Drive as Drive
    from mjx_climb.hardware.actuator import Joints as Joints
    from mjx_climb.hardware.actuator import JointSpring as JointSpring
    from mjx_climb.inputs.from_scenario import parameters as parameters
    from mjx_climb.inputs.from_scenario import paths as paths
    from mjx_climb.parameter_types import Gains as Gains
    from mjx_climb.parameter_types import Parameters as Parameters
    from mjx_climb.physics.contact.contact import Contact as Contact
    from mjx_climb.physics.contact.contact import Grip as Grip
    from mjx_climb.physics.contact.contact import Springs as Springs
    from mjx_climb.physics.equations_of_motion import ENGINES as ENGINES
    from mjx_climb.physics.state import Acceleration as Acceleration
    from mjx_climb.physics.state import State as State
    from mjx_climb.robot.constants import RobotError as RobotError
    from mjx_climb.scenario.load import load_scenario as load_scenario
    from mjx_climb.scenario.messages import ConfigError as ConfigError
    from mjx_climb.scenario.model import Scenario as Scenario
    from mjx_climb.simulation import Simulation as Simulation
    from mjx_climb.simulation import SimulationState as SimulationState
    from mjx_climb.trajectory import Trajectory as Trajectory
    from mjx_climb.walk.control_loop import BaseShift as BaseShift
    from mjx_climb.walk.control_loop import JointTargets as JointTargets
    from mjx_climb.walk.metrics import METRICS as METRICS
    from mjx_climb.walk.metrics import Metric as Metric
    from mjx_climb.walk.metrics import MetricTable as MetricTable
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
