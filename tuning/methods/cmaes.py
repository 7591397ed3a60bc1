"""CMA-ES, by the package `cmaes`: a population drawn from a Gaussian that learns the shape of the valley."""

import math
from typing import TYPE_CHECKING

import numpy as np

from mjx_climb import execution
from mjx_climb.scenario.messages import ConfigError
from tuning.methods.method import Method, Points, Request, Task
from tuning.problem.search import Search
from tuning.problem.spaces import Space

if TYPE_CHECKING:
    from cmaes import CMA

GENERATIONS = 60
MANY, OF_MANY = 150, 64  # generations at most, and points per gain, where a GPU's kernel walks them
WALKS = 32_768  # at a time there, of all members of an ensemble
FLAT, PATIENCE = 1e-4, 10  # the last of so many generations whose best differ by less is the last of all there
TRIES = 100  # to draw a point between the bounds, before it is taken to the nearest one that is
SPREAD = 0.2  # of the first population, relative to the width of the box


class CMAES(Method):
    """CMA-ES with a population of `starts`, or as many as the package takes, and on a GPU as many as it walks."""

    most = 100  # numbers: so few generations learn no covariance of more

    def check(self, space: Space, search: Search) -> None:
        super().check(space, search)
        if search.starts == 1:  # which cannot be compared
            raise ConfigError("", "starts", "a population of 2 or more for cmaes", "1")

    def rounds(self, task: Task) -> int:
        return task.search.iterations or (MANY if execution.many_at_once(task.problem.dtype) else GENERATIONS)

    def run(self, task: Task) -> Points:
        """Draw populations about the best of the first points until they agree or the rounds are spent.

        The first points are those that are known, the scenario's own gains before all, and others about these.
        """
        from cmaes import CMA

        space, by_kernel = task.problem.space, execution.many_at_once(task.problem.dtype)
        width, box, size = space.upper - space.lower, np.tile([0.0, 1.0], (space.size, 1)), population(task)

        rng = np.random.default_rng(task.search.seed)
        first = np.clip((task.start - space.lower) / width + SPREAD * rng.standard_normal((size, space.size)), 0, 1)
        first[: len(task.known)] = ((task.known - space.lower) / width)[:size]
        found = yield Request(space.lower + width * first, None, "first points")
        # after the known gains, which may be far away: a population would take them for the shape of the valley
        mean = first[np.argmin(found.merit)]
        with np.errstate(divide="ignore"):  # 2 or 3 points move the covariance by their path alone: a rate is 0
            optimizer = CMA(mean=mean, sigma=SPREAD, bounds=box, seed=task.search.seed, population_size=size)
        best: list[float] = []
        for _ in range(1, self.rounds(task)):
            unit = drawn(optimizer)
            found = yield Request(space.lower + width * unit, None, "population")
            tell(optimizer, unit, found.merit.astype(float))
            best = [*best, float(found.merit.min())][-PATIENCE:]
            flat = by_kernel and len(best) == PATIENCE and max(best) - min(best) < FLAT
            if optimizer.should_stop() or flat:
                return


def population(task: Task) -> int:
    """Return how many points a generation has: the package's own number, many where they walk side by side on a GPU."""
    size = task.problem.space.size
    few = 4 + math.floor(3 * math.log(size))
    if task.search.starts or not execution.many_at_once(task.problem.dtype):
        return task.search.starts or few
    return max(few, min(OF_MANY * size, WALKS // task.problem.members))


def drawn(optimizer: "CMA") -> np.ndarray:
    """Return a generation (B, n) of an optimizer between 0 and 1: the points that its `ask` would give one by one.

    Asked for one by one, hundreds of them take longer than their walks on a GPU. So this reaches into the package,
    whose versions are bounded for it.
    """
    basis, lengths = optimizer._eigen_decomposition()
    spread = optimizer._sigma * basis * lengths
    inside = outside = np.zeros((0, optimizer.dim))
    for _ in range(TRIES):
        missing = optimizer.population_size - len(inside)
        points = optimizer.mean + optimizer._rng.randn(missing, optimizer.dim) @ spread.T
        good = ((points >= 0) & (points <= 1)).all(1)
        inside, outside = np.concatenate([inside, points[good]]), points[~good]
        if not len(outside):
            return inside
    return np.concatenate([inside, np.clip(outside, 0, 1)])


def tell(own: "CMA", points: np.ndarray, merits: np.ndarray) -> None:
    """Tell an optimizer the merits (B,) of its generation (B, n), as its own `tell` does, which looks at each point.

    Equations are those of Hansen's tutorial (arXiv:1604.00772). This reaches into the package as `drawn` does.
    """
    order, size = np.argsort(merits, kind="stable"), own.dim
    own._g += 1
    place = 2 * (own.generation % own._funhist_term)
    own._funhist_values[place : place + 2] = merits[order[[0, -1]]]
    basis, lengths = own._eigen_decomposition()
    own._B = own._D = None
    whiten = basis / lengths @ basis.T  # C^(-1/2)
    steps = (points[order] - own._mean) / own._sigma
    mean = own._weights[: own._mu] @ steps[: own._mu]  # Eq. 41
    own._mean += own._cm * own._sigma * mean  # Eq. 42
    rate, along = own._c_sigma, own._cc
    own._p_sigma = (1 - rate) * own._p_sigma + math.sqrt(rate * (2 - rate) * own._mu_eff) * whiten @ mean  # Eq. 43
    length = float(np.linalg.norm(own._p_sigma))
    own._sigma *= math.exp(rate / own._d_sigma * (length / own._chi_n - 1))  # Eq. 44
    usual = math.sqrt(1 - (1 - rate) ** (2 * (own._g + 1))) * (1.4 + 2 / (size + 1)) * own._chi_n
    moves = float(length < usual)
    own._pc = (1 - along) * own._pc + moves * math.sqrt(along * (2 - along) * own._mu_eff) * mean  # Eq. 45
    squares = ((steps @ whiten) ** 2).sum(1) + 1e-8
    weights = np.where(own._weights >= 0, own._weights, own._weights * size / squares)  # Eq. 46
    kept = 1 + own._c1 * (1 - moves) * along * (2 - along) - own._c1 - own._cmu * own._weights.sum()
    own._C = kept * own._C + own._c1 * np.outer(own._pc, own._pc) + own._cmu * (weights * steps.T) @ steps  # Eq. 47


METHOD = CMAES()
