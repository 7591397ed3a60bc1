"""Forward dynamics behind one seam: state, torques and forces in, accelerations out.

An engine NAME is the file NAME_engine.py of this package, with `build(robot) -> ForwardDynamics`, for one robot;
nothing outside this package knows which one runs.
"""

import importlib
from collections.abc import Callable

from jax import Array

from mjx_climb.physics.state import Acceleration, State
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario import kinds
from mjx_climb.scenario.kinds import DEFAULT_ENGINE as DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError

# state, joint torque (limb, joint), foot force (limb, 3), base wrench (6,), cargo mass (), gravity (3,)
ForwardDynamics = Callable[[State, Array, Array, Array, Array, Array], Acceleration]


def _engine(name: str) -> Callable[[Robot], ForwardDynamics]:
    def build(robot: Robot) -> ForwardDynamics:
        # once it is used: MJX takes longer to import than all the rest
        engine = importlib.import_module(f"{__package__}.{name}{kinds.ENGINE_FILE}")
        dynamics: ForwardDynamics = engine.build(robot)
        return dynamics

    return build


ENGINES = {name: _engine(name) for name in kinds.ENGINES}


def checked_engine(name: str) -> str:
    """Return the name of an engine as it is.

    Raises:
        ConfigError: no such engine.
    """
    if name not in ENGINES:
        raise ConfigError("", "engine", f"one of {', '.join(ENGINES)}", f"{name!r}")
    return name
