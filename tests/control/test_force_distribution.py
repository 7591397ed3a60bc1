"""Sharing a wrench among feet against an exact quadratic program, over random supports and wrenches."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.control.climb_sdk import of_largest_margin
from mjx_climb.control.force_distribution import distributed, net_wrench, rigid_part, sharing
from tests import oracle_laws

SOFTNESS = 0.1


def scenes(count, limbs, seed=0):
    """Return levers, weights of at least three feet, pull limits, and wrenches of random forces on them."""
    rng = np.random.default_rng(seed)
    corners = np.linspace(0, 2 * np.pi, limbs, endpoint=False) + rng.uniform(-0.3, 0.3, (count, limbs))
    lever = np.stack([0.2 * np.cos(corners), 0.2 * np.sin(corners), np.full_like(corners, -0.1)], axis=-1)
    lever += rng.uniform(-0.03, 0.03, lever.shape)
    weight = np.where(rng.random((count, limbs)) < 0.3, 0.02, rng.uniform(0.02, 1, (count, limbs)))
    first = np.arange(limbs) == rng.integers(limbs, size=count)[:, None]
    weight[first & (rng.random(count) < 0.5)[:, None] & (limbs > 3)] = 0.0
    force = rng.normal(0, [1.0, 1.0, 3.0], (count, limbs, 3)) * (weight > 0)[..., None]
    wrench = np.concatenate([force.sum(1), np.cross(lever, force).sum(1)], axis=1)
    return wrench, lever, weight, rng.uniform(0.1, 3, count)


def exact(wrench, lever, weight, pull_limit):
    """Return the forces (scene, limb, 3) of the program, by trying every set of limits that may act.

    `min sum |F|^2 / (2 weight) + sum max(-pull_limit - F_z, 0)^2 / (2 softness)` with `sum G F` the wrench, in
    `u = F / sqrt(weight)`. Where a set is right, its limits are exceeded and no others are.
    """
    count, limbs = weight.shape
    root = np.repeat(np.sqrt(weight), 3, axis=1)
    to_wrench = np.stack([oracle_laws.grasp(own) for own in lever]) * root[:, None]
    solution = np.full((count, limbs, 3), np.nan)
    for acts in itertools.product([0.0, 1.0], repeat=limbs):
        up = np.zeros((limbs, 3))
        up[:, 2] = acts
        up = up.ravel()
        system = np.zeros((count, 3 * limbs + 6, 3 * limbs + 6))
        diagonal = 1 + up * root**2 / SOFTNESS
        system[:, range(3 * limbs), range(3 * limbs)] = diagonal
        system[:, : 3 * limbs, 3 * limbs :], system[:, 3 * limbs :, : 3 * limbs] = to_wrench.mT, to_wrench
        right = np.concatenate([-up * root * pull_limit[:, None] / SOFTNESS, wrench], axis=1)
        force = (root * np.linalg.solve(system, right[..., None])[:, : 3 * limbs, 0]).reshape(count, limbs, 3)
        beyond = force[..., 2] < -pull_limit[:, None]
        fits = (beyond == (np.array(acts) > 0)).all(1)
        solution[fits] = force[fits]
    return solution


@pytest.mark.parametrize(
    ("limbs", "count"),
    [pytest.param(4, 10_000, marks=pytest.mark.nightly), (3, 2000), pytest.param(6, 300, marks=pytest.mark.slow)],
)
def test_forces_are_those_of_the_exact_program(limbs, count):
    """The wrench to 1e-9; forces to 1e-3 of the largest, as 12 sweeps go; where no limit acts, to 1e-9."""
    wrench, lever, weight, limit = scenes(count, limbs)
    found = np.asarray(jax.jit(jax.vmap(distributed))(wrench, lever, weight, limit))
    again = np.asarray(jax.vmap(net_wrench)(lever, found))
    np.testing.assert_allclose(again, wrench, rtol=0, atol=1e-9)
    assert not found[weight == 0].any()
    best = exact(wrench, lever, weight, limit)
    assert np.isfinite(best).all()
    off, largest = np.abs(found - best).max((1, 2)), np.abs(best).max((1, 2))
    limited = (best[..., 2] < -limit[:, None]).any(1)
    assert min(limited.mean(), 1 - limited.mean()) > 0.05
    assert (off / largest).max() < 1e-3
    assert off[~limited].max() < 1e-9


def margins(wrench, lever, cost):
    """Return the forces (scene, limb, 3) of `min cost / 2 |F|^2 - m, m <= F_z`, by trying which feet are at the margin.

    Those that are have shares of one, none below 0; no other foot has less force along the normal.
    """
    count, limbs = lever.shape[:2]
    size = 3 * limbs
    to_wrench = np.stack([oracle_laws.grasp(own) for own in lever])
    solution, best = np.full((count, limbs, 3), np.nan), np.full(count, np.inf)
    for acts in itertools.product([False, True], repeat=limbs):
        feet = np.flatnonzero(acts)
        if not len(feet):
            continue
        system = np.zeros((count, size + 7 + len(feet), size + 7 + len(feet)))
        right = np.zeros((count, len(system[0])))
        at_margin = np.zeros((len(feet), size + 1))  # F_z - m
        at_margin[range(len(feet)), 3 * feet + 2], at_margin[:, size] = 1, -1
        system[:, range(size), range(size)] = cost
        right[:, size] = 1
        system[:, : size + 1, size + 7 :], system[:, size + 7 :, : size + 1] = -at_margin.T, at_margin
        system[:, :size, size + 1 : size + 7], system[:, size + 1 : size + 7, :size] = to_wrench.mT, to_wrench
        right[:, size + 1 : size + 7] = wrench
        system[:, range(size + 7, len(right[0])), range(size + 7, len(right[0]))] = 1e-9 / cost  # shares, if not unique
        found = np.linalg.solve(system, right[..., None])[..., 0]
        force = found[:, :size].reshape(count, limbs, 3)
        value = cost / 2 * (force**2).sum((1, 2)) - force[..., 2].min(1)
        fits = (found[:, size + 7 :] > -1e-9).all(1) & (value < best)
        solution[fits], best[fits] = force[fits], value[fits]
    return solution, best


@pytest.mark.parametrize(("limbs", "count"), [pytest.param(4, 10_000, marks=pytest.mark.nightly), (3, 2000)])
def test_forces_of_the_largest_margin_are_those_of_the_exact_program(limbs, count):
    wrench, lever, *_ = scenes(count, limbs)
    cost, all_bear = 0.01, np.ones((count, limbs), bool)

    def of_one(wrench, lever, bears):
        return of_largest_margin(sharing(wrench, lever, jnp.ones(limbs)), bears, cost)

    found = np.asarray(jax.jit(jax.vmap(of_one))(wrench, lever, all_bear))
    np.testing.assert_allclose(jax.vmap(net_wrench)(lever, found), wrench, rtol=0, atol=1e-9)
    _, best = margins(wrench, lever, cost)
    missing = cost / 2 * (found**2).sum((1, 2)) - found[..., 2].min(1) - best
    assert missing.min() > -1e-6
    np.testing.assert_array_less(np.percentile(missing, [50, 99]), [1e-6, 1e-2])  # N; few sweeps are made


@pytest.mark.slow
def test_a_rigid_motion_is_all_rigid_and_the_rest_has_none():
    """Against least squares; what is left over has neither a mean nor a turn."""
    _, lever, weight, _ = scenes(50, 4, seed=1)
    displacement = np.random.default_rng(2).normal(size=lever.shape)
    found = np.asarray(jax.jit(jax.vmap(rigid_part))(lever, displacement, weight))
    for own, *given in zip(found, lever, displacement, weight, strict=True):
        np.testing.assert_allclose(own, oracle_laws.rigid(*given), atol=1e-9)
    np.testing.assert_allclose(jax.vmap(rigid_part)(lever, found, weight), found, atol=1e-9)
