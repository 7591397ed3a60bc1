"""What only a GPU can tell: kernels of branching laws, of what laws are written with, and of gradients.

    python -m tests.on_gpu             every part, each in a process of its own that is ended after `LIMIT`
    python -m tests.on_gpu PART ...    these parts: mjx, base, branching, written, steps; ROBOTS-GAINS such as
                                       512-few, 16384-network; xla

Laws walk by the kernel in single precision; their metrics, tangents and gradients are those of the CPU in double
precision to what single precision is off by. It ends with code 1 where one is not, or where a kernel is refused.
Gradients of whole walks are timed beside values and forward mode, `xla` beside `jax.checkpoint` and XLA's own kernels.
"""

import math
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

import mjx_climb as mc
from mjx_climb.execution.flat import evaluated
from mjx_climb.execution.jax_internals import carried_out, inner_program, scan_sizes
from mjx_climb.execution.paths import ON_CPU
from tests.execution.test_branches_and_loops import Branching
from tests.execution.test_operations_of_laws import Written

SHORT = {"duration": 0.05, "gait.cycle": 0.05, "disturbance.cargo.start": 0.02, "disturbance.cargo.mass": 0.5}
LONGER = SHORT | {"duration": 0.3, "gait.cycle": 0.4}  # two levels of checkpoints
LAWS = {"base": None, "branching": Branching, "written": Written}
METRICS = ("peak_foot_force", "force_variation", "base_deviation")
ROBOTS, TOLERANCE, LIMIT = 64, 5e-3, 150.0  # LIMIT in s
PARTS = ("mjx", *LAWS, "steps", "512-few", "512-network", "16384-few", "16384-network", "xla")


def compared(name, law, changes=SHORT):
    """Return the largest relative errors of the kernel's metrics, tangents and gradients."""
    simulation = mc.Simulation(mc.load_scenario("case_1_2").with_overrides(changes), law and law())
    damping = {"damping": np.multiply.outer(np.geomspace(1e2, 2e2, ROBOTS), np.ones(6 if law is None else 3))}
    along = {"damping": damping["damping"][None]}
    weights = {metric: np.eye(len(METRICS))[row][:, None] * np.ones(ROBOTS) for row, metric in enumerate(METRICS)}

    def results(dtype, on_cpu):
        os.environ[ON_CPU] = str(ROBOTS if on_cpu else 0)
        values, tangents = simulation.jvp(damping, along, dtype=dtype)
        gradients = simulation.vjp(damping, weights, dtype=dtype)["damping"] * damping["damping"]
        rows = [np.stack([values[metric] for metric in METRICS])]
        rows += [np.stack([tangents[metric][0] for metric in METRICS]), gradients.reshape(len(METRICS), -1)]
        return rows

    mine, exact = results(np.float32, False), results(np.float64, True)
    errors = [np.median(abs(m - e), 1) / abs(e).max(1) for m, e in zip(mine, exact, strict=True)]
    print(f"{name}: off by", ", ".join(f"{max(error):.1e}" for error in errors), "(metrics, tangents, gradients)")
    return max(max(error) for error in errors)


def compared_mjx():
    """Return the largest relative error of metrics by engine mjx, which factors its inertia in the kernel."""
    scenario = mc.load_scenario("case_1_2").with_overrides(SHORT)
    found = []
    for dtype, limit in ((np.float32, 0), (np.float64, ROBOTS)):
        os.environ[ON_CPU] = str(limit)
        damping = {"damping": np.multiply.outer(np.geomspace(1e2, 2e2, ROBOTS), np.ones(6))}
        values = mc.Simulation(scenario, engine="mjx").metrics(damping, dtype=dtype)
        found.append(np.stack([values[metric] for metric in METRICS]))
    errors = np.median(abs(found[0] - found[1]), 1) / abs(found[1]).max(1)
    print(f"engine mjx: off by {errors.max():.1e} (metrics)")
    return errors.max()


def network():
    """Return the guide's law of 412 numbers, and gains of it."""
    sys.path.append(str(Path(__file__).parents[1] / "docs" / "guides"))
    from network_law import Network

    rng, shapes = np.random.default_rng(1), {"inner": (16, 12), "inner_bias": 16, "output": (12, 16), "output_bias": 12}
    return Network(), {name: rng.normal(0, 0.3, shape) for name, shape in shapes.items()}


def few():
    """Return the base's admittance law and two of its gains."""
    return None, {"damping": np.full(6, 1e3), "stiffness": np.full(6, 1e4)}


