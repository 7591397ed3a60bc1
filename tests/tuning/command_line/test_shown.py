"""What commands show of walks, of searches that go on, and of results before they are whole; processes that agree."""

import contextlib
import io
import math
import re
import types

import numpy as np
import pytest
from jax.experimental import multihost_utils

import mjx_climb as mc
from tuning.command_line import logs, run, session
from tuning.command_line.processes import Process, Team
from tuning.command_line.program import InputError
from tuning.comparisons import remedies
from tuning.pages import comparison
from tuning.writing import folder, record

CASE = mc.load_scenario("case_1_2")
NAMED = types.SimpleNamespace(files="map.png")
HELD = dict.fromkeys(mc.METRICS.names, 1.0) | {
    "detached_limb": None, "detached_at": None, "stands_at": None, "missed_grips": 0, "diverged": False
}  # fmt: skip


def walk(controller, **changes):
    """A walk of five steps, whose numbers are finite, and which had all of its sensors."""
    scenario = CASE.with_overrides({"control.controller": controller})
    rows = {name: np.zeros((5, 3)) for name in ("base_position", "joint_rates", "foot_force", "joint_torque")}
    rest = dict(scenario=scenario, law="", gains={}, lost_sensors={}, falls_at=None, standing={}, gap=0.0)
    return types.SimpleNamespace(time=np.arange(5) / 10, **rows | rest | changes)


class Shell:
    """A session that keeps its tables, lines and names of stages."""

    def __init__(self):
        self.shown, self.stages, self.tables = [], [], types.SimpleNamespace(width=90)

    def show(self, *what):
        self.shown += what

    @contextlib.contextmanager
    def stage(self, name, **how):
        self.stages.append((name, how))
        yield lambda *_: None


def test_of_one_walk_all_metrics_are_shown_and_what_would_keep_its_grippers(monkeypatch):
    asked = []
    monkeypatch.setattr(remedies, "remedies", lambda *how: asked.append(how) or "a remedy")
    shell, law = Shell(), mc.control.PD()
    loaded = types.SimpleNamespace(metrics=mc.METRICS, law=law)
    metrics = HELD | {"detached_limb": "LF", "detached_at": 0.25, "min_tsm": 1e6}
    one = walk("pd", lost_sensors={"RH": 0.2})
    run.show({"mine": one}, {"mine": metrics}, loaded, shell)
    table, verdict, sensor, weight, remedy = shell.shown
    ((_, rows),) = table.sections
    assert [name for name, *_ in rows] == [mc.METRICS.in_words(name) for name in metrics]
    assert rows[0][1:] == ["1", "N"] and verdict == "limb LF let go at 0.250 s"
    assert sensor == "mine ran without the force sensor of RH from 0.20 s" and weight.startswith("min TSM is a moment")
    assert remedy == "a remedy" and shell.stages == [("what would help", {"compiles": False})]
    assert asked == [(one.scenario, 0.25, law)]


def test_two_walks_are_shown_beside_the_rival_with_a_verdict_each(monkeypatch):
    monkeypatch.setattr(comparison, "table", lambda *how: how)
    shell, loaded = Shell(), types.SimpleNamespace(metrics=mc.METRICS, law=None)
    walks = {"base_admittance": walk("base_admittance"), "pd": walk("pd")}
    run.show(walks, {"base_admittance": HELD, "pd": HELD | {"missed_grips": 2}}, loaded, shell)
    table, *verdicts = shell.shown
    own = {name: getattr(CASE.control, name) for name in mc.Gains.AXES}
    assert table[0] == {"base_admittance": (own, HELD), "pd": (None, HELD | {"missed_grips": 2})}
    assert table[1:4] == ("", mc.METRICS, None)
    assert table[4] == [("base_admittance", None), ("base_admittance", "pd"), ("pd", None)]
    held, missed = verdicts
    assert held == "base_admittance: held all the way"
    assert missed.startswith("pd: every grip held, but 2 missed the ground; ")
    assert not shell.stages


@pytest.mark.parametrize("width", [56, 57])
def test_changes_are_shown_where_there_is_room_for_them(monkeypatch, width):
    monkeypatch.setattr(comparison, "table", lambda *how: how[-1])
    found = session.comparison_table({"pd": (None, HELD), "mine": ({}, HELD)}, "pd", width, mc.METRICS)
    assert found == [("pd", None), ("mine", None), ("mine", "pd")][: 2 + (width >= 57)]
    assert session.comparison_table({"mine": ({}, HELD)}, "pd", 90, mc.METRICS) == [("mine", None)]


