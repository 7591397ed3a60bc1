"""A walk that stands for want of a grip counts as lost, and missed grips are counted, wherever walks are counted."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.walk.metrics import GRIPS, failed
from tuning import numbers
from tuning.command_line.run import verdict
from tuning.comparisons import judge
from tuning.pages import runs
from tuning.problem.objectives import lost

# one walk holds, one loses a grip, one diverges, one stands
WALKS = {
    "detached_limb": np.array([-1, 2, -1, -1]), "diverged": np.array([False, False, True, False]),
    "stands_at": np.array([np.nan, np.nan, np.nan, 3.2]), "peak_utilization": np.array([0.2, 1.5, 0.4, 0.3]),
    "missed_grips": np.array([0, 0, 0, 6]),
}  # fmt: skip
HELD = {"detached_limb": None, "diverged": False, "stands_at": None, "missed_grips": 0, "force_variation": 20.0}


def fallen(*misses):
    """Return the first grips of two limbs: some steps miss, and the last are 0.7 m off as the robot falls."""
    missed = np.zeros((8, 2), bool)
    missed[list(misses), 0] = True
    gap = np.where(missed, 0.006, 0.001)
    gap[-2:] = 0.7
    support = ~missed
    support[-3:] = False
    return SimpleNamespace(missed=missed, grip_gap=gap, support=support, time=np.arange(8) / 10)


def test_a_fall_is_named_and_its_gap_is_no_cause():
    """The gap counts up to the first miss, in a walk and in a batch."""
    walk = fallen(2, 5, 6)
    assert mc.Trajectory.gap.fget(walk) == 0.006 and mc.Trajectory.falls_at.fget(walk) == 0.5
    metric = GRIPS["grip_gap"]
    running = metric.init(jnp.zeros(()))
    for gap, missed in zip(walk.grip_gap, walk.missed, strict=True):
        running = metric.update(running, SimpleNamespace(grip_gap=jnp.asarray(gap), missed=jnp.asarray(missed)), None)
    assert float(metric.finish(running, None)) == pytest.approx(0.006)
    walk.support[-1] = True
    assert mc.Trajectory.falls_at.fget(walk) is None
    own = SimpleNamespace(standing={}, gap=0.006, falls_at=0.5, scenario=mc.load_scenario("case_1_2"))
    assert verdict(own, HELD).startswith("falls off: no grip holds from 0.500 s on")


def test_standing_walks_are_lost():
    for walks in (WALKS, xr.Dataset({name: ("member", values) for name, values in WALKS.items()})):
        np.testing.assert_array_equal(failed(walks), [False, True, True, True])
        np.testing.assert_array_equal(lost(walks), [0, 1, 1, 1])
    # a table of one's own may have no such metric
    np.testing.assert_array_equal(failed({n: v for n, v in WALKS.items() if n != "stands_at"})[[0, 3]], [False, False])


def test_missed_grips_stand_beside_the_share_of_lost_walks():
    rows = {name: (("gains", "member"), np.stack([values, 0 * values])) for name, values in WALKS.items()}
    data = xr.Dataset(rows, {"gains": ["mine", "pd"]})
    data["detached_limb"][1], data["stands_at"][1] = -1, np.nan
    for name in ("missed_grips", "peak_utilization"):
        data[name].attrs["larger_is_better"] = 0
    text = judge.failed_in_words(judge.summary(data))
    assert text == "would lose a gripper, or diverge: mine 75%, pd 0%; missed grips of a walk: mine 1.5, pd 0"
    data["missed_grips"][:] = 0
    assert "missed" not in judge.failed_in_words(judge.summary(data))


@pytest.mark.parametrize(
    ("changes", "standing", "said"),
    [
        ({}, {}, "held all the way"),
        (
            {"missed_grips": 2},
            {},
            "every grip held, but 2 missed the ground; a foot is 21 mm off the ground",
        ),
        (
            {"stands_at": 3.2, "missed_grips": 6},
            {"LH": 3.2},
            "stands from 3.200 s, as LH found no grip; 6 grips",
        ),
    ],
)
def test_the_verdict_of_a_walk_says_that_it_stands(changes, standing, said, tmp_path):
    scenario = mc.load_scenario("case_1_2", {"contact.capture_distance": 0.005})
    walk = SimpleNamespace(standing=standing, gap=0.021, falls_at=None, scenario=scenario)
    assert verdict(walk, HELD | changes).startswith(said)
    (tmp_path / "metrics.json").write_text(json.dumps(HELD | changes))
    stands = "stands_at" in changes
    assert runs.verdict(tmp_path).startswith("stands from 3.2 s for want of a grip" if stands else "held all the way")
    assert numbers.failed(HELD | changes) == ("stands from 3.20 s" if stands else "")
