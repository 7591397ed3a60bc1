"""The time step that contacts and joints can follow: of joints that move alone, of a base on its contacts, in words."""

import math

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step, growth, largest_time_step, short_enough

ARMATURE = 0.5  # kg m^2, beside which links weigh nothing: each joint moves alone
SOFT = {"contact.stiffness": 1.0, "contact.damping": 1e-3, "hardware.servo.armature": ARMATURE}
LONGER = 1.01  # time steps, by which a walk may ring beyond its planned postures


def scenario(**changes):
    return mc.load_scenario("case_1_1").with_overrides(SOFT | changes)


def critical(case, low=1e-5, high=10.0):
    """Return the longest time step that a scenario can follow, s."""
    assert growth(case, low) <= 1 + 1e-7 and growth(case, high) > 1 + 1e-7
    for _ in range(22):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if growth(case, middle) <= 1 + 1e-7 else (low, middle)
    return low


def alone(stiffness, damping):
    """Return the longest time step of a joint alone, s: the root of 4 m - 2 h d - h^2 k."""
    return (math.sqrt(damping**2 + 4 * ARMATURE * stiffness) - damping) / stiffness / LONGER


VOLTAGE = {"hardware.servo.drive": "voltage", "hardware.servo.torque_limit": 4.0, "hardware.servo.no_load_speed": 2.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"control.kp": 50.0, "control.kd": 0.0}, alone(50.0, 0.0)),
        ({"control.kp": 50.0, "control.kd": 5.0}, alone(50.0, 5.0)),
        ({"control.kp": 50.0, "control.kd": 0.0, "hardware.servo.viscous_friction": 3.0}, alone(50.0, 3.0)),
        ({"control.kp": 50.0, "control.kd": 1.0, **VOLTAGE}, alone(50.0, 1.0 + 4.0 / 2.0)),
        ({"control.kp": 50.0, "control.kd": 1.0, **VOLTAGE, "hardware.servo.rated_voltage": 10.0,
          "hardware.servo.supply_voltage": 12.0}, alone(60.0, 1.2 + 2.0 * 1.0)),
        ({"control.kp": 50.0, "control.kd": 0.0, "hardware.servo.coulomb_friction": 0.2}, alone(50.0, 0.0)),
    ],
)  # fmt: skip
def test_a_heavy_joint_alone_follows_the_step_of_its_own_equation(changes, expected):
    assert critical(scenario(**changes)) == pytest.approx(expected, rel=0.02)


RIGID = {"hardware.servo.armature": 1e4, "control.kp": 1.0, "control.kd": 1e-3}


@pytest.mark.parametrize(
    ("springs", "power"),
    [
        ({"contact.stiffness": 4e4, "contact.damping": 1e-3}, 0.5),
        ({"contact.stiffness": 1.0, "contact.damping": 400.0}, 1.0),
        ({"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_stiffness": 400.0}, 0.5),
        ({"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_stiffness": 1e-3,
          "contact.rotational_damping": 9.0}, 1.0),
    ],
)  # fmt: skip
def test_a_base_on_stiff_feet_follows_a_step_by_the_root_of_the_stiffness_or_the_damping(springs, power):
    """Joints that hardly move: the base is a rigid body on its contacts, stiffer ones of which shorten the step."""
    name = max(springs, key=springs.__getitem__)
    once, four = (critical(scenario(**RIGID, **springs | {name: factor * springs[name]})) for factor in (1, 4))
    assert once / four == pytest.approx(4**power, rel=0.01)


