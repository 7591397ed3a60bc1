"""Walks that were never walked: a robot that stands on four limbs, with whatever series a test wants."""

import numpy as np

import mjx_climb as mc
from mjx_climb.walk.sample import unknown


def still(scenario, **series):
    """Return a walk of zeros with all grippers shut; `series` are values over time, or one value for all times."""
    shut = ("support", "contact", "reachable")
    arrays = {}
    for name, values in unknown(scenario.steps, {"limb": 4, "joint": 3}).items():
        value = np.asarray(series.get(name, name in shut), values.dtype)
        arrays[name] = np.broadcast_to(value, values.shape).copy()
    arrays["time"] = np.arange(scenario.steps) * scenario.time_step
    own = {"gains": mc.Gains(1.0, 1.0, 1.0), "parameters": mc.parameters(scenario), "limbs": ("LF", "LH", "RH", "RF")}
    return mc.Trajectory(scenario=scenario, **own, **arrays)
