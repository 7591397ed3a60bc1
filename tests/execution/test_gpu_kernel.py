"""The GPU kernel of a walk, carried out on the CPU, against the same walk by XLA; and its compilation for GPUs."""

import functools
import itertools
import math
import types

import jax
import jax.numpy as jnp
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


@pytest.mark.parametrize(("rows", "walks", "kept"), [(1, 1, 0), (3, 11, 5), (2, 33, 1), (32, 1, 2)])
def test_what_loops_write_is_behind_the_results_of_each_thread(rows, walks, kept):
    """In whole rows of 32 words; of threads beyond the last walk, too."""
    kernel = gpu_kernel.Kernel("", kept, 4)
    results = next(words for words in itertools.count(rows * walks) if words % 32 == 0)
    assert kernel.words(rows, walks) == results + kept * kernel.blocks(walks) * gpu_kernel.THREADS


def by_a_launch(monkeypatch, function, arrays, axes):
    """Return the results of a function by a kernel of words 100 (row + 1) + walk, and what it was launched by."""
    seen, one = {}, [jax.ShapeDtypeStruct(each.shape[own:], each.dtype) for each, own in zip(arrays, axes, strict=True)]
    program = jax.make_jaxpr(function)(*one)
    walks = math.prod(max((each.shape[:own] for each, own in zip(arrays, axes, strict=True)), key=len))
    kinds = [aval.dtype.kind for aval in program.out_avals for _ in range(aval.size)]

    def launched(source, name, blocks, threads, made, *given):
        words = np.zeros(math.prod(made.shape), made.dtype)
        for row, kind in enumerate(kinds):
            numbers = np.arange(walks, dtype=np.int32) + 100 * (row + 1)
            own = numbers.astype(np.float32).view(np.int32) if kind == "f" else numbers % 2 if kind == "b" else numbers
            words[row * walks : (row + 1) * walks] = own
        seen.update(name=name, blocks=blocks, threads=threads, words=words.size, given=given)
        return jnp.asarray(words.reshape(made.shape))

    monkeypatch.setattr(gpu_kernel, "launched", launched)
    by_kernel = lambda *of: (gpu_kernel.by_kernel(gpu_kernel.body_of(program), of, axes), seen["given"])  # noqa: E731
    found, given = jax.jit(by_kernel)(*arrays)
    return [*map(np.asarray, found)], seen | {"given": [*map(np.asarray, given)]}


