"""The program: what it prints, writes and returns, and how it refuses."""

import contextlib
import json
import re
import shlex
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from jax import monitoring

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.inputs.own_objects import load
from mjx_climb.robot_import.load import load_robot
from mjx_climb.viz import plots
from mjx_climb.walk.metrics import FAILURES
from mjx_climb.walks import LINES
from tests.shell import PROGRAM, ROOT, environment, finish
from tuning import numbers
from tuning.command_line import evaluate, logs, machine, main, options, processes, results, run, session, sweep, tune
from tuning.command_line.from_models import made
from tuning.command_line.program import ARGUMENTS, InputError, origin, repeated, typed_but, user_error
from tuning.comparisons import of_sweep
from tuning.gains import gains_file
from tuning.identification.plan.settings import Excitation
from tuning.identification.readers import read_log
from tuning.pages import page
from tuning.results.swept import best_cell
from tuning.searches import sweep as sweeps
from tuning.searches.shards import Rows

CONFIG = str(ROOT / "configs" / "case_1_2.yaml")
SHORT = ["--set", "duration=0.3"]
WEAK = ["--set", "contact.holding_limit=1e-6"]  # lets go at the first pull
GRID = ["--stiffness", "1e3:1e5:3", "--damping", "1e2:1e3:2", "--batch-size", "4"]


def strict_json(text):
    def refuse(constant):
        raise AssertionError(constant)

    return json.loads(text, parse_constant=refuse)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    texts = {"bad": "gait: {strid: 0.05}", "broken": "gait: [", "gains": "damping: 1"}
    held = "inertia: 1\ndamping: 1\nstiffness: 1"
    for name, text in {**texts, "held": held, "lawful": f"law: VirtualModelAdmittance\n{held}"}.items():
        (folder / f"{name}.yaml").write_text(text)
    (folder / "pd.yaml").write_text(held)
    (folder / "kp.yaml").write_text("law: PD\nkp: 50.0\n")
    (folder / "stiff.yaml").write_text(f"{held}\nkp: 1e7")
    (folder / "weighs.yaml").write_text("weights: {nothing: 1.0}")
    (folder / "file").write_text("")
    law = "from mjx_climb.control import VirtualModelAdmittance\nclass Mine(VirtualModelAdmittance): pass"
    (folder / "law.py").write_text(law)
    (folder / "log.csv").write_text("time,LF.coxa.command\n" + "".join(f"{n / 100},0.1\n" for n in range(20)))
    # of other commands, the last one's unfinished
    for name in ("trajectory.nc", "sweep.nc", "search.nc", "result.json", "parts"):
        (folder / f"with_{name}").mkdir()
        (folder / f"with_{name}" / name).write_text("")
        (folder / f"with_{name}" / "config.yaml").write_text("theirs")
    return folder


def refused():
    """Return the commands of refused.txt, each with what is said."""
    lines = (Path(__file__).parent / "refused.txt").read_text("utf-8").splitlines()
    return [line.replace("\\x1b", "\x1b").split(" => ") for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize(("line", "expected"), refused())
def test_bad_input_ends_with_2_and_one_line(line, expected, call, files, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in (  # refused before anything is computed
        "mjx_climb.rollout", "mjx_climb.rollout_metrics", "mjx_climb.rollout_histories",
        "tuning.problem.evaluation.baseline", "tuning.searches.schedule.pd_of",
    ):  # fmt: skip
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("computed"))
    code, out, err = call(*(word.format(config=CONFIG, files=files, long="b" * 300) for word in line.split()))
    assert (code, out) == (2, "")
    assert err.startswith("mjx-climb: error: ")
    assert len(err.splitlines()) == 1
    assert expected.format(files=files) in err
    assert not list(tmp_path.iterdir())
    assert {file.read_text() for file in files.glob("with_*/config.yaml")} == {"theirs"}


HAS_NONE = "cost_of_transport: expected a metric that pd has"
UNWEIGHABLE = {  # in free fall no transport has a cost relative to the weight
    "tune": f"error: --weight {HAS_NONE} here, got nan under pd",
    "tune --search search.yaml": f"error: search.yaml: weights.{HAS_NONE}",
    "tune --ensemble ensemble --members 2": f"error: --weight {HAS_NONE} in every member, got nan in the mean",
    "tune --against base_deviation --better cost_of_transport": f"error: --better: weights.{HAS_NONE}",
    "tune --over gravity=1e-300 --over cargo=0": f"case_1_2.yaml: weights.{HAS_NONE} here",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", [pytest.param(n, marks=[pytest.mark.nightly] * ("--members" in n or "--over" in n)) for n in UNWEIGHABLE]
)
def test_a_weight_on_what_pd_has_not_is_refused_before_anything_is_written(line, call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "search.yaml").write_text("weights: {cost_of_transport: 1.0}")
    command, *options = line.split()
    weightless = [] if "--over" in options else ["--set", "gravity=[0,0,0]"]
    code, out, err = call(command, CONFIG, *SHORT, *weightless, *options)
    assert (code, out) == (2, "")
    assert UNWEIGHABLE[line] in err.splitlines()[-1]
    assert [file.name for file in tmp_path.iterdir()] == ["search.yaml"]


WALK = f"run {CONFIG} --set duration=0.02 --out out"
SURROUNDINGS = {  # a line for the shell, and what is said
    "no tpu": (f"JAX_PLATFORMS=tpu {{program}} {WALK}", "JAX_PLATFORMS: expected devices that JAX can use"),
    "no cuda": (f"JAX_PLATFORMS=cuda {{program}} {WALK}", "JAX_PLATFORMS: expected devices that JAX can use, got 'cud"),
    "no truth": (f"JAX_ENABLE_X64=x {{program}} {WALK}", "JAX_ENABLE_X64: expected a value that JAX knows, got"),
    "not compiled": (f"JAX_DISABLE_JIT=1 {{program}} {WALK}", "JAX_DISABLE_JIT: expected 0, as no walk ends that is"),
    "no nan": (f"JAX_DEBUG_NANS=1 {{program}} {WALK}", "JAX_DEBUG_NANS, JAX_DEBUG_INFS: expected none"),
    "full": (
        "{program} doctor --schema >/dev/full",
        "standard output: expected a place that takes what is printed",
    ),
    "full, little": ("{program} --version >/dev/full", "standard output: expected a place that takes what is"),
    "closed": ("{program} doctor --schema >&-", "standard output: expected an open one"),
    "other text": (f"{{program}} {WALK}-$'\\xff'", "argument 6: expected UTF-8, which reports are written in"),
    "gone": ("rmdir $PWD && {program} doctor --schema", "the working folder: expected one that is there"),
}


SLOW_TO_END = ("no cuda", "no truth")  # those like them stay
ONCE_A_NIGHT = ("no tpu", "no nan", "full")


def in_bash(line, folder):
    line = "set -o pipefail; " + line.format(program=shlex.join(PROGRAM))
    return subprocess.run(["bash", "-c", line], cwd=folder, env=environment(), capture_output=True, text=True)


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="writes to /dev/full")
@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=[pytest.mark.slow] * (c in SLOW_TO_END) + [pytest.mark.nightly] * (c in ONCE_A_NIGHT))
     for c in SURROUNDINGS],
)  # fmt: skip
def test_surroundings_that_a_command_cannot_work_in_get_one_line(case, tmp_path):
    line, expected = SURROUNDINGS[case]
    done = in_bash(line, tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"mjx-climb: error: {expected}"), done.stderr


