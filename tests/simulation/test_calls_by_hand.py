"""What a simulation hands to the walks of a batch and makes of their results, with sums of gains in place of walks."""

import itertools

import jax
import numpy as np
import pytest
from jax import Array

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.control import LoadTransfer, VirtualModelAdmittance
from mjx_climb.walk.metrics import METRICS
from mjx_climb.walk.sample import Sample, unknown

CASE = mc.load_scenario("case_1_2", {"duration": 0.3})
SLOPES = {
    "damping": np.arange(1.0, 7),
    "stiffness": 10 * np.arange(1.0, 7),
    "kp": 3.0,
    "kd": 5.0,
    "inertia": np.full(6, 0.5),
}
OF_METRICS = {"travel": 1.0, "min_tsm": -2.0}  # by how much each is the sum
REAL = [name for name in METRICS.names if name not in ("detached_limb", "missed_grips", "diverged")]


@pytest.fixture
def asked(monkeypatch):
    """Have walks whose metrics are multiples of the sum of the gains, each times its slope."""
    calls = []

    def run(function, structure, robots, **how):
        calls.append((function.__name__, structure, robots, how))
        shape = robots.shape
        first = robots.arguments[0]
        if not isinstance(first, dict):
            first = {name: np.asarray(getattr(first, name)) for name in first.GAINS}

        def along(value, slope):
            return (value * slope).sum(-1) if np.ndim(slope) else value * slope

        def whole(value, name, extra=()):
            return np.broadcast_to(along(value, SLOPES[name]), (*shape, *extra))

        total = sum(whole(value, name) for name, value in first.items())
        values = {name: share * total for name, share in OF_METRICS.items()}
        if robots.directions is not None:
            moved = sum(whole(value, name, (value.shape[len(shape)],)) for name, value in robots.directions.items())
            return values, {name: share * moved for name, share in OF_METRICS.items()}
        if robots.weights is not None:
            weight = sum(OF_METRICS[name] * value for name, value in robots.weights.items())
            return values, {name: np.multiply.outer(weight, SLOPES[name]) for name in first}
        return values

    monkeypatch.setattr(execution, "run", run)
    return calls


def drawn(*shapes):
    rng = np.random.default_rng(sum(map(len, shapes)))
    least = {"damping": 100.0, "stiffness": 1e4, "kp": 40.0, "kd": 0.2}
    return {name: low * rng.uniform(1, 2, shape) for (name, low), shape in zip(least.items(), shapes, strict=True)}


BATCHES = [
    ((2, 6), (2, 6), (2,), (2,)), ((6,), (3, 6), (), (3,)),
    ((2, 1, 6), (3, 6), (2, 3), ()), ((1, 6), (4, 6), (1,), (4,)),
]  # fmt: skip


@pytest.mark.parametrize("shapes", BATCHES)
def test_derivatives_of_a_batch_are_those_of_its_robots_one_by_one(shapes, asked):
    """Of gains with axes that others lack, the derivatives of all robots that share a value are summed."""
    gains = drawn(*shapes)
    leads = {name: value.shape[: value.ndim - np.ndim(SLOPES[name])] for name, value in gains.items()}
    batch = np.broadcast_shapes(*leads.values())
    simulation, k = mc.Simulation(CASE), 2
    rng = np.random.default_rng(3)
    weights = {name: rng.normal(size=(k, *batch)) for name in OF_METRICS}
    found = simulation.vjp(gains, weights, dtype=np.float64)
    assert asked[-1][0] == "metrics_of_moved" and asked[-1][3]["over_time"] is False
    assert set(found) == set(gains)
    for name, value in gains.items():
        expected = np.zeros((k, *value.shape))
        lead = leads[name]
        for row, robot in itertools.product(range(k), np.ndindex(batch)):
            own = robot[len(batch) - len(lead) :]
            place = tuple(0 if size == 1 else n for n, size in zip(own, lead, strict=True))
            weight = sum(share * weights[metric][row][robot] for metric, share in OF_METRICS.items())
            expected[(row, *place)] += weight * SLOPES[name]
        np.testing.assert_allclose(found[name], expected, rtol=1e-12, err_msg=name)
    ones = {name: (1,) * (len(batch) - len(lead)) for name, lead in leads.items()}
    directions = {name: rng.normal(size=(k, *ones[name], *value.shape)) for name, value in gains.items()}
    metrics, tangents = simulation.jvp(gains, directions, dtype=np.float64)
    for row, robot in itertools.product(range(k), np.ndindex(batch)):
        moved = 0.0
        for name, rate in directions.items():
            whole = np.broadcast_to(rate[row], (*batch, *rate.shape[1 + len(batch) :]))
            moved += np.sum(whole[robot] * SLOPES[name])
        for metric, share in OF_METRICS.items():
            assert tangents[metric][row][robot] == pytest.approx(share * moved), metric
    assert tangents["travel"].shape == (k, *batch) and metrics["travel"].shape == batch


