"""The program: what it prints, writes and returns, and how it refuses."""

import functools
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb import plots
from mjx_climb.compilation import devices
from mjx_climb.dynamics import DEFAULT_ENGINE
from tuning.command_line import main, options, progress, report, sweep
from tuning.command_line.ending import InputError, user_error
from tuning.command_line.sweep import log_range
from tuning.gains import gains_file
from tuning.output import beside
from tuning.problem import evaluation
from tuning.report import page
from tuning.searches import grid, schedule

ROOT = Path(__file__).parents[3]
CONFIG = str(ROOT / "configs" / "case_1_2.yaml")
SHORT = ["--set", "duration=0.2"]
WEAK = ["--set", "contact.holding_limit=1e-6"]  # lets go at the first pull
GRID = ["--stiffness", "1e3:1e5:3", "--damping", "1e2:1e3:2", "--batch-size", "4"]


@pytest.fixture
def call(capsys):
    """Run the program in this process: (exit code, stdout, stderr)."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        return ended.value.code, *capsys.readouterr()

    return call


def strict_json(text):
    def refuse(constant):
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    (folder / "bad.yaml").write_text("gait: {strid: 0.05}")
    (folder / "broken.yaml").write_text("gait: [")
    (folder / "gains.yaml").write_text("damping: 1")
    (folder / "file").write_text("")
    (folder / "held.yaml").write_text("inertia: 1\ndamping: 1\nstiffness: 1")
    for name in ("trajectory.nc", "sweep.nc", "search.nc", "parts"):  # of other commands, the last one's unfinished
        (folder / f"with_{name}").mkdir()
        (folder / f"with_{name}" / name).write_text("")
        (folder / f"with_{name}" / "config.yaml").write_text("theirs")
    return folder


BAD = [
    ("bogus", "No such command"),
    ("run", "Missing argument 'CONFIG'"),
    ("run {config} --frobnicate", "No such option"),
    ("run {config} --stifness 3e3", "did you mean --set contact.stiffness= or --set control.stiffness=?"),
    ("run {config} --gait.cycl 3", "did you mean --set gait.cycle=?"),
    ("sweep {config} --stifness 1:2:3", "did you mean --stiffness?"),
    ("run {config} --controller pid", "'pid'"),
    ("run nowhere.yaml", "nowhere.yaml: expected a readable file"),
    ("run {files}", "expected a readable file"),
    ("run {files}/bad.yaml", "did you mean stride?"),
    ("run {files}/broken.yaml", "expected valid YAML"),
    (
        "run {config} --set control.damping=-1",
        "control.damping: expected a finite number above 0, or a list of six, got -1",
    ),
    ("run {config} --set control.inertia=0", "control.inertia: expected"),
    ("run {config} --set control.dampin=1", "control.dampin"),
    ("run {config} --set damping", "dotted.key=value"),
    ("run {config} --set robot=spot", "robot: expected one of"),
    ("run {config} --set control.reading=measured_pose --controller end_effector_admittance", "control.reading"),
    ("run {config} --set time_step=0.01", "time_step: expected one short enough for hubrobo_v3_2"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --set robot=hubrobo_v2_2", "0.0001 would do"),
    ("run {config} --set robot.height=0.1", "robot.file: expected a value, got none"),
    ("run {config} --engine bullet", "--engine: expected one of"),
    ("run {config} --gains nowhere.yaml", "nowhere.yaml: expected a readable file"),
    ("run {config} --gains {files}/gains.yaml", "inertia: expected a value, got none"),
    ("run {config} --metric nowhere.py:mine", "nowhere.py: expected a file of Python, got none"),
    ("tune {config} --metric mine", "metric: expected FILE.py:NAME, got 'mine'"),
    ("run {config} --figures gif", "--figures: expected some of png, svg, pdf, got 'gif'"),
    ("run {config} --out {files}/file", "{files}/file"),
    ("run {config} --compare pid", "'pid'"),
    ("run {config} --compare base_admittance", "--compare: expected a controller other than the walk's own"),
    ("run {config} --at 1", "--at: expected --snapshots beside it"),
    ("run {config} --size 641x480", "--size: expected WIDTHxHEIGHT"),
    ("run {config} --size 1e3x480", "--size: expected WIDTHxHEIGHT"),
    ("run {config} --size 640", "--size: expected WIDTHxHEIGHT"),
    ("run {config} --out {files}/file/below", "file/below: expected a folder that can be written to"),
    ("sweep {config} --stiffness 1:2:3", "--stiffness, --damping, --axis: expected two gains to sweep, got stiffness"),
    ("sweep {config} --damping 1:2:3 --stiffness 1e6:1e2:3", "--stiffness: expected LOW:HIGH:COUNT"),
    ("sweep {config} --stiffness 1:2:3 --damping 1e3:1e2:3", "LOW is not below HIGH"),
    ("sweep {config} --stiffness 1:2:3 --damping 0:1e2:3", "LOW is not between"),
    ("sweep {config} --stiffness 1:2:3 --damping=-1:1e2:3", "LOW is not between"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:nan:3", "HIGH is not between"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:many:3", "HIGH is not a number"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:1", "COUNT is not between 2"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:2.5", "COUNT is not a whole number"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2", "2 parts instead of 3"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:1.00000001:9", "too close"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --controller pd", "--controller"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --batch-size 0", "--batch-size"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --set robot=spot", "robot: expected one of"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --out {files}/file", "{files}/file"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --shard 5/4", "--shard: expected I/N with I from 1 to N"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --shard 1/10", "shard 1/10: expected at most 9 shards"),
    ("sweep {config} --stiffness 1:2:31700 --damping 1:2:31700", "--axis: expected at most 1000000000 walks in all"),
    ("export {files}/held.yaml --name caf\u00e9", "--name: expected ASCII letters, digits and underscores"),
    ("run {long}", "bbb: expected a file, or a config that comes with the program"),
    ("run {config} --hardware {long}", "bbb: expected a file, or a profile of hardware"),
    ("run {config} --law {long}.py:Law", "bbb.py: expected a file of Python, got none"),
    ("run {config} --set robot={long}", "robot: expected one of "),
    ("plot {long}", "bbb: expected a folder with a result"),
    ("merge {files}", "expected a shard's folder, or one that holds shards, got none"),
    ("judge {config} --gains {files}/gains.yaml", "inertia: expected a value, got none"),
    ("judge {config} --gains {files}/gains.yaml --controller pd", "--controller: expected a law"),
    ("judge {config} --gains nowhere.yaml --ensemble nowhere", "nowhere.yaml: expected a readable file"),
    ("run {config} --set contact.stiffness=1e308", "case_1_2.yaml: time_step: expected"),
    ("run {config} --set hardware.control_period=1e308", "hardware.control_period: expected at most 10000000 time"),
    ("run {config} --set gravity=[0,0,-1e308]", "gravity: expected a list of three numbers from -10000 to 10000, got"),
    ("run {config} --set gait.stride=1e308", "gait.stride: expected a number from 0 to 100, got 1e+308"),
    ("run {config} --set gait.step_height=1e308", "gait.step_height: expected a number above 0, 100 at most, got"),
    ("run {config} --out=\x1b[31m --frob", "No such option"),
    ("tune {config} --pin stiffness.q=1", "--pin stiffness.q: expected one of damping, stiffness"),
    ("tune {config} --bound damping=2:1", "--bound damping: expected low < high"),
    ("tune {config} --weight Smoothness=1", "'Smoothness' is no metric"),
    ("tune {config} --weight peak_force=1", "did you mean peak_pull_force or peak_foot_force?"),
    ("tune {config} --limit peak_force=1", "expected one of peak_foot_force, force_variation, "),
    ("tune {config} --seed=-1", "--seed: "),
    ("tune {config} --controller pd", "case_1_2.yaml: control.controller: expected an admittance law"),
    ("pareto {config} --better nothing", "--better: 'nothing' is no metric"),
    ("pareto {config} --better travel --against travel", "--against: expected another metric than travel"),
    ("schedule {config} --gravity 0,1", "--gravity: expected numbers above 0"),
    ("schedule {config} --cargo=-1,1", "--cargo: expected numbers 0 or above"),
    ("schedule {config} --cargo 1e400/3", "--cargo: expected numbers with commas"),
    ("schema --out=", ".: expected a file that can be written"),
    ("tune {config} --out {files}/file/below", "file/below: expected a folder that can be written to"),
    ("pareto {config} --out {files}/file", "file: expected a folder that can be written to"),
    ("schedule {config} --out {files}/file", "file: expected a folder that can be written to"),
]
TAKEN = [
    ("run {config}", "sweep.nc"),
    ("run {config}", "parts"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3", "trajectory.nc"),
    ("sweep {config} --stiffness 1:2:3 --damping 1:2:3 --shard 1/2", "search.nc"),
    ("tune {config}", "sweep.nc"),
    ("pareto {config}", "search.nc"),
    ("schedule {config}", "trajectory.nc"),
    ("margins {config}", "search.nc"),
    ("judge {config} --gains {files}/held.yaml", "search.nc"),
    ("reproduce", "sweep.nc"),
]
BAD += [
    (
        f"{line} --out {{files}}/with_{name}",
        f"with_{name}: expected a folder without another command's result, got {name}",
    )
    for line, name in TAKEN
]


@pytest.mark.parametrize(("line", "expected"), BAD, ids=[line for line, _ in BAD])
def test_bad_input_ends_with_2_and_one_line(line, expected, call, files, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("rollout", "rollout_metrics", "rollout_histories"):  # refused before anything is computed
        monkeypatch.setattr(mc, name, lambda *_, **__: pytest.fail("computed"))
    monkeypatch.setattr(evaluation, "baseline", lambda *_: pytest.fail("computed"))
    monkeypatch.setattr(schedule, "pd_of", lambda *_, **__: pytest.fail("computed"))
    code, out, err = call(*(word.format(config=CONFIG, files=files, long="b" * 300) for word in line.split()))
    assert (code, out) == (2, "")
    assert err.startswith("mjx-climb: error: ")
    assert len(err.splitlines()) == 1
    assert expected.format(files=files) in err
    assert not list(tmp_path.iterdir())
    assert {file.read_text() for file in files.glob("with_*/config.yaml")} == {"theirs"}


HAS_NONE = "cost_of_transport: expected a metric that pd has"
WEIGHTLESS = [*SHORT, "--set", "gravity=[0,0,0]"]
UNWEIGHABLE = {  # in free fall no transport has a cost relative to the weight
    "tune": (["tune", CONFIG, *WEIGHTLESS], f"error: --weight {HAS_NONE} here, got nan under pd"),
    "search file": (
        ["tune", CONFIG, *WEIGHTLESS, "--search", "search.yaml"],
        f"error: search.yaml: weights.{HAS_NONE}",
    ),
    "ensemble": (
        ["tune", CONFIG, *WEIGHTLESS, "--ensemble", "ensemble", "--members", "2"],
        f"error: --weight {HAS_NONE} in every member, got nan in the mean",
    ),
    "pareto": (
        ["pareto", CONFIG, *WEIGHTLESS, "--better", "cost_of_transport"],
        f"error: --better: weights.{HAS_NONE}",
    ),
    "schedule": (
        ["schedule", CONFIG, *SHORT, "--gravity", "1e-300", "--cargo", "0"],
        f"case_1_2.yaml: weights.{HAS_NONE} here",
    ),
}


@pytest.mark.parametrize(
    "search",
    [pytest.param(name, marks=() if name in ("tune", "search file") else pytest.mark.slow) for name in UNWEIGHABLE],
)
def test_a_weight_on_what_pd_has_not_is_refused_before_anything_is_written(search, call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if search == "search file":
        (tmp_path / "search.yaml").write_text("weights: {cost_of_transport: 1.0}")
    before = set(tmp_path.iterdir())
    arguments, expected = UNWEIGHABLE[search]
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert expected in err.splitlines()[-1]
    assert set(tmp_path.iterdir()) == before


WALK = f"run {CONFIG} --set duration=0.02 --out out"
SURROUNDINGS = {  # a line for the shell, and what is said
    "no tpu": (f"JAX_PLATFORMS=tpu {{program}} {WALK}", "JAX_PLATFORMS: expected devices that JAX can use"),
    "no nan": (f"JAX_DEBUG_NANS=1 {{program}} {WALK}", "JAX_DEBUG_NANS, JAX_DEBUG_INFS: expected none"),
    "full": ("{program} schema >/dev/full", "standard output: expected a place that takes what is printed, got 'no"),
    "full, little": ("{program} --version >/dev/full", "standard output: expected a place that takes what is"),
    "closed": ("{program} schema >&-", "standard output: expected an open one"),
    "other text": (f"{{program}} {WALK}-$'\\xff'", "argument 6: expected UTF-8, which reports are written in"),
    "gone": ("rmdir $PWD && {program} schema", "the working folder: expected one that is there"),
}


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="writes to /dev/full")
@pytest.mark.parametrize("case", SURROUNDINGS)
def test_surroundings_that_a_command_cannot_work_in_get_one_line(case, tmp_path):
    line, expected = SURROUNDINGS[case]
    line = "set -o pipefail; " + line.format(program=f"{sys.executable} -m tuning.command_line")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"mjx-climb: error: {expected}"), done.stderr


def test_a_closed_standard_error_leaves_standard_output_alone(tmp_path):
    line = f"{sys.executable} -m tuning.command_line run nowhere 2>&-"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")


def test_a_long_line_is_shortened_in_the_middle():
    line = user_error(InputError(f"--option: {'x' * 10_000} its end"))
    assert len(line) < 1100 and line.startswith("--option: ") and line.endswith(" its end")


def test_a_bug_is_not_taken_for_bad_input(monkeypatch, tmp_path):
    def bug(*_, **__):
        raise ValueError("a bug")

    monkeypatch.setattr(mc, "rollout", bug)
    with pytest.raises(ValueError, match="a bug"):
        main(["run", CONFIG, "--out", str(tmp_path)])


def test_run_writes_and_prints(call, tmp_path):
    code, out, err = call("run", CONFIG, *SHORT, "--controller", "pd", "--out", tmp_path)
    assert code == 0
    assert "peak foot force" in out
    assert "N m" in out
    assert out.rstrip().endswith("held all the way")
    assert "compil" in err
    assert str(tmp_path) in err
    pictures = {"walk.png", "feet.png"}
    written = {"trajectory.nc", "config.yaml", "metrics.json"} | pictures
    assert {path.name for path in tmp_path.iterdir()} == written
    scenario = mc.load_scenario(tmp_path / "config.yaml")
    assert scenario == mc.load_scenario(CONFIG, ["duration=0.2", "control.controller=pd"])
    metrics = strict_json((tmp_path / "metrics.json").read_text())
    assert list(metrics) == list(mc.METRICS.names)
    assert metrics["detached_at"] is None
    with xr.open_dataset(tmp_path / "trajectory.nc", engine="h5netcdf") as walk:
        assert walk.sizes["time"] == 200
        assert np.linalg.norm(walk["foot_force"], axis=-1).max() == pytest.approx(metrics["peak_foot_force"])


def test_run_takes_metrics_of_ones_own(call, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from mjx_climb.walk.metrics import largest\n"
        'highest = largest("highest_base", "m", "highest base", lambda s, _: s.base_position[2])\n'
    )
    metric = f"{tmp_path / 'mine.py'}:highest"
    code, out, _ = call("run", CONFIG, *SHORT, "--controller", "pd", "--metric", metric, "--out", tmp_path / "out")
    assert code == 0
    value = strict_json((tmp_path / "out" / "metrics.json").read_text())["highest_base"]
    with xr.open_dataset(tmp_path / "out" / "trajectory.nc", engine="h5netcdf") as walk:
        assert value == pytest.approx(walk["base_position"].values[:, 2].max())
    assert re.search(rf"highest base +{value:.4g} +m\b", out)


def test_run_says_who_let_go(call, tmp_path):
    code, out, _ = call("run", CONFIG, *SHORT, *WEAK, "--controller", "pd", "--out", tmp_path, "--json")
    metrics = strict_json(out)
    assert code == 1
    assert metrics["detached_limb"] in ("LF", "LH", "RH", "RF")
    code, out, _ = call("run", CONFIG, *SHORT, *WEAK, "--controller", "pd", "--out", tmp_path)
    said, helps = out.rstrip().splitlines()[-2:]
    assert said == f"limb {metrics['detached_limb']} let go at {metrics['detached_at']:.3f} s"
    own = mc.load_scenario(tmp_path / "config.yaml").with_overrides({"contact.holding_limit": None})
    for change in ("", "gait.stride=0.025", "control.kp=25 and control.kd=0.1", "control.kp=100 and control.kd=0.4"):
        walk = mc.rollout(own.with_overrides(change.split(" and ") if change else []))
        force = walk.foot_force[walk.support & (walk.foot_force[..., 2] < 0)]
        words = f"{f'with {change}' if change else 'pull on grips that never let go:'} "
        assert f"{words}{np.linalg.norm(force, axis=-1).max():.3g} N" in helps


def test_run_survives_divergence(call, tmp_path):
    law = ["--set", "control.reading=measured_pose", "--set", "control.damping=1e7"]
    code, out, _ = call("run", CONFIG, *SHORT, *law, "--out", tmp_path)
    assert code == 1
    assert "diverged at 0." in out
    metrics = strict_json((tmp_path / "metrics.json").read_text())
    assert metrics["diverged"] is True
    with xr.open_dataset(tmp_path / "trajectory.nc", engine="h5netcdf") as walk:
        force = np.linalg.norm(walk["foot_force"], axis=-1)
        finite = np.isfinite(force).all(1) & np.isfinite(walk["base_position"].values).all(1)
    until = np.argmin(finite)  # the metrics are those of the walk until then
    assert 0 < until < 200 and not finite.all()
    assert metrics["peak_foot_force"] == pytest.approx(force[:until].max())


def test_gains_file_takes_the_place_of_the_configs(call, tmp_path):
    gains_file.save(mc.Gains(2.0, 30.0, 500.0, kp=45.0), tmp_path / "gains.yaml")
    code, _, _ = call(
        "run", CONFIG, *SHORT, "--controller", "pd", "--gains", tmp_path / "gains.yaml", "--out", tmp_path / "out"
    )
    control = mc.load_scenario(tmp_path / "out" / "config.yaml").control
    assert code == 0
    assert (control.inertia, control.damping, control.stiffness, control.kp) == (2.0, 30.0, 500.0, 45.0)


class _Called(Exception):
    """All rollouts that a test waits for were asked for."""


def test_engine_and_batch_size_reach_the_rollouts(monkeypatch, tmp_path):
    calls = []

    def rollout(_, gains=None, *, engine=None, **__):
        calls.append((engine, None if gains is None else len(gains["stiffness"])))
        if len(calls) == 2:
            raise _Called

    for name in ("rollout", "rollout_histories"):
        monkeypatch.setattr(mc, name, rollout)
    with pytest.raises(_Called):
        main(["run", CONFIG, "--engine", "mjx", "--compare", "pd", "--out", str(tmp_path / "run")])
    assert calls == [("mjx", None)] * 2  # the walk and the one it is compared with
    calls[:] = [None]
    monkeypatch.setattr(beside, "beside", lambda *_: None)
    with pytest.raises(_Called):
        main(["sweep", CONFIG, *GRID, "--engine", "mjx", "--out", str(tmp_path / "sweep")])
    assert calls[1:] == [("mjx", 4)]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep that ran through, by another process: (folder, finished process)."""
    out = tmp_path_factory.mktemp("swept")
    arguments = ["sweep", CONFIG, *SHORT, *GRID, "--out", str(out), "--json"]
    command = [sys.executable, "-m", "tuning.command_line", *arguments]
    return out, subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_sweep_prints_json_alone_on_stdout(swept):
    out, done = swept
    assert done.returncode == 0, done.stderr
    found = strict_json(done.stdout)
    assert done.stdout.startswith("{")
    assert list(found) == ["best", "retuned_pd", "config", "pd", "force_sensor", "grid"]
    assert found["grid"]["walks"] == 6
    assert found["pd"]["gains"] is None
    assert found["config"]["gains"] == {"inertia": 1.0, "damping": 5e3, "stiffness": 5e4}
    assert all(list(found[name]["metrics"]) == list(mc.METRICS.names) for name in list(found)[:4])
    joint = found["retuned_pd"]["gains"]
    assert 10.0 <= joint["kp"] <= 200.0 and 0.02 <= joint["kd"] <= 2.0
    values = {name: found[name]["metrics"]["force_variation"] for name in ("best", "retuned_pd", "pd")}
    assert values["retuned_pd"] <= values["pd"]
    assert found["force_sensor"]["force_variation"] == pytest.approx(values["best"] / values["retuned_pd"] - 1)
    assert found["force_sensor"]["in_words"] in " ".join(done.stderr.split())
    for word in ("compil", "cache", "6 of 6 walks", "paper", "force variation", str(out)):
        assert word in done.stderr


