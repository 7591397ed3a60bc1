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
    see `mjx_climb.quantities.swing_reaction`. Limbs that lift off together are judged by the sum of their reactions.
    Feet stay above the ground and as high as the cubic in the middle, joints within their limits or those of the cubic.

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
    robot = load_robot(name)
    limbs, unknowns = len(robot.limbs), 3 * COUNT
    lift_off = [gait.lift_off[limb] for limb in robot.limbs]
    together = [np.array([other == one for other in lift_off]) for one in sorted(set(lift_off))]
    lower, upper = robot.joint_lower[..., 0].T, robot.joint_upper[..., 0].T

    def walked(paths: np.ndarray, near: np.ndarray | None = None) -> Reaction:
        return reaction(name, gait, turned, paths, near, _NODES)

    path = np.zeros((limbs, 3, COUNT))
    now = walked(path)
    lower = np.minimum(lower, now.joints.min(0)) - _WITHIN
    upper = np.maximum(upper, now.joints.max(0)) + _WITHIN
    reached = now.missed.max(0) + _WITHIN
    keep = np.array([_WEIGHT * _sum_of_squares(now, path, 0.0, group) for group in together])
    for _ in range(_ROUNDS):
        aside = path + _DIFFERENCE * np.eye(unknowns).reshape(-1, 1, 3, COUNT)
        residuals = _residuals(now)
        slopes = (_residuals(walked(aside, now.joints[:, None])) - residuals[:, None]) / _DIFFERENCE
        step = np.zeros_like(path)
        for group, weight in zip(together, keep, strict=True):
            columns = np.moveaxis(slopes[:, :, group], (2, 1), (-2, -1)).reshape(-1, group.sum() * unknowns)
            held = np.sqrt(weight) * np.eye(columns.shape[1])
            left = np.concatenate([residuals[:, group].sum(1).ravel(), np.sqrt(weight) * path[group].ravel()])
            step[group] = -np.linalg.lstsq(np.concatenate([columns, held]), left, rcond=None)[0].reshape(-1, 3, COUNT)
        tried = path + _TRIED[:, None, None, None] * step
        tries = walked(tried, now.joints[:, None])
        allowed = ((tries.joints >= lower) & (tries.joints <= upper)).all((0, -1)) & (tries.missed.max(0) <= reached)
        allowed &= (heights(_CHECKED, tried) >= 0).all(0)
        gained = 0.0
        for group, weight in zip(together, keep, strict=True):
            before = _sum_of_squares(now, path, weight, group)
            after = _sum_of_squares(tries, tried, weight, group)
            after = np.where(allowed[:, group].all(1), after, np.inf)
            best = int(np.argmin(after))
            if after[best] < before:
                path[group] = tried[best, group]
                gained = max(gained, 1 - after[best] / before)
        now = walked(path, now.joints)
        if gained < _ENOUGH:
            break
    return path


def _residuals(walked: Reaction) -> np.ndarray:
    """Return forces and moments over the length, weighted for the integral of their squares, (S, ..., L, 6)."""
    wrench = np.concatenate([walked.force, walked.moment / walked.length], axis=-1)
    weighted: np.ndarray = wrench * np.sqrt(walked.weight).reshape(-1, *[1] * (wrench.ndim - 1))
    return weighted


def _sum_of_squares(walked: Reaction, path: np.ndarray, weight: float, group: np.ndarray) -> np.ndarray:
    """Return (...) what is made small for limbs that swing together."""
    joint = _residuals(walked)[..., group, :].sum(-2)
    total: np.ndarray = (joint**2).sum((0, -1)) + weight * (path[..., group, :, :] ** 2).sum((-3, -2, -1))
    return total
