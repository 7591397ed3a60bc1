"""The paper's claims: each judged on made-up walks both ways, and the whole command."""

import contextlib
import dataclasses
import itertools
import json
import re
import types
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tests import approved
from tests.trajectories import still
from tuning.background import silent
from tuning.numbers import to_json
from tuning.pages.page import Origin
from tuning.reproduce import claims, results
from tuning.reproduce.claims import CASES, Pair, Verdict, Walk

STEPS = 2000
TIME = 1e-3 * np.arange(STEPS)
RIPPLE = np.sin(2 * np.pi * 10 * TIME)
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def walk(**changes):
    """A robot that glides 0.1 m in 2 s, 5 N on each foot, all grippers shut; arrays may be changed."""
    way = np.stack([0.05 * TIME, 0 * TIME, 0 * TIME + 0.11], 1)
    arrays = {"base_position": way, "base_reference": way, "foot_force": [0.0, 0.0, 5.0]}
    return still(mc.Scenario(duration=2.0), **arrays | changes)


def rippling(amplitude):
    """A walk in which forces, torques, margins and joint power swing."""
    force, torque = np.tile([0.0, 0.0, 5.0], (STEPS, 4, 1)), np.full((STEPS, 4, 3), 0.3)
    force[:, 1, 2] += amplitude * RIPPLE
    torque[:, 2, 1] += amplitude * RIPPLE
    margins = {"tsm": 0.1 + 0.01 * amplitude * RIPPLE, "gia_margin": 8 + amplitude * RIPPLE}
    return walk(foot_force=force, joint_torque=torque, joint_rates=torque, **margins)


def pushed(*shifts):
    """A walk in which two pushes, one along -y, move the base by so many metres; it then stays there."""
    push, position = np.zeros((STEPS, 6)), walk().base_position.copy()
    for start, force, axis, shift in ((200, 5.0, 0, shifts[0]), (1000, -5.0, 1, shifts[1])):
        push[start : start + 500, axis] = force
        position[start:, axis] += np.sign(force) * shift * np.minimum(np.arange(STEPS - start) / 500, 1)
    return walk(push=push, base_position=position)


def torn(limb, second):
    """A walk that loses a gripper."""
    torn_off, detached = np.zeros((STEPS, 4), bool), np.zeros((STEPS, 4), bool)
    row = round(second * 1000)
    torn_off[row, limb], detached[row + 1 :, limb] = True, True
    return walk(torn_off=torn_off, detached=detached, support=~detached)


def judged(claim, baseline, proposed, case="2"):
    return claims.CLAIMS[claim].judge(Pair(baseline, proposed), CASES[case])


@pytest.mark.parametrize("claim", ["force_oscillation", "torque_spikes", "margin_fluctuation", "cost_of_transport"])
def test_what_swings_less_bears_the_claim_out(claim):
    calm, rough = rippling(0.5), rippling(1.0)
    assert judged(claim, rough, calm, "1.2").holds is True
    assert judged(claim, rough, calm, "1.2").measured["change"] < 0
    assert judged(claim, calm, rough, "1.2").holds is judged(claim, rough, rough, "1.2").holds is False


@pytest.mark.parametrize(
    ("claim", "expected"),
    [
        # ten swings a second for two seconds; other feet hide the half of them below 5 N
        ("force_oscillation", {"force_variation": (40, 20), "peak_foot_force": (6.0, 5.5)}),
        ("torque_spikes", {"torque_variation": (80, 40), "peak_joint_torque": (1.3, 0.8)}),
    ],
)
def test_numbers_of_force_and_torque(claim, expected):
    verdict = judged(claim, rippling(1.0), rippling(0.5))
    for name, pair in expected.items():
        slack = 0.01 if name.endswith("variation") else 1e-6
        assert tuple(verdict.measured[name].values()) == pytest.approx(pair, rel=slack)
    assert "(-50.0 %)" in verdict.sentence


