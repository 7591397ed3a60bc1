"""The evaluation of points whose walks are a formula: values, derivatives in both modes, and their cost."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from tuning.problem import evaluation
from tuning.problem.evaluation import Problem, to_gains64, under_pd
from tuning.problem.objectives import Limit, Objective, Term
from tuning.problem.search import Search
from tuning.problem.spaces import space

CASE = mc.load_scenario("case_1_2", ["duration=0.3"])
GOAL = Objective(
    (Term("force_variation", 1.0, 2.0, 2.0),), (Limit("peak_pull_force", 40.0, 40.0, 0.5, "holding limit"),)
)


@jax.jit
def walked(gains):
    """Return the metrics of walks that all end."""
    found = formula(gains)
    return found | {"diverged": jnp.zeros(len(found["travel"]), bool)}


@jax.jit
def formula(gains):
    """Real metrics of walks (B,) by the gains (B, 6): a smooth companion is half of its metric."""
    stiffness, damping = gains["stiffness"], gains["damping"]
    none = jnp.zeros_like(stiffness[:, 0])
    found = dict.fromkeys(mc.METRICS.with_companions.names, none)
    found |= {"detached_limb": none - 1, "stands_at": none - 1}
    del found["diverged"]
    force = 1e-5 * stiffness @ jnp.arange(1.0, 7) + 1e-4 * damping[:, 2] ** 1.5 / 50
    pull = 1e-3 * damping @ jnp.ones(6)
    return found | {
        "force_variation": force, "force_variation_smooth": force / 2, "peak_pull_force": pull,
        "peak_pull_force_smooth": 0.9 * pull,
    }  # fmt: skip


@pytest.fixture
def asked(monkeypatch):
    calls = []

    def fields(gains):
        return {name: jnp.asarray(getattr(gains, name), float) for name in ("stiffness", "damping")}

    class Known(mc.Simulation):
        def metrics(self, gains, **how):
            calls.append(("walks", self.smooth, how))
            return jax.tree.map(np.asarray, walked(fields(gains)))

        def jvp(self, gains, tangents, **how):
            calls.append(("jvp", self.smooth, how))
            made = jax.vmap(lambda along: jax.jvp(formula, (fields(gains),), (along,))[1])(fields(tangents))
            return walked(fields(gains)), made

        def vjp(self, gains, weights, **how):
            calls.append(("vjp", self.smooth, how))
            _, back = jax.vjp(formula, fields(gains))
            every = {name: weights.get(name, jnp.zeros((2, len(gains.stiffness)))) for name in formula(fields(gains))}
            (found,) = jax.vmap(back)(every)
            return {"inertia": jnp.zeros_like(found["stiffness"]), **found}

    monkeypatch.setattr(mc, "Simulation", Known)
    with jax.enable_x64(True):
        yield calls


def problem_of(layout, dtype=np.float64):
    return Problem(CASE, space(CASE, Search(space=layout, joint_gains=False)), GOAL, dtype=dtype)


@pytest.mark.parametrize(("count", "mode"), [(0, ["walks"]), (4, ["jvp"]), (40, ["walks", "vjp"])])
def test_derivatives_of_both_modes_are_central_differences(asked, count, mode):
    """Of value and penalty together, and of the smooth companions that descents follow."""
    problem = problem_of("diagonal")
    own, rng = problem.space, np.random.default_rng(0)
    theta = own.draw(rng, 3)
    along = rng.standard_normal((count, own.size))
    found = problem.evaluate(theta, along if count else None)
    assert [name for name, *_ in asked] == mode
    assert all(smooth and how == {"unsteady": True, "dtype": np.float64} for _, smooth, how in asked)
    assert found.gradient.shape == found.sharp.shape == (3, count)
    score = GOAL.score(walked({n: jnp.asarray(getattr(to_gains64(own, theta), n)) for n in ("stiffness", "damping")}))
    np.testing.assert_allclose(found.value, score.value)
    np.testing.assert_allclose(found.merit, score.value + score.penalty)
    np.testing.assert_array_equal(found.feasible, score.feasible)
    assert (found.penalty > 0).any() and not found.feasible.all()
    for k in range(0, count, 7):
        ends = [problem.evaluate(theta + side * 1e-5 * along[k]) for side in (1, -1)]
        for name, value in (("gradient", "descent"), ("sharp", "merit")):
            slope = (getattr(ends[0], value) - getattr(ends[1], value)) / 2e-5
            np.testing.assert_allclose(getattr(found, name)[:, k], slope, rtol=1e-5, atol=1e-8)


def test_gains_are_feasible_that_keep_the_limits_in_all_walks(monkeypatch):
    class OfTwoMembers(mc.Simulation):
        def metrics(self, gains, **how):
            one = walked({name: jnp.asarray(getattr(gains, name), float) for name in ("stiffness", "damping")})
            pulls = {"peak_pull_force": 0 * one["peak_pull_force"] + jnp.array([[39.0], [41.0]])}
            return {name: jnp.broadcast_to(each, (2, 3)) for name, each in (one | pulls).items()}

    monkeypatch.setattr(mc, "Simulation", OfTwoMembers)
    problem = problem_of("isotropic")
    with jax.enable_x64(True):
        assert not problem.evaluate(problem.space.draw(np.random.default_rng(0), 3)).feasible.any()


def test_a_step_with_tangents_costs_as_many_more_and_the_reverse_mode_no_more_than_some():
    problem = dataclasses.replace(problem_of("isotropic"), members=4)
    steps = CASE.steps
    assert (problem.env_steps(5), problem.env_steps(5, 3)) == (5 * 4 * steps, 5 * 4 * steps * 4)
    assert problem.env_steps(5, 1000) == 5 * 4 * steps * (1 + evaluation.REVERSE_ABOVE)


@pytest.mark.parametrize(("more", "first"), [(0, "jvp"), (1, "metrics")])
def test_all_gains_with_axes_are_searched_by_tangents(more, first, monkeypatch):
    """Those of the paper's law on every axis, with its inertia and the joint loop's; reverse mode walks first."""

    class AskedError(Exception):
        """What is asked for is known: nothing needs to be compiled."""

    def asked(name):
        def raised(*_, **__):
            raise AskedError(name)

        return raised

    for name in ("metrics", "jvp"):
        monkeypatch.setattr(mc.Simulation, name, asked(name))
    every = space(CASE, Search(space="diagonal", inertia=True, joint_gains=True, also=("ki",)))
    assert every.size == 3 * 6 + 3 <= evaluation.REVERSE_ABOVE
    with pytest.raises(AskedError, match=first):
        Problem(CASE, every, GOAL).evaluate(every.lower[None], np.ones((evaluation.REVERSE_ABOVE + more, every.size)))


def test_pd_in_place_of_a_law_keeps_all_else():
    own = under_pd(CASE)
    assert own.control.controller == "pd" and own.control.kp == CASE.control.kp
    assert own == CASE.with_overrides({"control.controller": "pd"})
    # a reading is of a law that reads; the user's own law, metrics and objective are none of pd's
    named = {"name": "Mine", "file": "mine.py", "digest": "0"}
    mine = CASE.with_overrides({"control.reading": "measured_pose"})
    mine = mine.with_own(law=named, metrics=[named], objective=named)
    assert mine.own is not None and under_pd(mine) == own


def test_pd_is_walked_as_a_search_walks_it_and_alone_in_double_precision(monkeypatch):
    """With smooth companions both; among many also those that the time step is too long for."""
    asked, parameters = [], mc.parameters(CASE)
    monkeypatch.setattr(mc, "rollout_metrics", lambda *given, **how: asked.append((given, how)) or {"travel": 1})
    evaluation.pd_of(CASE, parameters, engine="mjx", metrics=mc.METRICS)
    assert evaluation.baseline(CASE, "mjx") == {"travel": 1.0}
    ((case, gains, own), many), ((alone,), how) = asked
    assert case == alone == under_pd(CASE) and own is parameters
    assert [np.shape(each) for each in (gains.inertia, gains.damping, gains.stiffness)] == [(6,)] * 3
    common = {"engine": "mjx", "metrics": mc.METRICS, "smooth": True}
    assert many == common | {"dtype": np.float32, "unsteady": True} and how == common | {"dtype": np.float64}


def test_pd_is_walked_again_where_a_file_that_it_reads_has_changed(monkeypatch):
    walks = iter([1.0, 2.0])
    contents = {"stiffness": 1.0}
    monkeypatch.setattr(mc, "rollout_metrics", lambda *_, **__: {"travel": next(walks)})
    own = evaluation.own_parameters(CASE)
    monkeypatch.setattr(
        evaluation, "own_parameters", lambda _: own.replace({"contact.stiffness": contents["stiffness"]})
    )
    case = CASE.with_overrides({"duration": 0.299})
    assert [evaluation.baseline(case)["travel"] for _ in range(2)] == [1.0, 1.0]
    contents["stiffness"] = 2.0
    assert evaluation.baseline(case)["travel"] == 2.0
