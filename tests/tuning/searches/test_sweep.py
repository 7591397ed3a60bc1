"""The grid search: its numbers, its choice, and what an interrupt leaves behind."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.files.dataset import OutputError
from mjx_climb.walks import LINES, stretches
from tuning.methods import parts
from tuning.problem.evaluation import Problem
from tuning.results.swept import best_cell
from tuning.searches import sweep as sweeps
from tuning.searches.shards import Rows
from tuning.searches.sweep import sweep

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "case_1_2.yaml"
AXES = {"stiffness": [1e3, 1e4, 1e5], "damping": [1e2, 1e3]}
SIZE = 4  # of a batch: two parts, the last one half full


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario(CONFIG, ["duration=0.3"])


@pytest.fixture(scope="module")
def whole(scenario):
    return sweep(scenario, AXES, batch_size=SIZE).data


def kept(scenario, out, axes=AXES, batch_size=SIZE, **walks):
    """Claim a folder for a sweep, and return how many of its walks are there."""
    grid = sweeps.grid_of(Problem(scenario, **walks), axes, batch_size=batch_size)
    return Rows(grid, out).there


def walks_of_gains(scenario, gains, parameters, **_):
    """Return metrics that tell stiffness, damping, and the grip's stiffness of each walk."""
    contact = np.broadcast_to(np.asarray(parameters.contact.stiffness, float), len(next(iter(gains.values()))))
    each = {name: np.asarray(gains[name], float)[:, 0] if name in gains else 0 * contact for name in AXES}
    found = dict.fromkeys(mc.METRICS.names, 0 * contact)
    return found | {"travel": each["stiffness"], "cost_of_transport": each["damping"], "min_tsm": contact}


@pytest.mark.parametrize(
    "axes", [AXES, dict(reversed(AXES.items())), {"damping": [1e2, 1e3], "contact.stiffness": [1e4, 2e4, 3e4]}]
)
def test_each_cell_has_the_walk_with_its_values(scenario, axes, monkeypatch):
    """Whatever stands first, in batches of which the last one is half full; rows are named by their values."""
    monkeypatch.setattr(mc, "rollout_histories", walks_of_gains)
    data, first, second = sweep(scenario, axes, batch_size=SIZE).data, *axes
    metric = {"stiffness": "travel", "damping": "cost_of_transport", "contact.stiffness": "min_tsm"}
    assert data["travel"].dims == (first, second)
    for name in axes:
        for value in axes[name]:
            assert (data[metric[name]].sel({name: value}) == value).all()
    grid = sweeps.grid_of(Problem(scenario), axes)
    assert grid.name(1) == f"{first} {axes[first][0]:.4g} {second} {axes[second][1]:.4g}"


def test_a_stretch_of_time_begins_where_the_one_before_ends():
    scenario, name = mc.load_scenario(CONFIG, ["duration=2"]), next(iter(LINES))
    count, steps = stretches(scenario.steps)
    assert steps > 1
    arrays = {metric: np.zeros(6) for metric in mc.METRICS.names} | {name: np.zeros((6, 2, count))}
    begins = sweeps.grid_of(Problem(scenario), AXES).result(arrays).data[name]["stretch"]
    np.testing.assert_allclose(begins, np.arange(count) * steps * scenario.time_step)


@pytest.mark.slow
def test_every_cell_is_the_walk_with_its_gains(scenario, whole):
    assert whole["peak_foot_force"].dims == ("stiffness", "damping")
    for k, d in ((1e3, 1e3), (1e5, 1e2), (1e5, 1e3)):
        alone = mc.metrics(mc.rollout(scenario, mc.Gains(1.0, d, k)))
        cell = whole.sel(stiffness=k, damping=d)
        for name in ("peak_foot_force", "force_variation", "base_deviation", "min_tsm"):
            assert cell[name].item() == pytest.approx(alone[name], rel=5e-3), name


@pytest.mark.slow
def test_a_small_grid_keeps_histories_with_the_peaks_of_its_walks(whole):
    for name, (*_, metric) in LINES.items():
        np.testing.assert_allclose(whole[name].sel(extreme="largest").max("stretch"), whole[metric], rtol=1e-6)


@pytest.mark.parametrize(
    "axis", [{"contact.damping": [200.0, 1.0]}, {"kp": [50.0, 20_000.0]}], ids=lambda axis: next(iter(axis))
)
def test_a_value_that_the_time_step_cannot_follow_is_refused_before_the_first_walk(scenario, axis):
    seen = []
    with pytest.raises(mc.ConfigError, match=r"scenario: time_step: expected .*(damping 200|kp 20000)"):
        sweep(scenario, axis | {"damping": [10.0, 20.0]}, batch_size=1, progress=lambda *done: seen.append(done))
    assert not seen


