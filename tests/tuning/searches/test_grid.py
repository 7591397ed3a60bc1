"""The grid search: its numbers, its choice, and what an interrupt leaves behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.files.dataset import OutputError
from tuning.gains import gains_file
from tuning.searches import finished_parts, grid

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "case_1_2.yaml"
STIFFNESS, DAMPING = np.array([1e3, 1e4, 1e5]), np.array([1e2, 1e3])
SIZE = 4  # of a batch: two parts, the last one half full


@pytest.fixture(scope="module")
def scenario():
    return mc.load_scenario(CONFIG, ["duration=0.2"])


@pytest.fixture(scope="module")
def whole(scenario):
    return grid.sweep(scenario, STIFFNESS, DAMPING, batch_size=SIZE)


@pytest.mark.slow
def test_every_cell_is_the_walk_with_its_gains(scenario, whole):
    assert whole["peak_foot_force"].dims == ("stiffness", "damping")
    for k, d in ((1e3, 1e3), (1e5, 1e2), (1e5, 1e3)):
        alone = mc.metrics(mc.rollout(scenario, mc.Gains(1.0, d, k)))
        cell = whole.sel(stiffness=k, damping=d)
        for name in ("peak_foot_force", "force_variation", "base_deviation", "min_tsm"):
            assert cell[name].item() == pytest.approx(alone[name], rel=5e-3), name


def test_progress_counts_walks_not_padding(scenario):
    seen = []
    grid.sweep(scenario, STIFFNESS, DAMPING, batch_size=SIZE, progress=lambda *done: seen.append(done))
    assert seen == [(0, 6), (4, 6), (6, 6)]


@pytest.mark.parametrize(("walks", "steps"), [(1, 8000), (4, 10), (144, 8000), (145, 8000), (5000, 200), (7, 10**7)])
def test_parts_are_equal_and_hold_all(walks, steps):
    for platform in ("cpu", "gpu"):
        size = grid.default_batch_size(walks, steps, platform)
        count = -(-walks // size)
        assert 1 <= size <= walks
        assert count * size - walks < count  # never a whole robot per part too many


def test_killed_sweep_resumes_bit_by_bit(scenario, whole, tmp_path):
    script = f"""
import os, signal, numpy as np, mjx_climb as mc
from pathlib import Path
from tuning.searches import grid
scenario = mc.load_scenario({str(CONFIG)!r}, ["duration=0.2"])
def die(done, total):
    if done:
        os.kill(os.getpid(), signal.SIGKILL)
grid.sweep(scenario, np.array({STIFFNESS.tolist()}), np.array({DAMPING.tolist()}), batch_size={SIZE}, progress=die,
           out=Path({str(tmp_path)!r}))
