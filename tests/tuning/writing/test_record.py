"""A folder belongs to one run's settings, and its result appears whole or not at all."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.files.dataset import OutputError
from mjx_climb.files.locks import alone
from tests.shell import ROOT, environment
from tuning.command_line.session import Session
from tuning.methods.parts import Parts
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.search import Search
from tuning.writing import folder as folders
from tuning.writing import record

OURS, THEIRS = {"command": "run", "a": {"b": 1}}, {"command": "run", "a": {"b": 2}}


@dataclasses.dataclass(frozen=True)
class Walk:
    """A walk that is known by its scenario."""

    scenario: mc.Scenario


def listed(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def fill(folder, *names, settings=OURS, text="", **how):
    with record.whole(folder, settings, **how) as place:
        for name in names:
            (place / name).parent.mkdir(exist_ok=True)
            (place / name).write_text(text or name)


def test_a_result_appears_at_once_at_the_end(tmp_path):
    home = tmp_path / "results" / "one"
    with record.whole(home, OURS) as place:
        (place / "gains.yaml").write_text("")
        assert not home.parent.exists()
    assert listed(home) == ["gains.yaml", "settings.json"]
    assert record.read(home) == record.Record(OURS, ("gains.yaml",), True)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
@pytest.mark.parametrize("there", [False, True])
def test_what_ends_early_leaves_all_as_it_was(tmp_path, error, there):
    home = tmp_path / "results" / "one"
    if there:
        fill(home, "report.html", text="whole")
    before = listed(tmp_path)
    with pytest.raises(error), record.whole(home, OURS) as place:
        (place / "report.html").write_text("half")
        raise error
    assert listed(tmp_path) == before and (there or not home.parent.exists())
    assert not there or (home / "report.html").read_text() == "whole"


def test_of_another_runs_files_none_is_left_and_of_foreign_ones_all(tmp_path):
    """From Python, where the caller alone says whose folder it is; the same run keeps what it drew otherwise."""
    fill(tmp_path, "report.html", "inputs/robot.xml", "walk.mp4")
    (tmp_path / "notes.txt").write_text("mine")
    fill(tmp_path, "report.html", "gains.yaml")
    assert "walk.mp4" in listed(tmp_path)
    Parts(tmp_path, {"a": 1})
    fill(tmp_path, "report.html", "map.nc", settings=None, text="new")
    assert listed(tmp_path) == ["map.nc", "notes.txt", "report.html", "settings.json"]
    assert (tmp_path / "report.html").read_text() == "new"


@pytest.mark.parametrize("way", ["dots", "root", "link"])
def test_a_list_of_files_that_leaves_the_folder_is_refused_and_nothing_is_removed(tmp_path, way):
    """Somebody else's settings.json, in a folder that is written to from Python, or taken by a command."""
    home, thesis = tmp_path / "home", tmp_path / "thesis.tex"
    fill(home, "gains.yaml", settings=None)
    thesis.write_text("mine")
    (home / "inputs").symlink_to(tmp_path)
    name = {"dots": "inner/../../thesis.tex", "root": str(thesis), "link": "inputs/thesis.tex"}[way]
    (home / record.SETTINGS).write_text(json.dumps({"settings": None, "files": ["gains.yaml", name], "whole": True}))
    for attempt in (lambda: fill(home, "report.html", settings=None), lambda: record.check_own(home, "search.nc")):
        with pytest.raises(OutputError, match=f"^{home}: expected results with files in this folder, got '.*{name}'"):
            attempt()
    assert thesis.read_text() == "mine" and (home / "gains.yaml").exists() and not (home / "report.html").exists()


def test_no_file_of_a_result_is_written_through_a_link_that_leaves_the_folder(tmp_path):
    home, theirs = tmp_path / "home", tmp_path / "theirs"
    theirs.mkdir()
    fill(home, "gains.yaml")
    (home / "inputs").symlink_to(theirs)
    with pytest.raises(OutputError, match=r"got 'inputs/robot\.xml', which leaves it"):
        fill(home, "inputs/robot.xml")
    assert not [*theirs.iterdir()]


