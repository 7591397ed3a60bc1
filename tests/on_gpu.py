"""What only a GPU can tell: kernels of branching laws, of what laws are written with, and of gradients.

    python -m tests.on_gpu             compare with the CPU in float64, then time gradients
    python -m tests.on_gpu --quick     compare alone

Laws walk by the kernel in single precision; their metrics, tangents and gradients are those of the CPU in double
precision to what single precision is off by. It ends with code 1 where one is not, or where a kernel is refused.
"""

import os
import sys
import time
import warnings

import jax
import numpy as np

import mjx_climb as mc
from mjx_climb.execution.paths import ON_CPU
from tests.execution.test_branches_and_loops import Branching
from tests.execution.test_operations_of_laws import Written

SHORT = {"duration": 0.05, "gait.cycle": 0.05, "disturbance.cargo.start": 0.02, "disturbance.cargo.mass": 0.5}
LAWS = {"base admittance": None, "branching": Branching(), "scatters and solves": Written()}
METRICS = ("peak_foot_force", "force_variation", "base_deviation")
ROBOTS, TOLERANCE = 64, 5e-3
LONG = {"duration": 8.0}


def compared(name, law):
    """Return the largest relative errors of the kernel's metrics, tangents and gradients."""
    simulation = mc.Simulation(mc.load_scenario("case_1_2").with_overrides(SHORT), law)
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


def timed(robots):
    """Print what gradients of whole walks cost, in values."""
    os.environ[ON_CPU] = "0"
    simulation = mc.Simulation(mc.load_scenario("case_1_2").with_overrides(LONG))
    gains = {"damping": np.full((robots, 6), 1e3), "stiffness": np.full((robots, 6), 1e4)}
    along = {name: np.ones((2, robots, 6)) for name in gains}
    runs = {
        "value": lambda: simulation.metrics(gains),
        "2 tangents": lambda: simulation.jvp(gains, along),
        "gradient": lambda: simulation.vjp(gains, {"force_variation": np.ones((1, robots))}),
    }
    seconds = {}
    for name, run in runs.items():
        begin = time.perf_counter()
        run()
        first = time.perf_counter() - begin
        rounds = []
        for _ in range(5):
            begin = time.perf_counter()
            run()
            rounds.append(time.perf_counter() - begin)
        seconds[name] = float(np.median(rounds))
        print(f"{robots} robots x 8 s, {name}: {1e3 * seconds[name]:.1f} ms, first {first:.1f} s", flush=True)
    print(f"{robots} robots: a gradient costs {seconds['gradient'] / seconds['value']:.2f} values")
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    print(f"memory: {peak / 1e9:.2f} GB at most")


def main():
    if jax.default_backend() == "cpu":
        raise SystemExit("no GPU: nothing to check")
    warnings.filterwarnings("error", message=".*slower")
    off = max(compared_mjx(), *(compared(name, law) for name, law in LAWS.items()))
    if "--quick" not in sys.argv:
        for robots in (512, 16384):
            timed(robots)
    raise SystemExit(off > TOLERANCE)


if __name__ == "__main__":
    main()
