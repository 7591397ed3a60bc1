"""The points that methods ask for, against the same rules written a second time, one start after the other."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

import mjx_climb as mc
from tuning.methods import gradient, grid, many_variables, rounds
from tuning.methods.gradient import Leg, Pace, by_adam
from tuning.methods.many_variables import Evaluated, descend
from tuning.methods.method import Function, Request, Task
from tuning.problem.evaluation import Evaluation
from tuning.problem.search import Search
from tuning.problem.spaces import Space, kind_of


class Row:
    """Adam of one start in loops: https://arxiv.org/abs/1412.6980, with the way back to the best point."""

    def __init__(self, x, moves, memory, patience, tiny, scale):
        self.memory, self.patience, self.tiny, self.scale = memory, patience, tiny, scale
        self.best, self.least, self.there, self.waited = np.array(x), np.inf, np.zeros(moves), 0
        self.forget()

    def forget(self):
        self.mean = self.square = 0.0
        self.count = 0

    def step(self, x, merit, slopes, lost):
        if not lost and merit < self.least:
            self.best, self.least, self.there, self.waited = x, merit, slopes, 0
        else:
            self.waited += 1
        if lost or self.waited >= self.patience:
            self.waited = 0
            if np.isfinite(self.least):
                self.scale *= 0.5
            self.forget()
            x, slopes = self.best, self.there
        first, second = self.memory
        self.count += 1
        self.mean = first * self.mean + (1 - first) * slopes
        self.square = second * self.square + (1 - second) * slopes**2
        mean, square = self.mean / (1 - first**self.count), self.square / (1 - second**self.count)
        return x, self.scale * mean / (np.sqrt(square) + self.tiny)


# --- many variables


def valley(x, sharp):
    """Merits of rows (B, 3): bowls, of which a region diverges, another has no slopes; true extremes bend otherwise."""
    scale = np.array([1.0, 3.0, 0.2])
    merit = (scale * (x - 0.5) ** 2).sum(1) + 0.3 * np.sin(9 * x[:, 0])
    slopes = 2 * scale * (x - 0.5) + np.where(sharp, 0.3 * 9, 0.1)[..., None] * np.cos(9 * x[:, :1]) * [1.0, 0, 0]
    merit = np.where(x[:, 1] > 1.1, np.nan, merit)
    slopes = np.where(x[:, 2:] < -1.0, np.inf, slopes)
    return Evaluated(merit, slopes)


@pytest.mark.parametrize("known", [False, True])
def test_a_descent_in_many_variables_is_that_of_each_problem_alone(known):
    """Of rows that walk well, that overshoot, that are lost at once and that lose their slopes."""
    rng, count = np.random.default_rng(3), 33
    starts = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, -0.9], [0.2, 1.2, 0.0], [-1.0, 1.05, 0.5], *rng.normal(size=(3, 3))])
    merits = rng.normal(0.3, 0.1, len(starts)) if known else None
    asked = []

    def evaluate(x, sharp):
        asked.append((x.copy(), sharp))
        return valley(x, sharp)

    found = descend(evaluate, starts, count, step=0.6, known=merits)
    assert len(asked) == count
    outside = 0
    for n, x in enumerate(starts):
        row = Row(x, 3, (0.9, 0.97), 8, 1e-30, 1.0)
        if known:
            row.least = merits[n]
        for number in range(count - 1):
            rate = 0.6 * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * number / count)))
            np.testing.assert_allclose(asked[number][0][n], x, rtol=1e-9, atol=1e-12, err_msg=f"{n} {number}")
            assert asked[number][1] == (number >= 0.6 * count)
            each = valley(x[None], number >= 0.6 * count)
            slopes, merit = each.slopes[0], each.merit[0]
            lost = not (np.isfinite(merit) and np.isfinite(slopes).all())
            outside += lost
            slopes = np.zeros(3) if lost else slopes
            if number == 0:
                row.there, begun, first = slopes, slopes, merits[n] if known else merit
            x, step = row.step(x, merit, slopes, lost)
            x = x - rate * step
        np.testing.assert_allclose(found.x[n], row.best, rtol=1e-9)
        np.testing.assert_allclose(found.merit[n], row.least, rtol=1e-9)
        np.testing.assert_allclose(found.first[n], first)
        ending = np.linalg.norm(valley(row.best[None], 0).slopes) / max(np.linalg.norm(begun), 1e-300)
        np.testing.assert_allclose(found.slope[n], ending, rtol=1e-9)
    assert outside > 5


# --- gains


