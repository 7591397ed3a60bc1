"""The free order of limbs: one at a time, that which gains most."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.gait.chosen_footholds import situation_of
from mjx_climb.gait.footholds.farthest import Farthest
from mjx_climb.gait.footholds.footholds import Prospects
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.gait.free_order import FreeOrder, first_largest
from mjx_climb.ground.ground import Ground
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.inverse_kinematics import limb_geometry
from tests.gait.test_planner import NO_PUSH, SOFT, holds
from tests.gait.test_planner_decisions import (
    BASE,
    FEET,
    MOVES,
    PERIOD,
    PLAN,
    ROBOT,
    STEP,
    begun,
    body_of,
    ground_of,
    nested,
    planner_of,
    reaches,
)  # fmt: skip

# a limb swings for 0.2 s, and all stand for 0.1 s
WALK = {
    "duration": 1.0, "gait.cycle": 1.2, "gait.duty": 0.834, "gait.stride": 0.01, "gait.step_height": 0.005,
    "gait.order": "free", "disturbance.pushes": [NO_PUSH], **SOFT,
}  # fmt: skip


def test_of_equal_ones_the_first_is_next():
    np.testing.assert_array_equal(first_largest(np.array([1.0, 3.0, 3.0, 0.0])), [False, True, False, False])


class Known(FreeOrder):
    """A free order in which limbs have 3, 4, none and 2 cm before them, or none."""

    def prospects(self, situation, body, ways):
        found = Prospects.none(situation.feet)
        return found if ways is None else found._replace(farthest=jnp.array([0.03, 0.04, -jnp.inf, 0.02]))


NEXT = {  # steps of a swing, step, what differs in the memory, whether there are holds, the limb and its wait
    "all stand": (150.0, 500, {}, True, 1, 50.0),
    "one has a step to go": (150.0, 499, {}, True, None, 50.0),
    "the base is there": (250.0, 600, {}, True, 1, 0.0),
    "the gait stands still": (150.0, 500, {"running": 0.0}, True, None, 50.0),
    "no limb has a hold ahead": (150.0, 500, {}, False, None, 50.0),
}


@pytest.mark.parametrize("name", NEXT)
def test_one_limb_is_next_once_all_stand_and_the_base_is_there(name):
    """It waits for a quarter of the cycle less its swing; what it has swung since then is its own."""
    swing, step, changes, ahead, limb, wait = NEXT[name]
    plan = PLAN._replace(swing_steps=jnp.asarray(swing))
    gait = Known(plan, STEP, False, ROBOT, limb_geometry(ROBOT), None, PERIOD, Farthest(), MOVES)
    own = {"begun": [0.0, 10.0, 150.0, 350.0], "step": step, "span": [swing] * 4} | changes
    situation = SimpleNamespace(feet=jnp.asarray(FEET))
    lifts, waits, _ = gait.next_swings(begun(planner_of(), **own), None, situation, None, None, ahead or None)
    np.testing.assert_array_equal(lifts, np.arange(4) == (-1 if limb is None else limb))
    assert waits == wait
    np.testing.assert_array_equal(gait.until_lift_off(None, jnp.array([-20.0, 0.0, 30.0])), [20.0, 800.0, 800.0])


@pytest.mark.slow
def test_the_limb_that_can_go_farthest_is_next(case):
    """Of three limbs with a hold ahead they swing in the order of the ways; the fourth stays."""
    scenario = case("case_2", "pd", WALK)
    feet = mc.rollout(case("case_2", "pd", WALK | {"duration": 0.1, "gait.order": "periodic"})).foot_position[0]
    ways = np.array([0.01, 0.0, 0.02, 0.015])
    points = feet[ways > 0] + np.outer(ways[ways > 0], [1.0, 0, 0])
    points[:, 2] = 0
    # on holds below its feet it stands
    ground = Ground(holds=holds(np.concatenate([points, feet * [1, 1, 0]])))
    parameters = dataclasses.replace(own_parameters(scenario), ground=ground, footholds=Farthest())
    walk = mc.rollout(scenario, parameters=parameters)
    assert walk.support.sum(1).min() >= 3 and not walk.detached.any()
    lifted = [int((~walk.support[:, limb]).argmax()) for limb in range(4)]
    assert lifted[2] < lifted[3] < lifted[0]
    np.testing.assert_allclose(walk.grip_point[-1][ways > 0], points, rtol=0, atol=1e-3)


def test_prospects_are_those_of_a_loop_over_holds():
    """Behind and ahead, near and far, in reach or not, and at another limb's foot; the last hold is padding."""
    random, advance = np.random.default_rng(12), np.array([0.16, 0.01, 0.0])
    points = (FEET + random.uniform(-0.12, 0.12, (8, 4, 3)) * [1, 0.4, 0]).reshape(-1, 3)
    feet = FEET - [0.12, 0.0, 0.0]
    feet[1] = FEET[0] + [0.04, 0.0, 0.0]  # before the first limb
    points = np.vstack([points, feet, points[:1]])
    planner = planner_of(rule=Nearest(reach_a_stride_on=False), holds=ground_of(points, random), free=True)
    ways = jnp.zeros(3), jnp.asarray(advance)

    @jax.jit
    def found(memory, body):
        return planner.prospects(situation_of(PLAN, memory, body, ways[1]), body, ways)

    prospects = found(nested(begun(planner, goal=feet)), body_of())
    forward, there = advance / np.linalg.norm(advance), reaches(points, BASE)
    farthest, near, in_vain = np.full(4, -np.inf), np.zeros(4), np.zeros(4)
    for limb in range(4):
        ahead, worth, may = [], [], []
        for number, point in enumerate(points[:-1]):
            step = point - feet[limb]
            free = all(np.linalg.norm(point - feet[other]) > 1e-3 for other in range(4) if other != limb)
            may.append(there[limb, number] and free)
            worth.append(-np.sum((point - feet[limb] - advance) ** 2))
            ahead.append(there[limb, number] and step @ forward > 0 and np.linalg.norm(step) <= 0.2)
            farthest[limb] = max(farthest[limb], step @ forward) if may[-1] else farthest[limb]
        best = max((w for w, m in zip(worth, may, strict=True) if m), default=-np.inf)
        near[limb], in_vain[limb] = sum(ahead), sum(a and w > best for a, w in zip(ahead, worth, strict=True))
    np.testing.assert_allclose(prospects.farthest, farthest)
    np.testing.assert_array_equal(prospects.near, near)
    np.testing.assert_array_equal(prospects.in_vain, in_vain)
    assert in_vain.any() and (near < there.sum(1)).all()
