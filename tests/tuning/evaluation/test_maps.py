"""Maps of a sweep: the objective of its cells, the limit of stability, and the line that shows it."""

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb import plots
from tuning.evaluation import maps, stability_limit
from tuning.searches.sweep import sweep

STABLE, UNSTABLE = 5e3, 1.9e4  # N s/m, of the measured pose with M = 1 at 1 ms, as seen on walks


def made(radius):
    cells = np.arange(6.0).reshape(3, 2)
    data = {"objective": (("stiffness", "damping"), cells), "spectral_radius": (("stiffness", "damping"), radius)}
    data["feasible"] = (("stiffness", "damping"), cells > 1)
    return xr.Dataset(data, {"stiffness": [1e2, 1e3, 1e4], "damping": [1e0, 1e1]})


def test_best_cell_keeps_every_limit():
    cell = maps.best_cell(made(np.full((3, 2), 0.9)))
    assert (float(cell["stiffness"]), float(cell["damping"])) == (1e3, 1e0)
    nothing = made(np.full((3, 2), 0.9))
    assert maps.best_cell(nothing.assign(feasible=nothing["feasible"] & False)) is None


def test_a_map_shows_where_the_loop_turns_unstable():
    legends = {}
    for name, radius in (("some", [[1.1, 0.9], [0.9, 0.9], [np.inf, 0.9]]), ("none", np.full((3, 2), 0.9))):
        figure = plots.plot_map(made(np.asarray(radius)), "objective")
        legends[name] = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert legends == {"some": ["stability limit"], "none": []}


@pytest.mark.nightly
@pytest.mark.slow
def test_radius_tells_stable_gains_from_unstable_ones(case):
    """Of the linearised loop, against what walks with these gains do."""
    scenario = case("case_2", "measured_pose")
    ones = np.ones((2, 6))
    gains = mc.Gains(ones, np.array([[STABLE], [UNSTABLE]]) * ones, 2e4 * ones)
    radius = stability_limit.spectral_radius(scenario, gains)
    assert radius[0] < 1 + 1e-9 < radius[1]
    short = case("case_2", "measured_pose", {"duration": 1.5})
    calm, wild = mc.rollout_metrics(short, gains)["force_variation"]
    assert not wild < 10 * calm


@pytest.mark.slow
def test_a_sweep_gets_its_objective_and_radius(case):
    scenario = case("case_2", "virtual_model", {"duration": 0.2})
    swept = sweep(scenario, {"stiffness": [1e3, 1e6], "damping": [1e0, 1e2, 1e4]}).data
    judged = maps.with_stability(maps.with_objective(swept, scenario), scenario)
    assert judged["objective"].dims == judged["spectral_radius"].dims == ("stiffness", "damping")
    assert judged["objective"].sel(stiffness=1e6, damping=1e4) == pytest.approx(1.0, abs=0.01)  # as good as rigid
    unstable = judged["spectral_radius"] > 1
    assert unstable.sel(stiffness=1e6, damping=1e0) and not unstable.sel(damping=1e4).any()
