"""The matrix: a part of a reader's own under every search is the same as a loop over rollouts, or refused by one line.

Rows are the parts of `conftest.py`: a contact, a drive, a disturbance, holds and a sensor.
"""

import dataclasses
import re

import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.contact.polyhedron import magnet
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.gripped_in_mujoco import NOISE, TRUTH, log_of
from tests.tuning.matrix.conftest import GAINS, MEMBERS, METRICS, PARTS, alone, check, member, slow
from tuning.comparisons import degraded, judge, margins
from tuning.gains.gains_file import by_name
from tuning.identification.fit import problem as fits
from tuning.identification.fit.search import Searches
from tuning.identification.model.gripped import check_parts, cut_gripped, gripped_model
from tuning.identification.model.variables import begin, variables
from tuning.identification.model.windows import KINDS
from tuning.methods.parts import Parts
from tuning.problem import ensemble as ensembles
from tuning.problem.ceiling import Ceiling
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
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
        ({"contact.damping": {"range": (2, 1)}}, "draw.contact.damping.range: expected low <= high, got 2, 1"),
        ({"contact.damping": {"range": (0, 1), "log": True}}, "range: expected numbers above 0 with log, got 0"),
        ({"contact.stiffness": {"range": (-1, 2)}}, "draw.contact.stiffness: expected finite numbers above 0, got -"),
        ({"gravity": {"range": (1, 2)}}, "draw.gravity: expected a factor, as the value is an array, got a range"),
        ({"hardware.command_delay": {"factor": (1, 2)}}, "draw.hardware.command_delay: expected a value other than 0"),
        (
            {"hardware.command_delay": {"range": (9, 9)}},
            "draw.hardware.command_delay: expected at most 500 time steps",
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
    walked = found.walked.with_gains({part.path: part.span[1], "damping": 1e3}).scenario
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
        ({"hardware.command_delay": [0.1, 9.0]}, "axes.hardware.command_delay: expected at most 500 time steps"),
    ],
)
def test_axes_that_the_walk_does_not_have_are_refused_in_one_line(axes, said):
    with pytest.raises(ValueError, match=re.escape(said)) as refused:
        grid_of(Problem(mc.Scenario()), {**axes, "damping": [1e2, 1e3]})
    assert "\n" not in str(refused.value)


@slow("contact", "drive", "disturbance")
def test_evaluate_walks_each_member_as_a_rollout(scenario, part, ensemble):
    found = tuning.evaluate(scenario, GAINS, ensemble, members=MEMBERS).data
    drawn = ensembles.draw(scenario, ensembles.fresh(ensemble, ensembles.Use.EVALUATION))
    np.testing.assert_allclose(found[part.path], drawn.at(part.path)[:, 0])
    for number in range(MEMBERS):
        check(found.sel(gains="mine", member=number), alone(scenario, GAINS["mine"], member(drawn, number)))


@slow("contact", "drive", "disturbance")
def test_worse_walks_are_rollouts_with_the_worse_value(scenario, part, ensemble):
    found = tuning.degrade(scenario, GAINS, ensemble, [f"{part.path}={part.span[1]}"], members=MEMBERS).data
    drawn = ensembles.draw(scenario, ensembles.fresh(ensemble, ensembles.Use.EVALUATION))
    worse = member(drawn, 0).replace({part.path: part.span[1]})
    check(found.sel(gains="mine", member=0).isel(setting=1), alone(scenario, GAINS["mine"], worse))
    check(found.sel(gains="mine", member=1).isel(setting=0), alone(scenario, GAINS["mine"], member(drawn, 1)))


@slow("contact")
def test_each_cell_of_a_sweep_is_a_rollout_with_its_value(scenario, part):
    found = tuning.sweep(scenario, {part.path: list(part.span), "damping": [1e2, 1e3]}).data
    for value in part.span:
        parameters = own_parameters(scenario).replace({part.path: value})
        gains = {"damping": 1e3}
        check(
            found.sel({part.path: value}, method="nearest").sel(damping=1e3),
            alone(scenario, gains, parameters, smooth=False),
        )


