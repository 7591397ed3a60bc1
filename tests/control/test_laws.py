"""Control laws as functions of one robot: one step against other code than ours, under jit, vmap and jvp."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import (
    LAWS,
    PD,
    EndEffectorAdmittance,
    MeasuredPoseAdmittance,
    Start,
    VirtualModelAdmittance,
    begin,
    law_of,
)
from mjx_climb.control.combined import product
from mjx_climb.control.law import SENSORS, beginning, constants
from mjx_climb.control.virtual_mass import Motion
from mjx_climb.execution.jax_internals import scan_sizes

STEP = 1e-3
FEET = np.array([[0.14, 0.14, 0.0], [-0.14, 0.14, 0.0], [-0.14, -0.14, 0.0], [0.14, -0.14, 0.0]])
pose = st.tuples(*[st.floats(-0.3, 0.3)] * 12).map(lambda values: np.array(values).reshape(4, 3))


def power(low, high):
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


def reference_of(position=(0.0, 0.0, 0.11), turn=(0.0, 0.0, 0.0)):
    quaternion = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return mc.Reference(jnp.asarray(position), jnp.asarray(quaternion), jnp.asarray(FEET))


def measured_of(reference, force=0.0, moment=(0.0, 0.0, 0.0)):
    """A measurement of a base at its reference, with a force on each foot."""
    forces, still = jnp.broadcast_to(jnp.asarray(force, float), (4, 3)), jnp.zeros(3)
    wrench = jnp.concatenate([forces.sum(0), jnp.asarray(moment, float)])
    return mc.Measurement(*reference[:2], still, still, forces, wrench, jnp.ones(4, bool))


@jax.jit
def command_of(law, measured, reference):
    return law.step(begin(law, Start(STEP, reference)), measured, reference)[1]


@given(power(-2, 2), power(-1, 3), power(-1, 5), pose, pose)
def test_measured_pose_is_one_step_of_eq_3(inertia, damping, stiffness, measured, planned):
    """`x_des = dx + dt dxd + dt^2 (w - D dxd - K dx) / M` in the axes of the reference, by other code than ours."""
    position, velocity, omega, force = measured
    aim, turned, axis, moment = planned
    reference = Rotation.from_rotvec(turned)
    base = (reference * Rotation.from_rotvec(axis)).as_quat(scalar_first=True)
    law = MeasuredPoseAdmittance(*(value * np.ones(6) for value in (inertia, damping, stiffness)))
    found = mc.Measurement(
        position, base, velocity, omega, np.zeros((4, 3)), np.concatenate([force, moment]), np.ones(4, bool)
    )
    command = command_of(law, found, reference_of(aim, turned))

    own = reference.inv().apply
    offset = np.concatenate([own(position - aim), 2 * Rotation.from_rotvec(axis).as_quat()[:3]])
    rate = np.concatenate([own(velocity), own(omega)])
    acceleration = (np.concatenate([own(force), own(moment)]) - damping * rate - stiffness * offset) / inertia
    shift = offset + STEP * rate + STEP**2 * acceleration
    np.testing.assert_allclose(command.base_displacement, shift, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(command.base_position, aim + reference.apply(shift[:3]), rtol=1e-9, atol=1e-12)
    assert float(np.linalg.norm(command.base_orientation)) == pytest.approx(1, abs=1e-12)
    if np.linalg.norm(shift[3:]) < 1.9:
        half = shift[3:] / 2
        turn = Rotation.from_quat([*half, np.sqrt(1 - half @ half)])
        difference = (reference * turn).inv() * Rotation.from_quat(command.base_orientation, scalar_first=True)
        assert difference.magnitude() < 1e-7


def held(inertia, damping, stiffness, force, steps):
    """Return the displacements (steps,) of `M x'' + D x' + K x = F` from rest under a force that is held."""
    system = np.array([[0.0, 1.0, 0.0], [-stiffness / inertia, -damping / inertia, force / inertia], [0.0, 0.0, 0.0]])
    return np.array([(expm(system * STEP * (n + 1)) @ [0.0, 0.0, 1.0])[0] for n in range(steps)])


def steps_of(law, measurements, reference):
    """Return the commands of a law step by step, one after the other."""
    law = dataclasses.replace(law, **{name: jnp.asarray(getattr(law, name), float) for name in law.GAINS})
    state, step, found = begin(law, Start(STEP, reference)), jax.jit(law.step), []
    for measured in measurements:
        state, command = step(state, measured, reference)
        found.append(command)
    return found


def test_each_foot_yields_by_eq_2_along_the_axes_of_the_reference_while_it_stands():
    """An open gripper's shift is gone at once, and a foot that stands again begins at rest."""
    reference = reference_of(turn=(0.1, -0.2, 0.7))
    turn = Rotation.from_quat(reference.base_orientation, scalar_first=True)
    gains = {"inertia": [1.0, 2.0, 3.0], "damping": [30.0, 40.0, 50.0], "stiffness": [4e3, 6e3, 5e3]}
    forces = np.array([[3.0, -2.0, 5.0], [1.0, 1.0, 1.0], [0.0, 4.0, 0.0], [2.0, 0.0, -6.0]])
    measured = measured_of(reference)._replace(foot_force=jnp.asarray(turn.apply(forces)))
    opens = measured._replace(support=jnp.array([True, False, True, True]))
    found = steps_of(EndEffectorAdmittance(**gains), [measured, opens, measured, measured], reference)
    expected = np.stack([
        np.stack([held(*own, force, 4) for own, force in zip(zip(*gains.values(), strict=True), row, strict=True)], -1)
        for row in forces
    ], 1)  # fmt: skip
    expected[1:, 1] = np.stack([np.zeros(3), expected[0, 1], expected[1, 1]])
    for command, shift in zip(found, expected, strict=True):
        moved = turn.inv().apply(np.array(command.foot_position - reference.foot_position))
        np.testing.assert_allclose(moved, shift, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(command.base_position, reference.base_position)


def test_the_base_yields_by_eq_3_against_the_wrench_along_the_axes_of_the_reference():
    reference = reference_of(turn=(0.1, -0.2, 0.7))
    turn = Rotation.from_quat(reference.base_orientation, scalar_first=True)
    gains = {
        "inertia": np.arange(1.0, 7.0),
        "damping": 10.0 * np.arange(2.0, 8.0),
        "stiffness": 1e3 * np.arange(3.0, 9),
    }
    wrench = np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6])
    world = jnp.asarray(np.concatenate([turn.apply(wrench[:3]), turn.apply(wrench[3:])]))
    found = steps_of(VirtualModelAdmittance(**gains), [measured_of(reference)._replace(wrench=world)] * 3, reference)
    expected = np.stack(
        [held(*own, -w, 3) for own, w in zip(zip(*gains.values(), strict=True), wrench, strict=True)], -1
    )
    for command, shift in zip(found, expected, strict=True):
        np.testing.assert_allclose(command.base_displacement, shift, rtol=1e-6)
        np.testing.assert_allclose(command.base_position, reference.base_position + turn.apply(shift[:3]), rtol=1e-9)
        np.testing.assert_array_equal(command.foot_position, FEET)


