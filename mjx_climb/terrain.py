"""The ground under the feet: a height for each foothold, from a list or a height map."""

import math

import numpy as np

from mjx_climb.gait.base_path import raised, sway_of, swayed
from mjx_climb.gait.swing import rest_to_rest
from mjx_climb.ground.height_map import grid_of
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.postures import MET, limb_joints
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import HeightMap, Scenario

# share of the stride: a limb that cannot follow even that does not limit the stride
_LITTLE = 1e-2
_HALVINGS = 7  # of the stride, in search of the longest one


def foothold_heights(scenario: Scenario, robot: Robot) -> np.ndarray:
    """Heights (limb, N) m of every limb's footholds in order, limbs in the robot's; N is 0 on flat ground.

    Raises:
        ConfigError: a height map that cannot be read or does not reach as far as the walk.
    """
    ground, limbs = scenario.ground, robot.limbs
    if ground.footholds is not None:
        given = dict(ground.footholds.items())
        lists = [given.get(limb, (0.0,)) for limb in limbs]
        count = max(map(len, lists))
        return np.array([[*heights, *[heights[-1]] * (count - len(heights))] for heights in lists])
    return np.zeros((len(limbs), 0)) if ground.map is None else _sampled(ground.map, footholds(scenario, robot), limbs)


def footholds(scenario: Scenario, robot: Robot) -> np.ndarray:
    """Planned footholds of each limb, (limb, N, 2) m, in the world, the first ones included."""
    gait = scenario.gait
    stance = (robot.stance_position + _stance_feet(robot))[:, None, :2]
    planned = stance + np.arange(_foothold_count(scenario))[:, None] * np.array([gait.stride, 0.0])
    c, s = np.cos(gait.heading), np.sin(gait.heading)
    return np.asarray(planned @ np.array([[c, s], [-s, c]]))


def _foothold_count(scenario: Scenario) -> int:
    """Return how many footholds a limb uses in a walk, at most, the first one included."""
    # a walk of whole cycles has no further foothold by rounding
    cycle: float = scenario.gait.cycle
    return math.ceil(scenario.duration / cycle - 1e-9) + 1


def check_reach(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a stride, or uneven ground, that a limb cannot reach from where the gait plans the base.

    Raises:
        ConfigError: in one line, the longest stride, or the first foothold out of reach.
    """
    robot = load_robot(scenario.robot)
    _check_stride(scenario, robot, source)
    heights = foothold_heights(scenario, robot)[:, : _foothold_count(scenario)]
    for n in np.sort(np.unique(heights, axis=1, return_index=True)[1]) if heights.size else ():
        height, feet = heights[:, n], _stance_feet(robot) - raised(robot, scenario.gait)
        feet[:, 2] += (above := height - height.mean())
        missed = limb_joints(robot, feet).errors
        if missed.max() > MET:
            name = robot.limbs[limb := int(np.argmax(np.where(missed > MET, np.abs(above), -1)))]
            key = f"ground.footholds.{name}.{n}" if scenario.ground.footholds is not None else "ground.map"
            where = f"at {height[limb]:g} m, {above[limb]:+.3g} m from the mean"
            got = f"one of {name} {where}, missed by {missed[limb] * 1e3:.2g} mm"
            raise ConfigError(source, key, "footholds within reach and joint limits", got)


def _check_stride(scenario: Scenario, robot: Robot, source: str) -> None:
    """Refuse a stride after which a foot cannot lift off or touch down where it should, on level ground.

    Limbs that cannot give way to the base at all, those of fewer than three joints that are driven, do not count.
    """
    gait = scenario.gait
    lift_off = np.array([gait.lift_off[limb] for limb in robot.limbs])
    feet = _stance_feet(robot) - raised(robot, gait)
    sway = sway_of(feet, lift_off, gait.duty, gait.sway)
    swung = [np.array([swayed(sway, at) for at in moments]) for moments in (lift_off, lift_off + 1 - gait.duty)]
    extremes = -rest_to_rest(lift_off), 1 - rest_to_rest(lift_off + 1 - gait.duty)  # strides from foot to base, ahead

    def missed(stride: float) -> np.ndarray:
        each = zip(extremes, swung, strict=True)
        planned = [feet - base + stride * np.outer(along, [1, 0, 0]) for along, base in each]
        errors = [limb_joints(robot, each, robot.stance_joints).errors for each in planned]
        return np.asarray(np.array(errors).max(0) > MET)

    low, high = 0.0, min(gait.stride, 10 * float(np.abs(feet).max()))  # no limb is as long as that
    far = missed(high)
    if not far.any() or not (far & (free := ~missed(_LITTLE * high))).any():
        return
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if (missed(middle) & free).any() else (middle, high)
    digit = 10.0 ** (math.floor(math.log10(low)) - 1) if low else 1.0
    most = f"at most {math.floor(low / digit) * digit:.2g} m"
    expected = f"{most}, which keeps all feet within reach and joint limits"
    raise ConfigError(source, "gait.stride", expected, f"{gait.stride:g}")


def _stance_feet(robot: Robot) -> np.ndarray:
    """Return the feet (limb, 3) m of the rest stance, heading along x, from the base's centre of mass."""
    rotation = quaternion_to_matrix(robot.stance_orientation)
    return np.asarray(limb_frames(robot, rotation, robot.stance_joints).foot)


def _sampled(ground: HeightMap, points: np.ndarray, limbs: tuple[str, ...]) -> np.ndarray:
    """Return the map's heights (limb, N) m at points (limb, N, 2), linear between its samples."""
    grid = grid_of(ground.file)
    column, row = np.moveaxis((points - np.array(ground.origin)) / ground.resolution, -1, 0)
    rows, columns = grid.shape
    inside = (column >= -1e-9) & (column <= columns - 1 + 1e-9) & (row >= -1e-9) & (row <= rows - 1 + 1e-9)
    if not inside.all():
        limb, n = np.argwhere(~inside)[0]
        x, y = points[limb, n]
        far = np.array(ground.origin) + ground.resolution * np.array([columns - 1, rows - 1])
        expected = f"a map that covers foothold {n} of {limbs[limb]} at x {x:.4g}, y {y:.4g} m"
        got = f"x {ground.origin[0]:g} to {far[0]:g}, y {ground.origin[1]:g} to {far[1]:g} m"
        raise ConfigError(ground.file, "ground.map", expected, got)
    i, j = (np.clip(np.floor(v).astype(int), 0, n - 2) for v, n in ((row, rows), (column, columns)))
    u, v = row - i, column - j
    low = (1 - v) * grid[i, j] + v * grid[i, j + 1]
    high = (1 - v) * grid[i + 1, j] + v * grid[i + 1, j + 1]
    return np.asarray(ground.scale * ((1 - u) * low + u * high))
