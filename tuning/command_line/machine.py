"""`mjx-climb bench` and `doctor`: how fast and how sound this installation is."""

import dataclasses
import importlib.metadata
import math
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Iterable, Sequence
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tuning.benchmarks import commands
from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import ENGINE, EngineName, Output, reserved_stdout
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from rich.table import Table

WORDS = ("measure", "unit", "command", "goal on two cores")  # columns that hold no numbers
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


@command()
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
        from tuning.command_line.session import duration
        from tuning.report import numbers

        engine, batch = asked.engine, asked.batch
        begin = time.perf_counter()

        def say(text: str) -> None:
            interruption.check()
            shell.say(f"{duration(time.perf_counter() - begin)}: {text}")

        result = measure.measure(
            engine, batch, measure.Plan.quick(batch) if asked.quick else measure.Plan.full(batch), say
        )
        names = QUICK if asked.quick else tuple(name for name, *_ in WAITS if name != commands.TUNE)
        waited = commands.measure((*names, commands.TUNE) if asked.with_tune else names, say)
        result["waits"] = {name: seconds._asdict() for name, seconds in waited.items()}
        say("done")
        shell.show(
            _table(
                ("measure", "value", "unit", "goal on two cores"),
                ((label, numbers.number(result[key]), unit, goal) for key, label, unit, goal in ROWS),
            ),
            _table(
                ("command", "cold s", "warm s", "CPU s, cold", "CPU s, warm", "goal, cold", "goal, warm"),
                ((name, *map(numbers.number, waited[name]), *goals) for name, *goals in WAITS if name in waited),
            ),
            f"batch {batch}, engine {engine}, {result['threads']} threads of {result['processor']}, "
            f"JAX on {', '.join(sorted(set(result['devices'])))}; load average at the end {result['load_average']:.1f}",
        )
        shell.print_json(numbers.to_json(result))


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> "Table":
    from tuning.command_line.session import plain_table

    table = plain_table(*columns)
    for column in table.columns:
        column.justify = "left" if column.header in WORDS else "right"
    for row in rows:
        table.add_row(*row)
    return table


PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
SIMULATION = ("walk", "gradient")
NVIDIA = Path("/proc/driver/nvidia/version")  # there where the driver is loaded


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of an installation."""

    name: str
    text: str  # one line for people
    facts: dict[str, Any]  # plain values
    findings: tuple[str, ...] = ()  # what is wrong and what to do, one line each


def examine() -> list[Part]:
    """Return all parts, in the order in which they depend on each other."""
    parts: list[Part] = []
    for examination in (versions, devices, cache, path, renderer, simulation):
        interruption.check()
        try:
            found = examination()
            parts += found if isinstance(found, list) else [found]
        except Exception as error:  # whatever it is, the other parts are still of interest
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            parts.append(Part(examination.__name__, "could not be examined", {}, (reason,)))
    return parts


def versions() -> Part:
    """Return the versions of what computes."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    found |= {name: _version(name) for name in ("mjx-climb", *PACKAGES)}
    missing = [name for name in PACKAGES if found[name] is None]
    findings = [f"{name} is not installed: python -m pip install mjx-climb" for name in missing]
    engine, mjx = found["mujoco"], found["mujoco-mjx"]
    if not missing and engine != mjx:
        findings.append(f'mujoco {engine} with mujoco-mjx {mjx}: python -m pip install "mujoco=={mjx}"')
    text = ", ".join(f"{name} {version or '(not installed as a package)'}" for name, version in found.items())
    return Part("versions", text, found, tuple(findings))


def devices() -> Part:
    """Return what the simulations run on."""
    import jax

    from mjx_climb.execution.devices import usable_cores

    found = [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices()]
    facts = {"backend": jax.default_backend(), "devices": found, "cores": usable_cores()}
    text = f"{', '.join(found)}; {facts['cores']} CPU cores usable"
    return Part("devices", text, facts, _unused_gpu() if facts["backend"] == "cpu" else ())


def _unused_gpu() -> tuple[str, ...]:
    """Return what keeps JAX from an NVIDIA GPU of this machine, where it has one and nobody asked for the CPU."""
    if not NVIDIA.exists() or "cpu" in os.environ.get("JAX_PLATFORMS", "").lower():
        return ()
    plugins = [f"jax-cuda{major}-plugin" for major in (12, 13)]
    if not any(_version(plugin) for plugin in plugins):
        return ('an NVIDIA GPU is here and JAX has no plugin for it: python -m pip install "mjx-climb[cuda13]"',)
    return ("an NVIDIA GPU is here, but JAX's plugin does not start: is the driver new enough for it?",)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def cache() -> Part:
    """Return the state of XLA's compilation cache."""
    from mjx_climb.execution.cache import VARIABLE, asked_folder, cache_in_use, doubt

    folder = cache_in_use()
    if folder is None:
        text = f"off ({VARIABLE}): every start compiles again"
        asked = asked_folder()
        why = None if asked is None else doubt(asked)
        return Part("cache", text, {"on": False, "folder": None}, () if why is None else (why,))
    sizes = [file.stat().st_size for file in Path(folder).glob("*-cache")]
    facts = {"on": True, "folder": folder, "programs": len(sizes), "bytes": sum(sizes), "writable": True}
    text = f"{folder}, {len(sizes)} programs, {sum(sizes) / 1e6:.0f} MB"
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        remedy = f"set {VARIABLE} to a folder that can be, or to off"
        reason = (error.strerror or str(error)).lower()
        finding = f"{folder} cannot be written ({reason}), so every start compiles again: {remedy}"
        return Part("cache", text, {**facts, "writable": False}, (finding,))
    return Part("cache", text, facts)