def test_gains_that_nobody_gives_are_those_of_the_papers_case_1_2():
    for kind in (VirtualModelAdmittance, MeasuredPoseAdmittance, EndEffectorAdmittance):
        assert (kind().inertia, kind().damping, kind().stiffness) == (1.0, 5e3, 5e4), kind
        # one range for a gain, whichever law has it
        bounds = {name: kind.GAINS[name].bounds for name in ("inertia", "damping", "stiffness")}
        assert bounds == {"inertia": (0.1, 1e2), "damping": (1.0, 1e5), "stiffness": (1e2, 1e6)}, kind
    control = mc.load_scenario("case_1_2").control
    assert (control.inertia, control.damping, control.stiffness) == (1.0, 5e3, 5e4)


def test_searches_of_the_measured_pose_look_in_proportion_to_the_step():
    law = MeasuredPoseAdmittance(np.array([1.0, 4.0] * 3), np.ones(6), np.ones(6))  # 2 in the mean of logarithms
    bounds = law.search_bounds(0.004)
    assert bounds["damping"] == pytest.approx((2 / 0.004, 100 * 2 / 0.004))
    assert bounds["stiffness"] == pytest.approx((0.01 * 2 / 0.004**2, 2 / 0.004**2))
    assert bounds["inertia"] == (1e-1, 1e2) and bounds["inertia.rotation"] == (1e-2, 1e1)


