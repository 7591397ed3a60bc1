"""Margins: found where walks of a known kind fail, and where those of the independent program do."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.from_scenario import own_parameters
from tuning.background import silent
from tuning.comparisons import deployment, linear_margins, margins, stability_limit
from tuning.gains import gains_file
from tuning.gains.gains_file import Whole, by_name
from tuning.problem.evaluation import RIGID

REFERENCE = json.loads((Path(__file__).parents[2] / "reference" / "hardware_walks.json").read_text())
GAINS = mc.Gains(1.0, 150.0, 3e3, kp=np.asarray(20.0), kd=np.asarray(0.1))
RETUNED_KP = 40.0  # with which pd's force varies by 75 N, not 100 N
TORN, DEARER, DIVERGES, WEAK = 9.5e-3, 7.1e-3, 20.5e-3, 0.31


def is_pd(law, gains):
    """Return whether gains walk as pd: under it, or under base admittance with a mass that nothing moves."""
    return isinstance(law, PD) or bool(np.all(by_name(gains).get("inertia", 1.0) == RIGID))


@pytest.fixture
def walks(monkeypatch):
    """Walks whose failures are known: what is walked is kept."""
    kept = []

    def walked(scenario, gains, parameters, *, law, metrics, engine, progress):
        kept.append((law, gains, parameters))
        given = not is_pd(law, gains)
        retuned = parameters.joint_loop.kp == RETUNED_KP
        variation = (
            np.where(given, 50.0, np.where(retuned, 75.0, 100.0))
            + given * 50.0 * np.maximum(parameters.force_sensor.delay, 0) / DEARER
        )
        weak = parameters.joint_loop.kp < WEAK * (20.0 if given else 50.0)
        return {
            "force_variation": np.where(parameters.bus.command_delay > DEARER, 200.0 * given, variation),
            "detached_at": np.where(given & (parameters.force_sensor.delay > TORN), 3.0, np.nan),
            "diverged": (given & (parameters.bus.control_period > DIVERGES)) | weak,
        }

    monkeypatch.setattr(mc, "rollout_metrics", walked)
    return kept


def test_margins_lie_where_walks_begin_to_fail(walks, case):
    """To a sixth of what the first grid leaves open; the control period to a time step.

    pd's walks of the first grid are the same whatever gains are in question: given, they are not repeated.
    """
    scenario = case("case_1_2", "virtual_model")
    whole = margins.find(scenario, GAINS)
    found = whole.margins
    assert whole.holds and whole.better and margins.warnings(whole) == []
    assert found["force_delay"].holds == pytest.approx(TORN, abs=4e-4) and found["force_delay"].holds <= TORN
    assert found["force_delay"].better == pytest.approx(DEARER, abs=4e-4) and found["force_delay"].better < DEARER
    assert found["command_delay"].better == pytest.approx(DEARER, abs=4e-4)
    assert found["command_delay"].holds == found["command_delay"].worst == 0.03
    assert found["control_period"].holds == found["control_period"].better == pytest.approx(20e-3)
    assert found["joint_gains"].holds == found["joint_gains"].better == pytest.approx(WEAK, abs=0.02)
    known = {"pd": margins.on_the_grid(scenario, margins.pd_of(scenario))}
    again = margins.find(scenario, GAINS, walked=known)
    assert len(walks) == 2 * 4  # of given gains and of pd, on two grids
    assert again.walks.identical(whole.walks) and again.margins == whole.margins


def test_what_is_walked_is_the_scenario_with_one_thing_changed(walks, case):
    hardware = {"hardware.control_period": 0.005, "hardware.force_sensor.delay": 0.002, "hardware.seed": 3}
    scenario = case("case_1_2", "virtual_model", hardware)
    margins.find(scenario, GAINS)
    (_, gains, given), (law, of_pd, pd) = walks[:2]
    assert is_pd(law, of_pd) and set(by_name(gains)) == {"inertia", "damping", "stiffness"}
    changed = {
        0: (given.force_sensor.delay, 0.002), 1: (given.bus.command_delay, 0.0), 2: (given.bus.control_period, 0.005),
        3: (given.joint_loop.kp, 20.0),
    }  # fmt: skip
    for row, (values, own) in changed.items():
        assert len(np.unique(values[row])) > 10
        np.testing.assert_array_equal(np.delete(values, row, 0), own)
    np.testing.assert_array_equal(given.force_sensor.delay[0], given.base_estimate.delay[0])
    np.testing.assert_allclose(given.joint_loop.kd / given.joint_loop.kp, 0.1 / 20)
    np.testing.assert_allclose(pd.joint_loop.kp / given.joint_loop.kp, 50 / 20)  # pd has the scenario's own
    assert given.bus.seed == 3


@pytest.mark.parametrize(
    ("law", "changes", "shared"),
    [("virtual_model", {}, True), ("measured_pose", {}, False), ("pd", {}, False), ("end_effector", {}, False),
     ("virtual_model", {"hardware.force_sensor.dead": {"LF": 0.1}}, False)],
)  # fmt: skip
def test_pd_walks_on_worse_hardware_by_the_program_of_base_admittance_where_the_config_does(
    law, changes, shared, walks, case
):
    """Elsewhere, and where base admittance would notice that a sensor is silent, by its own."""
    scenario = case("case_1_2", law, changes)
    for pd in (margins.pd_of(scenario), Whole(PD(), {"kp": RETUNED_KP, "kd": 0.2})):
        margins.on_the_grid(scenario, pd)
        of_pd, gains, parameters = walks.pop()
        assert (of_pd is None) == shared and is_pd(of_pd, gains)
        assert np.unique(parameters.joint_loop.kp).max() == by_name(pd.gains)["kp"]
    margins.on_the_grid(scenario, Whole(None, GAINS))
    assert walks.pop()[1].inertia != RIGID


def test_gains_pay_as_long_as_they_are_better_than_pd_retuned_where_it_walks_too(walks, case):
    """They were compared with pd as the config has it alone."""
    others = {"config": Whole(None, {}), margins.RETUNED: Whole(PD(), {"kp": RETUNED_KP, "kd": 0.2})}
    late = case("case_1_2", "virtual_model", {"hardware.force_sensor.delay": 3e-3})
    found = margins.find(late, GAINS, others=others)
    delay = found.margins["force_delay"]
    assert delay.better == pytest.approx(DEARER / 2, abs=4e-4) and delay.holds == pytest.approx(TORN, abs=4e-4)
    assert found.better and (found.rival, delay.rival) == ("retuned pd", "retuned pd")
    assert margins.warnings(found)[0].startswith("force delay: gains stay better than retuned pd up to 3.")
    later = case("case_1_2", "virtual_model", {"hardware.force_sensor.delay": 4e-3})
    worse = margins.find(later, GAINS, others=others)
    assert not worse.better and margins.warnings(worse)[0].endswith("the force varies no less than under retuned pd")


def test_margins_say_that_pd_is_not_retuned_where_pd_retuned_has_a_time_step_of_its_own(walks, case):
    late = case("case_1_2", "virtual_model", {"hardware.force_sensor.delay": 8e-3})
    found = margins.find(late, GAINS, retuned_step=5e-4)
    pd = "pd not retuned (pd retuned walks at steps of 0.0005 s)"
    delay = found.margins["force_delay"]
    assert delay.better == pytest.approx(DEARER, abs=4e-4)
    assert delay.sentence.endswith(f", better than {pd} up to {1e3 * delay.better:.3g} ms")
    assert margins.warnings(found)[0] == f"on the hardware itself the force varies no less than under {pd}"


@pytest.mark.parametrize(
    ("reached", "said"),
    [
        ((8e-3, 5e-3), "holds up to 8 ms, better than retuned pd up to 5 ms"),
        ((0.03, None), "holds up to 30 ms or more"),
        ((None, None), "holds at no value"),
    ],
)
def test_a_margin_is_a_sentence(reached, said):
    margin = margins.Margin(0.0, *reached, 0.03, "force delay", rival=margins.RETUNED)
    assert margin.sentence == f"force delay: {said}"


def test_less_than_twice_the_hardware_is_a_warning_by_name(walks, case):
    own = {"hardware.force_sensor.delay": 4e-3, "hardware.command_delay": 3e-3, "hardware.control_period": 0.011}
    lines = margins.warnings(margins.find(case("case_1_2", "virtual_model", own), GAINS))
    assert [line.split(":")[0] for line in lines] == ["force delay", "control period"]
    assert "stay better than pd up to" in lines[0] and "the hardware has 4 ms, 8 ms would be safe" in lines[0]
    assert "hold up to 20 ms only, the hardware has 11 ms, 22 ms would be safe" in lines[1]


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        (8e-3, ["on the hardware itself the force varies no less", "force delay: gains hold"]),
        (10e-3, ["on the hardware itself the walk fails"]),
    ],
)
def test_gains_of_no_use_on_the_hardware_itself_are_said_to_be_so_once(walks, case, delay, expected):
    found = margins.find(case("case_1_2", "virtual_model", {"hardware.force_sensor.delay": delay}), GAINS)
    lines = margins.warnings(found)
    assert len(lines) == len(expected) and all(map(str.startswith, lines, expected))


def test_any_path_has_a_margin(monkeypatch, case):
    """Values go from the scenario's own to the worst that is asked for, up or down."""
    asked = []

    def walked(scenario, gains, parameters, *, law, **_):
        asked.append(parameters)
        soft = np.asarray(parameters.contact.damping) < 20.0 * 0.3
        heavy = np.asarray(parameters.mass_scale) > 1.4
        lost = np.where((soft | heavy) & (not isinstance(law, PD)), 1.0, np.nan)
        return {"force_variation": np.ones(lost.shape), "detached_at": lost, "diverged": np.zeros(lost.shape, bool)}

    monkeypatch.setattr(mc, "rollout_metrics", walked)
    scenario = case("case_1_2", "virtual_model")
    wanted = margins.quantities(scenario, ["contact.damping=x0.1", "mass_scale=2", "gravity=x3"])
    found = margins.find(scenario, GAINS, asked=wanted).margins
    damping, mass, gravity = found.values()
    assert damping.holds == pytest.approx(0.3, abs=0.01) and damping.in_words(damping.holds) == "x 0.3"
    assert damping.own == 1 and damping.needed == 0.5 and damping.falls_short("gains hold", damping.holds) == []
    assert mass.holds == pytest.approx(1.4, abs=0.01) and mass.own == 1 and mass.worst == mass.needed == 2
    says = "mass_scale: gains hold up to 1.39 only, the hardware has 1, 2 would be safe"
    assert mass.falls_short("gains hold", 1.39) == [says]
    assert gravity.in_words(gravity.holds) == "x 3 or more"
    assert np.shape(asked[0].gravity) == (3, margins.POINTS, 3)
    np.testing.assert_allclose(asked[0].gravity[2, -1] / scenario.gravity[2], [0, 0, 3])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("contact.damping", "expected PATH=VALUE or PATH=xFACTOR, each path once, got 'contact.damping'"),
        ("contact.damping=soft", "expected PATH=VALUE or PATH=xFACTOR, each path once"),
        (
            "contact.spread=0.5",
            "contact.spread: expected a value at contact.spread to change, got Gripper",
        ),
        ("contact.damping=-1", "contact.damping: expected finite numbers of 0 or more, got -1"),
        ("gravity=3", "gravity: expected a factor, as x0.1, as the value is an array, got 3"),
        ("contact.damping=x0.5 contact.damping=x0.2", "each path once, got 'contact.damping=x0.2'"),
        ("mass_scale=1", "mass_scale: expected another value than the scenario's own, 1, got 1"),
        (
            "hardware.command_delay=x2",
            "hardware.command_delay: expected another value than the scenario's own, 0",
        ),
    ],
)
def test_a_quantity_that_cannot_get_worse_is_refused_in_one_line(case, text, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)) as refused:
        margins.quantities(case("case_1_2", "virtual_model"), text.split())
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("limits", "values", "step", "expected"),
    [
        ((1.3, 2.9), np.arange(4.0), 0.0, 1.3),
        ((2.4, 1.7), np.arange(4.0), 0.0, 1.7),  # a stance that is the worst only below the other's limit
        ((5.0, 4.0), np.arange(4.0), 0.0, 3.0),  # all are stable
        ((-1.0, 4.0), np.arange(4.0), 0.0, None),
        ((0.0207, 1.0), np.array([0.001, 0.015, 0.029]), 0.001, 0.02),
        ((-0.37, -0.2), -np.geomspace(1.0, 0.1, 9), 0.0, -0.37),
    ],
)
def test_the_linear_margin_is_bisected(limits, values, step, expected):
    """Never beyond it, and short of it by a thousandth at most; what is asked of one stance is of the worst."""
    steep = np.array([1.0, 10.0])
    asked = []

    def radii(some, only=None):
        asked.append(only)
        every = 1 + steep * (some[:, None] - np.array(limits))
        return every if only is None else every[:, [only]]

    found = linear_margins.crossing(values, radii, step)
    assert found == (expected and pytest.approx(expected, rel=1e-3)) and asked[0] is None
    assert found is None or (found <= expected + 1e-12 and asked.count(None) <= 3)


