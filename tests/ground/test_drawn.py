"""Points that can be held are on plots, films and recordings, where they are, by how much they bear."""

import numpy as np
import pytest
from matplotlib import colormaps

import mjx_climb as mc
from mjx_climb.ground import holds_of, of
from mjx_climb.mujoco_import import mujoco
from mjx_climb.viz import plots
from mjx_climb.viz.plots.holds import SCALE
from mjx_climb.viz.recording import save_mcap
from mjx_climb.viz.rendering import marks, surroundings
from tests.trajectories import still

POINTS = [
    {"at": [0.1, 0.2, 0.0], "limit": 5.0},
    {"at": [0.3, -0.2, 0.05], "normal": [0.6, 0.0, 0.8], "limit": 20.0},
    {"at": [-0.1, 0.0, 0.02]},
]


@pytest.fixture(scope="module")
def walk():
    changes = {"duration": 0.4, "time_step": 0.01, "gait.cycle": 0.4, "gait.heading": np.pi / 2}
    scenario = mc.Scenario.model_validate({"ground": {"holds": {"points": POINTS, "count": 5}}}).with_overrides(changes)
    feet = 0.14 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    return still(scenario, base_reference=[0.01, 0.02, 0.1], foot_position=feet, grip_point=feet)


def test_a_graspability_map_has_the_limits_as_colours():
    points, limits = np.array([[0, 0, 0], [1.0, 2, 3], [4, 4, 4]]), np.array([5.0, 20, np.inf])
    figure = plots.plot_holds(of(points, limit=limits, count=4))
    side, above, bar = figure.axes
    for panel, axes in ((side, [0, 2]), (above, [0, 1])):
        anyhow, limited = panel.collections
        np.testing.assert_allclose(limited.get_offsets(), np.array([[0, 0, 0], [1, 2, 3]])[:, axes])
        np.testing.assert_allclose(anyhow.get_offsets(), [[4, 4]])
        assert limited.get_array().tolist() == [5, 20] and limited.get_clim() == (0, 20)
    assert bar.get_ylabel() == "holding limit [N]"


@pytest.mark.parametrize(("sides", "inches"), [
    ((2.0, 1.0, 0.5), (2.2 * 1.1 / 2.1, 2.2 * 0.6 / 2.1)), ((1.0, 9.0, 0.0), (7.0, 0.3)),
])  # fmt: skip
def test_a_graspability_map_is_to_scale(sides, inches):
    """With 0.1 m more, from above and from the side, no flatter than 0.3 inch and no higher than two columns."""
    figure = plots.plot_holds(of(np.array([[0.0, 0, 0], sides]), limit=np.array([1.0, 2.0]), count=3))
    assert figure.get_size_inches() == pytest.approx((3.5, 0.9 + sum(inches)))
    side, above, _ = figure.axes
    assert side.get_gridspec().get_height_ratios() == pytest.approx([*inches[::-1]])
    assert (side.get_ylabel(), above.get_ylabel(), above.get_xlabel()) == ("z [m]", "y [m]", "x [m]")
    assert side.get_aspect() == above.get_aspect() == 1


def test_the_feet_are_drawn_over_what_can_be_held(walk):
    """Walking along y, ahead is y and to the left is -x, in mm from where the base starts."""
    side, above, bar = plots.plot_feet(walk).axes
    limited = above.collections[1]
    np.testing.assert_allclose(limited.get_offsets(), [[180, -90], [-220, -290]], atol=1e-9)
    np.testing.assert_allclose(side.collections[1].get_offsets(), [[180, 0], [-220, 50]], atol=1e-9)
    assert len(above.collections[0].get_offsets()) == 1 and bar.get_ylabel() == "holding limit [N]"


def test_a_film_has_a_disc_for_each_point(walk):
    """Its axis is the normal, its colour that of the limit; of padding there is none."""
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), maxgeom=50)
    marks.holds(scene, walk, 0)
    assert scene.ngeom == 3
    found = {tuple(geom.pos.astype(float).round(6).tolist()): geom for geom in scene.geoms[:3]}
    for point, share in zip(POINTS, (0.25, 1.0, None), strict=True):
        geom = found[tuple(point["at"])]
        np.testing.assert_allclose(geom.mat[:, 2], point.get("normal", [0, 0, 1]), atol=1e-6)
        rgb = colormaps[SCALE](share)[:3] if share is not None else marks.ANY_HOLD
        np.testing.assert_allclose(geom.rgba[:3], rgb, atol=1e-6)


def test_the_ground_of_a_film_lies_below_what_can_be_held():
    level = np.column_stack([np.arange(1000.0), np.zeros(1000), np.linspace(0, 0.1, 1000)])
    kept = surroundings.below(of(level).shown())
    assert 400 <= len(kept) <= 500 and kept[:, 2].max() > 0.09
    pipe = holds_of(mc.Scenario.model_validate({"ground": {"holds": {"pipe": {"radius": 0.3}}}}).ground)
    np.testing.assert_allclose(surroundings.below(pipe.shown())[:, 2], -0.6)


def test_the_points_of_a_recording_are_read_as_a_ground(walk, tmp_path):
    file = save_mcap(walk, tmp_path / "walk.mcap")
    again = holds_of(mc.Scenario.model_validate({"ground": {"holds": {"cloud": {"file": str(file)}}}}).ground)
    made = holds_of(walk.scenario.ground)
    for name in ("position", "normal", "limit_bound"):
        np.testing.assert_allclose(getattr(again, name), getattr(made, name)[:3], rtol=1e-6, atol=1e-7)
