"""The measurements of `mjx-climb doctor --bench`: every ratio from runs that take turns, medians of several rounds."""

import contextlib
import importlib.metadata
import importlib.util
import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.execution.cache import cache_in
from tuning.benchmarks import commands, operations
from tuning.benchmarks.walks import TIME_STEP, adjoint, gains, gradient, scenario, walk

Timed = tuple[int, Callable[[], object]]  # env-steps, and the function that walks them


class Plan(NamedTuple):
    """How much is run."""

    rounds: int
    steps: int  # of the closed loop in a round
    peer_steps: int  # of MuJoCo's peers, on the CPU
    tangents: tuple[int, ...]  # of the gradients
    adjoint: bool  # whether reverse mode runs
    batches: tuple[int, ...]  # for growth with the batch; none: left out
    lengths: tuple[int, ...]  # steps, for growth with time; none: left out

    @staticmethod
    def full(batch: int) -> "Plan":
        """Return the plan whose figures are to be quoted: on a GPU the closed loop walks for 8 s."""
        steps = 200 if jax.default_backend() == "cpu" else 8000
        batches, lengths = (batch * k // 4 for k in (1, 2, 4, 8, 16)), (steps * k // 4 for k in (1, 2, 4, 8))
        return Plan(5, steps, 200, (2, 12), True, tuple(batches), tuple(lengths))

    @staticmethod
    def quick(batch: int) -> "Plan":
        """Return a plan for a first look without the programs that take long to compile: their figures are None."""
        return Plan(3, 100 if jax.default_backend() == "cpu" else 4000, 100, (2,), False, (), ())


def in_turns(rounds: int, work: Mapping[str, Timed]) -> dict[str, float]:
    """Return the median seconds per env-step of each: all of them in each round, after one that does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(rounds + 1):
        for name, (env_steps, run) in work.items():
            begin = time.perf_counter()
            run()
            if turn:
                seconds[name].append((time.perf_counter() - begin) / env_steps)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def reverse_from(costs: Mapping[str, float | None]) -> float | None:
    """Return the number of gains from which reverse mode costs less: forward costs are a line through two of them."""
    two, twelve, adjoint = (costs[name] for name in ("gradient_cost_2", "gradient_cost_12", "adjoint_cost"))
    if two is None or twelve is None or adjoint is None or twelve <= two:
        return None
    return max(1.0, 2 + (adjoint - two) * 10 / (twelve - two))


def exponent(sizes: tuple[int, ...], seconds: list[float]) -> float | None:
    """Return the exponent of growth: the slope of log time over log size by least squares; None of nothing."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0]) if sizes else None


def measure(engine: str, batch: int, plan: Plan, say: Callable[[str], object]) -> dict[str, Any]:
    """Return every figure of the benchmark by name; `say` is told of each step.

    Times are in s; ratios say how many times faster this program is than the peer, or the cost of a gradient in values.
    """
    folder = tempfile.TemporaryDirectory(prefix="mjx-climb-bench-", ignore_cleanup_errors=True)
    # new, in this process and for its children, so that every run compiles alike
    with folder as cache, cache_in(cache):
        say("compiling the walk in fresh processes")
        value = commands.compiled("value", batch, plan.steps, engine, cache)
        warm = commands.compiled("value", batch, plan.steps, engine, cache)
        say("compiling its gradient in a fresh process")
        gradient = commands.compiled("gradient", batch, plan.steps // 2, engine, cache)
        with contextlib.ExitStack() as stack:
            ours, single, peers, numpy_loop = runs_of(engine, batch, plan, stack)
            for name, (_, run) in {**ours, **single}.items():
                say(f"compiling {name.replace('_', ' ')}")
                run()
            say("closed loops and their peers, in turns")
            rates = in_turns(plan.rounds, {**ours, **peers})
            single_rates = in_turns(plan.rounds, {**single, **numpy_loop})
        say("growth")
        growth, counted = growth_of(engine, batch, plan), operations_of(engine, batch, plan.steps)
    runs = {"gradient_cost_2": "gradient_2", "gradient_cost_12": "gradient_12", "adjoint_cost": "adjoint"}
    costs = {name: rates[run] / rates["value"] if run in rates else None for name, run in runs.items()}
    own, against = rates["closed_loop"], ("mujoco_c", "mjx", "mujoco_batch", "mujoco_warp")
    return {
        "engine": engine, "batch": batch, "steps": plan.steps, "rounds": plan.rounds,
        # tracing included: the time of a first call less that of the next
        "compile_value_s": value["first"] - value["again"],
        "compile_gradient_s": gradient["first"] - gradient["again"],
        "warm_start_s": warm["from_start"] - warm["again"],  # the run is left out but for one step of it
        **growth,
        **counted,
        "closed_loop_steps_per_s": 1 / own,
        **{f"vs_{name}": rates[name] / own if name in rates else None for name in against},
        "vs_numpy_loop_single": single_rates["numpy_loop"] / single_rates["single"],
        **costs,
        "adjoint_from": reverse_from(costs),
        "single_steps_per_s": 1 / single_rates["single"],
        "peers_steps_per_s": {
            name: 1 / rate for name, rate in {**rates, **single_rates}.items() if name in (*against, "numpy_loop")
        },
        **_machine(),
    }  # fmt: skip


def runs_of(engine: str, batch: int, plan: Plan, stack: contextlib.ExitStack) -> tuple[dict[str, Timed], ...]:
    """Return this program's runs, with a batch and with one robot, and the peers of both.

    The stack ends their threads.
    """
    from tuning.benchmarks import peers

    steps, few = plan.steps, plan.steps // 2
    ours: dict[str, Timed] = {
        "closed_loop": (batch * steps, walk(batch, steps, engine)),
        "mjx": (batch * few, walk(batch, few, "mjx")),
        "value": (batch * few, walk(batch, few, engine)),
    }
    for tangents in plan.tangents:
        length = steps // 2 if tangents == 2 else steps // 4  # its cost per step does not depend on their number
        ours[f"gradient_{tangents}"] = (batch * length, gradient(tangents, batch, length, engine))
    if plan.adjoint:
        ours["adjoint"] = (batch * few, adjoint(batch, few, engine))
    whole = round(8.0 / TIME_STEP)  # one robot is walked for its whole walk
    case, cores, length = scenario(steps), devices.usable_cores(), plan.peer_steps
    bare = peers.Rollout(case, batch, length, cores)
    stack.callback(bare.pool.close)
    steered = peers.Batch(case, gains(batch), cores)
    others: dict[str, Timed] = {
        "mujoco_c": (batch * length, bare.run),
        "mujoco_batch": (batch * length // 2, lambda: steered.run(length // 2)),
    }
    # on a CPU it steps on one core, which nobody would take it for
    if jax.default_backend() != "cpu" and importlib.util.find_spec("mujoco_warp"):
        falling = peers.Warp(case, batch)
        others["mujoco_warp"] = (batch * length, lambda: falling.run(length))
    loop = peers.Loop(scenario(length), gains(1))
    single: dict[str, Timed] = {"single": (whole, walk(1, whole, engine))}
    return ours, single, others, {"numpy_loop": (length, lambda: loop.run(length))}


def growth_of(engine: str, batch: int, plan: Plan) -> dict[str, object]:
    """Return how the time of walks grows with batch and steps."""
    found: dict[str, object] = {}
    for name, plural, sizes in (("batch", "batch", plan.batches), ("step", "steps", plan.lengths)):
        each = {size: (size, plan.steps) if name == "batch" else (batch, size) for size in sizes}
        work = {str(n): (robots * steps, walk(robots, steps, engine)) for n, (robots, steps) in each.items()}
        for _, run in work.values():
            run()
        rates = in_turns(max(plan.rounds // 2, 2), work)
        seconds = {size: rate * work[size][0] for size, rate in rates.items()}
        found[f"{name}_exponent"] = exponent(sizes, list(seconds.values()))
        found[f"seconds_by_{plural}"] = seconds
    return found


def operations_of(engine: str, batch: int, steps: int) -> dict[str, float]:
    """Return the operations of a step by XLA's count of the compiled program, which takes a loop's body once."""
    simulate = mc.simulator(scenario(steps // 2), engine=engine)
    single = {name: jnp.asarray(value, jnp.float32) for name, value in gains(batch).items()}
    compiled = jax.jit(simulate).lower(single).compile()
    cost: dict[str, float] = compiled.cost_analysis() or {}
    memory: Any = compiled.memory_analysis()
    return {
        "flops_per_env_step": cost.get("flops", 0.0) / batch,
        "flops_per_env_step_by_hand": operations.BY_HAND,
        "transcendentals_per_env_step": cost.get("transcendentals", 0.0) / batch,
        "transcendentals_per_env_step_by_hand": operations.TRANSCENDENTAL_BY_HAND,
        "temporary_bytes_per_env": memory.temp_size_in_bytes / batch,
    }


def _machine() -> dict[str, object]:
    names, processor = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"), platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        models = (line.partition(":")[2].strip() for line in file if line.startswith("model name"))
        processor = next(models, processor)
    return {
        "devices": [device.device_kind for device in jax.devices()],
        "threads": devices.usable_cores(),
        "processor": processor,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "versions": {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in names},
    }