def test_measured_pose_saturates_at_half_a_turn():
    """A demand beyond it keeps its axis, and the quaternion stays of unit length."""
    reference = reference_of()
    law = MeasuredPoseAdmittance(np.ones(6), np.ones(6), np.ones(6), horizon=1.0)
    command = command_of(law, measured_of(reference, moment=(0.0, 30.0, 40.0)), reference)
    np.testing.assert_allclose(command.base_orientation, [0.0, 0.0, 0.6, 0.8], atol=1e-12)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, id=kind.__name__, marks=[pytest.mark.slow] * (kind is not PD))
        for kind in dict.fromkeys(LAWS.values())
    ],
)
def test_a_law_of_one_robot_is_mapped_and_differentiated(kind):
    """Under vmap each robot has what it has alone; tangents by a gain are those of central differences."""
    reference = reference_of(turn=(0.1, 0.2, 0.3))
    measured = measured_of(reference, np.arange(12.0).reshape(4, 3), (1.0, 2.0, 3.0))
    measured = measured._replace(base_position=measured.base_position + 0.01)

    def of_stiffness(stiffness):
        law = kind(**{name: stiffness if name == "stiffness" else jnp.ones(()) for name in kind.GAINS})
        state = begin(law, Start(STEP, reference))
        for _ in range(3):
            state, command = law.step(state, measured, reference)
        return command[:4]  # none of these laws has joint gains of its own

    values = jnp.array([10.0, 3e3])
    batch = jax.jit(jax.vmap(of_stiffness))(values)
    for row, value in enumerate(values):
        for own, alone in zip(batch, of_stiffness(value), strict=True):
            np.testing.assert_allclose(own[row], alone, rtol=1e-12, atol=1e-12)
    tangent = jax.jvp(of_stiffness, (values[1],), (1.0,))[1]
    for own, above, below in zip(tangent, of_stiffness(values[1] + 1), of_stiffness(values[1] - 1), strict=True):
        np.testing.assert_allclose(own, (above - below) / 2, rtol=1e-5, atol=1e-12)
    assert kind is PD or max(float(jnp.abs(leaf).max()) for leaf in tangent) > 0


# --- What a law must keep


class Forgetful(VirtualModelAdmittance):
    def step(self, state, measured, reference):
        return (), super().step(state, measured, reference)[1]


class Growing(PD):
    def init(self, start):
        return jnp.zeros(3)

    def step(self, state, measured, reference):
        return measured.wrench, super().step((), measured, reference)[1]


class Rounding(Growing):
    def init(self, start):
        return 0, 0.0  # a whole number and a real one

    def step(self, state, measured, reference):
        return (state[0] + 0.5, state[1]), super().step(state, measured, reference)[1]


class OfABatch(PD):
    def step(self, state, measured, reference):
        return state, super().step(state, measured, reference)[1]._replace(base_displacement=jnp.zeros((6, 1)))


class Silent(PD):
    def step(self, state, measured, reference): ...


class Spoken(PD):
    def init(self, start):
        return {"mode": "off"}