def test_records_and_parts_are_written_in_place_of_links(tmp_path):
    """Somebody else's, to a file of this user's that is there, or is not yet."""
    home, thesis, absent = tmp_path / "home", tmp_path / "thesis.tex", tmp_path / "absent"
    (home / "parts").mkdir(parents=True)
    thesis.write_text("mine")
    (home / record.SETTINGS).symlink_to(absent)
    (home / "parts" / "identity.json").symlink_to(absent)
    (home / "parts" / "part-000000.npz").symlink_to(thesis)
    record.begin(home, OURS)
    Parts(home, {"a": 1}).save(0, {})
    assert thesis.read_text() == "mine" and not absent.exists()
    assert record.read(home).settings == OURS and Parts(home, {"a": 1}).load(0) == {}


def test_unfinished_work_keeps_its_parts_and_is_no_whole_result(tmp_path):
    Parts(tmp_path, {"a": 1})
    fill(tmp_path, "gains.yaml", finished=False)
    assert "parts/identity.json" in listed(tmp_path) and not record.read(tmp_path).whole


def test_a_kill_between_two_files_shows(tmp_path, monkeypatch):
    fill(tmp_path, "a", "b")
    moved, replace = [], os.replace

    def die(source, target):
        if ".part" in str(source) and os.path.basename(target) in "ab":
            moved.append(target)
            if len(moved) == 2:
                raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path, "a", "b", settings=THEIRS)
    assert not record.read(tmp_path).whole


def test_two_that_write_one_folder_take_turns(tmp_path):
    fill(tmp_path, "a", text="first")
    with ThreadPoolExecutor(1) as pool:
        with alone(tmp_path):
            second = pool.submit(fill, tmp_path, "a", text="second")
            assert wait([second], timeout=0.2).not_done and (tmp_path / "a").read_text() == "first"
        second.result()
    assert (tmp_path / "a").read_text() == "second"


def test_each_run_has_a_folder_of_its_own(tmp_path):
    base = tmp_path / "case_1_2-tune"
    ours = record.own_folder(base, OURS)
    assert ours == base
    record.begin(ours, OURS)  # and is interrupted
    theirs = record.own_folder(base, THEIRS)
    assert re.fullmatch("case_1_2-tune-[0-9a-f]{6}", theirs.name)
    assert theirs != record.own_folder(base, OURS, varied=True)
    fill(theirs, "gains.yaml", settings=THEIRS)
    assert record.own_folder(base, OURS) == base
    assert record.own_folder(base, THEIRS) == theirs


@pytest.mark.parametrize(
    ("prepare", "got"),
    [
        (lambda at: fill(at, "gains.yaml", settings=THEIRS), "the result of another run, which differs in a.b"),
        (lambda at: record.begin(at, THEIRS), "unfinished work of another run, which differs in a.b"),
        (lambda at: fill(at, "gains.yaml", settings=None), "the result of unknown settings"),
        (lambda at: (at / "sweep.nc").write_text(""), r"a result without settings.json \(sweep.nc\)"),
        (lambda at: (at / record.SETTINGS).write_text("{"), "unfinished work of unknown settings"),
        (
            lambda at: (at / record.SETTINGS).write_text('{"settings": [1], "files": [], "whole": true}'),
            "unfinished work of unknown settings",
        ),
    ],
)
def test_a_folder_of_another_run_is_refused(tmp_path, prepare, got):
    prepare(tmp_path)
    with pytest.raises(OutputError, match=f"^{tmp_path}: expected a folder of this run alone, got {got} "):
        record.check(tmp_path, OURS)


def test_a_command_that_is_refused_before_it_did_any_work_leaves_no_folder(tmp_path):
    """As sweep and evaluate, which claim their folder first; a part that is kept is work."""
    for kept in (True, False):
        there = record.begin(tmp_path / "results" / "out", OURS)
        parts = Parts(tmp_path / "results" / "out", {"a": 1})
        if kept:
            parts.save(0, {})
        record.give_up(tmp_path / "results" / "out", there)
        assert (tmp_path / "results").exists() is kept
        shutil.rmtree(tmp_path / "results", ignore_errors=True)


