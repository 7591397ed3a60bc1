"""Names of the last version: each call is understood as one of today, and says which."""

import json

import pytest

from tests.shell import ROOT
from tuning.command_line.old_names import OLD, translated
from tuning.command_line.program import COMMANDS, program

LAWS = "pd, EndEffectorAdmittance@damping,stiffness,base_admittance,my.py:Law,A@kp,B+C@damping,kd"
NOW = {
    ("merge", "a", "--json", "b", "--out", "c", "--law=x.py"): "sweep --merge a --json --merge b --out c --law=x.py",
    ("merge", "--figures", "svg", "a"): "sweep --figures svg --merge a",
    ("judge", "c", "--gains", "g", "--members", "3"): "evaluate c --gains g --members 3",
    ("margins", "c", "--gains", "g"): "evaluate --margins c --gains g",
    ("compare", "c", "--laws", LAWS, "--members=4"): "tune --law pd c --law EndEffectorAdmittance@damping,stiffness "
    "--law base_admittance --law my.py:Law --law A@kp --law B+C@damping,kd --test-members 4",
    ("pareto", "c", "--against", "travel"): "tune --against base_deviation c --against travel",
    ("schedule", "c", "--gravity", "1", "--cargo=0"): "tune --over gravity,cargo c --over gravity=1 --over cargo=0",
    ("bench", "--quick"): "doctor --bench --quick",
    ("schema",): "doctor --schema",
    ("tune", "c", "--judges", "5"): "tune c --test-members 5",
    ("tune", "c", "--gains", "g"): "tune c --gains g",
    ("replay", "c", "--log", "l", "--judge"): "replay c --log l --with-law",
    ("run", "judge"): "run judge",
    ("run", "c", "--ceiling"): "run c --roof",
    ("robot", "r.urdf", "--ceiling"): "robot r.urdf --roof",
    ("plot", "d", "--size=60x60", "--dpi", "90"): "plot d --figure-size 60x60 --dpi 90",
    ("--help",): "--help",
    (): "",
}  # fmt: skip


@pytest.mark.parametrize("typed", NOW)
def test_calls_of_the_last_version_in_the_words_of_today(typed):
    now = translated(typed)
    assert now == NOW[typed].split()
    command = now[0] if now else ""
    if command in COMMANDS and now[1:] != ["judge"]:  # with options that it has
        (made,) = (each for each in program(command).registered_commands if each.name == command)
        known = {f"--{name.replace('_', '-')}" for names in made.callback.options.values() for name in names}
        assert {word.partition("=")[0] for word in now if word.startswith("--")} <= known | {"--json", "--schema"}


def test_an_old_name_works_and_says_the_new_one_in_one_line(call):
    """JSON on standard output as before; the help shows neither."""
    code, out, err = call("schema")
    assert code == 0 and json.loads(out)["title"] == "Scenario"
    expected = "'schema' is 'doctor --schema' now, and works for this release alone"
    assert err == f"mjx-climb: {expected}\n"
    names = {line.split()[0] for line in call("--help")[1].splitlines() if line.startswith("  ")}
    assert not names & (OLD.keys() - {"tune", "replay", "run", "robot", "plot"})
    assert call("doctor", "--schema")[1:] == (out, "")


def test_an_old_command_that_is_refused_is_refused_in_todays_words(call, tmp_path):
    code, out, err = call("compare", ROOT / "configs" / "case_1_2.yaml", "--laws", "nothing", "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    told, refused = err.splitlines()
    assert " --law nothing " in told and refused.startswith("mjx-climb: error: --law: expected pd, base_admittance")
