"""Where the gait has the base over its feet: how high, and how far it sways towards those that stand.

The sway passes through a point for each group of limbs that swing together, in the middle of their swing: a share of
the way from the base to the centroid of the other feet, those of the rest stance. Between these points it is cubic,
at rest in each. It is written with operators alone, so that arrays of JAX and of NumPy do.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.arrays import AnyArray, namespace
from mjx_climb.gait.swing import lift, rest_to_rest
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import MET, limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Gait, Scenario

_HALVINGS = 10
_SLACK = 1e-6  # of a cycle


class Sway(NamedTuple):
    """Points through which the base sways; none where it does not."""

    points: AnyArray  # (K, 3) m, from where the base would be, in the order of the lift-offs
    first: AnyArray  # () cycles, when it passes through the first one
    spans: tuple[float, ...]  # (K,) cycles, from each point to the next, the last to the first


def sway_of(
    feet: AnyArray, lift_off: Sequence[float] | np.ndarray, duty: float | AnyArray, share: float | AnyArray
) -> Sway:
    """Return the sway of a base whose feet stand at `feet` (limb, 3) m from it, in axes whose z is up.

    `lift_off` are the shares of the cycle at which the limbs lift off, `share` is that of the way to the centroid.
    """
    xp, level = namespace(feet), np.array([1.0, 1.0, 0.0])
    times, swing = np.unique(lift_off), 1 - duty
    points = []
    for time in times:
        since = xp.mod(time + swing / 2 - np.asarray(lift_off) + _SLACK, 1.0)
        stands = xp.where(since < swing, 0.0, 1.0)
        points.append(share * level * (stands[:, None] * feet).sum(0) / stands.sum())
    spans = np.diff([*times, times[0] + 1])
    return Sway(xp.stack(points), times[0] + swing / 2, tuple(spans.tolist()))


def swayed(sway: Sway, phase: float | AnyArray) -> AnyArray:
    """Return how far the base has swayed at a phase () of its cycle, (3,) m."""
    xp = namespace(sway.points)
    at, begin, found = xp.mod(phase - sway.first, 1.0), 0.0, sway.points[0]
    for number, span in enumerate(sway.spans):
        way = sway.points[(number + 1) % len(sway.spans)] - sway.points[number]
        found = found + way * rest_to_rest(xp.clip((at - begin) / span, 0.0, 1.0))
        begin += span
    return found


def raised(robot: Robot, gait: Gait) -> np.ndarray:
    """Offset of the base by the gait from the rest stance, (3,) m, without its sway."""
    lift: float = gait.height - 1
    return lift * robot.stance_position * [0, 0, 1]


def planned_feet(robot: Robot, gait: Gait, phases: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the gait has the feet of a robot from its base on level ground, but for shapes added to a swing.

    Returns:
        feet (P, limb, 3) m at phases (P,) of the cycle, in axes that are the world's at heading zero, and the shares of
        their swings that are over, (P, limb), below 0 before a swing and above 1 after it.
    """
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    rotation = quaternion_to_matrix(robot.stance_orientation)
    feet = np.asarray(limb_frames(robot, rotation, robot.stance_joints).foot)
    sway = sway_of(feet, lift_off, gait.duty, gait.sway)
    swing = (phases[:, None] - lift_off) / (1 - gait.duty)
    moved = np.clip(swing / (1 - gait.settling), 0.0, 1.0)
    ahead = gait.stride * (rest_to_rest(moved) - rest_to_rest(phases)[:, None])
    above = gait.step_height * lift(moved)
    base = raised(robot, gait) + [swayed(sway, phase) for phase in phases]
    return feet + np.stack([ahead, 0 * ahead, above], -1) - base[:, None], swing


def check_base(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a height or a sway of the base with which a foot does not reach its foothold.

    Raises:
        ConfigError: in one line, the key, and how far it could go.
    """
    gait, robot = scenario.gait, load_robot(scenario.robot)
    for key in ("height", "sway"):
        none = {"height": 1.0, "sway": 0.0}[key]
        own = gait if key == "sway" else gait.model_copy(update={"sway": 0.0})
        if (value := getattr(gait, key)) != none and _missed(robot, own):
            low, high = none, value
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                missed = _missed(robot, own.model_copy(update={key: middle}))
                low, high = (low, middle) if missed else (middle, high)
            limit = f"at {'most' if value > none else 'least'} {low:.3g}"
            expected = f"{limit}, with which all feet are within reach and joint limits"
            raise ConfigError(source, f"gait.{key}", expected, f"{value:g}")


@functools.lru_cache(maxsize=256)
def _missed(robot: Robot, gait: Gait) -> bool:
    """Return whether a foot cannot stand where it does in the rest stance from one of the places of the base."""
    rotation = quaternion_to_matrix(robot.stance_orientation)
    feet = np.asarray(limb_frames(robot, rotation, robot.stance_joints).foot)
    places = sway_of(feet, [gait.lift_off[limb] for limb in robot.limbs], gait.duty, gait.sway).points
    places = np.vstack([np.zeros(3), places]) + raised(robot, gait)
    return any(limb_joints(robot, (feet - at) @ rotation, robot.stance_joints).errors.max() > MET for at in places)
