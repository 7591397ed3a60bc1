"""Gains that a search need not find: those of pd, as far as a law can express them, and the law's defaults."""

import dataclasses

import numpy as np

from mjx_climb.control import law_of
from tuning.problem.evaluation import Problem
from tuning.problem.spaces import kind_of, own_values

_STIFFENING = ("stiffness", "damping")  # in the names of gains: as they grow, forces move the robot less


def others(problem: Problem, start: np.ndarray) -> np.ndarray:
    """Return known points (S, n) besides the start, without those that are the same.

    First the gains nearest to pd: stiffness and damping at the upper ends of their bounds, where a law has such. Then
    the values that its fields have by default, where all of them have one.
    """
    space, law = problem.space, problem.law or law_of(problem.scenario)
    stiff = np.array([any(word in kind_of(name) for word in _STIFFENING) for name in space.names], bool)
    found = [np.where(stiff, space.upper, start)]
    fields = {field.name: field.default for field in dataclasses.fields(law)}
    if law.GAINS and all(fields[name] is not dataclasses.MISSING for name in law.GAINS):
        default = own_values(problem.scenario, dataclasses.replace(law, **{name: fields[name] for name in law.GAINS}))
        defaults = space.from_gains(default)
        of_law = np.array([kind_of(name) in law.GAINS for name in space.names], bool)
        found.append(np.where(of_law, defaults, start))
    kept: list[np.ndarray] = []
    for point in found:
        if all(np.abs(point - other).max(initial=0.0) > 1e-9 for other in (start, *kept)):
            kept.append(point)
    return np.array(kept).reshape(-1, start.size)
