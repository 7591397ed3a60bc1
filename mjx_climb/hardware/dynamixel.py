"""The position loop of Dynamixel X servos: its registers, and the gains in SI units that they stand for.

With an error e in counts of the encoder the loop's output is `P/128 e + I/65536 sum(e) + D/16 (change of e)`, in units
of which 885 are the whole supply voltage; the constants include the sampling time (ROBOTIS e-manual, X series, protocol
2: Position PID Gain 80, 82, 84, Goal PWM 100). Under the whole voltage a motor at rest gives its stall torque.
"""

import math
from typing import NamedTuple

P_UNIT, I_UNIT, D_UNIT = 128.0, 65536.0, 16.0  # what the registers are divided by
FULL_PWM = 885.0
COUNTS = 4096.0  # of a turn
RATE = 1000.0  # Hz, of the loop, where a scenario says none: assumed, the e-manual counts its Realtime Tick in ms
LARGEST = 16383  # that a register holds
_SHARE = COUNTS / (2 * math.pi) / FULL_PWM  # of the voltage for an error of one radian, at a gain of 1


class Registers(NamedTuple):
    """The registers of the position loop."""

    p: float
    i: float
    d: float


class LoopGains(NamedTuple):
    """The same in SI units."""

    kp: float  # N m/rad
    ki: float  # N m/(rad s)
    kd: float  # N m s/rad


def gains_of(registers: Registers, stall_torque: float, rate: float | None = None) -> LoopGains:
    """Return the gains for which registers stand, with the stall torque in N m at the voltage that the gains are for.

    The loop runs at `rate` Hz, at 1 kHz where None is given.
    """
    torque, often = stall_torque * _SHARE, RATE if rate is None else rate
    return LoopGains(
        kp=registers.p / P_UNIT * torque,
        ki=registers.i / I_UNIT * torque * often,
        kd=registers.d / D_UNIT * torque / often,
    )


def registers_of(gains: LoopGains, stall_torque: float, rate: float | None = None) -> Registers:
    """Return the registers that stand for gains, the inverse of `gains_of`: real numbers, and as large as it takes."""
    torque, often = stall_torque * _SHARE, RATE if rate is None else rate
    return Registers(
        p=gains.kp / torque * P_UNIT, i=gains.ki / (torque * often) * I_UNIT, d=gains.kd / torque * often * D_UNIT
    )
