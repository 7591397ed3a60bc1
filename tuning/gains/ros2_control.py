"""Gains for the `admittance_controller` of ros2_control: its parameters, and whether its integration is stable.

That controller integrates Eqs. 2 and 3 with explicit damping, one semi-implicit Euler step a period h
(ros2_controllers, admittance_rule_impl.hpp): `v += h (f - D v - K x) / M`, then `x += h v`, with
`D = damping_ratio 2 sqrt(M K)`; of axes that are not selected f is 0. Here they are integrated exactly and are stable
for any positive gains; there they are stable below a limit of h alone.
"""

import math
from typing import Any

import numpy as np
import yaml

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.files.dataset import SIX
from mjx_climb.scenario.messages import ConfigError
from tuning.gains.interfaces import INTERFACES, comment

MASS_BOUNDS = (1e-4, 1e6)  # of the controller, kg and kg m^2
MAX_STIFFNESS = 1e8  # N/m, N m/rad
MAX_RATE = 1_000_000  # Hz, beyond any robot
_ROOM = 1.05  # a suggestion lies so far inside the limit

_HEADER = """\
Parameters of the ros2_control admittance_controller, written by mjx-climb export.
The controller by itself is stable at update rates of {lowest} Hz and above; the largest discrete pole at {rate} Hz is
{pole:.6g}. How late and slow the robot around it may be is another question: mjx-climb evaluate --margins.
{interface}
joint_damping 0 leaves the law as it is; {filtered}. It reads its sensor by itself:
what a broadcaster's sensor_filter_chain makes of the wrench never comes here."""
_NO_MOMENTS = """
The law has no moments: selected_axes leaves the sensor's out. The values for rx, ry, rz repeat the translations'."""


