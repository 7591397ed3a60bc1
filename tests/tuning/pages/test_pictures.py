"""Pictures of searches: nothing is cut off, nothing hides another, nothing is empty."""

import itertools

import numpy as np
import pytest
import xarray as xr

from tuning.pages.laws import plot_laws
from tuning.pages.pareto import plot_front
from tuning.pages.schedule import plot_schedule

AXES = ("gravity", "cargo")


def schedule_over(gravity, spread=1.0):
    """Gains over gravities and three cargoes, rotations apart from translations."""
    cargo = np.array([0.0, 0.5, 1.0])
    rise = np.linspace(0, 1, len(gravity))[:, None] + np.array([0.0, 0.3, 0.5])
    kinds = {"stiffness": (1200 * spread**rise * 2**rise, "N/m"), "damping": (40 * 3**rise, "N s/m")}
    six = np.repeat([1.0, 0.5], 3)
    data = {name: ((*AXES, "six"), values[..., None] * six, {"units": unit}) for name, (values, unit) in kinds.items()}
    data["feasible"] = AXES, rise < 1.4
    shares = 100 * np.stack([0.5 + 0.1 * rise, 0.9 + 0 * rise, 0.4 + 0.1 * rise, 1 + 0 * rise], -1)
    data["force_variation"] = (*AXES, "walk"), shares
    data |= {
        name: ((*AXES, "walk"), np.full(shares.shape, v)) for name, v in {"detached_limb": -1, "diverged": 0}.items()
    }
    walks = ["tuned", "config", "retuned_pd", "pd"]
    coordinates = {"gravity": gravity, "cargo": cargo, "walk": walks}
    return xr.Dataset(data, coordinates, {"searched": "stiffness damping"})


def overlapping(texts):
    """Return which of some words on a picture are drawn over one another."""
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text() and text.get_visible()]
    return [(a, b) for (a, box), (b, other) in itertools.combinations(boxes, 2) if box.overlaps(other)]


def numbers_of(axis):
    """Return the numbers that an axis shows."""
    low, high = sorted(axis.get_view_interval())
    labels = [
        label
        for minor in (False, True)
        for label, at in zip(axis.get_ticklabels(minor=minor), axis.get_ticklocs(minor=minor), strict=True)
        if low <= at <= high
    ]
    return [label for label in labels if label.get_text()]


@pytest.mark.parametrize(
    ("gravity", "spread"), [([1e-6, 1e-2, 1 / 6, 0.38, 1.0], 1.0), ([1 / 6, 1.0], 2e4), ([1 / 6], 1.0)], ids=str
)
def test_words_and_numbers_of_a_schedule_do_not_collide(gravity, spread):
    figure = plot_schedule(schedule_over(gravity, spread))
    figure.draw_without_rendering()
    below = figure.axes[-1]
    for axis in (below.xaxis, *(panel.yaxis for panel in figure.axes)):
        numbers = numbers_of(axis)
        assert len(numbers) >= 2 and not overlapping(numbers)
    labels = [panel.yaxis.label for panel in figure.axes]
    assert not overlapping(labels)
    assert all(label.get_window_extent().y0 >= 0 for label in labels)


@pytest.mark.parametrize("gain", [40.0, 1e4])
def test_gains_that_are_equal_but_for_rounding_have_a_decade(gain):
    table = schedule_over([1 / 6, 1.0])
    table["damping"] = xr.full_like(table["damping"], gain)
    table["damping"][0] = np.nextafter(gain, 2 * gain)
    _, damping, _ = plot_schedule(table).axes
    np.testing.assert_allclose(damping.get_ylim(), gain * np.sqrt([0.1, 10]))


def test_the_whole_front_of_pd_is_on_the_picture_of_a_front():
    against, better = np.array([1e-3, 2e-3, 4e-3]), np.array([90.0, 60.0, 50.0])
    data = {
        "base_deviation": ("front", against, {"units": "m", "long_name": "base deviation"}),
        "force_variation": ("front", better, {"units": "N", "long_name": "force variation"}),
        "walked_base_deviation": ("walked", np.append(against, 0.5)),
        "walked_force_variation": ("walked", np.append(better, 900.0)),
        "held": ("walked", [True] * 4),
        "without_base_deviation": ("without", [2e-3, 1.2e-2]),
        "without_force_variation": ("without", [45.0, 38.0]),
        "reference_base_deviation": ("reference", [1.1e-3, 1.0e-3]),
        "reference_force_variation": ("reference", [93.0, 100.0]),
    }
    attributes = {"against": "base_deviation", "better": "force_variation"}
    front = xr.Dataset(data, {"reference": ["config", "pd"]}, attributes)
    (panel,) = plot_front(front).axes
    (left, right), (bottom, top) = panel.get_xlim(), panel.get_ylim()
    for line in panel.lines:
        if line.get_label() != "walked":
            x, y = line.get_data()
            assert (left < np.min(x)) and (np.max(x) < right), line.get_label()
            assert (bottom < np.min(y)) and (np.max(y) < top), line.get_label()


@pytest.mark.parametrize("few", [False, True])
def test_no_panel_of_a_comparison_of_laws_is_empty(few):
    """Without weight no walk has a cost of transport, and no walk may be lost; few seeds give no intervals."""
    metrics, names = ["objective", "force_variation", "cost_of_transport", "failed"], ["soft", "retuned_pd"]
    value = np.tile([[[1.0]], [[50.0]], [[np.nan]], [[0.0]]], (1, 2, 2))
    change = np.zeros_like(value)
    change[:2, :, 0] = -0.1
    change[2] = change[3, 1] = value[3, 1] = np.nan
    dims = ("metric", "statistic", "gains")
    data = {name: (dims, shift + change) for name, shift in {"difference": 0.0, "low": -0.02, "high": 0.02}.items()}
    data |= {"value": (dims, value), "real": (dims, change < 0), "larger_is_better": ("metric", [False] * 4)}
    coordinates = {"metric": metrics, "statistic": ["mean", "worst"], "gains": names}
    table = xr.Dataset(data, coordinates, {"baseline": "retuned_pd"})
    if few:
        table["low"], table["high"], table["real"] = (
            table["low"] * np.nan,
            table["high"] * np.nan,
            table["real"] & False,
        )
    shown = [panel.get_title(loc="left") for panel in plot_laws(table).axes if panel.get_visible()]
    assert shown == ["objective", "force variation"]


def test_a_comparison_of_laws_that_all_diverge_has_a_picture():
    dims = ("metric", "statistic", "gains")
    data = {name: (dims, np.full((1, 2, 2), np.nan)) for name in ("value", "difference", "low", "high", "real")}
    coordinates = {"metric": ["objective"], "statistic": ["mean", "worst"], "gains": ["soft", "retuned_pd"]}
    figure = plot_laws(xr.Dataset(data, coordinates, {"baseline": "retuned_pd"}))
    assert not any(panel.get_visible() for panel in figure.axes)
