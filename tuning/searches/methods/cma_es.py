"""CMA-ES, by the package `cmaes`: a population drawn from a Gaussian that learns the shape of the valley."""

import math

import numpy as np

from tuning.searches.methods.task import Points, Request, Task

GENERATIONS = 60
SPREAD = 0.2  # of the first population, relative to the width of the box


def rounds(task: Task) -> int:
    """Return how many generations a run takes at most."""
    return task.search.iterations or GENERATIONS


def run(task: Task) -> Points:
    """Draw populations, the first round the scenario's own gains, until they agree or the generations are spent."""
    from cmaes import CMA

    space = task.problem.space
    if space.size == 1:
        raise ValueError("cmaes: expected two gains or more to search")
    width = space.upper - space.lower
    size = task.search.starts or 4 + math.floor(3 * math.log(space.size))
    optimizer = CMA(
        mean=(task.start - space.lower) / width,
        sigma=SPREAD,
        bounds=np.tile([0.0, 1.0], (space.size, 1)),
        seed=task.search.seed,
        population_size=size,
    )
    for _ in range(rounds(task)):
        unit = [optimizer.ask() for _ in range(size)]
        found = yield Request(space.lower + width * np.array(unit), None, "population")
        optimizer.tell(list(zip(unit, found.merit.astype(float).tolist(), strict=True)))
        if optimizer.should_stop():
            return
