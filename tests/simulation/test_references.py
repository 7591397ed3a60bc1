"""Whole walks beside an independent prototype's figures, ClimbLab's recordings, and themselves in single precision."""

from pathlib import Path

import jax
import numpy as np
import pytest

import mjx_climb as mc

TABLE = [  # case, law, peak foot force N, variation N, cost of transport, final x m; without detachment
    ("case_1_1", "pd", 22.87, 367, 0.90, 0.099),
    ("case_1_1", "virtual_model", 22.84, 361, 0.90, 0.099),
    ("case_1_1", "measured_pose", 21.49, 217, 1.31, 0.098),
    ("case_1_2", "pd", 4.10, 100, 0.662, 0.100),
    ("case_1_2", "virtual_model", 4.09, 94, 0.654, 0.100),
    ("case_1_2", "measured_pose", 3.04, 32, 1.16, 0.104),
    ("case_2", "pd", 6.96, 130, 1.44e5, 0.100),
    ("case_2", "virtual_model", 6.88, 123, 1.40e5, 0.100),
    ("case_2", "measured_pose", 5.67, 34, 6.5e5, 0.095),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "law", "peak", "variation", "cost", "final_x"), TABLE)
def test_figures_of_the_prototype(case, walk, name, law, peak, variation, cost, final_x):
    """Of each case and law; the prototype's variation and cost are given to two or three digits."""
    trajectory = walk(case(name, law, (("contact.holding_limit", None),)))
    ours = mc.metrics(trajectory)
    assert ours["peak_foot_force"] == pytest.approx(peak, rel=0.01)
    assert ours["force_variation"] == pytest.approx(variation, rel=0.022)
    assert ours["cost_of_transport"] == pytest.approx(cost, rel=0.03)
    assert trajectory.base_position[-1, 0] == pytest.approx(final_x, rel=0.01)


WALKS = {  # recording of ClimbLab, whose damper and anchors differ: the case that it is of
    "climblab_1G_no_load": ("case_1_1", (("disturbance.cargo.mass", 0.0),)),
    "climblab_microgravity_impacts": ("case_2", ()),
}


@pytest.mark.parametrize("recording", WALKS)
def test_a_walk_is_climblabs_and_calmer(case, walk, recording):
    name, changes = WALKS[recording]
    with np.load(Path(__file__).parents[1] / "reference" / f"{recording}.npz") as file:
        theirs = {key: value[:-1] for key, value in file.items() if value.shape}  # the last row is an artefact
    rows = np.round(theirs["time"] / 1e-3).astype(int) + 1  # labelled t, taken at t + 1 ms
    names = ("base_position", "foot_position", "foot_force", "support", "tsm", "gia_margin")
    ours = {history: getattr(walk(case(name, "pd", changes)), history)[rows] for history in names}
    # base and feet go the same way: within a millimetre of 100 in the mean square, two at most for the base
    off, feet = (np.linalg.norm(ours[f"{of}_position"] - theirs[f"{of}_pos"], axis=-1) for of in ("base", "foot"))
    assert np.sqrt(np.mean(off**2)) < 1e-3 and off.max() < 2.5e-3
    assert np.sqrt(np.mean(feet**2)) < 1e-3
    np.testing.assert_array_equal(ours["support"], theirs["support"])
    # in the middle of each of the eight swings every limb carries the same mean load, to 2 % of the largest
    size = np.linalg.norm(theirs["foot_force"], axis=-1)
    for swing in range(8):
        middle = (theirs["time"] >= swing + 0.4) & (theirs["time"] < swing + 0.9)
        load, expected = (forces["foot_force"][middle].mean(0) for forces in (ours, theirs))
        assert np.abs(load - expected)[:, 2].max() < 0.02 * size.max(), swing
    # the largest foot force peaks at ClimbLab's level or below it, and varies less
    force, reference = np.linalg.norm(ours["foot_force"], axis=-1).max(1), size.max(1)
    assert 0.7 < force.max() / reference.max() <= 1.0
    assert 0.1 < np.abs(np.diff(force)).sum() / np.abs(np.diff(reference)).sum() < 1.0
    assert np.median(ours["tsm"]) == pytest.approx(np.median(theirs["tsm"]), rel=0.03)
    assert np.median(ours["gia_margin"]) == pytest.approx(np.median(theirs["gia_margin"]), rel=0.0045)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("law", "within"),
    [
        ("virtual_model", 4e-4),
        pytest.param("measured_pose", 3e-3, marks=pytest.mark.nightly),
        pytest.param("pd", 4e-4, marks=pytest.mark.nightly),
        pytest.param("end_effector", 3e-3, marks=pytest.mark.nightly),
    ],
)
def test_single_precision_is_good_enough(case, gains, numbers, walk, law, within):
    """Over 8 s of each case, walked as one batch, metrics in float32, as in sweeps, are those in float64."""
    scenarios = [case(name, law) for name in ("case_1_1", "case_1_2", "case_2")]
    stacked = [jax.tree.map(lambda *values: np.stack(values), *map(each, scenarios)) for each in (gains, numbers)]
    single, double = mc.rollout_metrics(scenarios[0], *stacked), [mc.metrics(walk(scenario)) for scenario in scenarios]
    assert not single["diverged"].any()
    for name in ("peak_foot_force", "force_variation", "peak_joint_torque", "cost_of_transport", "travel"):
        np.testing.assert_allclose(single[name], [metrics[name] for metrics in double], rtol=within, err_msg=name)
