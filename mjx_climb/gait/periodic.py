"""The values of the periodic gait."""

import math

import numpy as np
from jax import Array

from mjx_climb.component import BELOW_ONE, FINITE, NONNEGATIVE, POSITIVE, SHARE, Component, parameter

_MOST = 100.0  # m, of a stride or a step


class PeriodicGait(Component):
    """How far, how high and when the limbs swing."""

    stride: Array = parameter("m", bounds=(0.0, _MOST), default=0.05, long_name="stride")
    step_height: Array = parameter("m", bounds=(POSITIVE[0], _MOST), default=0.03, long_name="step height")
    cycle: Array = parameter("s", bounds=POSITIVE, default=4.0, long_name="gait cycle", in_steps=True)
    duty: Array = parameter("1", bounds=(POSITIVE[0], BELOW_ONE), default=0.75, long_name="duty")
    settling: Array = parameter("1", bounds=SHARE, default=0.0, long_name="share of a swing in which the foot waits")
    height: Array = parameter(
        "1", bounds=(POSITIVE[0], _MOST), default=1.0,
        long_name="height of the base as a share of the rest stance's",
    )  # fmt: skip
    sway: Array = parameter("1", bounds=SHARE, default=0.0, long_name="sway of the base")
    landing_speed: Array = parameter("m/s", bounds=NONNEGATIVE, default=0.0, long_name="landing speed")
    heading: Array = parameter("rad", bounds=(-2 * math.pi, 2 * math.pi), default=0.0, long_name="heading")
    # (limb, 3, K) step heights, added to each swing; K = 0: nothing
    swing_path: Array = parameter("1", shape=(None, 3, None), bounds=FINITE, default=np.zeros((4, 3, 0)))