@slow()
def test_margins_walk_the_part_on_worse_hardware(scenario, part):
    """Its own value is a margin by its path."""
    gains = {"damping": 300.0, "stiffness": 3000.0}
    own = own_parameters(scenario)
    worst = max(part.span, key=lambda end: abs(end - own.at(part.path)))
    asked = {"force_delay": margins.QUANTITIES["force_delay"]} | margins.quantities(scenario, [f"{part.path}={worst}"])
    found = margins.find(scenario, gains, asked=asked)
    walks = found.walks.sel(gains="given")
    assert found.margins[part.path].own == own.at(part.path) and found.margins[part.path].worst == worst
    for name, quantity in asked.items():
        one = walks.sel(quantity=name).isel(point=6)
        hardware = margins.changes(own, quantity, one["value"].values, margins.joint_gains(scenario, {}))
        walked = alone(scenario, gains, hardware, smooth=False)
        np.testing.assert_allclose(one["force_variation"], walked["force_variation"], rtol=5e-3)


@slow()
def test_each_point_of_a_search_is_a_rollout(scenario):
    found = tuning.tune(scenario, method="cmaes", starts=4, iterations=1)
    theta = found.data["theta"].values[:1]
    gains = {name: np.asarray(value)[0] for name, value in by_name(found.problem.space.to_gains(theta)).items()}
    check(found.data.isel(point=0), alone(scenario, gains))


@slow()
def test_each_point_of_a_search_over_an_ensemble_is_the_mean_of_rollouts(scenario, ensemble):
    found = tuning.robust(scenario, ensemble, method="cmaes", starts=4, iterations=1, joint_gains=False)
    theta, drawn = found.data["theta"].values[:1], ensembles.draw(scenario, ensemble)
    gains = {name: np.asarray(value)[0] for name, value in by_name(found.problem.space.to_gains(theta)).items()}
    walked = [alone(scenario, gains, member(drawn, number)) for number in range(MEMBERS)]
    check(found.data.isel(point=0), {name: np.mean([each[name] for each in walked]) for name in METRICS})


@slow()
def test_laws_are_tuned_and_walked_as_rollouts(scenario, ensemble):
    settings = {"method": "cmaes", "starts": 4, "iterations": 1}
    found = tuning.compare(scenario, ["base_admittance"], ensemble, members=MEMBERS, seeds=1, **settings)
    drawn, gains = ensembles.draw(scenario, judge.fresh(ensemble)), found.tuned["base_admittance"].gains
    walks = found.data.sel(gains="base_admittance").isel(seed=0)
    check(walks.sel(member=1), alone(scenario, gains, member(drawn, 1)))


@slow()
def test_a_ceiling_walks_laws_as_rollouts_and_hides_what_has_not_begun(scenario, name):
    laws = {"mine": {"kp": 60.0, "kd": 0.3}, "retuned_pd": {"kp": 55.0, "kd": 0.25}}
    brief = Ceiling(knots=(0.05,), iterations=3, delays=(0.02,), random=0, test_members=0)
    found = tuning.ceiling(scenario, laws, brief)
    check(found.data.sel(contestant="mine").isel(member=0), alone(scenario, laws["mine"]))
    disturbed = name == "disturbance"
    assert bool(found.data.attrs["hidden"]) == disturbed and ("causal 20 ms" in found.contestants) == disturbed
    if disturbed:
        plans = found.data["joint_targets"].isel(member=0)
        blind, late = plans.sel(plan="blind").values, plans.sel(plan="causal 20 ms").values
        np.testing.assert_array_equal(blind[:50], late[:50])  # it blows from 30 ms on, felt 20 ms later
        assert np.abs(blind - late).max() > 0


# --- fits of a log


def test_a_value_of_the_part_is_fitted_or_refused_in_one_line(scenario, part, name):
    own = own_parameters(scenario)
    if name == "disturbance":
        with pytest.raises(mc.ConfigError, match=r"disturbance\.others\.0: expected none with a log, got Gust"):
            check_parts(own, held=False)
        return
    check_parts(own, held=False)
    (variable,) = variables(scenario, [part.path], held=False)
    low, high = own.paths[part.path].bounds
    assert variable.nominal == own.at(part.path)
    assert low <= np.nan_to_num(variable.lower) < np.nan_to_num(variable.upper) <= high
    if name == "drive":
        with pytest.raises(mc.ConfigError, match=r"hardware\.servo: expected servos with the base held, got Belts"):
            check_parts(own, held=True)