@pytest.mark.nightly
def test_a_closed_standard_error_leaves_standard_output_alone(tmp_path):
    done = in_bash("{program} run nowhere 2>&-", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


def test_a_gpu_without_the_cpu_beside_it_is_refused(monkeypatch):
    """What is exact is computed on the CPU: JAX's own error names no variable."""
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    line = user_error(RuntimeError("Unknown backend cpu. Available backends are ['cuda']"))
    assert line == "JAX_PLATFORMS: expected cpu among them, where what is exact is computed, got 'cuda'"


@pytest.mark.parametrize(("options", "said"), [
    (("--with-joint-gains", "--without-joint-gains"), "--with-joint-gains and --without-joint-gains"),
    (("--seed", "1", "--seed=2"), "--seed 1 and --seed=2"),
    (("--out", "a", "--out", "b"), "--out a and --out b"),
])  # fmt: skip
def test_an_option_has_one_value(capsys, options, said):
    """The last one had won, without a word."""
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["tune", "nowhere", *options])
    assert capsys.readouterr().err == f"mjx-climb: error: {said.split()[0]}: expected one value, got {said}\n"


@pytest.mark.parametrize("options", [("--json", "nowhere", "--json"), ("nowhere", "--seed", "1", "--seed", "1")])
def test_an_option_may_be_said_twice_alike_and_a_list_has_several(capsys, options):
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["tune", *options, "--law", "pd", "--law", "LoadTransfer"])
    assert "error: nowhere: expected a file" in capsys.readouterr().err


@pytest.mark.parametrize("where", ["mine", "called", "inner"])
def test_an_error_of_a_users_own_file_is_one_line_with_its_place(tmp_path, where):
    """Also one of a library, or of ours, that it called; the rest of a traceback is no help."""
    failing = "    raise RuntimeError('first\\nsecond')"
    body = {"mine": failing, "called": "    return np.stack([])", "inner": "    inner()"}[where]
    (tmp_path / "own.py").write_text(f"import numpy as np\n\n\ndef mine():\n{body}\ndef inner():\n{failing}\n")
    mine, *_ = load(f"{tmp_path / 'own.py'}:mine", "function")
    with pytest.raises((RuntimeError, ValueError)) as caught:
        mine()
    said = "ValueError: need at least one array to stack" if where == "called" else "RuntimeError: first"
    assert user_error(caught.value) == f"{tmp_path / 'own.py'}:{7 if where == 'inner' else 5}: {said}"
    assert user_error(ZeroDivisionError("ours")) is None


def test_a_failed_callback_of_a_users_own_is_one_line_with_its_place(tmp_path):
    """Of a program that JAX compiled: its error has the traceback as a text."""
    (tmp_path / "own.py").write_text("def fail(x):\n    raise RuntimeError('no network')\n")
    fail, *_ = load(f"{tmp_path / 'own.py'}:fail", "function")
    walk = jax.jit(lambda x: jax.pure_callback(fail, jax.ShapeDtypeStruct((), x.dtype), x))
    with pytest.raises(jax.errors.JaxRuntimeError) as caught:
        jax.block_until_ready(walk(1.0))
    assert user_error(caught.value) == f"{tmp_path / 'own.py'}:2: RuntimeError: no network"
    assert user_error(jax.errors.JaxRuntimeError("INTERNAL: ours")) is None


