"""Which walks each kind of result is compared with, and where their numbers go: without walking."""

import dataclasses
import types
from typing import Any

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.control import PD, PlannedTransfer, VirtualModelAdmittance, law_of
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from tuning.background import ignore
from tuning.comparisons import of_sweep, stability_limit
from tuning.problem.evaluation import Problem, under_pd
from tuning.results.swept import HISTORIES, Swept
from tuning.searches import retuned_pd
from tuning.searches import sweep as sweeps
from tuning.searches.retuned_pd import Rival

COARSE = mc.load_scenario("case_1_2", {"time_step": 1e-3, "duration": 0.3})  # at which kp and kd of pd retuned shake
FINE = mc.load_scenario("case_1_2", {"time_step": 2.5e-4, "duration": 0.3})
JOINT = {"kp": 17.0, "kd": 1.0}
OTHER = next(engine for engine in mc.ENGINES if engine != DEFAULT_ENGINE)
LEVELS = {PD: 90.0, PlannedTransfer: 60.0, VirtualModelAdmittance: 30.0}


@dataclasses.dataclass(frozen=True)
class Walked:
    """A walk that is known by what it was asked for."""

    scenario: mc.Scenario
    gains: Any
    law: mc.Law | None
    engine: str

    @property
    def parameters(self):
        return types.SimpleNamespace(at=lambda path: {"contact.stiffness": 7e3, "contact.damping": 80.0}[path])


def number_of(scenario, law=None):
    """The force variation of a walk: another one for each law, kp, stiffness and time step."""
    control, own = scenario.control, law_of(scenario) if law is None else law
    rigid = type(own) is PD
    return LEVELS[type(own)] + control.kp / 100 + (0 if rigid else control.stiffness / 1e6) + 1e3 * scenario.time_step


@pytest.fixture
def walks(monkeypatch):
    """Have walks recorded, not walked."""
    asked = []

    def rollout(scenario, gains=None, *, law=None, engine):
        asked.append(engine)
        return Walked(scenario, law if gains is None else gains, law, engine)

    def metrics(walk, table):
        assert table is mc.METRICS
        none = {"diverged": False, "detached_limb": None, "detached_at": None, "stands_at": None}
        return dict.fromkeys(mc.METRICS.names, 1.0) | none | {"force_variation": number_of(walk.scenario, walk.law)}

    monkeypatch.setattr(mc, "rollout", rollout)
    monkeypatch.setattr(mc, "metrics", metrics)
    return asked


def grid(scenario, *, lost=False, least=None, gains=None, shape=(2, 3), axes=("stiffness", "damping")):
    """A grid whose best cell is its second last."""
    values = np.linspace(80, 50, int(np.prod(shape))).reshape(shape)
    values[-1, -1] = 70.0
    if least is not None:
        values[-1, -2] = least
    data = {"force_variation": values, "diverged": np.zeros(shape, bool), "detached_limb": np.full(shape, 2 * lost - 1)}
    spans = {name: 1e3 * (k + 1.0) * np.arange(1, n + 1) for k, (name, n) in enumerate(zip(axes, shape, strict=True))}
    made = xr.Dataset({name: (axes, each) for name, each in data.items()}, spans)
    made["force_variation"].attrs["larger_is_better"] = 0
    return Swept(made, Problem(scenario, engine=OTHER), gains=gains)


@pytest.fixture
def rivals(monkeypatch):
    """Have pd retuned and the limit of stability known; return how they were asked for."""
    asked = []

    def least(scenario, *, halvings=2, engine):
        asked.append((scenario, halvings, engine))
        return Rival(JOINT, 40.0, lacks="on a short grid" if halvings == 1 else "")

    def over_axes(scenario, axes, *, law, engine):
        asked.append((scenario, {name: values.tolist() for name, values in axes.items()}, law, engine))
        names = [*axes][::-1]
        return xr.DataArray(np.full([len(axes[name]) for name in names], 0.9), {n: axes[n] for n in names}, names)

    monkeypatch.setattr(retuned_pd, "least", least)
    monkeypatch.setattr(stability_limit, "over_axes", over_axes)
    return asked


