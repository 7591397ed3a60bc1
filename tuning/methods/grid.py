"""A logarithmic grid, then finer ones round its best cells."""

import itertools
import math

import numpy as np

from tuning.methods.method import Method, Points, Request, Task

POINTS = {1: 64, 2: 24, 3: 10, 4: 6}  # per coordinate, by the number of coordinates
CELLS = 3  # best ones, each refined
FINE = {1: 9, 2: 5, 3: 3, 4: 3}  # points per coordinate over the two cells beside a best one
REFINEMENTS = 2
BATCH = 256


class Grid(Method):
    """A grid of `starts` points per coordinate, refined `iterations` - 1 times round its best points."""

    most = 4  # a grid of more coordinates is no search

    def rounds(self, task: Task) -> int:
        n, (points, refinements, batch) = task.problem.space.size, _plan(task)
        refined = refinements * math.ceil(CELLS * FINE[n] ** n / batch)
        return int(math.ceil((points**n + len(task.known)) / batch) + refined)

    def run(self, task: Task) -> Points:
        """Evaluate the known gains, the scenario's own before all, and the grid; refine round the best of all these."""
        space, (count, refinements, batch) = task.problem.space, _plan(task)
        axes = [np.linspace(*ends, count) for ends in zip(space.lower, space.upper, strict=True)]
        cell = np.array([axis[1] - axis[0] if axis.size > 1 else 0.0 for axis in axes])
        points = np.array([*task.known, *itertools.product(*axes)])
        evaluated, merits = [], []
        for level in range(1 + refinements):
            phase = "grid" if level == 0 else "refined grid"
            for begin in range(0, len(points), batch):
                # the last batch is filled up with its last point, so that one program walks them all
                rows = np.minimum(np.arange(begin, begin + batch), len(points) - 1)
                found = yield Request(points[rows], None, phase)
                evaluated.append(points[rows])
                merits.append(np.where(found.feasible, found.value, 1e3 + found.merit))
            every, merit = np.concatenate(evaluated), np.concatenate(merits)
            every, first = np.unique(every, axis=0, return_index=True)
            best = every[np.argsort(merit[first], kind="stable")[:CELLS]]
            offsets = np.array(list(itertools.product(np.linspace(-1, 1, FINE[space.size]), repeat=space.size)))
            points = space.clip((best[:, None] + offsets * cell).reshape(-1, space.size))
            cell = cell * 2 / (FINE[space.size] - 1)


def _plan(task: Task) -> tuple[int, int, int]:
    """Return how many points a coordinate has, how often the grid is refined, and how many points a batch has."""
    n, again = task.problem.space.size, task.search.iterations
    points = task.search.starts or POINTS[n]
    dense = points**n + len(task.known)
    return points, REFINEMENTS if again is None else again - 1, math.ceil(dense / math.ceil(dense / BATCH))


METHOD = Grid()
