"""Gains by gait phase: phases, gains and motion against other code than ours; derivatives and walks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import (
    PD,
    EndEffectorAdmittance,
    LoadTransfer,
    MeasuredPoseAdmittance,
    Start,
    VirtualModelAdmittance,
    begin,
    combined,
    phased,
)
from mjx_climb.control.phased import PHASES, limb_shares, robot_shares
from mjx_climb.control.virtual_mass import Motion
from mjx_climb.execution.jax_internals import scan_sizes
from tests import oracle_laws
from tests.control.test_laws import STEP, measured_of, reference_of

TIME, RAMP = 0.2, 0.05
UNTIL = np.array([0.0, 0.21, 0.6, 0.03])  # in a swing, going to be before the lift-off, standing, going to swing
SINCE = np.array([0.0, 0.4, 0.24, 0.5])
SHARES = [[1, 0, 0, 0.4], [0, 0.8, 0, 0.6], [0, 0, 0.2, 0], [0, 0.2, 0.8, 0]]  # of limbs in `PHASES`
OF_ROBOT = [0.2, 0.8, 0, 0]


def timed(reference, until=UNTIL, since=SINCE):
    return reference._replace(until_lift_off=jnp.asarray(until), since_touchdown=jnp.asarray(since))


@pytest.fixture(scope="module")
def scene():
    """Forces at a base that is turned against the world and off its reference."""
    reference = timed(reference_of(turn=(0.3, -0.2, 0.5)))
    measured = measured_of(reference, np.random.default_rng(5).normal(size=(4, 3)), (0.4, -0.6, 0.2))
    return reference, measured._replace(base_position=measured.base_position + 0.01)


def walked(law, measured, reference, steps=3):
    """What a law commands at last."""
    state = begin(law, Start(STEP, reference))
    for _ in range(steps):
        state, command = law.step(state, measured, reference)
    return command


def test_limbs_go_from_phase_to_phase_on_straight_lines():
    """Around a lift-off and a touchdown that are far apart; a limb that is near both is partly in either."""
    time = np.linspace(0, 0.5, 101)
    near = timed(reference_of(), time, np.full_like(time, 0.6)), timed(reference_of(), np.full_like(time, 0.6), time)
    for reference, place in zip(near, (1, 2), strict=True):
        found = limb_shares(reference, TIME, RAMP)
        there = np.interp(time, [0, RAMP, TIME, TIME + RAMP], [0, 1, 1, 0])
        np.testing.assert_allclose(found[0], np.interp(time, [0, RAMP], [1, 0]), atol=1e-12)
        np.testing.assert_allclose(found[place], there, atol=1e-12)
        np.testing.assert_allclose(found[3 - place], 0, atol=1e-12)
    np.testing.assert_allclose(limb_shares(timed(reference_of()), TIME, RAMP), SHARES[:3], atol=1e-12)
    shares = np.array(limb_shares(timed(reference_of(), [0.22], [0.03]), TIME, RAMP)).ravel()
    np.testing.assert_allclose(shares, [0.4, 0.6 * 0.6, 0.6 * 0.4], atol=1e-12)


def test_a_robot_is_in_the_phase_of_the_limb_that_counts_most():
    found = robot_shares(limb_shares(timed(reference_of()), TIME, RAMP))
    np.testing.assert_allclose(found, OF_ROBOT[:3], atol=1e-12)
    until, since = np.random.default_rng(1).uniform(0, 0.4, (2, 50, 4))
    for limbs in (limb_shares(timed(reference_of(), *pair), TIME, RAMP) for pair in zip(until, since, strict=True)):
        sums = np.cumsum([limbs[1], limbs[2], limbs[0]], axis=0).max(1)
        np.testing.assert_allclose(robot_shares(limbs), [sums[2] - sums[1], sums[0], sums[1] - sums[0]], atol=1e-12)
        assert min(robot_shares(limbs)) >= -1e-12 and sums[2] <= 1 + 1e-12


def values_of(name, values):
    return {f"{name}_{phase}": value for phase, value in zip(PHASES, values, strict=True)}


def test_gains_that_a_step_reads_are_mixed_by_the_phase_of_the_robot(scene):
    reference, measured = scene
    values = 1e4, 3e3, 5e4, 2e4
    law = phased(MeasuredPoseAdmittance(), ["stiffness"], phase_time=TIME, phase_ramp=RAMP)
    command = walked(dataclasses.replace(law, **values_of("stiffness", values)), measured, reference)
    expected = walked(MeasuredPoseAdmittance(stiffness=np.dot(OF_ROBOT, values)), measured, reference)
    np.testing.assert_allclose(command.base_displacement, expected.base_displacement, rtol=1e-9)


def test_the_motion_of_a_virtual_mass_is_mixed_as_its_gains_are(scene):
    """The zero-order holds of all four phases, by a matrix exponential, in proportion."""
    reference, measured = scene
    values = 20.0, 80.0, 40.0, 30.0
    law = phased(VirtualModelAdmittance(2.0, 30.0, 400.0), ["damping"], phase_time=TIME, phase_ramp=RAMP)
    command = walked(dataclasses.replace(law, **values_of("damping", values)), measured, reference)
    holds = [expm(STEP * np.array([[0, 1, 0], [-200, -damping / 2, 0.5], [0, 0, 0]])) for damping in values]
    hold = np.linalg.matrix_power(np.tensordot(OF_ROBOT, holds, 1), 3)
    turn = Rotation.from_quat(reference.base_orientation, scalar_first=True).inv()
    wrench = np.ravel([turn.apply(each) for each in np.array(measured.wrench).reshape(2, 3)])
    np.testing.assert_allclose(command.base_displacement, -hold[0, 2] * wrench, rtol=1e-9)


def test_each_foot_has_the_gains_of_its_own_phase(scene):
    """By semi-implicit Euler, whose gains are those of the phase themselves."""
    reference, measured = scene
    values = np.array([20.0, 80.0, 40.0, 30.0])
    law = phased(EndEffectorAdmittance(1.5, 50.0, 900.0, Motion(semi_implicit=True)), ["damping"],
                 phase_time=TIME, phase_ramp=RAMP)  # fmt: skip
    command = walked(dataclasses.replace(law, **values_of("damping", values)), measured, reference)
    damping = (values @ SHARES)[:, None]
    turn = Rotation.from_quat(reference.base_orientation, scalar_first=True)
    force, shift, rate = turn.inv().apply(np.array(measured.foot_force)), np.zeros((4, 3)), np.zeros((4, 3))
    for _ in range(3):
        rate = rate + STEP * (force - damping * rate - 900 * shift) / 1.5
        shift = shift + STEP * rate
    np.testing.assert_allclose(command.foot_position - reference.foot_position, turn.apply(shift), rtol=1e-9)


@pytest.mark.slow
def test_each_foot_hands_its_load_over_by_the_gains_of_its_own_phase(scene):
    """Under load transfer, against NumPy with gains of each foot."""
    reference, measured = scene
    names, values = ["normal_damping", "leak", "unloading"], np.array([20.0, 80.0, 40.0, 30.0])
    scales = dict(zip(names, (1.0, 0.05, 0.02), strict=True))
    law = phased(LoadTransfer(tangential_damping=90.0, pull_limit=0.1), names, phase_time=TIME, phase_ramp=RAMP)
    law = dataclasses.replace(law, **{k: v for n in names for k, v in values_of(n, values * scales[n]).items()})
    law = dataclasses.replace(law, **{name: jnp.asarray(getattr(law, name), float) for name in law.GAINS})
    command = walked(law, measured, reference, steps=5)

    axes = Rotation.from_quat(reference.base_orientation, scalar_first=True)
    twin = oracle_laws.LoadTransfer(mc.load_scenario("case_1_2", {"time_step": STEP}), axes, 4)
    whole = {name: np.asarray(getattr(LoadTransfer, name)) for name in LoadTransfer.GAINS}
    of_each = {name: (values * scale @ SHARES)[:, None] for name, scale in scales.items()}
    twin.gains = whole | {"tangential_damping": 90.0, "pull_limit": 0.1} | of_each
    base = np.array(measured.base_position), np.array(measured.base_orientation)
    for _ in range(5):
        feet = twin.say(
            np.array(reference.base_position), base, np.array(measured.foot_force), None, np.array(measured.support),
            True, np.array(reference.foot_position), np.array([UNTIL, SINCE]),
        )[2]  # fmt: skip
    np.testing.assert_allclose(command.foot_position, feet, rtol=0, atol=1e-12)
    assert np.abs(command.foot_position - reference.foot_position).max() > 1e-4


def test_joint_gains_are_multiplied_by_the_phase_of_the_limb(scene):
    """Of a sum by both; kd stays where only kp was asked for."""
    reference, measured = scene
    inner = dataclasses.replace(phased(PD(), ["kp"], phase_time=TIME, phase_ramp=RAMP), kp_in_swing=0.5)
    command = walked(inner, measured, reference)
    np.testing.assert_allclose(command.joint_gains.kp, np.array([0.5, 1, 1, 1]) @ SHARES, rtol=1e-12)
    np.testing.assert_array_equal(command.joint_gains.kd, 1)
    law = dataclasses.replace(phased(PD(), ["kp", "kd"], phase_time=TIME, phase_ramp=RAMP),
                              kp_before_lift_off=3.0, kd_after_touchdown=2.0)  # fmt: skip
    found = walked(combined(law, inner), measured, reference).joint_gains
    np.testing.assert_allclose(found.kp, (np.array([1, 3, 1, 1]) @ SHARES) * (np.array([0.5, 1, 1, 1]) @ SHARES))
    np.testing.assert_allclose(found.kd, np.array([1, 1, 2, 1]) @ SHARES)
    own = dataclasses.replace(phased(PD(), ["ki"], phase_time=TIME, phase_ramp=RAMP), ki_in_swing=0.25)
    both = walked(combined(own, inner), measured, reference).joint_gains
    np.testing.assert_allclose(both.ki, np.array([0.25, 1, 1, 1]) @ SHARES, rtol=1e-12)
    np.testing.assert_allclose(both.kp, command.joint_gains.kp, rtol=1e-12)
    assert command.joint_gains.ki is None and found.ki is None
    assert law.search_bounds(STEP)["kp_in_swing"] == (0.1, 10.0) and "kp_standing" not in law.GAINS


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "damping_in_swing",
        "phase_ramp",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("damping_before_lift_off", "phase_time")),
    ],
)
def test_tangents_are_those_of_central_differences(scene, name):
    reference, measured = scene
    law = phased(EndEffectorAdmittance(1.5, 50.0, 900.0), ["damping"], phase_time=TIME, phase_ramp=RAMP)
    law = dataclasses.replace(law, **values_of("damping", (20.0, 80.0, 40.0, 30.0)))

    def of_gain(value):
        return walked(dataclasses.replace(law, **{name: value}), measured, reference).foot_position

    at = jnp.asarray(getattr(law, name))
    step = 1e-5 * at
    tangent = jax.jvp(of_gain, (at,), (jnp.ones(()),))[1]
    np.testing.assert_allclose(tangent, (of_gain(at + step) - of_gain(at - step)) / (2 * step), rtol=1e-4, atol=1e-14)
    assert jnp.abs(tangent).max() > 0


def test_a_loop_carries_what_moves_alone(scene):
    reference, measured = scene
    law = phased(VirtualModelAdmittance(), ["damping"])

    def loop(state):
        return jax.lax.scan(lambda s, _: law.step(s, measured, reference), state, length=10)

    program = jax.make_jaxpr(loop)(begin(law, Start(STEP, reference))).jaxpr
    assert [scan_sizes(e.params)[1] for e in program.eqns if e.primitive.name == "scan"] == [2]


class Rewritten(VirtualModelAdmittance):
    """The same law, whose step hands on as a new value what it leaves as it is."""

    def step(self, mass, measured, reference):
        return super().step(jax.tree.map(lambda value: value * 1, mass), measured, reference)


def test_a_value_times_one_is_the_same_value(scene):
    """What `init` makes of the gains is known by what it depends on, however a step is written."""
    reference, measured = scene
    found = []
    for kind in (VirtualModelAdmittance, Rewritten):
        law = phased(kind(2.0, 30.0, 400.0), ["damping"], phase_time=TIME, phase_ramp=RAMP)
        law = dataclasses.replace(law, **values_of("damping", (20.0, 80.0, 40.0, 30.0)))
        found.append(walked(law, measured, reference).base_displacement)
    np.testing.assert_allclose(*found, rtol=1e-12)


def test_gains_have_the_names_and_bounds_of_their_phases():
    law = phased(VirtualModelAdmittance(damping=7.0), ["damping"], phase_time=0.3)
    assert [law.damping_in_swing, law.damping_standing, law.phase_time] == [7.0, 7.0, 0.3]
    assert "damping" not in law.GAINS and law.GAINS["damping_in_swing"].unit == "N s/m, N m s/rad"
    words = {name: phased(law, ["stiffness", "kp"]).GAINS[name].long_name for name in ("stiffness_in_swing",
             "stiffness_before_lift_off", "kp_after_touchdown", "phase_ramp")}  # fmt: skip
    assert [*words.values()] == ["virtual stiffness K, in swing", "virtual stiffness K, before lift off",
                                 "factor of kp, after touchdown", "time from phase to phase"]  # fmt: skip
    with pytest.raises(ValueError, match=r"^gains by phase: expected some of inertia, .*, kp, kd, ki, .*, got none$"):
        phased(VirtualModelAdmittance(), [])
    bounds = law.search_bounds(STEP)
    assert bounds["damping_standing.rotation"] == (1e-1, 1e4) and bounds["phase_ramp"] == (5e-3, 0.5)
    both = combined(phased(EndEffectorAdmittance(), ["damping"]), law)
    assert {"end_effector_damping_in_swing", "virtual_model_phase_time", "virtual_model_stiffness"} <= both.GAINS.keys()
    with pytest.raises(ValueError, match=r"^gains by phase: expected some of inertia, .*Model.*, got mass$"):
        phased(VirtualModelAdmittance(), ["mass"])
    with pytest.raises(ValueError, match=r"^gains by phase: expected such as act on limbs, or such as do not"):
        phased(both, ["end_effector_inertia", "virtual_model_stiffness"])


SMALL = (
    ("duration", 0.3), ("gait.cycle", 0.4), ("gait.duty", 0.8), ("gait.stride", 0.005), ("gait.step_height", 0.002),
)  # fmt: skip


@pytest.mark.nightly
def test_a_walk_with_the_same_gains_in_all_phases_is_that_of_the_law(case):
    """And with others it is another."""
    scenario = case("case_1_2", "pd", SMALL)
    law = EndEffectorAdmittance(damping=1e3, stiffness=1e4)
    ours = phased(law, ["damping"], phase_time=0.03, phase_ramp=0.02)
    values = {"damping_before_lift_off": np.array([[1e3], [1e2]]) * np.ones(3)}
    found = mc.rollout_metrics(scenario, values, law=ours, dtype=np.float64)
    expected = mc.rollout_metrics(scenario, law=law, dtype=np.float64)
    for name in ("peak_foot_force", "force_variation", "base_deviation"):
        np.testing.assert_allclose(found[name][0], expected[name], rtol=1e-9)
    assert abs(found["force_variation"][1] / found["force_variation"][0] - 1) > 1e-4


@pytest.mark.nightly
def test_tangents_of_a_walk_are_those_of_central_differences(case):
    """By a factor of a joint gain, and by how long it is before a lift-off."""
    scenario, how = case("case_1_2", "pd", SMALL), {"dtype": np.float64, "smooth": True}
    how |= {"law": phased(PD(), ["kp", "kd"], phase_time=0.04, phase_ramp=0.02)}
    gains = {"kp_before_lift_off": np.array(1.2), "phase_time": np.array(0.0403)}
    along = {name: np.eye(2)[row] for row, name in enumerate(gains)}
    tangents = mc.rollout_jvp(scenario, gains, along, **how)[1]
    for row, name in enumerate(gains):
        sides = [mc.rollout_metrics(scenario, gains | {name: gains[name] + h}, **how) for h in (1e-5, -1e-5)]
        for metric in ("force_variation", "cost_of_transport", "base_deviation"):
            difference = (sides[0][metric] - sides[1][metric]) / 2e-5
            assert difference != 0
            np.testing.assert_allclose(tangents[metric][row], difference, rtol=1e-4, err_msg=f"{name} {metric}")