def timed(robots, kind):
    """Print the costs of gradients of whole walks; return how far one is off its sum with tangents, in forward mode."""
    os.environ[ON_CPU] = "0"
    law, own = {"few": few, "network": network}[kind]()
    simulation, rng = mc.Simulation(mc.load_scenario("case_1_2"), law), np.random.default_rng(0)
    gains = {n: np.float32(v * rng.uniform(0.9, 1.1, (robots, *(1,) * v.ndim))) for n, v in own.items()}
    along = {name: np.float32(value)[None] for name, value in gains.items()}
    weights = {"force_variation": np.ones((1, robots))}
    found, costs = {}, {}
    for name, walk in {
        "value": lambda: simulation.metrics(gains)["force_variation"],
        "tangent": lambda: simulation.jvp(gains, along)[1]["force_variation"][0],
        "gradient": lambda: sum(
            (value[0] * gains[name]).reshape(robots, -1).sum(1)
            for name, value in simulation.vjp(gains, weights).items()
        ),
    }.items():
        begin = time.perf_counter()
        found[name] = walk()
        first, rounds = time.perf_counter() - begin, []
        while len(rounds) < 5 and sum(rounds) < 10:
            begin = time.perf_counter()
            walk()
            rounds.append(time.perf_counter() - begin)
        costs[name] = float(np.median(rounds))
        print(f"{robots} x 8 s, {kind}, {name}: {1e3 * costs[name]:.1f} ms, first {first:.1f} s", flush=True)
    numbers = sum(math.prod(value.shape[1:]) for value in gains.values())
    print(f"{robots} robots by {numbers} numbers: a gradient costs {costs['gradient'] / costs['value']:.2f} values")
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    off = np.median(abs(found["gradient"] - found["tangent"])) / np.median(abs(found["tangent"]))
    print(f"memory: {peak / 1e9:.2f} GB at most; off its tangents by {off:.1e}", flush=True)
    return off


def with_checkpoints(program, arguments):
    """Return the results of a program whose long loops are two, the inner one under `jax.checkpoint`."""

    def results_of(equation, values):
        inner, name = inner_program(equation), equation.primitive.name
        if inner is not None and not name.startswith("custom"):
            return with_checkpoints(inner, values)
        length = equation.params.get("length", 0)
        if name != "scan" or length < 100:
            return carried_out(equation.primitive, equation.params, values)
        constants, carry = scan_sizes(equation.params)
        count = next(each for each in range(math.isqrt(length), 0, -1) if length % each == 0)
        assert len(values) == constants + carry == constants + len(equation.outvars)
        step = lambda carried, _: (core.jaxpr_as_fun(equation.params["jaxpr"])(*values[:constants], *carried), None)  # noqa: E731
        stretch = jax.checkpoint(lambda carried, _: lax.scan(step, carried, None, length=length // count))
        typed = [jnp.asarray(v, a.aval.dtype) for v, a in zip(values, equation.invars, strict=True)][constants:]
        return lax.scan(stretch, typed, None, length=count)[0]

    return evaluated(program, arguments, results_of)


def timed_by_xla(robots=512):
    """Print the cost of a gradient by `jax.checkpoint` and XLA's own kernels."""
    law, own = network()
    one = mc.simulator(mc.load_scenario("case_1_2"), law=law)
    gains = {n: jnp.broadcast_to(np.float32(value), (robots, *value.shape)) for n, value in own.items()}
    program, tree = jax.make_jaxpr(one, return_shape=True)(jax.tree.map(lambda v: v[0], gains))
    place = sorted(tree).index("force_variation")
    gradient = jax.jit(jax.vmap(jax.grad(lambda gains: with_checkpoints(program, jax.tree.leaves(gains))[place])))
    for name in ("first", "then"):
        begin = time.perf_counter()
        jax.block_until_ready(gradient(gains))
        print(
            f"{robots} x 8 s, network, jax.checkpoint by XLA, {name}: {time.perf_counter() - begin:.2f} s", flush=True
        )


def carried_out_here(part):
    """Carry a part out; return how far it is off."""
    if jax.default_backend() == "cpu":
        raise SystemExit("no GPU: nothing to check")
    warnings.filterwarnings("error", message=".*slower")
    if part == "mjx":
        return compared_mjx()
    if part in LAWS:
        return compared(part, LAWS[part])
    if part == "steps":
        return compared("300 steps", None, LONGER)
    if part == "xla":
        return timed_by_xla() or 0.0
    robots, kind = part.split("-")
    return timed(int(robots), kind)


def main():
    parts = sys.argv[1:] or PARTS
    if len(parts) == 1:
        limit = 2e-2 if parts[0][0].isdigit() else TOLERANCE  # of 8,000 steps in single precision: of two derivatives
        raise SystemExit(int(carried_out_here(parts[0]) > limit))
    failed = []
    for part in parts:  # one that hangs does not stop the others
        begin = time.perf_counter()
        try:
            code = subprocess.run([sys.executable, "-m", "tests.on_gpu", part], timeout=LIMIT).returncode
        except subprocess.TimeoutExpired:
            code = f"not ended after {LIMIT:.0f} s"
        print(f"-- {part}: {code or 'ok'}, {time.perf_counter() - begin:.0f} s", flush=True)
        failed += [part] * bool(code)
    raise SystemExit(", ".join(failed) or 0)


if __name__ == "__main__":
    main()
