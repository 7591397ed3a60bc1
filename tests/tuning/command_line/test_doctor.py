"""The program's look at its own installation: sound where it is, and every kind of damage seen."""

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from mjx_climb.checks import self_check
from mjx_climb.rendering import RenderingError, backend
from tuning.command_line import machine, main

ROOT = Path(__file__).parents[3]
PARTS = ["versions", "devices", "cache", "path", "renderer", "dynamics", "walk", "gradient"]


@pytest.fixture
def doctor(monkeypatch, capsys):
    """Run the program as on a machine with OpenGL that computes what is stored: (exit code, parsed JSON)."""
    stored = self_check.load()
    engines = dict.fromkeys(["limb", "mjx", "mujoco"], stored.pop("acceleration"))
    monkeypatch.setattr(self_check, "measure", lambda: stored | engines)
    monkeypatch.setattr(backend, "find", lambda: "egl")
    chosen = jax.config.jax_compilation_cache_dir  # by an earlier test of this process
    jax.config.update("jax_compilation_cache_dir", None)

    def run():
        with pytest.raises(SystemExit) as ended:
            main(["doctor", "--json"])
        return ended.value.code, json.loads(capsys.readouterr().out)

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


def test_a_gpu_that_jax_does_not_use_is_seen(doctor, monkeypatch, tmp_path, cpu_alone):
    monkeypatch.setattr(machine, "NVIDIA", tmp_path)
    installed = machine.versions_of
    plugins = ("jax-cuda12-plugin", "jax-cuda13-plugin")
    monkeypatch.setattr(machine, "versions_of", lambda *names: installed(*names) | dict.fromkeys({*names} & {*plugins}))
    monkeypatch.setenv("JAX_PLATFORMS", "")
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["devices"])
    assert "mjx-climb[cuda13]" in found["parts"]["devices"]["findings"][0]
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert doctor()[0] == 0


def test_a_cache_folder_that_cannot_be_written_is_seen(doctor, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path / "file" / "cache"))
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["cache"])
    assert found["parts"]["cache"]["writable"] is False
    assert "MJX_CLIMB_CACHE" in found["parts"]["cache"]["findings"][0]


def test_the_cache_is_counted(doctor, monkeypatch, tmp_path):
    monkeypatch.setenv("MJX_CLIMB_CACHE", str(tmp_path))
    (tmp_path / "jit_walk-1-cache").write_bytes(bytes(1000))
    code, found = doctor()
    assert code == 0
    cache = {"on": True, "folder": str(tmp_path), "programs": 1, "bytes": 1000, "writable": True, "findings": []}
    assert found["parts"]["cache"] == cache


def test_no_renderer_is_seen_and_one_switched_off_is_fine(doctor, monkeypatch):
    def none():
        raise RenderingError("expected OpenGL, install libegl1")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(backend, "find", none)
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["renderer"])
    assert "install" in found["parts"]["renderer"]["findings"][0]
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert doctor()[0] == 0


def test_two_releases_of_mujoco_are_seen(doctor, monkeypatch):
    version = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.0.0" if name == "mujoco" else version(name))
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["versions"])
    assert found["parts"]["versions"]["findings"][0].startswith("mujoco 4.0.0 with mujoco-mjx 3.17.0: python -m pip")


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
    measured = self_check.measure()
    measured["mjx"] = {key: value for key, value in measured["mjx"].items() if key != "LF tibia"}
    measured["walk"] = measured["walk"] | {"jerk": 1.0}
    monkeypatch.setattr(self_check, "measure", lambda: measured)
    code, found = doctor()
    assert (code, list(wrong(found))) == (1, ["dynamics", "walk"])
    assert found["parts"]["dynamics"]["findings"] == [
        f"mjx: LF tibia is None, stored is {self_check.load()['acceleration']['LF tibia']}"
    ]


@pytest.mark.slow
def test_this_code_computes_what_is_stored(tmp_path):
    """In a process of its own; `python -m mjx_climb.checks.self_check` stores the values anew."""
    environment = os.environ | {"MJX_CLIMB_CACHE": str(tmp_path)}
    command = [sys.executable, "-m", "tuning.command_line", "doctor"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stderr == ""
    assert [line.split()[0] for line in done.stdout.splitlines() if line[:1].islower()] == PARTS
    verdict = done.stdout.splitlines()[-1]
    sound = done.returncode == 0 and verdict.startswith("All is well")
    assert sound or verdict.startswith("Something is wrong with renderer."), done.stdout  # a machine without OpenGL
    assert list(tmp_path.glob("*-cache"))