def test_words_of_all_robots_and_directions_go_to_a_kernel_and_come_back_as_arrays(monkeypatch, without_nvrtc):
    """33 robots in three directions each: rows of 32 side by side, and each result of each walk in its place."""
    robots, directions = 33, 3
    rng = np.random.default_rng(0)
    scale, own = np.float32(0.5), rng.normal(size=(robots, 2)).astype("f4")
    flags, along = rng.integers(0, 2, robots).astype(bool), rng.integers(0, 9, (robots, directions)).astype("i4")

    def function(scale, own, flag, along):
        return {"a": own * scale, "b": along + 1, "c": flag & (along > 2)}

    with jax.enable_x64(False):
        found, seen = by_a_launch(monkeypatch, function, [scale, own, flags, along], [0, 1, 1, 2])
    walk = np.arange(robots * directions).reshape(robots, directions)
    np.testing.assert_array_equal(found[0], np.stack([100 + walk, 200 + walk], -1).astype("f4"))
    np.testing.assert_array_equal(found[1], 300 + walk)
    np.testing.assert_array_equal(found[2], walk % 2 == 1)
    assert [each.dtype for each in found] == [np.float32, np.int32, bool]
    common, of_robots, of_walks = seen["given"]
    assert common.tolist() == [robots, directions, int(scale.view("i4"))]
    rows = np.column_stack([own.view("i4"), flags.astype("i4")])
    expected = np.zeros((2, 3, 32), np.int32)
    for robot, words in enumerate(rows):
        expected[robot // 32, :, robot % 32] = words
    np.testing.assert_array_equal(of_robots, expected)
    np.testing.assert_array_equal(of_walks.swapaxes(1, 2).reshape(-1)[: along.size], along.ravel())
    assert (seen["name"], seen["threads"], seen["blocks"]) == ("walk", 128, 1) and seen["words"] == 416
    with jax.enable_x64(False):
        alone, seen = by_a_launch(monkeypatch, lambda own: own * 2, [own], [1])
    np.testing.assert_array_equal(alone[0], (np.array([100, 200]) + np.arange(robots)[:, None]).astype("f4"))
    assert seen["given"][0].tolist() == [robots, 1]


def test_what_is_no_word_goes_by_no_kernel(monkeypatch, without_nvrtc):
    with pytest.raises(Unsupported, match=r"^a function of float64"):
        by_a_launch(monkeypatch, lambda x: x * 2, [np.ones(3)], [1])
    with pytest.raises(Unsupported, match=r"^(a function to|numbers of type) "):
        by_a_launch(monkeypatch, lambda x: x.astype(np.int16), [np.ones(3, "f4")], [1])


class Nvrtc:
    """NVIDIA's compiler, as far as it is called: it says what it is made to say."""

    def __init__(self, *, log="", refuses="", errors=0):
        self.log, self.refuses, self.errors, self.calls = log, refuses, errors, []

    def __getattr__(self, name):
        return self[name]

    def __getitem__(self, name):
        def call(*given):
            self.calls.append(name)
            if name == "nvrtcCompileProgram":
                self.options = [given[2][n].decode() for n in range(given[1])]
            if name == "nvrtcCreateProgram":
                self.source = given[1]
            if name.endswith("Size"):
                given[1]._obj.value = 1 + len(self.log or "PTX of it")
            elif name.startswith("nvrtcGet"):
                given[1].value = (self.log or "PTX of it").encode()
            return self.errors if name == self.refuses else 0

        return call


@pytest.fixture
def nvrtc(monkeypatch):
    """Have a compiler for a GPU of compute capability 9.0 in place of NVIDIA's."""

    def put(**how):
        compiler = Nvrtc(**how)
        monkeypatch.setattr(gpu_kernel.ctypes, "CDLL", lambda place: compiler)
        monkeypatch.setattr(jax, "local_devices", lambda backend: [types.SimpleNamespace(compute_capability="9.0")])
        gpu_kernel._library.cache_clear()
        gpu_kernel.ptx.cache_clear()
        return compiler

    yield put
    gpu_kernel._library.cache_clear()
    gpu_kernel.ptx.cache_clear()


def test_a_kernel_is_compiled_for_the_gpu_that_is_there(nvrtc):
    """Multiplications and additions in one, divisions and roots to two units, and numbers below 1e-38 as zero."""
    compiler = nvrtc()
    assert gpu_kernel.ptx("a kernel") == "PTX of it" and compiler.source == b"a kernel"
    assert sorted(compiler.options) == sorted([
        "--gpu-architecture=compute_90", "--fmad=true", "--ftz=true", "--prec-div=false", "--prec-sqrt=false",
        "--std=c++17",
    ])  # fmt: skip
    assert compiler.calls[-1] == "nvrtcDestroyProgram"


def test_what_nvrtc_says_of_a_kernel_is_told(nvrtc):
    log = "walk.cu(1): warning: odd\n  walk.cu(7): error: none such \nmore"
    compiler = nvrtc(log=log, refuses="nvrtcCompileProgram", errors=6)
    with pytest.raises(Unsupported, match=r"^what NVRTC does not compile: walk.cu\(7\): error: none such$"):
        gpu_kernel.ptx("a kernel")
    assert compiler.calls[-1] == "nvrtcDestroyProgram"
    nvrtc(log="nothing but " + 300 * "x", refuses="nvrtcCompileProgram", errors=6)
    with pytest.raises(Unsupported, match=rf"^what NVRTC does not compile: nothing but {'x' * 188}$"):
        gpu_kernel.ptx("a kernel")
    nvrtc(refuses="nvrtcCreateProgram", errors=3)
    with pytest.raises(Unsupported, match=r"^what NVRTC does not do: error 3 of nvrtcCreateProgram$"):
        gpu_kernel.ptx("a kernel")


@pytest.mark.parametrize(
    ("plugins", "there", "taken"),
    [(["jax-cuda12-plugin"], ["12", "13"], "12"), (["jax-cuda13-plugin"], ["12", "13"], "13"), ([], ["12"], "12"),
     ([], ["12", "13"], "13"), (["jax-cuda12-plugin"], ["13"], "13")],
)  # fmt: skip
def test_the_compiler_is_that_of_the_cuda_that_jax_is_for(monkeypatch, plugins, there, taken):
    """Of the folders of NVIDIA's packages before the system's."""

    def library(place):
        asked.append(place)
        if not any(place.endswith(f"libnvrtc.so.{major}") for major in there):
            raise OSError(place)
        return place

    asked = []
    names = [types.SimpleNamespace(name=name) for name in (*plugins, "numpy")]
    monkeypatch.setattr(gpu_kernel.importlib.metadata, "distributions", lambda: names)
    spec = types.SimpleNamespace(submodule_search_locations=["/nvidia"])
    monkeypatch.setattr(gpu_kernel.importlib.util, "find_spec", lambda name: spec if name == "nvidia" else None)
    monkeypatch.setattr(gpu_kernel.ctypes, "CDLL", library)
    assert gpu_kernel._library.__wrapped__() == f"/nvidia/cu{taken}/lib/libnvrtc.so.{taken}"
    there.clear()
    asked.clear()
    with pytest.raises(Unsupported):
        gpu_kernel._library.__wrapped__()
    each = [[f"/nvidia/cu{n}/lib/libnvrtc.so.{n}", f"/nvidia/cuda_nvrtc/lib/libnvrtc.so.{n}", f"libnvrtc.so.{n}"]
            for n in ("12", "13")]  # fmt: skip
    assert asked == (each[0] + each[1] if plugins == ["jax-cuda12-plugin"] else each[1] + each[0])


def test_gradients_by_a_kernel_are_of_the_weighted_sums_by_the_first_argument(interpreted):
    """Of results in the order of their names, whichever are weighed, with all results beside."""

    def function(moving, factor):
        gain, offset = moving["gain"], moving["offset"]
        return {"cube": (gain**3).sum() * factor, "count": 3, "area": gain[0] * gain[1] + offset, "far": offset > 0}

    rng, robots, sums = np.random.default_rng(0), 3, 2
    gain, offset, factor = rng.normal(size=(robots, 2)), rng.normal(size=robots), np.float64(1.5)
    weights = {"cube": rng.normal(size=(robots, sums)), "area": rng.normal(size=(robots, sums))}
    for some in (weights, {"area": weights["area"]}):
        by_kernel = gpu_kernel.gradients_over_robots(function, [True, True, False])
        values, found = jax.jit(by_kernel)(some, {"gain": gain, "offset": offset}, factor)
        cube = weights["cube"] if "cube" in some else 0 * weights["cube"]
        by_gain = cube[..., None] * 3 * factor * gain[:, None] ** 2 + some["area"][..., None] * gain[:, None, ::-1]
        np.testing.assert_allclose(found["gain"], by_gain, rtol=1e-12)
        np.testing.assert_allclose(found["offset"], some["area"], rtol=1e-12)
        np.testing.assert_allclose(values["cube"], (gain**3).sum(1) * factor, rtol=1e-12)
        np.testing.assert_allclose(values["area"], gain.prod(1) + offset, rtol=1e-12)
        assert values["count"].tolist() == [3] * robots and (values["far"] == (offset > 0)).all()
