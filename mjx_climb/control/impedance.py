"""The gains that the paper's Eqs. 2 and 3 share: a virtual mass, damper and spring."""

from jax import Array

from mjx_climb.control.law import Law, gain

_INERTIA, _DAMPING, _STIFFNESS = (1e-1, 1e2), (1e0, 1e5), (1e2, 1e6)


class SixAxes(Law):
    """`M dxdd + D dxd + K dx = w` in three translations and three rotations.

    A rotation's gain is about a lever squared, 0.04 m^2, times that of a translation with the same effect at the feet.
    """

    inertia: Array = gain(
        "kg, kg m^2",
        bounds=_INERTIA,
        rotation_bounds=(1e-2, 1e1),
        default=1.0,
        long_name="virtual inertia M",
        searched=False,
    )
    damping: Array = gain(
        "N s/m, N m s/rad", bounds=_DAMPING, rotation_bounds=(1e-1, 1e4), default=5e3, long_name="virtual damping D"
    )
    stiffness: Array = gain(
        "N/m, N m/rad", bounds=_STIFFNESS, rotation_bounds=(1e1, 1e5), default=5e4, long_name="virtual stiffness K"
    )


class ThreeAxes(Law):
    """`M dxdd + D dxd + K dx = F` in three translations."""

    inertia: Array = gain("kg", length=3, bounds=_INERTIA, default=1.0, long_name="virtual inertia M", searched=False)
    damping: Array = gain("N s/m", length=3, bounds=_DAMPING, default=5e3, long_name="virtual damping D")
    stiffness: Array = gain("N/m", length=3, bounds=_STIFFNESS, default=5e4, long_name="virtual stiffness K")
