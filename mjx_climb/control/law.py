"""The seam between the control laws and the rollout."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array


class Measurement(NamedTuple):
    """What the robot's sensors tell, and the base pose it works out from them; world axes, layout of the hot path."""

    base_position: Array  # (3, B) m
    base_orientation: Array  # (4, B) wxyz
    base_linear_velocity: Array  # (3, B) m/s
    base_angular_velocity: Array  # (3, B) rad/s
    foot_force: Array  # (3, L, B) N
    wrench: Array  # (6, B) N, N m: w = J_b^T F_e
    support: Array  # (L, B) bool


class Reference(NamedTuple):
    """What the gait asks for; world axes."""

    base_position: Array  # (3, B) m
    base_orientation: Array  # (4, B) wxyz
    foot_position: Array  # (3, L, B) m


class Command(NamedTuple):
    """Targets for the inverse kinematics, world axes, and the shift that led to them."""

    base_position: Array  # (3, B) m
    base_orientation: Array  # (4, B) wxyz
    foot_position: Array  # (3, L, B) m
    base_displacement: Array  # (6, B) m, rad: the law's shift of the base, reference axes


class Law(NamedTuple):
    """A control law: its state at the start, and one step of it."""

    initial: Any
    command: Callable[[Any, Measurement, Reference], tuple[Any, Command]]
