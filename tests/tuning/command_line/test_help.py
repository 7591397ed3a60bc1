"""What the program says of itself: help of every command, and completion in three shells, without heavy imports."""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import mjx_climb as mc
from mjx_climb.scenario import shipped
from mjx_climb.walk.metrics import FAILURES
from tests import approved
from tests.shell import PROGRAM, ROOT, environment
from tuning.command_line import from_models
from tuning.command_line.options import EngineName
from tuning.command_line.program import COMMANDS
from tuning.problem import search

HEAVY = {"jax", "numpy", "matplotlib", "xarray", "mujoco", "yaml"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples_and_says_what_each_option_does(call, command):
    code, text, _ = call(command, "--help")
    examples = re.findall(rf"^    (mjx-climb {command}.*)$", text, re.MULTILINE)
    assert code == 0 and examples
    assert max(map(len, text.splitlines())) <= 100  # as wide as the documentation shows without scrolling
    for option in re.findall(r"--[a-z-]+", " ".join(examples)):
        assert re.search(rf"^  {option}\b", text, re.MULTILINE), option
    for parameter in re.split(r"\n(?=  -)", text.partition("\nOptions:\n")[2]):
        assert re.search(r"(  |\n {10,})[A-Z]\w*[:,]? \w+", parameter), parameter  # a sentence
    # headings, options, their values, ranges and defaults
    behind = text[text.rindex(examples[-1]) + len(examples[-1]) :].strip()
    approved.check(Path(__file__).parent / "approved" / "help" / f"{command}.txt", f"{behind}\n")


def test_the_list_of_commands_is_not_cut_off(call):
    text = call("--help")[1]
    listed = re.findall(r"^  (\w+) +(.+)$", text.partition("\nCommands:\n")[2].partition("\n\n")[0], re.MULTILINE)
    assert dict(listed) == COMMANDS


def light(arguments, heavy, **how):
    """Run the program with some arguments in a process that must not import anything heavy."""
    script = (
        f"import sys, tuning.command_line as c\ntry: c.main({arguments})\n"
        f"except SystemExit as end: assert not end.code\n"
        f"assert not {set(heavy)} & set(sys.modules), {set(heavy)} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, **how)
    assert (done.returncode, done.stderr) == (0, "")
    return done


@pytest.mark.parametrize("arguments", [["--help"], ["tune", "--help"]])
def test_help_needs_nothing_heavy(arguments):
    """Its time is that of the imports, and numbers and pictures are not needed to say what there is."""
    assert "mjx-climb tune case_1_2" in light(arguments, HEAVY, cwd=ROOT).stdout


def complete(line, shell="bash", folder=ROOT / "tests", heavy=HEAVY):
    """Return what a shell is told at the end of a line."""
    asked = {
        "_MJX_CLIMB_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    done = light([], heavy, cwd=folder, env=environment(**asked))
    return re.findall(r'"(.+?)"', done.stdout) if shell == "zsh" else done.stdout.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_options_and_their_values(shell):
    assert complete("mjx-climb tune case_1_2 --method ", shell) == list(search.METHODS)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("mjx-climb ", list(COMMANDS)),
        ("mjx-climb sw", ["sweep"]),
        ("mjx-climb run ", [*shipped.names(), "mine.yaml", "other.yml"]),
        ("mjx-climb run m", ["mine.yaml"]),
        ("mjx-climb run case_2 --engine ", list(get_args(EngineName))),
        ("mjx-climb run case_2 --controller base", ["base_admittance"]),
        ("mjx-climb tune case_2 --space ", list(search.LAYOUTS)),
        ("mjx-climb tune case_2 --ensemble e", shipped.ensembles()),
        ("mjx-climb tune case_2 --against min_", ["min_tsm", "min_gia_margin"]),
    ],
)
def test_names_complete(line, expected, tmp_path):
    for name in ("mine.yaml", "other.yml", "mine.csv"):
        (tmp_path / name).write_text("")
    assert complete(line, folder=tmp_path) == expected


def test_keys_of_the_scenario_complete(tmp_path):
    """The models of the scenario are imported for it, and yaml with them."""
    below = [f"disturbance.cargo.{name}=" for name in ("mass", "start", "stop")]
    assert complete("mjx-climb run case_2 --set disturbance.c", heavy=HEAVY - {"yaml"}) == below
    found = complete("mjx-climb tune case_2 --set control.", "zsh", heavy=HEAVY - {"yaml"})
    control, expected = mc.Scenario().control, []
    for name in type(control).model_fields:
        below = [f"{name}.{key}" for key in type(control.recovery).model_fields] if name == "recovery" else [name]
        expected += [f"control.{key}=" for key in below]
    assert found == expected


def test_names_written_for_completion_are_the_real_ones():
    assert set(get_args(EngineName)) == set(mc.ENGINES)
    assert set(from_models.metric_names()) == set(mc.METRICS.names) - set(FAILURES)
    assert {"case_1_1", "case_1_2", "case_2", "limbero_like_cliff"} <= set(shipped.names())


def completion(*arguments, **variables):
    quiet = environment(_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1", **variables)
    return subprocess.run(
        [*PROGRAM, *arguments], cwd=ROOT, env=quiet, capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.parametrize("shell", ["bash", *(pytest.param(s, marks=pytest.mark.slow) for s in ("zsh", "fish"))])
def test_completion_installs_in_a_home_and_sources(shell, tmp_path):
    shown = completion("--show-completion", shell, HOME=str(tmp_path))
    completion("--install-completion", shell, HOME=str(tmp_path))
    assert "_MJX_CLIMB_COMPLETE" in shown
    scripts = [file for file in tmp_path.rglob("*mjx-climb*") if file.is_file()]
    assert [file.read_text().strip() for file in scripts] == [shown.strip()]


@pytest.mark.slow
def test_bash_asks_the_program(tmp_path):
    """The script, sourced in a real bash, fills in what the program answers."""
    program = tmp_path / "mjx-climb"
    program.write_text(f'#!/bin/bash\nPYTHONPATH={ROOT} exec {shlex.join(PROGRAM)} "$@"\n')
    program.chmod(0o755)
    press = 'COMP_WORDS=(mjx-climb export --format j); COMP_CWORD=3; _mjx_climb_completion "$0"; echo "${COMPREPLY[@]}"'
    script = f"{completion('--show-completion', 'bash')}\n{press}"
    done = subprocess.run(["bash", "-c", script, str(program)], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["json"], done.stderr
