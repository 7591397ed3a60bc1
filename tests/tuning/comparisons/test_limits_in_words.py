"""Which limits a walk breaks, which hold it where it is, and what breaks off beside it."""

import types

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tuning.command_line.session import Compilation
from tuning.comparisons import maps, verification
from tuning.comparisons.verification import binding_limits, broken_limits, verify
from tuning.problem import spaces
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search

PULL = Limit("peak_pull_force", 40.0, 40.0, 0.02, "holding limit of the grippers")
MARGIN = Limit("joint_limit_margin", 0.0, 0.1, 0.02, "joint limits", larger_is_better=True)
TARGET = Objective((), (PULL, MARGIN))
HELD = {"diverged": False, "detached_limb": None, "detached_at": None}


@pytest.mark.parametrize(
    "pull, margin, broken, binding",
    [
        (39.18, 0.4, [], ["peak pull force 39.18, limit 40 (holding limit of the grippers)"]),
        (30.0, 0.002, [], ["joint limit margin 0.002, limit 0 (joint limits)"]),
        (30.0, 0.4, [], []),
        # a limit holds from 1.25 of 2 % of its scale on, and is kept where it is met
        (39.01, 0.4, [], ["peak pull force 39.01, limit 40 (holding limit of the grippers)"]),
        (38.99, 0.4, [], []),
        (
            40.0,
            0.0,
            [],
            [
                "peak pull force 40, limit 40 (holding limit of the grippers)",
                "joint limit margin 0, limit 0 (joint limits)",
            ],
        ),
        (41.0, -0.01, ["peak pull force 41, limit 40", "joint limit margin -0.01, limit 0"], []),
        (None, 0.4, [], []),
    ],
)
def test_limits_are_named(pull, margin, broken, binding):
    metrics = {**HELD, "peak_pull_force": pull, "joint_limit_margin": margin}
    assert binding_limits(TARGET, metrics) == binding
    found = broken_limits(TARGET, metrics)
    assert len(found) == len(broken) and all(map(str.startswith, found, broken))


def test_a_torn_gripper_and_a_walk_that_diverged_are_named():
    torn = {"diverged": False, "detached_limb": "LF", "detached_at": 1.5, "peak_pull_force": 1, "joint_limit_margin": 1}
    assert broken_limits(TARGET, torn) == ["limb LF let go at 1.500 s"]
    assert broken_limits(TARGET, torn | {"diverged": True}) == ["the walk diverged"]
    near = torn | {"peak_pull_force": 39.9}
    assert binding_limits(TARGET, near | {"diverged": True}) == [] != binding_limits(TARGET, near)


def test_a_cliff_is_named_by_what_breaks_off():
    """Less of the first gain breaks a limit, of the second it costs much; more of the third makes the walk diverge."""
    goal = Objective((Term("force_variation", 1.0, 2.0, 2.0),), (PULL,))
    problem = Problem(mc.Scenario(), spaces.space(mc.Scenario(), Search(space="split")), goal)
    names, n = problem.space.names, problem.space.size
    value, pull = np.full((2, 1 + 2 * n), [[0.5], [30.0]])
    pull[1], value[2], value[n + 3] = 45.0, 0.9, np.nan
    feasible, none = np.isfinite(value) & (pull < 40), np.zeros((1 + 2 * n, 0))
    metrics = dict.fromkeys(mc.METRICS.names, np.zeros(1 + 2 * n)) | {"peak_pull_force": pull}
    around = Evaluation(value, value, np.zeros(1 + 2 * n), feasible, none, none, metrics)
    theta = (problem.space.lower + problem.space.upper) / 2
    found = types.SimpleNamespace(feasible=True, theta=theta, value=0.5, of_pd=1.0, problem=problem)
    walk = {**HELD, "peak_pull_force": 30.0, "force_variation": 1.0}
    checked = verify(found, metrics=walk, tested=verification.Tests(around, np.zeros(n), 0.99))
    assert [checked.shape[name] for name in names] == ["cliff", "cliff", "cliff", "plateau"]
    said = f"{names[0]} (less: peak pull force beyond the limit), {names[1]} (less: objective +0.40), "
    assert [line for line in checked.warnings if "cliff" in line] == [
        f"cliff within 20% of {said}{names[2]} (more: the walk diverges)"
    ]
    lost = around._replace(value=np.full(1 + 2 * n, 0.5), feasible=np.zeros(1 + 2 * n, bool))
    besides = verify(found, metrics=walk, tested=verification.Tests(lost, np.zeros(n), 0.99))
    assert set(besides.shape.values()) == {"plateau"}  # where the result breaks a limit itself, so may its neighbours


