"""What a sweep is compared with: by few compiled programs, and what stands there before."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb import walks
from mjx_climb.control import law_of
from tests.shell import ROOT
from tuning.background import ignore
from tuning.comparisons import side_by_side
from tuning.problem import evaluation
from tuning.problem.evaluation import Problem

CASE = mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3"])
PD = evaluation.under_pd(CASE)


class Asked(Exception):
    """A walk was asked for."""


@pytest.mark.slow
def test_pd_by_the_program_of_base_admittance_walks_as_by_its_own():
    own, shared = mc.rollout(PD), evaluation.walk_of_pd(PD)
    assert shared.scenario == own.scenario and shared.law == own.law
    for name in mc.Gains.AXES:
        np.testing.assert_array_equal(getattr(shared.gains, name), getattr(own.gains, name))
    for name in ("joint_angles", "base_position", "foot_force"):
        np.testing.assert_allclose(getattr(shared, name), getattr(own, name), rtol=1e-6, atol=1e-9)
    for name, value in mc.metrics(own).items():
        assert mc.metrics(shared)[name] == (pytest.approx(value, rel=1e-6) if isinstance(value, float) else value), name


@pytest.mark.parametrize(
    ("changes", "law"),
    [
        ([], "VirtualModelAdmittance"),
        (["control.reading=measured_pose"], "PD"),  # another program walks the config's gains: pd has its own
        (["hardware.force_sensor.dead.LF=0.1"], "PD"),  # base admittance would notice that a sensor is silent
    ],
)
def test_pd_shares_the_compiled_program_where_that_is_another_walk_s(changes, law, monkeypatch):
    case, asked = mc.load_scenario(ROOT / "configs" / "case_1_2.yaml", ["duration=0.3", *changes]), []

    def rollout(scenario, gains=None, **_):
        asked.append(type(law_of(scenario)).__name__)
        raise Asked

    monkeypatch.setattr(mc, "rollout", rollout)
    walkers = {"pd": (evaluation.under_pd(case), None), "config": (case, None)}
    with pytest.raises(Asked):
        side_by_side.walks_together(Problem(case), walkers, lambda work: work)["pd"](ignore)
    assert asked == [law]


def test_histories_of_a_finer_walk_have_the_stretches_of_the_coarser_one():
    lines = {"line": np.sin(np.arange(1200) / 40)}
    finer, coarser = walks._extremes(lines, 600), walks._extremes({"line": lines["line"][1::2]})
    assert {name: len(values) for name, values in finer.items()} == {
        name: len(values) for name, values in coarser.items()
    }
    for name, values in finer.items():
        expected = lines["line"].reshape(200, 6)
        np.testing.assert_array_equal(values, expected.max(1) if name == "line" else expected.min(1))
