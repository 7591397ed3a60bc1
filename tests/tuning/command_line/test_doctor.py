"""The program's look at its own installation: sound where it is, and every kind of damage seen."""

import importlib.metadata
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from mjx_climb.viz.rendering import RenderingError, backend
from tuning.benchmarks import self_check
from tuning.command_line import machine

ROOT = Path(__file__).parents[3]
PARTS = ["versions", "devices", "cache", "path", "renderer", "dynamics", "walk", "gradient"]


@pytest.fixture
def doctor(monkeypatch, call):
    """Run the program as on a machine with OpenGL that computes what is stored: (exit code, parsed JSON)."""
    stored = self_check.load()
    engines = dict.fromkeys(["limb", "mjx", "mujoco"], stored.pop("acceleration"))
    monkeypatch.setattr(self_check, "measure", lambda: stored | engines)
    monkeypatch.setattr(backend, "find", lambda: "egl")
    chosen = jax.config.jax_compilation_cache_dir  # by an earlier test of this process
    jax.config.update("jax_compilation_cache_dir", None)

    def run():
        code, out, _ = call("doctor", "--json")
        return code, json.loads(out)

    yield run
    jax.config.update("jax_compilation_cache_dir", chosen)


def wrong(found):
    return {name: part["findings"] for name, part in found["parts"].items() if part["findings"]}


def test_all_is_well(doctor):
    code, found = doctor()
    assert (code, found["sound"], wrong(found)) == (0, True, {})
    assert list(found["parts"]) == PARTS
    assert found["parts"]["versions"]["jax"] == importlib.metadata.version("jax")
    assert found["parts"]["devices"]["cores"] >= 1
    assert found["verdict"].startswith("All is well")


A_LITTLE = "a hundred millionth"


@pytest.mark.parametrize(
    ("part", "name", "value", "seen_in"),
    [
        ("walk", "force_variation", A_LITTLE, "walk"),
        ("gradient", "peak_foot_force", A_LITTLE, "gradient"),
        ("acceleration", "LF tibia", A_LITTLE, "dynamics"),
        # what is no number is compared too
        ("walk", "diverged", True, "walk"),
        ("walk", "detached_limb", "LF", "walk"),
        ("walk", "travel", None, "walk"),
        ("walk", "force_variation", math.nan, "walk"),
    ],
)
def test_a_value_that_is_off_is_seen(doctor, monkeypatch, part, name, value, seen_in):
    stored = self_check.load()
    stored[part][name] = stored[part][name] * (1 + 1e-8) if value is A_LITTLE else value
    monkeypatch.setattr(self_check, "load", lambda: stored)
    code, found = doctor()
    assert (code, found["sound"], list(wrong(found))) == (1, False, [seen_in])
    assert found["verdict"] == f"Something is wrong with {seen_in}."
    if value is A_LITTLE:
        assert name in found["parts"][seen_in]["findings"][0]
    else:
        assert found["parts"]["walk"]["deviation"] == {"walk": None}


def no_opengl():
    raise RenderingError("expected OpenGL, install libegl1")


def without_plugins(name, version=importlib.metadata.version):
    if name.endswith("-plugin"):
        raise importlib.metadata.PackageNotFoundError
    return version(name)


@pytest.mark.parametrize(
    ("damage", "setting", "part", "said", "cured"),
    [
        (
            {
                (machine, "NVIDIA"): ROOT, (jax, "default_backend"): lambda: "cpu",
                (importlib.metadata, "version"): without_plugins,
            },
            ("JAX_PLATFORMS", ""), "devices", "mjx-climb[cuda13]", "cpu",
        ),
        ({}, ("MJX_CLIMB_CACHE", f"{__file__}/cache"), "cache", "MJX_CLIMB_CACHE", "off"),
        ({(backend, "find"): no_opengl}, ("MUJOCO_GL", ""), "renderer", "install", "off"),
    ],
)  # fmt: skip
def test_what_a_machine_lacks_is_seen_and_what_is_switched_off_is_fine(
    doctor, monkeypatch, damage, setting, part, said, cured
):
    """A GPU that JAX does not use, a cache that cannot be written, no renderer."""
    for (module, name), value in damage.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setenv(*setting)
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, [part])
    assert said in found["parts"][part]["findings"][0]
    assert part != "cache" or found["parts"]["cache"]["writable"] is False
    monkeypatch.setenv(setting[0], cured)
    assert doctor()[0] == 0


WHOLE = dict.fromkeys(["mujoco", "mujoco-core", "mujoco-studio"], "4.0.0") | {"mujoco-mjx": "3.17.0"}
AGAIN = 'python -m pip uninstall -y mujoco mujoco-core mujoco-studio; python -m pip install "mujoco=='
CHANGED = "as a change of release in place leaves it"


