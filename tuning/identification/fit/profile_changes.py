"""Likely single changes of the hardware's profile, each fitted: parts that it has too many, or lacks.

Each is tried with the noise that the fit had, and the rest of the profile as it is.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Servo
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.fit.search import Searches
from tuning.identification.model.predicted import model_of, with_nuisances
from tuning.identification.model.variables import Variable, begin, variables

_PARTS = (  # of a servo, which a profile may have and a robot not, by the fields that make one up
    ("backlash",), ("no_load_speed",), ("torque_limit", "no_load_speed"), ("delay",),
    ("stribeck_friction", "stribeck_load_friction", "stribeck_external_load_friction"),
    ("load_friction", "external_load_friction", "quadratic_load_friction", "quadratic_external_load_friction"),
    ("profile_velocity", "profile_acceleration"), ("current_limit",), ("rate",),
)  # fmt: skip
# SI units: parts that a profile may lack, at the size from which each is fitted
_MISSING = {
    "backlash": 0.005, "viscous_friction": 0.05, "stribeck_friction": 0.05, "load_friction": 0.1,
    "supply_resistance": 0.2,
}  # fmt: skip
_MOST, _TOLERANCE = 15, 1e-3  # evaluations, relative
_EXPLAINS = 0.8  # of the residuals' root mean square before


class Change(NamedTuple):
    """A change of a scenario's servos."""

    words: str
    scenario: mc.Scenario
    beside: tuple[Variable, ...]  # variables that are fitted with it


class Tried(NamedTuple):
    """The residuals that a change leaves."""

    words: str
    left: float  # root mean square over that without the change


def changes(scenario: mc.Scenario, chosen: Sequence[Variable]) -> Iterator[Change]:
    """Yield the likely single changes of a scenario's servos, but for the fitted ones."""
    servo, fitted = scenario.hardware.servo, {v.key for v in chosen}
    plain = {name: field.default for name, field in Servo.model_fields.items()}
    for part in _PARTS:
        keys = {name: f"hardware.servo.{name}" for name in part if getattr(servo, name) != plain[name]}
        if len(keys) < len(part) and part == ("torque_limit", "no_load_speed"):
            keys = {}  # the line alone is a part of its own
        if keys and not fitted & {*keys.values()}:
            changed = {key: plain[name] for name, key in keys.items()}
            options = " ".join(f"--set {key}={'null' if value is None else value}" for key, value in changed.items())
            try:
                yield Change(f"without {' and '.join(keys.values())} ({options})", scenario.with_overrides(changed), ())
            except ConfigError:  # another part needs it
                continue
    for name, value in _MISSING.items():
        key = f"hardware.servo.{name}"
        if getattr(servo, name) == plain[name] and key not in fitted:
            try:
                other = scenario.with_overrides({key: value})
            except ConfigError:  # this servo cannot have it
                continue
            yield Change(f"with {key} (--set {key}={value:g} --fit {key})", other, variables(other, [key], held=True))


def tried(
    problem: Problem, found: Fitted, scenario: mc.Scenario, chosen: Sequence[Variable], searches: Searches
) -> list[Tried]:
    """Return the share of the residuals that each likely change of a scenario leaves, the least first.

    Arguments:
        problem: as it was fitted, with its noise.
        found: its fit.
        scenario: whose servos are changed.
        chosen: the variables that were asked for.
        searches: of the fit.
    """
    windows, mass = problem.model.windows, problem.model.structure.mass
    known = dict(zip((v.key for v in problem.model.variables), found.x.tolist(), strict=True))

    def cost(change: Change) -> float:
        own = with_nuisances(change.scenario, (*chosen, *change.beside), windows.kinds)
        model = model_of(change.scenario, windows, own, mass)
        own_problem = Problem(model, problem.noise, problem.clock, problem.rate)
        x = np.array([known.get(v.key, nominal) for v, nominal in zip(own, begin(own), strict=True)])
        start = found.start if found.start.shape == model.guess.shape else model.guess
        end = searches.search(own_problem, np.r_[x, start.ravel()], _MOST, change.words, _TOLERANCE)
        return np.inf if end is None else end.cost

    each = [Tried(change.words, float(np.sqrt(cost(change) / found.cost))) for change in changes(scenario, chosen)]
    return sorted(each, key=lambda one: round(one.left, 2))  # of two alike the smaller change, which is tried first


def in_words(some: Sequence[Tried]) -> str:
    """Return which change explains the residuals best, in a line."""
    if not some:
        return ""
    best, *others = some
    if not best.left < _EXPLAINS:
        return f"none of {len(some)} single changes of hardware.servo explains the residuals"
    others = [each for each in others if best.left + 0.01 < each.left < _EXPLAINS]  # one as good holds the best
    beside = f"; next, {others[0].words}: {others[0].left:.2g} of them" if others else ""
    return f"the residuals are explained best {best.words}: {best.left:.2g} of them are left{beside}"