def test_a_linear_margin_of_the_control_period_is_whole_steps(case, monkeypatch):
    def radii(scenario, gains, parameters, **_):
        return 1 + 10 * (np.reshape(parameters.bus.control_period, (-1, 1)) - 7.4e-3)

    monkeypatch.setattr(stability_limit, "by_stance", radii)
    asked = {"control_period": margins.Margin(1e-3, 9e-3, 9e-3, 0.03, "control period")}
    found = linear_margins.find(case("case_1_2", "virtual_model"), GAINS, asked)["control_period"]
    assert found.up_to == pytest.approx(7e-3, rel=1e-12)


@pytest.mark.slow
def test_a_disturbance_leaves_the_linearised_loop_as_it_is(case):
    """It is in no linearisation: the loop is stable up to its last value."""
    scenario = case("case_1_2", "virtual_model", {"disturbance.others": [{"kind": "link_wrench", "force": [1, 0, 0]}]})
    wanted = margins.quantities(scenario, ["disturbance.others.0.force=x4"])
    asked = {name: margins.Margin(1.0, 4.0, 4.0, 4.0, unit="x") for name in wanted}
    (found,) = linear_margins.find(scenario, GAINS, asked, asked=wanted).values()
    assert found.up_to == found.tried > 1


@pytest.mark.parametrize(
    ("own", "holds", "stable", "warned"),
    [
        (4e-3, 9e-3, 7e-3, True),
        (4e-3, 9e-3, None, True),
        (4e-3, 9e-3, 8e-3, False),  # twice the hardware
        (4e-3, 7e-3, 6e-3, False),  # walks warn already
    ],
)
def test_the_linearised_loop_warns_where_walks_do_not(own, holds, stable, warned):
    margin = margins.Margin(own, holds, holds, 0.03, "force delay")
    found = linear_margins.Stable(stable, 0.03)
    lines = linear_margins.warnings({"force_delay": margin}, {"force_delay": found})
    reached = "at no value" if stable is None else "up to 7 ms only"
    says = f"force delay: the linearised loop is stable {reached}, the hardware has 4 ms, 8 ms would be safe"
    assert lines == [says] * warned