@pytest.mark.parametrize("out", ["", "of_mine"])
def test_a_command_that_is_refused_before_it_did_any_work_leaves_a_folder_as_it_was(out, monkeypatch, tmp_path):
    """The user's own folder, the current one too; what an earlier command keeps there stays."""
    monkeypatch.chdir(tmp_path)
    (folder := Path(out)).mkdir(exist_ok=True)
    (folder / "empty").mkdir()
    (folder / "notes.txt").write_text("mine")
    record.begin(folder / "kept", OURS)
    before = sorted(tmp_path.rglob("*"))
    for place in (folder, folder / "kept", folder / "kept" / "below"):
        there = record.begin(place, OURS)
        Parts(place / "law", {"a": 1})
        record.give_up(place, there)
    assert sorted(tmp_path.rglob("*")) == before


def test_settings_are_what_is_asked_for_not_where_it_is_computed(monkeypatch):
    problem = Problem(mc.load_scenario("case_1_2"))
    before = record.settings_of(problem, "run")
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert record.settings_of(problem, "run") == before
    assert record.settings_of(Problem(mc.load_scenario("case_2")), "run") != before


CASE = str(ROOT / "configs" / "case_1_2.yaml")
GAINS, MORE = "inertia: 2.0\ndamping: 30.0\nstiffness: 500.0\n", "inertia: 2.0\ndamping: 30.0\nstiffness: 501.0\n"
OF_WALKS = ["--set duration=0.3", "--hardware dynamixel_x", "--engine mjx"]
LAWS = ["--law LoadTransfer", "--controller end_effector_admittance"]
FEW = ["--space split", "--search search.yaml"]
OF_SEARCHES = [*FEW, "--seed 2", "--pin damping=150", "--limit base_deviation=0.01", "--bound stiffness=10:20"]
GRID = "sweep {case} --stiffness 1e3:1e5:3 --damping 1e2:1e3:2"
ASKED = {  # a command, and what changes its result
    "run {case}": [*OF_WALKS, *LAWS, "--gains gains.yaml", "--gains more.yaml", "--compare pd"],
    GRID: [*OF_WALKS, LAWS[1], "--law VirtualModelAdmittance", "--gains gains.yaml", "--gains more.yaml"],
    "sweep {case} --stiffness 1e3:1e5:4 --damping 1e2:1e3:2": [],
    "tune {case}": [
        *OF_WALKS, *LAWS, *OF_SEARCHES, "--gains gains.yaml", "--method cmaes", "--ensemble ensemble",
        "--ensemble ensemble --members 5", "--ensemble ensemble --test-members 5",
    ],
    "evaluate {case} --gains gains.yaml": [*OF_WALKS, "--members 5", "--gains more.yaml", "--ensemble other.yaml"],
    "tune {case} --law pd --law base_admittance": [
        *OF_WALKS, *OF_SEARCHES, "--members 5", "--test-members 5", "--ensemble other.yaml",
    ],
    "tune {case} --law pd --law end_effector_admittance": [],
    "evaluate {case} --margins": [
        *OF_WALKS, *LAWS, "--gains gains.yaml", "--gains more.yaml", "--retuned-pd joint.yaml",
    ],
    "tune {case} --against base_deviation": [*OF_WALKS, *LAWS, *FEW, "--points 5", "--better peak_foot_force"],
    "tune {case} --over gravity,cargo": [*OF_WALKS, *LAWS, *FEW, "--over gravity=0.1,1", "--over cargo=0.5"],
}  # fmt: skip


class Claimed(Exception):
    """The command has come to where it takes its folder."""


