"""Adam for the rows of a batch: a row goes back to its best point where it is lost or finds nothing better."""

from typing import Any

import jax
import numpy as np

BACK = 0.5  # share of its steps that a row keeps which goes back


class Adam:
    """Descents of a batch: the best point of each row, and Adam's memory.

    Adam steps as far along an axis that hardly matters as along one that does, and may leave a good valley for a worse
    one. So a row that has found nothing better for a while goes back to its best point, with a fresh memory, and steps
    half as far; as does one whose step went too far. The others do not notice.
    """

    def __init__(
        self, x: np.ndarray, moves: int, memory: tuple[float, float], patience: float, tiny: float, scales: Any = 1.0
    ):
        """Begin at points (B, n).

        Arguments:
            x: the points.
            moves: in how many directions they move.
            memory: of slopes and of their squares, a share per step.
            patience: steps without a better point after which a row goes back.
            tiny: added to the root of the squares.
            scales: (B,) of the steps.
        """
        import optax  # takes 0.1 s to load: few commands step

        self.best, self.least, self.there = x, np.full(len(x), np.inf), np.zeros((len(x), moves))
        adam, self._patience = optax.scale_by_adam(*memory, eps=tiny), patience
        # a memory for each row, as one may begin anew; compiled once
        begin, self._update = (jax.jit(jax.vmap(each)) for each in (adam.init, adam.update))
        self._scale, self._waited = np.broadcast_to(np.asarray(scales, float), len(x)), np.zeros(len(x), int)
        with jax.enable_x64(True):
            self._empty = self._memory = jax.tree.map(np.asarray, begin(self.there))

    def step(
        self, x: np.ndarray, merit: np.ndarray, slopes: np.ndarray, lost: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the points to go on from (B, n) and the steps there (B, moves), by merits, slopes and who is lost."""
        better = ~lost & (merit < self.least)
        self.best, self.there, self.least = choose(better, (x, slopes, merit), (self.best, self.there, self.least))
        waited = np.where(better, 0, self._waited + 1)
        back = lost | (waited >= self._patience)
        self._waited = np.where(back, 0, waited)
        self._scale = np.where(back & np.isfinite(self.least), BACK * self._scale, self._scale)
        self.forget(back)
        x, slopes = choose(back, (self.best, self.there), (x, slopes))
        with jax.enable_x64(True):
            moves, memory = self._update(slopes, self._memory)
        self._memory = jax.tree.map(np.asarray, memory)
        return x, self._scale[:, None] * np.asarray(moves)

    def forget(self, rows: np.ndarray) -> None:
        """Empty the memory of some rows (B,)."""
        self._memory = choose(rows, self._empty, self._memory)


def choose(rows: np.ndarray, yes: Any, no: Any) -> Any:
    """Return the rows of one pytree where `rows` (B,) is true and those of another elsewhere."""
    return jax.tree.map(lambda y, n: np.where(rows.reshape(-1, *[1] * (np.ndim(y) - 1)), y, n), yes, no)
