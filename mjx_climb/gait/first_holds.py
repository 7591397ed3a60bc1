"""The holds on which a robot stands at the start: to each foot of the rest stance the nearest one within its reach."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.arrays import AnyArray
from mjx_climb.gait.footholds.choice import Candidates, best
from mjx_climb.gait.footholds.held import Held
from mjx_climb.gait.footholds.reach import within_reach
from mjx_climb.ground import Holds, holds_of
from mjx_climb.physics.inverse_kinematics import Chain, LimbGeometry, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Gait, Ground, Scenario

_WIDE = 100.0  # m, over which no ground of a robot's size spreads
_NEAREST = 64  # holds to a foot, among which a scenario's check looks for one within reach
Place = tuple[Array, Array, Array, Array]


def first_holds(
    robot: Robot, geometry: LimbGeometry | Chain, holds: Holds, place: Place, otherwise: Held | None
) -> tuple[Array, Held | None]:
    """Return where the feet stand at the start, (limb, 3) m, and the holds there.

    Arguments:
        place: position (3,) m and rotation (3, 3) of the base, feet (limb, 3) m of the rest stance, gravity (3,) m/s^2.
        otherwise: holds of feet that reach none: these stay where they are.
    """
    base, rotation, feet, gravity = place

    def allowed(position: Array) -> Array:
        return jnp.asarray(_own(position, feet) & within_reach(robot, geometry, (position - base) @ rotation))

    return best(
        lambda position, _: -((position - feet) ** 2).sum(1), allowed, Candidates.of(holds), (feet, otherwise), gravity
    )


def check_first_holds(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse chosen footholds on a ground where a foot of the rest stance reaches no hold.

    Raises:
        ConfigError: in one line, the limb, and how far the nearest hold is.
    """
    if scenario.gait.footholds != "planned" and scenario.ground.holds is not None:
        turned = scenario.value("contact.rotational_stiffness", 0.0) > 0
        if lacking := _lacking(load_robot(scenario.robot), scenario.gait, scenario.ground, turned):
            limb, away, spread = lacking
            expected = "a hold within reach of each foot of the rest stance (ground.holds.at moves all of them)"
            units = f", among points over {spread:.3g} m, as of a file in mm" if spread > _WIDE else ""
            raise ConfigError(
                source, "ground.holds", expected, f"none for {limb}, the nearest {away:.2g} m away{units}"
            )


@functools.lru_cache(maxsize=64)
def _lacking(robot: Robot, gait: Gait, ground: Ground, turned: bool) -> tuple[str, float, float] | None:
    """Return a limb that reaches no hold, how far the nearest is from its foot, m, and over how many m holds spread."""
    holds = holds_of(ground)
    assert holds is not None
    heading = np.array([np.cos(gait.heading / 2), 0.0, 0.0, np.sin(gait.heading / 2)])
    stance = quaternion_to_matrix(robot.stance_orientation)
    turn = np.asarray(quaternion_to_matrix(heading))
    base = turn @ (robot.stance_position * [1, 1, gait.height])
    feet = np.asarray((robot.stance_position + limb_frames(robot, stance, robot.stance_joints).foot) @ turn.T)
    points = np.asarray(holds.position)[np.asarray(holds.valid) > 0]
    away = np.linalg.norm(points[:, None] - feet, axis=2)
    near = points[np.unique(np.argsort(away, axis=0)[:_NEAREST])][:, None] + 0 * feet
    target = (near - base) @ (turn @ np.asarray(stance))
    reached = _own(near, feet) & within_reach(robot, limb_geometry(robot, turned), target)
    lacks = ~np.asarray(reached).any(0)
    limb = int(lacks.argmax())
    found = robot.limbs[limb], float(away[:, limb].min()), float(np.ptp(points, axis=0).max())
    return found if lacks.any() else None


def _own(position: AnyArray, feet: AnyArray) -> AnyArray:
    """Return whether points (..., limb, 3) m are nearer to a limb's own foot (limb, 3) m than to another's."""
    away = ((position[..., None, :] - feet) ** 2).sum(-1)
    return ((position - feet) ** 2).sum(-1) <= away.min(-1)
