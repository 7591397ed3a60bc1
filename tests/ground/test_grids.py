"""Grids of heights, lattices and seams of a time: what a scan, a rule or a period says at its edges."""

import numpy as np
import pytest
from PIL import Image

import mjx_climb as mc
from mjx_climb.ground.from_scenario import holds_of
from mjx_climb.ground.height_map import grid_of, holdable
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.model import HoldMap
from mjx_climb.walk.structure import planning_steps

SLOPE = np.add.outer(0.2 * np.arange(4.0), 0.1 * np.arange(5.0))  # along y, along x


def map_of(tmp_path, heights, **more):
    np.save(tmp_path / "map.npy", heights)
    return HoldMap(file=str(tmp_path / "map.npy"), resolution=0.5, origin=(1.0, 2.0), **more)


def test_a_slope_has_its_normal_and_points_beside_a_gap_look_up(tmp_path):
    heights = SLOPE.copy()
    heights[1, 3] = np.nan
    position, normal = holdable(map_of(tmp_path, heights, scale=2.0))
    assert len(position) == 19
    np.testing.assert_allclose(position[0], [1.0, 2.0, 0.0])
    np.testing.assert_allclose(position[-1], [1.0 + 4 * 0.5, 2.0 + 3 * 0.5, 2.0 * SLOPE[3, 4]])
    beside = np.abs(position[:, :2] - [2.5, 2.5]).sum(1) < 0.6  # its four neighbours
    np.testing.assert_allclose(normal[beside], np.tile([0.0, 0.0, 1.0], (beside.sum(), 1)))
    np.testing.assert_allclose(normal[~beside], np.tile([-0.4, -0.8, 1.0], ((~beside).sum(), 1)))


@pytest.mark.parametrize(
    ("grid", "gaps", "said"),
    [
        (SLOPE[:1], True, "got shape (1, 5)"),
        (SLOPE[:, :1], True, "got shape (4, 1)"),
        (SLOPE[None], True, "got shape (1, 4, 5)"),
        (np.where(SLOPE > 0.5, np.inf, SLOPE), True, "got values that are not finite"),
        (np.where(SLOPE > 0.5, np.nan, SLOPE), False, "got values that are not finite"),
        (np.where(SLOPE > 0.5, np.nan, SLOPE), True, None),
        (SLOPE[:2, :2], False, None),
    ],
)
def test_a_grid_has_two_rows_and_columns_or_more_of_finite_numbers(grid, gaps, said, tmp_path):
    np.save(tmp_path / "grid.npy", grid)
    if said is None:
        np.testing.assert_array_equal(grid_of(str(tmp_path / "grid.npy"), gaps=gaps), grid)
    else:
        with pytest.raises(mc.ConfigError) as refused:
            grid_of(str(tmp_path / "grid.npy"), gaps=gaps)
        assert str(refused.value).endswith(said)


def test_a_picture_has_its_top_row_at_the_far_side_whether_it_is_grey_or_coloured(tmp_path):
    grey = np.array([[0, 51, 102], [153, 204, 255]], np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    colour = np.stack([grey, grey // 2, 0 * grey, 0 * grey + 255], -1).astype(np.uint8)
    Image.fromarray(colour).save(tmp_path / "colour.png")
    np.testing.assert_allclose(grid_of(str(tmp_path / "grey.png")), grey[::-1] / 255, atol=1e-6)
    mean = (grey / 255.0 + (grey // 2) / 255.0) / 3
    np.testing.assert_allclose(grid_of(str(tmp_path / "colour.png")), mean[::-1], atol=1e-6)


def test_diagonals_of_a_truss_rise_and_fall_from_bay_to_bay():
    """Of two bays, each diagonal in three pieces."""
    truss = {"corner": [0, 0], "size": [2.0, 1.0], "bay": 1.0, "depth": 1.0, "pitch": 0.48}
    found = holds_of(mc.Scenario().with_overrides({"ground.holds.truss": truss}).ground)
    position, normal = np.asarray(found.position), np.asarray(found.normal)
    top = position[(normal == [0, 0, 1]).all(1)][:, :2]
    inner = top[((top * 3) % 3 > 0.1).all(1) & (np.abs((top * 3) % 3 - 3) > 0.1).all(1)]
    expected = np.array([[1, 1], [2, 2], [4, 2], [5, 1]]) / 3
    np.testing.assert_allclose(sorted(inner.tolist()), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("period", "steps"), [(0.02, 20), (0.019, 20), (0.0224, 20), (0.0226, 25), (0.0225, 20), (1e-5, 1), (9.0, 300)]
)
def test_a_planning_period_is_the_nearest_number_of_steps_that_divides_the_walk(period, steps):
    case = mc.load_scenario("case_1_2").with_overrides({"duration": 0.3, "gait.planning_period": period})
    assert case.planning_steps == steps


@pytest.mark.parametrize(("key", "value"), [("gait.waiting.waits", True), ("control.recovery.shift", 0.01)])
def test_a_gait_that_waits_or_recovers_decides_once_a_planning_period(key, value):
    plain, case = (mc.load_scenario("case_1_2", each) for each in ({}, {key: value}))
    assert planning_steps(plain, own_parameters(plain)) == 0
    assert planning_steps(case, own_parameters(case)) == case.planning_steps > 1
