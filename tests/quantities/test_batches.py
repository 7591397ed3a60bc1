"""Batch axes: what varies from robot to robot, and what is the same for all."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.quantities.batches import flattened, own_axes


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_one_robot_has_the_axes_of_several(robots):
    """So that it walks by their program: gains with a batch axis keep it, and a number without stays without."""
    gains = mc.Gains(inertia=np.ones(6), damping=np.ones((robots, 6)), stiffness=np.ones((1, 6)), kp=np.float64(50.0))
    flat = flattened(gains, own_axes(gains), (robots,))
    shared = (6,) if robots > 1 else (1, 6)  # of several robots all have the same
    assert [np.shape(value) for value in (flat.inertia, flat.damping, flat.stiffness, flat.kp)] == [
        (6,), (robots, 6), shared, ()
    ]  # fmt: skip
