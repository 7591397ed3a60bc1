"""What would keep grippers from letting go, in one line."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.messages import ConfigError
from tuning.comparisons import remedies as module
from tuning.comparisons.remedies import gap_in_words, remedies

CLOSES = {"contact.capture_distance": 0.005, "contact.closing_time": 0.1}


def test_a_gap_is_named_where_it_pulls_or_misses():
    """One that snaps pulls stiffness times the gap; one that closes pulls nothing, but may be out of reach."""
    snaps = mc.load_scenario("case_1_2")
    closes = mc.load_scenario("case_1_2", CLOSES)
    named = "a foot is 1.2 mm off the ground when its gripper shuts, which pulls 12 N at once without a contact"
    assert gap_in_words(snaps, 0.0012, 12.5, 0).startswith(named)
    assert gap_in_words(snaps, 0.0001, 12.5, 0) == "" == gap_in_words(closes, 0.0012, 2.0, 0)
    # from half of the largest pull on; without a pull there is nothing to tell
    assert gap_in_words(snaps, 0.0012, 23.9, 0).startswith(named) and gap_in_words(snaps, 0.0012, 24.1, 0) == ""
    assert gap_in_words(snaps, 0.0, 0.0, 0) == ""
    # a gripper that reaches the ground and shuts at once
    reaches = mc.load_scenario("case_1_2", {"contact.capture_distance": 0.005})
    assert gap_in_words(reaches, 0.0012, 12.5, 0).startswith(named)
    missing = gap_in_words(closes, 0.021, 2.0, 1)
    assert missing == (
        "a foot is 21 mm off the ground when its gripper shuts, contact.capture_distance is 5 mm: raise control.kp, "
        "set gait.landing_speed, or lower gait.height"
    )


@pytest.mark.slow
def test_a_sagging_robot_is_told_of_its_gap_first():
    """It hangs below a ceiling by weak joints."""
    keys = ["duration=0.3", "gait.cycle=0.4", "gravity=[0, 0, 1.62]", "control.kp=20", "control.kd=0.1"]
    text = remedies(mc.load_scenario("case_1_2", keys), 0.1)
    assert text.startswith("a foot is ") and text.index("when its gripper shuts") < text.index("; pull on grips")


@pytest.mark.slow
def test_grips_without_a_limit_are_said_to_have_none():
    """A hold with limits may let go of them."""
    scenario = mc.load_scenario("case_1_2", ["duration=0.3", "contact.holding_limit=null"])
    assert remedies(scenario, 0.1).endswith("; contact.holding_limit is null")


def test_each_remedy_is_the_walk_that_its_words_name(monkeypatch):
    """All values but those that it names are the scenario's; the first walk, and that cut by its end, name none."""
    scenario, walked = mc.load_scenario("case_1_2", ["duration=6"]), []
    paths = ("gait.cycle", "gait.stride", "control.kp", "control.kd")

    def rollout(scenario, parameters, law):
        walked.append(parameters)
        return parameters

    def metrics(parameters, _):
        pull = sum(float(parameters.at(path)) for path in paths)
        return {"diverged": False, "peak_pull_force": pull, **dict.fromkeys(module.GAP, 0.0)}

    monkeypatch.setattr(module, "check_time_step", lambda scenario, parameters: None)
    monkeypatch.setattr(module, "rollout", rollout)
    monkeypatch.setattr(module, "metrics", metrics)
    own, found = own_parameters(scenario), []
    for at in (2.9, 3.1):
        walked.clear()
        text = remedies(scenario, at)
        assert text.count(" N") == len(walked) + 1  # the limit beside them
        factors = [{path: float(each.at(path) / own.at(path)) for path in paths} for each in walked]
        found.append([{path: by for path, by in each.items() if not np.isclose(by, 1)} for each in factors])

    # joints that the time step cannot follow are no remedy
    def refuse(scenario, parameters):
        if float(parameters.at("control.kp")) > float(own.at("control.kp")):
            raise ConfigError("", "time_step", "a shorter one", "this")

    monkeypatch.setattr(module, "check_time_step", refuse)
    monkeypatch.setattr(module, "check_time_step", refuse)
    walked.clear()
    assert "control.kp=100" not in remedies(scenario, 2.9) and len(walked) == 4
    softer, stiffer = ({"control.kp": by, "control.kd": by} for by in (0.5, 2.0))
    assert found[0] == [{}, {"gait.cycle": 2.0}, {"gait.stride": 0.5}, softer, stiffer]
    assert found[1] == [{}, {"gait.stride": 0.5}, softer, stiffer]