@pytest.mark.slow
def test_progress_counts_walks_not_padding(scenario):
    seen = []
    sweep(scenario, AXES, batch_size=SIZE, progress=lambda *done: seen.append(done))
    assert seen == [(0, 6), (4, 6), (6, 6)]


@pytest.mark.parametrize(("walks", "steps"), [(1, 8000), (4, 10), (144, 8000), (145, 8000), (5000, 200), (7, 10**7)])
def test_parts_are_equal_and_hold_all(walks, steps):
    for platform in ("cpu", "gpu"):
        size = sweeps.default_batch_size(walks, steps, platform)
        count = -(-walks // size)
        assert 1 <= size <= walks
        assert count * size - walks < count  # never a whole robot per part too many


@pytest.mark.slow
def test_killed_sweep_resumes_bit_by_bit(scenario, whole, tmp_path):
    script = f"""
import os, signal, numpy as np, mjx_climb as mc
from tuning import sweep
scenario = mc.load_scenario({str(CONFIG)!r}, ["duration=0.3"])
def die(done, total):
    if done:
        os.kill(os.getpid(), signal.SIGKILL)
sweep(scenario, {AXES}, batch_size={SIZE}, progress=die, out={str(tmp_path)!r})
"""
    died = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True)
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert kept(scenario, tmp_path) == SIZE
    seen = []
    resumed = sweep(scenario, AXES, batch_size=SIZE, out=tmp_path, progress=lambda *done: seen.append(done)).data
    assert seen == [(4, 6), (6, 6)]
    xr.testing.assert_identical(resumed.drop_attrs(), whole.drop_attrs())
    parts.clear(tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("differs", "changes"),
    [
        ("scenario.contact.damping", {"scenario": mc.load_scenario(CONFIG, ["duration=0.3", "contact.damping=21"])}),
        ("axes.stiffness", {"axes": {**AXES, "stiffness": [1e3, 1e4]}}),
        ("axes.damping", {"axes": {**AXES, "damping": [1e2, 2e3]}}),
        ("precision", {"dtype": np.float64}),
        ("batch_size", {"batch_size": 2}),
        ("metrics", {"metrics": mc.MetricTable(tuple(mc.METRICS)[:-1])}),
        ("engine", {"engine": "mjx"}),
    ],
)
def test_folder_of_another_sweep_is_refused(scenario, tmp_path, differs, changes):
    for _ in range(2):
        assert kept(scenario, tmp_path) == 0
    with pytest.raises(OutputError, match=f"^{tmp_path}: .* differs in {differs} "):
        kept(**{"scenario": scenario, "out": tmp_path} | changes)
    (tmp_path / parts.FOLDER / "identity.json").write_text("{")
    with pytest.raises(OutputError):
        kept(scenario, tmp_path)


@pytest.mark.slow
def test_best_is_the_least_among_walks_that_hold(whole):
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], np.float32)
    limb, diverged = np.full((3, 2), -1, np.int32), np.zeros((3, 2), bool)
    limb[0, 0], diverged[0, 1] = 0, True  # the first limb has number 0
    cells = {"force_variation": values, "min_tsm": values, "detached_limb": limb, "diverged": diverged}
    made = whole.assign({name: (("stiffness", "damping"), each) for name, each in cells.items()})
    best = best_cell(made)
    assert (best["stiffness"], best["damping"], best["force_variation"]) == (1e4, 1e2, 3)
    assert best_cell(made, "min_tsm")["min_tsm"] == 6
    assert best_cell(made.assign(diverged=made["diverged"] | True)) is None


_LONG_SWEEP = f"""
import sys, mjx_climb as mc
from tuning import sweep
scenario = mc.load_scenario({str(CONFIG)!r}, ["duration=0.3"])
print("begun", flush=True)
sweep(scenario, {AXES}, batch_size=1, out=sys.argv[1], progress=lambda done, total: print(done, flush=True))
print("whole", flush=True)
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_sweep_killed_at_random_instants_resumes_bit_by_bit(scenario, tmp_path, killed):
    """SIGKILL at any instant, while it compiles, walks or writes; as often as it takes to see it whole."""
    rng, there = np.random.default_rng(), []
    for _ in range(2):  # lines: begun, what is there, the first new part
        killed(_LONG_SWEEP, tmp_path, lines=rng.integers(1, 4), delay=rng.exponential(0.05))
        there.append(kept(scenario, tmp_path, batch_size=1))
    assert there == sorted(there)
    resumed = sweep(scenario, AXES, batch_size=1, out=tmp_path).data
    xr.testing.assert_equal(resumed, sweep(scenario, AXES, batch_size=1).data)
