"""The neighbours that test a result, the stances that a loop is looked at in, pushes by bisection: by plain loops."""

import itertools
import math
import types

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.gait_values import TIMES
from tuning.comparisons import pushes, stability_limit, verification
from tuning.comparisons.side_by_side import differences
from tuning.gains.gains_file import by_name
from tuning.methods.gradient import CANDIDATES
from tuning.problem import spaces
from tuning.problem.evaluation import Evaluation, Problem
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search


def evaluated(asked):
    """An evaluation whose value is the sum of the coordinates, its slopes 1, 2, ...: what is asked is kept."""

    def evaluate(theta, directions=None):
        asked.append((theta, directions))
        count, along = len(theta), np.zeros((len(theta), 0 if directions is None else len(directions)))
        slopes = along if directions is None else along + np.asarray(directions) @ np.arange(1.0, theta.shape[1] + 1)
        feasible = np.ones(count, bool)
        return Evaluation(
            theta.sum(1), theta.sum(1), 0 * theta[:, 0], feasible, slopes, slopes, {"travel": theta[:, 0]}
        )

    return evaluate


def rounds_of(*rounds):
    """Return data of a search: so many points in each round, with derivatives or without."""
    counts, descents = zip(*rounds, strict=True)
    number = np.repeat(np.arange(len(rounds)), counts)
    norms = np.where(np.repeat(descents, counts), 1.0, np.nan)
    return xr.Dataset({"round": ("point", number), "gradient_norm": ("point", norms)})


@pytest.mark.parametrize("also", [(), ("gait.cycle", "gait.height")])
def test_neighbours_are_a_fifth_less_and_more_of_each_gain_and_within_the_bounds_of_a_gait(also, monkeypatch):
    """As many walk as searches have at least, over and over; the radius is that of the gains with their gait."""
    scenario = mc.load_scenario("case_1_2")
    space = spaces.space(scenario, Search(space="split", also=also))
    asked, looked = [], []
    monkeypatch.setattr(Problem, "evaluate", lambda self, *how: evaluated(asked)(*how))
    monkeypatch.setattr(stability_limit, "spectral_radius", lambda *how, **more: looked.append((how, more)) or 0.97)
    theta = space.upper - 1e-3
    gains = spaces.to_gains64(space, theta)
    problem = Problem(scenario, space)
    data = rounds_of((24, False), (3, True), (3, True))
    found = types.SimpleNamespace(theta=theta, problem=problem, walked=problem.with_gains(gains), data=data)
    told = verification.tests(found)
    expected = [theta]
    for factor in (0.8, 1.2):
        for place, name in enumerate(space.names):
            point = theta.copy()
            point[place] = point[place] * factor if space.units[place] > 0 else point[place] + math.log(factor)
            if name in also:
                point[place] = min(max(point[place], space.lower[place]), space.upper[place])
            expected.append(point)
    walked, directions = asked[0]
    assert directions is None and len(walked) == max(len(expected), CANDIDATES)
    for place, point in enumerate(walked):
        np.testing.assert_allclose(point, expected[place % len(expected)])
    assert told.around.value.shape == (len(expected),) and told.around.metrics["travel"].shape == (len(expected),)
    wanted = [
        math.nan if name in TIMES else (place + 1.0) * (theta[place] if space.units[place] > 0 else 1.0)
        for place, name in enumerate(space.names)
    ]
    np.testing.assert_allclose(told.slopes, wanted)
    assert len(asked[1][0]) == 3 and (asked[1][0] == theta).all()
    (((where, none), how),) = looked
    assert told.radius == 0.97 and how["law"] is None and none == {}
    np.testing.assert_allclose(where.control.stiffness, by_name(gains)["stiffness"])
    assert where.gait.cycle == (
        pytest.approx(np.exp(space.upper[space.names.index("gait.cycle")] - 1e-3)) if also else 4
    )


@pytest.mark.parametrize(
    ("rounds", "rows"),
    [([(24, False), (3, True)], 3), ([(3, True), (2, True), (1, True)], 1), ([(4, True), (9, False)], 4),
     ([(9, False)], 1)],
)  # fmt: skip
def test_slopes_are_those_of_as_many_points_as_a_search_descended_with_last(rounds, rows, monkeypatch):
    """Their program is there: one for another number of points would be compiled for them alone."""
    asked, scenario = [], mc.load_scenario("case_1_2")
    space = spaces.space(scenario, Search())
    monkeypatch.setattr(Problem, "evaluate", lambda self, *how: evaluated(asked)(*how))
    monkeypatch.setattr(stability_limit, "spectral_radius", lambda *_, **__: 0.97)
    problem = Problem(scenario, space)
    verification.tests(
        types.SimpleNamespace(theta=space.lower, problem=problem, walked=problem, data=rounds_of(*rounds))
    )
    assert [len(theta) for theta, directions in asked if directions is not None] == [rows]