@pytest.mark.nightly
def test_the_linearised_loop_fails_about_where_walks_do(case, walks):
    """Shaking grows in the worst stance, and tears a gripper off a little beyond where it begins to."""
    scenario, gains = case("case_1_2", "virtual_model"), mc.Gains(1.0, 100.0, 2e3)
    margin = margins.Margin(0.0, 5.96e-3, 4.25e-3, 0.03, "force delay")  # of walks
    found = linear_margins.find(scenario, gains, {"force_delay": margin})["force_delay"]
    assert 0.9 * margin.holds < found.up_to < margin.holds
    delays = found.up_to * np.array([1.0, 1.002])
    late = margins.changes(own_parameters(scenario), margins.QUANTITIES["force_delay"], delays, {"kp": 50.0, "kd": 0.2})
    radius = stability_limit.spectral_radius(scenario, gains, late)
    assert radius[0] < 1 < radius[1]


@pytest.mark.nightly
@pytest.mark.parametrize("law", [pytest.param("pd", marks=pytest.mark.nightly), "end_effector"])
def test_gains_of_any_law_have_margins(case, law):
    """Six values of a law of three, and those of one without any."""
    scenario = case("case_1_2", law, {"duration": 0.05, "disturbance.cargo.start": 0.01})
    found = margins.find(scenario, mc.Gains(*(np.ones(6) * value for value in (1.0, 200.0, 5e3)), kp=np.asarray(40.0)))
    assert found.holds and found.walks["force_variation"].shape == (2, 4, 2 * margins.POINTS)
    assert np.isfinite(found.walks["force_variation"]).all()


