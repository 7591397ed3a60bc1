"""Gains for the C++ library `admittance_control` of the paper's first author (2026, Apache-2.0).

It moves a virtual mass for each three-vector, a force or a moment, `M x'' + D x' + K x = u`, by semi-implicit Euler in
substeps of at most 2 ms, as `mjx_climb.control.virtual_mass` does with `control.integration: semi_implicit`. It knows
one M, D and K for a force, and one of each for a moment.
"""

import math
from typing import Any

import numpy as np
import yaml

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.control.virtual_mass import LONGEST_PERIOD, SUBSTEP, Motion
from mjx_climb.files.dataset import SIX
from mjx_climb.scenario.messages import ConfigError
from tuning.gains import ros2_control
from tuning.gains.interfaces import INTERFACES, comment
from tuning.gains.ros2_control import six

_KINDS = ("force", "moment")  # of three axes each

_HEADER = """\
Gains for the C++ library admittance_control, written by mjx-climb export: call it every {period:g} s.
{interface}
Units: kg, N s/m, N/m, N, m, m/s; of moments kg m^2, N m s/rad, N m/rad, N m, rad, rad/s. An infinite bound is none."""


def check(gains: mc.Gains, period: float, source: str) -> None:
    """Refuse gains that the library cannot take, or that grow in it.

    Raises:
        ConfigError: in one line, gains that differ between the axes of a force or of a moment, a period that the
            library would cut short, or a substep that is too long.
    """
    for name, values in zip(mc.Gains.AXES, six(gains), strict=True):
        for kind, three, axes in zip(_KINDS, np.split(values, 2), np.split(np.array(SIX), 2), strict=True):
            if np.ptp(three):
                each = ", ".join(f"{axis} {value:.4g}" for axis, value in zip(axes, three, strict=True))
                expected = f"one value for the axes of a {kind}, which is all that admittance_control knows"
                raise ConfigError(source, name, expected, f"{each}: search them with --space split")
    if period > LONGEST_PERIOD * (1 + 1e-9):
        expected = f"a period of at most {LONGEST_PERIOD:g} s, to which admittance_control cuts longer ones"
        raise ConfigError(source, "", expected, f"{period:g}")
    substep = substep_of(period)
    if not ros2_control.stable(gains, 1 / substep).all():
        inertia = 1.05 * ros2_control.smallest_inertia(gains, 1 / substep).max()
        expected = f"gains that are stable in the substeps of {substep:g} s that admittance_control takes"
        raise ConfigError(
            source, "", expected, f"a displacement that grows: a virtual inertia of {inertia:.3g} would do"
        )


def substep_of(period: float) -> float:
    """Return the substeps, s, into which the library divides a period."""
    return period / math.ceil(period / SUBSTEP - 1e-6)


def write(
    gains: mc.Gains, period: float, motion: Motion | None = None, law: type[mc.Law] = VirtualModelAdmittance
) -> str:
    """Return the library's parameters as YAML.

    Arguments:
        gains: that `check` lets through at this period, s; of a law without moments as `interfaces.of_law` has it.
        motion: deadband and bounds that were walked; none where None.
        law: whose gains they are: no moment is written of one that has none.
    """
    motion = motion or Motion()
    tree: dict[str, Any] = {"period": period}
    for place, kind in enumerate(_KINDS[: INTERFACES[law].axes // 3]):
        own = {n: float(v[3 * place]) for n, v in zip(("mass", "damping", "stiffness"), six(gains), strict=True)}
        bounds = {n: float(getattr(motion, n)[place]) for n in ("deadband", "max_offset", "max_velocity")}
        tree[kind] = own | bounds
    interface = comment(law, "The virtual mass moves along what it is given: give it")
    header = _HEADER.format(period=period, interface=interface)
    return ros2_control.commented(header, {"admittance_control": tree}, flow=False)


def read(text: str) -> tuple[mc.Gains, float, Motion]:
    """Return gains, period and motion in a file that `write` made with forces and moments."""
    tree = yaml.safe_load(text)["admittance_control"]
    force, moment = (tree[kind] for kind in _KINDS)
    gains = mc.Gains(*(np.repeat([force[n], moment[n]], 3) for n in ("mass", "damping", "stiffness")))
    bounds = {n: (force[n], moment[n]) for n in ("deadband", "max_offset", "max_velocity")}
    return gains, tree["period"], Motion(semi_implicit=True, **bounds)
