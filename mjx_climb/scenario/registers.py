"""Registers of a servo's position loop, and the gains in SI units that they stand for.

One unit of a register stands for a share of the whole supply voltage, for an error of one radian and likewise for its
integral and the rate. Under the whole voltage a motor at rest gives its stall torque. How large the share is differs
from servo to servo, also where manuals give the same formula: it comes with each servo's file.
"""

from typing import NamedTuple

from pydantic import Field

from mjx_climb.scenario import values as v
from mjx_climb.scenario.values import setting


class RegisterScale(v.Section):
    """The value of one unit of each register of the servo's position loop: a share of the supply voltage."""

    p: v.Positive = Field(description="of Position P Gain, for an error of one rad, 1/rad")
    i: v.PositiveOrNull = setting(None, "of Position I Gain, for its integral, 1/(rad s); null: not known")
    d: v.PositiveOrNull = setting(None, "of Position D Gain, for the rate, s/rad; null: not known")
    largest: v.Register = setting(16383, "largest value that a register holds")


class Registers(NamedTuple):
    """The registers of the position loop; None where the scale of one is not known."""

    p: float
    i: float | None
    d: float | None


class LoopGains(NamedTuple):
    """The same in SI units."""

    kp: float  # N m/rad
    ki: float  # N m/(rad s)
    kd: float  # N m s/rad


def gains_of(registers: Registers, scale: RegisterScale, stall_torque: float) -> LoopGains:
    """Return the gains for which registers stand, with the stall torque in N m at the voltage that the gains are for.

    A register that is not known, or without a scale, counts as 0.
    """
    units = scale.p, scale.i, scale.d
    return LoopGains(
        *(stall_torque * (unit or 0.0) * (held or 0.0) for unit, held in zip(units, registers, strict=True))
    )


def registers_of(gains: LoopGains, scale: RegisterScale, stall_torque: float) -> Registers:
    """Return the registers that stand for gains, the inverse of `gains_of`: real numbers, and as large as it takes."""
    return Registers(
        p=gains.kp / (stall_torque * scale.p),
        i=None if scale.i is None else gains.ki / (stall_torque * scale.i),
        d=None if scale.d is None else gains.kd / (stall_torque * scale.d),
    )