def test_feet_that_tilt_with_their_damping_count_where_they_are_held_against_turning_alone():
    free = {"contact.stiffness": 1.0, "contact.damping": 1e-3, "contact.rotational_damping": 9.0}
    held = {"contact.rotational_stiffness": 1e-3}
    assert critical(scenario(**RIGID, **free)) > 5 * critical(scenario(**RIGID, **free, **held))


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({"duration": 0.3, "gait.cycle": 0.4}, 0.1),
        ({"duration": 0.3, "gait.cycle": 0.375}, 0.025),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.control_period": 0.004}, 0.002),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.servo.rate": 250.0}, 0.002),
        ({"duration": 0.3, "gait.cycle": 0.4, "hardware.servo.rate": 250.0, "hardware.control_period": 0.025}, 0.001),
    ],
)
def test_the_largest_step_divides_all_that_is_counted_in_steps(changes, step):
    assert largest_time_step(scenario(**changes)) == step


def test_the_largest_step_is_short_enough_and_the_next_one_is_not():
    case = mc.load_scenario("case_1_1").with_overrides({"duration": 1.0, "gait.cycle": 1.0, "contact.stiffness": 3e5})
    step = largest_time_step(case)
    longest = critical(case, 1e-6, 0.1)
    assert step <= longest < 2.5 * step and short_enough(case.with_overrides({"time_step": step}))
    assert not short_enough(case.with_overrides({"time_step": 1e-3})) and growth(case) == growth(case, case.time_step)
    with pytest.raises(mc.ConfigError, match=r"expected contacts and joint gains that some step of 0.1 us or more"):
        largest_time_step(case.with_overrides({"contact.stiffness": 1e18}))


def test_a_refusal_names_what_holds_the_robot_and_the_step_that_would_do():
    case = mc.load_scenario("case_1_1").with_overrides({"contact.stiffness": 3e6, "control.kp": 40.0})
    check_time_step(mc.load_scenario("case_1_1"))
    with pytest.raises(mc.ConfigError) as refused:
        check_time_step(case, "mine.yaml")
    said = str(refused.value)
    assert said.startswith("mine.yaml: time_step: expected one short enough for ")
    assert "with contact.stiffness 3e+06, contact.damping" in said and "control.kp 40 and control.kd" in said
    assert f"{growth(case):.3g}-fold a step): {largest_time_step(case):g} would do" in said
    assert "back EMF" not in said and "stretched" not in said
    with pytest.raises(
        mc.ConfigError, match=r"contact.damping 20, a back EMF of 2 N m s/rad, control.kp 40 and contro"
    ):
        check_time_step(case.with_overrides(VOLTAGE))


def test_of_many_robots_the_one_that_cannot_follow_is_named():
    case = mc.load_scenario("case_1_1")
    stiffness = np.array([[1e4, 2e4, 3e4], [1e4, 4e6, 2e4]])
    own = own_parameters(case)
    check_time_step(case, parameters=own.replace({"contact.stiffness": np.minimum(stiffness, 5e4)}))
    with pytest.raises(mc.ConfigError, match=r"contact.stiffness 4e\+06, contact.damping 20, control.kp 50 and"):
        check_time_step(case, parameters=own.replace({"contact.stiffness": stiffness}))
    # the stiffest of each together would not, but no robot has both
    stiff = 1.5 * next(
        each for each in np.geomspace(1e4, 1e7, 60) if growth(case.with_overrides({"contact.stiffness": each})) > 1.001
    )
    apart = {"contact.stiffness": np.array([1e4, stiff]), "hardware.servo.armature": np.array([0.0, 0.05])}
    assert growth(case.with_overrides({"contact.stiffness": stiff})) > 1.001
    check_time_step(case, parameters=own.replace(apart))


def test_values_of_the_gait_that_all_robots_share_move_the_postures():
    case = mc.load_scenario("case_1_1").with_overrides({"contact.stiffness": 3e5})
    own = own_parameters(case)
    longer = growth(case, parameters=own.replace({"gait.stride": 0.1}))
    assert longer == growth(case.with_overrides({"gait.stride": 0.1})) != growth(case)
    apart = own.replace({"gait.stride": np.array([0.05, 0.1])})
    assert growth(case, parameters=apart) == growth(case)
