"""The numbers of a scenario as a pytree: what may differ from one environment of a batch to the next."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Real

from mjx_climb.quantities.ground import foothold_heights
from mjx_climb.scenario.model import Scenario

# batch axes of one gain need not be those of another: they broadcast; the hot path has them last
_Values = Array | np.ndarray
_Gain = Real[_Values, ""] | Real[_Values, "... 1"] | Real[_Values, "... 6"] | Real[_Values, "6 B"] | float
_JointGain = Real[_Values, "..."] | float
_Scalar = Real[_Values, "..."]
_Vector = Real[_Values, "... 3"] | Real[_Values, "3 B"]
_Footholds = Real[_Values, "... L N"]
_Pushes = Real[_Values, "... pushes 3"] | Real[_Values, "pushes 3 B"]
_PushTimes = Real[_Values, "... pushes"] | Real[_Values, "pushes B"]


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
    """Numbers of a scenario in SI units, each with any leading batch axes that broadcast with the gains'.

    Arrays of JAX, or of numpy, which keep double precision whatever JAX's own setting.
    `AXES` tells how many axes one environment's value has, where it is no scalar.
    """

    AXES: ClassVar[Mapping[str, int]] = MappingProxyType(
        {"gravity": 1, "foothold_height": 2, "push_force": 2, "push_moment": 2, "push_start": 1, "push_stop": 1}
    )

    gravity: _Vector  # (3,) m/s^2
    contact_stiffness: _Scalar  # N/m
    contact_damping: _Scalar  # N s/m
    holding_limit: _Scalar  # N, infinite where a gripper cannot be torn off
    kp: _Scalar  # N m/rad
    kd: _Scalar  # N m s/rad
    stride: _Scalar  # m
    step_height: _Scalar  # m
    cycle: _Scalar  # s
    duty: _Scalar  # 1
    heading: _Scalar  # rad
    foothold_height: _Footholds  # (L, N) m, of each limb's footholds in order; N = 0: flat ground
    cargo_mass: _Scalar  # kg
    cargo_start: _Scalar  # s
    cargo_stop: _Scalar  # s
    push_force: _Pushes  # (pushes, 3) N
    push_moment: _Pushes  # (pushes, 3) N m
    push_start: _PushTimes  # (pushes,) s
    push_stop: _PushTimes  # (pushes,) s
    mass_scale: _Scalar  # 1, of all masses and inertias of the robot; the cargo's not


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def parameters(scenario: Scenario, dtype: jnp.dtype | None = None) -> Parameters:
    """Return the numbers of a scenario, to be replaced one by one or by batches with `dataclasses.replace`."""
    contact, control, gait = scenario.contact, scenario.control, scenario.gait
    cargo, pushes = scenario.disturbance.cargo, scenario.disturbance.pushes
    values = dict(
        gravity=scenario.gravity,
        contact_stiffness=contact.stiffness,
        contact_damping=contact.damping,
        holding_limit=_or_infinite(contact.holding_limit),
        kp=control.kp,
        kd=control.kd,
        stride=gait.stride,
        step_height=gait.step_height,
        cycle=gait.cycle,
        duty=gait.duty,
        heading=gait.heading,
        foothold_height=foothold_heights(scenario),
        cargo_mass=cargo.mass,
        cargo_start=cargo.start,
        cargo_stop=_or_infinite(cargo.stop),
        push_force=[push.force for push in pushes],
        push_moment=[push.moment for push in pushes],
        push_start=[push.start for push in pushes],
        push_stop=[_or_infinite(push.stop) for push in pushes],
        mass_scale=1.0,
    )
    arrays = {}
    for name, value in values.items():
        array = jnp.asarray(value, dtype or jnp.result_type(float))
        without_pushes = name in ("push_force", "push_moment") and array.size == 0
        arrays[name] = array.reshape(0, 3) if without_pushes else array
    return Parameters(**arrays)


def gains(scenario: Scenario) -> Gains:
    """Return the admittance gains that the scenario's own control section gives."""
    control = scenario.control
    return Gains(*(jnp.asarray(value, float) for value in (control.inertia, control.damping, control.stiffness)))


def batch_shape(gains: Gains, parameters: Parameters) -> tuple[int, ...]:
    """Return the batch shape that gains and parameters broadcast to.

    Raises:
        ValueError: shapes that do not broadcast, or gains whose last axis is not 1 or 6.
    """
    shapes = [
        jnp.shape(value)[: jnp.ndim(value) - Parameters.AXES.get(name, 0)] for name, value in vars(parameters).items()
    ]
    for name in ("inertia", "damping", "stiffness"):
        shape = jnp.shape(getattr(gains, name))
        if shape and shape[-1] not in (1, 6):
            raise ValueError(f"gains.{name}: expected a scalar or a last axis of six, got shape {shape}")
        shapes.append(shape[:-1])
    shapes += [jnp.shape(value) for value in (gains.kp, gains.kd) if value is not None]
    return jnp.broadcast_shapes(*shapes)


def batch_last(
    gains: Gains, parameters: Parameters, shape: tuple[int, ...], dtype: jnp.dtype
) -> tuple[Gains, Parameters]:
    """Return gains (6, B) and parameters (..., B) in the layout of the hot path.

    The batch axes `shape` are flattened to one; what does not vary over them keeps a batch axis of size one.
    """

    def last(value: ArrayLike, natural: tuple[int, ...]) -> Array:
        value = jnp.asarray(value, dtype)
        lead = value.shape[: value.ndim - len(natural)]
        if math.prod(lead) != 1:
            lead = shape
        value = jnp.broadcast_to(value, (*lead, *natural)).reshape(math.prod(lead), *natural)
        return jnp.moveaxis(value, 0, -1)

    def six(value: ArrayLike) -> Array:
        value = jnp.asarray(value, dtype)
        return last(value if value.ndim else value[None], (6,))

    numbers = {}
    for name, value in vars(parameters).items():
        numbers[name] = last(value, jnp.shape(value)[jnp.ndim(value) - Parameters.AXES.get(name, 0) :])
    for name in ("kp", "kd"):
        if getattr(gains, name) is not None:
            numbers[name] = last(getattr(gains, name), ())
    return Gains(six(gains.inertia), six(gains.damping), six(gains.stiffness)), Parameters(**numbers)