def test_a_long_line_is_shortened_in_the_middle():
    line = user_error(InputError(f"--option: {'x' * 10_000} its end"))
    assert len(line) < 1100 and line.startswith("--option: ") and line.endswith(" its end")


def test_a_command_is_said_again_with_another_value_of_an_option():
    """With either way of writing a value, and flags before it."""
    token = ARGUMENTS.set(("sweep", "case_1_2", "--json", "--shard=1/2", "--damping", "1:2:3", "--shard", "3/16"))
    try:
        assert typed_but("--shard", "N/16") == "mjx-climb sweep case_1_2 --json --damping 1:2:3 --shard N/16"
        again = "mjx-climb sweep config.yaml --damping 1:2:3 --out again"
        assert repeated(["sweep"], "--damping", "--stiffness") == again
    finally:
        ARGUMENTS.reset(token)


def test_a_bug_is_not_taken_for_bad_input(monkeypatch, tmp_path):
    def bug(*_, **__):
        raise ValueError("a bug")

    monkeypatch.setattr(mc, "rollout", bug)
    with pytest.raises(ValueError, match="a bug"):
        main(["run", CONFIG, "--out", str(tmp_path)])


@pytest.mark.slow
def test_run_writes_and_prints(call, tmp_path):
    code, out, err = call("run", CONFIG, *SHORT, "--controller", "pd", "--mcap", "--out", tmp_path)
    assert code == 0
    assert "peak foot force" in out and "N m" in out and out.rstrip().endswith("held all the way")
    assert "compil" in err and str(tmp_path) in err
    written = {"trajectory.nc", "config.yaml", "metrics.json", "walk.png", "feet.png", "walk.mcap", "settings.json"}
    assert {path.name for path in tmp_path.iterdir()} == written
    scenario = mc.load_scenario(tmp_path / "config.yaml")
    assert scenario == mc.load_scenario(CONFIG, ["duration=0.3", "control.controller=pd"])
    metrics = strict_json((tmp_path / "metrics.json").read_text())
    assert list(metrics) == list(mc.METRICS.names) and metrics["detached_at"] is None
    walk = xr.load_dataset(tmp_path / "trajectory.nc", engine="h5netcdf")
    assert walk.sizes["time"] == 300
    assert np.linalg.norm(walk["foot_force"], axis=-1).max() == pytest.approx(metrics["peak_foot_force"])
    log = read_log(tmp_path / "walk.mcap", load_robot(scenario.robot))
    np.testing.assert_array_equal(log.signals["RH.femur.position"].value, walk["joint_angles"].values[:, 2, 1])


@pytest.mark.slow
def test_run_takes_metrics_of_ones_own_and_a_gains_file_in_place_of_the_configs_gains(call, tmp_path):
    mine, gains, out = tmp_path / "mine.py", tmp_path / "gains.yaml", tmp_path / "out"
    mine.write_text(
        "from mjx_climb.walk.metrics import largest\n"
        'highest = largest("highest_base", "m", "highest base", lambda s, _: s.base_position[2])\n'
    )
    gains_file.save(mc.Gains(2.0, 30.0, 500.0, kp=45.0), gains)
    own = ["--metric", f"{mine}:highest", "--gains", gains]
    code, printed, _ = call("run", CONFIG, *SHORT, "--controller", "pd", *own, "--out", out)
    assert code == 0
    value = strict_json((out / "metrics.json").read_text())["highest_base"]
    walk = xr.load_dataset(out / "trajectory.nc", engine="h5netcdf")
    assert value == pytest.approx(walk["base_position"].values[:, 2].max())
    assert re.search(rf"highest base +{value:.4g} +m\b", printed)
    control = options.Walk(config=out / "config.yaml").load().scenario.control
    assert (control.inertia, control.damping, control.stiffness, control.kp) == (2.0, 30.0, 500.0, 45.0)


@pytest.mark.slow
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


@pytest.mark.slow
def test_run_survives_divergence(call, tmp_path):
    law = ["--set", "control.reading=measured_pose", "--set", "control.damping=1e7"]
    code, out, _ = call("run", CONFIG, *SHORT, *law, "--out", tmp_path)
    assert code == 1 and "diverged at 0." in out
    metrics = strict_json((tmp_path / "metrics.json").read_text())
    assert metrics["diverged"] is True
    assert re.search(r"force variation +failed", out)
    assert {metrics[name] for name in mc.METRICS.names if name not in FAILURES} == {None}


class _Called(Exception):
    """All rollouts that a test waits for were asked for."""


WITH_ENGINE = (
    "run", "run --compare pd", "sweep " + " ".join(GRID), "tune", "tune --ensemble ensemble --members 2",
    "evaluate --gains {files}/held.yaml --members 2", "tune --against base_deviation", "tune --over gravity,cargo",
    "evaluate --margins",
)  # fmt: skip


