"""Can the limbs do in the rest stance what their grips ask of them? Answered before anything is walked."""

import functools

import numpy as np

from mjx_climb.robot.constants import load_model
from mjx_climb.robot.posture import SINGULAR, keeps_attitude, smallest_singular_values
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile, Scenario


def check_stance(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a rest stance in which a limb is singular: it cannot move its foot every way, or turn it as its grip asks.

    Raises:
        ConfigError: in one line, the limb and the smallest singular value of its Jacobian.
    """
    limb, least, turned = _worst(scenario.robot, scenario.contact.rotational_stiffness > 0)
    if least < SINGULAR:
        does = "move and turn its foot" if turned else "move its foot"
        raise ConfigError(
            f"{source}: robot.limbs.{limb}.foothold: expected a stance in which the limb can {does} every way, got a "
            f"singular one (smallest singular value of its Jacobian {least:.2g}, lengths over the limb's): another "
            "height or foothold"
        )


@functools.lru_cache(maxsize=64)
def _worst(robot: str | RobotFile, moments: bool) -> tuple[str, float, bool]:
    """Return the limb nearest to singular in the rest stance, its smallest singular value, and whether turns count."""
    model = load_model(robot)
    turned = moments and keeps_attitude(model)
    least = smallest_singular_values(model, model.key_qpos[0, 7:].reshape(model.nsite, -1), turned)
    limb = int(np.argmin(least))
    return model.site(limb).name.removesuffix("_foot"), float(least[limb]), turned
