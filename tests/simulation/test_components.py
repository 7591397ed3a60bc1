"""A user's law, contact or actuator without a method, or with values out of bounds: one line each, before a walk."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, VirtualModelAdmittance
from mjx_climb.disturbances.link_wrench import LinkWrench
from mjx_climb.disturbances.on_base import Cargo
from mjx_climb.ground.ground import Ground
from mjx_climb.hardware.servo import Servos
from mjx_climb.hardware.velocity_commanded import VelocityCommanded
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.contact.uncertain import UncertainGripper
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.own_section import load_law

SHORT = {"duration": 0.01, "gait.cycle": 4.0}


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_2", "virtual_model", SHORT)


def begun(scenario, gains=None, **own):
    """Begin a walk as an abstract one: checked, and not compiled."""
    return jax.eval_shape(mc.Simulation(scenario, **own).reset, gains)


OUTSIDE = {  # contact, and the line that refuses it
    "above": (UncertainGripper(spread=50.0), "parameters.contact.spread: expected numbers from 0 to 1, got 50"),
    "below": (UncertainGripper(tries=0.5), "parameters.contact.tries: expected numbers from 1 to 100, got 0.5"),
    "nan": (
        UncertainGripper(seed=np.nan),
        "parameters.contact.seed: expected numbers from 0 to 1.67772e+07, got nan",
    ),
    "within": (
        UncertainGripper(damping=-1.0),
        "parameters.contact.damping: expected finite numbers of 0 or more, got -1",
    ),
}


@pytest.mark.parametrize("case_of", OUTSIDE)
def test_values_of_a_component_outside_of_their_bounds_are_refused(scenario, case_of):
    contact, said = OUTSIDE[case_of]
    for walk in (mc.Simulation(scenario, contact=contact).metrics, lambda: begun(scenario, contact=contact)):
        with pytest.raises(ValueError) as refused:
            walk()
        assert str(refused.value) == said


def test_the_ends_of_bounds_are_within_in_either_precision(scenario):
    """0.1 of single precision is above 0.1."""
    for value in (np.float32(0.1), np.float64(0.1), jnp.asarray(0.1, np.float32)):
        begun(scenario, drive=VelocityCommanded(p=value))
    begun(scenario, contact=UncertainGripper(spread=np.array(1.0)))


def test_the_gait_waits_for_grips_that_may_fail(scenario):
    """Given in Python too, unless the scenario has it go on."""
    goes_on = scenario.with_overrides({"gait.waiting.waits": False})
    assert begun(scenario, contact=UncertainGripper()).parameters.waiting is not None
    assert begun(scenario, contact=Gripper()).parameters.waiting is None
    assert begun(goes_on, contact=UncertainGripper()).parameters.waiting is None


def test_components_given_in_python_take_the_place_of_the_scenarios_or_act_beside_them(scenario):
    wrench = LinkWrench(force=np.array([1.0, 0.0, 0.0]))
    own = begun(scenario, drive=VelocityCommanded(), contact=UncertainGripper(), disturbances=iter([wrench])).parameters
    assert [type(each) for each in own.disturbances] == [Cargo, LinkWrench]
    assert (type(own.drive), type(own.contact)) == (VelocityCommanded, UncertainGripper)
    plain = begun(scenario)
    assert (type(plain.parameters.drive), type(plain.parameters.contact)) == (Servos, Gripper)
    assert {leaf.dtype for leaf in jax.tree.leaves(plain.parameters)} == {np.dtype(np.float64)}  # JAX's own setting


def test_a_simulation_refuses_what_no_walk_could_have(scenario):
    reach = "with which all feet are within reach and joint limits"
    for changes, said in (
        ({"gait.height": 2.5}, rf"gait.height: expected at most 1\.\d+, {reach}, got 2.5"),
        ({"gait.sway": 0.9, "gait.height": 1.7}, rf"gait.sway: expected at most 0\.\d+, {reach}, got 0.9"),
    ):
        with pytest.raises(ConfigError, match=f"^scenario: {said}$"):
            mc.Simulation(scenario.with_overrides(changes))
    with pytest.raises(ValueError, match=r"^disturbance: expected an instance of a class that inherits from mjx_climb"):
        mc.Simulation(scenario, disturbances=[Gripper()])


def test_gains_go_beyond_the_bounds_of_searches(scenario):
    """They say where searches look."""
    (_, most) = VirtualModelAdmittance.GAINS["damping"].bounds
    state = begun(scenario, {"damping": 100 * most})
    assert state.law.damping.shape == (6,)


class WithoutStep(mc.Law):
    """It has a start alone."""

    def init(self, start):
        return ()


class Stiff(mc.Actuator):
    """It does not say by which spring it holds joints."""

    stiffness: object = mc.parameter("N m/rad", bounds=(1.0, 1e3), default=50.0)

    def init(self, angles):
        return ()

    def step(self, memory, targets, gains, joints, period):
        torque = self.stiffness * (targets - joints.angles) - 0.2 * joints.rates
        return memory, mc.Drive(torque, torque)


class Bound(Gripper):
    """Its springs are its own affair."""

    def springs(self):
        return None


class WithTable(PD):
    """A walk is compiled for its table, which could change in place."""

    table: object = dataclasses.field(default_factory=lambda: [1, 2])


def test_a_field_that_could_change_in_place_is_refused(scenario):
    with pytest.raises(ConfigError, match=r"^WithTable: table: expected a value that can be hashed, .*, got \[1, 2\]$"):
        begun(scenario, law=WithTable())
    begun(scenario, law=WithTable((1, 2)))


@pytest.mark.parametrize("base", [mc.Law, mc.Contact, mc.Actuator, mc.Disturbance, mc.Footholds])
def test_a_class_without_its_methods_has_no_instance(base):
    """The line names the class and the methods."""
    kind = type("Mine", (base,), {"__annotations__": {}})
    with pytest.raises(TypeError, match=r"^Can't instantiate abstract class Mine .*(init|act|score)"):
        kind()


def test_a_law_without_its_step_is_refused_in_one_line(tmp_path):
    with pytest.raises(TypeError, match=r"^Can't instantiate abstract class WithoutStep .*step'?$"):
        WithoutStep()
    text = "import mjx_climb as mc\n\nclass Mine(mc.Law):\n    def init(self, start):\n        return ()\n"
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(ConfigError, match=r"mine\.py: expected Mine to have its methods .*step") as refused:
        load_law(f"{tmp_path / 'mine.py'}:Mine")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("own", "name"), [({"drive": Stiff()}, "Stiff"), ({"contact": Bound()}, "Bound")])
def test_a_time_step_that_is_not_checked_is_said(scenario, own, name):
    with pytest.warns(UserWarning, match=rf"^{name} has no method spring.?: the time step of 0\.001 s is not checked"):
        begun(scenario, **own)


class Fixed(mc.Contact):
    """It has no `tear_off`."""

    def init(self, grip_point, rotation):
        return ()

    def step(self, memory, feet, turning, closed, ground):
        raise AssertionError("nobody walks")

    def springs(self):
        return mc.Springs(1e4, 20.0)


def test_holds_with_limits_ask_for_a_contact_that_can_be_torn_off(scenario):
    limits = {"limit_matrix": np.ones((1, 2, 3)), "limit_bound": np.ones((1, 2))}
    point = {"position": np.zeros((1, 3)), "normal": np.array([[0.0, 0.0, 1.0]]), "valid": np.ones(1)}
    parameters = dataclasses.replace(own_parameters(scenario), ground=Ground(holds=mc.Holds(**point, **limits)))
    with pytest.raises(ValueError, match=r"^Fixed: expected a method tear_off, as the holds have limits, got none$"):
        mc.Simulation(scenario, contact=Fixed()).reset(None, parameters)
