"""The values of a scenario as a pytree: what may differ from one robot of a batch to the next."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Real

from mjx_climb.execution.forked import check_process
from mjx_climb.quantities.ground import foothold_heights
from mjx_climb.quantities.low_reaction import swing_path
from mjx_climb.scenario.model import Scenario

# batch axes of one gain need not be those of another: they broadcast
_Values = Array | np.ndarray
_Gain = Real[_Values, ""] | Real[_Values, "... 1"] | Real[_Values, "... 6"] | float
_JointGain = Real[_Values, "..."] | float
_Scalar = Real[_Values, "..."]
_Vector = Real[_Values, "... 3"]
_Footholds = Real[_Values, "... limbs N"]
_SwingPaths = Real[_Values, "... limbs 3 K"]
_Pushes = Real[_Values, "... pushes 3"]
_PushTimes = Real[_Values, "... pushes"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gains:
    """Gains of the admittance law (paper Eqs. 2 and 3): scalar, six axes, or a batch of six axes.

    Axes: three translations, then three rotations, about the axes of the walk (x ahead, z up). The end-effector law
    uses the translations. `kp` and `kd` replace the scenario's joint gains where given.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType({"inertia": 1, "damping": 1, "stiffness": 1})

    inertia: _Gain  # kg, kg m^2
    damping: _Gain  # N s/m, N m s
    stiffness: _Gain  # N/m, N m
    kp: _JointGain | None = None  # N m/rad
    kd: _JointGain | None = None  # N m s/rad


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Parameters:
    """Values of a scenario in SI units, each with any leading batch axes that broadcast with the gains'.

    Arrays of JAX, or of NumPy, which keep double precision whatever JAX's own setting.
    `AXES` tells how many axes one robot's value has, where it is no scalar.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType(
        {
            "gravity": 1,
            "foothold_height": 2,
            "swing_path": 3,
            "push_force": 2,
            "push_moment": 2,
            "push_start": 1,
            "push_stop": 1,
        }
    )

    gravity: _Vector  # (3,) m/s^2
    contact_stiffness: _Scalar  # N/m
    contact_damping: _Scalar  # N s/m
    rotational_stiffness: _Scalar  # N m/rad, of a grip
    rotational_damping: _Scalar  # N m s/rad
    holding_limit: _Scalar  # N, infinite where a gripper cannot be torn off
    kp: _Scalar  # N m/rad
    kd: _Scalar  # N m s/rad
    stride: _Scalar  # m
    step_height: _Scalar  # m
    cycle: _Scalar  # s
    duty: _Scalar  # 1
    heading: _Scalar  # rad
    foothold_height: _Footholds  # (limb, N) m, of each limb's footholds in order; N = 0: flat ground
    swing_path: _SwingPaths  # (limb, 3, K) step heights, added to each swing, see `low_reaction`; K = 0: nothing
    cargo_mass: _Scalar  # kg
    cargo_start: _Scalar  # s
    cargo_stop: _Scalar  # s
    push_force: _Pushes  # (pushes, 3) N
    push_moment: _Pushes  # (pushes, 3) N m
    push_start: _PushTimes  # (pushes,) s
    push_stop: _PushTimes  # (pushes,) s
    mass_scale: _Scalar  # 1, of all masses and inertias of the robot; the cargo's not
    capture_distance: _Scalar  # m, infinite: a gripper holds however far off the ground it shuts
    control_period: _Scalar  # s, rounded to time steps; 0: the time step
    command_delay: _Scalar  # s
    force_delay: _Scalar  # s
    force_noise: _Scalar  # N
    force_bias: _Scalar  # N
    force_resolution: _Scalar  # N
    force_filter: _Scalar  # Hz, infinite: none
    base_delay: _Scalar  # s
    position_noise: _Scalar  # m
    velocity_noise: _Scalar  # m/s
    torque_limit: _Scalar  # N m, infinite: none
    no_load_speed: _Scalar  # rad/s, infinite: none
    armature: _Scalar  # kg m^2, beside what the robot's file says
    coulomb_friction: _Scalar  # N m
    viscous_friction: _Scalar  # N m s/rad
    load_friction: _Scalar  # 1
    backlash: _Scalar  # rad
    servo_delay: _Scalar  # s
    seed: _Scalar  # whole, below 2^24 so that single precision holds it


KEYS = {  # of a scenario, whose values and ranges these are
    "gravity": "gravity",
    "contact_stiffness": "contact.stiffness",
    "contact_damping": "contact.damping",
    "rotational_stiffness": "contact.rotational_stiffness",
    "rotational_damping": "contact.rotational_damping",
    "holding_limit": "contact.holding_limit",
    "kp": "control.kp",
    "kd": "control.kd",
    "stride": "gait.stride",
    "step_height": "gait.step_height",
    "cycle": "gait.cycle",
    "duty": "gait.duty",
    "heading": "gait.heading",
    "cargo_mass": "disturbance.cargo.mass",
    "cargo_start": "disturbance.cargo.start",
    "cargo_stop": "disturbance.cargo.stop",
    "push_force": "disturbance.pushes.force",
    "push_moment": "disturbance.pushes.moment",
    "push_start": "disturbance.pushes.start",
    "push_stop": "disturbance.pushes.stop",
    "capture_distance": "contact.capture_distance",
    "control_period": "hardware.control_period",
    "command_delay": "hardware.command_delay",
    "force_delay": "hardware.force_sensor.delay",
    "force_noise": "hardware.force_sensor.noise",
    "force_bias": "hardware.force_sensor.bias",
    "force_resolution": "hardware.force_sensor.resolution",
    "force_filter": "hardware.force_sensor.filter",
    "base_delay": "hardware.base_estimate.delay",
    "position_noise": "hardware.base_estimate.position_noise",
    "velocity_noise": "hardware.base_estimate.velocity_noise",
    "torque_limit": "hardware.servo.torque_limit",
    "no_load_speed": "hardware.servo.no_load_speed",
    "armature": "hardware.servo.armature",
    "coulomb_friction": "hardware.servo.coulomb_friction",
    "viscous_friction": "hardware.servo.viscous_friction",
    "load_friction": "hardware.servo.load_friction",
    "backlash": "hardware.servo.backlash",
    "servo_delay": "hardware.servo.delay",
    "seed": "hardware.seed",
}


def parameters(scenario: Scenario, dtype: jnp.dtype | None = None) -> Parameters:
    """Return the parameters of a scenario, to be replaced one by one or by batches with `dataclasses.replace`."""
    return parameters_by(functools.partial(jnp.asarray, dtype=dtype or jnp.result_type(float)), scenario)


def own_parameters(scenario: Scenario) -> Parameters:
    """Return the parameters of a scenario in double precision, as arrays of NumPy."""
    return parameters_by(functools.partial(np.asarray, dtype=float), scenario)


def parameters_by(array: Callable[[Any], Any], scenario: Scenario) -> Parameters:
    """Return the parameters of a scenario as arrays that a function makes."""
    check_process()
    values = {name: _value(scenario, *key.split(".")) for name, key in KEYS.items()}
    values |= {"foothold_height": foothold_heights(scenario), "swing_path": swing_path(scenario), "mass_scale": 1.0}
    arrays = {name: array(value) for name, value in values.items()}
    if not scenario.disturbance.pushes:
        arrays |= {name: arrays[name].reshape(0, 3) for name in ("push_force", "push_moment")}
    return Parameters(**arrays)


def _value(section: Any, name: str, *rest: str) -> Any:
    """Return the value at a key of a section, of each section in a list of them; null is infinite."""
    if isinstance(section, tuple):
        return [_value(each, name, *rest) for each in section]
    value = getattr(section, name)
    return _value(value, *rest) if rest else math.inf if value is None else value


def gains(scenario: Scenario) -> Gains:
    """Return the admittance gains that the scenario's own control section gives."""
    control = scenario.control
    return Gains(*(jnp.asarray(value, float) for value in (control.inertia, control.damping, control.stiffness)))
