"""Laws that move the feet, in plain NumPy by docs/explanation/laws.md; `tests.oracle` walks under them."""

import numpy as np
from scipy.spatial.transform import Rotation


def grasp(levers):
    """Return G (6, 3 limb): from forces to the wrench about the point where the levers begin."""
    return np.hstack([np.vstack([np.eye(3), np.cross(lever, np.eye(3)).T]) for lever in levers])


def rigid(levers, displacement, weight):
    """Return the rigid motion (limb, 3) that is nearest to displacements."""
    root, back = np.repeat(np.sqrt(weight), 3), grasp(levers).T
    return (back @ np.linalg.lstsq(root[:, None] * back, root * displacement.ravel())[0]).reshape(-1, 3)


def pseudoinverse(levers, weight):
    """Return W G^T (G W G^T)^-1 (3 limb, 6)."""
    map_, by_force = grasp(levers), np.diag(np.repeat(weight, 3))
    return by_force @ map_.T @ np.linalg.inv(map_ @ by_force @ map_.T)


def parts(wrench, levers, weight):
    """Return the forces of least `sum |F|^2 / weight`, what pushes on the feet add to them, and which are vertical."""
    inverse, up = pseudoinverse(levers, weight), np.eye(3 * len(levers))[2::3]
    by_force = np.diag(np.repeat(weight, 3))
    return inverse @ wrench, (by_force - inverse @ grasp(levers) @ by_force) @ up.T, up


def shared(wrench, levers, weight, pull_limit, softness=0.1, sweeps=12):
    """Return the forces of least `sum |F|^2 / weight`, pulls softly limited: 12 sweeps through the multipliers."""
    free, push, up = parts(wrench, levers, weight)
    change, multiplier = up @ push, np.zeros(len(levers))
    for limb in list(range(len(levers))) * sweeps:
        missing = -pull_limit - up[limb] @ free - change[limb] @ multiplier - softness * multiplier[limb]
        multiplier[limb] = max(multiplier[limb] + missing / (change[limb, limb] + softness), 0)
    return (free + push @ multiplier).reshape(-1, 3)


def of_largest_margin(wrench, levers, weight, bears, cost, sweeps=12):
    """Return the forces of the largest least normal force of feet that bear: 12 sweeps through pairs of feet."""
    free, push, up = parts(wrench, levers, weight)
    share, pairs = bears / max(bears.sum(), 1), [(i, j) for i in range(len(levers)) for j in range(i)]
    for i, j in pairs * sweeps:
        if bears[i] and bears[j]:
            apart = up[i] - up[j]
            slope = apart @ (free + push @ share / cost)
            given = slope * cost / (apart @ (push[:, i] - push[:, j]) + 1e-6)
            given = min(max(given, -share[j]), share[i])
            share[i], share[j] = share[i] - given, share[j] + given
    return (free + push @ share / cost).reshape(-1, 3)


def bounded(rows, largest):
    return rows * np.minimum(1, largest / np.maximum(np.linalg.norm(rows, axis=1), 1e-300))[:, None]


class OfFeet:
    """What laws that move the feet share; `gains` as of the law, by name."""

    gains: dict[str, float]

    def __init__(self, scenario, reference, limbs):
        self.reference, self.period = reference, scenario.hardware.control_period or scenario.time_step
        self.offset = np.zeros((limbs, 3))

    def say(self, position, base, force, wrench, support, known, feet, times):
        """Return where base, its attitude and the feet shall be, and the shift of the base."""
        where, quaternion, *_ = base
        into = self.reference.inv()
        levers, own = into.apply(feet - where), into.apply(force)
        turn = (into * Rotation.from_quat(quaternion, scalar_first=True)).as_quat(canonical=True)
        error = np.concatenate([into.apply(where - position), 2 * turn[:3] * turn[3]])
        self.move(levers, np.where(support[:, None], own, 0), error, support, known, times)
        return position, self.reference, feet + self.reference.apply(self.offset), np.zeros(6)


class LoadTransfer(OfFeet):
    def move(self, levers, force, error, support, known, times):
        gains, h = self.gains, self.period
        before, after = np.ravel(gains["unloading"]), np.ravel(gains["loading"])  # of all limbs, or of each
        ramps = np.minimum(times[0] / before, 1) * np.minimum(times[1] / after, 1)
        weight = support * np.maximum(ramps, 0.02)
        wanted = shared(grasp(levers) @ force.ravel(), levers, weight, gains["pull_limit"])
        whole = rigid(levers, self.offset, support * 1.0)
        damping = np.ones((len(force), 1)) * gains["tangential_damping"] * [1, 1, 0]
        damping = damping + np.ones((len(force), 1)) * gains["normal_damping"] * [0, 0, 1]
        rate = known * (force - wanted) / damping
        rate = rate - gains["leak"] * (self.offset - whole) - gains["leveling"] * whole
        moved = bounded(self.offset + h * bounded(rate, 0.1), 0.02)
        lands = -gains["landing"] * (error[:3] + np.cross(error[3:], levers))
        fades = lands + (self.offset - lands) * np.exp(-h / 0.05)
        self.offset = np.where(support[:, None], moved, fades)


class InternalForce(OfFeet):
    def move(self, levers, force, error, support, known, times):
        stiffness, h = self.gains["stiffness"], self.period
        weight = support * 1.0
        wrench = grasp(levers) @ force.ravel()
        internal = known * (force - (pseudoinverse(levers, weight) @ wrench).reshape(-1, 3))
        kept = np.exp(-h * stiffness / self.gains["damping"])
        moved = bounded(internal / stiffness + kept * (self.offset - internal / stiffness), 0.02)
        self.offset = np.where(support[:, None], moved, self.offset * np.exp(-h / 0.05))


class ClimbSDK(OfFeet):
    steps = 0

    def move(self, levers, force, error, support, known, times):
        gains, h = self.gains, self.period
        change = np.zeros_like(self.offset)
        if self.steps % round(0.05 / h) == 0:
            weight = support * 1.0
            wanted = of_largest_margin(grasp(levers) @ force.ravel(), levers, weight, support, gains["force_cost"])
            pushed = known * (force - wanted)
            change = gains["force_gain"] * (pushed - rigid(levers, pushed, support * 1.0))
            change = change + gains["body_gain"] * (error[:3] + np.cross(error[3:], levers))
        self.steps += 1
        moved = bounded(self.offset + change, 0.02)
        self.offset = np.where(support[:, None], moved, self.offset * np.exp(-h / 0.05))
