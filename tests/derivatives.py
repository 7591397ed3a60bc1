"""Derivatives of a walk's metric by its parameters, forward and by central differences."""

import jax
import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters


def by_each(scenario, names, metric):
    """Return the tangents of a metric by each value, and central differences, by path; a robot for each."""
    own, simulate = mc.parameters(scenario), mc.simulator(scenario)
    at = {name: jnp.full(len(names), float(own.at(name))) for name in names}
    along = {name: jnp.asarray(np.array(names) == name, float) for name in names}

    def value(varied):
        return simulate(parameters=own.replace(varied))[metric]

    _, forward = jax.jit(lambda: jax.jvp(value, (at,), (along,)))()
    sides = []
    for sign in (1, -1):
        moved = {name: np.asarray(at[name] * (1 + sign * 1e-6 * along[name])) for name in names}
        changed = own_parameters(scenario).replace(moved)
        sides.append(mc.rollout_metrics(scenario, parameters=changed, dtype=np.float64)[metric])
    widths = np.array([2e-6 * float(own.at(name)) for name in names])
    return dict(zip(names, zip(np.asarray(forward), (sides[0] - sides[1]) / widths, strict=True), strict=True))
