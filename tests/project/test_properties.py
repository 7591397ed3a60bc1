"""What must hold for any input: scenarios and YAML, contact, and shapes in signatures, see `tests/shapes.py`.

`HYPOTHESIS_PROFILE=thorough` tries many more.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from beartype.roar import BeartypeCallHintViolation
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import mjx_climb as mc
from mjx_climb.physics.contact.gripper import GripperMemory
from mjx_climb.physics.kinematics import Feet
from mjx_climb.physics.spatial import norm, quaternion_multiply, quaternion_to_matrix
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from mjx_climb.scenario.yaml_text import Dumper, pairs

# --- scenarios

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


def leaves(data):
    """Return the values of a scenario by dotted key, lists as a whole."""
    return dict(pairs({key: value for key, value in data.items() if value != {}}, "data"))


def outcome(make):
    """Return the scenario, or what the user is told."""
    try:
        return make()
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1
        return str(error)


@given(scenarios())
def test_a_scenario_survives_yaml_and_is_made_by_its_keys_one_by_one(data):
    scenario = Scenario.model_validate(data)
    assert Scenario.from_yaml(scenario.to_yaml()) == scenario
    one_by_one = [f"{key}={inline(value)}" for key, value in leaves(scenario.model_dump(mode="json")).items()]
    assert Scenario().with_overrides(one_by_one) == scenario


def inline(value) -> str:
    """Return a value as it may stand behind --set key=."""
    text = yaml.dump(value, Dumper=Dumper, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip("\n")


junk = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
junk = junk | st.lists(st.floats() | st.text(), max_size=7)


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
        # where a value does not go with another key's, the line is about both
        about_another = in_file.removeprefix("walk: ") in as_option
        assert about_another or (key.split(".")[0] in in_file and key.split(".")[0] in as_option)
    else:
        assert in_file == as_option


# --- contact

PARAMETERS = jax.tree.map(np.asarray, mc.parameters(Scenario()))
place = arrays(float, (4, 3), elements=st.floats(-0.1, 0.1, allow_subnormal=False))
flags = arrays(bool, 4)
contacts = st.builds(GripperMemory, place, flags, flags, reach=st.none(), attitude=st.none(), closing=st.none())


@jax.jit
def gripped(memory, feet, closed, ground, parameters):
    return parameters.contact.step(memory, feet, None, closed, ground)


levels = arrays(float, 4, elements=st.floats(-0.05, 0.05, allow_subnormal=False))


@given(contacts, place, place, flags, levels, st.floats(0, 1e3))
def test_contact(contact, position, velocity, closed, ground, limit):
    """Who is held, who is pushed, and that the damper takes energy out, whatever a foot does."""
    feet = Feet(position, velocity, position)
    parameters = PARAMETERS.replace({"contact.holding_limit": np.asarray(limit)})
    after, held = jax.tree.map(np.asarray, gripped(contact, feet, closed, ground, parameters))
    at_ground = position[:, 2] <= ground
    np.testing.assert_array_equal(held.support, closed & ~contact.detached)
    np.testing.assert_array_equal(after.touching, held.support | at_ground)
    assert (held.foot_force[~after.touching] == 0).all()
    # grips: where the foot came to the ground, and there for as long as it touches
    fresh = after.touching & ~contact.touching
    np.testing.assert_array_equal(after.grip_point[~fresh], contact.grip_point[~fresh])
    np.testing.assert_array_equal(after.grip_point[fresh, :2], position[fresh, :2])
    np.testing.assert_array_equal(after.grip_point[fresh, 2], ground[fresh])
    # power: what the spring stores comes back, what is left goes into the damper
    spring = -float(PARAMETERS.contact.stiffness) * (position - after.grip_point)
    damped = np.sum((held.foot_force - spring) * velocity, axis=1)[after.touching]
    lost = float(PARAMETERS.contact.damping) * np.sum(velocity**2, axis=1)[after.touching]
    assert (damped <= 1e-9).all()
    np.testing.assert_allclose(damped, -lost, atol=1e-9)
    # grippers: torn off by a pull beyond the limit alone, and for good
    torn = held.support & (held.foot_force[:, 2] < 0) & (np.linalg.norm(held.foot_force, axis=1) > limit)
    np.testing.assert_array_equal(held.torn_off, torn)
    np.testing.assert_array_equal(after.detached, contact.detached | torn)


# --- shapes


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: quaternion_to_matrix(jnp.ones(3)),
        lambda: quaternion_multiply(jnp.ones(4), jnp.ones(3)),
        lambda: mc.Gains(np.ones(5), 1.0, 2.0),
        lambda: mc.State(*[np.ones((2, 3))] * 6),  # its orientation has four components
    ],
)
def test_wrong_shapes_are_seen(wrong):
    with pytest.raises(BeartypeCallHintViolation):
        wrong()


def test_right_shapes_pass():
    """Batch axes that broadcast, arrays of numpy for those of JAX, and what JAX puts into trees on its way."""
    gains = mc.Gains(1, np.ones((64, 1)), 3e3)
    assert jax.tree.map(jnp.ndim, gains).damping == 2
    assert jax.tree.map(lambda _: True, gains).damping is True
    batch = mc.Gains(*[np.ones((3, 6))] * 3)
    assert jax.vmap(lambda one: one.damping)(batch).shape == (3, 6)
    assert norm(np.ones((5, 4))).shape == (5,)
