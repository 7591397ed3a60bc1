"""The choice of footholds written a second time, with loops in NumPy, and margins by linear programs.

ClimbLab's rule follows its description: Uno et al., "Non-periodic gait planning based on salient region detection for a
planetary cave exploration robot", i-SAIRAS 2020; Uno et al., "Gait planning for a free-climbing robot based on tumble
stability", IEEE/SICE SII 2019.
"""

import numpy as np
from scipy.optimize import linprog

NONE = -1  # no point may be chosen


def _best(position, allowed, worth):
    """Return for each limb the first of the points that are worth most, NONE where none is worth anything."""
    chosen = np.full(len(allowed), NONE)
    for limb, may in enumerate(allowed):
        most = -np.inf
        for number, point in enumerate(position):
            value = worth(limb, point, number) if may[number] else -np.inf
            if value > most:
                most, chosen[limb] = value, number
    return chosen


def nearest(position, allowed, planned):
    """Return the point (limb,) of least distance from each planned foothold."""
    return _best(position, allowed, lambda limb, point, _: -np.linalg.norm(point - planned[limb]))


def farthest(position, allowed, feet, forward):
    """Return the point (limb,) farthest ahead of each foot."""
    return _best(position, allowed, lambda limb, point, _: (point - feet[limb]) @ forward)


def climblab(position, allowed, feet, forward, stride_cap):
    """Return the point (limb,) of the largest step towards the goal, seen from above, under a cap."""

    def worth(limb, point, _):
        step = point - feet[limb]
        return step @ forward if np.hypot(step[0], step[1]) <= stride_cap else -np.inf

    return _best(position, allowed, worth)


def climblab_limb(position, allowed, feet, forward, ahead=0.2):
    """Return the limb with most points before it, none of them farther away than `ahead`; the first of several."""
    counts = []
    for foot, may in zip(feet, allowed, strict=True):
        steps = [point - foot for point, one in zip(position, may, strict=True) if one]
        counts.append(sum(step @ forward > 0 and np.linalg.norm(step) <= ahead for step in steps))
    return counts.index(max(counts))


def diagonals(feet):
    """Return where the lines between opposite feet meet, (3,), in the least squares where several do not."""
    limbs, half = len(feet), len(feet) // 2
    rows, sides = [], []
    for one, other in zip(feet[:half], feet[half:], strict=False):
        along = (other - one)[:2]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        rows.append(across)
        sides.append(across @ one[:2])
    meet = feet.mean(0)
    if limbs % 2 == 0 and np.linalg.matrix_rank(rows, tol=1e-6) == 2:
        meet[:2] = np.linalg.lstsq(np.array(rows), np.array(sides), rcond=None)[0]
    return meet


def tumbling_margin(feet, com, weight, pull):
    """Return the smallest moment () N m that keeps a robot at rest on all its feet from tumbling, 0 once it does.

    About each line from a foot to the next one it is that of the weight and of the one grip off the line that holds
    best; grips pull the feet towards the ground, against `pull` (limb, 3) N.
    """
    smallest = np.inf
    for number, foot in enumerate(feet):
        after = feet[(number + 1) % len(feet)]
        outwards = (foot - after) / np.linalg.norm(foot - after)
        held = [outwards @ np.cross(other - foot, -force) for other, force in zip(feet, pull, strict=True)]
        smallest = min(smallest, outwards @ np.cross(com - foot, weight) + max(0.0, *held))
    return max(0.0, smallest)


def best_margin(
    position, normals, pulls, allowed, feet, planned, stands, com, weight, standing_pull, distance_weight=1.0
):
    """Return the point (limb,) of the largest margin, over weight and pull, less the distance from the planned one.

    Limbs that do not stand are all on the point, where their grips bear its pull along its normal; the others bear
    `standing_pull` (limb, 3) N, of which the largest scales the margin.
    """
    scale, moments = np.linalg.norm(weight) + max(np.linalg.norm(each) for each in standing_pull), []
    for point, normal, pull in zip(position, normals, pulls, strict=True):
        placed, holding = np.array(feet), np.array(standing_pull)
        placed[~stands], holding[~stands] = point, pull * normal
        moments.append(tumbling_margin(placed, com, weight, holding))

    def worth(limb, point, number):
        return moments[number] / scale - distance_weight * np.linalg.norm(point - planned[limb])

    return _best(position, allowed, worth)


