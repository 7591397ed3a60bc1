"""The sum of two laws against their equations, by other code than ours; its gains, derivatives and walks."""

import dataclasses
import pickle

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
    phased,
)
from mjx_climb.control.combined import combined, either
from tests.control.test_laws import STEP, measured_of, reference_of
from tuning.gains import gains_file, own_section

BASE, FEET = VirtualModelAdmittance(2.0, 30.0, 400.0), EndEffectorAdmittance(1.5, 50.0, 900.0)


def walked(law, measured, reference, steps=3):
    """What a law commands at last."""
    state = begin(law, Start(STEP, reference))
    for _ in range(steps):
        state, command = law.step(state, measured, reference)
    return command


def yielded(inertia, damping, stiffness, force, steps):
    """Displacements of `M xdd + D xd + K x = f` from rest, by a matrix exponential."""
    system = np.array([[0, 1, 0], [-stiffness / inertia, -damping / inertia, 1 / inertia], [0, 0, 0]])
    return expm(system * STEP * steps)[0, 2] * force


@pytest.fixture(scope="module")
def scene():
    """Forces at a base that is turned against the world."""
    reference = reference_of(turn=(0.3, -0.2, 0.5))
    force = np.random.default_rng(5).normal(size=(4, 3))
    return reference, measured_of(reference, force, (0.4, -0.6, 0.2))


def test_base_and_feet_yield_at_once(scene):
    reference, measured = scene
    command = walked(combined(BASE, FEET), measured, reference)
    turn = Rotation.from_quat(reference.base_orientation, scalar_first=True)
    own = [turn.inv().apply(each) for each in np.array(measured.wrench).reshape(2, 3)]
    shift = yielded(2.0, 30.0, 400.0, -np.ravel(own), 3)
    feet = turn.apply(yielded(1.5, 50.0, 900.0, turn.inv().apply(np.array(measured.foot_force)), 3))
    np.testing.assert_allclose(command.base_displacement, shift, rtol=1e-9)
    np.testing.assert_allclose(command.base_position - reference.base_position, turn.apply(shift[:3]), rtol=1e-9)
    np.testing.assert_allclose(command.foot_position - reference.foot_position, feet, rtol=1e-9)
    turned = (turn * Rotation.from_rotvec(shift[3:])).as_quat(scalar_first=True, canonical=True)
    np.testing.assert_allclose(command.base_orientation, turned, rtol=1e-9)


@pytest.mark.parametrize(("take_second", "own"), [(False, BASE), (True, FEET)])
def test_one_of_two_laws_commands(scene, take_second, own):
    """As it does alone, while the other one goes on; both choices have one structure, so one compiled program."""
    reference, measured = scene
    law = either(BASE, FEET, take_second=take_second)
    assert jax.tree.structure(law) == jax.tree.structure(either(BASE, FEET, take_second=not take_second))
    command, alone = walked(law, measured, reference), walked(own, measured, reference)
    jax.tree.map(np.testing.assert_array_equal, command, alone)
    assert pickle.loads(pickle.dumps(type(law))) is type(law)


def test_shifts_add_up_and_turns_follow_each_other(scene):
    reference, measured = scene
    laws = VirtualModelAdmittance(1e-3, 1e-2, 10.0), VirtualModelAdmittance(2e-3, 1e-1, 20.0)
    command, *parts = (walked(law, measured, reference) for law in (combined(*laws), *laws))
    turns = [Rotation.from_quat(one.base_orientation, scalar_first=True) for one in (*parts, reference)]
    expected = (turns[0] * turns[2].inv() * turns[1]).as_quat(scalar_first=True, canonical=True)
    np.testing.assert_allclose(command.base_orientation, expected, rtol=1e-9)
    assert (turns[2].inv() * turns[1]).magnitude() > 1e-3
    total = sum(one.base_position - reference.base_position for one in parts)
    np.testing.assert_allclose(command.base_position - reference.base_position, total, rtol=1e-9)


@pytest.mark.slow
def test_tangents_by_gains_of_both_are_those_of_central_differences(scene):
    reference, measured = scene

    def of_gains(base, feet):
        law = dataclasses.replace(combined(BASE, FEET), virtual_model_stiffness=base, end_effector_damping=feet)
        command = walked(law, measured, reference)
        return jnp.concatenate([command.base_displacement, command.foot_position.ravel()])

    at = jnp.array(400.0), jnp.array(50.0)
    for name, step in enumerate((1.0, 0.1)):
        rate = [jnp.zeros(()), jnp.zeros(())]
        rate[name] = jnp.ones(())
        tangent = jax.jvp(of_gains, at, tuple(rate))[1]
        above, below = (of_gains(*(a + side * step * r for a, r in zip(at, rate, strict=True))) for side in (1, -1))
        np.testing.assert_allclose(tangent, (above - below) / (2 * step), rtol=1e-4, atol=1e-15)
        assert jnp.abs(tangent).max() > 0


