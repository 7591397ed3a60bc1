"""A variable of the user's own, of `docs/guides/link_masses.py`: fitted as the shipped ones, in one file."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.stand_in_mujoco import TRUTH, columns_of, log_of
from tuning.identification.fit.identify import identity_of_fit
from tuning.identification.fit.output import identified_scenario
from tuning.identification.fit.result import Estimate, Identified
from tuning.identification.model.predicted import stages_for
from tuning.identification.model.variables import Variable, applied, begin, variables
from tuning.identification.readers import write_csv

LINKS = f"{Path(__file__).parents[3] / 'docs' / 'guides' / 'link_masses.py'}:links"
SCENARIO = mc.Scenario().with_overrides({"hardware.servo.coulomb_friction": 0.05})
ROBOT = load_robot(SCENARIO.robot)
NUMBER = 3


def rub(share, parameters, robot):
    """Return the dry friction times a share, and as much viscous friction."""
    friction = parameters.drive.coulomb_friction
    return parameters.replace(
        {"hardware.servo.coulomb_friction": friction * share, "hardware.servo.viscous_friction": friction * share}
    ), robot


def lighten(share, parameters, robot):
    return parameters, dataclasses.replace(robot, base_mass=robot.base_mass * share)


rubbing = Variable("rubbing", "1", 1.0, 1.0, 0.5, 0.0, 10.0, change=rub)
lighter = Variable("lighter", "1", 1.0, 1.0, 0.5, 0.0, 10.0, change=lighten)
twice = dataclasses.replace(rubbing, key="control.kp")
shipped = dataclasses.replace(rubbing, change=None)


def found_of(chosen, values):
    """Return a result whose fit ended at some values."""
    estimates = {v.key: Estimate(x, 0.0, 9.0, True, 1.0, v.unit) for v, x in zip(chosen, values, strict=True)}
    structure = SimpleNamespace(robot=ROBOT, places=tuple(v.place for v in chosen), mass=0.0)
    model = SimpleNamespace(variables=chosen, structure=structure, parameters=own_parameters(SCENARIO))
    nothing = dict.fromkeys([field.name for field in dataclasses.fields(Identified)])
    fitted = SimpleNamespace(x=np.array(values))
    given = {"scenario": SCENARIO, "estimates": estimates, "beside": {}, "model": model, "fitted": fitted}
    return Identified(**nothing | given)


def test_the_variable_of_the_page_changes_the_robot_beside_a_shipped_one():
    chosen = variables(SCENARIO, ["control.kp", LINKS], held=True)
    assert [v.key for v in chosen] == ["control.kp", "links"]
    np.testing.assert_allclose(begin(chosen), [np.log(SCENARIO.control.kp), 0.0])
    with jax.enable_x64(True):
        point = jnp.log(jnp.array([30.0, 1.1]))
        parameters, robot = applied([v.place for v in chosen], point, own_parameters(SCENARIO), ROBOT)
    assert float(parameters.joint_loop.kp) == pytest.approx(30.0)
    np.testing.assert_allclose(robot.link_mass, 1.1 * ROBOT.link_mass)


def test_stages_that_only_a_variable_of_ones_own_needs_are_there():
    assert not stages_for(SCENARIO, [lighter]).viscous_friction and stages_for(SCENARIO, [rubbing]).viscous_friction


def test_keys_that_a_variable_changes_are_those_of_the_identified_scenario(tmp_path):
    """Beside those that are fitted themselves; the robot has a file of its own where that is changed."""
    chosen = (*variables(SCENARIO, ["control.kd"], held=True), rubbing)
    found = found_of(chosen, [0.3, 0.5])
    expected = {
        "control.kd": pytest.approx(0.3),
        "hardware.servo.coulomb_friction": pytest.approx(0.025),
        "hardware.servo.viscous_friction": pytest.approx(0.025),
    }
    assert found.overrides() == expected
    assert identified_scenario(found, SCENARIO, tmp_path).hardware.servo.viscous_friction == pytest.approx(0.025)
    assert not list(tmp_path.iterdir())
    lighter_one = identified_scenario(found_of((lighter,), [0.5]), SCENARIO, tmp_path)
    assert load_robot(lighter_one.robot).base_mass == pytest.approx(ROBOT.base_mass / 2, rel=1e-5)


def test_an_unfinished_fit_of_another_change_is_another_fit():
    log, model = SimpleNamespace(digest=""), SimpleNamespace(structure=SimpleNamespace(mass=0.0))
    first, again, other = (
        identity_of_fit(SCENARIO, log, SimpleNamespace(variables=[v], structure=model.structure), 0.2, 1)
        for v in (rubbing, dataclasses.replace(rubbing), dataclasses.replace(rubbing, change=lighten))
    )
    assert first == again != other


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ([f"{__file__}:NUMBER"], "expected NUMBER to be a Variable with a change, got 3"),
        ([f"{__file__}:shipped"], "expected shipped to be a Variable with a change, got Variable("),
        ([f"{__file__}:nobody"], "expected a variable named nobody, got none"),
        ([f"{__file__}:twice"], ":twice: expected a key of its own, got control.kp"),
        ([rubbing, rubbing], "--fit rubbing: expected a key of its own, got rubbing"),
    ],
)
def test_what_is_no_variable_of_ones_own_is_refused_in_one_line(asked, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)) as refused:
        variables(SCENARIO, asked, held=True)
    assert "\n" not in str(refused.value)


@pytest.mark.nightly
def test_heavier_links_of_a_log_are_told_at_the_shell(tmp_path, call, optimised):
    """Beside the joint loop's gains, which the log tells too."""
    truth = dataclasses.replace(TRUTH, heavier=1.2, damping=0.0)
    write_csv(tmp_path / "log.csv", columns_of(log_of(truth, 3.0)))
    config, folder = tmp_path / "config.yaml", tmp_path / "found"
    known = {"control.kp": 40.0, "control.kd": 0.3, "hardware.servo.armature": truth.armature}
    config.write_text(SCENARIO.with_overrides(known).to_yaml())
    asked = ["--log", tmp_path / "log.csv", "--fit", LINKS, "--fit", "control.kp", "--starts", "1"]
    code, out, err = call("identify", config, *asked, "--out", folder, "--json")
    assert code == 0, err
    links = json.loads(out)["parameters"]["links"]
    assert links["seen"] and links["low"] < 1.2 < links["high"] and links["high"] - links["low"] < 0.1
    robot = load_robot(mc.load_scenario(folder / "identified.yaml").robot)
    np.testing.assert_allclose(robot.link_mass, links["value"] * ROBOT.link_mass, rtol=1e-5)
