"""The static inputs of a compiled walk: all that it depends on beside its law and the values of its parameters."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from mjx_climb.control import LAWS, Law
from mjx_climb.execution.contents import Unidentifiable, identity
from mjx_climb.hardware.stages import IDEAL, Stages
from mjx_climb.inputs.from_scenario import stages_under_trace
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.physics.equations_of_motion import ENGINES
from mjx_climb.physics.inverse_kinematics import Chain, limb_geometry
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.walk.metrics import GRIPS, METRICS, SENSORS, Metric, MetricTable

_PACKAGE = __name__.split(".")[0] + "."


class Structure(NamedTuple):
    """Static inputs of a compiled walk, beside its law and the values of its parameters; hashable."""

    robot: Robot
    engine: str
    lift_off: tuple[tuple[str, float], ...]  # of each limb, as a share of the cycle
    base_reference: str
    steps: int
    time_step: Any  # s, float; traced in programs that serve all
    metrics: MetricTable = METRICS
    smooth: bool = False  # no gripper is torn off
    stages: Stages = IDEAL  # of hardware between law and joints
    # digest of law, components, metrics and engine of the user's own: a global that they read may have changed
    own_code: str = ""
    free: bool = False  # the limb that gains most swings next
    way_points: tuple[tuple[float, float], ...] = ()  # m, that the base walks to
    planning: int = 0  # of `planning_steps`


def structure(
    scenario: Scenario,
    engine: str,
    parameters: Parameters,
    *,
    law: Law | None = None,
    metrics: Iterable[Metric] = METRICS,
    smooth: bool = False,
    called: Callable[[str], str] = "parameters.{}".format,
) -> Structure:
    """Return the structure of a scenario's walk.

    With `smooth` the metrics have their smooth companions, and no gripper is torn off. Parameters, with any leading
    batch axes, say which stages of hardware there are; see `stages_under_trace`.

    Raises:
        ConfigError: footholds to be chosen where there are no holds, or keys of chosen ones without a choice.
        ValueError: two metrics of one name, parameters that JAX traces and that decide about a stage, or a contact
            without `tear_off` where the holds have limits.
    """
    if parameters.footholds is not None and parameters.ground.holds is None:
        raise ConfigError("", "gait.footholds", "planned, as the ground has no holds to choose among")
    robot = load_robot(scenario.robot)
    if parameters.footholds is not None and parameters.footholds.reach_by_height:
        if isinstance(limb_geometry(robot), Chain):
            expected = "false for limbs other than of a yaw joint and two parallel pitch joints"
            raise ConfigError("", "gait.footholds.reach_by_height", expected, True)
    if parameters.footholds is None and scenario.gait.order == "free":
        raise ConfigError("", "gait.order", "periodic with planned footholds", "free")
    if parameters.footholds is None and scenario.gait.way_points:
        points = [list(point) for point in scenario.gait.way_points]
        raise ConfigError("", "gait.way_points", "none with planned footholds", points)
    contact = parameters.contact
    limited = parameters.ground.holds is not None and parameters.ground.holds.limit_bound.shape[-1] > 0
    if limited and contact is not None and type(contact).tear_off is Contact.tear_off:
        raise ValueError(f"{type(contact).__name__}: expected a method tear_off, as the holds have limits, got none")
    table = MetricTable(metrics)
    own: list[object] = [metric for metric in table if metric not in (*METRICS, *SENSORS, *GRIPS)]
    own += [] if law is None or type(law) in LAWS.values() else [type(law)]
    components = {type(each) for each in parameters.components.values()}
    own += [kind for kind in components if not kind.__module__.startswith(_PACKAGE)]
    own += [] if ENGINES[engine].__module__.startswith(_PACKAGE) else [ENGINES[engine]]
    try:
        own_code = identity(own) if own else ""
    except Unidentifiable:
        own_code = ""
    return Structure(
        robot=robot,
        engine=engine,
        lift_off=tuple(scenario.gait.lift_off.items()),
        base_reference=scenario.gait.base_reference,
        steps=scenario.steps,
        time_step=scenario.time_step,
        metrics=table.with_companions if smooth else table,
        smooth=smooth,
        stages=stages_under_trace(scenario, parameters, robot, called),
        own_code=own_code,
        free=scenario.gait.order == "free",
        way_points=scenario.gait.way_points,
        planning=planning_steps(scenario, parameters),
    )


def planning_steps(scenario: Scenario, parameters: Parameters) -> int:
    """Return the number of steps between decisions of the gait; 0: the periodic gait throughout."""
    decides = (parameters.footholds, parameters.recovery, parameters.waiting)
    return 0 if all(each is None for each in decides) else scenario.planning_steps
