"""Values of the gait among the gains, by the keys of a scenario: a law and the gait under it are tuned together."""

from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np

from mjx_climb.arrays import AnyArray
from mjx_climb.execution.batch_axes import batch_shape
from mjx_climb.gait.base_path import check_base
from mjx_climb.gait.periodic import PeriodicGait
from mjx_climb.parameter_types import Parameters, is_tracer, whole_steps
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario

GAIT = tuple(f"gait.{name}" for name in PeriodicGait.VALUES if name not in ("heading", "swing_path"))
TIMES = ("gait.cycle", "gait.duty")  # counted in whole time steps: no metric has a derivative along them
Value = TypeVar("Value")
_WAY = ("gait.cycle", "gait.stride")


def gait_of(gains: Mapping[str, Value]) -> dict[str, Value]:
    """Return those of some values by name that are the gait's."""
    return {name: value for name, value in gains.items() if name in GAIT}


def own_gait(scenario: Scenario) -> dict[str, float]:
    """Return the values of a scenario's gait that may be among gains, by their keys."""
    return {key: getattr(scenario.gait, key.removeprefix("gait.")) for key in GAIT}


def why_fixed(scenario: Scenario, keys: Iterable[str]) -> str:
    """Return why a key cannot be a gain in a scenario, "" where all can."""
    low, read = scenario.gait.swing == "low_reaction", scenario.gait.swing_file is not None
    for key in keys:
        if low or read or (scenario.ground.map is not None and key in _WAY):
            what = "a map's footholds are"
            if low or read:
                what = "gait.swing: low_reaction is" if low else "gait.swing_file is"
            return f"{key}: expected none, as {what} computed for the scenario's own gait"
    return ""


def with_gait(scenario: Scenario, own: Parameters, values: Mapping[str, AnyArray]) -> Parameters:
    """Return parameters with values of the gait, by their keys, in place of their own.

    The speed of travel is held: with another cycle and no stride of its own, the stride changes in proportion.

    Raises:
        ValueError: in one line, a value that no gait of the scenario could have, as far as values are known.
    """
    if not values:
        return own
    changed = dict(values)
    if "gait.cycle" in changed:  # whole steps, so that the speed is that of the cycle that is walked
        changed["gait.cycle"] = whole_steps(changed["gait.cycle"], scenario.time_step) * scenario.time_step
        changed.setdefault("gait.stride", own.gait.stride / own.gait.cycle * changed["gait.cycle"])
    if why := why_fixed(scenario, values):
        raise ValueError(f"gains.{why}")
    walked = own.replace(changed)
    batch_shape(walked)
    each = [walked.at(path) for path in GAIT]
    if not any(map(is_tracer, each)):
        _check(scenario, dict(zip(GAIT, np.broadcast_arrays(*map(np.asarray, each)), strict=True)))
    return walked


def scenario_with_gait(scenario: Scenario, gains: Mapping[str, AnyArray]) -> Scenario:
    """Return a scenario with the gait among the gains of one robot in place of its own, as `with_gait` has it.

    Raises:
        ConfigError: a value that it could not have.
    """
    values = {key: float(value) for key, value in gait_of(gains).items()}
    if "gait.cycle" in values:
        values["gait.cycle"] = float(whole_steps(values["gait.cycle"], scenario.time_step) * scenario.time_step)
        values.setdefault("gait.stride", scenario.gait.stride / scenario.gait.cycle * values["gait.cycle"])
    return scenario.with_overrides(values) if values else scenario


def _check(scenario: Scenario, values: Mapping[str, np.ndarray]) -> None:
    """Refuse gaits (any shape) that the scenario could not have; the extremes of a batch stand for all of it."""
    rows = {key: value.ravel() for key, value in values.items()}
    swing = (1 - rows["gait.duty"]) * rows["gait.cycle"]
    extremes = {int(end) for value in (*rows.values(), swing) for end in (value.argmin(), value.argmax())}
    for place in extremes:
        try:
            check_base(scenario.with_overrides({key: float(value[place]) for key, value in rows.items()}))
        except ConfigError as error:
            raise ValueError(f"gains.{error.moved(source='')}") from None