def test_sweep_writes_grid_maps_and_config(swept):
    out, done = swept
    names = {path.name for path in out.iterdir()}
    assert names == {"report.html", "sweep.nc", "config.yaml", "comparison.json", "maps.png"}
    with xr.open_dataset(out / "sweep.nc", engine="h5netcdf") as result:
        np.testing.assert_allclose(result["stiffness"], [1e3, 1e4, 1e5])
        best = grid.best_cell(result.load())
        assert best["stiffness"].item() == strict_json(done.stdout)["best"]["gains"]["stiffness"]
    assert mc.load_scenario(out / "config.yaml") == mc.load_scenario(CONFIG, ["duration=0.2"])


@pytest.mark.slow
def test_a_sweep_from_python_writes_what_the_command_writes(swept, monkeypatch, tmp_path):
    monkeypatch.setattr(plots, "save_figure", lambda figure, stem, _: stem.with_suffix(".png").write_bytes(b""))
    scenario = mc.load_scenario(CONFIG, ["duration=0.2"])
    axes = {"stiffness": np.geomspace(1e3, 1e5, 3), "damping": np.geomspace(1e2, 1e3, 2)}
    found = tuning.sweep(scenario, axes, batch_size=4, out=tmp_path)
    judged = found.write(tmp_path)
    names = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert names == {str(path.relative_to(swept[0])) for path in swept[0].rglob("*")}
    assert judged.summary == swept[1].stdout.strip() == (tmp_path / "comparison.json").read_text().strip()
    results = [xr.load_dataset(folder / "sweep.nc", engine="h5netcdf") for folder in (tmp_path, swept[0])]
    xr.testing.assert_identical(*(result.drop_attrs() for result in results))