@pytest.mark.parametrize("engine", mc.ENGINES)
@pytest.mark.parametrize("command", WITH_ENGINE)
def test_engine_and_batch_size_reach_the_rollouts(command, engine, files, monkeypatch, tmp_path):
    asked, batch, beside = [], 4 if "sweep" in command else None, "--compare" in command

    def rollout(_, gains=None, *__, engine="the default", **___):
        asked.append((engine, None if batch is None else len(gains["stiffness"])))
        if beside and len(asked) == 1:  # the walk; the next one is what it is compared with
            return None
        raise _Called

    for name in ("rollout", "rollout_metrics", "rollout_histories"):
        monkeypatch.setattr(mc, name, rollout)
    monkeypatch.setattr(of_sweep, "begin", lambda *_: of_sweep.Begun(None, None))
    name, *options = command.format(files=files).split()
    with pytest.raises(_Called):
        main([name, CONFIG, *options, "--engine", engine, "--out", str(tmp_path / "out")])
    assert asked == [(engine, batch)] * (2 if beside else 1)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep by another process: (folder, standard output, standard error)."""
    out = tmp_path_factory.mktemp("swept")
    return out, *finish("sweep", CONFIG, *SHORT, *GRID, "--out", out, "--json")


@pytest.mark.nightly
def test_sweep_prints_json_alone_on_stdout_and_writes_grid_maps_and_config(swept):
    folder, out, err = swept
    found = strict_json(out)
    assert out.startswith("{")
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
    assert found["force_sensor"]["in_words"] in " ".join(err.split())
    for word in ("compil", "cache", "6 of 6 walks", "paper", "force variation", str(folder)):
        assert word in err
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.html", "sweep.nc", "config.yaml", "comparison.json", "maps.png", "settings.json"}
    result = xr.load_dataset(folder / "sweep.nc", engine="h5netcdf")
    np.testing.assert_allclose(result["stiffness"], [1e3, 1e4, 1e5])
    assert best_cell(result)["stiffness"].item() == found["best"]["gains"]["stiffness"]
    assert mc.load_scenario(folder / "config.yaml") == mc.load_scenario(CONFIG, ["duration=0.3"])


def same_grids(*folders):
    one, other = (xr.load_dataset(folder / "sweep.nc", engine="h5netcdf").drop_attrs() for folder in folders)
    xr.testing.assert_identical(one, other)


_FROM_PYTHON = f"""
import sys, numpy as np, mjx_climb as mc, tuning
from mjx_climb.viz import plots
def empty(figure, stem, _):
    stem.with_suffix(".png").touch()
    return [stem.with_suffix(".png")]
