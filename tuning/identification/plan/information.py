"""Forecast of a log: Fisher information, expected standard deviations, and directions that it does not tell.

Parameters are counted in units of their own scale, so that a standard deviation is relative to the value. Each has a
prior of 100 %: it changes nothing that a log tells well, and gives an answer where it tells nothing.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

SEEN = 0.5  # relative standard deviation beyond which a 95 % interval is wider than the value itself
_PART = 0.3  # of the largest effect in a direction: parameters with less of it are not named
_MANY = 8  # names in a list


@dataclasses.dataclass(frozen=True)
class Information:
    """The Fisher information `R^T R` of one log, prior included, about parameters in units of their scales."""

    names: tuple[str, ...]
    root: Float[np.ndarray, "parameter parameter"]  # R: its square would lose half of the digits

    @property
    def matrix(self) -> np.ndarray:
        """The information of the log alone (parameter, parameter)."""
        return np.asarray(self.root.T @ self.root - np.eye(len(self.names)))

    @property
    def deviations(self) -> np.ndarray:
        """Expected standard deviations (parameter,), relative; 1, the prior's, where the log says nothing."""
        return np.asarray(np.linalg.norm(np.linalg.inv(self.root), axis=1))

    @property
    def score(self) -> float:
        """Logarithm of the determinant."""
        return 2 * float(np.linalg.slogdet(self.root)[1])

    @property
    def silent(self) -> list[str]:
        """Parameters that the log says next to nothing of, were all others known."""
        known = np.linalg.norm(self.root, axis=0)
        return [name for name, value in zip(self.names, known, strict=True) if value < 1 / SEEN]

    def weak(self) -> list[tuple[float, dict[str, float]]]:
        """Return directions that the log does not tell: their relative standard deviation, and their variables.

        Along a direction its parameters, none of them silent, change together, each by its share of its own value.
        """
        kept = [n for n, name in enumerate(self.names) if name not in self.silent]
        if not kept:
            return []
        _, values, vectors = np.linalg.svd(self.root[:, kept])
        alone = np.linalg.norm(self.root[:, kept], axis=0)  # information about each, were the others known
        found = []
        for value, vector in zip(values, vectors, strict=True):
            if value < 1 / SEEN:
                effect = np.abs(vector) * alone
                vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
                named = np.flatnonzero(effect > _PART * effect.max())
                found.append((float(1 / value), {self.names[kept[n]]: float(vector[n]) for n in named}))
        return found

    def unseen(self) -> str:
        """In one sentence the parameters that the log will not tell apart."""
        said = [f"it will not tell apart {_listed(list(parts))} ({_combination(parts)})" for _, parts in self.weak()]
        if self.silent:
            said.append(f"it will say next to nothing of {_listed(self.silent)}")
        if said:
            return f"Of this log: {'; '.join(said)}."
        worst = int(np.argmax(self.deviations))
        least = f"{self.names[worst]}, to {100 * self.deviations[worst]:.2g} % (one standard deviation)"
        return f"This log will tell all of them apart; it says least of {least}."


def information(
    names: Sequence[str], sensitivity: Float[np.ndarray, "sample parameter"], deviation: Float[np.ndarray, " sample"],
    beside: Float[np.ndarray, "sample nuisance"] | None = None,
) -> Information:  # fmt: skip
    """Return the information of independent, normal samples.

    Arguments:
        names: of the parameters.
        sensitivity: change of each sample per parameter, in units of the parameter's scale.
        deviation: standard deviation of each sample.
        beside: change of each sample per nuisance, in units of the nuisance's prior; these are eliminated.
    """
    none = np.zeros((len(sensitivity), 0))
    every = np.hstack([none if beside is None else beside, sensitivity])
    root = np.asarray(np.linalg.qr(np.vstack([every / deviation[:, None], np.eye(every.shape[1])]), "r"))
    first = every.shape[1] - len(names)  # the nuisances stand first, so that the rest of R is without them
    return Information(tuple(names), root[first:, first:])


def _listed(names: Sequence[str]) -> str:
    *most, last = names if len(names) <= _MANY else (*names[:_MANY], f"{len(names) - _MANY} more")
    return f"{', '.join(most)} and {last}" if most else last


def _combination(parts: dict[str, float]) -> str:
    """Return the least visible direction in words: each parameter by its share of its own value."""
    unit = max(parts.values(), key=abs)
    changes = [f"{name} {100 * part / unit:+.3g} %" for name, part in parts.items()]
    return f"{', '.join(changes)} at once look the same"
