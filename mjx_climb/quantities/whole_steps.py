"""Times as whole numbers of time steps, the same in single and in double precision."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_climb.quantities.parameters import Parameters

ROUNDING = 2.0**-21  # of a number of steps: what single precision may be off
_TIMES = ("cycle", "cargo_start", "cargo_stop", "push_start", "push_stop", "control_period")


def whole_steps(seconds: Any, time_step: float) -> Any:
    """Return the whole number of time steps nearest to each time in s, of two the larger; arrays of JAX or of NumPy.

    What lies below half a step by no more than the rounding of single precision counts as half a step.
    """
    steps = seconds / time_step + 0.5
    return _module(steps).floor(steps + _slack(steps))


def stance_steps(duty: Any, cycle_steps: Any) -> Any:
    """Return for how many steps of a cycle a limb stands: rounded up, so that limbs in turn never swing together."""
    steps = duty * cycle_steps
    return _module(steps).ceil(steps - _slack(steps))


def _slack(steps: Any) -> Any:
    return _module(steps).minimum(steps * ROUNDING, 0.125)


def _module(array: Any) -> Any:
    return jnp if isinstance(array, jax.Array) else np


def with_whole_steps(parameters: Parameters, time_step: float) -> Parameters:
    """Return parameters whose gait, windows and control period are whole time steps, counted in double precision.

    A walk in any precision finds the same numbers of steps in them. Values that JAX traces stay as they are.
    """
    known = {name: getattr(parameters, name) for name in (*_TIMES, "duty")}
    known = {n: np.asarray(v, np.float64) for n, v in known.items() if not isinstance(v, jax.core.Tracer)}
    steps = {name: whole_steps(known[name], time_step) for name in _TIMES if name in known}
    changed = {name: count * time_step for name, count in steps.items()}
    if "duty" in known and "cycle" in known:
        changed["duty"] = stance_steps(known["duty"], steps["cycle"]) / np.maximum(steps["cycle"], 1)
    return dataclasses.replace(parameters, **changed)
