"""The settings of an excitation: the keys that a log is to tell, and the limits of the motion.

Nothing heavy is imported here, so that the command line starts at once.
"""

import math
from collections.abc import Iterator
from typing import Literal

from mjx_climb.scenario.messages import ConfigError
from tuning.problem.settings import NonNegative, Positive, Settings, setting

FIT = ("hardware.servo.armature", "hardware.servo.coulomb_friction", "hardware.servo.viscous_friction",
       "hardware.command_delay")  # fmt: skip
ENCODER = 2 * math.pi / 4096 / math.sqrt(12)  # rad, rounding of an encoder of 4096 counts
Family = Literal["chirp", "multisine", "steps", "reversals"]


class Excitation(Settings):
    """Keys that a log is to tell, and the limits of its motion."""

    fit: tuple[str, ...] = setting(
        FIT,
        "key of a parameter that the log is to tell",
        metavar="KEY",
        default_in_words="armature, frictions and command delay",
    )
    family: tuple[Family, ...] = setting(
        (), "motion: chirp, multisine, steps, reversals, in turn; null: the best of several mixes", metavar="NAME"
    )
    base: Literal["held", "free"] = setting("held", "base held, on a stand or hung up, or free on all shut grippers")
    duration: float = setting(20.0, "length of the log, without the drop, s", ge=2, le=600)
    low: Positive = setting(0.1, "lowest frequency, Hz")
    high: Positive = setting(10.0, "highest frequency, Hz")
    kp: tuple[Positive, ...] = setting((), "P gain over equal times, N m/rad; null: the config's", metavar="N")
    mass: NonNegative = setting(0.0, "known mass hung on each foot, kg")
    drop: bool = setting(False, "end with a drop: torque off, the limbs fall")
    limb_by_limb: bool = setting(False, "move one limb after the other")
    rate: Positive | None = setting(None, "rate of the log, Hz; null: that of the commands")
    noise: Positive = setting(
        ENCODER, "standard deviation of a joint angle, rad", default_in_words="an encoder of 4096 counts"
    )
    margin: float = setting(0.7, "share of each limit that may be used", gt=0, le=1)
    candidates: int = setting(8, "motions of which one is taken", ge=1, le=256)
    seed: int = setting(0, "of the candidates", ge=0, le=2**31 - 1)

    def faults(self) -> Iterator[ValueError]:
        if not self.low < self.high:
            yield ConfigError("", "high", f"a frequency above low = {self.low:g} Hz", f"{self.high:g}")
        if not self.fit:
            yield ConfigError("", "fit", "a key or more", "none")
        for name in ("kp", "mass", "drop", "limb_by_limb"):
            if self.base == "free" and getattr(self, name):
                yield ConfigError("", name, "none with base free", getattr(self, name))