plots.save_figure = empty
axes = {{"stiffness": np.geomspace(1e3, 1e5, 3), "damping": np.geomspace(1e2, 1e3, 2)}}
found = tuning.sweep(mc.load_scenario({CONFIG!r}, ["duration=0.3"]), axes, batch_size=4, out=sys.argv[1])
print(tuning.write(found, sys.argv[1]).summary)
"""


@pytest.mark.nightly
def test_a_sweep_from_python_writes_what_the_command_writes(swept, tmp_path):
    command = [sys.executable, "-c", _FROM_PYTHON, str(tmp_path)]
    summary = subprocess.run(command, cwd=ROOT, env=environment(), check=True, stdout=subprocess.PIPE, text=True).stdout
    ours, theirs = ({str(path.relative_to(folder)) for path in folder.rglob("*")} for folder in (tmp_path, swept[0]))
    assert ours == theirs
    assert summary.strip() == swept[1].strip() == (tmp_path / "comparison.json").read_text().strip()
    same_grids(tmp_path, swept[0])


@pytest.mark.slow
@pytest.mark.nightly
def test_interrupted_sweep_keeps_its_parts_and_goes_on(call, swept, monkeypatch, tmp_path):
    walk, walked = mc.rollout_histories, []

    def stopped(scenario, gains, *robots, **options):
        walked.append(len(gains["stiffness"]))
        if len(walked) == 1:
            signal.raise_signal(signal.SIGTERM)
        return walk(scenario, gains, *robots, **options)

    command = ("sweep", CONFIG, *SHORT, *GRID, "--out", tmp_path)
    monkeypatch.setattr(mc, "rollout_histories", stopped)
    code, out, err = call(*command)
    assert (code, out) == (130, "")
    last = err.splitlines()[-1]
    assert last == (f"mjx-climb: interrupted: 4 of 6 walks are kept in {tmp_path}; the same command goes on from there")
    code, _, err = call("sweep", CONFIG, *SHORT, *GRID[:2], "--damping", "1:9:2", "--out", tmp_path)
    assert code == 2 and str(tmp_path) in err
    monkeypatch.setattr(plots, "save_figure", lambda *_: [])
    monkeypatch.setattr(page, "write", lambda _, folder: folder / "report.html")
    code, out, err = call(*command)
    # the config's gains and pd by the program of the grid, whose size they take; then what the grid lacks
    assert (code, walked) == (0, [4, 4, 2])
    assert "4 are there already" in err and "best of 6 walks, stiffness" in out
    same_grids(tmp_path, swept[0])


@pytest.mark.slow
def test_a_sweep_that_is_stopped_after_its_first_map_leaves_it(call, monkeypatch, tmp_path):
    """Map, table and page of the grid stand there as soon as it has walked; a line says what they lack."""
    values = {name: np.linspace(1.0, 2.0, 6) for name in mc.METRICS.names}
    values |= {"detached_limb": np.full(6, -1), "diverged": np.zeros(6, bool), "detached_at": np.full(6, np.nan)}
    values["stands_at"] = np.full(6, np.nan)
    values |= {name: np.ones((6, 2, 150), np.float32) for name in LINES}
    numbers = {name: each[3].item() for name, each in values.items() if name in mc.METRICS.names}
    pd = numbers | {"force_variation": 3.0, "detached_limb": None, "detached_at": None, "stands_at": None}

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Rows, "walk", lambda *_: values)
    monkeypatch.setattr(sweeps.Grid, "named", lambda _: {"config": pd, "pd": pd})
    monkeypatch.setattr(of_sweep, "begin", lambda *_: of_sweep.Begun(None, None))
    monkeypatch.setattr("tuning.pages.sweep.compare", stopped)
    code, out, err = call("sweep", CONFIG, *SHORT, *GRID, "--out", tmp_path)
    assert code == 130
    assert err.splitlines()[-1] == (
        f"mjx-climb: interrupted: {tmp_path} holds a result without pd retuned, the walks in double precision and "
        "the limit of stability; the same command goes on from there"
    )
    first = "not yet compared with pd retuned: best of 6 walks, stiffness "
    assert first in out and "1 N, 66.7 % less than the best rival that walked, the paper's gains: 3 N" in out
    page = (tmp_path / "report.html").read_text()
    assert f'<p class="verdict">N{first[1:]}' in page and "-66.7" in out
    found = {path.name for path in tmp_path.iterdir()}
    assert found >= {"sweep.nc", "maps.png", "comparison.json", "config.yaml", "report.html", "settings.json"}
    assert "are missing here" in (tmp_path / "report.html").read_text()
    assert strict_json((tmp_path / "comparison.json").read_text())["pd"]["metrics"]["force_variation"] == 3
    assert not json.loads((tmp_path / "settings.json").read_text())["whole"]
    # what is whole stays until all of the next result is there
    record = json.loads((tmp_path / "settings.json").read_text())
    (tmp_path / "settings.json").write_text(json.dumps(record | {"whole": True}))
    (tmp_path / "report.html").write_text("whole")
    assert call("sweep", CONFIG, *SHORT, *GRID, "--out", tmp_path)[0] == 130
    assert (tmp_path / "report.html").read_text() == "whole"


@pytest.mark.nightly
def test_sweep_in_which_all_fail(call, tmp_path):
    code, out, _ = call("sweep", CONFIG, *SHORT, *GRID, *WEAK, "--out", tmp_path, "--json")
    found = strict_json(out)
    assert (code, found["best"], found["grid"]["failed"]) == (0, None, 6)


def test_version_and_no_arguments(call):
    code, out, _ = call("--version")
    assert code == 0 and "mjx-climb" in out and "jax" in out
    code, out, _ = call()
    assert code == 0 and "sweep" in out


def test_ranges_are_even_on_a_logarithmic_scale():
    grid = made(sweep.Grid, {"stiffness": "1e2:1e6:5", "axis": {"kp": ("1", "4", "3")}})
    axes = grid.work(options.Walk(config=Path(CONFIG))).axes
    np.testing.assert_allclose(axes["stiffness"], [1e2, 1e3, 1e4, 1e5, 1e6])
    np.testing.assert_allclose(axes["kp"], [1, 2, 4])


@pytest.mark.parametrize(("count", "said"), [(1000, "; expect some 30 min, or spread them over machines"), (100, "")])
def test_a_long_sweep_says_before_how_long_it_takes(count, said, monkeypatch, capsys, tmp_path):
    """On a CPU; how long a GPU takes is not foretold."""

    def walk(*_):
        raise _Called

    monkeypatch.setattr(devices, "usable_cores", lambda: 2)
    monkeypatch.setattr(of_sweep, "begin", lambda *_: of_sweep.Begun(None, None))
    monkeypatch.setattr(Rows, "walk", walk)
    monkeypatch.setattr(jax, "devices", lambda *_: jax.local_devices(backend="cpu"))
    with pytest.raises(_Called):
        main(["sweep", CONFIG, "--stiffness", f"1:9:{count}", "--damping", f"1:9:{count}", "--out", str(tmp_path)])
    line = next(line for line in capsys.readouterr().err.splitlines() if "walks (" in line)
    sizes = f"{count**2} walks ({count} stiffness x {count} damping)"
    assert f"{sizes} of 8000 steps on {jax.devices()[0].device_kind}{said}" in line
    assert ("expect" in line) == bool(said)


def test_time_left_counts_only_what_is_done_since_the_last_compilation():
    estimate = session.Estimate(since=0.0)
    assert estimate.update(40, 100, now=1.0) is None  # found on disk
    assert estimate.update(50, 100, now=5.0) == pytest.approx(25.0)
    estimate.compiled(now=11.0)
    assert estimate.update(60, 100, now=13.0) == pytest.approx(8.0)
    assert estimate.update(100, 100, now=17.0) == 0


def test_what_the_compiler_spent_is_told_apart_and_counted_once():
    with session.Compilation() as watched:
        watched.since -= 9.0
        monitoring.record_event_duration_secs(session.TRACED, 1.0)
        monitoring.record_event_duration_secs(session.TRACED, 4.0)  # around the first, and over now
        watched.since -= 7.4
        monitoring.record_event_duration_secs(session.COMPILED, 2.0)  # the rest was something else
        watched.since -= 5.0
        monitoring.record_event(session.FROM_CACHE)
        monitoring.record_event_duration_secs(session.COMPILED, 0.5)
    expected = {"tracing": 1.0, "compiling": 2.0, session.LOADING: 0.5}
    assert watched.seconds == pytest.approx(expected, abs=0.2)
    assert str(watched) == f"1.0 s tracing and 2.0 s compiling and 0.5 s {session.LOADING}"


def test_a_hit_in_one_thread_is_not_taken_for_the_compilation_of_another():
    """Programs are compiled side by side: with an empty cache all seconds of the compiler are compiling."""
    with session.Compilation() as watched, ThreadPoolExecutor(1) as other:
        other.submit(monitoring.record_event, session.FROM_CACHE).result()
        watched.since -= 3.0
        monitoring.record_event_duration_secs(session.COMPILED, 3.0)
    assert watched.seconds == pytest.approx({"compiling": 3.0})


def test_long_names_in_a_head_break_behind_their_underscores():
    assert session.broken("case_1_2_best") == "case_1_2_\nbest"
    assert session.broken("robust_from_long_search") == "robust_from_\nlong_search"
    assert [session.broken(name) for name in ("retuned_pd", "vs retuned_pd %")] == ["retuned_pd", "vs retuned_pd %"]


def test_numbers_in_tables_and_json():
    assert numbers.change(2.0, 1.0) == "+100"
    assert numbers.change(0.5, 1.0) == "-50.0"
    assert numbers.change(None, 1.0) == numbers.change("LF", 1.0) == numbers.change(1.0, 0.0) == ""
    text = numbers.to_json({"a": np.float32("nan"), "b": np.int32(3), "c": [np.inf, True]})
    assert strict_json(text) == {"a": None, "b": 3, "c": [None, True]}


def test_configs_that_come_with_the_program_are_found_by_name(call, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    scenario = options.scenario_from(Path("case_2"), {"duration": 0.3})
    assert scenario == mc.load_scenario(ROOT / "configs" / "case_2.yaml", ["duration=0.3"])
    code, _, err = call("run", "case_9")
    expected = "case_9: expected a file, or a config that comes with the program (case_1_1, case_1_2, case_2"
    assert (code, expected in err) == (2, True)
    (tmp_path / "case_2").write_text("duration: -1")  # a file of one's own comes first
    code, _, err = call("run", "case_2")
    assert (code, "case_2: duration: expected" in err) == (2, True)


@pytest.mark.parametrize(
    ("options", "gravity"),
    [([], (0, 0, -9.81)), (["--slope", "90"], (-9.81, 0, 0)), (["--roof"], (0, 0, 9.81))],
)
def test_run_turns_gravity_as_it_is_told(options, gravity, monkeypatch, tmp_path):
    """Its strength stays the config's; nothing is walked here."""
    walked = []

    def refuse(scenario, **_):
        walked.append(scenario.gravity)
        raise mc.ConfigError("enough")

    monkeypatch.setattr(mc, "rollout", refuse)
    with pytest.raises(SystemExit):
        main(["run", "case_1_2", "--set", "gravity=[0,0,-9.81]", "--out", str(tmp_path / "out"), *options])
    assert walked == [pytest.approx(gravity)]