@pytest.mark.parametrize(
    ("name", "row", "at"),
    [("base_position", 2, 0.2), ("joint_rates", 3, 0.3), ("foot_force", 0, 0.0), ("joint_torque", 4, 0.4),
     ("time", None, 0.4)],
)  # fmt: skip
def test_a_walk_diverges_at_its_first_number_that_is_none(name, row, at):
    own = walk("pd")
    if row is not None:
        getattr(own, name)[row:] = np.nan
    assert run.verdict(own, HELD | {"diverged": True}) == f"diverged at {at:.3f} s"
    own.falls_at = 0.1
    both = run.verdict(own, HELD | {"diverged": True, "detached_limb": "RF", "detached_at": 0.05, "missed_grips": 3})
    assert both.startswith(
        f"limb RF let go at 0.050 s, diverged at {at:.3f} s, falls off: no grip holds from 0.100 s on; 3 grips missed"
    )


def shell_of(monkeypatch):
    out = io.StringIO()
    made = session.Session(io.StringIO())
    made.console = session.console(out)
    monkeypatch.setattr(made, "show", lambda *what: None)
    return made, out


def test_a_search_tells_its_best_its_slope_and_the_walks_alive(monkeypatch):
    shell, out = shell_of(monkeypatch)
    now = types.SimpleNamespace(rounds=3, rounds_in_all=9, best=0.51234, gradient_norm=0.0123, phase="descent", alive=7,
                                batch=8, env_steps=2_345_000)  # fmt: skip
    with shell.rounds("mine") as told:
        told(now)
        assert shell.done == 3
        now.best, now.gradient_norm = math.inf, math.nan
        told(now)
    first, second = re.findall("mine: .*|descent .*", out.getvalue())[:2]
    assert first.startswith("descent 3/9: best 0.5123, gradient 0.012, 7 of 8 alive, 2.35 M env-steps")
    assert second.startswith("descent 3/9: best none feasible yet, 7 of 8 alive")


@pytest.mark.parametrize("tables", [(), ("its own",)])
@pytest.mark.parametrize("before", [None, types.SimpleNamespace(whole=False), types.SimpleNamespace(whole=True)])
def test_a_first_result_is_written_unless_the_folder_holds_the_whole_one(before, tables, monkeypatch, tmp_path):
    shell, out = shell_of(monkeypatch)
    shown, written = [], []
    monkeypatch.setattr(shell, "show", lambda *what: shown.append(what))
    monkeypatch.setattr(session, "comparison_table", lambda *how: how)
    monkeypatch.setattr(comparison, "gains_table", lambda *how: how)
    monkeypatch.setattr(record, "read", lambda place: before if place == tmp_path else 1 / 0)
    monkeypatch.setattr(folder, "write", lambda *given, **how: written.append((given, how)) or NAMED)
    shell.out, shell.name, shell.settings = tmp_path, "case", {"a": 1}
    told = types.SimpleNamespace(compared="walks", outcome=("one", "two"), tables=tables)
    problem = types.SimpleNamespace(metrics="metrics", law="law")
    made = types.SimpleNamespace(written=told, problem=problem)
    search = None if before is None else "search"
    shell.first_result(types.SimpleNamespace(problem=problem, search=search), made, "again", "the rivals")
    of_walks = [(("walks", "pd", shell.tables.width, "metrics", "law"),)]
    of_walks += [] if search is None else [(("walks", "law"),)]
    assert shown == [*([tables] if tables else of_walks), ("one", "two")]
    if before is not None and before.whole:
        assert not written and shell.lacks == "" and not out.getvalue()
        return
    (((content, place, about), how),) = written
    assert (content, place, about, how["settings"], how["finished"]) == (made, tmp_path, "", {"a": 1}, False)
    assert (how["origin"].name, how["origin"].again) == ("case", "again")
    assert shell.lacks == "the rivals" and "map.png; the rivals follow" in " ".join(out.getvalue().split())


# ------------------------------------------------------------------------------------------------ several processes


def rows_of(monkeypatch, *others):
    """Have all processes tell what this one tells, but others their own."""

    def gathered(own):
        rows = [own if other is None else np.frombuffer(other.ljust(len(own), b"\0"), np.uint8) for other in others]
        return np.stack(rows)

    monkeypatch.setattr(multihost_utils, "process_allgather", gathered)


DIGEST = bytes(range(32))


@pytest.mark.parametrize(
    ("others", "problem", "said"),
    [
        ((None, None), "", None),
        ((None, DIGEST + b"no file"), "", "process 1: no file"),
        ((bytes(32), None), "", "process 0: expected the same command and config in all processes"),
        # one's own error is said by oneself, and another's as it is where one has an error too
        ((None, None), "mine", "mine"),
        ((DIGEST + b"theirs", None), "mine", "theirs"),
    ],
)
def test_processes_hear_of_the_errors_of_others(monkeypatch, tmp_path, others, problem, said):
    team = Team(Process(1 if problem or others[0] else 0, 2, None, "test"), tmp_path)
    rows_of(monkeypatch, *others)
    with pytest.raises(InputError) if said else contextlib.nullcontext() as found:
        team.agree(DIGEST, problem)
    assert said is None or str(found.value) == said


