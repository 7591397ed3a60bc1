"""`mjx-climb bench`: how fast, against what."""

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from tuning.benchmarks import commands
from tuning.command_line.ending import InputError
from tuning.command_line.from_models import command
from tuning.command_line.options import ENGINE, EngineName, Output
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from rich.table import Table

BATCH = 1024
SMALLEST_BATCH = 64

# name, what it is, unit, what it should be on two cores
ROWS = (
    ("closed_loop_steps_per_s", "closed loop, metrics included", "steps/s", ""),
    ("vs_mujoco_c", "against mujoco.rollout, bare dynamics", "times", "1 or more"),
    ("vs_mjx", "against the closed loop with engine mjx", "times", "5 or more"),
    ("vs_mujoco_batch", "against mujoco.batch with NumPy control", "times", "3 or more"),
    ("vs_mujoco_warp", "against mujoco_warp, bare dynamics, on a GPU", "times", ""),
    ("single_steps_per_s", "one robot", "steps/s", ""),
    ("vs_numpy_loop_single", "against a loop over mj_step with NumPy control", "times", "10 or more"),
    ("gradient_cost_2", "value and gradient by 2 gains, in values", "times", "4 or less"),
    ("gradient_cost_12", "value and gradient by 12 gains, in values", "times", "14 or less"),
    ("compile_value_s", "compiling the walk, no cache", "s", "15 or less"),
    ("compile_gradient_s", "compiling its gradient by 2 gains, no cache", "s", "45 or less"),
    ("warm_start_s", "process start to first step, warm cache", "s", "3 or less"),
    ("batch_exponent", "growth of time with the batch, exponent", "", "1"),
    ("step_exponent", "growth of time with the steps, exponent", "", "1"),
    ("flops_per_env_step", "operations of a step as compiled", "", ""),
    ("flops_per_env_step_by_hand", "counted by hand", "", ""),
)


# name, goals on two cores: with an empty cache, and again
WAITS = (
    (commands.IMPORT, "", "1"),
    (commands.HELP, "", "0.2"),
    (commands.RUN, "7", "3"),
    (commands.SWEEP, "20", "5"),
    (commands.TUNE, "90", "50"),
)
QUICK = (commands.IMPORT, commands.HELP, commands.RUN)


class Bench(Options):
    """What is measured."""

    quick: bool = setting(False, "a first look, not to be quoted: fewer rounds, some figures left out")
    batch: int = setting(BATCH, "robots that walk at a time, a multiple of 4", ge=SMALLEST_BATCH)
    with_tune: bool = setting(False, "time a search of twelve gains as well, which takes minutes")
    engine: EngineName = ENGINE


def bench(asked: Bench, output: Annotated[Output, "json_only"]) -> None:
    """Measure speed on this machine, beside MuJoCo and MJX in the same run.

    A batch of robots walks under base admittance in single precision, all metrics worked out. Its peers on the same
    cores: mujoco.rollout of the bare dynamics; this program with the dynamics of MJX; mujoco.batch, and a loop over
    mj_step, under the same control law and grip in NumPy. On a GPU mujoco_warp too, where the extra `compare` has
    installed it: the bare dynamics, in CUDA graphs. Medians of rounds in which all take turns. Then what a user
    waits for, whole commands in processes of their own, with an empty cache and again. Needs the machine for itself,
    and a few minutes.

    \b
    Examples:
      mjx-climb bench
      mjx-climb bench --quick --json
    """
    with output.session() as shell:
        if asked.batch % 4:
            raise InputError(f"--batch: expected a multiple of 4, got {asked.batch}")
        from tuning.benchmarks import measure
        from tuning.command_line import interruption, progress
        from tuning.report import numbers

        engine, batch = asked.engine, asked.batch
        begin = time.perf_counter()

        def say(text: str) -> None:
            interruption.check()
            shell.say(f"{progress.duration(time.perf_counter() - begin)}: {text}")

        result = measure.measure(
            engine, batch, measure.Plan.quick(batch) if asked.quick else measure.Plan.full(batch), say
        )
        names = QUICK if asked.quick else tuple(name for name, *_ in WAITS if name != commands.TUNE)
        waited = commands.measure((*names, commands.TUNE) if asked.with_tune else names, say)
        result["waits"] = {name: seconds._asdict() for name, seconds in waited.items()}
        say("done")
        shell.show(
            _table(result),
            _waits(waited),
            f"batch {batch}, engine {engine}, {result['threads']} threads of {result['processor']}, "
            f"JAX on {', '.join(sorted(set(result['devices'])))}; load average at the end {result['load_average']:.1f}",
        )
        shell.print_json(numbers.to_json(result))


def _table(result: Mapping[str, Any]) -> "Table":
    from rich import box
    from rich.table import Table

    from tuning.report import numbers

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for name in ("measure", "value", "unit", "goal on two cores"):
        table.add_column(name, justify="right" if name == "value" else "left", no_wrap=True)
    for key, label, unit, goal in ROWS:
        table.add_row(label, numbers.number(result[key]), unit, goal)
    return table


def _waits(waited: Mapping[str, commands.Waited]) -> "Table":
    from rich import box
    from rich.table import Table

    from tuning.report import numbers

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for name in ("command", "cold s", "warm s", "CPU s, cold", "CPU s, warm", "goal, cold", "goal, warm"):
        table.add_column(name, justify="left" if name == "command" else "right", no_wrap=True)
    for name, *goals in WAITS:
        if name in waited:
            table.add_row(name, *(numbers.number(seconds) for seconds in waited[name]), *goals)
    return table


COMMAND = command(bench)
