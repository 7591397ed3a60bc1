"""The package as others get it: built from a clean checkout, installed elsewhere, used outside of the repository."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import mjx_climb as mc

ROOT = Path(__file__).parents[2]
FILES = (  # beside the code
    "mjx_climb/robot/models/*.xml", "mjx_climb/*.json", "mjx_climb/viz/plots/*.mplstyle", "tuning/pages/page.*",
    "tuning/gains/*.hpp", "*/py.typed",
)  # fmt: skip

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]

pytestmark = pytest.mark.slow


def done(*command, **how) -> str:
    finished = subprocess.run([str(word) for word in command], capture_output=True, text=True, **how)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of what git knows of, or would take up."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout of git's")
    copy = tmp_path_factory.mktemp("checkout")
    for name in done("git", "ls-files", "-co", "--exclude-standard", "-z", cwd=ROOT).split("\0"):
        if name and (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def built(checkout):
    """Wheel and sdist."""
    done(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-t", "sdist", cwd=checkout)
    (wheel,), (sdist,) = (list((checkout / "dist").glob(kind)) for kind in ("*.whl", "*.tar.gz"))
    return wheel, sdist


def install(what: Path, where: Path) -> Path:
    """Install into an environment of its own, which finds the dependencies in ours; return its folder of programs."""
    done(sys.executable, "-m", "venv", "--without-pip", where)
    paths = sysconfig.get_paths("venv", {"base": str(where), "platbase": str(where)})
    ours = [path for path in sys.path if path.endswith("site-packages")]
    (Path(paths["purelib"]) / "dependencies.pth").write_text("\n".join(ours))
    pip = (sys.executable, "-m", "pip", "--python", Path(paths["scripts"]) / "python", "install", "--quiet")
    done(*pip, "--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check", what, env=plain())
    return Path(paths["scripts"])


def plain() -> dict[str, str]:
    """Return the environment without anything that leads to the repository."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def files_in(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}


@pytest.fixture(scope="module")
def programs(built, tmp_path_factory):
    return install(built[0], tmp_path_factory.mktemp("wheel"))


def test_the_wheel_holds_every_module_and_asset(built, checkout):
    inside = files_in(built[0])
    wanted = {path for pattern in (*FILES, "mjx_climb/**/*.py", "tuning/**/*.py") for path in checkout.glob(pattern)}
    assert {path.relative_to(checkout).as_posix() for path in wanted} < set(inside)
    configs = {f"mjx_climb/{path.relative_to(checkout).as_posix()}" for path in checkout.glob("configs/**/*.*")}
    assert {name for name in inside if name.startswith("mjx_climb/configs/")} == configs
    assert {name.split("/")[0].split("-")[0] for name in inside} == {"mjx_climb", "tuning"}


def test_the_sdist_gives_the_same_wheel(built, tmp_path):
    wheel, sdist = built
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (folder,) = tmp_path.iterdir()
    done(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "again", cwd=folder)
    assert files_in(tmp_path / "again" / wheel.name) == files_in(wheel)


@pytest.mark.nightly
def test_the_installed_program_works_outside_the_repository(programs, tmp_path):
    program = programs / "mjx-climb"
    how = {"cwd": tmp_path, "env": plain()}
    assert "case_1_1, case_1_2, case_2" in " ".join(done(program, "run", "--help", **how).split())
    assert done(program, "--version", **how).startswith(f"mjx-climb {VERSION}, ")
    metrics = json.loads(done(program, "run", "case_1_2", "--set", "duration=0.05", "--json", "--out", "walk", **how))
    assert list(metrics) == list(mc.METRICS.names)
    assert (tmp_path / "walk" / "walk.png").stat().st_size > 10_000


@pytest.mark.nightly
def test_a_whole_walk_and_the_self_check_of_the_installed_program(programs, tmp_path):
    how = {"cwd": tmp_path, "env": plain()}
    assert "held all the way" in done(programs / "mjx-climb", "run", "case_1_2", **how)
    assert f"mjx-climb {VERSION}" in " ".join(done(programs / "mjx-climb", "doctor", **how).split())


INSTALLED = """
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario import load, shipped
from tuning.benchmarks import self_check
from tuning.problem import ensemble
from tuning.pages import page
print(self_check.__file__, page.__file__, shipped.config_path("case_2.yaml"), self_check.STORED, sep="\\n")
[load_robot(load.load_scenario(name).robot) for name in shipped.names()]
ensemble.Ensemble.load(shipped.config_path("ensemble.yaml"))
self_check.load()["walk"], page.ENVIRONMENT.get_template("page.html.jinja")
[(page.HERE / name).read_text() for name in ("page.css", "page.js")]
"""


def test_installed_code_finds_its_own_files(programs, tmp_path):
    places = done(programs / "python", "-c", INSTALLED, cwd=tmp_path, env=plain()).splitlines()
    assert len(places) == 4 and all(programs.parent in Path(place).parents for place in places)


def test_pip_installs_a_checkout(checkout, tmp_path):
    programs = install(checkout, tmp_path / "env")
    assert "Simulate a limbed climbing robot" in done(programs / "mjx-climb", "--help", cwd=tmp_path, env=plain())