def boxed(names, lower, upper):
    """A space of logarithms of gains."""
    count = len(names)
    index = {name: np.array([n for n in range(count) if kind_of(names[n]) == name]) for name in map(kind_of, names)}
    return Space(tuple(names), np.array(lower, float), np.array(upper, float), np.zeros(count), index, np.zeros(0))


SIX = boxed([f"{gain}.{axis}" for gain in ("stiffness", "damping") for axis in "xyz"], [-2.0] * 6, [3.0] * 6)
GOAL = np.array([2.4, -1.0, 1.5, 0.0, 0.2, -0.3])


def hills(theta, directions):
    """An evaluation of points: a bowl with a cliff, beyond which walks diverge or values are out of all proportion."""
    bowl = 0.3 * ((theta - GOAL) ** 2).sum(1)
    value = np.where(theta[:, 0] > 2.5, bowl + 200, bowl)
    descent = np.where(theta[:, 1] > 2.6, np.nan, value + 0.1)
    penalty = np.maximum(theta[:, 2] - 2, 0.0)
    slope = 0.6 * (theta - GOAL)
    true = slope + np.where(theta[:, 2] > 2, 1.0, 0.0)[:, None] * np.eye(theta.shape[1])[2]
    true[:, 3] += 0.3
    along = np.zeros((0, theta.shape[1])) if directions is None else directions
    slope = np.where(theta[:, 4:5] > 2.7, np.nan, slope)
    return Evaluation(value, descent, penalty, penalty <= 0, slope @ along.T, true @ along.T, {})


def descents(leg, space, answer, seed):
    """What `by_adam` should ask for, of each iteration (B, n), by loops over its rows."""
    rng, rows = np.random.default_rng(seed), []
    theta, ties, count, pace, scales = leg
    own = [Row(x, len(ties), (0.8, pace.memory), pace.patience, 1e-8, s) for x, s in zip(theta, scales, strict=True)]
    values, asked = [math.inf] * len(theta), []
    strides = space.strides
    for number in range(count):
        rate = pace.rate * (pace.last + (1 - pace.last) * 0.5 * (1 + math.cos(math.pi * number / count)))
        asked.append(np.array(theta))
        found, rows, homeless = answer(np.array(theta), ties), [], []
        for n, row in enumerate(own):
            slopes = (found.gradient if number < pace.smooth * count else found.sharp)[n]
            merit = found.merit[n]
            over = found.value[n] > values[n] + 10 * max(1.0, abs(values[n]))
            lost = over or not (np.isfinite(found.descent[n]) and np.isfinite(slopes).all())
            if not lost and merit < row.least:
                values[n] = found.value[n]
            slopes = np.zeros(len(ties)) if lost else slopes * min(1.0, 5.0 / max(np.linalg.norm(slopes), 1e-12))
            x, step = row.step(theta[n], merit, slopes, lost)
            way = sum(rate * length * tie for length, tie in zip(step, ties, strict=True)) * strides
            rows.append(np.clip(x - way, space.lower, space.upper))
            homeless.append(lost and math.isinf(row.least))
        if any(homeless):
            drawn = space.draw_tied(rng, len(theta))
            for n in range(len(theta)):
                if homeless[n]:
                    rows[n] = drawn[n]
                    own[n].forget()
        theta = rows
    return asked


# numbers of an array move together as far as one gain
ARRAY = boxed(["w.0", "w.1", "w.2", "w.3", "damping.x", "damping.y"], SIX.lower, SIX.upper)


@pytest.mark.parametrize(("space", "tied"), [(SIX, False), (SIX, True), (ARRAY, False)])
def test_descents_of_gains_are_those_of_each_start_alone(space, tied):
    """Starts on the good side, at the cliffs, beyond them at once, and with scales of their own."""
    rng = np.random.default_rng(1)
    starts = np.concatenate([SIX.draw(rng, 5), [[2.9] * 6, [0.5, 2.9, 0, 0, 2.9, 0], [2.4, 2.5, 1.9, 0, 2.6, 0]]])
    pace = Pace("some", rate=0.9, last=0.2, smooth=0.6, memory=0.9, patience=3)
    ties = space.ties if tied else np.eye(6)
    leg = Leg(starts, ties, 14, pace, np.linspace(0.5, 1.5, len(starts)))
    asked, away = [], 0

    def answer(request):
        nonlocal away
        assert request.phase == "some"
        np.testing.assert_array_equal(request.directions, ties)
        found = hills(request.theta, request.directions)
        away += int((~found.alive | (found.value > 100)).sum())
        asked.append(request.theta)
        return found

    points = by_adam(SimpleNamespace(problem=SimpleNamespace(space=space)), leg, np.random.default_rng(7))
    rounds.follow(points, answer)
    wanted = descents(leg, space, hills, 7)
    np.testing.assert_allclose(asked, wanted, rtol=1e-9, atol=1e-12)
    assert away > 2


