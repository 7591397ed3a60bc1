"""The result of `identify`: the estimate of each key, and the scenario and the robot with it."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.parameter_types import Parameters
from mjx_climb.robot.constants import Robot
from tuning.identification.fit.inference import Posterior, Whiteness, suspicious
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.model.predicted import PRESLIDING, Fit
from tuning.identification.model.variables import applied, begin
from tuning.identification.readers.log import Log


@dataclasses.dataclass(frozen=True)
class Estimate:
    """The estimate of one key, SI units."""

    value: float  # where the search ended; the nominal one where the log does not tell it
    low: float  # 95 % interval
    high: float
    seen: bool  # the log tells it
    before: float
    unit: str
    remark: str = ""  # bound or prior reached


@dataclasses.dataclass(frozen=True)
class Identified:
    """The result of `identify`."""

    FILE = "result.json"  # by it the folder is known
    KIND = "identify"

    scenario: mc.Scenario
    log: Log
    estimates: Mapping[str, Estimate]  # by key
    beside: Mapping[str, Estimate]  # nuisances: delays of recorded signals, presliding
    held_out: Mapping[str, Any]
    warnings: tuple[str, ...]
    combined: tuple[str, ...]  # told combinations of keys that are not told
    model: Fit
    problem: Problem
    fitted: Fitted
    posterior: Posterior
    tests: Sequence[Whiteness]

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        seen = sum(each.seen for each in self.estimates.values())
        held = self.held_out.get("error_over_noise")
        predicted = "" if held is None else f", and predicts what it has not seen within {held:.3g} of the noise"
        wrong = len(suspicious(self.tests))
        refuted = f"; the residuals refute the model in {wrong} of {len(self.tests)} signals" if wrong else ""
        return f"{self.log.source} tells {seen} of {len(self.estimates)} parameters{predicted}{refuted}"

    def as_json(self) -> dict[str, Any]:
        """Return the result as `mjx-climb identify --json` prints it."""
        names = ("value", "low", "high", "seen")
        shown = {key: {n: getattr(each, n) for n in names} for key, each in self.estimates.items()}
        search = {
            "ended": self.fitted.ended, "iterations": self.fitted.iterations, "costs": list(self.fitted.costs),
        }  # fmt: skip
        return {
            "parameters": shown, "held_out": dict(self.held_out), "search": search, "warnings": list(self.warnings),
        }  # fmt: skip

    @property
    def known(self) -> dict[str, Estimate]:
        """The estimates that the log tells, by key: the others stay nominal."""
        return {key: each for key, each in self.estimates.items() if each.seen}

    def overrides(self) -> dict[str, Any]:
        """Return the keys of a scenario with their new values; those of the robot go by its file."""
        found: dict[str, Any] = {k: each.value for k, each in self.known.items() if k in self.model.parameters.paths}
        if self.own:
            parameters, _ = self._applied()
            before = self.model.parameters.values
            each = {path: np.asarray(value) for path, value in parameters.values.items() if "." in path}
            found |= {path: v.tolist() for path, v in each.items() if not np.array_equal(v, before[path])}
        found = {key: max(value, 0.0) if key.endswith("delay") else value for key, value in found.items()}
        if (bend := self.beside.get(PRESLIDING)) is not None and bend.seen:  # the friction that was found goes with it
            found[PRESLIDING] = bend.value
        tilt = [self.known.get(f"gravity.tilt_{axis}") for axis in "xy"]
        if any(tilt):
            angles = [0.0 if each is None else each.value for each in tilt]
            found["gravity"] = (turned(angles) @ np.asarray(self.scenario.gravity)).tolist()
        return found

    @property
    def own(self) -> bool:
        """Whether the user brought a variable that is known."""
        return any(v.change is not None and v.key in self.known for v in self.model.variables)

    def robot(self) -> Robot:
        """The robot with its identified values, constants of NumPy."""
        return self._applied()[1]

    def _applied(self) -> tuple[Parameters, Robot]:
        places, nominal = self.model.structure.places, self.model.structure.robot
        before, known = begin(self.model.variables), self.known
        x = np.where([v.key in known for v in self.model.variables], self.fitted.x, before)
        with jax.enable_x64(True):
            both = applied(places, jnp.asarray(x), self.model.parameters, nominal)
        constants: tuple[Parameters, Robot] = jax.tree.map(np.asarray, both)
        return constants


def turned(angles: Sequence[float]) -> np.ndarray:
    """Return the rotation (3, 3) by angles about the world's x and y, rad."""
    return np.asarray(Rotation.from_rotvec([*angles, 0.0]).as_matrix())