def resting_forces(feet, com, weight):
    """Return the forces of the ground on feet (n, 3) N that bear a weight at rest, of the least sum of squares."""
    balance = np.zeros((6, 3 * len(feet)))
    for number, (x, y, z) in enumerate(feet - com):
        balance[:, 3 * number : 3 * number + 3] = [
            [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -z, y], [z, 0, -x], [-y, x, 0],
        ]  # fmt: skip
    return np.linalg.lstsq(balance, -np.append(weight, np.zeros(3)), rcond=None)[0].reshape(-1, 3)


def springs_of_a_base(feet, force, points):
    """Return the forces (m, 3) N of springs at points (m, 3) m of a base whose feet on equal springs bear (n, 3) N.

    The springs' ends move with the base: its rigid motion is fitted to the forces.
    """
    rows, sides = [], []
    for (x, y, z), own in zip(feet, force, strict=True):
        # t + theta x r
        rows += [[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]]
        sides += list(own)
    motion = np.linalg.lstsq(np.array(rows, float), np.array(sides), rcond=None)[0]
    return motion[:3] + np.cross(motion[3:], points)


def least_use(position, normals, pulls, allowed, feet, planned, stands, com, weight, distance_weight=1.4):
    """Return the number of the point that each limb takes, (limb,): by use of the grip and distance from the plan.

    The pull is that of a spring at the point on a base which hangs on the standing feet, at least three.
    """
    uses = np.zeros(len(position))
    if stands.sum() >= 3:
        force = springs_of_a_base(feet[stands], resting_forces(feet[stands], com, weight), position)
        for number, (own, normal, pull) in enumerate(zip(force, normals, pulls, strict=True)):
            uses[number] = max(0.0, -own @ normal) / pull if pull > 0 else 0.0

    def worth(limb, point, number):
        return -uses[number] - distance_weight * np.linalg.norm(point - planned[limb])

    return _best(position, allowed, worth)


# --- linear programs


def frame(normal, gravity):
    """Return a hold's axes as columns (3, 3): uphill in the surface, across, along the normal."""
    for start in (-np.asarray(gravity, float), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])):
        uphill = start - (start @ normal) * normal
        if np.linalg.norm(uphill) > 1e-9 * max(np.linalg.norm(start), 1e-30):
            uphill = uphill / np.linalg.norm(uphill)
            return np.column_stack([uphill, np.cross(normal, uphill), normal])
    raise ValueError("expected a normal of length one")


def largest_pull(matrix, bound):
    """Return the largest pull along the normal alone that a polyhedron holds, infinite where none is too large."""
    found = linprog([-1.0], A_ub=-np.asarray(matrix)[:, 2:], b_ub=bound, bounds=[(0, None)])
    return np.inf if found.status == 3 else found.x[0]


def largest_share(position, axes, matrix, bound, wrench, about):
    """Return how much of a wrench (6,), N and N m about a point, feet can bear at once; negative: not even nothing.

    Feet (n, 3) bear forces on the ground's polyhedra `matrix f <= bound` (n, m, 3), (n, m), in `axes` (n, 3, 3), which
    as columns are those of the holds; the forces sum to minus the share of the wrench.
    """
    count, rows = bound.shape
    wrench, balance = np.asarray(wrench, float), np.zeros((6, 3 * count + 1))
    limits = np.zeros((count * rows, 3 * count + 1))
    for foot in range(count):
        part = slice(3 * foot, 3 * foot + 3)
        x, y, z = position[foot] - about
        balance[:3, part] = np.eye(3)
        balance[3:, part] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        limits[foot * rows : (foot + 1) * rows, part] = matrix[foot] @ axes[foot].T
    balance[:, -1] = wrench
    objective = np.append(np.zeros(3 * count), -1.0)
    found = linprog(
        objective, A_ub=limits, b_ub=bound.ravel(), A_eq=balance, b_eq=np.zeros(6),
        bounds=[(None, None)] * (3 * count) + [(0, None)],
    )  # fmt: skip
    return {2: -1.0, 3: np.inf}.get(found.status, found.x[-1] if found.x is not None else np.nan)