def test_a_descent_whose_points_walk_without_a_gradient_is_refused():
    """Not where no point walks at all."""
    leg = Leg(SIX.draw(np.random.default_rng(0), 2), np.eye(6), 3, gradient.SINGLE, np.ones(2))
    task = SimpleNamespace(problem=SimpleNamespace(space=SIX))

    def answer(alive):
        def of(request):
            found = hills(np.zeros((2, 6)), np.eye(6))
            descent = found.descent if alive else found.descent * np.nan
            return found._replace(descent=descent, gradient=found.gradient * np.nan, sharp=found.sharp * np.nan)

        return of

    with pytest.raises(mc.ConfigError, match="cmaes or grid, as no point that walks has a finite gradient"):
        rounds.follow(by_adam(task, leg, np.random.default_rng(0)), answer(alive=True))
    rounds.follow(by_adam(task, leg, np.random.default_rng(0)), answer(alive=False))


def requests(method, task, answer=hills):
    """All requests of a method."""
    asked = []

    def evaluate(request):
        asked.append(request)
        return answer(request.theta, request.directions)

    rounds.follow(method.run(task), evaluate)
    return asked


@pytest.mark.parametrize(("starts", "iterations", "known"), [(None, None, 2), (1, 5, 0), (4, 3, 1)])
def test_the_stages_of_a_search_by_gradients(starts, iterations, known):
    """Random points with the known ones before them, all axes tied, a race of the two best, the winner alone."""
    rng = np.random.default_rng(5)
    task = Task(SimpleNamespace(space=SIX), Search(starts=starts, iterations=iterations, seed=3), SIX.draw(rng, 1)[0],
                SIX.draw(rng, known))  # fmt: skip
    asked = requests(gradient.METHOD, task)
    lengths = [(phase, len([*each])) for phase, each in itertools.groupby(request.phase for request in asked)]
    count = starts or 3
    wanted = [("random points", 1)] if count > 1 else []
    wanted += [("axes tied", 12), ("axes free", 10), ("winner alone", iterations or 64)]
    assert lengths == wanted and gradient.METHOD.rounds(task) == len(asked)
    if count > 1:
        first, *asked = asked
        drawn = SIX.draw_tied(np.random.default_rng(3), 12 * (count - 1))
        drawn[:known] = task.others
        np.testing.assert_array_equal(first.theta, drawn)
        assert first.directions is None
        best = drawn[np.argsort(hills(drawn, None).merit)[: count - 1]]
        np.testing.assert_array_equal(asked[0].theta, [task.start, *best])
    legs = asked[:12], asked[12:22], asked[22:]
    for before, after, most in ((legs[0], legs[1], min(count, 2)), (legs[1], legs[2], 1)):
        points = np.array([request.theta for request in before])
        merits = np.array([hills(each, None).merit for each in points])
        ends = sorted((merits[:, n].min(), n) for n in range(points.shape[1]))
        expected = [points[merits[:, n].argmin(), n] for _, n in ends[:most]]
        np.testing.assert_array_equal(after[0].theta, expected)
    for leg, pace, scales in ((legs[1], gradient.RACE, [1.0, 0.5]), (legs[2], gradient.ALONE, [1.0])):
        own = Leg(leg[0].theta, np.eye(6), len(leg), pace, np.array(scales[: len(leg[0].theta)]))
        np.testing.assert_allclose([each.theta for each in leg], descents(own, SIX, hills, 0), rtol=1e-9, atol=1e-12)


def test_an_isotropic_space_has_one_stage_and_searches_once_more_shorter_steps():
    both = boxed(["stiffness", "damping"], [-2, -2], [3, 3])
    task = Task(SimpleNamespace(space=both), Search(starts=1), np.zeros(2))
    assert gradient.iterations(task) == (20,) and gradient.METHOD.rounds(task) == 20
    assert {request.phase for request in requests(gradient.METHOD, task, lambda t, d: two(t, d))} == {"descent"}
    wanted = {(0, 6): (2, 0.5), (1, 6): (6, 0.3), (2, 6): (6, 0.18), (1, 2): (2, 0.3)}
    for (number, size), (directions, scale) in wanted.items():
        space, own = (SIX, hills) if size == 6 else (both, two)
        problem = SimpleNamespace(problem=SimpleNamespace(space=space))
        asked, theta = [], space.draw(np.random.default_rng(2), 2)
        descent = gradient.again(problem, theta, 4, number, 3, np.random.default_rng(0))
        rounds.follow(descent, lambda request, asked=asked, own=own: (asked.append(request), own(*request[:2]))[1])
        assert {request.phase for request in asked} == {f"descent {number + 1} of 3"}
        assert all(len(request.directions) == directions for request in asked)
        leg = Leg(theta, space.ties if directions == 2 else np.eye(size), 4, gradient.TIED, np.full(2, scale))
        np.testing.assert_allclose([each.theta for each in asked], descents(leg, space, own, 0), rtol=1e-9, atol=1e-12)


