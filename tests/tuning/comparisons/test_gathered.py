"""Which walks each kind of result is compared with, and where their numbers go: without walking."""

import contextlib
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
from tuning.comparisons import (
    compare,
    degraded,
    judge,
    margins,
    merge,
    of_ensemble,
    of_front,
    of_search,
    of_sweep,
    stability_limit,
    verification,
    worth,
)
from tuning.gains.gains_file import Whole
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.search import Search
from tuning.results.swept import HISTORIES, Swept
from tuning.searches import retuned_pd
from tuning.searches import sweep as sweeps
from tuning.searches.retuned_pd import Rival
from tuning.searches.shards import Kept, Shard

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


def named(law):
    """The name of a law beside the scenario's own, which a walk tells in its place; empty for none."""
    return law if isinstance(law, str) else "" if law is None else type(law).__name__


def number_of(scenario, law=None):
    """The force variation of a walk: another one for each law, kp, stiffness and time step."""
    law = {"": None, "PlannedTransfer": PlannedTransfer()}[law] if isinstance(law, str) else law
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
        assert (walk.scenario, named(walk.law), walk.engine) == (walked, named(law), OTHER), name
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
    assert rivals[0] == (expected["gains file"][0], axes, None, OTHER) and rivals[1] == (scenario, 1, OTHER)
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


def test_a_plan_that_is_no_better_than_pd_on_its_joint_gains_is_no_row_and_no_walk(walks, rivals, monkeypatch):
    monkeypatch.setitem(LEVELS, PlannedTransfer, 95.0)
    found = of_sweep.compare(grid(FINE))
    assert [*found.walks] == [*found.rows] == ["best", "retuned_pd", "paper", "pd"]


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
    alone, walked = of_sweep.walk_alone(swept), len(walks)
    again = of_sweep.compare(swept, begun=begun._replace(alone=lambda _: alone))
    assert [*alone] == ["pd", "paper", "best"] and [*again.rows] == [*found.rows] and again.verdict == found.verdict
    assert all(again.walks[name] is alone[name].walk for name in alone)
    assert len(walks) - walked == 2  # pd retuned, planned
    problem, works = swept.problem, []
    of_sweep.begin(problem, dataclasses.replace(problem, law=PD()), {"kp": np.array([1.0])}, works.append)
    assert len(works) == 2 and not rivals
    assert works[0](ignore).dims == ("kp",) and works[1](ignore).joint == JOINT
    assert rivals[0][:2] == (FINE, {"kp": [1.0]}) and type(rivals[0][2]) is PD and rivals[1] == (FINE, 1, OTHER)


