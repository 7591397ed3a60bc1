"""Laws that branch and loop on what they measure: they walk, and their tangents are right."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.execution import of_limbs, over_robots

SHORT = (("duration", 0.05), ("gait.cycle", 0.5), ("disturbance.cargo.start", 0.02), ("disturbance.cargo.mass", 0.5))
METRICS = ("peak_foot_force", "force_variation", "base_deviation")
STEP = 1e-3


class Branching(mc.Law):
    """Yields more slowly while the feet bear little."""

    damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e5), default=1e2)

    def init(self, start):
        return jnp.zeros(6), start.period

    def rate(self, measured):
        loaded = jnp.abs(measured.foot_force).sum() > 8.0
        return jax.lax.cond(loaded, lambda w: w / self.damping, lambda w: 0.5 * w / self.damping, measured.wrench[:3])

    def step(self, state, measured, reference):
        shift, period = state
        shift = shift.at[:3].add(-period * self.rate(measured))
        return (shift, period), mc.control.shifted(reference, shift)


class Looping(Branching):
    """Carries the feet's forces and a count through a loop; the forces decide about the number of passes."""

    def rate(self, measured):
        def halved(carried):
            force, count, rate = carried
            return 0.5 * force, count + 1, 0.5 * (rate + measured.wrench[:3] / self.damping)

        start = measured.foot_force, 0, jnp.zeros_like(self.damping)
        return jax.lax.while_loop(lambda carried: jnp.abs(carried[0]).sum() > 4.0, halved, start)[2]


@dataclasses.dataclass(frozen=True)
class Limbs:
    """What limbs bear."""

    OF_LIMBS = ("force",)
    force: Float[Array, "limb axis"]


QUICKEST, *OTHERS = itertools.product((Branching, Looping), ((2,), ()), (np.float64, np.float32))
WALKS = [QUICKEST, *(pytest.param(*each, marks=pytest.mark.nightly) for each in OTHERS)]
CONDITIONS = {"of the forces": lambda force, gain: force.sum() > 10, "of the gain": lambda force, gain: gain > 1.5}


@pytest.mark.parametrize("condition", CONDITIONS.values(), ids=CONDITIONS)
def test_branches_and_loops_and_their_tangents_are_those_of_jax(condition):
    """Of several robots, along several directions; loops carry arrays of the limbs beside single numbers."""

    def walk(gain, row):
        force = of_limbs(Limbs(row.reshape(4, 2))).force
        few = condition(force, gain)
        kept, moved = jax.lax.cond(few, lambda g: (force, g * force), lambda g: (2 * force, force / g), gain)
        start = force, 0, gain, jnp.zeros(())
        passed = jax.lax.while_loop(
            lambda c: c[1] < 3, lambda c: (0.5 * c[0], c[1] + 1, c[2] ** 2, c[3] + c[2] * c[0].sum()), start
        )
        return {"kept": kept, "moved": moved, "halved": passed[0], "count": passed[1] * 1.0, "summed": passed[3]}

    def derivatives(walk):
        def along(direction):
            return jax.jvp(jax.vmap(walk), (gains, rows), (direction, jnp.zeros_like(rows)))

        return jax.jit(jax.vmap(along))(np.array([[1.0, 2.0], [3.0, 0.0], [0.0, 1.0]]))

    gains, rows = np.array([1.2, 2.0]), np.arange(1.0, 17.0).reshape(2, 8) / 4
    for mine, theirs in zip(*(jax.tree.leaves(derivatives(each)) for each in (over_robots(walk), walk)), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "robots", "dtype"), WALKS)
def test_tangents_of_such_a_law_are_its_differences(case, law, robots, dtype):
    """In float64; those of float32 are the same."""
    simulation = mc.Simulation(case("case_1_2", "virtual_model", SHORT), law())
    damping = np.multiply.outer(np.array([1e2, 2e2]) if robots else np.array(1e2), np.ones(3))
    along = {"damping": np.stack([np.ones_like(damping), damping])}
    values, tangents = simulation.jvp({"damping": damping}, along, dtype=dtype)
    sides = np.stack([damping + side * STEP * rates for rates in along["damping"] for side in (1, -1)])
    moved = simulation.metrics({"damping": sides}, dtype=np.float64)
    for name in METRICS:
        differences = (moved[name][::2] - moved[name][1::2]) / (2 * STEP)
        assert values[name].shape == robots and tangents[name].shape == (2, *robots)
        np.testing.assert_allclose(tangents[name], differences, rtol=1e-3 if dtype == np.float64 else 2e-2)