def two(theta, directions):
    """`hills` of two gains."""
    whole = np.column_stack([theta, np.zeros((len(theta), 4))])
    along = None if directions is None else np.column_stack([directions, np.zeros((len(directions), 4))])
    return hills(whole, along)


# --- grids


@pytest.mark.parametrize(
    ("size", "starts", "iterations", "known"),
    [(1, None, None, 1), (2, 5, 3, 0), (2, None, 1, 2), (3, 4, 2, 1), (1, 1, 2, 0), (4, None, 1, 0)],
)
def test_a_grid_is_refined_about_its_best_cells(size, starts, iterations, known):
    """By loops: every point of the grid, the known ones before; then finer ones within a cell of the three best."""
    space = boxed(
        ["damping.x", "damping.y", "stiffness", "kp"][:size], [-2.0, -1.5, 0.0, 0.0][:size], [3.0, 2.0, 1.0, 2.0][:size]
    )
    rng = np.random.default_rng(size)
    task = Task(SimpleNamespace(space=space), Search(starts=starts, iterations=iterations), space.draw(rng, 1)[0],
                space.draw(rng, known))  # fmt: skip

    def answer(theta, directions=None):
        found = hills(np.column_stack([theta, np.zeros((len(theta), 6 - size))]), None)
        return found._replace(feasible=theta[:, 0] < 0.4, penalty=np.maximum(theta[:, 0] - 0.4, 0.0))

    grid.METHOD.check(space, task.search)
    asked = requests(grid.METHOD, task, answer)
    # rounds at most: of one point some cells are the same
    assert grid.METHOD.rounds(task) == len(asked) or (starts == 1 and grid.METHOD.rounds(task) > len(asked))
    count, fine = starts or {1: 64, 2: 24, 3: 10, 4: 6}[size], {1: 9, 2: 5, 3: 3, 4: 3}[size]
    axes = [[low + (high - low) * n / (count - 1) if count > 1 else low for n in range(count)]
            for low, high in zip(space.lower, space.upper, strict=True)]  # fmt: skip
    points = [task.start, *task.others, *map(np.array, itertools.product(*axes))]
    batch = math.ceil(len(points) / math.ceil(len(points) / 256))
    cell, seen, place = np.array([axis[1] - axis[0] if count > 1 else 0.0 for axis in axes]), {}, 0
    for level in range(iterations or 3):
        rows = []
        for begin in range(0, len(points), batch):
            rows = [points[min(n, len(points) - 1)] for n in range(begin, begin + batch)]
            np.testing.assert_allclose(asked[place].theta, rows, atol=1e-12)
            assert asked[place].directions is None
            assert asked[place].phase == ("refined grid" if level else "grid")
            place += 1
        for point in points:
            one = answer(np.asarray(point)[None])
            worth = one.value[0] if one.feasible[0] else 1e3 + one.merit[0]
            seen[tuple(point)] = worth
        best = sorted(seen, key=lambda point: (seen[point], point))[:3]
        steps = [-1 + 2 * n / (fine - 1) for n in range(fine)]
        points = [np.clip(np.array(middle) + np.array(way) * cell, space.lower, space.upper)
                  for middle in best for way in itertools.product(steps, repeat=size)]  # fmt: skip
        cell = cell * 2 / (fine - 1)
    assert place == len(asked)


def test_a_request_counts_its_tangents_and_a_task_knows_its_points():
    assert Request(np.zeros((3, 2)), None, "").tangents == 0 and Request(np.zeros((3, 2)), np.eye(2), "").tangents == 2
    start, others = np.array([1.0, 2.0]), np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(Task(None, Search(), start, others).known, [[1, 2], [3, 4]])
    np.testing.assert_array_equal(Task(None, Search(), start).known, [[1, 2]])
    own = Function(lambda task: iter(()))  # how many rounds it takes is not known where nobody says
    assert [own.rounds(Task(None, Search(iterations=n), start)) for n in (None, 7)] == [0, 7]
    assert many_variables.SMOOTH == 0.6