def test_a_value_is_verified_alone_and_its_neighbours_relative_to_pds(monkeypatch):
    """The walk alone is scored; a neighbour counts by its change in shares of pd's value, or of 1 where that is 0."""
    goal = Objective((Term("force_variation", 1.0, 2.0, 2.0),), (Limit("base_deviation", 0.1, 0.1, 0.02, "own"),))
    scenario = mc.load_scenario("case_1_2")
    problem = Problem(scenario, spaces.space(scenario, Search()), goal)
    none = np.zeros((5, 0))
    value = np.array([0.5, 0.504, 0.56, 0.5, 0.62])
    around = Evaluation(value, value, 0 * value, np.ones(5, bool), none, none, dict.fromkeys(mc.METRICS.names, value))
    walk = {
        "diverged": False,
        "detached_limb": None,
        "detached_at": None,
        "force_variation": 1.2,
        "base_deviation": 0.0,
    }
    middle = (problem.space.lower + problem.space.upper) / 2
    shapes = {}
    for of_pd in (1.0, 10.0, 0.0, -0.4):
        found = types.SimpleNamespace(feasible=True, theta=middle, value=0.6, of_pd=of_pd, problem=problem)
        told = verification.verify(found, metrics=walk, tested=verification.Tests(around, np.ones(2), 0.9))
        assert (told.value, told.search_value, told.spectral_radius) == (pytest.approx(0.6), 0.6, 0.9)
        assert [*told.less.values()] == pytest.approx([0.004, 0.06]) and [*told.more.values()] == pytest.approx(
            [0, 0.12]
        )
        shapes[of_pd] = [*told.shape.values()]
    assert shapes == {1.0: ["plateau", "cliff"], 10.0: ["plateau", "slope"], 0.0: ["plateau", "cliff"],
                      -0.4: ["slope", "cliff"]}  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_stances_lie_between_any_two_changes_of_the_feet(seed, case):
    """Of gaits at random: steps are walked through one by one, and the times of the same feet are cut by periods."""
    rng = np.random.default_rng(seed)
    duty, cycle = rng.choice([0.75, 0.8, 0.9]), rng.choice([0.9, 2.0, 4.0])
    turn = case("case_1_2", "virtual_model", {"gait.duty": duty, "gait.cycle": cycle, "duration": 2.2 * cycle})
    steps, periods, uneven = (
        round(cycle / turn.time_step),
        np.array([1, int(rng.integers(2, 30)), int(rng.integers(60, 300))]),
        seed % 2 == 1,
    )
    found = stability_limit.linearised_at(turn, periods, uneven=uneven)
    air = []
    for step in range(steps):
        share = (step + 0.5) / steps
        air.append([lift <= share < lift + (1 - turn.gait.duty) for lift in turn.gait.lift_off.values()])
    begins = [0, *(step for step in range(1, steps) if air[step] != air[step - 1]), steps]
    groups = [[] for _ in periods]  # of steps of which one is enough
    for number in range(math.ceil(turn.steps / steps) if uneven else 1):
        for begin, end in itertools.pairwise(begins):
            begin, end = begin + number * steps, end + number * steps
            for row, period in enumerate(periods):
                within = [at for at in range(0, end, period) if at + period <= end - 1]
                inside, last = [at for at in within if at >= begin + 2], max(within, default=0)
                apart = [abs(at - (begin + end) / 2) for at in inside]
                middle = {at for at, far in zip(inside, apart, strict=True) if far == min(apart)}
                groups[row] += [{inside[0] if inside else last}, {last}, middle or {last}]
    for row, expected in enumerate(groups):
        own = set(found[row].astype(int).tolist())
        assert own <= set().union(*expected) and all(own & each for each in expected)


