"""`mjx-climb bench`: how fast, against what."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError

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


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="A first look, not to be quoted: fewer rounds, some figures left out.")
    ] = False,
    batch: Annotated[
        int, typer.Option(min=SMALLEST_BATCH, metavar="N", help="Robots that walk at a time, a multiple of 4.")
    ] = BATCH,
    json: options.Json = False,
    engine: options.Engine = None,
) -> None:
    """Measure speed on this machine, beside MuJoCo and MJX in the same run.

    A batch of robots walks under base admittance in single precision, all metrics worked out. Its peers on the same
    cores: mujoco.rollout of the bare dynamics; this program with the dynamics of MJX; mujoco.batch, and a loop over
    mj_step, under the same control law and grip in NumPy. Medians of rounds in which all take turns. Needs the machine
    for itself, and a few minutes.

    \b
    Examples:
      mjx-climb bench
      mjx-climb bench --quick --json
    """
    with options.reserved_stdout() as stdout:
        import time

        engine = options.engine_from(engine)
        if batch % 4:
            raise InputError(f"--batch: expected a multiple of 4, got {batch}")
        from tuning.benchmarks import measure
        from tuning.command_line import interruption, progress, report

        console = report.console(stderr=True)
        begin = time.perf_counter()

        def say(text: str) -> None:
            interruption.check()
            console.print(f"{progress.duration(time.perf_counter() - begin)}: {text}", highlight=False)

        result = measure.measure(engine, batch, measure.Plan.quick(batch) if quick else measure.Plan.full(batch), say)
        say("done")
        tables = console if json else report.console(file=stdout)
        tables.print(_table(result))
        tables.print(
            f"batch {batch}, engine {engine}, {result['threads']} threads of {result['processor']}, "
            f"JAX on {', '.join(sorted(set(result['devices'])))}; load average at the end {result['load_average']:.1f}",
            soft_wrap=True,
        )
        if json:
            print(report.to_json(result), file=stdout)


def _table(result: Mapping[str, Any]) -> "Table":
    from rich import box
    from rich.table import Table

    from tuning.command_line import report

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for name in ("measure", "value", "unit", "goal on two cores"):
        table.add_column(name, justify="right" if name == "value" else "left", no_wrap=True)
    for key, label, unit, goal in ROWS:
        table.add_row(label, report.number(result[key]), unit, goal)
    return table
