"""Our walks beside ClimbLab's: the same path and loads, and calmer forces (its damper and its anchors differ)."""

from pathlib import Path

import numpy as np
import pytest

WALKS = {  # recording: the case that it is of
    "climblab_1G_no_load": ("case_1_1", (("disturbance.cargo.mass", 0.0),)),
    "climblab_microgravity_impacts": ("case_2", ()),
}


@pytest.fixture(scope="module", params=WALKS)
def both(request, case, walk):
    """Our trajectory, ClimbLab's, and our rows of its instants."""
    name, changes = WALKS[request.param]
    with np.load(Path(__file__).parents[1] / "reference" / f"{request.param}.npz") as file:
        theirs = {key: value[:-1] for key, value in file.items() if value.shape}  # the last row is an artefact
    rows = np.round(theirs["time"] / 1e-3).astype(int) + 1  # labelled t, taken at t + 1 ms
    return walk(case(name, "pd", changes)), theirs, rows


def test_path(both):
    """Base and feet go the same way: within a millimetre of 100 in the mean square, two at most for the base."""
    ours, theirs, rows = both
    off = np.linalg.norm(ours.base_position[rows] - theirs["base_pos"], axis=-1)
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert off.max() < 2.5e-3
    feet = np.linalg.norm(ours.foot_position[rows] - theirs["foot_pos"], axis=-1)
    assert np.sqrt(np.mean(feet**2)) < 1e-3


def test_support_sequence(both):
    """Every gripper opens and shuts in the same steps."""
    ours, theirs, rows = both
    np.testing.assert_array_equal(ours.support[rows], theirs["support"])


def test_load_of_each_limb(both):
    """In the middle of each of the eight swings every limb carries the same mean load, to 2 % of the largest."""
    ours, theirs, rows = both
    for swing in range(8):
        middle = (theirs["time"] >= swing + 0.4) & (theirs["time"] < swing + 0.9)
        load = ours.foot_force[rows][middle].mean(0)
        expected = theirs["foot_force"][middle].mean(0)
        assert np.abs(load - expected)[:, 2].max() < 0.02 * np.linalg.norm(theirs["foot_force"], axis=-1).max(), swing


def test_forces_at_the_same_level_and_calmer(both):
    """The largest foot force peaks at ClimbLab's level or below it, and varies less."""
    ours, theirs, rows = both
    force, reference = (np.linalg.norm(f, axis=-1).max(1) for f in (ours.foot_force[rows], theirs["foot_force"]))
    assert 0.7 < force.max() / reference.max() <= 1.0
    assert 0.1 < np.abs(np.diff(force)).sum() / np.abs(np.diff(reference)).sum() < 1.0


def test_margins_at_the_same_level(both):
    """Medians over the whole walk agree: TSM to 3 %, GIA margin to 0.5 %."""
    ours, theirs, rows = both
    assert np.median(ours.tsm[rows]) == pytest.approx(np.median(theirs["tsm"]), rel=0.03)
    assert np.median(ours.gia_margin[rows]) == pytest.approx(np.median(theirs["gia_margin"]), rel=0.0045)
