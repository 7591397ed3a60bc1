"""Commands from start to end: all that they print and leave, against texts that were read once.

Walks of 0.3 s are a whole cycle of the gait: each foot leaves the ground once, and grips again.
"""

import shlex
from pathlib import Path

import pytest

import mjx_climb as mc
from tests import approved, left

pytestmark = pytest.mark.slow
HERE = Path(__file__).parent / "approved"
BASE = (
    "case_1_2 --set duration=0.3 --set gait.cycle=0.3 --set gait.stride=0.01 --set gait.step_height=0.005 "
    "--set disturbance.cargo.start=0.1 --figures svg"
)
FILES = {
    "six.yaml": "inertia: 2.0\ndamping: [800, 800, 900, 5, 5, 6]\nstiffness: [2e3, 3e3, 4e3, 20, 20, 30]\n"
    "kp: 60.0\nkd: 0.3\n",
    "two.yaml": "law: VirtualModelAdmittance\ninertia: [2, 2, 2, 0.1, 0.1, 0.1]\n"
    "damping: [800, 800, 800, 5, 5, 5]\nstiffness: [2e3, 2e3, 2e3, 20, 20, 20]\nkp: 60.0\nkd: 0.3\n"
    "gait: {duty: 0.8, cycle: 0.3}\n",
    "thick.mplstyle": "lines.linewidth: 3\naxes.linewidth: 2\n",
    "joint.yaml": "law: PD\nkp: 80.0\nkd: 0.25\n",
    "few.yaml": "members: 3\nseed: 4\npushes: {count: 1, force: [1.0, 4.0], start: [0.05, 0.1], length: [0.05, 0.1]}\n"
    "cargo: {mass: [0.5, 1.5], start: [0.05, 0.15]}\ngravity: {scale: [0.8, 1.2], slope: [0.0, 20.0]}\n"
    "grip_stiffness: [0.5, 2.0]\nrobot_mass: [0.9, 1.1]\nhardware: null\nworst: {share: 0.5, weight: 0.25}\n",
}
COMMANDS = {
    "tune": "tune {base} --set contact.holding_limit=5 --starts 3 --iterations 2 --bound stiffness=1e3:1e5 "
    "--bound damping=10:1000 --limit base_deviation=0.0017 --seeds 2",
    "tune_many": "tune {base} --method cmaes --space split --with-inertia --with-joint-gains "
    "--pin damping.rotation=500 --bound kp=30:90 --starts 6 --iterations 3 --may-be-worse-than-pd "
    "--weight peak_pull_force=2 --weight travel=0.5 --limit min_gia_margin=6.3 --deviation-factor 1.05 --seed 3",
    "robust": "tune {base} --ensemble {files}/few.yaml --test-members 4 --starts 2 --iterations 2",
    "sweep": "sweep {base} --stiffness 1e2:1e7:4 --damping 1e0:1e4:3 --set contact.holding_limit=5 "
    "--gains {files}/six.yaml",
    "evaluate": "evaluate {base} --gains {files}/six.yaml --retuned-pd {files}/joint.yaml --members 6 "
    "--ensemble {files}/few.yaml",
    "margins": "evaluate {base} --gains {files}/six.yaml --margins",
    "margins_of": "evaluate {base} --margins --margin contact.damping=x0.01 --margin control.kd=0.3 "
    "--retuned-pd {files}/joint.yaml",
    "worse": "evaluate {base} --gains {files}/six.yaml --worse contact.damping=x0.1 --worse contact.stiffness=x3 "
    "--members 4 --retuned-pd {files}/joint.yaml",
}

LONG = ("robust", "tune_many")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a folder with the gains and the ensemble that commands are given."""
    folder = tmp_path_factory.mktemp("given")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def said(call, files, tmp_path, monkeypatch):
    """Run a command in a folder of its own; return all that it prints, and the files of one folder, as lines."""
    monkeypatch.chdir(tmp_path)

    def said(line, folder=None):
        ended = call(*shlex.split(line.format(base=BASE, files=files)))
        return left.of_command(*ended, None if folder is None else tmp_path / folder, files, tmp_path)

    return said


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.nightly) if name in LONG else name for name in COMMANDS]
)
def test_a_command_leaves_what_was_read(name, said):
    approved.check_numbers(HERE / f"{name}.txt", said(f"{COMMANDS[name]} --out out", "out"))


def test_shards_of_a_sweep_are_merged_and_drawn_and_listed(said, tmp_path):
    """Of shards in two places; a style sheet changes what it names alone."""
    grid = "sweep {base} --axis contact.damping=1:20:3 --axis gait.duty=0.75:0.85:2 --batch-size 2 --roof"
    lines = [said(f"{grid} --shard 2/2 --out one"), said(f"{grid} --shard 1/2 --out other")]
    lines += [said("sweep --merge one --merge other --out both", "both"), said("runs both")]
    lines.append(said("plot both --metric min_tsm --out drawn --figures svg --style {files}/thick.mplstyle", "drawn"))
    lines += [f"{file.name}: {left.look_of(file.read_text())}" for file in sorted((tmp_path / "drawn").iterdir())]
    approved.check_numbers(HERE / "sweep_shards.txt", "\n".join(lines) + "\n")


def test_gains_are_exported_in_every_form(said, files):
    """Those of a config walk first."""
    lines = [
        said(f"export {{files}}/{file} --format {form}")
        for file, form in (
            ("six.yaml", "ros2_control --update-rate 2000 --name mine"), ("six.yaml", "json"), ("two.yaml", "csv"),
            ("two.yaml", "admittance_control --update-rate 500"), ("six.yaml", "admittance_control"),
        )
    ]  # fmt: skip
    changes = [word for word in shlex.split(BASE) if "=" in word]
    (files / "base.yaml").write_text(mc.load_scenario("case_1_2", changes).to_yaml())
    lines.append(said("export {files}/two.yaml --config {files}/base.yaml --format admittance_control"))
    approved.check_numbers(HERE / "export.txt", "\n".join(lines))