def problem_of(changes, *keys):
    """The fit of two keys to a sway of a robot in MuJoCo."""
    scenario = mc.load_scenario("case_1_1").with_overrides(changes)
    log = log_of(dataclasses.replace(TRUTH, stiffness=3e3, damping=30.0, armature=0.0), 1.5)
    windows = cut_gripped(log, load_robot("hubrobo_v3_2"), scenario.time_step, 0.0)
    model = gripped_model(scenario, log, windows, variables(scenario, keys, held=False))
    return fits.Problem(model, np.array([NOISE[KINDS[kind]] for kind in windows.kind]))


@pytest.mark.nightly
def test_a_contact_and_a_drive_are_fitted_as_grippers_and_servos_are():
    """They are the same springs by other names: where the fit of these ends, residuals and derivatives are the same."""
    parts = PARTS["contact"].changes | PARTS["drive"].changes
    parts |= {"contact.hardness": 4e3, "contact.loss": 30.0, "contact.spread": 0.3, "hardware.servo.tension": 45.0}
    own = problem_of(parts, "contact.spread", "hardware.servo.tension")
    shipped = problem_of(
        {"contact.stiffness": 3400.0, "contact.damping": 30.0, "control.kp": 45.0}, "contact.stiffness", "control.kp"
    )
    with Parts(None, dict) as kept:
        found = Searches(kept).search(shipped, begin(shipped.model.variables), 12, "fit")
    stiffness = np.exp(found.x[0])
    spread = 2 * (1 - stiffness / 4e3)
    (mine, theirs) = (
        problem.evaluate(np.r_[first, found.x[1:], found.start.ravel()])
        for problem, first in ((own, spread), (shipped, found.x[0]))
    )
    np.testing.assert_allclose(mine.scaled, theirs.scaled, rtol=1e-6, atol=1e-6)
    scale = np.abs(theirs.along).max(0)
    along = theirs.along / scale
    along[:, 0] *= -2e3 / stiffness
    np.testing.assert_allclose(mine.along / scale, along, atol=1e-6)
    assert stiffness == pytest.approx(3e3, rel=0.05)


# --- a walk is lost by what its grips use, whatever the contact and the holds


def held(pull, **changes):
    """On Earth, on magnets that are pulled off by so many N."""
    values = {key: np.asarray(value).tolist() for key, value in magnet(pull=pull, friction=0.5).items()}
    return {"contact": {"kind": "polyhedron", **values}, **changes}


def test_a_magnet_has_no_limit_of_the_gripper():
    """A limit that nothing reads is refused."""
    scenario = mc.load_scenario("case_1_1").with_overrides(held(60.0, **{"contact.holding_limit": 0.5}))
    with pytest.raises(
        mc.ConfigError, match=r"contact\.holding_limit: expected one of stiffness, .*, only_pulled, got"
    ):
        mc.parameters(scenario)


ROCK = {  # limbs step at once, from where they stood onto the rock
    "ground.holds": {"rock": {"density": 2000.0, "roughness": 0.0}, "limit": 0.3}, "gait.footholds": "nearest",
    "gait.cycle": 0.4, "gait.stride": 0.01, "time_step": 5e-4,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "lost"),
    [
        pytest.param(held(2.5), 1.0, id="a magnet of 2.5 N"),
        pytest.param(held(60.0), 0.0, id="a magnet of 60 N"),
        pytest.param(ROCK, 1.0, id="holds of 0.3 N", marks=pytest.mark.nightly),
    ],
)
def test_the_share_of_lost_walks_is_that_of_rollouts_that_tear(changes, lost):
    scenario = mc.load_scenario("case_1_1", ["duration=0.2"]).with_overrides(changes)
    found = tuning.evaluate(
        scenario, GAINS, Ensemble.make({"members": MEMBERS, **CALM, "grip_stiffness": (1, 1)}), members=MEMBERS
    )
    assert (mc.rollout(scenario, GAINS["mine"]).detached.any()) == bool(lost)
    assert (judge.summary(found.data)["failed"] == lost).all()
    assert f"mine {lost:.0%}" in judge.failed_in_words(judge.summary(found.data))
