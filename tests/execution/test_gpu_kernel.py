"""The GPU kernel of a walk, carried out on the CPU, against the same walk by XLA; and its compilation for GPUs."""

import functools
import types

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import law_of
from mjx_climb.execution import gpu_kernel, paths
from mjx_climb.execution.elements import Unsupported
from mjx_climb.execution.gpu_kernel import over_robots, tangents_over_robots
from mjx_climb.execution.paths import first_possible
from mjx_climb.execution.refused import Refused
from mjx_climb.inputs.resolve import resolve_in
from mjx_climb.parameter_types import Gains
from mjx_climb.walk.structure import structure
from mjx_climb.walks import metrics_of, metrics_of_moved

ROBOTS = 140  # a block and a part of one
STEPS = 120
PUSH = {"start": 0.01, "stop": 0.05, "force": [3.0, 0.0, 1.0], "moment": [0.0, 0.5, 0.0]}
FOOTHOLDS = {"LF": [0.0, 0.02], "RH": [0.015, 0.0, 0.03]}
# every law, both references of the base, both swings, flat and uneven ground, pushes, cargo, another heading
CASES = {
    "virtual_model": ({"disturbance.pushes": [PUSH], "gait.heading": 0.4, "contact.holding_limit": 4.0}, False),
    "measured_pose": ({"gait.base_reference": "actual", "disturbance.cargo": {"mass": 1.0, "start": 0.02}}, True),
    "end_effector": ({"ground.footholds": FOOTHOLDS, "disturbance.pushes": [PUSH, PUSH]}, False),
    "pd": ({"ground.footholds": FOOTHOLDS, "gait.base_reference": "actual", "gait.swing": "low_reaction"}, False),
}


def walk_of(case, law, steps, dtype):
    """Return one robot's walk as a function of law and parameters, these, and which of their arrays are batched."""
    overrides, smooth = CASES[law]
    scenario = case("case_1_2", law, overrides.items())
    rng = np.random.default_rng(7)
    spread = lambda *shape: 10.0 ** rng.uniform(-0.2, 0.2, (ROBOTS, *shape))  # noqa: E731
    gains = Gains(10 * spread(6), 1e3 * spread(6), np.full(6, 1e4))
    parameters = mc.parameters(scenario).replace(
        {"gravity": np.array([0, 0, -1.0]) * spread(1), "mass_scale": spread()}
    )
    found = resolve_in(scenario, law_of(scenario), gains, parameters, dtype)
    arguments = found.law, found.parameters
    pairs = zip(jax.tree.leaves(arguments), jax.tree.leaves(found.axes), strict=True)
    shape = structure(scenario, "limb", found.parameters, law=found.law, smooth=smooth)._replace(steps=steps)
    return functools.partial(metrics_of, shape), arguments, [leaf.ndim > own for leaf, own in pairs]


@pytest.mark.nightly
@pytest.mark.parametrize(
    "law",
    ["virtual_model", *(pytest.param(law, marks=pytest.mark.nightly) for law in ("measured_pose", "end_effector"))],
)
def test_the_kernel_walks_as_xla_does(case, law, interpreted):
    """Float64 metrics of 140 robots that differ in gains, gravity and mass agree to 1e-9 of their size."""
    walk, arguments, batched = walk_of(case, law, STEPS, np.float64)
    whole = {"xla_disable_hlo_passes": "fusion"}  # compiles sooner
    found = jax.jit(over_robots(walk, batched), compiler_options=whole)(*arguments)
    axes = jax.tree.unflatten(jax.tree.structure(arguments), [0 if own else None for own in batched])
    expected = jax.jit(jax.vmap(walk, axes), compiler_options=whole)(*arguments)
    assert found.keys() == expected.keys()
    assert len(np.unique(expected["peak_foot_force"])) == ROBOTS
    if law == "virtual_model":
        assert 0 < np.sum(expected["detached_limb"] >= 0) < ROBOTS
    for name, values in expected.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("law", [pytest.param(law, marks=[pytest.mark.slow] * (law != "pd")) for law in CASES])
def test_the_kernel_is_written_for_gpus(case, law, without_nvrtc):
    """Every operation of a walk has its form in CUDA C, and the walk of 8000 steps is one kernel."""
    with jax.enable_x64(False):
        walk, arguments, batched = walk_of(case, law, 8000, np.float32)
        mapped = over_robots(walk, batched)
        lowered = jax.jit(mapped).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.ptx") == 1
    assert "stablehlo.while" not in lowered
    [kernel] = without_nvrtc
    assert "__shfl_xor_sync" in kernel  # sums over the limbs


@pytest.mark.slow
def test_engine_mjx_is_one_kernel(case):
    """Its inertia is solved without a library."""
    scenario = case("case_1_2", "pd")
    with jax.enable_x64(False):
        found = resolve_in(scenario, law_of(scenario), None, None, np.float32)
        shape = structure(scenario, "mjx", found.parameters, law=found.law)
        program = jax.make_jaxpr(functools.partial(metrics_of, shape))(found.law, found.parameters)
        text = gpu_kernel.written(gpu_kernel.body_of(program), (0,) * len(program.in_avals)).text
    assert text.count("#pragma unroll 1") == 1
    assert text.count("\n") < 12_000


