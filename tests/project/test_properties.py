"""What must hold for any input: scenarios and YAML, kinematics and its inverse, contact, the laws in discrete time.

`HYPOTHESIS_PROFILE=thorough` tries many more.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.control import LAWS, Measurement, Reference, Start
from mjx_climb.control.virtual_mass import VirtualMass, advance, discretize
from mjx_climb.dynamics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.dynamics.kinematics import Feet, limb_frames
from mjx_climb.quantities.parameters import Gains
from mjx_climb.robot.constants import load_robot
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.yaml_text import Dumper
from mjx_climb.walk.contact import Contact, grip

# ------------------------------------------------------------------------------------------------------------
# Scenarios

number = st.floats(allow_nan=False, allow_infinity=False)
above = st.floats(0, exclude_min=True, allow_infinity=False)
not_below = st.floats(0, allow_infinity=False)
vector = st.tuples(number, number, number)
gain = above | st.tuples(*[above] * 6)
heights = st.lists(number, min_size=1, max_size=3)
footholds = st.fixed_dictionaries(dict.fromkeys(["LF", "LH", "RH", "RF"], heights))


@st.composite
def windows(draw, **fields):
    start = draw(st.floats(0, 1e6))
    stop = draw(st.none() | st.floats(start, 1e7, exclude_min=True))
    return {**draw(st.fixed_dictionaries(fields)), "start": start, "stop": stop}


@st.composite
def scenarios(draw):
    """Return the data of a valid scenario, every key given."""
    time_step = draw(st.sampled_from([1e-4, 2.5e-4, 1e-3, 0.002]))
    controller = draw(st.sampled_from(["pd", "base_admittance", "end_effector_admittance"]))
    readings = ["virtual_model", "measured_pose"][: 1 if controller == "end_effector_admittance" else 2]
    return {
        "robot": draw(st.text().filter(lambda text: text.strip() and text.isprintable())),
        "gravity": draw(st.tuples(*3 * [st.floats(-1e4, 1e4)])),
        "duration": draw(st.integers(1, 10**6)) * time_step,
        "time_step": time_step,
        "gait": {
            "cycle": draw(st.integers(100, 10**6)) * time_step,
            "duty": draw(st.floats(0.75, 0.97)),
            "stride": draw(st.floats(0, 100)),
            "step_height": draw(st.floats(0, 100, exclude_min=True)),
            "sequence": draw(st.permutations(["LF", "LH", "RH", "RF"])),
            "swing": draw(st.sampled_from(["cubic", "low_reaction"])),
            "base_reference": draw(st.sampled_from(["nominal", "actual"])),
            "heading": draw(st.floats(-6.28, 6.28)),
        },
        "ground": draw(st.just({}) | st.fixed_dictionaries({"footholds": footholds})),
        "contact": {
            "stiffness": draw(above), "damping": draw(not_below), "holding_limit": draw(st.none() | not_below)
        },
        "control": {
            "controller": controller, "reading": draw(st.sampled_from(readings)), "inertia": draw(gain),
            "damping": draw(gain), "stiffness": draw(gain), "kp": draw(above), "kd": draw(not_below),
        },
        "disturbance": {
            "cargo": draw(windows(mass=not_below)),
            "pushes": draw(st.lists(windows(force=vector, moment=vector), max_size=3)),
        },
    }  # fmt: skip


def leaves(data, prefix=""):
    """Return the values of a scenario by dotted key, lists as a whole."""
    if not isinstance(data, dict):
        return {prefix: data}
    return {k: v for name, value in data.items() for k, v in leaves(value, f"{prefix}.{name}".lstrip(".")).items()}


def outcome(make):
    """Return the scenario, or what the user is told."""
    try:
        return make()
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1
        return str(error)


@given(scenarios())
def test_a_scenario_survives_yaml(data):
    scenario = Scenario.model_validate(data)
    assert Scenario.from_yaml(scenario.to_yaml()) == scenario


@given(scenarios())
def test_keys_one_by_one_make_the_scenario_of_the_file(data):
    scenario = Scenario.model_validate(data)
    one_by_one = [f"{key}={inline(value)}" for key, value in leaves(scenario.model_dump(mode="json")).items()]
    assert Scenario().with_overrides(one_by_one) == scenario


def inline(value) -> str:
    """Return a value as it may stand behind --set key=."""
    text = yaml.dump(value, Dumper=Dumper, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip("\n")


junk = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.floats() | st.text(), max_size=7)
)


@given(st.data(), scenarios())
def test_an_option_says_what_the_file_would(data, scenario):
    """Any key with a value from another scenario, or with nonsense: the same scenario, or the same one line."""
    known = leaves(scenario)
    key = data.draw(st.sampled_from(sorted(known)) | st.sampled_from(["gait.dutty", "speed", "contact.damping.x"]))
    value = data.draw(junk | st.just(known.get(key)))
    assume(inline(value).strip())
    nested = value
    for part in reversed(key.split(".")):
        nested = {part: nested}
    in_file = outcome(lambda: Scenario.from_yaml(yaml.dump(nested, Dumper=Dumper, allow_unicode=True), "walk"))
    as_option = outcome(lambda: Scenario().with_overrides([f"{key}={inline(value)}"]))
    if isinstance(in_file, str) and isinstance(as_option, str):
        assert key.split(".")[0] in in_file and key.split(".")[0] in as_option
    else:
        assert in_file == as_option


# ------------------------------------------------------------------------------------------------------------
# Kinematics

ROBOT = load_robot("hubrobo_v3_2")
GEOMETRY = limb_geometry(ROBOT)
shares = arrays(float, (4, 3), elements=st.floats(0, 1))


@jax.jit
def feet_of(joint_angles):
    return limb_frames(ROBOT, jnp.eye(3), joint_angles).foot


@jax.jit
def solved(target, direction):
    """Return joint angles, whether the targets are met, and the rate of the angles as the targets move."""
    (angles, met), (rates, _) = jax.jvp(lambda foot: inverse_kinematics(GEOMETRY, foot), (target,), (direction,))
    return angles, met, rates


@given(shares)
def test_inverse_kinematics_undoes_the_forward_one(share):
    """Within the limits, the foot ahead of the coxa's axis: to 1e-9 m, and to 1e-9 rad where the knee bends."""
    angles = ROBOT.joint_lower + share * (ROBOT.joint_upper - ROBOT.joint_lower)
    feet = np.asarray(feet_of(angles))
    local = np.vecmat(feet - GEOMETRY.hip_position, GEOMETRY.hip_rotation)
    coxa, tibia = angles[:, 0], angles[:, 2]
    ahead = np.cos(coxa) * local[:, 0] + np.sin(coxa) * local[:, 1] > 0.01
    again, met, _ = solved(feet, np.zeros_like(feet))
    assert (np.asarray(met) | ~ahead).all()
    assert (np.abs(feet_of(again) - feet) < 1e-9)[ahead].all()
    assert (np.abs(np.asarray(again) - angles) < 1e-9)[ahead & (tibia < -0.1)].all()