def test_each_doubt_about_a_result_is_a_warning_of_its_own():
    """Flat or steep to either side, gains without response, bounds, a better grid, an unstable loop, rounding."""
    goal = Objective((Term("force_variation", 1.0, 2.0, 2.0),), (PULL,))
    problem = Problem(mc.Scenario(), spaces.space(mc.Scenario(), Search(space="split")), goal)
    names, n = problem.space.names, problem.space.size
    # less of each, then more
    value = np.array([0.5, 0.505, 0.49, 0.5, 0.35, 0.505, 0.515, 0.59, 0.5])
    force = 1 + np.array([0, 0.01, 0, 0.0005, 0.01, 0, 0.01, 0.0009, 0.01])
    metrics = dict.fromkeys(mc.METRICS.names, np.zeros(1 + 2 * n)) | {"force_variation": force}
    feasible, none = np.arange(1 + 2 * n) != 6, np.zeros((1 + 2 * n, 0))
    around = Evaluation(value, value, 0 * value, np.ones(1 + 2 * n, bool), none, none, metrics)
    theta = (problem.space.lower + problem.space.upper) / 2
    theta[1] = problem.space.upper[1]
    found = types.SimpleNamespace(feasible=True, theta=theta, value=0.5, of_pd=1.0, problem=problem)
    cells = {"objective": ("stiffness", [0.52, 0.45, 0.4]), "feasible": ("stiffness", [True, True, False])}
    grid = xr.Dataset(cells, {"stiffness": [1.0, 2.0, 3.0]})

    def checked(around=around, radius=1.0, force=1.0, **changes):
        own = types.SimpleNamespace(**vars(found) | changes)
        walk = {**HELD, "peak_pull_force": 30.0, "force_variation": force}
        return verify(own, metrics=walk, walks=grid, tested=verification.Tests(around, np.arange(n), radius))

    first = checked()
    assert [first.shape[name] for name in names] == ["plateau", "slope", "slope", "slope"]
    assert [first.less[name] for name in names] == pytest.approx([0.005, -0.01, 0.0, -0.15])
    assert [first.more[name] for name in names] == pytest.approx([0.005, 0.015, 0.09, 0.0])
    assert (first.value, first.grid_value, first.grid_gains) == (0.5, 0.45, {"stiffness": 2.0})
    assert list(first.slopes.values()) == [0, 1, 2, 3] and first.passed
    assert first.warnings == [
        f"{names[1]} lies on a bound: widen bounds.{names[1]}",
        f"{names[2]}: no metric responds to it here (less than 0.1% for 20%)",
        "a coarse grid found better: 0.4500 at stiffness 2",
    ]
    # by rounding alone a grid finds nothing better
    assert "coarse grid" not in " ".join(checked(value=0.45005).warnings)
    broken = checked(around._replace(feasible=feasible))
    assert broken.more[names[1]] is None and broken.shape[names[1]] == "cliff" and broken.less[names[1]] is not None
    beyond = checked(around._replace(value=np.where(np.arange(1 + 2 * n) == 7, 0.61, value)))
    assert beyond.shape[names[2]] == "cliff"
    more = {
        "the closed loop is unstable in a stance of the gait: a disturbance grows by 1.001000 a step": {
            "radius": 1.001
        },
        "alone in float64 the objective is 0.5200, in the search 0.5000": {"force": 1.04},
        "alone in float64 the objective is 0.4800, in the search 0.5000": {"force": 0.96},
        "no point of the search keeps every limit: these gains are the nearest to it": {"feasible": False},
    }
    for line, changes in more.items():
        assert {*checked(**changes).warnings} - {*first.warnings} == {line}
    # what pd's value is not 1 of is relative to it
    assert set(checked(of_pd=100.0).shape.values()) == {"plateau"}


def test_times_of_a_gait_have_no_slope_and_limbs_in_turn_cannot_stand_less():
    """A duty on its bound is no reason to widen that, another value of the gait is."""
    settings = Search(space="isotropic", also=("gait.cycle", "gait.duty", "gait.height"))
    space, goal = spaces.space(mc.Scenario(), settings), Objective((Term("force_variation", 1.0, 2.0, 2.0),), ())
    count = 1 + 2 * len(space.parts)
    value, none = np.full(count, 0.5), np.zeros((count, 0))
    around = Evaluation(value, value, 0 * value, np.ones(count, bool), none, none,
                        {"force_variation": np.arange(1.0, count + 1)})  # fmt: skip
    problem = Problem(mc.Scenario(), space, goal, metrics=mc.MetricTable([mc.METRICS["force_variation"]]))
    found = types.SimpleNamespace(feasible=True, theta=space.lower, value=0.5, of_pd=1.0, problem=problem)
    tested = verification.Tests(around, np.ones(len(space.parts)), 0.9)
    checked = verify(found, metrics={**HELD, "force_variation": 1.0}, tested=tested)
    assert [*checked.shape] == [*space.parts] == ["damping", "stiffness", "gait.cycle", "gait.duty", "gait.height"]
    assert [*checked.slopes] == ["damping", "stiffness", "gait.height"]
    wider = {name: "" if name == "gait.duty" else f": widen bounds.{name}" for name in space.parts}
    assert checked.warnings == [f"{name} lies on a bound{more}" for name, more in wider.items()]