@pytest.mark.slow
def test_interrupted_sweep_keeps_its_parts_and_goes_on(call, swept, monkeypatch, tmp_path):
    walk, calls = mc.rollout_histories, []

    def stopped(*arguments, **options):
        calls.append(1)
        if len(calls) == 1:
            signal.raise_signal(signal.SIGTERM)
        return walk(*arguments, **options)

    command = ("sweep", CONFIG, *SHORT, *GRID, "--out", tmp_path)
    monkeypatch.setattr(mc, "rollout_histories", stopped)
    code, out, err = call(*command)
    assert (code, out) == (130, "")
    last = err.splitlines()[-1]
    assert last == (f"mjx-climb: interrupted: 4 of 6 walks are kept in {tmp_path}; the same command goes on from there")
    code, _, err = call("sweep", CONFIG, *SHORT, *GRID[:2], "--damping", "1:9:2", "--out", tmp_path)
    assert code == 2
    assert str(tmp_path) in err

    monkeypatch.setattr(plots, "save_figure", lambda *_: None)
    monkeypatch.setattr(page, "write", lambda *_: None)
    code, out, err = call(*command)
    assert code == 0
    assert len(calls) == 2
    assert "4 are there already" in err
    assert "best: stiffness" in out
    results = [xr.load_dataset(folder / "sweep.nc", engine="h5netcdf") for folder in (tmp_path, swept[0])]
    xr.testing.assert_identical(*(result.drop_attrs() for result in results))