def test_torque_must_fall_in_peak_and_variation():
    spike = rippling(0.5).joint_torque.copy()
    spike[700, 0, 0] = 2.0
    support = np.ones((STEPS, 4), bool)
    support[700:1200, 0] = False
    verdict = judged("torque_spikes", rippling(1.0), walk(joint_torque=spike, support=support))
    assert verdict.holds is False
    assert "vary less, but their peak does not fall" in verdict.sentence
    assert verdict.measured["peak_away_from_grip_changes"]["proposed"] == pytest.approx(0.8)
    assert "away from grip changes the peak goes from 1.3 to 0.8 N m" in verdict.sentence


@pytest.mark.parametrize(
    ("baseline", "proposed", "case", "holds"),
    [
        ("early", "whole", "1.1", True),
        ("whole", "late", "1.1", False),
        ("early", "late", "1.1", False),
        # nobody fails: a disagreement where the paper's baseline fails, else nothing to avoid
        ("whole", "whole", "1.1", False),
        ("whole", "whole", "2", None),
    ],
)
def test_detachment(baseline, proposed, case, holds):
    walks = {"whole": walk(), "early": torn(2, 0.5), "late": torn(1, 1.5)}
    verdict = judged("detachment", walks[baseline], walks[proposed], case)
    assert verdict.holds is holds
    assert ("baseline loses RH at 0.50 s" in verdict.sentence) == (baseline == "early")
    lost = {"whole": None, "early": 0.5, "late": 1.5}
    assert verdict.measured["detached_at"] == {"baseline": lost[baseline], "proposed": lost[proposed]}


def test_margins_count_up_to_the_first_loss():
    calm, rough = rippling(0.5), rippling(1.0)
    rough_then_lost = dataclasses.replace(rough, torn_off=torn(0, 1.0).torn_off)
    verdict = judged("margin_fluctuation", rough_then_lost, calm, "1.1")
    assert verdict.holds is True
    assert verdict.measured["until"] == pytest.approx(0.999)
    assert verdict.measured["gia_margin_variation"]["baseline"] == pytest.approx(40, rel=0.01)
    at_once = dataclasses.replace(rough, torn_off=torn(0, 0.0).torn_off)
    assert judged("margin_fluctuation", at_once, calm, "1.1").holds is None
    for row, said in ((1, None), (2, True)):  # one instant has no variation
        soon = dataclasses.replace(rough, torn_off=torn(0, 1e-3 * row).torn_off)
        assert judged("margin_fluctuation", soon, calm, "1.1").holds is said
    weightless = [dataclasses.replace(each, tsm=np.full(STEPS, np.nan)) for each in (rough, calm)]
    verdict = judged("margin_fluctuation", *weightless)
    assert verdict.holds is True and "no TSM is defined" in verdict.sentence


@pytest.mark.parametrize(
    ("baseline", "proposed", "holds"),
    [
        ((0.001, 0.001), (0.002, 0.003), True),
        ((0.002, 0.003), (0.001, 0.001), False),
        ((0.001, 0.001), (0.002, 0.0005), False),  # not with every push
        ((0.001, 0.001), (0.002, -0.003), False),  # leans into it
    ],
)
def test_base_moves_with_the_push(baseline, proposed, holds):
    verdict = judged("moves_with_push", pushed(*baseline), pushed(*proposed))
    assert verdict.holds is holds
    means = {"baseline": np.divide(baseline, 2), "proposed": np.divide(proposed, 2)}  # of ramps
    assert verdict.measured["shifts"] == {name: pytest.approx(mean, rel=0.01) for name, mean in means.items()}
    assert judged("moves_with_push", walk(), walk(), "1.1").holds is None