@pytest.mark.parametrize(("scenario", "needs"), [(FINE, False), (COARSE, True)])
def test_a_grid_stands_beside_pd_pd_retuned_its_own_gains_and_those_of_a_file(scenario, needs, walks, rivals):
    given = {"stiffness": 5e4, "damping": 60.0, "kp": 30.0}
    found = of_sweep.compare(grid(scenario, gains=given))
    fine = scenario.with_overrides({"time_step": scenario.time_step / 2} if needs else {})
    own, step = scenario.with_overrides({"control.kp": 30.0, "control.safe_kp": 50.0}), fine.time_step
    best = own.with_overrides({"control.stiffness": 2e3, "control.damping": 4e3})
    retuned = under_pd(fine).with_overrides({"control.kp": 17.0, "control.kd": 1.0, "control.safe_kp": 50.0})
    expected = {
        "best": (best, None), "retuned_pd": (retuned, None), "planned_unsearched": (retuned, PlannedTransfer()),
        "gains file": (own.with_overrides({"control.stiffness": 5e4, "control.damping": 60.0}), None),
        "paper": (scenario, None), "pd": (under_pd(scenario), None),
    }  # fmt: skip
    assert [*found.walks] == [*found.rows] == [*expected]
    for name, (walked, law) in expected.items():
        walk, (gains, metrics) = found.walks[name], found.rows[name]
        assert (walk.scenario, repr(walk.law), walk.engine) == (walked, repr(law), OTHER), name
        assert metrics["force_variation"] == number_of(walked, law)
        if name in ("retuned_pd", "planned_unsearched"):
            assert gains == JOINT
        else:
            assert gains == (None if name == "pd" else {n: getattr(walked.control, n) for n in mc.Gains.AXES})
    np.testing.assert_array_equal(found.walks["pd"].gains.stiffness, scenario.control.stiffness)
    assert set(walks) == {OTHER} and len(walks) == len(expected) + needs  # and the best at the step of pd retuned
    assert found.level == ((step, pytest.approx(number_of(best.with_overrides({"time_step": step}))
                            / number_of(retuned, PlannedTransfer()) - 1)) if needs else None)  # fmt: skip
    assert (found.failed, found.at_edge, [*found.remedies]) == (0, ["stiffness"], [])
    assert found.best["force_variation"].item() == 56.0
    assert (
        found.data["spectral_radius"].dims == ("stiffness", "damping") and (found.data["spectral_radius"] == 0.9).all()
    )
    assert found.histories is not None and found.histories.sizes == {"stiffness": 2, "damping": 3}
    axes = {"stiffness": [1e3, 2e3], "damping": [2e3, 4e3, 6e3]}
    assert rivals[0] == (scenario, 1, OTHER) and rivals[1] == (expected["gains file"][0], axes, None, OTHER)
    assert len(rivals) == 2  # the best of the grid is no better than pd on its short one


@pytest.mark.parametrize(("least", "again"), [(39.0, True), (41.0, False)])
def test_a_best_cell_better_than_pd_on_a_short_grid_has_pd_retuned_within_all_of_its_bounds(
    least, again, walks, rivals
):
    found = of_sweep.compare(grid(FINE, least=least, axes=("contact.stiffness", "contact.damping")))
    assert [*found.walks] == [*found.rows] == ["best", "retuned_pd", "planned_unsearched", "paper", "pd"]
    assert [each[1:] for each in rivals if len(each) == 3] == [(1, OTHER), (2, OTHER)][: 1 + again]
    paths = {"contact.stiffness": 7e3, "contact.damping": 80.0}
    for name, (gains, _) in found.rows.items():
        assert name in ("retuned_pd", "planned_unsearched") or {**gains} == paths | (gains if name != "pd" else {}), (
            name
        )
    assert found.walks["best"].scenario.contact.stiffness == 2e3
    assert ("short grid" in found.worth.in_words) is not again


def test_where_no_cell_holds_the_worth_is_unknown_and_help_is_for_the_configs_own_gains(walks, rivals, monkeypatch):
    from mjx_climb.viz import plots

    monkeypatch.setattr(plots, "detachments", lambda walk: [("LF", 0.1), ("RF", 0.2)])
    monkeypatch.setattr(of_sweep, "remedies", lambda scenario, limb, law: (scenario, limb, law))
    swept = grid(FINE.with_overrides({"control.stiffness": 6e3}), lost=True, gains={"stiffness": 5e4})
    monkeypatch.setattr(retuned_pd, "least", lambda *_, **__: None)
    found = of_sweep.compare(swept)
    assert [*found.walks] == [*found.rows] == ["gains file", "config", "pd"]
    assert (found.best, found.worth, found.level, found.failed, found.at_edge) == (None, None, None, 6, [])
    assert [*found.remedies] == [f"config: {(swept.scenario, 'LF', None)}"]


def test_of_a_large_grid_a_coarser_one_with_the_best_cell_keeps_histories(walks, rivals, monkeypatch):
    asked = []

    def sweep(scenario, axes, **how):
        asked.append((scenario, {name: values.tolist() for name, values in axes.items()}, how))
        return types.SimpleNamespace(data="coarser")

    monkeypatch.setattr(sweeps, "sweep", sweep)
    small, large = (grid(FINE, shape=(2, HISTORIES // 2 + more)) for more in (0, 1))
    assert of_sweep.compare(small).histories is small.data and not asked
    assert of_sweep.compare(large).histories == "coarser"
    (scenario, axes, how), best = asked[0], large.data["damping"].values[-2]
    assert scenario == FINE and how == {"law": None, "metrics": mc.METRICS, "engine": OTHER}
    assert [*axes] == ["stiffness", "damping"] and best in axes["damping"] and axes["stiffness"] == [1e3, 2e3]
    assert HISTORIES * 0.9 <= 2 * len(axes["damping"]) <= HISTORIES


def test_rivals_of_a_grid_that_were_begun_before_it_are_not_begun_again(walks, rivals):
    swept = grid(FINE)
    radius = xr.zeros_like(swept.data["force_variation"])
    begun = of_sweep.Begun(lambda _: Rival(JOINT, 40.0), lambda _: radius)
    found = of_sweep.compare(swept, begun=begun)
    assert not rivals and (found.data["spectral_radius"] == 0).all()
    problem, works = swept.problem, []
    of_sweep.begin(problem, dataclasses.replace(problem, law=PD()), {"kp": np.array([1.0])}, works.append)
    assert len(works) == 2 and not rivals
    assert works[0](ignore).joint == JOINT and works[1](ignore).dims == ("kp",)
    assert rivals[0] == (FINE, 1, OTHER) and rivals[1][:2] == (FINE, {"kp": [1.0]}) and type(rivals[1][2]) is PD
