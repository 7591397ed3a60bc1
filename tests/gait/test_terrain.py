"""Uneven ground: where the feet grip, what the maps say, and flat ground as it was."""

import io
import json

import matplotlib.image
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb import terrain
from mjx_climb.robot_import.load import load_robot
from mjx_climb.terrain import check_reach
from tests.robot import climbers
from tuning.proposal.propose import propose

STEPS = {"LF": [0.0, 0.02], "LH": [0.01, -0.01], "RH": [0.0, 0.015, 0.03], "RF": [-0.01]}
CALM = {"duration": 3.2, "gait.cycle": 1.6, "gait.stride": 0.02, "time_step": 0.001}


def foothold_heights(scenario):
    return terrain.foothold_heights(scenario, load_robot(scenario.robot))


def footholds(scenario):
    return terrain.footholds(scenario, load_robot(scenario.robot))


@pytest.fixture(scope="module")
def scenario():
    return mc.Scenario().with_overrides({**CALM, "gravity": [0.0, 0.0, -1.6], "ground.footholds": STEPS})


@pytest.fixture(scope="module")
def walked(scenario):
    return mc.rollout(scenario)


@pytest.mark.slow
def test_grippers_close_at_the_heights_of_their_footholds(scenario, walked):
    """Each limb grips where the list says, first foothold to last, and no gripper lets go.

    `tests/walk/test_oracle.py` has the paths of feet and base in between, and the start.
    """
    heights = [[0, 0.02, 0.02], [0.01, -0.01, -0.01], [0, 0.015, 0.03], [-0.01] * 3]
    np.testing.assert_array_equal(foothold_heights(scenario), heights)
    assert not walked.detached.any() and walked.reachable.all()
    for limb, levels in enumerate([[0, 0.02], [-0.01], [0, 0.015, 0.03], [-0.01]]):  # LH lifts off at once
        gripped = walked.grip_point[walked.support[:, limb], limb, 2]
        _, first = np.unique(gripped.round(9), return_index=True)
        np.testing.assert_allclose(gripped[np.sort(first)], levels, atol=1e-12)


@pytest.mark.nightly
def test_engines_agree_on_uneven_ground(scenario, walked):
    other = mc.rollout(scenario, engine="mjx")
    for name in ("base_position", "foot_force", "tsm", "gia_margin"):
        np.testing.assert_allclose(getattr(other, name), getattr(walked, name), rtol=1e-8, atol=1e-8)


def test_the_last_height_of_a_list_goes_on_and_limbs_that_are_not_named_stand_at_zero(scenario):
    heights = [[0, 0.02, 0.02], [0.01, -0.01, -0.01], [0, 0.015, 0.03], [-0.01] * 3]
    np.testing.assert_array_equal(foothold_heights(scenario), heights)
    some = mc.Scenario().with_overrides({"ground.footholds": {"RF": [0.01, 0.02]}})
    np.testing.assert_array_equal(foothold_heights(some), [[0, 0]] * 3 + [[0.01, 0.02]])
    assert foothold_heights(mc.Scenario()).shape == (4, 0)


# --- maps


def slope(x, y):
    return 0.05 * x - 0.03 * y


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """The same plane as CSV, npy and PNG, 5 mm pitch from (-0.4, -0.3) m; PNG in grey levels of 16 bits."""
    folder = tmp_path_factory.mktemp("maps")
    x, y = np.meshgrid(-0.4 + 0.005 * np.arange(181), -0.3 + 0.005 * np.arange(121))
    grid = slope(x, y)
    np.save(folder / "plane.npy", grid)
    np.savetxt(folder / "plane.csv", grid, delimiter=",")
    grey = (grid[::-1] - grid.min()) / np.ptp(grid)
    matplotlib.image.imsave(folder / "plane.png", np.repeat(grey[..., None], 3, axis=-1))
    return folder, float(np.ptp(grid)), float(grid.min())


def on(file, **more):
    ground = {"file": str(file), "resolution": 0.005, "origin": [-0.4, -0.3], **more}
    return mc.Scenario().with_overrides({"ground.map": ground, "gait.heading": 0.3})


