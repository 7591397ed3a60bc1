"""The rest stance of a scenario, checked."""

import functools

from mjx_climb.physics.postures import SINGULAR, keeps_attitude, least_singular_values
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile, Scenario


def check_stance(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a rest stance in which a limb is singular: it cannot move its foot every way, or turn it as its grip asks.

    Raises:
        ConfigError: in one line, the limb and the smallest singular value of its Jacobian.
    """
    if wrong := _singular_limb(scenario.robot, scenario.contact.rotational_stiffness > 0):
        raise ConfigError(f"{source}: {wrong}")


@functools.lru_cache(maxsize=64)
def _singular_limb(name: str | RobotFile, moments: bool) -> str | None:
    robot = load_robot(name)
    turned = moments and keeps_attitude(robot)
    values = least_singular_values(robot, robot.stance_joints, turned)
    limb, least, does = robot.limbs[values.argmin()], values.min(), "move and turn" if turned else "move"
    if least >= SINGULAR:
        return None
    return (
        f"robot.limbs.{limb}.foothold: expected a stance in which the limb can {does} its foot every way, got a "
        f"singular one (smallest singular value of its Jacobian {least:.2g}, lengths over the limb's): another height "
        "or foothold"
    )