def test_times_of_the_gait_have_no_derivative_and_gains_that_a_law_lacks_neither(asked):
    simulation = mc.Simulation(CASE)
    gains = {"damping": np.full((3, 6), 1e2), "gait.cycle": np.full(3, 8.0), "gait.duty": np.array(0.9)}
    found = simulation.vjp(gains, {"travel": np.ones((2, 3))}, dtype=np.float64)
    assert found["gait.cycle"].shape == (2, 3) and found["gait.duty"].shape == (2,)
    assert not found["gait.cycle"].any() and not found["gait.duty"].any() and found["damping"].all()
    assert set(asked[-1][2].arguments[0]) == {"damping"}


@pytest.mark.parametrize(
    ("weights", "said"),
    [
        ({"travl": np.ones((2, 3))},
         f"weights.travl: expected one of {', '.join(sorted(REAL))}, the metrics that are real numbers"),
        ({"diverged": np.ones((2, 3))}, "weights.diverged: expected one of "),
        ({"travel": np.ones(3)}, "weights: expected shapes (k, 3), got travel (3,)"),
        ({"travel": np.ones((2, 4))}, "weights: expected shapes (k, 3), got travel (2, 4)"),
        ({"travel": np.ones((2, 3)), "min_tsm": np.ones((1, 3))},
         "weights: expected shapes (k, 3), got travel (2, 3), min_tsm (1, 3)"),
        ({"travel": 1.0}, "weights: expected shapes (k, 3), got travel ()"),
        ({}, "weights: expected shapes (k, 3), got none"),
    ],
)  # fmt: skip
def test_weights_of_another_shape_or_metric_are_refused(weights, said, asked):
    with pytest.raises(ValueError) as refused:
        mc.Simulation(CASE).vjp({"damping": np.full((3, 6), 1e2)}, weights)
    assert str(refused.value).startswith(said) and not asked


def test_walks_get_the_options_that_are_asked_for(asked):
    """Metrics of the law's gains, in the precision and the shares of the call; histories over time."""
    simulation = mc.Simulation(CASE, VirtualModelAdmittance(np.ones(6), np.full(6, 2.0), np.full(6, 3.0)))
    seen = lambda *_: None  # noqa: E731
    found = simulation.metrics(dtype=np.float64, batch_size=7, progress=seen)
    function, structure, robots, how = asked[-1]
    assert function == "metrics_of" and how == {"over_time": False, "batch_size": 7, "progress": seen}
    assert robots.shape == () and {leaf.dtype for leaf in jax.tree.leaves(robots.arguments)} == {np.dtype(np.float64)}
    assert found["travel"] == pytest.approx(0.5 * 6 + 21 * 2 + 210 * 3) and structure.steps == CASE.steps
    simulation.metrics({"damping": np.ones((2, 6))})
    assert asked[-1][2].shape == (2,)
    assert {leaf.dtype for leaf in jax.tree.leaves(asked[-1][2].arguments)} == {np.dtype(np.float32)}
    simulation.histories()
    assert asked[-1][0] == "histories_of" and asked[-1][3]["over_time"] is True
    mc.rollout_metrics(CASE, {"damping": 1e2}, smooth=True, batch_size=3)
    assert asked[-1][3]["batch_size"] == 3 and "smooth_peak_foot_force" in asked[-1][1].metrics.names


def test_a_time_step_that_contacts_cannot_follow_walks_for_searches_alone(asked):
    stiff = mc.parameters(CASE).replace({"contact.stiffness": np.asarray(1e9)})
    simulation = mc.Simulation(CASE)
    with pytest.raises(mc.ConfigError, match="time_step"):
        simulation.metrics(parameters=stiff)
    assert not asked
    simulation.metrics(parameters=stiff, unsteady=True)
    assert len(asked) == 1


@pytest.fixture
def begun(monkeypatch):
    """Have walks whose samples are zeros, but for a base as far ahead as the number of its part; return the calls."""
    calls = []

    def run_one(function, structure, law, parameters, time_step, *more):
        calls.append((function.__name__, structure, law, parameters, time_step, more))
        if function.__name__ == "begun":
            return 0
        made = unknown(structure.steps, {"limb": 4, "joint": 3})
        made["base_position"] = np.full_like(made["base_position"], more[0])
        return more[0] + 1, Sample(**made)

    monkeypatch.setattr(execution, "run_one", run_one)
    return calls