def test_a_base_that_was_off_before_a_push_moves_no_further_with_it():
    base, further = pushed(0.001, 0.001), pushed(0.002, 0.003)
    off = dataclasses.replace(further, base_position=further.base_position + 0.01)
    shifts = [judged("moves_with_push", base, each).measured["shifts"]["proposed"] for each in (further, off)]
    np.testing.assert_allclose(*shifts, atol=1e-6)


def test_levels_are_compared_without_detachment():
    """A baseline that lost a gripper early looks calm; without detachment it is rough."""
    baseline = Walk(torn(2, 0.5), rippling(1.0))
    verdict = claims.judge("force_oscillation", baseline, Walk(rippling(0.5)), CASES["1.1"])
    assert verdict.holds is True
    assert verdict.sentence.endswith("(grippers that never let go).")
    # also where the proposed controller alone lost one
    verdict = claims.judge("force_oscillation", Walk(rippling(1.0)), Walk(torn(2, 0.5), rippling(0.5)), CASES["1.1"])
    assert verdict.holds is True and verdict.sentence.endswith("(grippers that never let go).")
    verdict = claims.judge("force_oscillation", Walk(rippling(1.0)), Walk(rippling(0.5)), CASES["1.1"])
    assert "never let go" not in verdict.sentence
    assert claims.judge("detachment", baseline, Walk(walk()), CASES["1.1"]).holds is True


def test_nothing_is_said_of_a_walk_that_diverges():
    lost = walk().base_position.copy()
    lost[1500:] = np.nan
    for name in claims.CLAIMS:
        verdict = claims.judge(name, Walk(walk()), Walk(walk(base_position=lost)), CASES["2"])
        assert verdict.holds is None
        assert "proposed controller diverges" in verdict.sentence


def test_all_claims_are_judged_and_shown():
    """The baseline that follows the actual base is judged where the paper's baseline fails; tables hold it all."""
    from tuning import numbers

    baseline = Walk(torn(2, 0.5), rippling(1.0))
    walks = {name: Walk(rippling(0.5)) for name in claims.METHODS} | {"pd": baseline, "pd_actual": baseline}
    metrics = {name: mc.metrics(w.trajectory) for name, w in walks.items()}
    found = {
        name: results.Reproduction(CASES[name], walks, metrics, claims.judge_all(walks, CASES[name]))
        for name in ("1.1", "2")
    }
    assert "detachment_actual" in found["1.1"].verdicts["virtual_model"]
    assert "detachment_actual" not in found["2"].verdicts["virtual_model"]
    markdown = results.as_markdown(found)
    assert "| detached at | s | fails | holds | 0.5 | 0.5 | holds | holds | holds |" in markdown
    assert "| cost of transport |  | 8.88e4 | 6.86e4 |" in markdown
    assert "in the paper from 8.88e+04 to 6.86e+04 (-22.7 %)" in markdown
    assert "Virtual model: yes: the reaction force oscillates less" in markdown
    table = results.tables(found)[1]
    row = dict(zip(table.columns, table.sections[0][1][0], strict=True))
    assert row["1.1 virtual model"] == row["2 measured pose"] == "yes, -50.0 %"
    plain = json.loads(numbers.to_json(results.as_json(found)["cases"]["1.1"]))
    assert plain["runs"]["pd"]["metrics_without_detachment"]["detached_at"] is None
    assert {claim["reading"] for claim in plain["claims"]} == set(claims.READINGS)