def path() -> Part:
    """Return by which path robots walk: the fast one for this device, where a trial of it went well, or XLA's own."""
    from mjx_climb.execution import paths, probe

    fast = paths.fast_path()
    if fast is None:
        return Part("path", "XLA's own: none faster is made for this device", {"path": None})
    found = probe.verdict(fast)
    if not found.works:
        remedy = "walks are right, but slower; the versions of jax and jaxlib in pyproject.toml are known to work"
        finding = f"{probe.PATHS[fast]} cannot be used here ({found.seen}): {remedy}"
        return Part("path", "XLA's own", {"path": None}, (finding,))
    return Part("path", f"{probe.PATHS[fast]}, {found.seen}", {"path": fast})


def renderer() -> Part:
    """Return which OpenGL renders pictures and videos."""
    from mjx_climb.rendering import RenderingError, backend

    if os.environ.get("MUJOCO_GL", "").lower().strip() in backend.OFF:
        return Part("renderer", "off (MUJOCO_GL)", {"backend": None})
    try:
        found = backend.find()
    except RenderingError as error:
        return Part("renderer", "none: no videos, no snapshots", {"backend": None}, (str(error),))
    return Part("renderer", found, {"backend": found})


def simulation() -> list[Part]:
    """Return how far walk, gradient and dynamics on this machine are from the stored values."""
    from mjx_climb.checks import self_check

    with warnings.catch_warnings():
        # what `cache` has found already
        warnings.filterwarnings("ignore", ".*persistent compilation cache", UserWarning)
        measured = self_check.measure()
    found = self_check.deviations(measured, self_check.load())
    dynamics = {name: found[name] for name in found if name not in SIMULATION}
    parts, limit = [], self_check.TOLERANCE
    for name, group in (("dynamics", dynamics), *((name, {name: found[name]}) for name in SIMULATION)):
        off = {source: each for source, each in group.items() if not each.size <= limit}
        findings = tuple(f"{source}: {o.name} is {o.value}, stored is {o.stored}" for source, o in off.items())
        what = f"{', '.join(group) if len(group) > 1 else ''} {'off' if off else 'as stored'}".strip()
        largest = max(each.size for each in group.values())
        text = f"{what}, largest relative deviation {largest:.1g} (limit {limit:g})"
        sizes = {source: each.size if math.isfinite(each.size) else None for source, each in group.items()}
        parts.append(Part(name, text, {"deviation": sizes}, findings))
    return parts


@command()
def doctor(output: Annotated[Output, "json_only"]) -> None:
    """Examine this installation: does it compute what it should?

    Prints versions, devices, the state of the compilation cache and which OpenGL renders. Then walks half a second and
    takes its gradient by the gains, solves the equations of motion with both engines and with MuJoCo's C code, and
    compares with values stored in the package, to nine digits. Half a minute or so, twice that where the compilation
    cache is empty. Says of all that is wrong what to do about it.

    Exit code 0: all is well. 1: something is wrong.

    \b
    Examples:
      mjx-climb doctor
      mjx-climb doctor --json
    """
    with reserved_stdout() as stdout:
        begin = time.perf_counter()
        parts = examine()
        wrong = [part.name for part in parts if part.findings]
        sound = not wrong
        said = "All is well: physics and gradients on this machine are those stored with the package."
        if wrong:
            said = f"Something is wrong with {' and '.join(filter(None, [', '.join(wrong[:-1]), wrong[-1]]))}."
        if output.json_only:
            found = {part.name: {**part.facts, "findings": list(part.findings)} for part in parts}
            print(dumps({"sound": sound, "verdict": said, "parts": found}, indent=2, allow_nan=False), file=stdout)
        else:
            for part in parts:
                print(f"{part.name:9} {part.text}", file=stdout)
                for finding in part.findings:
                    print(f"{'':9} ! {finding}", file=stdout)
            print(f"\n{said} ({time.perf_counter() - begin:.0f} s)", file=stdout)
    raise typer.Exit(0 if sound else 1)