def test_a_rollout_says_what_it_walked(begun):
    """Gains of the paper's laws on six axes; the parameters without the joint gains; the scenario with the gait."""
    simulation = mc.Simulation(CASE)
    gains = {"damping": 7.0, "kp": 40.0, "gait.cycle": 2.0, "gait.duty": 0.8}
    walk = simulation.rollout(gains, mc.parameters(CASE).replace({"contact.stiffness": np.asarray(9e3)}))
    assert (walk.law, walk.limbs, walk.time.shape) == ("", ("LF", "LH", "RH", "RF"), (300,))
    assert walk.scenario == CASE.with_overrides({"gait.cycle": 2.0, "gait.duty": 0.8, "gait.stride": 0.025})
    np.testing.assert_array_equal(walk.gains.damping, np.full(6, 7.0))
    np.testing.assert_array_equal(walk.gains.stiffness, np.full(6, CASE.control.stiffness))
    assert (walk.gains.kp, walk.gains.kd) == (40.0, None)
    own = {"control.kp": CASE.control.kp, "contact.stiffness": 9e3, "gait.cycle": 2.0, "gait.stride": 0.025}
    for path, value in own.items():
        assert walk.parameters.at(path) == pytest.approx(value), path
    walked = begun[-1][3]
    assert (walked.at("control.kp"), walked.at("contact.stiffness")) == (40.0, 9e3)
    np.testing.assert_array_equal(begun[-1][2].damping, np.full(6, 7.0))
    single = simulation.rollout(dtype=np.float32)
    leaves = [*jax.tree.leaves(begun[-1][3]), *jax.tree.leaves(single.parameters), begun[-1][4]]
    assert {leaf.dtype for leaf in leaves} == {np.dtype(np.float32)}
    own = mc.Simulation(CASE, LoadTransfer()).rollout({"leak": 0.5})
    assert own.law == "LoadTransfer" and {*own.gains} == {*LoadTransfer.GAINS} and own.gains["leak"] == 0.5
    with pytest.raises(ValueError, match=r"^rollout walks one robot: for a batch of gains or parameters use rollout_m"):
        simulation.rollout({"kp": np.full(1, 50.0)})


def test_a_rollout_is_made_of_parts_under_the_targets_of_each(begun):
    """The last part goes on with the last targets, and is cut where the walk ends."""
    case = CASE.with_overrides({"duration": 4.5, "gait.cycle": 4.5})
    targets = np.arange(4500.0)[:, None, None] + np.zeros((4, 3))
    walk = mc.Simulation(case).rollout(targets=targets)
    assert walk.law == "JointTargets" and walk.time.shape == (4500,)
    assert [(name, structure.steps, structure.time_step) for name, structure, *_ in begun] == [
        ("begun", 2000, 0.0), *[("next_samples", 2000, 0.0)] * 3
    ]  # fmt: skip
    for part, (*_, time_step, (carry, first, under)) in enumerate(begun[1:]):
        assert (carry, first, time_step) == (part, 2000 * part, 0.001)
        np.testing.assert_array_equal(under[:, 1, 2], np.minimum(2000 * part + np.arange(2000), 4499))
    np.testing.assert_array_equal(walk.base_position[:, 0], np.arange(4500) // 2000)
    with pytest.raises(ValueError, match=r"^targets: expected shape \(4500, 4, 3\), got \(4499, 4, 3\)$"):
        mc.Simulation(case).rollout(targets=targets[1:])
    looks = case.with_overrides({"control.recovery.shift": 0.1, "gait.planning_period": 0.9})
    begun.clear()
    mc.Simulation(looks).rollout()
    # as many whole planning periods as fit into a part
    assert [structure.steps for _, structure, *_ in begun] == [1800] * 4


class Recovering(VirtualModelAdmittance):
    recovery_lead_time: Array = mc.gain("s", shape=(), bounds=(0.01, 1.0), default=0.2)


GIVEN = {
    "of the law": {"damping": np.full((3, 6), 1e2)},
    "none": None,
    "of the joint loop": {"kp": np.full(3, 50.0), "ki": 1.0},
    "of the gait": {"gait.duty": np.array([0.8, 0.9, 0.85]), "gait.sway": 0.1},
}


@pytest.mark.parametrize("law", [None, Recovering()], ids=["plain", "recovering"])
@pytest.mark.parametrize("gains", GIVEN.values(), ids=GIVEN)
def test_walks_under_a_simulations_own_parameters_are_those_under_the_same_given(gains, law, monkeypatch):
    """With gains of all kinds, in both precisions, and again."""
    asked = []
    monkeypatch.setattr(execution, "run", lambda *given, **how: asked.append(given) or {})
    own = mc.parameters(CASE).replace(
        {"contact.stiffness": np.array([[4e3], [5e3]]), "control.kd": np.full((2, 1), 0.3)}
    )
    held, open_ = mc.Simulation(CASE, law, parameters=own), mc.Simulation(CASE, law)
    for dtype in (np.float32, np.float64, np.float32):
        held.metrics(gains, dtype=dtype, unsteady=True)
        open_.metrics(gains, own, dtype=dtype, unsteady=True)
        (_, structure, robots), (_, expected, wanted) = asked[-2:]
        assert structure == expected and robots.shape == wanted.shape == np.broadcast_shapes((2, 1), robots.shape)
        jax.tree.map(np.testing.assert_array_equal, robots.arguments, wanted.arguments)
        assert jax.tree.leaves(robots.axes) == jax.tree.leaves(wanted.axes)
