"""Walks that were never walked: a robot that stands on four limbs, with whatever series a test wants."""

import dataclasses

import numpy as np

import mjx_climb as mc


def still(scenario, **series):
    """Return a walk of zeros with all grippers shut; `series` are values over time, or one value for all times."""
    sizes = {"time": scenario.steps, "limb": 4, "joint": 3}
    shut = ("support", "contact", "reachable")
    arrays = {}
    for field in dataclasses.fields(mc.Trajectory):
        if hasattr(field.type, "dim_str"):
            shape = [sizes.get(size) or int(size) for size in field.type.dim_str.split()]
            kind = bool if "bool" in str(field.type.dtypes) else float
            value = series.get(field.name, field.name in shut)
            arrays[field.name] = np.broadcast_to(np.asarray(value, kind), shape).copy()
    arrays["time"] = np.arange(scenario.steps) * scenario.time_step
    limbs = ("LF", "LH", "RH", "RF")
    return mc.Trajectory(scenario, mc.Gains(1.0, 1.0, 1.0), mc.parameters(scenario), limbs, **arrays)
