"""A search round the best point so far, closer every round."""

import numpy as np

from tuning.methods import Method, Request


class ClosingIn(Method):
    """Rounds of `starts` points."""

    def rounds(self, task):
        """Return how many rounds there are."""
        return task.search.iterations or 20

    def run(self, task):
        """Draw points all over the space, then round the best."""
        space, rng = task.problem.space, np.random.default_rng(task.search.seed)
        best, least, theta = task.start, np.inf, space.draw(rng, task.search.starts or 32)
        theta[: len(task.known)] = task.known[: len(theta)]
        for number in range(self.rounds(task)):
            found = yield Request(theta, None, "closing in")
            if found.merit.min() < least:
                best, least = theta[np.argmin(found.merit)], found.merit.min()
            theta = space.clip(best + 0.8**number * rng.standard_normal(theta.shape))
