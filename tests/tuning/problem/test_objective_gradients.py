"""Derivatives of every objective term and constraint, along every coordinate of every space, against differences."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.walk.metrics import FAILURES, PREFIX
from tuning.problem import search, spaces
from tuning.problem.objectives import Limit, Objective, Term

CASES = ("case_1_1", "case_1_2", "case_2")
# a whole cycle in 0.4 s: each limb lets go, swings and grips; cargo and pushes come while it does
QUICK = {"duration": 0.4, "gait.cycle": 0.4, "gait.stride": 0.01, "gait.step_height": 0.01}
WINDOWS = ((0.06, 0.11), (0.18, 0.25), (0.29, 0.36))
QUICK_NUMBERS = {"disturbance.cargo.start": 0.15}
for _n, (_start, _stop) in enumerate(WINDOWS):
    QUICK_NUMBERS |= {f"disturbance.pushes.{_n}.start": _start, f"disturbance.pushes.{_n}.stop": _stop}
STEPS = np.array([1e-4, 1e-5, 1e-6])  # in the logarithm of the gains
ROUNDING = 1e-12  # of a metric, relative
STEEPEST_PENALTY = 10.0  # per relative change of the metric: so much more does its rounding count
TERMS = tuple(name for name in mc.METRICS.names if name not in FAILURES)
# holding force, joint limits, base deviation; `no worse than pd` adds the metrics with a weight
LIMITS = ("peak_utilization", "joint_limit_margin", "base_deviation", "force_variation", "peak_foot_force",
          "cost_of_transport")  # fmt: skip
OVERSHOOTS = (-0.01, 0.03, 3.0)  # relative: in the margin before a limit, just beyond it, far beyond it
NOMINAL = {  # gains that matter in these walks, and of which none lies on a bound
    "virtual_model": mc.Gains(2.0, 1.5e2, 3e3),
    "measured_pose": mc.Gains(1.0, 7e3, 5e5),
}
SPACES = [
    {"space": layout, "inertia": inertia, "joint_gains": joint}
    for layout, inertia, joint in itertools.product(search.LAYOUTS, (False, True), (False, True))
]


class Searched:
    """The rows of one batch: every case, every space, every coordinate; and the program that walks them."""

    def __init__(self, case, numbers, reading: str, layouts: list[dict], overrides: dict, changes: dict):
        scenarios = [case(name, reading, overrides) for name in CASES]
        self.scenario = scenarios[0]
        self.spaces = [spaces.space(scenarios[0], search.Search.make(settings)) for settings in layouts]
        rng, self.points = np.random.default_rng(0), []
        for space in self.spaces:
            theta = space.from_gains(dataclasses.replace(NOMINAL[reading], kp=45.0, kd=0.25))
            self.points.append(space.clip(theta + rng.uniform(-0.2, 0.2, space.size)))
        self.axes = [np.eye(space.size) for space in self.spaces]
        self.numbers = []
        for scenario in scenarios:
            own = {n: v for n, v in changes.items() if ".cargo." in n or scenario.disturbance.pushes}
            own = {name: np.asarray(value, float) for name, value in own.items()}
            self.numbers.append(numbers(scenario).replace(own))
        self.walk = self._walk()

    def _walk(self):
        """Return the walk of all rows as a function of gains; their parameters are known where it is compiled."""
        rows = sum(map(len, self.axes))
        parameters = jax.tree.map(lambda *values: np.repeat(np.stack(values), rows, axis=0), *self.numbers)
        simulate = mc.simulator(self.scenario, smooth=True)
        return jax.jit(lambda gains: simulate(gains, parameters))

    def metrics(self, thetas) -> dict:
        """Return all metrics (case x row) of points (B, n) of each space, one batch after the other."""
        made = [space.to_gains(theta) for space, theta in zip(self.spaces, thetas, strict=True)]
        joint, joined = {"kp": 50.0, "kd": 0.2}, {}
        for name in ("inertia", "damping", "stiffness", "kp", "kd"):
            own = [
                jax.numpy.full(len(theta), joint[name]) if (value := getattr(gains, name)) is None else value
                for gains, theta in zip(made, thetas, strict=True)
            ]
            joined[name] = jax.numpy.tile(jax.numpy.concatenate(own), (len(CASES), *[1] * (own[0].ndim - 1)))
        found = self.walk(mc.Gains(**joined))
        return {name: value for name, value in found.items() if np.issubdtype(value.dtype, np.floating)}

    def forward(self) -> tuple[dict, dict]:
        """Return metrics and their derivatives, a row for each case and coordinate of each space."""
        return jax.jvp(self.metrics, ([point + 0 * axes for point, axes in zip(self.points, self.axes, strict=True)],),
                       (self.axes,))  # fmt: skip

    def shifted(self) -> dict:
        """Return metrics (step, side, case x row) beside the points."""
        found = [
            self.metrics([point + offset * axes for point, axes in zip(self.points, self.axes, strict=True)])
            for offset in np.multiply.outer(STEPS, [1.0, -1.0]).ravel()
        ]
        return jax.tree.map(lambda *values: np.reshape(values, (len(STEPS), 2, -1)), *found)


def judgements(metrics: dict) -> dict:
    """Return all that is to be derived, by name, as functions of metrics."""
    one = {name: np.asarray(value) for name, value in metrics.items()}

    def by_row(name):
        values = one[name]
        return tuple(np.where(np.abs(values) > 0, np.abs(values), 1.0))

    functions = {}
    for name in TERMS:
        smooth = PREFIX + name if PREFIX + name in one else name
        goal = Objective((Term(name, 2.0, by_row(name), by_row(smooth), mc.METRICS[name].larger_is_better),), ())
        functions[f"{name}, true"] = lambda m, goal=goal: goal.score(m).value
        if smooth != name:
            functions[f"{name}, smooth"] = lambda m, goal=goal: goal.score(m).descent
    for name, over in itertools.product(LIMITS, OVERSHOOTS):
        larger_is_better = mc.METRICS[name].larger_is_better
        sign = -1.0 if larger_is_better else 1.0
        bound = tuple(one[name] - sign * over * np.array(by_row(name)))
        limit = Limit(name, bound, by_row(name), 0.02, "", larger_is_better)
        goal = Objective((), (limit,), lambda m: m["travel"] * 0)
        functions[f"limit of {name}, {over:+g}"] = lambda m, goal=goal: goal.score(m).descent
    return functions


def derivatives_and_errors(searched: Searched) -> dict:
    """Return per function the derivatives (row,) and their distance (row,) from the central difference that fits best.

    A difference is right while no kink (maxima over time and limbs, absolute values) and no grip event lies within its
    step. A small step loses to rounding what a large one loses to kinks; what rounding may do is allowed for.
    """
    metrics, slopes = searched.forward()
    functions = judgements(metrics)
    diverged = np.zeros(len(metrics["travel"]), bool)

    def judged(found):
        return {name: function({**found, "diverged": diverged}) for name, function in functions.items()}

    value, forward = jax.jit(lambda m, dm: jax.jvp(judged, (m,), (dm,)))(metrics, slopes)
    beside = jax.jit(jax.vmap(jax.vmap(judged)))(searched.shifted())
    result = {}
    for name, sides in beside.items():
        difference = np.asarray(sides[:, 0] - sides[:, 1]) / (2 * STEPS[:, None])
        steepest = STEEPEST_PENALTY if name.startswith("limit") else 1.0
        noise = ROUNDING * np.maximum(np.abs(value[name]), steepest) / STEPS[:, None]
        error = np.maximum(np.abs(difference - forward[name]) - noise, 0).min(0)
        result[name] = np.asarray(forward[name]), error
    return result


def assert_right(found: dict) -> None:
    """Each derivative is within 1e-3 of its difference, and every function has one that is far from zero."""
    for name, (derivative, error) in found.items():
        assert np.isfinite(derivative).all(), name
        assert (error <= 1e-3 * np.maximum(np.abs(derivative), 1e-300)).all(), name
        assert np.abs(derivative).max() > 1e-3, name


@pytest.mark.nightly
@pytest.mark.parametrize(
    "reading", [pytest.param(name, marks=() if name == "virtual_model" else pytest.mark.nightly) for name in NOMINAL]
)
def test_every_space_term_and_constraint(case, numbers, reading):
    """Twelve spaces, three cases, one cycle with grips, cargo and pushes."""
    assert_right(derivatives_and_errors(Searched(case, numbers, reading, SPACES, QUICK, QUICK_NUMBERS)))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("reading", list(NOMINAL))
def test_whole_walks(case, numbers, reading):
    """The walks of the paper, 8 s: one space of each layout, with inertia and joint gains."""
    layouts = [{"space": layout, "inertia": True, "joint_gains": True} for layout in ("isotropic", "split")]
    assert_right(derivatives_and_errors(Searched(case, numbers, reading, layouts, {}, {})))
