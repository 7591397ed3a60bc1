"""`mjx-climb doctor`: how sound this installation is, how fast, and the keys of its scenarios."""

import math
import os
import platform
import time
import warnings
from collections.abc import Iterator, Mapping
from importlib import metadata
from json import dumps
from pathlib import Path
from typing import Annotated

import typer

from tuning.benchmarks import commands
from tuning.command_line import interruption
from tuning.command_line.cache import Part, cache
from tuning.command_line.from_models import command
from tuning.command_line.options import ENGINE, EngineName, Output, reserved_stdout
from tuning.command_line.program import InputError, in_words, versions_of
from tuning.problem.settings import Options, setting

ROWS = (  # name, meaning, unit, goal on two cores
    ("closed_loop_steps_per_s", "closed loop, metrics included", "steps/s", ""),
    ("vs_mujoco_c", "against mujoco.rollout, bare dynamics", "times", "1 or more"),
    ("vs_mjx", "against the closed loop with engine mjx", "times", "5 or more"),
    ("vs_mujoco_batch", "against mujoco.batch with NumPy control", "times", "3 or more"),
    ("vs_mujoco_warp", "against mujoco_warp, bare dynamics, on a GPU", "times", ""),
    ("single_steps_per_s", "one robot", "steps/s", ""),
    ("vs_numpy_loop_single", "against a loop over mj_step with NumPy control", "times", "10 or more"),
    ("gradient_cost_2", "value and gradient by 2 gains, in values", "times", "4 or less"),
    ("gradient_cost_12", "value and gradient by 12 gains, in values", "times", "14 or less"),
    ("adjoint_cost", "gradient in reverse mode, by any number of gains, in values", "times", "8 or less"),
    ("adjoint_from", "gains from which reverse mode costs less; searches use it from 25 on", "", ""),
    ("compile_value_s", "compiling the walk, no cache", "s", "15 or less"),
    ("compile_gradient_s", "compiling its gradient by 2 gains, no cache", "s", "45 or less"),
    ("warm_start_s", "process start to first step, warm cache", "s", "3 or less"),
    ("batch_exponent", "growth of time with the batch, exponent", "", "1"),
    ("step_exponent", "growth of time with the steps, exponent", "", "1"),
    ("flops_per_env_step", "operations of a step as compiled", "", ""),
    ("flops_per_env_step_by_hand", "counted by hand", "", ""),
)
WAITS = (  # name, goals on two cores: with an empty cache, and again
    (commands.IMPORT, "", "1"),
    (commands.HELP, "", "0.2"),
    (commands.RUN, "7", "3"),
    (commands.SWEEP, "20", "5"),
    (commands.TUNE, "90", "50"),
)
QUICK = (commands.IMPORT, commands.HELP, commands.RUN)


class Bench(Options):
    """The measurement."""

    bench: bool = setting(False, "measure speed on this machine, beside MuJoCo and MJX in the same run")
    quick: bool = setting(False, "a first look, not to be quoted: fewer rounds, some figures left out")
    batch: int = setting(1024, "robots that walk at a time, a multiple of 4", ge=64)
    with_tune: bool = setting(False, "time a search of twelve gains as well, which takes minutes")
    engine: EngineName = ENGINE


def bench(asked: Bench, output: Annotated[Output, "json_only"]) -> None:
    """Measure speed on this machine, beside MuJoCo and MJX in the same run."""
    with output.session() as shell:
        if asked.batch % 4:
            raise InputError(f"--batch: expected a multiple of 4, got {asked.batch}")
        from tuning import numbers
        from tuning.benchmarks import measure
        from tuning.command_line.session import duration
        from tuning.pages.table import Table

        begin = time.perf_counter()

        def say(text: str) -> None:
            interruption.check()
            shell.say(f"{duration(time.perf_counter() - begin)}: {text}")

        plan = measure.Plan.quick if asked.quick else measure.Plan.full
        result = measure.measure(asked.engine, asked.batch, plan(asked.batch), say)
        names = QUICK if asked.quick else tuple(name for name, *_ in WAITS if name != commands.TUNE or asked.with_tune)
        waited = commands.measure(names, say)
        result["waits"] = {name: seconds._asdict() for name, seconds in waited.items()}
        say("done")
        figures = [[label, numbers.number(result[key]), unit, goal] for key, label, unit, goal in ROWS]
        waits = [[name, *map(numbers.number, waited[name]), *goals] for name, *goals in WAITS if name in waited]
        heads = ["command", "cold s", "warm s", "CPU s, cold", "CPU s, warm", "goal, cold", "goal, warm"]
        shell.show(
            Table("", ["measure", "value", "unit", "goal on two cores"], [("", figures)], 1),
            Table("", heads, [("", waits)], 1),
            f"batch {asked.batch}, engine {asked.engine}, beside mujoco {result['versions']['mujoco']}, "
            f"{result['threads']} threads of {result['processor']}, "
            f"JAX on {', '.join(sorted(set(result['devices'])))}; load average at the end {result['load_average']:.1f}",
        )
        shell.print_json(numbers.to_json(result))


PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
MUJOCO, MJX = ((3, 17), (5, 0)), (3, 17)  # as pyproject.toml lets in: from, below; the release of MJX
OF_MUJOCO_4 = ("mujoco-core", "mujoco-studio")  # write into the folder that was all mujoco's up to 3
NVIDIA = Path("/proc/driver/nvidia/version")  # there where the driver is loaded


def versions() -> Iterator[Part]:
    """Yield the versions of the packages that compute."""
    found = {"python": platform.python_version(), **versions_of("mjx-climb", *PACKAGES)}
    findings = [f"{name} is not installed: python -m pip install mjx-climb" for name in PACKAGES if not found[name]]
    parts = {name: version for name, version in versions_of(*OF_MUJOCO_4).items() if version}
    if not findings:
        findings += _of_mujoco(str(found["mujoco"]), str(found["mujoco-mjx"]), parts)
    found |= parts
    yield Part("versions", in_words(found), found, findings)


def _of_mujoco(engine: str, mjx: str, parts: Mapping[str, str]) -> Iterator[str]:
    """Yield the faults of the releases of MuJoCo and MJX, and with MuJoCo's files.

    An upgrade in place from 3 to 4 installs the new parts, then removes the old package with the files that they share.
    """
    (low, high), (release, of_mjx) = MUJOCO, ((*map(int, text.split(".")[:2]),) for text in (engine, mjx))
    wanted = f"mujoco=={engine}"
    if not low <= release < high:
        wanted = f"mujoco>={'.'.join(map(str, low))},<{high[0]}"
        yield f'mujoco {engine}: python -m pip install "{wanted}"'
    if of_mjx != MJX:
        yield f'mujoco-mjx {mjx}: python -m pip install "mujoco-mjx=={".".join(map(str, MJX))}.*"'
    expected = {} if release < (4,) else dict.fromkeys(OF_MUJOCO_4, engine)
    files = [file for name in ("mujoco", *parts) for file in metadata.files(name) or () if file.suffix != ".pyc"]
    lost = sum(not os.path.exists(file.locate()) for file in files)
    if lost or parts != expected:
        beside = f" beside {in_words(parts)}" * (parts != expected)
        remedy = f'python -m pip uninstall -y mujoco {" ".join(OF_MUJOCO_4)}; python -m pip install "{wanted}"'
        damage = f"{lost} of {len(files)} files lost, as a change of release in place leaves it"
        yield f"mujoco {engine}{beside}, {damage}: {remedy}"


def devices() -> Iterator[Part]:
    """Yield the devices of simulations, and why JAX finds no NVIDIA GPU where nobody asked for the CPU."""
    import jax

    from mjx_climb.execution.devices import usable_cores

    found, findings = [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices()], []
    facts = {"backend": jax.default_backend(), "devices": found, "cores": usable_cores()}
    if facts["backend"] == "cpu" and NVIDIA.exists() and "cpu" not in os.environ.get("JAX_PLATFORMS", "").lower():
        there = any(versions_of("jax-cuda12-plugin", "jax-cuda13-plugin").values())
        findings.append(
            "an NVIDIA GPU is here, but JAX's plugin does not start: is the driver new enough for it?"
            if there
            else 'an NVIDIA GPU is here and JAX has no plugin for it: python -m pip install "mjx-climb[cuda13]"'
        )
    yield Part("devices", f"{', '.join(found)}; {facts['cores']} CPU cores usable", facts, findings)


def path() -> Iterator[Part]:
    """Yield the path of walks: the fast one for this device, where a trial of it went well, or XLA's own."""
    from mjx_climb.execution import paths

    if (fast := paths.fast_path()) is None:
        yield Part("path", "XLA's own: none faster is made for this device", {"path": None})
    elif (found := paths.verdict(fast)).works:
        yield Part("path", f"{paths.PATHS[fast]}, {found.seen}", {"path": fast})
    else:
        remedy = "walks are right, but slower; the versions of jax and jaxlib in pyproject.toml are known to work"
        finding = f"{paths.PATHS[fast]} cannot be used here ({found.seen}): {remedy}"
        yield Part("path", "XLA's own", {"path": None}, [finding])


def renderer() -> Iterator[Part]:
    """Yield which OpenGL renders pictures and videos."""
    from mjx_climb.viz.rendering import RenderingError, backend

    found, text, findings = None, "off (MUJOCO_GL)", []
    if os.environ.get("MUJOCO_GL", "").lower().strip() not in backend.OFF:
        try:
            found = text = backend.find()
        except RenderingError as error:
            text, findings = "none: no videos, no snapshots", [str(error)]
    yield Part("renderer", text, {"backend": found}, findings)