def test_all_processes_begin_with_the_parts_of_the_first(monkeypatch, tmp_path):
    """The archive that process 0 sends is unpacked by the others; without parts nothing is sent."""
    rows_of(monkeypatch, None, None)
    sent, homes = [], [tmp_path / name for name in ("first", "second")]
    (homes[0] / "parts").mkdir(parents=True)
    (homes[0] / "parts" / "part-0.npz").write_text("kept")
    homes[1].mkdir()
    monkeypatch.setattr(multihost_utils, "broadcast_one_to_all", lambda value: sent.append(value) or value)
    first, second = (Team(Process(n, 2, None, "test"), tmp_path / "own") for n in (0, 1))
    assert not first.heard and Team(None, tmp_path).heard
    first.begin(homes[0], "asked")
    assert first.heard and len(sent) == 2 and int(sent[0]) == len(sent[1])
    answers = iter(sent[:])
    monkeypatch.setattr(multihost_utils, "broadcast_one_to_all", lambda value: next(answers))
    second.begin(homes[1], "asked")
    assert (homes[1] / "parts" / "part-0.npz").read_text() == "kept"
    assert (first.folder(homes[0]), second.folder(homes[1])) == (homes[0], tmp_path / "own" / "out")
    (homes[0] / "parts" / "part-0.npz").unlink()
    (homes[0] / "parts").rmdir()
    sent.clear()
    monkeypatch.setattr(multihost_utils, "broadcast_one_to_all", lambda value: sent.append(value) or value)
    first.begin(homes[0], "asked")
    assert [int(value) for value in sent] == [0]


def test_a_log_is_walked_under_the_law_with_its_pushes_and_both_walks_are_shown(monkeypatch):
    law, asked = mc.control.PD(), []
    monkeypatch.setattr(mc, "rollout", lambda scenario, **how: asked.append((scenario, how)) or walk("pd", gap=1.0))
    monkeypatch.setattr(mc, "metrics", lambda one, about: HELD | {"travel": one.gap, "missed_grips": 2 * int(one.gap)})
    push = {"force": [1.0, 0.0, 0.0], "start": 0.1, "stop": 0.2}
    logged = CASE.with_overrides({"disturbance.pushes": [push], "duration": 0.7, "control.kp": 9.0})
    loaded = types.SimpleNamespace(scenario=CASE, law=law, engine="mjx", metrics=mc.METRICS)
    shell, found = Shell(), types.SimpleNamespace(scenario=logged, walk=walk("pd"))
    told = logs.walked_under_law(found, loaded, shell)
    wanted = CASE.with_overrides({"disturbance.pushes": [push], "duration": 0.7})
    assert asked == [(wanted, {"law": law, "engine": "mjx"})] and shell.stages == [("law on the logged pushes", {})]
    assert {name: values["travel"] for name, values in told.items()} == {"law": 1.0, "logged commands": 0.0}
    table, *verdicts = shell.shown
    assert table.columns == ["metric", "law", "logged commands", "unit"]
    assert ["travel", "1", "0", "m"] in table.sections[0][1] and len(table.sections[0][1]) == len(HELD)
    assert verdicts[0].startswith("law: every grip held, but 2 missed the ground")
    assert verdicts[1] == "logged commands: held all the way"


@pytest.mark.parametrize("terminal", [True, False])
def test_a_film_is_told_of_frame_by_frame_at_a_terminal_and_every_fiftieth_in_a_file(terminal, monkeypatch, tmp_path):
    told, saved = [], []

    def save_video(file, *walks, progress, **how):
        saved.append((file, walks, how))
        for done in range(1, 121):
            progress(done, 120)

    monkeypatch.setattr("mjx_climb.viz.rendering.save_video", save_video)
    monkeypatch.setattr("sys.stderr", types.SimpleNamespace(isatty=lambda: terminal))

    @contextlib.contextmanager
    def stage(name, **how):
        assert (name, how) == ("video", {"compiles": False, "unit": "frames"})
        yield lambda *now: told.append(now)

    names = run.Pictures(video=True).write({"a": 1, "b": 2}, tmp_path, stage)
    assert (names, saved) == (
        ["walk.mp4"],
        [(tmp_path / "walk.mp4", (1, 2), {"size": (960, 720), "labels": ["a", "b"]})],
    )
    frames = range(1, 121) if terminal else (50, 100, 120)
    assert told == [(0, 1), *((frame, 120) for frame in frames)]
    run.Pictures(video=True).write({"a": 1}, tmp_path, stage)
    assert saved[1][1:] == ((1,), {"size": (1280, 720), "labels": None})


def test_a_robot_that_stands_has_stood_since_its_first_limb_found_no_grip():
    own = walk("pd", standing={"LF": 0.3, "RH": 0.2})
    assert run.verdict(own, HELD) == "stands from 0.200 s, as LF and RH found no grip"
