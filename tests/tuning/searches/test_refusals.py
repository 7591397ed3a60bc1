"""What no search can be asked for: one line says what was expected and where."""

import re

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.walk.metrics import smallest
from tuning.methods import Request
from tuning.problem import ensemble as ensembles
from tuning.problem import evaluation, spaces
from tuning.problem.evaluation import under_pd
from tuning.problem.search import Search

CASE = mc.load_scenario("case_1_2", ["duration=0.3"])
OWN = smallest("lowest_base", "m", "lowest base", lambda s, _: s.base_position[2])


@pytest.fixture(autouse=True)
def unwalked(monkeypatch):
    """Have pd score 1 in every metric, and its walk diverge never: its program takes seconds to compile."""
    monkeypatch.setattr(evaluation, "baseline", lambda *_: dict.fromkeys(mc.METRICS.names, 1.0) | {"diverged": False})


def space(**settings):
    return lambda: spaces.space(CASE, Search.make(settings))


def search(**how):
    return lambda: tuning.tune(CASE, **how)


def method(*requests):
    return search(method=lambda task: (request for request in requests))


def schedule(**points):
    return lambda: tuning.schedule(CASE, **points)


def grid(axis=(1e3,), **axes):
    return lambda: tuning.sweep(CASE, {"stiffness": axis, "damping": [1e2, 1e3], **axes})


def draw(**hardware):
    return lambda: ensembles.draw(CASE, ensembles.Ensemble.make({"hardware": hardware}))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (space(pins={"damping.rx": 1.0}), "pins.damping.rx: expected one of damping, "),
        (space(bounds={"kp": [1, 2]}), "bounds.kp: expected one of damping, "),
        (space(pins={"damping": 1, "stiffness": 1}), "pins: expected a gain left to search, got none"),
        (search(weights={"speed": 1}), "search: 'speed' is no metric to weigh or limit"),
        (search(weights={"lowest_base": 1.0}), "search: 'lowest_base' is no metric to weigh or limit"),
        (search(weights={"lost": 1.0}), "search: 'lost' is no metric to weigh or limit"),  # of a single walk
        (search(bounds={"damping": [2, 1]}), "search: bounds.damping: expected low < high, got 2, 1"),
        (
            search(pins={"damping": 5}, bounds={"damping": [100, 200]}),
            "search: pins.damping: expected one setting of this gain, got bounds.damping too",
        ),
        (
            search(pins={"damping": 3}, frozen=["damping"]),
            "search: pins.damping: expected one setting of this gain, got frozen.damping too",
        ),
        (
            search(frozen=["damping"], bounds={"damping": [100, 200]}),
            "search: frozen.damping: expected one setting of this gain, got bounds.damping too",
        ),
        (
            space(space="split", bounds={"damping": [1, 9]}, pins={"damping.translation": 1, "damping.rotation": 1}),
            "bounds.damping: expected a gain with numbers of no other setting, got none",
        ),
        (search(metrics=(OWN,)), "metrics: expected the shipped peak_foot_force among them"),
        (search(method="grid", space="diagonal"), "method: expected at most 4 numbers to search by grid, got 12: pin"),
        (search(method="magic"), "method: expected cmaes, gradient, grid, optuna, optuna:SAMPLER or FILE.py:"),
        (search(method="own"), "method: expected own.method in the scenario, or tune(method=...), with own"),
        (search(method=3.0), "method: expected a name, a Method, or a function"),
        (method(np.zeros((2, 2))), "method: expected a Request of finite theta (B, 2), got a ndarray"),
        (method(Request(np.zeros((2, 5)), None, "")), "method: expected a Request of finite theta (B, 2), got (2, 5)"),
        (method(Request(np.diag([0.0, np.nan]), None, "")), "(B, 2), got (2, 2) with values that are not finite"),
        (method(Request(np.zeros((2, 2)), np.ones((1, 3)), "")), "method: expected directions (k, 2), got (1, 3)"),
        (lambda: tuning.pareto(CASE, better="travel", against="travel"), "against: expected another metric than"),
        (schedule(gravity=(1.0, 0.1)), "gravity: expected ascending numbers, got 1, 0.1"),
        (schedule(gravity=(0.0, 1.0)), "gravity.0: expected a number above 0"),
        (schedule(cargo=()), "cargo: "),
        (schedule(cargo=(-1.0,)), "cargo.0: expected 0 or more"),
        *((grid(axis), "stiffness: expected a list of finite numbers above 0")
          for axis in ([], [0.0, 1.0], [1.0, np.nan], [1.0, np.inf], [[1.0]])),
        (grid(inertia=[1.0]), "axes: expected two gains, got 3"),
        (lambda: tuning.sweep(CASE, {}, precision="half"), "precision: expected float32 or float64, got 'half'"),
        (grid(speed=[1.0]), "axes.speed: expected a gain of the law, one of "),
        (lambda: tuning.sweep(under_pd(CASE), {"stiffness": [1]}), "an admittance law, got pd"),
        (draw(friction=(0.5, 2.0)), "hardware.friction: expected friction in the scenario"),
        (draw(control_rate=(100.0, 2000.0)), "hardware.control_rate: expected at most the 1000 Hz"),
        (draw(force_delay=(0.0, 1e9)), "hardware.force_delay: expected at most 500 time steps, 0.5 s"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_in_one_line(call, message):
    with pytest.raises((ConfigError, ValueError), match=re.escape(message)) as refused:
        call()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "where"),
    [("cargo: {mass: [2, 1]}", "cargo.mass: expected low <= high"), ("slope: 3", "slope"), ("members: 0", "members"),
     ("robot_mass: [0, 1]", "robot_mass"), ("[1]", "expected a mapping")],
)  # fmt: skip
def test_errors_name_file_and_key(tmp_path, text, where):
    (tmp_path / "e.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"e\.yaml") as error:
        ensembles.Ensemble.load(tmp_path / "e.yaml")
    assert where in str(error.value)


def test_the_most_particular_setting_of_a_number_decides():
    """A part may be searched, held or left alone beside the whole."""
    found = spaces.space(
        CASE,
        Search.make(
            {
                "space": "diagonal",
                "pins": {"damping": 7.0, "stiffness.x": 9.0},
                "frozen": ["damping.rx", "stiffness"],
                "bounds": {"damping.z": (1.0, 2.0)},
            }
        ),
    )
    gains = found.to_gains(found.lower)
    damping, stiffness = (np.broadcast_to(each, 6) for each in (CASE.control.damping, CASE.control.stiffness))
    assert found.names == ("damping.z",)
    np.testing.assert_allclose(gains.damping, [7.0, 7.0, 1.0, damping[3], 7.0, 7.0])
    np.testing.assert_allclose(gains.stiffness, [9.0, *stiffness[1:]])
