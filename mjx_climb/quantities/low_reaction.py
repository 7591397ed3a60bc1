"""The swing that disturbs the base least: what to add to each limb's cubic swing, found before anything is compiled.

The idea of a low-reaction swing is that of RAMP (Ribeiro et al., ICRA 2023); the measure and the search are our own.
"""

import functools

import numpy as np

from mjx_climb.quantities.swing import COUNT
from mjx_climb.quantities.swing_reaction import Reaction, heights, reaction
from mjx_climb.robot.constants import load_robot
from mjx_climb.scenario.model import Gait, RobotFile, Scenario

_NODES = 12  # in each half of a swing: the sums to four digits
_ROUNDS = 8
_ENOUGH = 1e-3  # by which a round lowers the sum of squares, relative
_TRIED = 0.5 ** np.arange(8)  # shares of a Gauss-Newton step
_DIFFERENCE = 1e-4  # step heights
_WEIGHT = 1e-3  # of the coefficients, beside the reaction of the cubic swing: keeps what hardly matters small
_WITHIN = 1e-9  # rad, or m
_CHECKED = np.linspace(0.0, 1.0, 201)


def swing_path(scenario: Scenario) -> np.ndarray:
    """Return what a scenario's `gait.swing` adds to the cubic swings, (L, 3, K), in step heights; K is 0 for `cubic`.

    Axes: ahead, left, up; shapes as `mjx_climb.quantities.swing.added_shapes`. For `low_reaction` the integral of the
    squared reaction on the base is as small as these shapes make it (a local minimum, from the cubic), on flat ground:
    see `mjx_climb.quantities.swing_reaction`. Limbs that lift off together count by the sum of their reactions.
    Feet stay above the ground and as high as the cubic in the middle, joints within their limits or those of the cubic.
    A limb that cannot follow its cubic keeps it, as do those that lift off with it.

    It is worked out for the scenario's own stride, step height and timing. In `Parameters` it is one value for all
    robots of a batch, in step heights: other step heights scale it, headings turn it, and it is zero at both ends, so
    that other strides, cycles and grounds get a sound swing, if not their best. For these give the parameters a batch
    of `swing_path`, one from each scenario.
    """
    limbs = len(scenario.gait.lift_off)
    if scenario.gait.swing == "cubic":
        return np.zeros((limbs, 3, 0))
    return _least(scenario.robot, scenario.gait, scenario.contact.rotational_stiffness > 0).copy()


@functools.lru_cache(maxsize=64)
def _least(name: str | RobotFile, gait: Gait, turned: bool) -> np.ndarray:
    """Return the paths (limb, 3, K) by Gauss-Newton, one for each group of limbs that lift off together."""
    robot = load_robot(name)
    limbs, unknowns = len(robot.limbs), 3 * COUNT
    lift_off = [gait.lift_off[limb] for limb in robot.limbs]
    groups = [np.array([other == one for other in lift_off]) for one in sorted(set(lift_off))]

    def swung(paths: np.ndarray, near: np.ndarray | None = None) -> Reaction:
        return reaction(name, gait, turned, paths, near, _NODES)

    path = np.zeros((limbs, 3, COUNT))
    now = swung(path)
    lower = np.minimum(robot.joint_lower, now.joints.min(0)) - _WITHIN
    upper = np.maximum(robot.joint_upper, now.joints.max(0)) + _WITHIN
    weights = [_WEIGHT * _sum_of_squares(now, path, 0.0, group) for group in groups]
    for _ in range(_ROUNDS):
        aside = path + _DIFFERENCE * np.eye(unknowns).reshape(-1, 1, 3, COUNT)
        around = swung(aside, now.joints[:, None])
        jacobian = (around.residuals - now.residuals[:, None]) / _DIFFERENCE
        step = np.zeros_like(path)
        for group, weight in zip(groups, weights, strict=True):
            columns = np.moveaxis(jacobian[:, :, group], (2, 1), (-2, -1)).reshape(-1, group.sum() * unknowns)
            held = np.sqrt(weight) * np.eye(columns.shape[1])
            left = np.concatenate([now.residuals[:, group].sum(1).ravel(), np.sqrt(weight) * path[group].ravel()])
            step[group] = -np.linalg.lstsq(np.concatenate([columns, held]), left, rcond=None)[0].reshape(-1, 3, COUNT)
        tried = path + _TRIED[:, None, None, None] * step
        tries = swung(tried, now.joints[:, None])
        allowed = ((tries.joints >= lower) & (tries.joints <= upper)).all((0, -1)) & (tries.missed.max(0) <= _WITHIN)
        allowed &= (heights(_CHECKED, tried) >= 0).all(0)
        gained = 0.0
        for group, weight in zip(groups, weights, strict=True):
            before = _sum_of_squares(now, path, weight, group)
            after = _sum_of_squares(tries, tried, weight, group)
            after = np.where(allowed[:, group].all(1), after, np.inf)
            best = int(np.argmin(after))
            if after[best] < before:
                path[group] = tried[best, group]
                gained = max(gained, 1 - after[best] / before)
        now = swung(path, now.joints)
        if gained < _ENOUGH:
            break
    return path


def _sum_of_squares(swung: Reaction, path: np.ndarray, weight: np.ndarray | float, group: np.ndarray) -> np.ndarray:
    """Return (...) what is made small for limbs that swing together."""
    together = swung.residuals[..., group, :].sum(-2)
    total: np.ndarray = (together**2).sum((0, -1)) + weight * (path[..., group, :, :] ** 2).sum((-3, -2, -1))
    return total