"""
    died = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True)
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert grid.claim(scenario, STIFFNESS, DAMPING, batch_size=SIZE, out=tmp_path) == SIZE
    seen = []
    resumed = grid.sweep(
        scenario, STIFFNESS, DAMPING, batch_size=SIZE, out=tmp_path, progress=lambda *done: seen.append(done)
    )
    assert seen == [(4, 6), (6, 6)]
    xr.testing.assert_identical(resumed.drop_attrs(), whole.drop_attrs())
    finished_parts.clear(tmp_path)
    assert not any(tmp_path.iterdir())


def test_folder_of_another_sweep_is_refused(scenario, tmp_path):
    grid.claim(scenario, STIFFNESS, DAMPING, out=tmp_path)
    grid.claim(scenario, STIFFNESS, DAMPING, out=tmp_path)
    other = scenario.with_overrides(["contact.damping=21"])
    for differs, arguments, options in (
        ("scenario.contact.damping", (other, STIFFNESS, DAMPING), {}),
        ("axes.stiffness", (scenario, STIFFNESS * 2, DAMPING), {}),
        ("axes.damping", (scenario, STIFFNESS, DAMPING * 2), {}),
        ("dtype", (scenario, STIFFNESS, DAMPING), {"dtype": np.float64}),
        ("batch_size", (scenario, STIFFNESS, DAMPING), {"batch_size": 2}),
        ("metrics", (scenario, STIFFNESS, DAMPING), {"metrics": tuple(mc.METRICS)[:-1]}),
    ):
        with pytest.raises(OutputError, match=f"differs in {differs} ") as refused:
            grid.claim(*arguments, out=tmp_path, **options)
        assert str(tmp_path) in str(refused.value)
    (tmp_path / finished_parts.FOLDER / "identity.json").write_text("{")
    with pytest.raises(OutputError):
        grid.claim(scenario, STIFFNESS, DAMPING, out=tmp_path)


def test_damaged_part_is_walked_again(tmp_path):
    kept = finished_parts.Parts(tmp_path, {"a": 1.5})
    kept.save(0, {"x": np.arange(3)})
    np.testing.assert_array_equal(kept.load(0)["x"], np.arange(3))
    file = next((tmp_path / finished_parts.FOLDER).glob("*.npz"))
    os.truncate(file, file.stat().st_size // 2)
    assert kept.load(0) is None
    assert kept.load(1) is None


@pytest.mark.parametrize("axis", [[], [0.0, 1.0], [1.0, np.nan], [1.0, np.inf], [[1.0]]])
def test_bad_axes(scenario, axis):
    with pytest.raises(ValueError, match="stiffness"):
        grid.sweep(scenario, np.array(axis), DAMPING)


def test_pd_has_nothing_to_sweep(scenario):
    with pytest.raises(ValueError, match="pd"):
        grid.sweep(scenario.with_overrides(["control.controller=pd"]), STIFFNESS, DAMPING)


def test_best_is_the_least_among_walks_that_hold(whole):
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], np.float32)
    limb, diverged = np.full((3, 2), -1, np.int32), np.zeros((3, 2), bool)
    limb[0, 0], diverged[0, 1] = 2, True
    made = whole.assign(
        force_variation=(whole["detached_limb"].dims, values),
        min_tsm=(whole["detached_limb"].dims, values),
        detached_limb=(whole["detached_limb"].dims, limb),
        diverged=(whole["detached_limb"].dims, diverged),
    )
    best = grid.best_cell(made)
    assert (best["stiffness"], best["damping"], best["force_variation"]) == (1e4, 1e2, 3)
    assert grid.best_cell(made, "min_tsm")["min_tsm"] == 6
    assert grid.best_cell(made.assign(diverged=made["diverged"] | True)) is None


@pytest.mark.parametrize(
    "gains",
    [
        mc.Gains(1.0, 5e3, 2e4),
        mc.Gains(np.arange(1.0, 7.0), np.float32(0.1), 1e22, kp=40.0, kd=0.0),
    ],
)
def test_gains_file_returns_what_went_in(gains, scenario, tmp_path):
    read = gains_file.load(gains_file.save(gains, tmp_path / "new" / "gains.yaml", "found by\na test"))
    for name, value in vars(gains).items():
        assert (getattr(read, name) is None) == (value is None)
        np.testing.assert_array_equal(getattr(read, name), value)
    control = gains_file.applied(scenario, read).control
    np.testing.assert_array_equal(control.damping, gains.damping)
    assert control.kp == (scenario.control.kp if gains.kp is None else gains.kp)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "a mapping with keys"),
        ("[1]", "a mapping with keys"),
        ("inertia: 1\ndamping: 1", "stiffness: expected a value, got none"),
        ("inertia: 1\ndamping: -1\nstiffness: 1", ": damping: expected a finite number above 0"),
        ("inertia: 1\ndamping: [1, 2]\nstiffness: 1", ": damping: expected"),
        ("inertia: 1\ndamping: {x: 1}\nstiffness: 1", ": damping"),
        ("inertia: 1\ndamping: 1\nstiffness: 1\nki: 3", "ki: expected only the keys"),
        ("inertia: 1\ndamping: 1\nstiffness: 1\nkd: null", ": kd: expected"),
        ("inertia: [", "valid YAML"),
    ],
)
def test_bad_gains_file(text, expected, tmp_path):
    (tmp_path / "gains.yaml").write_text(text)
    with pytest.raises(mc.ConfigError) as refused:
        gains_file.load(tmp_path / "gains.yaml")
    message = str(refused.value)
    assert expected in message
    assert message.startswith(str(tmp_path / "gains.yaml"))
    assert len(message.splitlines()) == 1


_LONG_SWEEP = f"""
import numpy as np, sys, mjx_climb as mc
from pathlib import Path
from tuning.searches import grid
scenario = mc.load_scenario({str(CONFIG)!r}, ["duration=0.2"])
print("begun", flush=True)
grid.sweep(scenario, np.array({STIFFNESS.tolist()}), np.array({DAMPING.tolist()}), batch_size=1, out=Path(sys.argv[1]),
           progress=lambda done, total: print(done, flush=True))
print("whole", flush=True)
"""


@pytest.mark.slow
def test_sweep_killed_at_random_instants_resumes_bit_by_bit(scenario, tmp_path):
    """SIGKILL at any instant, while it compiles, walks or writes; as often as it takes to see it whole."""
    environment = dict(os.environ, PYTHONPATH=str(ROOT))
    rng, kept = np.random.default_rng(), []
    for _ in range(4):
        process = subprocess.Popen(
            [sys.executable, "-c", _LONG_SWEEP, str(tmp_path)], cwd=ROOT, env=environment, text=True,
            stdout=subprocess.PIPE,
        )  # fmt: skip
        for _ in range(rng.integers(1, 4)):  # begun, what is there, the first new part
            process.stdout.readline()
        time.sleep(rng.exponential(0.05))
        process.kill()
        process.communicate()
        kept.append(grid.claim(scenario, STIFFNESS, DAMPING, batch_size=1, out=tmp_path))
    assert kept == sorted(kept)
    resumed = grid.sweep(scenario, STIFFNESS, DAMPING, batch_size=1, out=tmp_path)
    xr.testing.assert_equal(resumed, grid.sweep(scenario, STIFFNESS, DAMPING, batch_size=1))
