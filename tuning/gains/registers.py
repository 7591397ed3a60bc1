"""Gains of the joint loop as the registers of the robot's Dynamixel servos."""

import mjx_climb as mc
from mjx_climb.hardware import dynamixel
from mjx_climb.rollouts.resolve import AnyGains
from tuning.gains.gains_file import applied


def in_words(scenario: mc.Scenario, gains: AnyGains) -> str:
    """Return the registers that hold gains of the joint loop, the scenario's where there are none, and what they miss.

    Nothing where the scenario's servos are none whose loop gives a share of the voltage.
    """
    walked = applied(scenario, gains)
    servo, control = walked.hardware.servo, walked.control
    if servo.torque_limit is None or (servo.drive == "torque" and scenario.hardware.servo.registers is None):
        return ""
    wanted = dynamixel.LoopGains(control.kp, control.ki, control.kd)
    exact = dynamixel.registers_of(wanted, servo.torque_limit, servo.rate)
    held = dynamixel.Registers(*(min(round(value), dynamixel.LARGEST) for value in exact))
    text = f"registers of a Dynamixel X servo: Position P Gain {held.p}, I Gain {held.i}, D Gain {held.d}"
    found = dynamixel.gains_of(held, servo.torque_limit, servo.rate)
    pairs = zip(found._fields, found, wanted, strict=True)
    off = [f"{name} {own:.3g} in place of {value:.3g}" for name, own, value in pairs if abs(own - value) > 0.02 * value]
    return f"{text} ({', '.join(off)})" if off else text