@pytest.fixture
def claimed(monkeypatch, tmp_path):
    """Return a function that gives the settings by which a command knows its folder, and the name of that."""
    from tuning.command_line import program

    monkeypatch.chdir(tmp_path)
    files = {
        "gains": GAINS,
        "more": MORE,
        "joint": f"{GAINS}kp: 60.0\nkd: 0.5\n",
        "other": "seed: 5\n",
        "search": "seed: 1\n",
    }
    for name, text in files.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    claim = Session.claim

    def stop(self, *named, **how):
        raise Claimed(how["settings"], claim(self, *named, **how))

    monkeypatch.setattr(Session, "claim", stop)

    def run(line):
        with pytest.raises(Claimed) as stopped:
            program.program(line.split()[0])(line.format(case=CASE).split(), standalone_mode=False)
        return stopped.value.args

    return run


QUICK = ("run",)
COMMANDS = [
    pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow)
    for name in dict.fromkeys(line.split()[0] for line in ASKED)
]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_knows_its_folder_by_all_that_its_result_depends_on(command, claimed):
    """Another value of each option is another run, with a folder of its own; how it is printed or drawn is none."""
    lines = [f"{line} {more}" for line, options in ASKED.items() for more in ("", *options)]
    found = {}
    for line in (line for line in lines if line.split()[0] == command):
        settings, folder = found[line] = claimed(line)
        record.begin(folder, settings)
    for one, (settings, folder) in found.items():
        assert not [line for line, theirs in found.items() if line != one and settings == theirs[0]], one
        assert not [line for line, theirs in found.items() if line != one and folder == theirs[1]], one
    plain, last = next(iter(found)), next(reversed(found))
    assert claimed(f"{plain} --figures svg --json") == found[plain] and claimed(last) == found[last]
    if command in ("sweep", "evaluate"):
        assert claimed(f"{plain} --shard 1/2") == found[plain]


def test_members_of_an_ensemble_are_those_that_are_asked_for(claimed):
    settings, _ = claimed("tune {case} --ensemble ensemble --members 5 --test-members 7")
    assert (settings["ensemble"]["members"], settings["judges"]) == (5, 7)


class Killed(BaseException):
    """In place of SIGKILL, after which nothing is tidied up."""


@pytest.fixture
def kill(monkeypatch):
    """Return a function that lets a process die at its n-th step on disk: True where it had so many."""

    def run(work, step):
        count = 0

        def counted(function):
            def called(*arguments):
                nonlocal count
                count += 1
                if count == step:
                    raise Killed
                return function(*arguments)

            return called

        with monkeypatch.context() as patched:
            for name in ("replace", "rename", "unlink", "mkdir"):
                patched.setattr(os, name, counted(getattr(os, name)))
            patched.setattr(record.shutil, "rmtree", lambda *_, **__: None)
            try:
                work()
            except Killed:
                return True
        return False

    return run


def settled(folder):
    """Return what a folder holds as text, by name, without its record; None where it is not whole."""
    own = record.read(folder)
    there = {name: (folder / name).read_text() for name in listed(folder) if name != record.SETTINGS}
    return there if own is not None and own.whole else None


@pytest.fixture(params=[0o022, 0o002], ids=["alone", "shared with a group"])
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


@pytest.mark.parametrize("settings", [OURS, THEIRS])
@pytest.mark.parametrize("there", [False, True])
def test_killed_at_any_step_the_next_run_finds_the_old_result_or_the_new_one(tmp_path, kill, there, settings, umask):
    """Of the same run or of another; with a file that is no result's; and nothing hidden is left."""
    old, new = ({"a": text, "inputs/b": text} for text in ("old", "new"))
    new["c"] = "new"
    if settings == THEIRS:
        new.pop("a")
    foreign, seen, step = {"notes.txt": "mine"}, set(), 1
    while step:
        home = tmp_path / str(step) / "one"
        if there:
            fill(home, *old, text="old")
            (home / "notes.txt").write_text("mine")
        died = kill(lambda home=home: fill(home, *new, settings=settings, text="new"), step)
        record.recover(home)
        found = settled(home) if home.exists() else {}
        expected = [{**old, **foreign}, {**new, **foreign}] if there else [{}, new]
        if settings == OURS and there:
            expected[1] = {**old, **expected[1]}
        assert found in expected and not list(tmp_path.glob("**/.one.*.part")), step
        seen.add(expected.index(found))
        fill(home, *new, settings=settings, text="new")  # the same command again
        assert settled(home) == expected[1] and home.stat().st_mode & 0o777 == 0o777 & ~umask
        step = step + 1 if died else 0
    assert seen == {0, 1}