@pytest.mark.nightly
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("name", [pytest.param("soft", marks=pytest.mark.nightly), "damped"])
def test_margins_are_those_of_the_independent_program(case, name):
    """Between its last walk that was better than pd and its first that was not, likewise for lost grippers."""
    gains = mc.Gains(1.0, REFERENCE["gains"][name]["damping"], REFERENCE["gains"][name]["stiffness"])
    found = margins.find(case("case_1_2", "virtual_model"), gains).margins
    walks = REFERENCE["cases"]["case_1_2"]
    for quantity, key in (("force_delay", "force_sensor.delay"), ("command_delay", "command_delay")):
        for entry in (entry for entry in walks if entry.startswith(f"{key}=") and " " not in entry):
            value, there, pd = float(entry.partition("=")[2]), walks[entry][name], walks[entry]["pd"]
            held = there["detached_at"] is None
            assert (value <= found[quantity].holds) == held, entry
            better = held and there["force_variation"] < pd["force_variation"]
            assert (value <= found[quantity].better) == better, entry


def test_the_command_prints_writes_and_warns(walks, monkeypatch, tmp_path, call):
    """JSON alone on standard output; the linearised loop's margins stand beside those of walks."""
    gains = gains_file.save(GAINS, tmp_path / "soft.yaml")

    def radii(scenario, gains, parameters, *, only, hardware, law, engine):
        varied = (
            parameters.force_sensor.delay,
            parameters.bus.command_delay,
            parameters.bus.control_period,
            parameters.joint_loop.kp,
        )
        return 0.991 + np.broadcast_arrays(*varied)[0][:, None]

    monkeypatch.setattr(stability_limit, "by_stance", radii)
    out = tmp_path / "out"
    late = ("--set", "hardware.force_sensor.delay=4e-3")
    code, said, told = call(
        "evaluate", "case_1_2", "--margins", "--gains", gains, "--retuned-pd", gains, "--json", "--out", out, *late
    )
    found = json.loads(said)
    assert code == 0 and found == json.loads((out / "margins.json").read_text())
    assert found["margins"]["force_delay"]["stable"]["up_to"] == pytest.approx(9e-3, rel=1e-3)
    assert found["margins"]["force_delay"]["needed"] == 8e-3
    assert found["own_hardware"] == {"holds": True, "better": True}
    assert [line.startswith("force delay: gains stay better than retuned pd") for line in found["warnings"]] == [True]
    assert "warning: force delay" in told and {file.name for file in out.iterdir()} == {
        "config.yaml", "margins.json", "margins.nc", "margins.png", "settings.json"
    }  # fmt: skip


