"""What a sweep is compared with: by few compiled programs, and what stands there before."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb import walks
from mjx_climb.control import PlannedTransfer, law_of
from mjx_climb.inputs.resolve import by_name
from tests.shell import ROOT
from tuning.background import ignore
from tuning.comparisons import side_by_side
from tuning.problem import evaluation
from tuning.problem.evaluation import Problem

CASE = mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3"])
PD = evaluation.under_pd(CASE)
PLAN = PlannedTransfer(load=1.1)


class Asked(Exception):
    """A walk was asked for."""


@pytest.mark.slow
@pytest.mark.parametrize("walker", [(PD, None), (CASE, None), (PD, PLAN)], ids=["pd", "base admittance", "by plan"])
def test_laws_by_one_program_walk_as_by_their_own(walker):
    scenario, law = walker
    own, shared = mc.rollout(scenario, law=law), evaluation.walk_of_any(scenario, law, beside=PLAN)
    assert shared.scenario == own.scenario and shared.law == own.law
    for name, value in by_name(own.gains).items():
        np.testing.assert_array_equal(by_name(shared.gains)[name], value)
    for name in ("joint_angles", "base_position", "foot_force"):
        np.testing.assert_allclose(getattr(shared, name), getattr(own, name), rtol=1e-6, atol=1e-9)
    for name, value in mc.metrics(own).items():
        assert mc.metrics(shared)[name] == (pytest.approx(value, rel=1e-6) if isinstance(value, float) else value), name


@pytest.mark.parametrize(
    ("changes", "law"),
    [
        ([], "VirtualModelAdmittance|PlannedTransfer"),
        (["control.reading=measured_pose"], "PD"),  # another program walks the config's gains: pd has its own
        (["hardware.force_sensor.dead.LF=0.1"], "PD"),  # base admittance would notice that a sensor is silent
    ],
)
def test_pd_shares_the_compiled_program_where_that_is_another_walk_s(changes, law, monkeypatch):
    case, asked = mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3", *changes]), []

    def rollout(scenario, law=None, **_):
        asked.append(type(law or law_of(scenario)).__name__)
        raise Asked

    monkeypatch.setattr(mc, "rollout", rollout)
    walkers = {"pd": (evaluation.under_pd(case), None), "config": (case, None)}
    with pytest.raises(Asked):
        side_by_side.walks_together(Problem(case), walkers, lambda work: work)["pd"](ignore)
    assert asked == [law]


def test_load_transfer_by_plan_shares_the_program_of_base_admittance(monkeypatch):
    asked = []

    def rollout(scenario, law=None, **_):
        asked.append(type(law))
        raise Asked

    monkeypatch.setattr(mc, "rollout", rollout)
    walkers = {"pd": (PD, None), "config": (CASE, None), "plan": (PD, PLAN)}
    for walk in side_by_side.walks_together(Problem(CASE), walkers, lambda work: work).values():
        with pytest.raises(Asked):
            walk(ignore)
    assert asked == [asked[0]] * 3 and asked[0].__name__ == "VirtualModelAdmittance|PlannedTransfer"


def test_histories_of_a_finer_walk_have_the_stretches_of_the_coarser_one():
    lines = {"line": np.sin(np.arange(1200) / 40)}
    finer, coarser = walks._extremes(lines, 600), walks._extremes({"line": lines["line"][1::2]})
    assert {name: len(values) for name, values in finer.items()} == {
        name: len(values) for name, values in coarser.items()
    }
    for name, values in finer.items():
        expected = lines["line"].reshape(200, 6)
        np.testing.assert_array_equal(values, expected.max(1) if name == "line" else expected.min(1))