@pytest.mark.parametrize("seed", range(4))
def test_pushes_are_bisected_as_one_by_one(seed, monkeypatch, case):
    """Each draw has a force that it bears: nothing tried is between what is survived and what is lost."""
    rng = np.random.default_rng(seed)
    limit = rng.choice([0.5, 3.0, 20.0, 80.0], (6, 5)) * rng.uniform(0.7, 1.3, (6, 5))
    heading, tried = rng.uniform(-3, 3), []

    def walked(scenario, gains, parameters, **_):
        (push,) = parameters.disturbances[1:]
        size = np.linalg.norm(push.force, axis=-1)
        tried.append((size, push, parameters.at("hardware.seed")))
        lost = size > limit
        return {"peak_utilization": np.where(lost & (limit < 10), 2.0, 0.5), "diverged": (lost & (limit >= 10)) * 1.0}

    monkeypatch.setattr(mc, "rollout_metrics", walked)
    scenario = case("case_2", "pd", {"gait.heading": heading})
    how = {"lengths": (0.3,), "largest": 64.0, "draws": 5, "rounds": 4, "seed": seed}
    found = pushes.find(scenario, {"a": pushes.Walker(None, {})}, **how)
    for way in range(6):
        for draw in range(5):
            low, high = 1.0, 64.0
            if limit[way, draw] < low:
                low, high = 0.0, 1.0
            elif limit[way, draw] >= high:
                low, high = 64.0, math.inf
            else:
                for _ in range(4):
                    middle = math.sqrt(low * high)
                    low, high = (middle, high) if middle <= limit[way, draw] else (low, middle)
            own = found.isel(walker=0, length=0, direction=way, draw=draw)
            assert (own["survived"].item(), own["lost"].item()) == pytest.approx((low, high))
    assert [np.unique(size).size == 1 for size, *_ in tried[:2]] == [True, True]
    assert (tried[0][0].flat[0], tried[1][0].flat[0]) == pytest.approx((1.0, 64.0)) and len(tried) == 6
    ahead, left = [math.cos(heading), math.sin(heading), 0], [-math.sin(heading), math.cos(heading), 0]
    ways = {"up": [0, 0, 1], "down": [0, 0, -1], "ahead": ahead, "back": np.negative(ahead), "left": left,
            "right": np.negative(left)}  # fmt: skip
    for (size, push, seeds), name in ((each, name) for each in tried[:3] for name in ways):
        place = [*ways].index(name)
        np.testing.assert_allclose(push.force[0, place], size[0, place][:, None] * np.array(ways[name]), atol=1e-9)
        np.testing.assert_allclose(push.stop - push.start, 0.3)
        assert not push.moment.any() and seeds[0].ravel().tolist() == list(range(seed, seed + 30))
    start = tried[0][1].start
    assert (start >= 0.25).all() and (start <= scenario.duration - 0.3 - 0.5).all()
    np.testing.assert_allclose(1e3 * start, np.round(1e3 * start), atol=1e-9)
    assert np.any(np.round(1e3 * start) % 10)


def drawn(survived, lost):
    about = {"smallest": 1.0, "largest": 64.0}
    return xr.Dataset({"survived": ("draw", survived), "lost": ("draw", lost)}, attrs=about)


def test_the_force_that_a_share_survives_is_that_of_the_draw_which_is_lost_next():
    """Of ten draws half are lost beyond the sixth of them, 95 % beyond the first; the interval is of their ranks."""
    low = np.array([0, 1, 2, 4, 8, 8, 16, 32, 64, 64.0])
    high = np.array([1, 2, 4, 8, 16, 16, 32, 64, np.inf, np.inf])
    order = np.random.default_rng(0).permutation(10)
    half, most = (pushes.borne(drawn(low[order], high[order]), share) for share in (0.5, 0.95))
    assert half == (pytest.approx(math.sqrt(8 * 16)), low[1], high[8])
    assert most == (0.0, 0.0, high[2])
    bounded = drawn(low[5:8], high[5:8])
    assert pushes.borne(bounded, 0.95)[0] == pytest.approx(math.sqrt(8 * 16)) and pushes.borne(bounded, 0.0)[0] > 40
    assert pushes.borne(drawn(low[8:], high[8:]), 0.5) == (math.inf, 0.0, math.inf)
    ends = {math.inf: "more than 64 N, the largest tried", 0.0: "less than 1 N, the smallest tried"}
    for force, said in (ends | {11.0: "11 N"}).items():
        assert pushes.in_words(bounded, force) == said


def test_metrics_that_differ_are_told_as_a_loop_tells_them():
    """Whatever their kind, sign and size; nothing of walks that failed."""
    rng = np.random.default_rng(0)
    names = [name for name in mc.METRICS.names if name not in ("detached_limb", "detached_at", "stands_at", "diverged")]
    for number in range(40):
        base = {name: float(rng.choice([0.0, 1.0, -2.0, 3.0])) for name in names}
        ours = {name: value + float(rng.choice([0.0, 0.015, 0.05, -0.05, 2.0])) for name, value in base.items()}
        for name in rng.choice(names, 2, replace=False):
            (ours if number % 2 else base)[name] = [None, "x", True][number % 3]
        worse, better = [], []
        for name in names:
            if name == names[0] or any(not isinstance(each[name], float) for each in (ours, base)):
                continue
            if abs(ours[name] - base[name]) <= 0.02 * abs(base[name]):
                continue
            if base[name] > 0:
                percent = 100 * (ours[name] / base[name] - 1)
                text = f"{percent:+.1f} %" if abs(percent) < 100 else f"{percent:+.0f} %"
            else:
                text = f"{base[name]:.4g} to {ours[name]:.4g}"
            good = (ours[name] > base[name]) == mc.METRICS[name].larger_is_better
            (better if good else worse).append(f"{mc.METRICS.in_words(name)} {text}")
        assert differences(ours, base, but=(names[0],)) == (worse, better)
        assert differences(ours | {"diverged": True}, base) == differences(ours, base | {"stands_at": 1.0}) == ([], [])