class Deaf(PD):
    def step(self, state, measured):
        return super().step(state, measured, None)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (Silent, "Silent.step: expected a pair of state and command, got None"),
        (Spoken, "Spoken.init: expected a state of arrays and numbers, got 'off'"),
        (Deaf, "Deaf.step: expected 3 arguments beside self, got too many positional arguments"),
        (Forgetful, r"Forgetful.step: expected a state like that of init, VirtualMass.*, got \(\)"),
        (Growing, r"Growing.step: expected a state like that of init, float64\[3\], got float64\[6\]"),
        (Rounding, r"Rounding.step: expected a state like that of init, \('int64\[\]', 'float64\[\]'\), got \('float"),
        (OfABatch, r"OfABatch.step: expected the command, .*float64\[6\].*, got .*float64\[6, 1\]"),
    ],
)
def test_a_state_or_command_of_another_shape_is_refused_in_one_line(kind, message):
    with pytest.raises(mc.ConfigError, match=f"^{message}") as error:
        begin(kind(), Start(STEP, reference_of()))
    assert "\n" not in str(error.value)


def test_a_state_begins_in_the_precision_of_the_walk():
    reference = jax.tree.map(jnp.float32, reference_of())
    gains = np.ones((3, 6), np.float32)
    for law in (VirtualModelAdmittance(*gains), MeasuredPoseAdmittance(*gains, horizon=1e-3)):
        state = begin(law, Start(STEP, reference))
        assert {leaf.dtype for leaf in jax.tree.leaves(state)} == {np.dtype(np.float32)}


def test_declared_gains_are_checked():
    with pytest.raises(ValueError, match=r"^length of a gain: expected 1, 3 or 6, got 4"):
        mc.gain("N", length=4, bounds=(1.0, 2.0))
    with pytest.raises(ValueError, match=r"^bounds of a value: expected low < high"):
        mc.gain("N", bounds=(2.0, 1.0))
    with pytest.raises(ValueError, match=r"^Taken.kp: expected another name"):
        type("Taken", (mc.Law,), {"__annotations__": {"kp": float}, "kp": mc.gain("N", bounds=(1.0, 2.0))})


@pytest.mark.parametrize(("kind", "carried"), [(PD, 0), (VirtualModelAdmittance, 2), (MeasuredPoseAdmittance, 0)])
def test_a_loop_carries_what_changes_alone(kind, carried):
    """What a law hands on as it is, its transition say, is a constant of the loop."""
    reference, law = reference_of(), kind(*np.ones((len(kind.GAINS), 6)))
    measured = measured_of(reference)

    def walked(state):
        return jax.lax.scan(lambda s, _: law.step(s, measured, reference), state, length=10)

    program = jax.make_jaxpr(walked)(begin(law, Start(STEP, reference))).jaxpr
    assert [scan_sizes(e.params)[1] for e in program.eqns if e.primitive.name == "scan"] == [carried]


class Remembering(PD):
    """A state of which some stays as `init` made it, in one way of writing or another, and some does not."""

    damping: jax.Array = mc.gain("N s/m", length=1, bounds=(1.0, 1e5), default=5e3)

    def init(self, start):
        made = {"handed": self.damping, "times_one": self.damping, "chosen": self.damping}
        made |= {"unknown": self.damping * jnp.nan}
        of_time = {"clock": -self.damping, "of_clock": self.damping, "decays": self.damping, "holds": self.damping}
        of_force = {"of_force": self.damping, "of_that": self.damping, "at_the_end": self.damping}
        partly = {"partly": jnp.stack([self.damping, self.damping])}
        return made | of_time | of_force | partly | {"force": 0.0, "reference": start.reference.base_position}

    def step(self, state, measured, reference):
        unread = jnp.sum(measured.foot_force) + jnp.sum(measured.joint_rates)
        jnp.sin(unread)
        after = {
            "handed": state["handed"],
            "times_one": state["times_one"] * 1,
            "unknown": state["unknown"] * 1,
            "chosen": jnp.where(state["handed"] > 1, state["chosen"], state["handed"]),
            "clock": state["clock"] + 1,
            "of_clock": jnp.where(state["clock"] > 9, state["decays"], state["of_clock"]),
            "decays": state["decays"] * 0.9,
            "holds": state["holds"] + 0 * state["clock"],
            "force": 0.9 * state["force"] + measured.wrench.sum(),
            "reference": reference.base_position,
            "of_force": jnp.maximum(state["of_force"], state["force"]),
            "of_that": jnp.maximum(state["of_that"], state["of_force"]),
            "at_the_end": jnp.maximum(state["at_the_end"], state["of_that"]),
            "partly": state["partly"] * jnp.array([1.0, 0.9]),
        }
        return after, super().step((), measured, reference)[1]


