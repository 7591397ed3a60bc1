"""A metric and an objective of one's own, as the documentation shows them: searched, resumed, seen everywhere."""

import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
import tuning
from mjx_climb.viz.plots.maps import plot_map
from tuning.pages import comparison
from tuning.pages.explorer import explorer, grid_points
from tuning.problem.objectives import Limit, Objective, Term

PAGE = Path(__file__).parents[3] / "docs" / "guides" / "metric.md"
SHORT = {"duration": 0.3, "gait.cycle": 0.4, "disturbance.cargo.start": 0.05}


@pytest.fixture
def example(monkeypatch, tmp_path):
    """Return a function that runs the first block of the page, with a short walk and few rounds, in a folder."""
    block = re.search(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)[1]
    assert sum(bool(line.strip()) for line in block.splitlines()) <= 15
    load, tune = mc.load_scenario, tuning.tune
    monkeypatch.setattr(mc, "load_scenario", lambda name: load(name, SHORT))

    def run(folder, progress=None):
        (tmp_path / folder).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / folder)
        short = functools.partial(tune, iterations=2, space="isotropic", starts=3, progress=progress)
        monkeypatch.setattr(tuning, "tune", short)
        scope = {}
        exec(compile(block, PAGE.name, "exec"), scope)
        return scope

    return run


@pytest.mark.nightly
def test_the_example_is_resumed_bit_for_bit_and_seen_everywhere(example, stop):
    cut = example("one", stop(2))["found"]
    assert cut.interrupted
    scope = example("one")
    found, asked = scope["found"], {"metrics": scope["metrics"], "objective": scope["calm"]}
    undisturbed = tuning.tune(scope["scenario"], limits={"peak_base_speed": 0.5}, **asked)  # the same programs
    assert not found.interrupted and cut.data.sizes["point"] < found.data.sizes["point"]
    for name in ("theta", "value", "descent", "peak_base_speed"):
        np.testing.assert_array_equal(found.data[name], undisturbed.data[name])
    feasible = found.data.isel(point=found.data["feasible"].values)
    np.testing.assert_allclose(found.value, feasible["value"].values.astype(float).min())
    assert (feasible["peak_base_speed"] <= 0.5).all()

    metrics, scenario = scope["metrics"], scope["scenario"]
    table = comparison.table({"tuned": (None, scope["best"]), "pd": (None, scope["best"])}, "", metrics)
    rows = {row[0]: row for _, section in table.sections for row in section}
    assert rows["largest speed of the base"][1:3] == ["m/s", f"{scope['best']['peak_base_speed']:.4g}"]

    axes = {"stiffness": np.geomspace(1e3, 1e4, 2), "damping": np.geomspace(1e1, 1e2, 2)}
    walks = tuning.sweep(scenario, axes, metrics=metrics).data
    panel = plot_map(walks, "peak_base_speed").axes[1]
    assert panel.get_ylabel() == "largest speed of the base [m/s]"
    points = grid_points(walks, walks, scope["best"], {}, None)
    expected = {"label": "largest speed of the base", "unit": "m/s", "larger_is_better": False}
    assert points["texts"]["peak_base_speed"] == expected and "peak_base_speed" in points["scales"]
    shown = explorer({"pd": mc.rollout(scenario, found.gains)}, {"pd": scope["best"]}, about=metrics)
    assert shown["metrics"]["peak_base_speed"] == expected


@pytest.mark.slow
def test_a_walk_that_diverged_is_worth_nothing_and_has_no_gradient():
    """Its metrics are finite, those until it diverged."""
    terms = (Term("travel", 1.0, 0.1, 0.1, larger_is_better=True),)
    objective = Objective(terms, (Limit("travel", 0.01, 1.0, 0.02, "", larger_is_better=True),))
    diverged = jnp.array([False, True])

    def value(travel):
        return objective.score({"travel": travel, "diverged": diverged})

    score = value(jnp.full(2, 0.1))
    assert score.feasible.tolist() == [True, False]
    for part in score[:3]:
        assert np.isfinite(part).tolist() == [True, False]
    slope = jax.jvp(lambda travel: value(travel).descent, (jnp.full(2, 0.1),), (jnp.ones(2),))[1]
    assert np.isfinite(slope).tolist() == [True, False]