@pytest.mark.slow
def test_tangents_are_written_for_gpus(case, without_nvrtc):
    """Tangents by gains of the law and of the joints are one kernel, whatever the number of directions."""
    directions = 5
    with jax.enable_x64(False):
        walk, (law, parameters), batched = walk_of(case, "virtual_model", 8000, np.float32)
        moving = {"damping": law.damping, "kp": np.full(ROBOTS, 50.0, "f4")}
        along = {"damping": np.ones((ROBOTS, directions, 6), "f4"), "kp": np.ones((ROBOTS, directions), "f4")}
        moved = functools.partial(metrics_of_moved, *walk.args)
        traced = jax.jit(tangents_over_robots(moved, [True, True, *batched])).trace(along, moving, law, parameters)
        lowered = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("__gpu$xla.gpu.ptx") == 1
    assert len(without_nvrtc) == 1
    assert traced.out_info[1]["min_tsm"].shape == (ROBOTS, directions)


@pytest.mark.parametrize(
    ("backend", "capability", "paid"), [("cpu", None, False), ("gpu", "9.0", True), ("gpu", "7.5", False)]
)
def test_the_kernel_is_for_new_gpus(monkeypatch, backend, capability, paid):
    """From compute capability 8.0 on, whatever this machine has; not in float64."""
    device = types.SimpleNamespace(compute_capability=capability) if capability else types.SimpleNamespace()
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "devices", lambda: [device])
    monkeypatch.setattr(paths, "works", lambda path: path == "kernel")
    assert (paths.path_for(None, kernel=True) == "kernel") == paid
    assert paths.path_for(None, kernel=False) != "kernel"


# robots, tangents, double precision, limit, whether on the CPU; in single precision nine go by the kernel
FEW = [
    (1, 0, True, "", True), (8, 0, False, "", True), (9, 0, False, "", False), (64, 0, True, "", True),
    (65, 0, True, "", False), (4, 12, False, "", True), (5, 12, False, "", False), (500, 12, True, "500", True),
    (1, 0, True, "0", False),
]  # fmt: skip


@pytest.mark.parametrize(("robots", "tangents", "double", "limit", "there"), FEW)
def test_few_robots_walk_on_the_cpu(monkeypatch, robots, tangents, double, limit, there):
    """Although there is a GPU, up to a number that differs for what walks, or that the environment gives."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(paths, "path_for", lambda device, kernel: "kernel" if kernel else "plain")
    monkeypatch.setenv(paths.ON_CPU, limit)
    assert (paths.device_for(robots, tangents, kernel=not double) == "cpu") == there


def test_walks_that_keep_histories_never_ask_for_the_kernel(monkeypatch):
    """It cannot return something of each step; nor can it walk in double precision."""
    asked = []

    class AskedError(Exception):
        """What is asked for is known: nothing needs to be compiled."""

    def path_for(device, kernel):
        asked.append(kernel)
        raise AskedError

    monkeypatch.setattr(paths, "path_for", path_for)
    scenario = mc.Scenario().with_overrides({"duration": 0.008, "gait.cycle": 0.008, "gait.stride": 0.0})
    gains = Gains(*(np.ones((2, 6)),) * 3)
    for walk, dtype in ((mc.rollout_metrics, "f4"), (mc.rollout_histories, "f4"), (mc.rollout_metrics, "f8")):
        with pytest.raises(AskedError):
            walk(scenario, gains, dtype=np.dtype(dtype))
    assert asked == [True, False, False]


def test_a_limit_that_is_no_number_is_refused(monkeypatch):
    monkeypatch.setenv(paths.ON_CPU, "few")
    assert paths.device_for(1, 0, kernel=True) is None  # where there is no GPU nothing is asked
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(Refused, match=r"^MJX_CLIMB_ON_CPU: expected a number of robots, got 'few'$"):
        paths.device_for(1, 0, kernel=True)


def test_without_nvrtc_the_reason_is_told(monkeypatch):
    """It is what the fall-back to XLA's own kernels says."""

    def missing(place):
        raise OSError(place)

    monkeypatch.setattr(gpu_kernel.ctypes, "CDLL", missing)
    with pytest.raises(Unsupported, match=r"libnvrtc\.so; pip install"):
        gpu_kernel._library.__wrapped__()


def test_what_the_kernel_cannot_do_is_said_once_and_walked_by_xla(interpreted):
    """A loop of unknown length goes by the plain program; the next structure goes by the kernel again."""

    def function(structure, value):
        loop = lambda v: jax.lax.while_loop(lambda a: a < 9, lambda a: a * 2, v)  # noqa: E731
        return loop(value) if structure == "loop" else value * 2

    def fast(structure, values):
        return over_robots(functools.partial(function, structure), [True])(values)

    taken = []

    def carried_out(structure, values):
        def by(path):
            taken.append(path)
            if path == "kernel":
                return jax.jit(fast, static_argnums=0)(structure, values)
            return jax.vmap(functools.partial(function, structure))(values)

        return first_possible(by, "kernel", structure)

    values = np.arange(1.0, 4.0)
    with pytest.warns(UserWarning, match=r"cannot do the operation while \(.*test_gpu_kernel\.py:\d+") as said:
        for _ in range(2):
            np.testing.assert_array_equal(carried_out("loop", values), [16.0, 16.0, 12.0])
    assert len(said) == 1
    np.testing.assert_array_equal(carried_out("double", values), values * 2)
    assert taken == ["kernel", "plain", "plain", "kernel"]


@pytest.mark.parametrize("walks", [1, 31, 32, 33, 500])
def test_every_walk_has_a_thread_for_each_limb(walks):
    threads = gpu_kernel.THREADS * gpu_kernel.Kernel("", 0, 4).blocks(walks)
    assert 4 * walks <= threads < 4 * walks + gpu_kernel.THREADS