def test_claims_and_their_report_are_those_that_were_read(monkeypatch):
    """Every claim on walks of every kind, with its numbers and its sentence; then all that the command writes."""
    spiked, support = rippling(0.5).joint_torque.copy(), np.ones((STEPS, 4), bool)
    spiked[700:719, 0, 0] = 2.0
    support[700:1200, 0] = False
    weightless = {"tsm": np.full(STEPS, np.nan), "gia_margin": np.full(STEPS, np.nan)}
    pulling = np.tile([3.0, 0.0, -4.0], (STEPS, 4, 1))
    rough, calm, plain, swinging = rippling(1.0), rippling(0.5), walk(), ("force_oscillation", "torque_spikes")
    swinging = (*swinging, "margin_fluctuation", "cost_of_transport")
    pairs = {
        "calmer": (rough, calm, swinging), "rougher": (calm, rough, swinging),
        "hardly calmer": (rough, rippling(0.996), swinging[:3]),
        "spiked": (rough, walk(joint_torque=spiked, support=support), ("torque_spikes",)),
        "lost early": (torn(2, 0.5), plain, ("detachment", "margin_fluctuation")),
        "lost late": (plain, torn(1, 1.5), ("detachment", "margin_fluctuation")),
        "lost at once": (torn(3, 0.0), plain, ("detachment", "margin_fluctuation")),
        "pushed further": (pushed(0.001, 0.002), pushed(0.003, 0.004), ("moves_with_push",)),
        "pushed less": (pushed(0.001, 0.002), pushed(0.003, 0.001), ("moves_with_push",)),
        "pulling": (walk(foot_force=pulling), walk(foot_force=0.5 * pulling), ("detachment", "moves_with_push")),
        "weightless": (walk(**weightless), walk(**weightless), ("margin_fluctuation",)),
        "nowhere": (plain, walk(base_position=0.11), ("cost_of_transport",)),
    }  # fmt: skip
    lines, known, compute = [], {}, mc.metrics
    monkeypatch.setattr(mc, "metrics", lambda own: known.get(id(own)) or known.setdefault(id(own), compute(own)))
    for name, (*pair, asked) in pairs.items():
        for claim, case in itertools.product(asked, ("1.1", "1.2")):
            if case == "1.1" or claim in ("detachment", "cost_of_transport"):
                told = judged(claim, *pair, case)
                lines += [f"{name}, {claim}, {case}: {told.holds}; {told.sentence}"]
                lines += approved.of_json(json.loads(to_json(told.measured)), "  ") if told.measured else []
    each = {
        "1.1": dict.fromkeys(claims.METHODS, Walk(calm)) | {"pd": Walk(torn(2, 0.5), rough)},
        "1.2": dict.fromkeys(claims.METHODS, Walk(plain)) | {"pd": Walk(rough), "measured_pose": Walk(calm)},
        "2": dict.fromkeys(claims.METHODS, Walk(pushed(0.003, 0.004))) | {"pd": Walk(pushed(0.001, 0.002))},
    }
    found = {}
    for case, walks in each.items():
        metrics = {method: mc.metrics(own.trajectory) for method, own in walks.items()}
        found[case] = results.Reproduction(CASES[case], walks, metrics, claims.judge_all(walks, CASES[case]))
    lines += ["--- markdown", results.as_markdown(found), "--- terminal", *results.lines(found), results.verdict(found)]
    one = {"1.2": found["1.2"]}
    lines += ["--- json", *approved.of_json(json.loads(to_json(results.as_json(one))))]
    page = results.page(one, Path("out"), Origin("", "ask", "again"))
    lines += [f"--- page {page.title}", *page.findings.lines, *map(str, page.facts.items())]
    lines += [f"{caption} {file}" for caption, file in page.origin.pictures.items()]
    (shown,) = page.explorers.values()
    lines += [f"shown: {', '.join(walk['name'] for walk in shown['walks'] if walk['shown'])}"]
    approved.check(Path(__file__).parent / "approved_claims.txt", "\n".join([*lines, ""]))