coordinate = st.floats(-0.4, 0.4) | st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1e-300, 1e-12])


@given(arrays(float, (4, 3), elements=coordinate), arrays(float, (4, 3), elements=st.floats(-1, 1)))
def test_any_target_has_an_answer(target, direction):
    """Angles within a turn and their derivative are finite; a target counts as met where, and only where, it is."""
    angles, met, rates = map(np.asarray, solved(target, direction))
    assert np.isfinite(angles).all() and np.isfinite(rates).all()
    assert (np.abs(angles) <= np.pi).all()
    missed = np.linalg.norm(feet_of(angles) - target, axis=1)
    assert (missed[met] < 1e-9).all()


# ------------------------------------------------------------------------------------------------------------
# Contact

PARAMETERS = jax.tree.map(np.asarray, mc.parameters(Scenario()))
place = arrays(float, (4, 3), elements=st.floats(-0.1, 0.1, allow_subnormal=False))
flags = arrays(bool, 4)
contacts = st.builds(Contact, grip_point=place, touching=flags, detached=flags, reach=st.just(()), attitude=st.just(()))
gripped = jax.jit(grip)


@given(
    contacts,
    place,
    place,
    flags,
    arrays(float, 4, elements=st.floats(-0.05, 0.05, allow_subnormal=False)),
    st.floats(0, 1e3),
)
def test_contact(contact, position, velocity, closed, ground, limit):
    """Who is held, who is pushed, and that the damper takes energy out, whatever a foot does."""
    feet = Feet(position, velocity, position, np.zeros((4, 3, 3)))
    parameters = dataclasses.replace(PARAMETERS, holding_limit=np.asarray(limit))
    after, held = jax.tree.map(np.asarray, gripped(contact, feet, closed, ground, parameters))
    at_ground = position[:, 2] <= ground
    np.testing.assert_array_equal(held.support, closed & ~contact.detached)
    np.testing.assert_array_equal(after.touching, held.support | at_ground)
    assert (held.force[~after.touching] == 0).all()
    # grips: where the foot came to the ground, and there for as long as it touches
    fresh = after.touching & ~contact.touching
    np.testing.assert_array_equal(after.grip_point[~fresh], contact.grip_point[~fresh])
    np.testing.assert_array_equal(after.grip_point[fresh, :2], position[fresh, :2])
    np.testing.assert_array_equal(after.grip_point[fresh, 2], ground[fresh])
    # power: what the spring stores comes back, what is left goes into the damper
    spring = -float(PARAMETERS.contact_stiffness) * (position - after.grip_point)
    damped = np.sum((held.force - spring) * velocity, axis=1)[after.touching]
    assert (damped <= 1e-9).all()
    np.testing.assert_allclose(
        damped, -float(PARAMETERS.contact_damping) * np.sum(velocity**2, axis=1)[after.touching], atol=1e-9
    )
    # grippers: torn off by a pull beyond the limit alone, and for good
    torn = held.support & (held.force[:, 2] < 0) & (np.linalg.norm(held.force, axis=1) > limit)
    np.testing.assert_array_equal(held.torn_off, torn)
    np.testing.assert_array_equal(after.detached, contact.detached | torn)