def simulation() -> Iterator[Part]:
    """Yield how far walk, gradient and dynamics on this machine are from the stored values."""
    from tuning.benchmarks import self_check

    with warnings.catch_warnings():
        # `cache` has found it already
        warnings.filterwarnings("ignore", ".*persistent compilation cache", UserWarning)
        found = self_check.deviations(self_check.measure(), self_check.load())
    own, limit = {name: {name: found.pop(name)} for name in ("walk", "gradient")}, self_check.TOLERANCE
    for name, group in {"dynamics": found, **own}.items():
        findings = [
            f"{source}: {off.name} is {off.value}, stored is {off.stored}"
            for source, off in group.items()
            if off.size > limit
        ]
        what = f"{', '.join(group) if len(group) > 1 else ''} {'off' if findings else 'as stored'}".strip()
        largest = max(each.size for each in group.values())
        text = f"{what}, largest relative deviation {largest:.1g} (limit {limit:g})"
        sizes = {source: each.size if math.isfinite(each.size) else None for source, each in group.items()}
        yield Part(name, text, {"deviation": sizes}, findings)


def examine() -> list[Part]:
    """Return all parts, each behind those that it depends on."""
    parts: list[Part] = []
    for examination in (versions, devices, cache, path, renderer, simulation):
        interruption.check()
        try:
            parts += examination()
        except Exception as error:  # the other parts are still of interest
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            parts.append(Part(examination.__name__, "could not be examined", {}, [reason]))
    return parts


class Schema(Options):
    """The keys of a scenario."""

    of_scenarios: bool = setting(False, "print the JSON schema of scenarios, for editors", flag="--schema")
    out: Path | None = setting(None, "file to write the schema to; null: standard output", metavar="FILE")


def schema(asked: Schema) -> None:
    """Print the JSON schema of scenarios: every key with its type, range, unit and default."""
    import mjx_climb as mc
    from mjx_climb.files import dataset

    tree = {"$schema": "https://json-schema.org/draft/2020-12/schema", **mc.Scenario.model_json_schema()}
    text = dumps(tree, indent=2) + "\n"
    if asked.out is None:
        typer.echo(text, nl=False)
    else:
        dataset.write_text_atomically(asked.out, text)


@command("Is this installation sound, and how fast?", forms={"bench": bench, "of_scenarios": schema})
def doctor(output: Annotated[Output, "json_only"]) -> None:
    """Examine this installation: does it compute right?

    Prints versions, devices, the state of the compilation cache and which OpenGL renders. Then walks half a second and
    takes its gradient by the gains, solves the equations of motion with both engines and with MuJoCo's C code, and
    compares with values stored in the package, to nine digits. Half a minute or so, twice that where the compilation
    cache is empty. Each fault comes with its remedy.

    Exit code 0: all is well. 1: something is wrong.

    --bench: a batch of robots walks under base admittance in single precision, all metrics included. Its peers on the
    same cores: mujoco.rollout of the bare dynamics; this program with the dynamics of MJX; mujoco.batch, and a loop
    over mj_step, under the same control law and grip in NumPy. On a GPU mujoco_warp too, where the extra `compare` has
    installed it: the bare dynamics, in CUDA graphs. Medians of rounds of all by turns. Then the times that a user
    waits for, whole commands in processes of their own, with an empty cache and again. Needs the machine for itself,
    and a few minutes.

    --schema: every key of a scenario with its type, range, unit and default. An editor with YAML support (VS Code,
    Neovim, Emacs: yaml-language-server) completes and checks a scenario whose first line names the file:

    \b
      # yaml-language-server: $schema=scenario.schema.json

    \b
    Examples:
      mjx-climb doctor
      mjx-climb doctor --json
      mjx-climb doctor --bench --quick
      mjx-climb doctor --schema --out scenario.schema.json
    """
    with reserved_stdout() as stdout:
        from mjx_climb.scenario.messages import printable

        begin, parts = time.perf_counter(), examine()
        wrong = [part.name for part in parts if part.findings]
        said = "All is well: physics and gradients on this machine are those stored with the package."
        if wrong:
            said = f"Something is wrong with {' and '.join(filter(None, [', '.join(wrong[:-1]), wrong[-1]]))}."
        if output.json_only:
            found = {part.name: {**part.facts, "findings": list(part.findings)} for part in parts}
            print(dumps({"sound": not wrong, "verdict": said, "parts": found}, indent=2, allow_nan=False), file=stdout)
        else:
            for part in parts:
                print(printable(f"{part.name:9} {part.text}", "\n"), file=stdout)
                for finding in part.findings:
                    print(printable(f"{'':9} ! {finding}", "\n"), file=stdout)
            print(f"\n{said} ({time.perf_counter() - begin:.0f} s)", file=stdout)
    raise typer.Exit(1 if wrong else 0)
