"""What the program says of itself: help of every command, and completion in three shells, without heavy imports."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mjx_climb as mc
from mjx_climb.scenario import shipped
from mjx_climb.walk.metrics import FAILURES
from tuning.command_line import completion, main
from tuning.command_line.program import app
from tuning.problem import search

ROOT = Path(__file__).parents[3]
COMMANDS = [command.name for command in app.registered_commands]
HEAVY = {"jax", "numpy", "matplotlib", "xarray", "mujoco", "yaml"}


@pytest.fixture
def say(capsys):
    def say(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        assert ended.value.code == 0
        return capsys.readouterr().out

    return say


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_examples_and_says_what_each_option_does(say, command):
    text = say(command, "--help")
    examples = re.findall(rf"^    (mjx-climb {command}.*)$", text, re.MULTILINE)
    assert examples
    for option in re.findall(r"--[a-z-]+", " ".join(examples)):
        assert re.search(rf"^  {option}\b", text, re.MULTILINE), option
    for parameter in re.split(r"\n(?=  -)", text.partition("\nOptions:\n")[2]):
        assert re.search(r"(  |\n {10,})[A-Z]\w*[:,]? \w+", parameter), parameter  # a sentence


def test_the_list_of_commands_is_not_cut_off(say):
    text = say("--help")
    listed = re.findall(r"^  (\w+) +(.+)$", text.partition("\nCommands:\n")[2].partition("\n\n")[0], re.MULTILINE)
    assert [name for name, _ in listed] == COMMANDS
    assert all(words.endswith(".") and not words.endswith("...") for _, words in listed)


def complete(line, shell="bash", folder=ROOT / "tests", heavy=frozenset(HEAVY)):
    """Return what a shell is told at the end of a line, by a process that must not import anything heavy."""
    program = (
        "import sys, tuning.command_line as c\n"
        "try: c.main([])\n"
        "except SystemExit as end: assert not end.code\n"
        f"assert not {set(heavy)} & set(sys.modules), {set(heavy)} & set(sys.modules)"
    )
    asked = {
        "_MJX_CLIMB_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split(" ")) - 1),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    environment = os.environ | asked | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return re.findall(r'"(.+?)"', done.stdout) if shell == "zsh" else done.stdout.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_options_and_their_values(shell):
    assert complete("mjx-climb tune case_1_2 --method ", shell) == list(search.METHODS)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("mjx-climb ", COMMANDS),
        ("mjx-climb sw", ["sweep"]),
        ("mjx-climb run ", [*shipped.names(), "mine.yaml"]),
        ("mjx-climb run m", ["mine.yaml"]),
        ("mjx-climb run case_2 --engine ", list(completion.ENGINES)),
        ("mjx-climb run case_2 --controller base", ["base_admittance"]),
        ("mjx-climb tune case_2 --space ", list(search.LAYOUTS)),
        ("mjx-climb tune case_2 --ensemble e", ["ensemble", "ensemble_dynamixel_x"]),
        ("mjx-climb pareto case_2 --against min_", ["min_tsm", "min_gia_margin"]),
    ],
)
def test_names_complete(line, expected, tmp_path):
    (tmp_path / "mine.yaml").write_text("")
    assert complete(line, folder=tmp_path) == expected


def test_keys_of_the_scenario_complete(tmp_path):
    """The models of the scenario are imported for it, and yaml with them."""
    below = [f"disturbance.cargo.{name}=" for name in ("mass", "start", "stop")]
    assert complete("mjx-climb run case_2 --set disturbance.c", heavy=HEAVY - {"yaml"}) == below
    found = complete("mjx-climb tune case_2 --set control.", "zsh", heavy=HEAVY - {"yaml"})
    assert found == [f"control.{name}=" for name in type(mc.Scenario().control).model_fields]


def test_names_written_for_completion_are_the_real_ones():
    assert set(completion.ENGINES) == set(mc.ENGINES)
    assert set(completion.METRICS) == set(mc.METRICS.names) - set(FAILURES)
    assert {"case_1_1", "case_1_2", "case_2", "limbero_like_cliff"} <= set(shipped.names())


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_installs_in_a_home_and_sources(shell, tmp_path):
    environment = os.environ | {"HOME": str(tmp_path), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    command = [sys.executable, "-m", "tuning.command_line"]
    how = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True}
    shown = subprocess.run([*command, "--show-completion", shell], **how)
    installed = subprocess.run([*command, "--install-completion", shell], **how)
    assert shown.returncode == installed.returncode == 0, installed.stderr
    assert "_MJX_CLIMB_COMPLETE" in shown.stdout
    scripts = [file for file in tmp_path.rglob("*mjx-climb*") if file.is_file()]
    assert [file.read_text().strip() for file in scripts] == [shown.stdout.strip()]


def test_bash_asks_the_program(tmp_path):
    """The script, sourced in a real bash, fills in what the program answers."""
    script = subprocess.run(
        [sys.executable, "-m", "tuning.command_line", "--show-completion", "bash"],
        cwd=ROOT,
        env=os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
    ).stdout
    program = tmp_path / "mjx-climb"
    program.write_text(f'#!/bin/bash\nPYTHONPATH={ROOT} exec "{sys.executable}" -m tuning.command_line "$@"\n')
    program.chmod(0o755)
    press = 'COMP_WORDS=(mjx-climb export --format j); COMP_CWORD=3; _mjx_climb_completion "$0"; echo "${COMPREPLY[@]}"'
    done = subprocess.run(
        ["bash", "-c", f"{script}\n{press}", str(program)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.split() == ["json"], done.stderr