@pytest.mark.slow
def test_sweep_in_which_all_fail(call, tmp_path):
    code, out, _ = call("sweep", CONFIG, *SHORT, *GRID, *WEAK, "--out", tmp_path, "--json")
    found = strict_json(out)
    assert code == 0
    assert found["best"] is None
    assert found["grid"]["failed"] == 6


def test_help_is_quick_and_needs_nothing_heavy():
    script = (
        "import sys, tuning.command_line as c\n"
        "try: c.main(['run', '--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'jax', 'numpy', 'matplotlib', 'xarray', 'mujoco'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "mjx-climb run case_2" in done.stdout


def test_import_prints_nothing():
    command = [sys.executable, "-c", "import mjx_climb"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True).stdout == b""


def test_version_and_no_arguments(call):
    code, out, _ = call("--version")
    assert code == 0
    assert "mjx-climb" in out
    assert "jax" in out
    code, out, _ = call()
    assert code == 0
    assert "sweep" in out


def test_help_names_the_default_engine(call):
    _, out, _ = call("run", "--help")
    assert f"[default: ({DEFAULT_ENGINE})]" in " ".join(out.split())
    assert all(name in out for name in mc.ENGINES)


def test_range_is_even_on_a_logarithmic_scale():
    np.testing.assert_allclose(log_range("--x", "1e2:1e6:5"), [1e2, 1e3, 1e4, 1e5, 1e6])
    with pytest.raises(InputError, match="--x"):
        log_range("--x", "")


def test_a_long_sweep_says_before_how_long_it_takes(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 2)
    scenario = mc.load_scenario(CONFIG)  # of 8000 steps
    said = functools.partial(sweep._announcement, scenario, engine="limb", said=[], kept=0)
    axes = {"stiffness": np.ones(1000), "damping": np.ones(1000)}
    assert said(axes, here=10**6).endswith("; expect some 30 min, or spread them over machines with --shard")
    assert said(axes, here=10**4).endswith(f"of 8000 steps on {jax.devices()[0].device_kind}")


def test_estimate_leaves_the_compiler_out():
    estimate = progress.Estimate(now=0.0)
    assert estimate.update(40, 100, now=1.0) is None  # found on disk
    estimate.compiled(now=11.0)
    assert estimate.update(60, 100, now=13.0) == pytest.approx(4.0)
    assert estimate.update(100, 100, now=17.0) == 0


def test_numbers_in_tables_and_json():
    assert report.change(2.0, 1.0) == "+100"
    assert report.change(0.5, 1.0) == "-50.0"
    assert report.change(None, 1.0) == report.change("LF", 1.0) == report.change(1.0, 0.0) == ""
    assert strict_json(report.to_json({"a": np.float32("nan"), "b": np.int32(3), "c": [np.inf, True]})) == {
        "a": None,
        "b": 3,
        "c": [None, True],
    }


def test_time_left_counts_only_what_is_done_since_the_last_compilation():
    estimate = progress.Estimate(now=0.0)
    assert estimate.update(0, 10, now=0.0) is None
    assert estimate.update(2, 10, now=4.0) == pytest.approx(16.0)
    estimate.compiled(now=30.0)
    assert estimate.update(4, 10, now=32.0) == pytest.approx(6.0)


def test_only_the_compilers_time_is_called_compiling():
    watched = progress.Compilation()
    watched.since -= 3.0
    watched._duration(progress.COMPILED, 2.0)
    watched.since -= 5.0
    watched._event(progress.FROM_CACHE)
    watched._duration(progress.COMPILED, 0.5)
    compiled, loaded = watched.seconds.values()
    assert compiled == pytest.approx(3.0, abs=0.5) and loaded == pytest.approx(5.0, abs=0.5)


def test_configs_that_come_with_the_program_are_found_by_name(call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    scenario = options.scenario_from(Path("case_2"), None, ["duration=0.2"])
    assert scenario == mc.load_scenario(ROOT / "configs" / "case_2.yaml", ["duration=0.2"])
    code, _, err = call("run", "case_9")
    assert code == 2
    assert "case_9: expected a file, or a config that comes with the program (case_1_1, case_1_2, case_2" in err
    (tmp_path / "case_2").write_text("duration: -1")  # a file of one's own comes first
    code, _, err = call("run", "case_2")
    assert (code, "case_2: duration: expected" in err) == (2, True)