def test_points_of_a_front_walk_with_their_gains_beside_pd_and_the_laws_own(walks, monkeypatch):
    """The gains are two, one of them by axis; the walk of pd is by its own law."""
    asked, law = [], PlannedTransfer()
    monkeypatch.setattr(mc, "rollout_histories", lambda *given, **how: asked.append((given, how)) or "histories")
    monkeypatch.setattr(of_front, "of_front", lambda found: ("worth", found))
    monkeypatch.setattr(of_front, "verdict", lambda found, metrics: ("verdict", found, metrics))
    columns = {"stiffness": ("front", [1.0, 2.0]), "damping": (("front", "six"), np.ones((2, 6))), "other": 3.0}
    data = xr.Dataset(columns, attrs={"gains": "stiffness damping"})
    problem = Problem(FINE, law=law, engine=OTHER)
    found = types.SimpleNamespace(problem=problem, data=data, scenario=FINE)
    compared = of_front.compare(found)
    assert [(name, walk.scenario, walk.law, walk.engine) for name, walk in compared.walks.items()] == [
        ("pd", under_pd(FINE), None, OTHER), ("config", FINE, law, OTHER)
    ]  # fmt: skip
    (((scenario, gains), how),) = asked
    assert scenario is FINE and [*gains] == ["stiffness", "damping"] and how.pop("law") is law
    assert how == {"engine": OTHER, "metrics": mc.METRICS, "unsteady": True}
    np.testing.assert_array_equal(gains["damping"], np.ones((2, 6)))
    assert [each["force_variation"] for each in compared.metrics.values()] == [
        number_of(under_pd(FINE)), number_of(FINE, law)
    ]  # fmt: skip
    assert compared.histories == "histories" and compared.worth == ("worth", found)
    assert compared.verdict == ("verdict", found, compared.metrics)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Walks of gains through a draw: of the n-th gains and the m-th member 10 n + m."""

    problem: Problem
    gains: Any
    ensemble: Any = None
    pd: Any = None

    def dataset(self, arrays):
        assert arrays == ("walked", [*self.gains])
        names = [*self.gains, *(self.pd or ()), "pd"]
        values = 10.0 * np.arange(len(names))[:, None] + np.arange(2.0)
        lost = {judge.LOST_SENSORS: f"{names[0]} lost one" if names[0].startswith("mine") else ""}
        return xr.Dataset({"force_variation": (("gains", "member"), values), "mass": ("member", [1.0, 2.0])},
                          {"gains": names, "member": [0, 1]}, lost)  # fmt: skip


@pytest.fixture
def draws(monkeypatch):
    """Have draws recorded, not walked; return them with their folders."""
    asked = []

    def through(problem, gains, ensemble, pd=None):
        return Drawn(dataclasses.replace(problem, parameters=("of", ensemble.seed)), gains, ensemble, pd)

    def rows(draw, out=None):
        asked.append((draw, out))
        return types.SimpleNamespace(walk=lambda told: ("walked", [*draw.gains]))

    monkeypatch.setattr(judge, "through", through)
    monkeypatch.setattr(of_ensemble, "Rows", rows)
    monkeypatch.setattr(compare, "Rows", rows)
    return asked


def result(scenario, gains, law=None):
    return types.SimpleNamespace(scenario=scenario, gains=gains, law=law)


@pytest.mark.parametrize(("retunes", "plans", "reads"), [(True, True, True), (True, False, True), (True, False, False),
                                                         (False, False, True)])  # fmt: skip
@pytest.mark.parametrize(("scenario", "needs"), [(FINE, None), (COARSE, 5e-4)])
def test_gains_over_an_ensemble_walk_beside_their_rivals_and_again_through_their_own_draw(
    scenario, needs, retunes, plans, reads, draws, monkeypatch
):
    law, own, asked = VirtualModelAdmittance(), PlannedTransfer(), []
    pd = result(scenario, JOINT) if retunes else None
    plan = result(scenario, {"kp": 20.0, "kd": 1.0}, own) if plans else None
    monkeypatch.setattr(of_ensemble, "retuned", lambda *how: asked.append(how) or (lambda told: pd))
    monkeypatch.setattr(
        of_ensemble, "planned", lambda *how: asked.append(how) or ((lambda told: plan) if plans else None)
    )
    monkeypatch.setattr(retuned_pd, "by_plan", lambda problem: own if reads else None)
    monkeypatch.setattr(of_ensemble, "conclusions", lambda *given: given)
    problem, ensemble = Problem(scenario, law=law), Ensemble(members=3, seed=4)
    found = types.SimpleNamespace(problem=problem, search="search", seeds=2, scenario=scenario, ensemble=ensemble,
                                  gains={"stiffness": 1.0}, judges=8)  # fmt: skip
    _, walked, seen, others, step = of_ensemble.compare(found, out="folder")
    assert asked == [(problem, "search", 2, "folder")] * 2 and others == (pd, plan)
    assert step == (needs if retunes else None)
    (fresh, _), (again, _) = draws
    assert fresh.problem.scenario.time_step == (needs if retunes and needs else scenario.time_step)
    assert (fresh.ensemble.members, again.ensemble) == (8, ensemble) and fresh.ensemble.seed != 4
    assert again.problem is problem and again.gains == {"robust": found.gains} and again.pd is None
    assert fresh.gains["robust"] == found.gains and fresh.gains["config"] is law
    more = [name for name in fresh.gains if name not in ("robust", "config")]
    assert more == (["planned_transfer"] if plans else ["planned_unsearched"] if retunes and reads else [])
    for name in more:
        assert fresh.gains[name].law is own and fresh.gains[name].gains == (plan.gains if plans else JOINT)
    assert fresh.pd == ({"retuned_pd": JOINT} if retunes else {})
    assert walked["gains"].values.tolist() == [*fresh.gains, *fresh.pd, "pd"]
    assert seen["gains"].values.tolist() == ["robust", "pd"]
    found.problem = dataclasses.replace(problem, law=None)
    of_ensemble.compare(found)
    assert draws[2][0].gains["config"].stiffness == scenario.control.stiffness


@pytest.mark.parametrize("method", ["cmaes", "grid"])
def test_laws_are_searched_from_each_seed_and_judged_on_the_same_unseen_walks(method, draws, monkeypatch, tmp_path):
    searches, told = [], []

    def run(problem, search, *, patience, out, progress):
        searches.append((problem, search.seed, patience, out))
        name = "mine" if problem.law else "pd"
        return types.SimpleNamespace(
            problem=problem, search=search, gains=f"{name} {search.seed}", value=0.1 * search.seed + (name == "pd"),
            feasible=search.seed == 7, converged=name == "pd", interrupted=search.seed == stopped,
        )  # fmt: skip

    @contextlib.contextmanager
    def stage(name, **how):
        told.append((name, how))
        yield ignore

    monkeypatch.setattr(compare.tune, "run", run)
    monkeypatch.setattr(compare.tune, "of_search", lambda problem, own, n: dataclasses.replace(problem, members=10 + n))
    monkeypatch.setattr(compare, "on_better_hardware", lambda scenario, drawn: {"half the delay": (scenario, drawn)})
    search, law, stopped = Search(seed=7, method=method, starts=6), PlannedTransfer(), None
    laws = {"mine/a b": compare.Contestant(FINE, law, search, "space"),
            "retuned_pd": compare.Contestant(under_pd(FINE), None, search, "of pd")}  # fmt: skip
    base = Problem(COARSE, ensemble=Ensemble(members=3, seed=4), engine=OTHER)
    found = compare.run(laws, base, search, members=9, seeds=2, out=tmp_path, stage=stage)
    patience = 60 if method == "cmaes" else None
    folder = tmp_path / "parts"
    expected = [
        (dataclasses.replace(base, scenario=own.scenario, law=own.law, space=own.space, members=10 + n),
         7 + n, patience, folder / f"{name}-{7 + n}")
        for name, own in (("mine_a_b", laws["mine/a b"]), ("retuned_pd", laws["retuned_pd"])) for n in (0, 1)
    ]  # fmt: skip
    assert searches == expected
    names = ["mine/a b", "retuned_pd", "half the delay"]
    words = [f"{name}, seed {7 + n}" for name in names[:2] for n in (0, 1)]
    assert [name for name, _ in told] == [*words, *(f"unseen walks of {name}" for name in names)]
    assert [how for _, how in told] == [{"unit": "rounds", "keeps": True}] * 4 + [{"unit": "members"}] * 3
    assert [out for _, out in draws] == [
        folder / f"judged-{name}" for name in ("mine_a_b", "retuned_pd", "half_the_delay")
    ]
    mine, pd, better = (draw for draw, _ in draws)
    assert {(draw.ensemble.members, draw.ensemble.seed) for draw in (mine, pd, better)} == {
        (9, judge.fresh(base.ensemble).seed)
    }
    assert mine.gains == {f"mine/a b, seed {n}": f"mine {n}" for n in (7, 8)}
    assert pd.gains == {f"retuned_pd, seed {n}": f"pd {n}" for n in (7, 8)}
    assert better.gains == {f"half the delay, seed {n}": f"pd {n}" for n in (7, 8)}
    assert (mine.problem.law, mine.problem.members) == (law, 10) and pd.problem.scenario == under_pd(FINE)
    assert better.problem.parameters == (pd.problem.scenario, pd.problem.parameters)
    data = found.data
    assert data["gains"].values.tolist() == [*names, "pd"] and data["seed"].values.tolist() == [7, 8]
    own = [[0.0, 1.0], [10.0, 11.0]]
    np.testing.assert_array_equal(data["force_variation"], [own, own, own, [[20.0, 21.0]] * 2])
    assert data["mass"].dims == ("member",) and data.attrs[judge.LOST_SENSORS] == "mine/a b, seed 7 lost one"
    nothing = [[np.nan] * 2] * 2
    np.testing.assert_allclose(data["search_value"], [[0.7, 0.8], [1.7, 1.8], *nothing])
    np.testing.assert_array_equal(data["search_feasible"], [[1.0, 0.0], [1.0, 0.0], *nothing])
    np.testing.assert_array_equal(data["search_converged"], [[0.0, 0.0], [1.0, 1.0], *nothing])
    assert (found.problem, found.search, found.ensemble) == (base, search, base.ensemble)
    assert [*found.searched] == [*laws]
    assert all([each.search.seed for each in own] == [7, 8] for own in found.searched.values())
    compare.run(laws, base, search)
    assert [(seed, out) for _, seed, _, out in searches[4:]] == [(7, None), (7, None)] and draws[3][1] is None
    assert draws[3][0].ensemble.members == judge.MEMBERS
    stopped = 8
    with pytest.raises(KeyboardInterrupt):
        compare.run(laws, base, search, seeds=3)
    assert len(searches) == 8


LAW, TABLE = PlannedTransfer(), mc.MetricTable([mc.METRICS["travel"], mc.METRICS["force_variation"]])


@pytest.fixture
def works(monkeypatch):
    """Have works handed on, not walked: their arguments and where they are kept."""

    class Handed:
        def __init__(self, work, out):
            self.asked = work, out

        def walk(self, progress):
            return *self.asked, progress

    for module in (judge, degraded):
        monkeypatch.setattr(module, "Rows", Handed)
        monkeypatch.setattr(
            module, "draw_of", lambda *given: types.SimpleNamespace(given=given, result=lambda arrays: arrays)
        )
    monkeypatch.setattr(judge, "walk_shard", lambda work, *more: (work, *more))


def test_what_evaluate_and_degrade_are_asked_for_is_what_walks(works):
    gains, ensemble, told = {"mine": {"leak": 1.0}}, Ensemble(members=3), [].append
    problem = Problem(FINE, law=LAW, metrics=TABLE, engine=OTHER)
    more, how = {"members": 7, "out": "folder", "progress": told}, {"law": LAW, "engine": OTHER}
    work, *rest = judge.evaluate(FINE, gains, ensemble, **more, **how, metrics=iter(TABLE))
    assert work.given == (problem, gains, ensemble, 7) and rest == ["folder", told]
    work, *rest = degraded.degrade(FINE, gains, ensemble, ["delay=x2"], **more, **how, metrics=iter(TABLE))
    assert work.given == (problem, gains, ensemble, ["delay=x2"], 7) and rest == ["folder", told]
    work, *rest = judge.evaluate_shard(FINE, gains, ensemble, (2, 3), **more, **how, metrics=iter(TABLE))
    assert work.given == (problem, gains, ensemble, 7) and rest == [(2, 3), "folder", told]
    for work, *_ in (judge.evaluate(FINE, gains, ensemble), judge.evaluate_shard(FINE, gains, ensemble, (1, 1), out=0)):
        assert work.given == (Problem(FINE), gains, ensemble, judge.MEMBERS)
    work, *rest = degraded.degrade(FINE, gains, ensemble, [])
    assert work.given == (Problem(FINE), gains, ensemble, [], judge.MEMBERS) and rest == [None, None]


def test_laws_are_compared_by_what_is_asked_for(monkeypatch):
    """The settings that none of the laws would share are refused before pd walks for the objective."""
    asked = []

    def problem_of(scenario, search, **how):
        asked.append((scenario, search, how))
        return "problem"

    monkeypatch.setattr(compare.tune, "problem_of", problem_of)
    monkeypatch.setattr(compare, "run", lambda *given, **how: asked.append((given, how)) or "compared")
    ensemble, search, stage = Ensemble(members=3), Search(method="cmaes", starts=6, seed=5), contextlib.nullcontext
    how = {"metrics": iter(TABLE), "engine": OTHER, "out": "folder", "stage": stage, "members": 7, "iterations": 4}
    assert compare.compare(FINE, ["FootOffsets"], ensemble, search, seeds=2, **how) == "compared"
    (scenario, of_pd, walks), ((laws, base, wanted, members, seeds), kept) = asked
    assert scenario == FINE and of_pd == laws["retuned_pd"].search and base == "problem"
    assert walks == {"ensemble": ensemble, "metrics": TABLE, "engine": OTHER, "own_method": None}
    assert (wanted.starts, wanted.iterations, wanted.seed, wanted.joint_gains) == (6, 4, 5, True)
    assert [*laws] == ["FootOffsets", "retuned_pd"] and (members, seeds) == (7, 2)
    assert kept == {"out": "folder", "stage": stage}
    compare.compare(FINE, ["FootOffsets"], ensemble)
    (_, _, wanted, members, seeds), kept = asked[-1]
    assert (wanted.method, members, kept["out"]) == ("cmaes", judge.MEMBERS, None)
    assert (wanted.starts, wanted.iterations) in (compare.FEW, compare.MANY)
    assert seeds in (compare.SEEDS, compare.SEEDS_OF_MANY)


@pytest.mark.parametrize("kind", ["sweep", "evaluate"])
def test_shards_are_put_together_by_the_config_and_the_law_beside_them(kind, monkeypatch, tmp_path):
    asked, own = [], FINE.with_own(law={"name": "PlannedTransfer"})
    (tmp_path / "config.yaml").write_text(own.to_yaml())
    kept = [Kept(tmp_path, Shard(1, 2), {"kind": kind}, {}), Kept(tmp_path / "other", Shard(2, 2), {"kind": kind}, {})]

    def read(*given):
        asked.append(given)
        return types.SimpleNamespace(result=lambda arrays: arrays)

    monkeypatch.setattr(merge, "KINDS", dict.fromkeys(merge.KINDS, None) | {kind: read})
    monkeypatch.setattr(merge, "find", lambda folders: asked.append(folders) or kept)
    monkeypatch.setattr(merge, "joined", lambda work, found: found)
    assert merge.merge([str(tmp_path)], metrics=iter(TABLE)) is kept
    folders, (first, scenario, law, metrics) = asked
    assert folders == [tmp_path] and first is kept[0] and metrics == TABLE
    assert scenario == FINE and type(law) is PlannedTransfer
    given = VirtualModelAdmittance()
    merge.merge([tmp_path], law=given)
    assert asked[-1][2:] == (given, mc.METRICS)
    monkeypatch.undo()
    assert merge.KINDS == {"sweep": sweeps.read_asked, "evaluate": judge.read_asked}


@pytest.mark.parametrize("plans", [True, False])
@pytest.mark.parametrize(("scenario", "needs"), [(FINE, None), (COARSE, 5e-4)])
def test_a_search_stands_beside_pd_retuned_and_the_plan_and_on_worse_hardware(
    plans, scenario, needs, walks, monkeypatch
):
    """Walks begun before the search are not begun again; a plan that is no row has no walk."""
    asked, stages, plan = {}, [], types.SimpleNamespace(walked=Problem(scenario, law=PlannedTransfer(load=1.5)))
    rival = types.SimpleNamespace(gains=JOINT)
    for name, value in {"tests": "tested", "map_of": "map", "verify": "checked"}.items():
        monkeypatch.setattr(
            verification, name, lambda *given, key=name, told=value, **how: asked.update({key: (given, how)}) or told
        )
    monkeypatch.setattr(margins, "find", lambda *given, **how: asked.update(margins=(given, how)) or "margins")
    monkeypatch.setattr(retuned_pd, "joint_of", lambda found: found.gains)

    def conclusions(*given):
        asked["conclusions"] = given
        return {name: 0 for name in given[1] if name != "planned_unsearched"}, "broken", "worth", "said", "apart"

    monkeypatch.setattr(of_search, "conclusions", conclusions)
    monkeypatch.setattr(of_search, "with_joint_gains", lambda walk, problem: walk.scenario.control.kp)

    @contextlib.contextmanager
    def stage(name, **_):
        stages.append(name)
        yield ignore

    problem = Problem(scenario, engine=OTHER)
    found = types.SimpleNamespace(scenario=scenario, problem=problem, walked=problem, law=None, gains="gains", seeds=2)
    there = {name: lambda _: Walked(scenario, None, None, "begun") for name in ("pd", "config")}
    begun = of_search.Begun(
        lambda _: rival, (lambda _: plan) if plans else None, there, None, {"pd": lambda _: "pd", "config": lambda _: 1}
    )
    told = of_search.compare(found, stage, begun=begun)
    names = ["pd", "config", "tuned", *(["planned_transfer"] if plans else []), "retuned_pd"]
    every = names if plans else [*names, "planned_unsearched"]
    searches = ["retuned pd", "load transfer by plan"][: 1 + plans]
    assert stages == [*searches, *every, "map", "margins", "verification"]
    assert [*told.walks] == names and [*asked["conclusions"][1]] == every
    assert (told.over, told.hardware, told.checked) == ("map", "margins", "checked")
    assert (told.broken, told.worth, told.verdict, told.level) == ("broken", "worth", "said", "apart")
    given, (walked, others, at_step) = asked["conclusions"][0], asked["conclusions"][1:]
    assert given is found and others == (rival, plan if plans else None)
    step = scenario.time_step if needs is None else needs
    own = number_of(scenario)
    variations = {name: metrics["force_variation"] for name, (_, metrics) in walked.items()}
    retuned = under_pd(scenario).with_overrides(
        {"control.kp": 17.0, "control.kd": 1.0, "control.safe_kp": 50.0, "time_step": step}
    )
    expected = {"pd": own, "config": own, "tuned": own, "retuned_pd": number_of(retuned)}
    if plans:
        expected["planned_transfer"] = number_of(scenario, PlannedTransfer())
    else:
        expected["planned_unsearched"] = number_of(retuned, PlannedTransfer())
    assert variations == pytest.approx(expected) and walked["retuned_pd"][0] == 17.0
    if needs is None:
        assert at_step is None
    else:
        there = scenario.with_overrides({"time_step": needs})
        assert at_step[0] == needs and at_step[1]["force_variation"] == pytest.approx(number_of(there))
    (own, gains), how = asked["margins"]
    assert (own, gains, how["law"], how["engine"], how["retuned_step"]) == (scenario, "gains", None, OTHER, needs)
    assert how["walked"] == {"pd": "pd", "config": 1}
    others = {"config": Whole(None, {})} | ({} if needs else {margins.RETUNED: Whole(PD(), JOINT)})
    assert {name: (type(each.law), each.gains) for name, each in how["others"].items()} == {
        name: (type(each.law), each.gains) for name, each in others.items()
    }
    (checked,), how = asked["verify"]
    assert checked is found and (how["walks"], how["hardware"], how["tested"]) == ("map", "margins", "tested")
    assert how["metrics"]["force_variation"] == pytest.approx(number_of(scenario))


@pytest.mark.parametrize("ours", [0.2, 0.4])
@pytest.mark.parametrize(("better", "larger"), [("min_tsm", True), ("force_variation", False)])
def test_the_worth_at_the_knee_of_a_front_knows_which_way_a_metric_is_better(better, larger, ours):
    without = {f"without_{better}": 0.3, "without_kp": 20.0, "without_kd": 1.0, "without_law": retuned_pd.NAME}
    asked = types.SimpleNamespace(better=better, against="cost_of_transport")
    data = xr.Dataset({better: ("front", [9.0, ours])})
    found = types.SimpleNamespace(problem=Problem(FINE), rival=xr.Dataset(without), asked=asked, data=data, knee=1)
    assert ("does not pay" in worth.of_front(found)) is ((ours < 0.3) == larger)
    found.rival = None
    assert worth.of_front(found) == "pd has more cost of transport than the knee with any kp and kd of its grid"