def test_a_folder_that_another_process_fills_is_left_alone(tmp_path):
    with record.whole(tmp_path / "one", OURS) as place:
        (place / "a").write_text("a")
        record.recover(tmp_path / "one")
        fill(tmp_path / "one", "a", text="of another that ended first")
    assert settled(tmp_path / "one") == {"a": "a"}


def test_two_that_end_at_one_moment_leave_the_result_of_one(tmp_path):
    """As the last two shards of a sweep may, which both merge: the same result twice."""
    with ThreadPoolExecutor(8) as pool:
        works = [pool.submit(fill, tmp_path / "one", "a", "b", "c", text=str(number)) for number in range(24)]
        for work in works:
            work.result()
    assert len({*settled(tmp_path / "one").values()}) == 1 and not list(tmp_path.glob("**/.*.part"))


COMMAND = """
import sys
from pathlib import Path
from mjx_climb.files.writing import OutputError
from tuning.command_line.options import Output

def command(folder, name):
    with Output(out=folder).session() as shell:
        shell.claim("trajectory.nc", "walk", settings={"command": "run", "name": name})
        with shell.whole() as place:
            (place / "trajectory.nc").write_text(name)

name, home = sys.argv[1:]
print("ready", flush=True)
for line in sys.stdin:  # the barrier
    try:
        command(Path(home, line.strip(), "one"), name)
        print("written", flush=True)
    except OutputError as error:
        print(f"refused: {error}", flush=True)
"""


@pytest.mark.slow
def test_of_two_commands_that_begin_together_one_is_refused(tmp_path):
    """Twenty times, each with one --out and other settings: nobody is told that a result is there which is gone."""
    pipes, rounds = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}, 20
    pair = [
        subprocess.Popen([sys.executable, "-c", COMMAND, name, tmp_path], env=environment(), **pipes) for name in "ab"
    ]
    assert [each.stdout.readline() for each in pair] == ["ready\n"] * 2
    for number in range(rounds):
        if number % 2:
            (tmp_path / str(number) / "one").mkdir(parents=True)
        for each in pair:
            each.stdin.write(f"{number}\n")
            each.stdin.flush()
        said = dict(zip("ab", (each.stdout.readline() for each in pair), strict=True))
        (winner,) = (name for name, text in said.items() if text == "written\n")
        (refused,) = (text for name, text in said.items() if name != winner)
        assert "expected a folder that no other command uses" in refused or "of this run alone" in refused
        assert (tmp_path / str(number) / "one" / "trajectory.nc").read_text() == winner
    for each in pair:
        each.communicate()
    assert not [*tmp_path.glob("**/.*")]


def test_a_folder_is_held_until_the_command_ends_by_all_but_shards_of_the_same(tmp_path):
    one, inner = tmp_path / "one", tmp_path / "more" / "one"
    for folder in (one, inner):
        with record.held(folder, OURS):
            (tmp_path / "more").mkdir(exist_ok=True)  # which is nearer to the second
            for settings, how in ((THEIRS, {}), (OURS, {}), (OURS, {"shard": True})):
                with pytest.raises(record.InUse, match="expected a folder that no other command uses"):
                    record.held(folder, settings, **how).__enter__()
        with record.held(folder, OURS, shard=True), record.held(folder, OURS, shard=True):
            for settings, how in ((OURS, {}), (THEIRS, {"shard": True})):
                with pytest.raises(record.InUse):
                    record.held(folder, settings, **how).__enter__()
        with record.held(folder, THEIRS):
            pass
    assert listed(tmp_path) == [] and not [*tmp_path.glob("**/.*")]