def test_what_stays_as_it_began_is_known_by_what_it_depends_on():
    """However a step is written; one compiled program tells."""
    reference = reference_of()
    law = Remembering(damping=jnp.asarray(7.0))

    @jax.jit
    def stays(law):
        begun = begin(law, Start(STEP, reference))
        names = [path[0].key for path, _ in jax.tree.leaves_with_path(begun)]
        found = constants(law, begun, measured_of(reference), reference)
        assert found[names.index("handed")] is True and found[names.index("force")] is False
        return dict(zip(names, found, strict=True))

    assert {name for name, found in stays(law).items() if found} == {"handed", "times_one", "unknown", "chosen"}


def test_what_a_step_looks_at_to_no_effect_is_not_read():
    """A force or a servo's report that nothing is made of needs no sensor."""
    found = beginning(Remembering(damping=jnp.asarray(7.0)), Start(STEP, reference_of()))
    assert (found.reads_forces, found.reads_servos) == (True, False)
    assert not beginning(PD(), Start(STEP, reference_of())).reads_forces


@pytest.mark.parametrize(
    ("field", "sensor"), [(field, sensor) for sensor, fields in SENSORS.items() for field in fields]
)
def test_a_law_that_looks_at_a_reading_reads_that_sensor(field, sensor):
    """Of the servos are the joints' angles and their efforts."""

    class Looks(PD):
        def step(self, state, measured, reference):
            command = super().step(state, measured, reference)[1]
            seen = jnp.sum(jnp.asarray(getattr(measured, field), float))
            return state, command._replace(base_position=command.base_position + seen)

    found = beginning(Looks(), Start(STEP, reference_of()))
    assert (set(found.reads), found.reads_forces) == ({sensor}, sensor == "forces")
    assert found.reads_servos == (sensor in ("joint angles", "joint efforts")) and found.joint_gains is None


def test_a_law_of_translations_has_the_translations_gains_and_each_law_its_limits():
    gains = {"inertia": [1.0, 2, 3, 4, 5, 6], "damping": [7.0, 8, 9, 1, 2, 3], "stiffness": 500.0}
    limits = {"integration": "semi_implicit", "deadband": 0.5, "max_offset": [0.01, 0.2], "max_velocity": None}
    motion = Motion(True, (0.5, 0.5), (0.01, 0.2), (math.inf, math.inf))
    for controller, size in (("base_admittance", 6), ("end_effector_admittance", 3)):
        control = {"controller": controller, "reading": "virtual_model", **gains, **limits}
        law = law_of(mc.Scenario().with_overrides({"control": control}))
        assert (*law.inertia,) == (*gains["inertia"][:size],) and (*law.damping,) == (*gains["damping"][:size],)
        assert (law.stiffness, law.motion) == (500.0, motion)


def test_factors_of_joint_gains_are_those_that_are_given():
    given = {"kp": jnp.ones(4), "kd": None, "ki": 2 * jnp.ones(4)}
    assert [*mc.control.JointGains(**given).moved] == ["kp", "ki"]
    one, other = mc.control.JointGains(**given), mc.control.JointGains(3 * jnp.ones(4), 5 * jnp.ones(4))
    assert [float(each[0]) for each in product(one, other)] == [3.0, 5.0, 2.0]
    assert [float(each[0]) for each in product(product(one, other), product(other, one))] == [9.0, 25.0, 4.0]
    assert product(None, other) is other and product(one, None) is one and product(None, None) is None
