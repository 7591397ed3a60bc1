"""Double precision for the session, a compilation cache that workers and runs share, and programs that tests share."""

import contextlib
import ctypes
import dataclasses
import functools
import gc
import os
import shutil
import signal
from pathlib import Path

# before JAX is imported, here and in the programs that tests start; `pytest --cache-clear` empties it
os.environ.setdefault("MJX_CLIMB_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "d" / "xla"))

from tests import shapes

shapes.check()  # before either package is imported

import jax
import numpy as np
import pytest
from hypothesis import settings

import mjx_climb as mc
from mjx_climb.disturbances.on_base import Push
from mjx_climb.execution import batches, cache, gpu_kernel, paths
from tests.execution.interpreter import launched

jax.config.update("jax_enable_x64", True)
cache.enable_cache()
cache.executable_file = lambda *_: None  # tests replace functions of which a kept program knows nothing
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # what one worker compiled the other reads
gc.set_threshold(50_000, 50, 100)  # tracing makes many objects that stay

settings.register_profile("quick", deadline=None, max_examples=50, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))

CONFIGS = Path(__file__).parents[1] / "configs"
LAWS = {
    "pd": {"control.controller": "pd"},
    "virtual_model": {"control.controller": "base_admittance", "control.reading": "virtual_model"},
    "measured_pose": {"control.controller": "base_admittance", "control.reading": "measured_pose"},
    "end_effector": {"control.controller": "end_effector_admittance", "control.reading": "virtual_model"},
}
OPTIMISED = "xla_backend_optimization_level"  # by regions, see `compiler_options`
PUSHES = 3
# bytes of a worker between modules; what is dropped is traced anew, so it is dropped seldom
MOST_MEMORY = 3e9
BROWSER = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)


@pytest.fixture(autouse=True)
def signals():
    """Ctrl-C ends the tests, whatever a program that ran in this process has done to its signals."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True, scope="module")
def memory():
    """Drop compiled programs after a module once they are large, and give what they took back to the system."""
    yield
    with contextlib.suppress(OSError, AttributeError):  # measured on Linux alone
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > MOST_MEMORY:
            jax.clear_caches()
            batches._program.cache_clear()
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture
def cpu_alone(monkeypatch):
    """Have the package see no GPU, on any machine."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")


@pytest.fixture
def without_nvrtc(monkeypatch):
    """Have kernels for GPUs written, on any machine, but not compiled; return the list to which they come."""
    kernels = []
    monkeypatch.setattr(gpu_kernel, "ptx", lambda source: kernels.append(source) or "PTX")
    return kernels


@pytest.fixture
def interpreted(monkeypatch):
    """Have kernels carried out by XLA's own operations, on any device and in any precision."""
    monkeypatch.setattr(gpu_kernel, "by_kernel", launched)


@pytest.fixture(scope="module")
def optimised():
    """Have batches optimised as users' are, also under `make test-slow`: they walk for longer than that takes."""
    options = paths.compiler_options
    batches._program.cache_clear()  # knows programs by other options
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "compiler_options", lambda *of, **how: {OPTIMISED: 1} | options(*of, **how))
        yield
    batches._program.cache_clear()


@pytest.fixture(scope="session")
def case():
    """Return a paper's case, `case("case_2", "pd", **{"contact.holding_limit": None})`."""

    def load(name, law, overrides=()):
        return mc.load_scenario(CONFIGS / f"{name}.yaml", LAWS[law] | dict(overrides))

    return load


def padded_numbers(scenario, **changes):
    """Return the scenario's parameters with three pushes, idle ones included: one shape, so one program, for all.

    `changes` are values by path, in which "__" stands for a dot.
    """
    numbers = jax.tree.map(np.asarray, mc.parameters(scenario))
    missing = PUSHES + 1 - len(numbers.disturbances)
    idle = jax.tree.map(np.asarray, Push(force=np.zeros(3), moment=np.zeros(3), start=0.0, stop=0.0))
    numbers = dataclasses.replace(numbers, disturbances=(*numbers.disturbances, *[idle] * missing))
    return numbers.replace({name.replace("__", "."): np.asarray(value, float) for name, value in changes.items()})


def six_gains(scenario):
    """Return the scenario's gains on six axes each: one shape, so one program, for all."""
    control = scenario.control
    return mc.Gains(
        *(np.broadcast_to(np.asarray(g, float), 6) for g in (control.inertia, control.damping, control.stiffness))
    )


@pytest.fixture(scope="session")
def numbers():
    return padded_numbers


@pytest.fixture(scope="session")
def gains():
    return six_gains


@pytest.fixture(scope="session")
def walk():
    """Return the trajectory of a scenario in double precision, walked once a session."""

    @functools.cache
    def trajectory(scenario):
        return mc.rollout(scenario, six_gains(scenario), padded_numbers(scenario))

    return trajectory


@pytest.fixture(scope="session", params=list(mc.ENGINES))
def engine(request):
    return request.param


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """Return a browser without a window; a test says how large its page is."""
    selenium = pytest.importorskip("selenium.webdriver", reason="needs selenium")
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.skip("needs chromium and chromedriver")
    options = selenium.ChromeOptions()
    options.binary_location = programs[0]
    for flag in [*BROWSER.split(), f"--user-data-dir={tmp_path_factory.mktemp('profile')}"]:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = selenium.Chrome(options=options, service=selenium.ChromeService(programs[1]))
    yield driver
    driver.quit()
