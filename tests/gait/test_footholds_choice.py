"""The rules of footholds choose what the references choose, on random grounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_climb.gait.chosen_footholds import middle_of
from mjx_climb.gait.footholds.choice import Candidates
from mjx_climb.gait.footholds.footholds import Candidate, Situation
from mjx_climb.gait.footholds.least_use import LeastUse, resting_forces
from mjx_climb.gait.footholds.nearest import Nearest
from mjx_climb.ground import Holds
from mjx_climb.inputs.own_objects import class_of
from mjx_climb.scenario.model import FootholdsKind
from tests.gait import footholds_reference as reference

POINTS, DEFAULT, NIGHTLY = 12, 300, 10_000
CAP = 0.15
NAMES = ["nearest", "farthest", "climblab", "best_margin", "least_use"]
LIMBS = {"four": 4, "six": 6}


def ground(random, limbs):
    """Return a case: feet around a base, points around the feet, of which limbs may use some."""
    angle = 2 * np.pi * (np.arange(limbs) + 0.5) / limbs
    feet = 0.2 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(limbs)])
    feet += random.normal(0, 0.02, feet.shape)
    position = np.column_stack([random.uniform(-0.35, 0.35, (POINTS, 2)), random.normal(0, 0.02, POINTS)])
    allowed = random.random((limbs, POINTS)) < random.uniform(0.2, 1.0)
    heading = random.uniform(0, 2 * np.pi)
    forward = np.array([np.cos(heading), np.sin(heading), 0])
    stands = np.ones(limbs, bool)
    stands[random.integers(limbs)] = False
    tilted = random.normal([0, 0, 1], 0.6, (POINTS + limbs, 3))
    normal, under = np.split(tilted / np.linalg.norm(tilted, axis=1, keepdims=True), [POINTS])
    # of the holds some bear any pull
    limit = np.where(random.random(POINTS) < 0.3, np.inf, random.uniform(1, 20, POINTS))
    weight = random.uniform(0, 20) * np.array([*random.normal(0, 0.3, 2), random.choice([-1.0, 1.0])])
    return {
        "feet": feet, "planned": feet + 0.05 * forward, "forward": forward, "stands": stands,
        "center_of_mass": random.normal([0, 0, 0.1], 0.02), "weight": weight,
        "holding_force": random.choice([0.0, 5.0, 15.0]), "position": position, "allowed": allowed,
        "normal": normal, "limit": limit, "pull": random.uniform(0, 15, (limbs, 1)) * under,
    }  # fmt: skip


def expected(name, case):
    """Return the point of each limb by the reference."""
    position, allowed, feet, forward = (case[key] for key in ("position", "allowed", "feet", "forward"))
    if name == "nearest":
        return reference.nearest(position, allowed, case["planned"])
    if name == "farthest":
        return reference.farthest(position, allowed, feet, forward)
    if name == "climblab":
        return reference.climblab(position, allowed, feet, forward, CAP)
    weaker = np.minimum(case["limit"], case["holding_force"] or np.inf)
    pulls = np.where(np.isfinite(weaker), weaker, 0.0)
    own = [case[key] for key in ("allowed", "feet", "planned", "stands", "center_of_mass", "weight")]
    if name == "least_use":
        return reference.least_use(position, case["normal"], pulls, *own)
    return reference.best_margin(position, case["normal"], pulls, *own, case["pull"])


def chosen(names, cases):
    """Return the points of all limbs in all cases by each rule, in one program."""
    rules = [
        class_of(FootholdsKind(kind=name), "gait.footholds")(**({"stride_cap": CAP} if name == "climblab" else {}))
        for name in names
    ]
    stacked = {key: jnp.array([case[key] for case in cases]) for key in cases[0]}
    down, valid = jnp.tile(jnp.array([0.0, 0.0, -1.0]), (POINTS, 1, 1)), jnp.ones(POINTS)

    def choose(case):
        situation = Situation(**{key: case[key] for key in Situation._fields})
        holds = Holds(case["position"], case["normal"], down, case["limit"][:, None], valid)

        def scores(one):
            candidate = one.with_feet(jnp.broadcast_to(one.vector, situation.feet.shape), case["holding_force"])
            return [rule.score(situation, candidate) for rule in rules]

        each = jax.vmap(scores)(Candidates.of(holds))
        worth = [jnp.where(case["allowed"], of_rule.T, -jnp.inf) for of_rule in each]
        return [jnp.where(jnp.isfinite(each.max(1)), each.argmax(1), reference.NONE) for each in worth]

    return dict(zip(names, map(np.asarray, jax.jit(jax.vmap(choose))(stacked)), strict=True))


def compare(names, limbs, count):
    random = np.random.default_rng(limbs)
    cases = [ground(random, limbs) for _ in range(count)]
    for name, found in chosen(names, cases).items():
        np.testing.assert_array_equal(found, [expected(name, case) for case in cases], err_msg=name)
        assert (found == reference.NONE).any() and len(np.unique(found)) == POINTS + 1


def test_rules_choose_as_their_references():
    compare(NAMES, 4, DEFAULT // len(NAMES))


def situation_of(case):
    return Situation(**{key: jnp.asarray(case[key]) for key in Situation._fields})


def test_a_limb_may_go_where_it_stands_and_not_where_another_one_does():
    case = ground(np.random.default_rng(0), 6)
    points = case["feet"][[0, 0, 2, 5, 4, 5]] + np.array([0, 0, 0, 0, 0.1, 0])[:, None]
    found = Nearest().apart(situation_of(case), jnp.asarray(points))
    np.testing.assert_array_equal(found, [True, False, True, False, True, True])


def test_resting_forces_bear_the_weight_with_the_least_squares():
    case = ground(np.random.default_rng(0), 6)
    stands = case["stands"] = np.array([True, False, True, True, False, True])
    feet, com, weight = case["feet"], case["center_of_mass"], case["weight"]
    own = np.asarray(jax.jit(resting_forces)(situation_of(case), feet))[stands]
    np.testing.assert_allclose(own.sum(0), -weight, atol=1e-9)
    np.testing.assert_allclose(np.cross(feet[stands] - com, own).sum(0), 0, atol=1e-9)
    np.testing.assert_allclose(own, reference.resting_forces(feet[stands], com, weight), atol=1e-9)


def test_a_foot_off_the_support_sags_most_and_pressing_or_two_feet_predict_nothing():
    """LF of a square that hangs: the opposite foot bears nothing, its neighbours half the weight, it would bear all."""
    feet = np.array([[0.1, 0.1, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.1, -0.1, 0]])
    case = ground(np.random.default_rng(0), 4) | {"feet": feet, "planned": feet, "stands": np.arange(4) > 0}
    case |= {"center_of_mass": np.array([0, 0, 0.1]), "weight": np.array([0, 0, 4.0])}
    forces, score = jax.jit(resting_forces), jax.jit(LeastUse().score)
    np.testing.assert_allclose(forces(situation_of(case), feet)[:, 2], [-4, -2, 0, -2], atol=1e-9)
    hold = Candidate(feet, jnp.asarray(8.0), jnp.array([0, 0, 1.0]))
    assert score(situation_of(case), hold)[0] == pytest.approx(-0.5)
    assert score(situation_of(case), hold._replace(pull=jnp.asarray(0.0)))[0] == 0
    assert score(situation_of(case | {"weight": np.array([0, 0, -4.0])}), hold)[0] == 0
    assert score(situation_of(case | {"stands": np.arange(4) > 1}), hold)[0] == 0


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("limbs", LIMBS.values(), ids=LIMBS)
def test_the_base_stands_over_the_reference_of_its_diagonals(limbs):
    random = np.random.default_rng(0)
    feet = np.array([ground(random, limbs)["feet"] for _ in range(NIGHTLY)])
    found = jax.jit(jax.vmap(middle_of))(jnp.array(feet))
    np.testing.assert_allclose(found, [reference.diagonals(each) for each in feet], atol=1e-9)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("limbs", LIMBS.values(), ids=LIMBS)
@pytest.mark.parametrize("name", NAMES)
def test_a_rule_chooses_as_its_reference_on_ten_thousand_grounds(name, limbs):
    compare([name], limbs, NIGHTLY)