def test_gains_of_both_have_names_that_tell_whose_they_are():
    law = combined(BASE, FEET)
    assert [*law.GAINS] == [f"{whose}_{what}" for whose in ("virtual_model", "end_effector")
                            for what in ("inertia", "damping", "stiffness")]  # fmt: skip
    assert (law.virtual_model_damping, law.end_effector_stiffness) == (30.0, 900.0)
    assert type(law) is type(combined(VirtualModelAdmittance(), EndEffectorAdmittance()))
    assert {*combined(BASE, PD()).GAINS} == {"inertia", "damping", "stiffness"}
    assert "second_damping" in combined(BASE, VirtualModelAdmittance()).GAINS
    assert {*combined(FEET, LoadTransfer()).GAINS} == {*FEET.GAINS, *LoadTransfer.GAINS}  # none of a name in common
    assert combined(BASE, FEET).LIMBWISE == {f"end_effector_{name}" for name in FEET.LIMBWISE}
    by_phase = combined(phased(FEET, ["damping"]), FEET)
    assert {"first_damping_standing", "first_stiffness", "second_stiffness"} <= {*by_phase.GAINS}
    assert by_phase.LIMBWISE == {"first_inertia", "first_stiffness", *(f"second_{name}" for name in FEET.LIMBWISE)}
    bounds = combined(MeasuredPoseAdmittance(), FEET).search_bounds(STEP)
    assert bounds["measured_pose_stiffness"] == (1e4, 1e6)
    assert bounds["end_effector_stiffness"] == (1e2, 1e6)


def test_laws_go_by_names_that_are_put_together():
    """Which their gains files have, and `own.law.name`; a law that has no such name is refused."""
    for name in ("PD+EndEffectorAdmittance", "EndEffectorAdmittance@damping,stiffness", "LoadTransfer+PD+LoadTransfer",
                 "VirtualModelAdmittance@damping@stiffness+LoadTransfer@leak"):  # fmt: skip
        law = own_section.load_law(name)
        assert own_section.reference(law) == name and type(own_section.load_law(name)) is type(law)
        assert pickle.loads(pickle.dumps(type(law))) is type(law)  # as programs on disk find it
        scenario = mc.load_scenario("case_1_2").with_overrides({"own": own_section.section(law)})
        assert type(own_section.taken(scenario)[1]) is type(law)
    assert type(combined(BASE, combined(BASE, FEET))).__name__.endswith(
        "+(VirtualModelAdmittance+EndEffectorAdmittance)"
    )
    with pytest.raises(mc.ConfigError, match=r"^law: gains by phase: expected some of .* of PD, got leak$"):
        own_section.load_law("PD@leak+PD")
    with pytest.raises(mc.ConfigError, match=r"^law: expected FILE.py:NAME, or one of ClimbSDK, .*, got 'PD\+Nobody'$"):
        own_section.load_law("PD+Nobody")


def test_gains_of_a_sum_are_saved_and_read_back(tmp_path):
    law = combined(BASE, FEET)
    values = {name: getattr(law, name) for name in law.GAINS}
    file = gains_file.save(values | {"end_effector_damping": 70.0}, tmp_path / "gains.yaml", law=law)
    assert "law: VirtualModelAdmittance+EndEffectorAdmittance" in file.read_text()
    assert float(gains_file.load(file, law)["end_effector_damping"][0]) == 70.0
    assert own_section.section(law)["law"]["name"] == "VirtualModelAdmittance+EndEffectorAdmittance"


@pytest.mark.nightly
def test_a_walk_with_nothing_added_is_that_of_the_law_alone(case):
    scenario = case("case_1_2", "pd", (("duration", 0.1), ("gait.cycle", 0.4)))
    gains, how = {"stiffness": np.array([[3e3], [3e4]]) * np.ones(6)}, {"dtype": np.float64}
    alone = mc.rollout_metrics(scenario, gains, law=VirtualModelAdmittance(damping=1e2), **how)
    added = mc.rollout_metrics(scenario, gains, law=combined(VirtualModelAdmittance(damping=1e2), PD()), **how)
    for name in ("peak_foot_force", "force_variation", "base_deviation"):
        np.testing.assert_allclose(added[name], alone[name], rtol=1e-9)
    assert np.ptp(alone["force_variation"]) > 1e-3
