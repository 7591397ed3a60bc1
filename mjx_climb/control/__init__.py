"""Control laws behind one seam: what is measured and planned goes in, targets of base and feet come out.

A law is one module with `build(gains, time_step) -> Law`; what depends on the gains alone is worked out there, once a
walk.
"""

from collections.abc import Callable

from jax import Array

from mjx_climb.control import base_admittance, end_effector_admittance, pd
from mjx_climb.control.law import Command, Law, Measurement, Reference
from mjx_climb.quantities.parameters import Gains

# (controller, reading of the paper's equation) -> build; gains are (6, B)
LAWS: dict[tuple[str, str], Callable[[Gains, float | Array], Law]] = {
    ("pd", "virtual_model"): pd.build,
    ("pd", "measured_pose"): pd.build,
    ("base_admittance", "virtual_model"): base_admittance.build_virtual_model,
    ("base_admittance", "measured_pose"): base_admittance.build_measured_pose,
    ("end_effector_admittance", "virtual_model"): end_effector_admittance.build,
}

__all__ = ["LAWS", "Command", "Law", "Measurement", "Reference"]