@pytest.mark.parametrize(("walking", "standing", "holds", "said"), [
    (1.0, 1.0, True, ["a warning"]), (1 + 0.9e-9, 0.9, True, ["a warning"]),
    (1.001, 0.9, True, "a disturbance about a stance of the gait that grows by 1.001000 a time step"),
    (1.0, 1.0025, True, "a disturbance of a robot that stands on all feet that grows by 1.002500 a time step"),
    (1.0, 1.0, False, "a walk that loses a gripper or diverges"),
])  # fmt: skip
def test_gains_may_go_to_the_robot_where_they_are_stable_and_hold(walking, standing, holds, said, monkeypatch, case):
    """It stands on all feet in a gait whose swings take two time steps."""
    scenario, law, asked, stages = case("case_1_2", "virtual_model"), PD(), [], []

    def radius(walked, gains, *, law, engine):
        asked.append((walked.gait.duty, gains, law, engine))
        return np.array([0.5, walking if walked == scenario else standing])

    def find(walked, gains, *, law, engine, progress):
        asked.append((walked, gains, law, engine))
        return margins.Found({}, holds, True, None)

    monkeypatch.setattr(stability_limit, "spectral_radius", radius)
    monkeypatch.setattr(margins, "find", find)
    monkeypatch.setattr(margins, "warnings", lambda found: ["a warning"])
    how = {"law": law, "engine": "mjx", "stage": lambda name: stages.append(name) or silent()}
    if isinstance(said, list):
        assert deployment.check(scenario, GAINS, "mine.yaml", **how) == said
    else:
        stable = "gains that hold" if "walk" in said else "gains that are stable"
        with pytest.raises(mc.ConfigError) as refused:
            deployment.check(scenario, GAINS, "mine.yaml", **how)
        assert str(refused.value) == f"mine.yaml: expected {stable} on the config's hardware, got {said}"
    duties = [scenario.gait.duty, 1 - 2 * scenario.time_step / scenario.gait.cycle]
    every = [*((duty, GAINS, law, "mjx") for duty in duties), (scenario, GAINS, law, "mjx")]
    assert asked == every[: 1 if walking > 1.0001 else 2 if standing > 1 else 3]
    words = ["disturbances about a stance of the gait", "disturbances of a robot that stands on all feet"]
    assert stages == [*words, "walks on worse hardware"][: len(asked)]


def test_gains_without_those_of_the_joint_loop_keep_all_others():
    """Of a law's own by name, and of base admittance."""
    joint = {"kp": 40.0, "kd": 0.3, "ki": 2.0}
    assert margins.without_joint({"leak": 1.0, **joint}) == {"leak": 1.0}
    assert by_name(margins.without_joint(mc.Gains(1.0, 2.0, 3.0, **joint))).keys() == mc.Gains.AXES.keys()