def test_what_a_killed_command_leaves_hinders_nobody_and_is_removed(tmp_path, kill, umask):
    def command():
        with record.held(tmp_path / "one", OURS):
            os.mkdir(tmp_path / "one")

    assert kill(command, 2)
    assert [*tmp_path.glob(".one.*.part")]
    with record.held(tmp_path / "one", THEIRS):
        record.recover(tmp_path / "one")
    assert not [*tmp_path.glob(".one.*.part")]


@pytest.mark.parametrize("whose", ["another's", "everybody's", "its group's"])
def test_a_result_that_another_user_planted_is_not_taken(tmp_path, monkeypatch, whose):
    """Beside the folder, or above it, under the name that this user's own unfinished move would have."""
    home = tmp_path / "above" / "one"
    fill(home, "gains.yaml", text="mine")
    with record.whole(home, OURS) as place:
        planted = tmp_path / place.name
        (place / "gains.yaml").write_text("mine")
    shutil.copytree(home, planted)
    (planted / "gains.yaml").write_text("theirs")
    if whose == "another's":
        monkeypatch.setattr(os, "geteuid", lambda: planted.stat().st_uid + 1)
    else:
        planted.chmod(0o777 if whose == "everybody's" else 0o775)
    record.recover(home)
    assert (home / "gains.yaml").read_text() == "mine" and planted.exists()
    monkeypatch.undo()
    planted.chmod(0o755)
    record.recover(home)
    assert (home / "gains.yaml").read_text() == "theirs" and not planted.exists()


def test_a_law_that_nothing_identifies_is_known_by_its_text():
    """One that holds a lock; another scenario, ensemble or text is another run."""
    case = mc.load_scenario("case_1_2")

    class Locked(mc.control.PD):
        def __init__(self, name):
            super().__init__()
            object.__setattr__(self, "name", name)
            object.__setattr__(self, "lock", threading.Lock())

        def __repr__(self):
            return f"Locked({self.name})"

    law, ensemble = Locked("a"), Ensemble(members=3)
    problems = [Problem(case, law=law), Problem(case, law=Locked("b")), Problem(case, law=law, engine="mjx"),
                Problem(case, law=law, ensemble=ensemble), Problem(case)]  # fmt: skip
    settings = [record.settings_of(problem, "run", gains=np.ones(2), search=Search(seed=3)) for problem in problems]
    assert settings[0] == record.settings_of(Problem(case, law=Locked("a")), "run", gains=[1, 1], search=Search(seed=3))
    assert all(one != other for place, one in enumerate(settings) for other in settings[:place])
    assert settings[0]["law"] == "Locked(a)" and "lock" in settings[0]["unidentified"]
    assert settings[0]["command"] == "run" and settings[0]["search"]["seed"] == 3 and settings[0]["gains"] == [1, 1]
    assert not {"versions", "platform", "batch_size"} & settings[4].keys()


def test_walks_of_a_folder_name_the_files_of_its_home(tmp_path):
    place, home, case = tmp_path / "place", tmp_path / "home", mc.load_scenario("case_1_2")
    scenario = case.with_own(law={"file": str(place / "inputs" / "law.py"), "name": "Mine"})
    walks = record.walks_at_home({"a": Walk(scenario), "b": Walk(case)}, place, home)
    assert walks["a"].scenario.own.law.file == str(home / "inputs" / "law.py") and walks["b"].scenario == case


def test_data_of_a_folder_names_the_copies_of_its_files_and_keeps_its_own_scenario():
    own = mc.load_scenario("case_1_2", {"duration": 0.5, "control.kp": 7.0})
    copied = mc.load_scenario("case_1_2", {"duration": 2.0, "hardware.control_period": 0.004})
    named = folders._naming(xr.Dataset(attrs={"scenario": own.to_yaml(), "title": "mine"}), copied)
    found = dataset.scenario_of(named)
    assert found == own.model_copy(update={"hardware": copied.hardware}) and named.attrs["title"] == "mine"
    assert folders._naming(xr.Dataset(attrs={"title": "mine"}), copied).attrs == {"title": "mine"}
