"""Forward dynamics behind one seam: state, torques and forces in, accelerations out.

An engine is one module with `build(robot) -> ForwardDynamics`, for one robot; nothing outside this package knows which
one runs.
"""

from collections.abc import Callable

from jax import Array

from mjx_climb.physics import limb_engine
from mjx_climb.physics.state import Acceleration, State
from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError

# state, joint torque (limb, joint), foot force (limb, 3), base wrench (6,), cargo mass (), gravity (3,)
ForwardDynamics = Callable[[State, Array, Array, Array, Array, Array], Acceleration]


def _mjx(robot: Robot) -> ForwardDynamics:
    from mjx_climb.physics import mjx_engine  # takes longer to import than all the rest

    return mjx_engine.build(robot)


ENGINES: dict[str, Callable[[Robot], ForwardDynamics]] = {"mjx": _mjx, "limb": limb_engine.build}
DEFAULT_ENGINE = "limb"


def checked_engine(name: str) -> str:
    """Return the name of an engine as it is.

    Raises:
        ConfigError: no such engine.
    """
    if name not in ENGINES:
        raise ConfigError("", "engine", f"one of {', '.join(ENGINES)}", f"{name!r}")
    return name