def test_a_run_says_its_reading_its_reference_and_the_gains_that_it_has():
    """Eq. 3 alone is read two ways; pd has no gains of an admittance."""
    scenario, walks = mc.Scenario(), {}
    for name, method in claims.METHODS.items():
        walks[name] = Walk(types.SimpleNamespace(scenario=scenario.with_overrides(method.changes)))
    metrics = {name: {"travel": number} for number, name in enumerate(walks)}
    found = results.as_json({"1.1": results.Reproduction(CASES["1.1"], walks, metrics, {})})["cases"]["1.1"]
    control = scenario.control
    gains = {"inertia": control.inertia, "damping": control.damping, "stiffness": control.stiffness}
    expected = {
        "pd": ("pd", None, "nominal", None), "pd_actual": ("pd", None, "actual", None),
        "virtual_model": ("base_admittance", "virtual_model", "nominal", gains),
        "measured_pose": ("base_admittance", "measured_pose", "nominal", gains),
        "end_effector": ("end_effector_admittance", None, "nominal", gains),
    }  # fmt: skip
    keys = ("controller", "reading", "base_reference", "gains", "metrics", "metrics_without_detachment")
    assert found["runs"] == {
        name: dict(zip(keys, (*told, metrics[name], None), strict=True)) for name, told in expected.items()
    }
    assert found["paper"]["cost_of_transport"] == {"baseline": None, "proposed": 1.31}
    assert found["paper"]["baseline_detaches"] is True and found["title"] == "Earth gravity, 1 kg of cargo"


def test_the_verdict_on_the_paper_counts_claims():
    holds = dict.fromkeys(claims.CLAIMS, True) | {"detachment": None, "cost_of_transport": False}

    def case(**changes):
        verdicts = {claim: Verdict(value, {}, "") for claim, value in (holds | changes).items()}
        return results.Reproduction(CASES["2"], {}, {}, dict.fromkeys(claims.READINGS, verdicts))

    text = results.verdict({"1.2": case(), "2": case(torque_spikes=False)})
    assert text.count("3 hold wherever they can be judged and 1 in some cases only") == 2


@pytest.mark.slow
def test_a_torn_gripper_asks_for_a_second_walk():
    scenario = mc.Scenario().with_overrides({"duration": 0.5, "contact.holding_limit": 0.5, "control.controller": "pd"})
    scenario = scenario.with_overrides({"gravity": [0.0, 0.0, -9.81e-6], "gait.cycle": 0.5})
    pair = results.walked(scenario, silent, "weak")
    assert pair.trajectory.torn_off.any()
    assert pair.unlimited is not None and not pair.unlimited.torn_off.any()
    strong = scenario.with_overrides({"contact.holding_limit": 1000.0})
    assert results.walked(strong, silent, "strong").unlimited is None


def test_the_configs_are_the_papers():
    gains = {"1.1": (1, 1e4, 4e5), "1.2": (1, 5e3, 5e4), "2": (1, 5e3, 2e4)}
    for name, scenario in results.scenarios().items():
        control = scenario.control
        assert (control.inertia, control.damping, control.stiffness) == gains[name]
        assert (scenario.contact.holding_limit, scenario.duration) == (15.0, 8.0)


@pytest.mark.nightly
def test_the_whole_command(tmp_path, call):
    code, out, _ = call("reproduce", "--out", tmp_path, "--json")
    found = json.loads(out)
    assert code == 0 and found == json.loads((tmp_path / "reproduce.json").read_text())
    assert list(found["cases"]) == ["1.1", "1.2", "2"]
    for name, case in found["cases"].items():
        assert set(case["runs"]) == set(claims.METHODS)
        for method, run in case["runs"].items():
            assert set(run["metrics"]) == set(mc.METRICS.names)
            with xr.open_dataset(tmp_path / f"{results.stem(name)}-{method}.nc") as dataset:
                assert dataset.sizes["time"] == 8000
        for kind in ("png", "yaml"):
            assert (tmp_path / f"{results.stem(name)}.{kind}").stat().st_size > 0
        holds = {(claim["claim"], claim["reading"]): claim["holds"] for claim in case["claims"]}
        for reading in claims.READINGS:
            assert holds["force_oscillation", reading] is True
            assert holds["margin_fluctuation", reading] is True
            assert holds["moves_with_push", reading] is (True if name == "2" else None)
            # the baseline holds in ours: what the paper reports is not reproduced
            assert holds["detachment", reading] is (False if name == "1.1" else None)
        assert holds["cost_of_transport", "measured_pose"] is False

    assert "case 1.1" in (tmp_path / "tables.txt").read_text()
    assert "Of the paper&#39;s 6 claims" in (tmp_path / "report.html").read_text()
    # the page in docs says what the run says; numbers may differ in their last digits on another machine
    page = (Path(__file__).parents[3] / "docs" / "studies" / "paper_run.md").read_text()
    ours = (tmp_path / "paper.md").read_text()
    written = re.search(r"<!-- begin of what the run wrote -->\n(.*)\n<!-- end -->", page, re.DOTALL).group(1)
    assert NUMBER.sub("#", written).strip() == NUMBER.sub("#", ours).strip()
    for line, expected in zip(written.strip().splitlines(), ours.strip().splitlines(), strict=True):
        slack = 0.2 if "%" in line else 1e-4  # per cent come with one digit after the point
        read, own = ([float(found) for found in NUMBER.findall(text)] for text in (line, expected))
        assert read == pytest.approx(own, rel=0.01, abs=slack), expected