def test_the_cells_of_a_map_have_the_scores_of_a_search(monkeypatch):
    """There is none beyond all bounds; a walk that let go keeps no limit, however its numbers are."""
    dims, shape = ("damping", "stiffness"), (2, 2)
    data = {name: (dims, np.zeros(shape)) for name in mc.METRICS.names}
    data["force_variation"] = (dims, [[1.0, 3.0], [np.inf, 1.5]])
    data["peak_pull_force"] = (dims, [[30.0, 41.0], [np.inf, 30.0]])
    data["diverged"] = (dims, np.zeros(shape, bool))
    data["detached_at"] = (dims, [[np.nan, np.nan], [np.nan, 0.2]])
    data["line"] = (("extreme", *dims), np.zeros((2, *shape)))
    walks = xr.Dataset(data, {"damping": [5.0, 7.0], "stiffness": [1e3, 2e3]}).transpose("extreme", ...)
    goal, asked = Objective((Term("force_variation", 1.0, 2.0, 2.0),), (PULL,)), []
    problem = Problem(mc.Scenario(), None, goal)
    monkeypatch.setattr(maps, "problem_of", lambda *given, **how: asked.append((given, how)) or problem)
    search = Search(seed=3)
    found = maps.with_objective(walks, mc.Scenario(), search, law="law")
    assert asked == [((mc.Scenario(), search), {"law": "law"})]
    np.testing.assert_allclose(found["objective"], [[0.5, 1.5], [np.nan, 0.75]])
    assert found["feasible"].values.tolist() == [[True, False], [False, False]]
    assert maps.best_cell(found)["stiffness"] == 1e3
    assert maps.best_cell(found.assign(feasible=found["feasible"] & False)) is None


def test_a_walk_without_a_metric_that_counts_keeps_no_limit():
    goal = Objective((Term("cost_of_transport", 1.0, 2.0, 2.0),), ())
    missing, there = (maps.score_of(goal, {**HELD, "cost_of_transport": cost}) for cost in (None, 3.0))
    assert not missing.feasible and not missing.value < np.inf
    assert there.feasible and there.value == 1.5


def test_the_scores_of_several_walks_are_compiled_once():
    goal = Objective((Term("cost_of_transport", 1.0, 2.0, 2.0),), ())
    maps.score_of(goal, {**HELD, "cost_of_transport": 3.0})
    with Compilation() as watched:
        assert maps.score_of(goal, {**HELD, "cost_of_transport": 5.0}).value == 2.5
    assert watched.seconds == {}


@pytest.mark.parametrize(("law", "settings", "names"), [
    (None, {"space": "split"}, ["stiffness", "damping"]),
    (None, {"pins": {"damping": 20.0}, "also": ("gait.cycle", "gait.duty")}, []),
    (None, {"pins": {"damping": 20.0}, "inertia": True}, []),  # of the paper's gains these two
    (mc.control.LoadTransfer(), {}, ["normal_damping", "tangential_damping"]),
])  # fmt: skip
def test_a_map_has_the_first_two_gains_over_the_whole_of_their_bounds(law, settings, names):
    space = spaces.space(mc.Scenario(), Search.make(settings), law)
    box = verification.axes_of(space, law)
    assert list(box) == names
    for kind, values in box.items():
        own = [spaces.kind_of(name) == kind for name in space.names]
        low, high = np.exp([space.lower[own].min(), space.upper[own].max()])
        np.testing.assert_allclose(values, np.geomspace(low, high, 12))


def test_slopes_of_a_result_are_by_the_size_of_a_gain():
    """A gain's is by its logarithm, an array's that of all its entries; along times of the gait there is none."""
    smooth, units = np.array([True, False, True, True]), np.array([0.0, 0.0, 2.0, 3.0])
    parts = {"a": [0], "gait.cycle": [1], "array": [2, 3]}
    space = types.SimpleNamespace(size=4, smooth=smooth, units=units, parts=parts)

    def evaluate(theta, directions):
        return types.SimpleNamespace(sharp=(np.array([1.0, 10.0, 100.0, 1000.0]) @ directions.T)[None])

    problem = types.SimpleNamespace(space=space, evaluate=evaluate)
    found = verification.slopes_at(problem, np.array([0.5, 2.0, 3.0, -2.0]))
    np.testing.assert_allclose(found, [1.0, np.nan, 3 * 100 - 2 * 1000])