def six(gains: mc.Gains) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inertia, damping and stiffness of one set of gains, each (6,)."""
    inertia, damping, stiffness = (np.broadcast_to(np.asarray(getattr(gains, n), float), 6) for n in mc.Gains.AXES)
    return inertia, damping, stiffness


def poles(gains: mc.Gains, rate: float) -> np.ndarray:
    """Return the two discrete poles of each axis, (6, 2) complex, at an update rate in Hz."""
    inertia, damping, stiffness = six(gains)
    h = 1 / rate
    d, k = h * damping / inertia, h * h * stiffness / inertia
    # z^2 - (2 - d - k) z + (1 - d) in s = 1 - z: s^2 - (d + k) s + k, whose small root loses no digits so
    root = np.sqrt(((d + k) ** 2 - 4 * k).astype(complex))
    large = (d + k + root) / 2
    return np.asarray(1 - np.stack([k / large, large], axis=-1))


def stable(gains: mc.Gains, rate: float) -> np.ndarray:
    """Return for each axis (6,) whether both poles lie inside the unit circle: `h^2 K / M + 2 h D / M < 4` (Jury)."""
    inertia, damping, stiffness = six(gains)
    return np.asarray((stiffness / rate + 2 * damping) / (rate * inertia) < 4)


def lowest_rate(gains: mc.Gains) -> np.ndarray:
    """Return for each axis (6,) the update rate in Hz above which it is stable."""
    inertia, damping, stiffness = six(gains)
    d, k = damping / inertia, stiffness / inertia
    return np.asarray((d + np.sqrt(d * d + 4 * k)) / 4)


def smallest_inertia(gains: mc.Gains, rate: float) -> np.ndarray:
    """Return for each axis (6,) the virtual inertia above which it is stable at a rate, damping and stiffness kept."""
    _, damping, stiffness = six(gains)
    return np.asarray((stiffness / rate + 2 * damping) / (4 * rate))


def check(gains: mc.Gains, rate: float, source: str) -> None:
    """Refuse gains that the controller cannot take or that grow in it.

    Raises:
        ConfigError: in one line, the axis, and the update rate or virtual inertia that would do.
    """
    inertia, _, stiffness = six(gains)

    def rounded_up(value: float) -> float:  # to two digits
        unit = 10.0 ** (math.floor(math.log10(value)) - 1)
        return float(f"{math.ceil(value / unit) * unit:.6g}")

    for name, values, (low, high) in (("inertia", inertia, MASS_BOUNDS), ("stiffness", stiffness, (0, MAX_STIFFNESS))):
        for axis, value in zip(SIX, values, strict=True):
            if not low <= value <= high:
                expected = f"{low:g} to {high:g}, which admittance_controller takes"
                raise ConfigError(source, name, expected, f"{value:g} ({axis})")
    holds, size = stable(gains, rate), np.abs(poles(gains, rate)).max(1)
    if holds.all():
        return
    cures = []
    if (faster := rounded_up(_ROOM * lowest_rate(gains).max())) <= MAX_RATE:
        cures.append(f"--update-rate {faster:.0f}")
    heavier = rounded_up(_ROOM * smallest_inertia(gains, rate)[~holds].max())
    if MASS_BOUNDS[0] <= heavier <= MASS_BOUNDS[1]:
        axes = f" ({', '.join(np.array(SIX)[~holds])})" if holds.any() else ""
        cures.append(f"a virtual inertia of {heavier:g}{axes}")
    cure = f"{' or '.join(cures)} would do" if cures else "no update rate or virtual inertia within bounds would do"
    worst = int(np.argmax(np.where(holds, 0, size)))
    got = f"a discrete pole of magnitude {size[worst]:.4g} ({SIX[worst]}): {cure}"
    raise ConfigError(source, "", f"gains that are stable in admittance_controller at {rate:g} Hz", got)


def write(
    gains: mc.Gains,
    rate: int,
    name: str = "admittance_controller",
    cutoff: float | None = None,
    registers: str = "",
    law: type[mc.Law] = VirtualModelAdmittance,
) -> str:
    """Return the parameter file of a controller called `name`.

    Arguments:
        gains: that `check` lets through at this update rate, Hz; without moments as `interfaces.of_law` has them.
        cutoff: of the first-order low pass on the forces with which the gains were walked, Hz; None: none.
        registers: of the servos that hold the gains of the joint loop, in words.
        law: whose gains they are; the axes that it has are selected.
    """
    axes = INTERFACES[law].axes
    inertia, damping, stiffness = six(gains)
    parameters = {
        "update_rate": rate,
        # the share of a new sample in a first-order low pass; 1 filters nothing
        "ft_sensor": {"filter_coefficient": 1.0 if cutoff is None else -math.expm1(-2 * math.pi * cutoff / rate)},
        "admittance": {
            "selected_axes": [True] * axes + [False] * (6 - axes),
            "mass": inertia.tolist(),
            "damping_ratio": (damping / (2 * np.sqrt(inertia * stiffness))).tolist(),
            "stiffness": stiffness.tolist(),
            "joint_damping": 0.0,
        },
    }
    lowest = math.ceil(lowest_rate(gains).max())
    filtered = "filter_coefficient 1 filters nothing" if cutoff is None else f"filter_coefficient: {cutoff:g} Hz"
    interface = comment(law, "It yields along the wrench that it is given: give it")
    interface += _NO_MOMENTS if axes < 6 else ""
    pole = np.abs(poles(gains, rate)).max()
    header = _HEADER.format(lowest=lowest, rate=rate, pole=pole, filtered=filtered, interface=interface)
    joint = {key: float(value) for key in ("kp", "kd", "ki") if (value := getattr(gains, key)) is not None}
    if joint:
        header += "\nThe joint loop is the hardware's: " + ", ".join(f"{key} {value:g}" for key, value in joint.items())
    header += f"\nIn {registers}" if registers else ""
    return commented(header, {name: {"ros__parameters": parameters}})


def commented(header: str, tree: dict[str, Any], flow: bool | None = None) -> str:
    """Return a tree as YAML below a comment; `flow` as PyYAML's `default_flow_style`."""
    lines = "".join(f"# {line}\n" for line in header.splitlines())
    return lines + yaml.safe_dump(tree, sort_keys=False, default_flow_style=flow)


def read(text: str) -> mc.Gains:
    """Return the gains in a parameter file of one controller, as the controller would take them."""
    (controller,) = yaml.safe_load(text).values()
    admittance = controller["ros__parameters"]["admittance"]
    mass, ratio, stiffness = (np.asarray(admittance[key]) for key in ("mass", "damping_ratio", "stiffness"))
    return mc.Gains(mass, ratio * 2 * np.sqrt(mass * stiffness), stiffness)