def test_maps_give_the_heights_below_the_planned_footholds(maps):
    folder, span, low = maps
    expected = slope(*np.moveaxis(footholds(on(folder / "plane.npy")), -1, 0))
    assert expected.shape == (4, 3)
    for suffix in ("npy", "csv"):
        np.testing.assert_allclose(foothold_heights(on(folder / f"plane.{suffix}")), expected, atol=1e-12)
    grey = foothold_heights(on(folder / "plane.png", scale=span))
    np.testing.assert_allclose(grey + low, expected, atol=span / 255)


def test_footholds_are_planned_along_the_heading():
    """Those of a walk along x, turned about z with the walk: a stride ahead for each cycle."""
    turned, ahead = (footholds(mc.Scenario().with_overrides({"gait.heading": angle})) for angle in (0.3, 0.0))
    forward, left = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    np.testing.assert_allclose(turned, ahead[..., :1] * forward + ahead[..., 1:] * left, atol=1e-12)
    np.testing.assert_allclose(
        np.diff(turned, axis=1), mc.Scenario().gait.stride * np.ones((4, 2, 1)) * forward, atol=1e-12
    )


def npy(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def png(array):
    content = io.BytesIO()
    matplotlib.image.imsave(content, array, format="png")
    return content.getvalue()


BAD = {  # content of the file, what is said
    "text.csv": (b"1,2\nthree,4\n", "ground.map.file: expected a grid of numbers"),
    "ragged.csv": (b"1,2\n3\n", "ground.map.file: expected a grid of numbers"),
    "nan.csv": (b"1,2\nnan,4\n", "not finite"),
    "line.csv": (b"1,2\n", "expected two rows and columns or more"),
    "empty.npy": (b"", "ground.map.file: expected a grid of numbers"),
    "noise.png": (b"noise", "ground.map.file: expected a grid of numbers"),
    "cut.npy": (npy(np.ones((30, 30)))[:-100], "ground.map.file: expected a grid of numbers"),
    "head.npy": (npy(np.ones((30, 30)))[:40], "ground.map.file: expected a grid of numbers"),
    "large.npy": (npy(np.ones((10, 30))).replace(b"(10, 30), ", b"(10**15,)"), "expected a grid of numbers"),
    "complex.npy": (npy(1j * np.ones((2, 2))), "ground.map.file: expected real numbers, got values of type complex128"),
    "words.npy": (npy(np.array([["1", "2"]] * 2)), "ground.map.file: expected real numbers, got values of type <U1"),
    "cut.png": (png(np.eye(200))[:-200], "ground.map.file: expected a grid of numbers"),
    "end.png": (png(np.eye(200))[:-12], "ground.map.file: expected a grid of numbers"),
    "empty.csv": (b"", "expected two rows and columns or more of finite numbers, got shape (0, 0)"),
    "map.tif": (b"", "expected a .csv, .npy or .png"),
    "small.csv": (b"0,0\n0,0\n", "expected a map that covers foothold 0 of LF"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_map_that_cannot_be_used_is_refused_in_one_line(name, tmp_path):
    content, expected = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(mc.ConfigError) as refused:
        foothold_heights(on(tmp_path / name))
    assert expected in str(refused.value) and name in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_what_a_limb_cannot_reach_is_refused_before_the_walk(scenario):
    check_reach(scenario)
    check_reach(mc.Scenario())
    with pytest.raises(mc.ConfigError, match=r"ground.footholds.RH.1: expected footholds within reach"):
        check_reach(scenario.with_overrides({"ground.footholds.RH": [0.0, 0.5]}))


@pytest.mark.parametrize(("limb", "heights", "number", "words"), [
    ("LF", [0.5], 0, "at 0.5 m, +0.375 m from the mean"), ("RH", [0.01, -4.0], 1, "at -4 m, -3 m from the mean"),
    ("RF", [0.0, 0.01, 4.0], 2, "at 4 m, +3 m from the mean"),
])  # fmt: skip
def test_the_foothold_farthest_from_the_mean_of_those_out_of_reach_is_named(limb, heights, number, words):
    """The base goes with the mean height of the feet: of one that is far off the others are, the other way."""
    case = mc.Scenario().with_overrides({"ground.footholds": {limb: heights}})
    with pytest.raises(mc.ConfigError) as refused:
        check_reach(case, "walk")
    said = (
        f"walk: ground.footholds.{limb}.{number}: expected footholds within reach and joint limits, got one of {limb} "
    )
    assert str(refused.value).startswith(said + words)
    level = {name: [0.5] for name in ("LF", "LH", "RH", "RF")}
    check_reach(mc.Scenario().with_overrides({"ground.footholds": level}))


def test_a_map_ends_with_its_last_row_and_column(tmp_path):
    np.save(tmp_path / "map.npy", np.zeros((2, 3)))
    whole = {"file": str(tmp_path / "map.npy"), "resolution": 1.0, "origin": [-0.5, -0.5]}
    assert not foothold_heights(mc.Scenario().with_overrides({"ground.map": whole})).any()
    for origin, limb, said in (([-0.5, -0.9], "LF", "got x -0.5 to 1.5, y -0.9 to 0.1 m"),
                               ([-0.5, 0.0], "RH", "got x -0.5 to 1.5, y 0 to 1 m"),
                               ([-1.9, -0.5], "LF", "got x -1.9 to 0.1, y -0.5 to 0.5 m"),
                               ([0.0, -0.5], "LH", "got x 0 to 2, y -0.5 to 0.5 m")):  # fmt: skip
        with pytest.raises(mc.ConfigError) as refused:
            foothold_heights(mc.Scenario().with_overrides({"ground.map": whole | {"origin": origin}}))
        assert f"expected a map that covers foothold 0 of {limb} at x " in str(refused.value)
        assert str(refused.value).endswith(said)


def test_a_map_beside_its_config(maps, tmp_path, monkeypatch):
    (tmp_path / "plane.npy").write_bytes((maps[0] / "plane.npy").read_bytes())
    text = {"ground": {"map": {"file": "plane.npy", "resolution": 0.005, "origin": [-0.4, -0.3]}}}
    (tmp_path / "walk.yaml").write_text(json.dumps(text))
    monkeypatch.chdir("/")
    assert foothold_heights(mc.load_scenario(tmp_path / "walk.yaml")).any()


def test_a_stride_out_of_reach_is_refused_with_the_longest_one():
    scenario = mc.load_scenario("case_1_2")
    for stride in (0.4, 100.0):
        with pytest.raises(mc.ConfigError, match=r"^walk: gait\.stride: expected at most 0\.13 m, .* got ") as error:
            check_reach(scenario.with_overrides({"gait.stride": stride}), "walk")
        assert "\n" not in str(error.value)
    check_reach(scenario.with_overrides({"gait.stride": 0.13}))
    with pytest.raises(mc.ConfigError, match=r"gait\.stride"):
        check_reach(scenario.with_overrides({"gait.stride": 0.14}))


def test_limbs_that_cannot_follow_a_base_are_not_asked_to(tmp_path):
    """Of two joints each: the base stays where it is, whatever the stride."""
    (tmp_path / "robot.xml").write_text(climbers.mjcf(4, 2))
    scenario = mc.Scenario.model_validate(propose(tmp_path / "robot.xml").sections)
    assert load_robot(scenario.robot).joints == 2 and scenario.gait.stride > 0
    check_reach(scenario)


def test_the_height_and_the_sway_of_the_base_count_for_how_far_a_stride_may_be():
    """Half the sway takes the base off a foot that lifts off or lands, here sideways, where it has more room ahead."""
    for changes, longest in (({"stride": 0.135}, "0.13"), ({"stride": 0.1, "height": 1.9}, "0.052")):
        with pytest.raises(mc.ConfigError, match=rf"^scenario: gait\.stride: expected at most {longest} m"):
            check_reach(mc.load_scenario("case_1_1", {"gait": changes}))
    check_reach(mc.load_scenario("case_1_1", {"gait": {"stride": 0.135, "sway": 0.6}}))
