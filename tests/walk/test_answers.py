"""A component of a user's that answers otherwise than it should is refused in one line, by class and method."""

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.disturbances.disturbance import Body, External
from mjx_climb.physics.contact.contact import Grip
from mjx_climb.walk.answers import disturbed, driven, gripped

FEET, JOINTS, NONE = np.zeros((4, 3)), np.zeros((4, 2)), np.zeros(4, bool)
GRIP = Grip(FEET, FEET, FEET, NONE, NONE, NONE, NONE, NONE, np.zeros(4))
TORQUES = mc.Drive(JOINTS, JOINTS)


def contact_of(answer, memory=()):
    class Mine(mc.Contact):
        def init(self, grip_point, rotation): ...

        def step(self, memory, feet, turning, closed, ground):
            return answer

    return gripped(Mine(), memory, None, None, NONE, FEET[:, 0])


def actuator_of(answer, memory=0.0):
    class Mine(mc.Actuator):
        def init(self, angles): ...

        def step(self, memory, targets, gains, joints, period):
            return answer

    return driven(Mine(), memory, JOINTS, None, None, 1e-3)


def disturbance_of(answer):
    class Mine(mc.Disturbance):
        def act(self, time, body):
            return answer

    state = type("State", (), {"joint_angles": JOINTS})
    return disturbed(Mine(), 0.0, Body(None, None, state))


@pytest.mark.parametrize(("of", "answer", "expected"), [
    (contact_of, None, "Mine.step: expected a pair of memory and Grip, got None"),
    (contact_of, ((), GRIP, 1), "Mine.step: expected a pair of memory and Grip, got"),
    (contact_of, ((), {"foot_force": FEET}), "Mine.step: expected an object Grip, got {'foot_force': 'float64[4, 3]'}"),
    (contact_of, (FEET, GRIP), "Mine.step: expected a memory like that before, (), got float64[4, 3]"),
    (contact_of, ((), GRIP._replace(foot_force=FEET[1:])), "Mine.step: foot_force: expected real[4, 3], got"),
    (contact_of, ((), GRIP._replace(utilization=FEET)), "Mine.step: utilization: expected real[4], got float64[4, 3]"),
    (contact_of, ((), GRIP._replace(grip_point=FEET > 0)), "Mine.step: grip_point: expected real[4, 3], got bool"),
    (contact_of, ((), GRIP._replace(support=FEET[:, 0])), "Mine.step: support: expected bool[4], got float64[4]"),
    (actuator_of, (0.0, JOINTS), "Mine.step: expected an object Drive, got float64[4, 2]"),
    (actuator_of, (FEET, TORQUES), "Mine.step: expected a memory like that before, 0.0, got float64[4, 3]"),
    (actuator_of, (0.0, mc.Drive(JOINTS, FEET)), "Mine.step: joint_torque: expected real[4, 2], got float64[4, 3]"),
    (disturbance_of, None, "Mine.act: expected an object External, got None"),
    (disturbance_of, External(FEET), "Mine.act: base_wrench: expected real[6], got float64[4, 3]"),
    (disturbance_of, External(None, JOINTS.T), "Mine.act: joint_torque: expected real[4, 2], got float64[2, 4]"),
    (disturbance_of, External(None, None, FEET), "Mine.act: cargo_mass: expected real[], got float64[4, 3]"),
])  # fmt: skip
def test_another_answer_is_refused_in_one_line(of, answer, expected):
    with pytest.raises(mc.ConfigError) as refused:
        of(answer)
    assert str(refused.value).startswith(expected) and "\n" not in str(refused.value)


def test_a_memory_keeps_its_types_but_for_numbers_of_python():
    single, double = jnp.zeros(3, jnp.float32), jnp.zeros(3)
    with pytest.raises(mc.ConfigError, match=r"expected a memory like that before, float64\[3\], got float32\[3\]"):
        actuator_of((single, TORQUES), memory=double)
    assert actuator_of((single[0], TORQUES), memory=0.0)[1] is TORQUES
    assert contact_of(((), GRIP)) == ((), GRIP)
    assert disturbance_of(External(cargo_mass=1)).cargo_mass == 1


def test_other_arguments_are_refused_in_one_line():
    class Mine(mc.Disturbance):
        def act(self, time):
            return time

    with pytest.raises(mc.ConfigError, match=r"^Mine\.act: expected 2 arguments beside self, got too many positional"):
        disturbed(Mine(), 0.0, None)
