"""Admittance of the base, the paper's Eq. 3, `M dxdd + D dxd + K dx = w`, in two readings.

w = J_b^T F_e is the wrench of the foot forces on the base, dx the shift of the base in its six axes. The virtual model
is driven by -w, so that the base yields; the measured pose has +w, as the paper prints it; a foot is driven by +F.
Gains and shift are taken along the axes of the base reference, so a walk turned about z is the same walk.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.control.law import Command, Law, Measurement, Reference, Start, gain, shifted
from mjx_climb.control.virtual_mass import Motion, VirtualMass, advance, at_rest
from mjx_climb.physics.spatial import quaternion_conjugate, quaternion_multiply, quaternion_to_matrix


class SixAxes(Law):
    """Gains M, D and K of Eq. 3 in three translations and three rotations.

    A rotation's gain is about a lever squared, 0.04 m^2, times that of a translation with the same effect at the feet.
    """

    inertia: Array = gain(
        "kg, kg m^2", bounds=(1e-1, 1e2), rotation_bounds=(1e-2, 1e1), default=1.0, long_name="virtual inertia M",
        searched=False,
    )  # fmt: skip
    damping: Array = gain(
        "N s/m, N m s/rad", bounds=(1e0, 1e5), rotation_bounds=(1e-1, 1e4), default=5e3, long_name="virtual damping D"
    )
    stiffness: Array = gain(
        "N/m, N m/rad", bounds=(1e2, 1e6), rotation_bounds=(1e1, 1e5), default=5e4, long_name="virtual stiffness K"
    )


class VirtualModelAdmittance(SixAxes):
    """Eq. 3 as a virtual mass, damper and spring, `M dxdd + D dxd + K dx = -w`, integrated exactly: the base yields.

    The ground pushes the feet with w where something pushes the base with -w, so dx is driven by -w.
    """

    motion: Motion = Motion()

    def init(self, start: Start) -> VirtualMass:
        """Return the virtual mass at rest."""
        return at_rest(self, start.period, jnp.zeros_like(start.reference.base_position, shape=6), self.motion)

    def step(self, mass: VirtualMass, measured: Measurement, reference: Reference) -> tuple[VirtualMass, Command]:
        """Let the mass move under the wrench for one period, and shift the base by where it is."""
        to_reference = quaternion_to_matrix(reference.base_orientation).T
        # Eq. 3 driven by -w: driven by +w the base leans into a push (docs/explanation/departures.md, 1)
        mass = advance(mass, -_turned(to_reference, measured.wrench), self.motion)
        return mass, shifted(reference, mass.displacement)


class MeasuredPoseAdmittance(SixAxes):
    """Eq. 3 with dx and its rate measured: one step of the virtual mass from where the base is.

    `a = (w - D dxd - K dx) / M`, target `x_b + h dxd + h^2 a`; dx is the base's offset from its reference, dxd the
    base's own velocity. Rotations are twice the vector part of the quaternion. h is the `horizon`: the effect of the
    gains depends on it.
    """

    horizon: float | None = None  # s; None: the law's own period

    def init(self, start: Start) -> float | Array:
        """Return the horizon: there is nothing else to remember."""
        return start.period if self.horizon is None else self.horizon

    def step(self, horizon: Array, measured: Measurement, reference: Reference) -> tuple[Array, Command]:
        """Shift the base to where one step of the virtual mass leads."""
        to_reference = quaternion_to_matrix(reference.base_orientation).T
        turn = quaternion_multiply(quaternion_conjugate(reference.base_orientation), measured.base_orientation)
        turn = jnp.where(turn[0] < 0, -turn, turn)  # of the two quaternions of a rotation, that of the shorter way
        offset = jnp.concatenate([to_reference @ (measured.base_position - reference.base_position), 2 * turn[1:]])
        velocity = jnp.concatenate([measured.base_linear_velocity, measured.base_angular_velocity])
        rate, wrench = _turned(to_reference, velocity), _turned(to_reference, measured.wrench)

        # Eq. 3, solved for the acceleration
        acceleration = (wrench - self.damping * rate - self.stiffness * offset) / self.inertia
        target = offset + horizon * rate + horizon**2 * acceleration
        # half of its last three values is the vector part of a unit quaternion; a demand beyond half a turn keeps its
        # axis and saturates there
        half = target[3:] / 2
        square = jnp.sum(half * half)
        less = square < 1
        real = jnp.where(less, jnp.sqrt(jnp.where(less, 1 - square, 1.0)), 0.0)
        turn = jnp.concatenate([real[None], half / jnp.sqrt(jnp.maximum(square, 1.0))])
        return horizon, shifted(reference, target, turn)

    def search_bounds(self, period: float) -> dict[str, tuple[float, float]]:
        """Return where searches look, in proportion to the length of a step.

        One step takes the shares h D / M of the rate and h^2 K / M of the offset out of the target; the base is held
        only by shares of the order of one.
        """
        mass = float(np.exp(np.log(np.asarray(self.inertia, float)).mean()))
        bounds = super().search_bounds(period)
        inertias = {key: bounds[key] for key in ("inertia", "inertia.rotation")}
        damping, stiffness = (mass / period, 1e2 * mass / period), (1e-2 * mass / period**2, mass / period**2)
        return inertias | {"damping": damping, "stiffness": stiffness}


def _turned(rotation: Array, vectors: Array) -> Array:
    """Return a wrench or a velocity (6,) with both of its vectors turned."""
    return jnp.concatenate([rotation @ vectors[:3], rotation @ vectors[3:]])
