"""Walks that are as short as one planning period of a gait that chooses footholds."""

from pathlib import Path

import numpy as np
import pytest

import mjx_climb as mc

ROCK = Path(__file__).parents[2] / "configs" / "climb_rock.yaml"


@pytest.mark.slow
def test_a_walk_of_one_planning_period_is_the_begin_of_a_longer_one():
    """XLA's compiler for CPUs ended the process here: the loop over periods had one round."""
    one, two = (mc.rollout(mc.load_scenario(ROCK, [f"duration={duration}"])) for duration in (0.1, 0.2))
    assert len(one.base_position) == 200
    np.testing.assert_allclose(one.base_position, two.base_position[:200], rtol=0, atol=1e-12)
