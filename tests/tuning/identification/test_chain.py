"""The whole way: a hidden robot, its log, `identify`, `tune` on what the log leaves open, simulated on the truth."""

import pytest

import mjx_climb as mc
import tuning
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.shipped import config_path
from tests.tuning.identification.stand_in_mujoco import Truth, log_of
from tuning.identification.fit.output import ensemble_of
from tuning.problem.ensemble import Ensemble
from tuning.problem.search import WEIGHTS

TRUTH = {
    "hardware.servo.armature": 0.018,
    "hardware.servo.coulomb_friction": 0.14,
    "hardware.servo.viscous_friction": 0.04,
    "hardware.command_delay": 0.006,
    "hardware.servo.backlash": 0.0,
}
DRY = {"hardware.servo.presliding": 5e-5}  # as good as MuJoCo's dry friction
SEARCH = {"method": "cmaes", "starts": 16, "iterations": 8}


@pytest.mark.slow
@pytest.mark.nightly
def test_gains_from_a_log_are_those_of_the_truth():
    """In what the search weighs within 5 % of those found on the truth itself; the walk is foretold within 2 %."""
    profile = with_hardware(mc.load_scenario(config_path("case_1_1.yaml")), load_hardware("dynamixel_x"))
    # how friction sets in is known: a log of positions tells nothing of it, and it moves the force variation by 3.5 %
    profile = profile.with_overrides({"control.controller": "pd", "duration": 8.0, **DRY})
    truth = profile.with_overrides(TRUTH)
    armature, friction, damping, delay, _ = TRUTH.values()
    robot = Truth(armature, friction, damping, profile.control.kp, profile.control.kd, delay, tuple(profile.gravity))
    log = log_of(robot, 8.0, noise={"position": 4e-4}, kinds=("position",), amplitude=0.15, top=2.5)

    found = tuning.identify(profile, log, list(TRUTH))
    known = profile.with_overrides(found.overrides())
    walks = {name: mc.metrics(mc.rollout(each)) for name, each in (("known", known), ("truth", truth))}
    for name in WEIGHTS:
        assert float(walks["known"][name]) == pytest.approx(float(walks["truth"][name]), rel=0.02)

    gains = {
        "log": tuning.robust(known, ensemble_of(found).model_copy(update={"members": 4}), **SEARCH).gains,
        "truth": tuning.tune(truth, **SEARCH).gains,
    }
    alone = Ensemble(members=2, pushes=None, cargo=None, gravity=None, grip_stiffness=(1.0, 1.0), robot_mass=(1.0, 1.0))
    walked = tuning.evaluate(truth, gains, alone, members=2).data
    better = 0
    for name in WEIGHTS:
        values = walked[name].mean("member")
        assert float(values.sel(gains="log")) <= 1.05 * float(values.sel(gains="truth"))
        better += float(values.sel(gains="log")) < 0.99 * float(values.sel(gains="pd"))
    assert better >= 2  # the search did something
