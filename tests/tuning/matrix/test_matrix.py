"""The matrix: a part of a reader's own under every search is the same as a loop over rollouts, or refused by one line.

Rows are the parts of `conftest.py`: a contact, a drive, a disturbance, holds and a sensor.
"""

import re

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.contact.polyhedron import magnet
from tests.tuning.matrix.conftest import FILE, GAINS, MEMBERS, alone, check, member
from tuning.comparisons import degraded, judge, margins
from tuning.problem import ensemble as ensembles
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.searches import ceiling as ceilings
from tuning.searches.sweep import grid_of

CALM = dict.fromkeys(("pushes", "cargo", "gravity"))


def test_an_ensemble_draws_a_value_of_the_part(scenario, part, ensemble):
    drawn, own = ensembles.draw(scenario, ensemble), own_parameters(scenario)
    values, (low, high) = drawn.at(part.path), part.span
    assert values.shape == (MEMBERS, 1) and low <= values.min() < np.mean(part.span) < values.max() <= high
    factor = ensemble.changed({"draw": {part.path: {"factor": (0.5, 0.6), "log": True}}})
    share = ensembles.draw(scenario, factor).at(part.path) / own.at(part.path)
    assert share.min() >= 0.5 and share.max() <= 0.6
    same, other = (ensembles.draw(scenario, ensemble.changed({"seed": seed})).at(part.path) for seed in (0, 1))
    assert (same == values).all() and (other != values).all()
    # other draws stay as they are
    np.testing.assert_array_equal(drawn.mass_scale, ensembles.draw(scenario, ensemble.changed({"draw": {}})).mass_scale)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (
            {"contact.spread": {"range": (0.0, 1.0)}},
            "draw.contact.spread: expected a value at contact.spread to change",
        ),
        ({"ground.holds.limit": {"range": (1, 2)}}, "draw.ground.holds.limit: expected a value at ground.holds.limit"),
        ({"contact.damping": {}}, "draw.contact.damping: expected a range or a factor, got none"),
        ({"contact.damping": {"range": (2, 1)}}, "draw.contact.damping: range: expected low <= high, got 2, 1"),
        ({"contact.damping": {"range": (0, 1), "log": True}}, "range: expected numbers above 0 with log, got 0"),
        ({"contact.stiffness": {"range": (-1, 2)}}, "draw.contact.stiffness: expected finite numbers above 0, got -"),
        ({"gravity": {"range": (1, 2)}}, "draw.gravity: expected a factor, as the value is an array, got a range"),
        ({"hardware.command_delay": {"factor": (1, 2)}}, "draw.hardware.command_delay: expected a value other than 0"),
        (
            {"hardware.command_delay": {"range": (9, 9)}},
            "draw.hardware.command_delay: expected at most 1000 time steps",
        ),
    ],
)
def test_a_draw_of_what_the_walk_does_not_have_is_refused_in_one_line(draw, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)) as refused:
        ensembles.draw(mc.Scenario(), Ensemble.make({"draw": draw}))
    assert "\n" not in str(refused.value)


def test_a_value_of_the_part_is_made_worse_by_its_path(scenario, part, ensemble):
    low, high = part.span
    worse = degraded.draw_of(Problem(scenario), GAINS, ensemble, [f"{part.path}=x0.5", f"{part.path}={high}"], MEMBERS)
    drawn, half, other = worse.problem.parameters.at(part.path).reshape(3, MEMBERS)
    np.testing.assert_allclose(half, drawn / 2)
    assert (other == high).all() and drawn.min() >= low
    np.testing.assert_array_equal(
        worse.problem.parameters.mass_scale.reshape(3, -1), [worse.problem.parameters.mass_scale.reshape(3, -1)[0]] * 3
    )


@pytest.mark.parametrize(
    ("worse", "said"),
    [
        (
            "contact.spread=0.5",
            "worse: contact.spread: expected a value at contact.spread to change, got Gripper without",
        ),
        ("contact.spread=x2", "worse: expected contact.spread in the config or the draw to scale, got none"),
        ("contact.stiffness=-1", "worse: contact.stiffness: expected finite numbers above 0, got -1"),
        ("contact.stiffness=soft", "worse: contact.stiffness: expected a number, got 'soft'"),
    ],
)
def test_what_cannot_be_made_worse_is_refused_in_one_line(worse, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)):
        degraded.draw_of(Problem(mc.Scenario()), GAINS, Ensemble(), [worse], MEMBERS)


def test_an_axis_of_a_sweep_is_a_path(scenario, part):
    grid = grid_of(Problem(scenario), {part.path: list(part.span), "damping": [1e2, 1e3]})
    assert grid.rows == 4 and {*grid.axes} == {part.path, "damping"}
    found = grid.result({name: np.zeros(4) for name in grid.walked.metrics.names})
    walked, _ = found.walker({part.path: part.span[1], "damping": 1e3})
    assert own_parameters(walked).at(part.path) == part.span[1] and walked.control.damping == 1e3


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (
            {"contact.spread": [0.1, 1.0]},
            "axes.contact.spread: expected a value at contact.spread to change, got Gripper",
        ),
        ({"contact.stiffness": [0.0, 1.0]}, "contact.stiffness: expected a list of finite numbers above 0"),
        ({"hardware.force_sensor.dead": [1.0, 2.0]}, "axes.hardware.force_sensor.dead: expected a path of one number"),
        ({"hardware.command_delay": [0.1, 9.0]}, "axes.hardware.command_delay: expected at most 1000 time steps"),
    ],
)
def test_axes_that_the_walk_does_not_have_are_refused_in_one_line(axes, said):
    with pytest.raises(ValueError, match=re.escape(said)) as refused:
        grid_of(Problem(mc.Scenario()), {**axes, "damping": [1e2, 1e3]})
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_evaluate_walks_each_member_as_a_rollout(scenario, part, ensemble):
    found = tuning.evaluate(scenario, GAINS, ensemble, members=MEMBERS).data
    drawn = ensembles.draw(scenario, judge.fresh(ensemble))
    np.testing.assert_allclose(found[part.path], drawn.at(part.path)[:, 0])
    for number in range(MEMBERS):
        check(found.sel(gains="mine", member=number), alone(scenario, GAINS["mine"], member(drawn, number)))