# ------------------------------------------------------------------------------------------------------------
# Laws in discrete time

STEP = 1e-3


def power(low, high):
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


inertias, dampings, stiffnesses = power(-2, 2), power(-3, 6), power(-2, 7)


@jax.jit
def step_matrix(gains, time_step):
    """Return displacement and rate after a step, of displacement, rate and a held force, (2, 3)."""
    t = discretize(gains, time_step)
    return jnp.array([[1 + t.xx, t.xv, t.xf], [t.vx, 1 + t.vv, t.vf]])


def natural(matrix, inertia, stiffness):
    """Return a step in units of the virtual mass itself, in which its elements compare: sqrt(M) v, sqrt(K) x, f."""
    row = np.array([np.sqrt(stiffness), np.sqrt(inertia)])
    return row[:, None] * matrix / np.array([*row, 1.0])


@given(inertias, dampings, stiffnesses)
def test_the_zero_order_hold_is_exact(inertia, damping, stiffness):
    """One step is the matrix exponential, for any positive gains."""
    continuous = np.array([[0, 1, 0], [-stiffness / inertia, -damping / inertia, 1 / inertia], [0, 0, 0]])
    ours = np.asarray(step_matrix(Gains(inertia, damping, stiffness), STEP))
    exact = natural(expm(continuous * STEP)[:2], inertia, stiffness)
    np.testing.assert_allclose(natural(ours, inertia, stiffness), exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


@jax.jit
def halves_and_whole(gains, displacement, rate, force):
    half, whole = (VirtualMass(displacement, rate, discretize(gains, period)) for period in (STEP / 2, STEP))
    return advance(advance(half, force), force), advance(whole, force)


def rounded(largest):
    """Values without the tiny ones, whose last digits underflow."""
    return st.floats(-largest, largest).map(lambda value: round(value, 9))


@given(inertias, dampings, stiffnesses, rounded(1), rounded(1), rounded(100))
def test_two_half_steps_are_one(inertia, damping, stiffness, displacement, rate, force):
    halves, whole = halves_and_whole(Gains(inertia, damping, stiffness), displacement, rate, force)
    energy = abs(displacement) * np.sqrt(stiffness) + abs(rate) * np.sqrt(inertia) + abs(force) / np.sqrt(stiffness)
    assert abs(halves.displacement - whole.displacement) * np.sqrt(stiffness) <= 1e-10 * energy
    assert abs(halves.rate - whole.rate) * np.sqrt(inertia) <= 1e-10 * energy


@jax.jit
def by_damping(inertia, damping, stiffness):
    """Return a step and its derivative by the logarithm of the damping."""
    return jax.jvp(lambda d: step_matrix(Gains(inertia, d, stiffness), STEP), (damping,), (damping,))


@given(inertias, stiffnesses)
def test_critical_damping_is_nothing_special(inertia, stiffness):
    """There the poles meet and the closed form has no derivative; value and derivative pass through it smoothly."""
    critical, near = 2 * np.sqrt(inertia * stiffness), 1e-5
    steps = [by_damping(inertia, critical * np.exp(side * near), stiffness) for side in (-1, 0, 1)]
    (low, low_slope), (_, slope), (high, high_slope) = (
        [natural(np.asarray(part), inertia, stiffness) for part in step] for step in steps
    )
    size = np.abs(slope).max()
    assert np.isfinite(slope).all() and size > 0
    np.testing.assert_allclose((high - low) / (2 * near), slope, atol=1e-6 * max(1, size))
    assert np.abs(high_slope - low_slope).max() <= 1e-3 * max(1, size)


pose = st.tuples(*[st.floats(-0.3, 0.3)] * 12).map(lambda values: np.array(values).reshape(4, 3))


@jax.jit
def measured_pose(gains, measurement, reference):
    law = LAWS["base_admittance", "measured_pose"](gains.inertia, gains.damping, gains.stiffness)
    return law.step(law.init(Start(STEP, reference)), measurement, reference)[1]


@given(inertias, power(-1, 3), power(-1, 5), pose, pose)
def test_measured_pose_is_one_step_of_eq_3(inertia, damping, stiffness, measured, planned):
    """`x_des = dx + dt dxd + dt^2 (w - D dxd - K dx) / M` in the axes of the reference, by other code than ours."""
    position, velocity, omega, force = measured
    aim, turned, axis, moment = planned
    reference, base = Rotation.from_rotvec(turned), Rotation.from_rotvec(turned) * Rotation.from_rotvec(axis)
    command = measured_pose(
        Gains(*(value * np.ones(6) for value in (inertia, damping, stiffness))),
        Measurement(
            base_position=position,
            base_orientation=base.as_quat(scalar_first=True),
            base_linear_velocity=velocity,
            base_angular_velocity=omega,
            foot_force=np.zeros((4, 3)),
            wrench=np.concatenate([force, moment]),
            support=np.ones(4, bool),
        ),
        Reference(aim, reference.as_quat(scalar_first=True), np.zeros((4, 3))),
    )

    def own(value):
        return reference.inv().apply(value)

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