@pytest.mark.parametrize(
    ("changed", "lost", "finding"),
    [
        ({}, [], None),
        # an upgrade in place from 3.17, and a downgrade
        ({}, ["mujoco-core", "mujoco-studio"], f"4.0.0, 2 of 4 files lost, {CHANGED}: {AGAIN}4"),
        ({"mujoco": "3.17.0"}, [], f"{AGAIN}3.17.0"),
        ({"mujoco-core": "4.0.1"}, [], "mujoco 4.0.0 beside mujoco-core 4.0.1, mujoco-studio 4.0.0, 0 of 4 files lost"),
        (dict.fromkeys(WHOLE, "5.0.0") | {"mujoco-mjx": "3.17.0"}, [], 'pip install "mujoco>=3.17,<5"'),
        (dict.fromkeys(WHOLE, "3.16.0") | {"mujoco-mjx": "3.17.0"}, [], 'pip install "mujoco>=3.17,<5"'),
        ({"mujoco-mjx": "3.18.0"}, [], 'mujoco-mjx 3.18.0: python -m pip install "mujoco-mjx==3.17.*"'),
    ],
)
def test_a_mujoco_that_is_damaged_or_not_known_to_work_is_seen(doctor, monkeypatch, tmp_path, changed, lost, finding):
    """Installed packages: each has one file, and a compiled one that may be gone; the first has two."""
    for name, version in (WHOLE | changed).items():
        about, module = (tmp_path / f"{name.replace('-', '_')}{end}" for end in (f"-{version}.dist-info", ".py"))
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        files = [module.name, f"{module.stem}.pyc", *([f"{about.name}/METADATA"] if name == "mujoco" else [])]
        (about / "RECORD").write_text("".join(f"{file},,\n" for file in files))
        if name not in lost:
            module.touch()
    monkeypatch.syspath_prepend(tmp_path)
    code, found = doctor()
    assert (code, list(wrong(found))) == ((0, []) if finding is None else (1, ["versions"]))
    assert found["parts"]["versions"]["mujoco-core"] == (WHOLE | changed)["mujoco-core"]
    assert finding is None or finding in found["parts"]["versions"]["findings"][0]


def test_the_releases_of_mujoco_that_doctor_knows_are_those_that_are_installed():
    packages = (ROOT / "pyproject.toml").read_text()
    (low, high), mjx = machine.MUJOCO, ".".join(map(str, machine.MJX))
    assert f'"mujoco>={low[0]}.{low[1]},<{high[0]}"' in packages
    assert f'"mujoco-mjx=={mjx}.0"' in packages


def test_a_mujoco_that_cannot_be_imported_is_one_line(tmp_path):
    """As the missing parts of MuJoCo 4 are; in a process of its own, where it is not imported yet."""
    (tmp_path / "mujoco.py").write_text("raise ImportError('its core is missing or corrupted. Repair it')")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    command = [sys.executable, "-m", "tuning.command_line", "run", "case_2"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    said = "mjx-climb: error: mujoco: its core is missing or corrupted; mjx-climb doctor says what to do\n"
    assert (done.returncode, done.stderr) == (2, said)


def test_the_cache_is_counted(doctor, monkeypatch, tmp_path):
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    (tmp_path / "jit_walk-1-cache").write_bytes(bytes(2_600_000))
    (tmp_path / "programs").mkdir()
    (tmp_path / "programs" / "0d21").write_bytes(bytes(500))
    code, found = doctor()
    assert code == 0
    cache = {"on": True, "folder": str(tmp_path), "programs": 2, "bytes": 2_600_500, "writable": True, "findings": []}
    (part,) = machine.cache()
    assert part.text == f"{tmp_path}, 2 programs, 3 MB"
    assert found["parts"]["cache"] == cache


def test_a_part_that_breaks_down_is_a_finding_beside_the_others(monkeypatch, doctor):
    def devices():
        raise RuntimeError("no\nplugin")

    monkeypatch.setattr(machine, "devices", devices)
    monkeypatch.setattr(self_check, "measure", lambda: 1 / 0)
    code, found = doctor()
    assert code == 1
    assert wrong(found) == {
        "devices": ["RuntimeError: no plugin"],
        "simulation": ["ZeroDivisionError: division by zero"],
    }
    assert found["verdict"] == "Something is wrong with devices and simulation."


def test_an_engine_that_has_no_value_is_seen(doctor, monkeypatch):
    """And a walk that has none; a metric that is not stored, of a later version or the user's, is not compared."""
    measured = self_check.measure()
    measured["mjx"] = {key: value for key, value in measured["mjx"].items() if key != "LF tibia"}
    measured["walk"] = measured["walk"] | {"travel": None}
    measured["gradient"] = measured["gradient"] | {"jerk": 1.0}
    monkeypatch.setattr(self_check, "measure", lambda: measured)
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["dynamics", "walk"])
    assert found["parts"]["dynamics"]["findings"] == [
        f"mjx: LF tibia is None, stored is {self_check.load()['acceleration']['LF tibia']}"
    ]


@pytest.mark.nightly
def test_this_code_computes_what_is_stored(tmp_path):
    """In a process of its own; `python -m tuning.benchmarks.self_check` stores the values anew."""
    environment = os.environ | {"MJX_CLIMB_CACHE": str(tmp_path)}
    command = [sys.executable, "-m", "tuning.command_line", "doctor"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stderr == ""
    assert [line.split()[0] for line in done.stdout.splitlines() if line[:1].islower()] == PARTS
    verdict = done.stdout.splitlines()[-1]
    sound = done.returncode == 0 and verdict.startswith("All is well")
    assert sound or verdict.startswith("Something is wrong with renderer."), done.stdout  # a machine without OpenGL
    assert list(tmp_path.glob("*-cache"))


@pytest.mark.parametrize("missing", machine.PACKAGES)
def test_a_package_that_is_not_installed_is_seen(missing, doctor, monkeypatch):
    def version(name, version=importlib.metadata.version):
        if name == missing:
            raise importlib.metadata.PackageNotFoundError
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    code, found = doctor()
    assert (code, wrong(found)["versions"]) == (1, [f"{missing} is not installed: python -m pip install mjx-climb"])


def test_a_gpu_that_is_used_needs_no_plugin(doctor, monkeypatch):
    monkeypatch.setattr(machine, "NVIDIA", ROOT)
    monkeypatch.setattr(importlib.metadata, "version", without_plugins)
    monkeypatch.setenv("JAX_PLATFORMS", "")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    (part,) = machine.devices()
    assert part.findings == []