@pytest.mark.parametrize(
    "text",
    [
        "import sys\nsys.exit(0)",
        "from mjx_climb.control import PD\nclass Mine(PD):\n    def __init__(self): exit(0)",
        "exit()",
    ],
)
def test_a_file_of_ones_own_does_not_end_the_program_as_if_all_were_done(text, call, tmp_path):
    (tmp_path / "own.py").write_text(text)
    code, out, err = call("run", CONFIG, "--law", f"{tmp_path}/own.py:Mine", "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1) and ("SystemExit" in err or "sys.exit(0)" in err)


def test_a_rival_of_a_file_has_its_joint_gains_and_gait(tmp_path):
    file = tmp_path / "pd.yaml"
    file.write_text("law: PD\nkp: 20.0\nkd: 0.5\ngait: {duty: 0.8}\n")
    assert evaluate.Rival(retuned_pd=file).joint_gains() == {"kp": 20.0, "kd": 0.5, "gait.duty": 0.8}


@pytest.mark.parametrize(("command", "there"), [("run", True), ("runs", False)])
def test_a_key_that_is_typed_as_an_option_is_looked_for_where_keys_can_be_set(command, there, call):
    code, _, said = call(command, "--disturbance.cargo.mass=3")
    assert (
        code == 2
        and "No such option: --disturbance.cargo.mass" in said
        and ("--set disturbance.cargo.mass=" in said) is there
    )


LOG = {"log": "log.csv", "fit": ["control.kp"]}
EDGES = {  # of an option: its model with what that needs, the last values that it takes, and the first that it does not
    "slope": (options.Walk, {"config": "a"}, ["0", "180"], ["-0.1", "180.1"]),
    "members": (options.Members, {}, ["1"], ["0"]),
    "test_members": (tune.Many, {}, ["1"], ["0"]),
    "seeds": (tune.Laws, {}, ["1", "100"], ["0", "101"]),
    "held_out": (logs.Fitted, LOG, ["0", "0.8"], ["-0.1", "0.81"]),
    "starts": (logs.Fitted, LOG, ["1", "64"], ["0", "65"]),
    "mass": (logs.Fitted, LOG, ["0"], ["-0.001", "inf"]),
    "push_draws": (evaluate.Pushes, {}, ["8"], ["7"]),
    "largest_push": (evaluate.Pushes, {}, ["1e-9"], ["0", "inf"]),
    "push_length": (evaluate.Pushes, {}, [["1e-9", "2"]], [["0"], ["1", "-1"]]),
    "batch": (machine.Bench, {}, ["64"], ["63"]),
    "dpi": (results.Plot, {"folder": "a"}, ["20", "2400"], ["19", "2401"]),
    "figure_size": (
        results.Plot, {"folder": "a"}, ["10.16x2540", "2540X10.16"],
        ["10.1x100", "100x10.1", "2541x100", "100x2541", "100", "100x100x100", "ax100"],
    ),
    "rate": (results.Export, {"gains": "a"}, ["1", "1000000"], ["0", "1000001"]),
    "name": (results.Export, {"gains": "a"}, ["_a1"], ["1a", "a-b", "\u00e9"]),
    "batch_size": (sweep.Grid, {"axis": {"kp": ["1", "2", "2"], "kd": ["1", "2", "2"]}}, ["1"], ["0"]),
    "stiffness": (
        sweep.Grid, {"axis": {"kp": ["1", "2", "2"]}}, ["1e-30:1e30:2", "1:2:100000"],
        ["0.9e-30:1:2", "1:1.1e30:2", "1:2:1", "1:2:100001", "1:1:2", "2:1:2", "1:2"],
    ),
    "size": (
        run.Pictures, {}, ["64x4096", "4096X64"],
        ["62x64", "64x62", "64x4098", "4098x64", "65x64", "64x65", "64", "64x64x64"],
    ),
    "duration": (Excitation, {}, ["2", "600"], ["1.9", "601"]),
    "high": (Excitation, {"low": "0.5"}, ["0.51"], ["0.5", "0.4"]),
    "margin": (Excitation, {}, ["1", "1e-9"], ["0", "1.01"]),
    "candidates": (Excitation, {}, ["1", "256"], ["0", "257"]),
    "seed": (Excitation, {}, ["0", "2147483647"], ["-1", "2147483648"]),
    "noise": (Excitation, {}, ["1e-12"], ["0"]),
    "kp": (Excitation, {}, [["1e-9"]], [["0"], ["1", "-1"]]),
}  # fmt: skip


@pytest.mark.parametrize("name", EDGES)
def test_an_option_takes_values_up_to_its_edges_and_none_beyond(name):
    model, needed, taken, refused = EDGES[name]
    for value in taken:
        found = getattr(made(model, needed | {name: value}), name)
        numbers = (
            [float(part) for part in re.split("[xX:]", value)] if isinstance(value, str) and name != "name" else []
        )
        if name == "figure_size":
            numbers = [number / 25.4 for number in numbers]
        assert numbers == [] or np.ravel(found).tolist() == pytest.approx(numbers)
    for value in refused:
        with pytest.raises(InputError, match=f"--{'update-' * (name == 'rate')}{name.replace('_', '-')}"):
            made(model, needed | {name: value})


def test_only_a_held_base_is_moved_limb_by_limb_dropped_and_weighed():
    for name, value in {"kp": ["40"], "mass": "0.1", "drop": True, "limb_by_limb": True}.items():
        made(Excitation, {name: value})
        with pytest.raises(InputError, match=f"--{name.replace('_', '-')}: expected none with base free"):
            made(Excitation, {name: value, "base": "free"})


@pytest.mark.parametrize("value", ["1", "True", "YES", "on"])
def test_no_walk_is_begun_without_the_compiler_but_help_is_given(value, call, monkeypatch):
    monkeypatch.setenv("JAX_DISABLE_JIT", value)
    code, _, err = call("run", "nowhere")
    assert (code, "JAX_DISABLE_JIT: expected 0" in err, repr(value) in err) == (2, True, True)
    assert call("run", "--help")[0] == 0
    monkeypatch.setenv("JAX_DISABLE_JIT", "off")
    assert "nowhere: expected a file" in call("run", "nowhere")[2]


def test_a_length_of_time_is_said_as_a_person_does():
    said = {0.04: "0.0 s", 1.25: "1.2 s", 9.94: "9.9 s", 10.4: "10 s", 119.4: "119 s", 120.0: "2 min",
            7140.0: "119 min", 7169.0: "119 min", 7171.0: "2 h 0 min", 9000.0: "2 h 30 min"}  # fmt: skip
    assert {seconds: session.duration(seconds) for seconds in said} == said


def test_the_compiler_is_told_of_where_it_took_a_tenth_of_a_second():
    watched = session.Compilation()
    watched.seconds = {"tracing": 0.09, "compiling": 0.11}
    assert str(watched) == "0.1 s compiling"


def test_the_time_of_a_sweep_is_that_of_the_walks_that_are_not_there(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 2)
    monkeypatch.setattr(jax, "devices", lambda *_: jax.local_devices(backend="cpu"))
    grid = made(sweep.Grid, {"stiffness": "1:9:1000", "damping": "1:9:1000"})
    work = grid.work(options.Walk(config=Path(CONFIG)))
    assert [len(grid.said(work, 10**6, there)) for there in (0, 10**6 - 5)] == [2, 1]


def test_operating_points_have_the_strength_of_a_gravity_that_leans():
    scenario = mc.Scenario().with_overrides({"gravity": [3.0, 0.0, -4.0], "disturbance.cargo.mass": 0.5})
    assert tune.Over(over=("cargo=1,2",)).points(scenario).gravity == pytest.approx((5 / 9.80665,), rel=1e-3)
    assert tune.Over(over=("gravity=1,2",)).points(scenario).cargo == (0.5,)


def test_up_to_twelve_snapshots_are_taken_from_the_first_to_the_last_instant(monkeypatch):
    monkeypatch.setattr("mjx_climb.viz.rendering.backend.find", lambda: "egl")
    scenario = mc.load_scenario(CONFIG)
    run.Pictures(at=",".join(["0", *["8"] * 11]), snapshots=True).check(scenario)
    with pytest.raises(InputError, match="--at: expected --snapshots beside it"):
        run.Pictures(at="1").check(scenario)


def test_gains_must_hold_in_the_config_that_is_given_or_the_one_beside_them(tmp_path):
    gains_file.save(mc.Gains(1.0, 100.0, 1000.0), gains := tmp_path / "gains.yaml")
    (tmp_path / "config.yaml").write_text(mc.load_scenario(CONFIG, {"duration": 0.7}).to_yaml())
    beside = results.Export(gains=gains).scenario(None)
    assert beside.duration == 0.7 and beside.control.integration == "exact"
    other = results.Export(gains=gains, config=Path(CONFIG), form="admittance_control").scenario(None)
    assert other.duration == 8.0 and other.control.integration == "semi_implicit"
    periods = [results.Export(gains=gains, rate=rate).scenario(None).hardware.control_period for rate in (1000, 500)]
    assert periods == [0.0, 0.002]
    (tmp_path / "config.yaml").write_text(mc.load_scenario(CONFIG, {"control.reading": "measured_pose"}).to_yaml())
    assert results.Export(gains=gains, form="json").scenario(None).control.reading == "measured_pose"
    for form in results.ROBOTS_OWN:
        with pytest.raises(mc.ConfigError, match=r"control.reading: expected virtual_model"):
            results.Export(gains=gains, form=form).scenario(None)


def test_gains_of_the_other_reading_go_into_tables_alone(call, tmp_path):
    text = "law: MeasuredPoseAdmittance\ninertia: 1\ndamping: 100\nstiffness: 1e3\n"
    (tmp_path / "gains.yaml").write_text(text)
    for form in ("json", "csv", *results.ROBOTS_OWN):
        code, _, err = call("export", tmp_path / "gains.yaml", "--format", form)
        assert (code, "law: expected VirtualModelAdmittance" in err) == (
            (2, True) if form in results.ROBOTS_OWN else (0, False)
        )


def test_a_folder_is_named_after_law_and_hardware_and_has_a_digest_where_more_differs():
    walk = options.Walk(config=Path("case_1_2"))
    assert (walk.words, walk.varied) == ((), False)
    named = walk.model_copy(update={"controller": "pd", "law": "a/my-law.py:My Law", "hardware": "mine/servo.yaml"})
    assert (named.words, named.varied) == (("pd", "My_Law", "servo"), False)
    for name, value in {
        "roof": True, "slope": 0.0, "changes": ("a=1",), "gains": Path("a"), "contact": "a", "drive": "a",
        "disturbances": ("a",),
    }.items():  # fmt: skip
        other = walk.model_copy(update={name: value})
        assert (other.words, other.varied) == ((), True), name


def test_joint_gains_may_be_set_beside_a_law_of_ones_own(files):
    mine = options.Walk(config=Path(CONFIG), law=f"{files}/law.py:Mine", changes=("control.kp=60",)).load()
    assert mine.scenario.control.kp == 60.0 and type(mine.law).__name__ == "Mine"
    other = options.Walk(config=Path(CONFIG), law=f"{files}/law.py:Mine", changes=("control.damping=70",)).load()
    assert np.ravel(other.law.damping)[0] == 70.0


def test_programs_are_loaded_ahead_that_the_command_needed_for_this_config(monkeypatch):
    asked, begun = [], []

    @contextlib.contextmanager
    def loading_ahead(name):
        asked.append(name)
        yield

    monkeypatch.setattr("mjx_climb.execution.cache.loading_ahead", loading_ahead)
    monkeypatch.setattr("mjx_climb.execution.devices.begin", lambda: begun.append(1))
    token = ARGUMENTS.set(("run", "case_2", "--json"))
    try:
        with processes.devices_begun():
            assert (asked, begun) == (["run case_2"], [1])
    finally:
        ARGUMENTS.reset(token)


def test_walkers_without_recovery_walk_beside_those_that_recover():
    recovering = options.Walk(config=Path(CONFIG), changes=("control.recovery.shift=0.02",)).load()
    walkers = evaluate.Pushes().walkers(recovering)
    assert {name: each.parameters.recovery is None for name, each in walkers.items()} == {
        "config": False, "config, no recovery": True, "pd": False, "pd, no recovery": True
    }  # fmt: skip
    assert list(evaluate.Pushes().walkers(options.Walk(config=Path(CONFIG)).load())) == ["config", "pd"]


def test_formats_are_named_in_any_case_and_each_is_drawn_once():
    assert made(options.Output, {"figures": "PNG, svg,png"}).figures == ("png", "svg")


def test_a_report_names_files_without_the_folders_of_one_machine():
    token = ARGUMENTS.set(
        ("run", "~/a/b.yaml", "--gains=/x/y.yaml", r"C:\c\d.csv", "e/f.yaml", "/g/h/", "--set", "a=b/c")
    )
    try:
        found = origin("mine", "again")
    finally:
        ARGUMENTS.reset(token)
    assert found.asked == "mjx-climb run b.yaml --gains=y.yaml d.csv e/f.yaml h --set a=b/c"
    assert (found.name, found.again) == ("mine", "again")
