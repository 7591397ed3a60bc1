"""Base admittance, the paper's Eq. 3: `M dxdd + D dxd + K dx = w`, in two readings.

w = J_b^T F_e is the wrench of the foot forces on the base, dx the shift of the base in its six axes. Gains and shift
are taken along the axes of the base reference, so a walk turned about z is the same walk.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.control.base_shift import shifted
from mjx_climb.control.impedance import SixAxes
from mjx_climb.control.law import Command, Measurement, Reference, Start
from mjx_climb.control.motion import Mass, Motion, begin, move
from mjx_climb.control.virtual_model import rest
from mjx_climb.dynamics.spatial import (
    quaternion_conjugate,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_to_matrix,
    rotate_back,
)


def _in_reference_axes(rotation: Array, vector: Array) -> Array:
    """Turn the two halves of a six-vector (6, B) from world axes into those of the base reference."""
    return jnp.concatenate([rotate_back(rotation, vector[:3]), rotate_back(rotation, vector[3:])])


class VirtualModelAdmittance(SixAxes):
    """Eq. 3 as a virtual mass, spring and damper, integrated exactly, that yields to the wrench.

    The ground pushes the feet with w where something pushes the base with -w, so dx is driven by -w.
    """

    motion: Motion = Motion()

    def init(self, start: Start) -> Mass:
        """Return the virtual mass at rest, (6, B)."""
        return begin(self.motion, self, start.period, rest(self.stiffness))

    def step(self, state: Mass, measurement: Measurement, reference: Reference) -> tuple[Mass, Command]:
        """Return the reference with the base shifted."""
        rotation = quaternion_to_matrix(reference.base_orientation)
        moved = move(self.motion, self, state, -_in_reference_axes(rotation, measurement.wrench))
        displacement = moved.state.displacement
        turn = quaternion_from_rotation_vector(displacement[3:])
        return moved, shifted(reference, rotation, displacement, turn)


class MeasuredPoseAdmittance(SixAxes):
    """Eq. 3 with dx and its rate measured: one step of the virtual mass from where the base is.

    `a = (w - D dxd - K dx) / M`, target `x_b + dt dxd + dt^2 a`; dx is the base's offset from its reference, dxd the
    base's own velocity. Rotations are twice the vector part of the quaternion. dt is the `horizon`: what the gains do
    depends on it.
    """

    horizon: float | None = None  # s; None: the law's own period

    def init(self, start: Start) -> float | Array:
        """Return the horizon: there is nothing else to remember."""
        return start.period if self.horizon is None else self.horizon

    def step(
        self, state: float | Array, measurement: Measurement, reference: Reference
    ) -> tuple[float | Array, Command]:
        """Return the reference with the base shifted to where one step of the virtual mass leads."""
        rotation = quaternion_to_matrix(reference.base_orientation)
        turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measurement.base_orientation)
        turn = jnp.where(turn[0] < 0, -turn, turn)
        offset = jnp.concatenate(
            [rotate_back(rotation, measurement.base_position - reference.base_position), 2 * turn[1:]]
        )
        rate = _in_reference_axes(
            rotation, jnp.concatenate([measurement.base_linear_velocity, measurement.base_angular_velocity])
        )
        wrench = _in_reference_axes(rotation, measurement.wrench)
        acceleration = (wrench - self.damping * rate - self.stiffness * offset) / self.inertia
        target = offset + state * rate + state**2 * acceleration
        half = target[3:] / 2
        length = jnp.minimum(jnp.sum(half * half, axis=0), 1.0)
        # a demand beyond half a turn keeps its axis and saturates there
        real = jnp.sqrt(jnp.where(length < 1, 1 - length, 1.0)) * (length < 1)
        vector = half / jnp.sqrt(jnp.maximum(jnp.sum(half * half, axis=0), 1.0))
        return state, shifted(reference, rotation, target, jnp.concatenate([real[None], vector]))

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches look, which is what the length of a step makes of the gains.

        One step takes the shares dt D / M of the rate and dt^2 K / M of the offset out of the target; the base is held
        only by shares of the order of one.
        """
        mass = float(np.exp(np.log(np.asarray(self.inertia, float)).mean()))
        bounds = super().search_bounds(period)
        return {
            **{key: bounds[key] for key in ("inertia", "inertia.rotation")},
            "damping": (mass / period, 1e2 * mass / period),
            "stiffness": (1e-2 * mass / period**2, mass / period**2),
        }