def test_each_case_walks_by_each_method_and_once_more_where_a_gripper_lets_go(monkeypatch, tmp_path):
    """Without walking: which walk is written, drawn and judged."""
    asked, stages, drawn = [], [], []

    def rollout(scenario):
        asked.append(scenario)
        torn = scenario.contact.holding_limit is not None and scenario.control.controller == "pd"
        return types.SimpleNamespace(scenario=scenario, torn_off=np.array([torn, False]))

    @contextlib.contextmanager
    def stage(name):
        stages.append(name)
        yield

    monkeypatch.setattr(mc, "rollout", rollout)
    monkeypatch.setattr(mc, "metrics", lambda walk: ("metrics", walk.scenario))
    monkeypatch.setattr(results.dataset, "to_dataset", lambda walk: walk.scenario)
    monkeypatch.setattr(results.dataset, "save", lambda data, file: drawn.append((file.name, data)))
    monkeypatch.setattr(results.plots, "plot_comparison", lambda walks, title: (walks, title))
    monkeypatch.setattr(results.plots, "save_figure", lambda figure, file: drawn.append((file.name, *figure)))
    monkeypatch.setattr(results.claims, "judge_all", lambda walks, case: (walks, case))
    found = dict(results.reproduced(tmp_path, stage))
    cases = results.scenarios()
    assert [*found] == [*cases] == [*results.CASES]
    for name, scenario in cases.items():
        own, case, stem = found[name], results.CASES[name], f"case_{name.replace('.', '_')}"
        assert (tmp_path / f"{stem}.yaml").read_text() == scenario.to_yaml() and own.published == case
        assert [*own.walks] == [*own.metrics] == [*results.METHODS] and own.verdicts == (own.walks, case)
        for method, what in results.METHODS.items():
            changed, walk = scenario.with_overrides(what.changes), own.walks[method]
            torn = changed.control.controller == "pd"
            assert walk.trajectory.scenario == changed and own.metrics[method] == ("metrics", changed)
            assert (walk.unlimited is not None) == torn and (f"{stem}-{method}.nc", changed) in drawn
            assert stages.count(f"case {name}, {what.title}") == 1
            if torn:
                free = changed.with_overrides({"contact.holding_limit": None})
                assert walk.unlimited.scenario == free and (f"{stem}-{method}-unlimited.nc", free) in drawn
                assert f"case {name}, {what.title}, grippers that never let go" in stages
        ((walks, title),) = [rest for file, *rest in drawn if file == stem]
        assert title == f"Case {name}: {case.title}"
        assert walks == {results.METHODS[key].title: own.walks[key].trajectory for key in results.FIGURE}
    assert len(asked) == len(stages) and len(drawn) == len(stages) + len(cases)
