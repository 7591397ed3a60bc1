"""The values of the ground: heights of the footholds, and the points that can be held."""

import dataclasses

import numpy as np
from jax import Array

from mjx_climb.component import Component, parameter
from mjx_climb.ground.holds import Holds
from mjx_climb.value_field import FINITE


class Ground(Component):
    """The ground under the feet."""

    # (limb, N) m, in order; N = 0: flat ground
    foothold_height: Array = parameter("m", shape=(None, None), bounds=FINITE, default=np.zeros((4, 0)))
    holds: Holds | None = dataclasses.field(default=None, metadata={"tree": True})  # None: all of it can be held
